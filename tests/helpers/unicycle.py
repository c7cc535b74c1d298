"""Unicycle plant: its curvature follows the offset of a gait, and its heading oscillates."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.plants.base import Plant, SnakeState
from srs_twin.robot.file import load_robot

VENT = np.full((4, 2), -1, dtype=np.int8)


class Wheel(Controller):
    """Gait without valve commands; it only has an offset."""

    kind = "wheel"
    frequency = 2.0

    def __init__(self):
        self.offset = 0.0

    def reset(self, spec, tick, *, seed=0):
        pass

    def step(self, state):
        return VENT

    def signals(self):
        return {"offset": self.offset}


@dataclass
class Unicycle(Plant):
    """Unicycle with dκ/ds = (curvature_at(offset) − κ)/ℓ; state variables that are not modelled are NaN.

    Attributes:
        wheel: gait whose offset steers.
        curvature_at: function from offset to curvature, 1/m.
        speed: forward speed, m/s.
        response_length: response length ℓ, m.
        wag: amplitude of the heading oscillation at the gait frequency, rad.
        stops: time at which it stops, s.
    """

    wheel: Wheel
    curvature_at: object
    speed: float = 0.2
    response_length: float = 0.05
    wag: float = 0.3
    stops: float = math.inf
    tick: float = 0.02
    name: str = "analytical"
    spec: object = field(default_factory=lambda: load_robot("gen2"))

    def reset(self, *, pose=(0.0, 0.0, 0.0), seed=0):
        self.x, self.y, self.heading = pose
        self.time = 0.0
        self.curvature = 0.0
        self.offsets = []
        return self._state()

    def step(self, valves):
        self.offsets.append((self.time, self.wheel.offset))
        substeps = 10
        for _ in range(substeps if self.time < self.stops else 0):
            distance = self.speed * self.tick / substeps
            self.curvature += (
                self.curvature_at(self.wheel.offset) - self.curvature
            ) * (1 - math.exp(-distance / self.response_length))
            self.heading += distance * self.curvature / 2
            self.x += distance * math.cos(self.heading)
            self.y += distance * math.sin(self.heading)
            self.heading += distance * self.curvature / 2
        self.time = round(self.time + self.tick, 9)
        return self._state()

    def _state(self):
        swing = self.wag * math.sin(2 * math.pi * Wheel.frequency * self.time)
        values = dict.fromkeys((each.name for each in fields(SnakeState)), math.nan)
        values["time"] = self.time
        values["com"] = np.array([self.x, self.y])
        values["heading"] = self.heading + swing
        return SnakeState(**values)
