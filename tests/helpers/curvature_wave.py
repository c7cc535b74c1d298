"""Bends of a travelling wave of curvature, prescribed instead of driven by chambers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from srs_twin.pneumatics import Pneumatics, Schedule, Trace
from srs_twin.pneumatics.base import OptionalArray
from srs_twin.robot.file import load_robot
from srs_twin.robot.spec import Friction, Geometry, Mass, RobotSpec, Skin


class CurvatureWave(Pneumatics):
    """Bends q_j = ∫ κ ds of segment j for κ = K cos 2π(n s + t/T), with s from the tail in body lengths."""

    kind = "wave"
    metered = False

    def __init__(self, spec: RobotSpec, *, amplitude: float, period: float, waves: float = 1.0) -> None:
        self._amplitude, self._period, self._waves = amplitude, period, waves
        super().__init__(spec, layout="3/2")

    def reset(self) -> None:
        super().reset()
        self.bend = self._at(np.zeros(1)).bend[0]

    def _simulate(
        self, schedule: Schedule, times: np.ndarray, bend: OptionalArray, bend_rate: OptionalArray
    ) -> Trace:
        trace = self._at(self._elapsed + times)
        self.bend = self._at(np.array([self._elapsed + schedule.span])).bend[0]
        return trace

    def _at(self, time: np.ndarray) -> Trace:
        trace, omega = Trace.empty(len(time), self._segments), 2 * math.pi / self._period
        wave_number = 2 * math.pi * self._waves
        ends = wave_number * (1 - np.arange(self._segments + 1) / self._segments) + omega * time[:, None]
        scale = self._amplitude / wave_number
        trace.bend[:] = -scale * np.diff(np.sin(ends))
        trace.bend_rate[:] = -scale * omega * np.diff(np.cos(ends))
        trace.bend_acceleration[:] = scale * omega**2 * np.diff(np.sin(ends))
        trace.pressure[:], trace.valves[:], trace.air[:] = 0.0, -1, 0.0
        return trace


def continuous_snake(
    forward: float, backward: float, transverse: float, *, law: str = "cosine", segments: int = 32,
    points: int = 4,
) -> RobotSpec:  # fmt: skip
    """Return a uniform body of 1 m and 1 kg with skin, whose segments bend over their whole length."""
    base = load_robot("gen2")
    return replace(
        base,
        geometry=Geometry(segments + 1, 1.0 / segments, 0.0, 0.01, 0.001, 0.001, 0.03),
        mass=Mass.along_body((1.0 / segments,) * segments),
        friction=Friction(forward, transverse, mu_back=backward),
        skin=Skin(law=law, points=points),
    )
