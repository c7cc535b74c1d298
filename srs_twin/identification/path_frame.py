r"""Poses along arcs, and what a period-averaged path says of them.

A pose is a point of the path and the direction of the path there, as a planner has it. With arcs of curvature
κ and length L as motions

.. math:: A_κ(L) = \Bigl(L\,\mathrm{sinc}\tfrac{κL}{2},\; \text{at the angle}\; \tfrac{κL}{2};\;\; κL\Bigr),

poses are put after each other: P ∘ A is where the arc leads from P. Arrays of poses have one leading axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.gait_window import GaitWindow
from srs_twin.trajectory import Trajectory

_STRAIGHT = 1e-9  # 1/m: an arc of less curvature is a line to rounding
_SMALL_TURN = 1e-4  # rad: below it a series is better than a quotient of two small numbers


@dataclass(frozen=True)
class Frames:
    """Poses, or motions from one pose to another.

    Attributes:
        place: x + i y, shape (n,) or (), m.
        heading: same shape, rad.
    """

    place: np.ndarray
    heading: np.ndarray

    @classmethod
    def arc(cls, curvature: float, length: np.ndarray | float) -> Frames:
        """Return the motions A_κ(L); negative lengths (m) lead back."""
        half = curvature * np.asarray(length, dtype=float) / 2
        return cls(length * np.sinc(half / np.pi) * np.exp(1j * half), 2 * half)

    def then(self, other: Frames) -> Frames:
        """Return self ∘ other: the other motion begun at this pose."""
        return Frames(self.place + np.exp(1j * self.heading) * other.place, self.heading + other.heading)

    def inverse(self) -> Frames:
        """Return the motion that undoes this one."""
        return Frames(-np.exp(-1j * self.heading) * self.place, -self.heading)

    def mean(self) -> Frames:
        """Return the mean of poses that lie close to each other."""
        return Frames(np.asarray(self.place.mean()), np.asarray(self.heading.mean()))

    def coordinates(self, points: np.ndarray, curvature: float) -> tuple[np.ndarray, np.ndarray]:
        """Return path coordinates of points about arcs through these poses, as `planning.swept` has them.

        Args:
            points: shape (n, points, 2), m; with a single pose any first axis.
            curvature: of the arcs, 1/m.

        Returns:
            Place along the arc from the pose, and distance to its left, each (n, points), m.
        """
        away = points[..., 0] + 1j * points[..., 1] - self.place[..., None]
        away = away * np.exp(-1j * self.heading)[..., None]
        u, w = away.real, away.imag
        across, down = curvature * u, 1 - curvature * w
        left = (2 * w - curvature * (u**2 + w**2)) / (1 + np.hypot(across, down))
        along = np.arctan2(across, down) / curvature if abs(curvature) > _STRAIGHT else u
        return along, left


def averaged_path(trajectory: Trajectory, window: GaitWindow) -> tuple[np.ndarray, Frames]:
    """Return times (s) and poses of the period-averaged path of the centre of mass in a window.

    Each pose is in the middle of a period, its direction that of the period's chord. The mean of an arc lies
    inside of it, by (1 − sinc(φ/2))/κ where a period turns by φ; that is put back. What the body sways in a
    period is in single poses still; means over whole periods of them are free of it.

    Args:
        trajectory: one run.
        window: K periods, in which the snake is taken to turn at one rate.

    Returns:
        (instants,) each, over K − 1 periods.
    """
    mean, velocity = window.running(trajectory, trajectory.com)
    turn = float(window.running(trajectory, trajectory["heading"])[1].mean()) * window.period
    chord = (velocity[:, 0] + 1j * velocity[:, 1]) * window.period
    half = turn / 2
    inside = half / 12 if abs(half) < _SMALL_TURN else (1 - np.sinc(half / np.pi)) / (2 * np.sin(half))
    place = mean[:, 0] + 1j * mean[:, 1] - 1j * inside * chord
    times = window.times(window.periods - 1) + window.period / 2
    return times, Frames(place, np.unwrap(np.angle(chord)))
