"""Trajectories with prescribed speed, turning radius and bends.

A constant-curvature snake moves along a straight line or a circle. The kinematics of
the package are not used: the tangent of the centre line is integrated numerically along
the body.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from srs_twin.trajectory import Trajectory


@dataclass(frozen=True)
class Snake:
    """Prescribed motion in SI units; the oscillation of the body is in the path frame (ahead, left)."""

    speed: float = 0.2
    yaw_rate: float = 0.0
    frequency: float = 2.0
    amplitude: float = 0.8
    bias: float = 0.0
    sway: tuple[float, float] = (0.004, 0.006)
    heading_sway: float = 0.1
    phase: float = 0.0
    backward_wave: bool = False
    connectors: int = 5
    segment_length: float = 0.037
    rigid_gap: float = 0.018
    duration: float = 6.0
    record_hz: float = 100.0
    periodic: bool = True

    @property
    def body_length(self) -> float:
        return (self.connectors - 1) * (self.segment_length + self.rigid_gap)

    def bends(self, time: np.ndarray) -> np.ndarray:
        """Return a bend wave that travels from head to tail, shape (samples, segments)."""
        lag = 2 * np.pi / (self.connectors - 1) * np.arange(self.connectors - 1)
        sense = -1.0 if self.backward_wave else 1.0
        angle = sense * 2 * np.pi * self.frequency * time[:, None] - lag + self.phase
        return self.bias + self.amplitude * np.sin(angle)

    def trajectory(self, plant: str = "analytical") -> Trajectory:
        time = np.arange(round(self.duration * self.record_hz) + 1) / self.record_hz
        beat = 2 * np.pi * self.frequency * time + self.phase
        path_heading = self.yaw_rate * time
        heading = path_heading + self.heading_sway * np.sin(beat + 0.4)
        sway = np.stack(
            [self.sway[0] * np.sin(2 * beat), self.sway[1] * np.cos(beat)], axis=-1
        )
        com = arc(self.speed, self.yaw_rate, time) + _turned(sway, path_heading)
        bend = self.bends(time)
        theta = _headings(bend, heading)
        body = _centre_line(theta, self.segment_length, self.rigid_gap)
        position = com[:, None, :] + body - body.mean(axis=1, keepdims=True)
        return Trajectory(
            {
                "time": time,
                "com_x": com[:, 0],
                "com_y": com[:, 1],
                "heading": heading,
                **numbered("x", position[..., 0]),
                **numbered("y", position[..., 1]),
                **numbered("connector_heading", theta),
                **numbered("bend", bend),
            },
            metadata={
                "plant": plant,
                "robot": "synthetic",
                "tick_s": 0.02,
                "duration_s": self.duration,
                "gait_frequency_hz": self.frequency if self.periodic else None,
                "body_length_m": self.body_length,
                "record_hz": self.record_hz,
                "valve_switches": [[12, 12]] * (self.connectors - 1),
            },
        )


def numbered(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{name}_{i}": column for i, column in enumerate(values.T, start=1)}


def with_columns(trajectory: Trajectory, **columns: np.ndarray) -> Trajectory:
    return replace(trajectory, columns={**trajectory.columns, **columns})


def with_metadata(trajectory: Trajectory, **metadata: object) -> Trajectory:
    return replace(trajectory, metadata={**trajectory.metadata, **metadata})


def sampled(trajectory: Trajectory, keep: slice | np.ndarray) -> Trajectory:
    return replace(
        trajectory,
        columns={name: column[keep] for name, column in trajectory.columns.items()},
    )


def moved(trajectory: Trajectory, x: float, y: float, angle: float) -> Trajectory:
    """Return the run rotated about the origin and then shifted."""
    shift = np.array([x, y])
    com = _turned(trajectory.com, angle) + shift
    position = _turned(trajectory.position, angle) + shift
    return with_columns(
        trajectory,
        com_x=com[:, 0],
        com_y=com[:, 1],
        heading=trajectory["heading"] + angle,
        **numbered("x", position[..., 0]),
        **numbered("y", position[..., 1]),
        **numbered("connector_heading", trajectory.stack("connector_heading") + angle),
    )


def mirrored(trajectory: Trajectory) -> Trajectory:
    """Return the run mirrored at the x axis."""
    names = ("com_y", "heading", "y", "connector_heading", "bend")
    flipped = {
        n: -c
        for n, c in trajectory.columns.items()
        if n.rstrip("0123456789").rstrip("_") in names
    }
    return with_columns(trajectory, **flipped)


def backwards(trajectory: Trajectory) -> Trajectory:
    """Return the run in reverse order."""
    return with_columns(
        sampled(trajectory, slice(None, None, -1)), time=trajectory.time
    )


def _turned(points: np.ndarray, angle: float | np.ndarray) -> np.ndarray:
    turned = (points[..., 0] + 1j * points[..., 1]) * np.exp(1j * np.asarray(angle))
    return np.stack([turned.real, turned.imag], axis=-1)


def arc(speed: float, yaw_rate: float, time: np.ndarray) -> np.ndarray:
    """Return points of a path that starts along x with a constant yaw rate, shape (samples, 2)."""
    half = yaw_rate * time / 2
    chord = speed * time * np.sinc(half / np.pi)
    return np.stack([chord * np.cos(half), chord * np.sin(half)], axis=-1)


def _headings(bend: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return connector headings with q_j = θ_j − θ_{j+1} and the given mean, shape (samples, N)."""
    from_head = np.concatenate(
        [np.zeros((len(bend), 1)), -np.cumsum(bend, axis=1)], axis=1
    )
    return from_head + (mean - from_head.mean(axis=1))[:, None]


def _centre_line(theta: np.ndarray, length: float, gap: float) -> np.ndarray:
    """Return connector positions relative to the head, shape (samples, N, 2)."""
    node, weight = np.polynomial.legendre.leggauss(12)
    along_arc = 0.5 * (node + 1)
    front = theta[:, :-1, None]
    back = theta[:, 1:, None]
    tangent = np.exp(1j * (front + (back - front) * along_arc))
    chord = length * (tangent @ (0.5 * weight)) + 0.5 * gap * np.exp(1j * theta[:, :-1])
    chord = chord + 0.5 * gap * np.exp(1j * theta[:, 1:])
    place = np.concatenate(
        [np.zeros((len(theta), 1)), -np.cumsum(chord, axis=1)], axis=1
    )
    return np.stack([place.real, place.imag], axis=-1)
