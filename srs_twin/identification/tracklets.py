r"""Tracklets: stretches of one slot in which nothing but one marker can have been seen.

From one sample of a slot to its next a marker is expected at

$$ \hat p_k = p_a + (k - a)(p_a - p_{a-1}), $$

and the link is sure where the sample lies nearer to it than the gate, and twice as near as any other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

GATE = 0.4
"""Of the distance of the two closest markers: how far from its expected place a marker surely is itself."""

_SAMPLED = 500  # frames


@dataclass(frozen=True)
class Tracklet:
    """One stretch of one slot.

    Attributes:
        slot: which.
        frames: where it was seen, ascending, shape (samples,).
    """

    slot: int
    frames: np.ndarray

    @property
    def start(self) -> int:
        """First frame."""
        return int(self.frames[0])

    @property
    def end(self) -> int:
        """Last frame."""
        return int(self.frames[-1])


def closest(points: np.ndarray) -> float:
    """Return how near two markers come, but for a few frames, m; infinite where there is one."""
    some = points[:: len(points) // _SAMPLED + 1]
    apart = np.linalg.norm(some[:, :, None] - some[:, None], axis=-1)
    apart[:, np.arange(apart.shape[1]), np.arange(apart.shape[1])] = np.nan
    apart = np.where(np.isnan(apart), np.inf, apart)
    nearest = apart.min(axis=(1, 2))
    nearest = nearest[np.isfinite(nearest)]
    return float(np.quantile(nearest, 0.05)) if nearest.size else np.inf


def tracklets(points: np.ndarray, gate: float, longest: int) -> list[Tracklet]:
    """Cut slots where a marker may have become another.

    Args:
        points: shape (frames, slots, 2), m.
        gate: m.
        longest: frames over which a link may go.

    Returns:
        In the order of their first frames.
    """
    found: list[Tracklet] = []
    for slot in range(points.shape[1]):
        seen = np.flatnonzero(~np.isnan(points[:, slot, 0]))
        breaks = np.flatnonzero(~_sure(points, slot, seen, gate, longest)) + 1
        found += [Tracklet(slot, part) for part in np.split(seen, breaks) if part.size]
    return sorted(found, key=lambda each: (each.start, each.slot))


def _sure(points: np.ndarray, slot: int, seen: np.ndarray, gate: float, longest: int) -> np.ndarray:
    """Say of each step from one sample to the next whether it is sure, shape (samples − 1,)."""
    own = points[:, slot]
    before, after = seen[:-1], seen[1:]
    step = after - before
    velocity = np.zeros((len(before), 2))
    running = np.flatnonzero(step[:-1] == 1) + 1
    velocity[running] = own[before[running]] - own[before[running] - 1]
    # A jump is no velocity: what follows it would be expected far away.
    velocity[np.hypot(*velocity.T) > 2 * gate] = 0.0
    # Farther than a few frames nothing goes on as it did.
    expected = own[before] + velocity * np.minimum(step, 3)[:, None]
    away = np.hypot(*(own[after] - expected).T)
    nearest = np.full(len(before), np.inf)
    for other in range(points.shape[1]):
        if other != slot:
            distance = np.hypot(*(points[after, other] - expected).T)
            np.fmin(nearest, distance, out=nearest)
    return np.asarray((away < gate) & (2 * away < nearest) & (step <= longest))
