"""Trajectories of a straight rigid snake on arcs, with exact speed, curvature and edges.

The kinematics of the package are not used: headings are integrated in small steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from srs_twin import Trajectory, load_robot
from srs_twin.robot.spec import Geometry

SUBSTEPS = 10


@dataclass(frozen=True)
class Crawl:
    """Prescribed motion in SI units; the sway (ahead, left) in the path frame has the gait's period."""

    curvatures: tuple[float, ...] = (0.0,)
    until: tuple[float, ...] = ()
    speed: float = 0.15
    frequency: float = 2.0
    sway: tuple[float, float] = (0.0, 0.0)
    phase: float = 0.0
    duration: float = 4.0
    record_hz: float = 100.0

    @property
    def geometry(self) -> Geometry:
        return replace(
            load_robot("gen2").geometry,
            connectors=5,
            segment_length=0.04,
            rigid_gap=0.01,
            width=0.03,
        )

    @property
    def period(self) -> float:
        return 1 / self.frequency

    def path(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions x + i y and headings of the path at evenly spaced times."""
        fine = np.linspace(time[0], time[-1], (len(time) - 1) * SUBSTEPS + 1)
        step = fine[1] - fine[0]
        middle = fine[:-1] + step / 2
        curvature = np.array(self.curvatures)[np.searchsorted(self.until, middle)]
        heading = np.concatenate([[0.0], np.cumsum(curvature * self.speed * step)])
        steps = self.speed * step * np.exp(1j * (heading[1:] + heading[:-1]) / 2)
        place = np.concatenate([[0.0], np.cumsum(steps)])
        return place[::SUBSTEPS], heading[::SUBSTEPS]

    def trajectory(self) -> Trajectory:
        time = np.arange(round(self.duration * self.record_hz) + 1) / self.record_hz
        place, heading = self.path(time)
        beat = 2 * np.pi * self.frequency * time + self.phase
        com = place + (
            self.sway[0] * np.sin(beat) + 1j * self.sway[1] * np.cos(beat)
        ) * np.exp(1j * heading)
        stations = (
            np.linspace(0.5, -0.5, self.geometry.connectors) * self.geometry.body_length
        )
        body = com[:, None] + stations * np.exp(1j * heading)[:, None]
        columns = {
            "time": time,
            "com_x": com.real,
            "com_y": com.imag,
            "heading": heading,
        }
        for i in range(self.geometry.connectors):
            columns |= {
                f"x_{i + 1}": body[:, i].real,
                f"y_{i + 1}": body[:, i].imag,
                f"connector_heading_{i + 1}": heading,
            }
        about = {
            "plant": "twin",
            "gait_frequency_hz": self.frequency,
            "body_length_m": self.geometry.body_length,
        }
        return Trajectory(columns, metadata=about)
