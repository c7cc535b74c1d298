"""Bends that are prescribed instead of driven by chambers, such as a travelling wave of curvature."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from srs_twin.pneumatics import Pneumatics, Schedule, Trace
from srs_twin.pneumatics.base import OptionalArray
from srs_twin.robot.file import load_robot
from srs_twin.robot.spec import Friction, Geometry, Mass, RobotSpec, Skin

Path = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


class PrescribedBends(Pneumatics):
    """Bends that follow a given path in time instead of chambers.

    Args:
        path: function of times, shape (times,); returns bends, rates and accelerations,
            each of shape (times, segments).
    """

    kind = "prescribed"
    measures_air = False

    def __init__(self, spec: RobotSpec, path: Path) -> None:
        self._path = path
        super().__init__(spec, layout="3/2")

    def reset(self) -> None:
        super().reset()
        self.bend = self._at(np.zeros(1)).bend[0]

    def _simulate(
        self,
        schedule: Schedule,
        times: np.ndarray,
        bend: OptionalArray,
        bend_rate: OptionalArray,
    ) -> Trace:
        trace = self._at(self._elapsed + times)
        self.bend = self._at(np.array([self._elapsed + schedule.span])).bend[0]
        return trace

    def _at(self, time: np.ndarray) -> Trace:
        trace = Trace.empty(len(time), self._segments)
        trace.bend[:], trace.bend_rate[:], trace.bend_acceleration[:] = self._path(time)
        trace.pressure[:] = 0.0
        trace.valves[:] = -1
        trace.pneumatic_energy[:] = 0.0
        return trace


class CurvatureWave(PrescribedBends):
    """Bends q_j = ∫ κ ds of segment j for κ = K cos 2π(n s + t/T), with s from the tail in body lengths."""

    def __init__(
        self, spec: RobotSpec, *, amplitude: float, period: float, waves: float = 1.0
    ) -> None:
        omega = 2 * math.pi / period
        wave_number = 2 * math.pi * waves
        places = wave_number * (1 - np.arange(spec.segments + 1) / spec.segments)
        scale = amplitude / wave_number

        def path(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            ends = places + omega * time[:, None]
            return (
                -scale * np.diff(np.sin(ends)),
                -scale * omega * np.diff(np.cos(ends)),
                scale * omega**2 * np.diff(np.sin(ends)),
            )

        super().__init__(spec, path)


def continuous_snake(
    forward: float,
    backward: float,
    transverse: float,
    *,
    friction_law: str = "cosine",
    segments: int = 32,
    points: int = 4,
) -> RobotSpec:
    """Return a uniform body of 1 m and 1 kg with skin, whose segments bend over their whole length."""
    base = load_robot("gen2")
    return replace(
        base,
        geometry=Geometry(segments + 1, 1.0 / segments, 0.0, 0.01, 0.001, 0.001, 0.03),
        mass=Mass.along_body((1.0 / segments,) * segments),
        friction=Friction(forward, transverse, mu_back=backward),
        skin=Skin(friction_law=friction_law, points=points),
    )
