"""Modules that obey Eq. 14, many at once with different gains, for the search of `gains.py`.

The chambers are `LagPneumatics`. The controllers run every millisecond with a noisy
sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.linalg import expm

from srs_twin import RobotSpec, Trajectory, load_robot
from srs_twin.control.smc import SlidingMode
from srs_twin.pneumatics.lag import LagPneumatics

TICK_S = 1e-3
SUPPLY_PA = 48.3e3
NOISE_RAD = np.radians(0.2)


@dataclass(frozen=True)
class Module:
    """Module on a bench.

    Attributes:
        pace: factor on the time constants.
        end_kg: mass at the free end, kg; without it the module obeys Eq. 14.
        leak_per_s: leak rate λ of the chambers, 1/s.
        seed: random seed of the sensor noise.
    """

    pace: float = 1.0
    end_kg: float = 0.0
    leak_per_s: float = 0.0
    seed: int = 0

    def spec(self, count: int) -> RobotSpec:
        """Return generation 4 with a number of independent segments as modules."""
        spec = load_robot("gen4")
        actuator = replace(
            spec.actuator,
            tau_fill=self.pace * spec.actuator.tau_fill,
            tau_vent=self.pace * spec.actuator.tau_vent,
        )
        geometry = replace(spec.geometry, connectors=count + 1)
        mass = replace(spec.mass, connectors=spec.mass.connectors[:1] * (count + 1))
        return replace(spec, actuator=actuator, geometry=geometry, mass=mass)

    def follow(
        self, controller: SlidingMode, duration: float, *, count: int = 1
    ) -> list[Trajectory]:
        """Return the trajectories of several modules, each with its own gains of the controller.

        Args:
            controller: controller with gains of shape (count,) or scalars.
            duration: simulated time, s.
            count: number of modules.
        """
        spec = self.spec(count)
        air = LagPneumatics(
            spec,
            supply_pa=SUPPLY_PA,
            layout=controller.layouts[0],
            leak_per_s=self.leak_per_s,
        )
        load = _Load(spec, self.end_kg) if self.end_kg else None
        controller.reset(spec, TICK_S)
        ticks = round(duration / TICK_S)
        # The same noise for all modules, so that only the gains differ.
        noise = NOISE_RAD * np.random.default_rng(self.seed).standard_normal(
            (ticks + 1, 1)
        )
        noise = np.repeat(noise, count, axis=1)
        bend = np.zeros((ticks + 1, count))
        reference = np.zeros((ticks + 1, count))
        states = np.full((ticks + 1, count, 2), -1, dtype=np.int8)
        reference[0] = controller.signals()["reference"]
        end = np.array([TICK_S])
        for k in range(ticks):
            seen: Any = SimpleNamespace(
                time=k * TICK_S, measured_bend=bend[k] + noise[k]
            )
            trace = air.advance(air.schedule(controller.step(seen), TICK_S), end)
            bend[k + 1] = (
                trace.bend[0] if load is None else load.step(trace.pressure[0])
            )
            states[k + 1] = air.valves
            reference[k + 1] = controller.signals()["reference"]
        time = TICK_S * np.arange(ticks + 1)
        return [
            Trajectory(
                {
                    "time": time,
                    "reference_1": reference[:, j],
                    "bend_1": bend[:, j],
                    "measured_bend_1": bend[:, j] + noise[:, j],
                    "valve_plus_1": states[:, j, 0].astype(float),
                    "valve_minus_1": states[:, j, 1].astype(float),
                },
                metadata={
                    "tick_s": TICK_S,
                    "valve_switches": air.openings[j : j + 1].tolist(),
                },
            )
            for j in range(count)
        ]


class _Load:
    """Bends with a mass at the end: J q̈ + k τ₂ q̇ + k q = k G (p⁺ − p⁻), pressures linear over a tick."""

    def __init__(self, spec: RobotSpec, end_kg: float) -> None:
        # The end of an arc of length l with bend q moves laterally by l q/2.
        inertia = end_kg * (spec.geometry.segment_length / 2) ** 2
        pull = spec.bending.stiffness / inertia
        matrix = [
            [0, 1, 0, 0],
            [-pull, -pull * spec.actuator.tau_mode, pull, 0],
            [0, 0, 0, 1],
            [0, 0, 0, 0],
        ]
        self._gain = spec.actuator.gain
        self._step = expm(TICK_S * np.array(matrix))
        self._state = np.zeros(
            (4, spec.segments)
        )  # bend, its rate, free bend, its rate

    def step(self, pressure: np.ndarray) -> np.ndarray:
        """Return the bends after a tick that ends with these pressures, shape (segments, 2)."""
        self._state[3] = (
            self._gain * (pressure[:, 0] - pressure[:, 1]) - self._state[2]
        ) / TICK_S
        self._state = self._step @ self._state
        return self._state[0].copy()
