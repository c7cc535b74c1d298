"""Fields of round obstacles to plan in: the text's 18 sites, and circles strewn at random."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.errors import InputError
from srs_twin.robot.world import Bounds, Circle, Goal, Pose, World

FIG54_START = Pose(0.0, 0.0, math.pi / 4)
"""Section 5.2.1's start in the field of Fig. 54."""

FIG54_GOAL = Goal(2.0, 1.0, math.pi / 4, radius=0.02, heading_tolerance=0.05)
"""Its target: the text writes -3/4 pi, which is the heading of the tree that grows back from there."""

FIG54_BOUNDS = Bounds((-0.3, 2.3), (-0.3, 1.3))
"""The border that the h score speaks of; its place is in the lost figure, so it is ours."""

FIG54_SITES = tuple(
    Circle(0.4 + 0.3 * column, 0.5 + 0.4 * (row - 1) + 0.1 * (1 if column % 2 else -1), 0.1)
    for column in range(5)
    for row in range(3)
) + tuple(Circle(x, y, 0.1) for x, y in ((0.1, 0.6), (1.9, 0.4), (1.85, 0.05)))
"""18 sites of circles of 200 mm diameter between start and target; ours, for Fig. 54's are lost."""

_TRIES = 200


def fig54_world(count: int, seed: int) -> World:
    """Draw some of Fig. 54's 18 sites.

    Args:
        count: how many circles, 0 to 18.
        seed: of the draw; every pair of count and seed is a draw of its own.

    Raises:
        InputError: no such count.
    """
    if not 0 <= count <= len(FIG54_SITES):
        raise InputError(f"{count} obstacles cannot be drawn from {len(FIG54_SITES)} sites")
    drawn = np.random.default_rng((seed, count)).choice(len(FIG54_SITES), count, replace=False)
    return World(tuple(FIG54_SITES[i] for i in sorted(drawn)), FIG54_BOUNDS, FIG54_GOAL)


def strewn(
    count: int,
    bounds: Bounds,
    seed: int,
    *,
    radius: tuple[float, float] = (0.05, 0.15),
    gap: float = 0.0,
    clear: tuple[tuple[float, float, float], ...] = (),
) -> tuple[Circle, ...]:
    """Strew circles uniformly over a rectangle, their centres inside it.

    Args:
        count: how many.
        bounds: the rectangle.
        seed: same seed, same circles.
        radius: smallest and largest, uniform, m.
        gap: least distance between the edges of two circles, m; below 0 they may overlap by that much.
        clear: discs (x, y, radius) that no circle touches, such as start and goal.

    Raises:
        InputError: they do not fit (each circle is tried 200 times).
    """
    rng = np.random.default_rng(seed)
    kept: list[Circle] = []
    for _ in range(count * _TRIES):
        if len(kept) == count:
            break
        x, y, r = rng.uniform(*bounds.x), rng.uniform(*bounds.y), rng.uniform(*radius)
        apart = all(math.hypot(x - k.x, y - k.y) >= r + k.radius + gap for k in kept)
        if apart and all(math.hypot(x - cx, y - cy) >= r + cr for cx, cy, cr in clear):
            kept.append(Circle(x, y, r))
    if len(kept) < count:
        raise InputError(
            f"{count} circles do not fit with gaps of {gap:g} m: {len(kept)} did; take fewer or smaller"
        )
    return tuple(kept)
