"""How far a body reaches to the left and right of the path of its centre of mass (Fig. 58, Table 8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.gait_window import GaitWindow
from srs_twin.comparison.sampling import positive_number
from srs_twin.trajectory import Trajectory

# A path that bends by less than this over its whole length is taken for a line, rad: where a circle would be
# fitted to it, rounding would decide its radius.
_LEAST_TURN = 1e-4


@dataclass(frozen=True)
class PathFit:
    """The circle, or the line, that fits the period-averaged path of a centre of mass best.

    Attributes:
        centre: of the circle, shape (2,), m; of a line any point on it.
        radius: m, positive where the centre lies on the left of the way the snake heads; None: a line.
        ahead: unit vector along a line, shape (2,).
    """

    centre: np.ndarray
    radius: float | None
    ahead: np.ndarray

    @classmethod
    def of(cls, trajectory: Trajectory, window: GaitWindow) -> PathFit | None:
        """Return the fit over a window of whole periods; None of a snake that stays where it is."""
        mean, velocity = window.running(trajectory, trajectory.com)
        heading, turning = window.running(trajectory, trajectory["heading"])
        middle = mean.mean(axis=0)
        length = float(np.hypot(*velocity.T).mean()) * (window.periods - 1) * window.period
        if length < 1e-9:
            return None
        # Along the path the heading goes with it: which side is left is the heading's to say.
        facing = heading[len(heading) // 2]
        ahead = np.array([np.cos(facing), np.sin(facing)])
        turn = float(turning.mean()) * window.period
        x, y = (mean - middle).T / length
        # Kåsa's circle: x² + y² + a x + b y + c = 0, by least squares.
        basis = np.stack([x, y, np.ones_like(x)], axis=-1)
        (a, b, c), _, rank, _ = np.linalg.lstsq(basis, -(x**2 + y**2), rcond=1e-10)
        bent = rank == 3 and abs(turn) * (window.periods - 1) >= _LEAST_TURN
        if not bent:
            along = np.linalg.svd(mean - middle, full_matrices=False)[2][0]
            return cls(middle, None, along if along @ ahead > 0 else -along)
        centre = np.array([-a / 2, -b / 2])
        # Averaging over a period draws a circle inwards by the sinc of half the turn.
        radius = length * float(np.sqrt(centre @ centre - c)) / float(np.sinc(turn / (2 * np.pi)))
        left = ahead[0] * centre[1] - ahead[1] * centre[0]
        return cls(middle + length * centre, radius if left > 0 else -radius, ahead)

    def to_the_right(self, points: np.ndarray) -> np.ndarray:
        """Return how far points, shape (…, 2), lie to the right of the path, shape (…), m."""
        apart = points - self.centre
        if self.radius is None:
            side: np.ndarray = self.ahead[1] * apart[..., 0] - self.ahead[0] * apart[..., 1]
            return side
        beyond = np.hypot(apart[..., 0], apart[..., 1]) - abs(self.radius)
        return beyond if self.radius > 0 else -beyond


def box_edges(trajectory: Trajectory, window: GaitWindow, path: PathFit) -> tuple[float, float]:
    """Return the left and the right edge of what a body sweeps over a window, m; left is negative.

    Each connector counts with half the width of the body on either side of it, across its own heading, where
    the metadata give a width (``body_width_m``).
    """
    seen = (trajectory.time >= window.start - 1e-9) & (trajectory.time <= window.end + 1e-9)
    theta, position = trajectory.stack("theta")[seen], trajectory.position[seen]
    half = (positive_number(trajectory, "body_width_m") or 0.0) / 2
    across = half * np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    reach = path.to_the_right(np.concatenate([position + across, position - across]))
    return float(reach.min()), float(reach.max())
