"""Worlds with random round obstacles: the 18 sites of the dissertation, and uniformly distributed circles."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.errors import InputError
from srs_twin.robot.world import Bounds, Circle, Goal, Pose, World

FIG54_START = Pose(0.0, 0.0, math.pi / 4)
"""Start of Section 5.2.1 in the world of Fig. 54."""

FIG54_GOAL = Goal(2.0, 1.0, math.pi / 4, radius=0.02, heading_tolerance=0.05)
"""Goal of Section 5.2.1; the printed heading −3/4 π is that of the tree that starts at the goal."""

FIG54_BOUNDS = Bounds((-0.3, 2.3), (-0.3, 1.3))
"""Border in the definition of the h score; its position in the lost figure is our assumption."""

FIG54_SITES = tuple(
    Circle(0.4 + 0.3 * column, 0.5 + 0.4 * (row - 1) + 0.1 * (1 if column % 2 else -1), 0.1)
    for column in range(5)
    for row in range(3)
) + tuple(Circle(x, y, 0.1) for x, y in ((0.1, 0.6), (1.9, 0.4), (1.85, 0.05)))
"""18 sites of circles with a diameter of 200 mm between start and goal; assumed, as Fig. 54 is lost."""

_MAX_TRIES = 200
"""Largest mean number of tries per circle; with more, the circles count as not fitting."""


def fig54_world(count: int, seed: int) -> World:
    """Return a world with random circles at some of the 18 sites of Fig. 54.

    Args:
        count: number of circles, 0 to 18.
        seed: random seed; each pair of count and seed gives an independent draw.

    Raises:
        InputError: the count is not 0 to 18.
    """
    if not 0 <= count <= len(FIG54_SITES):
        raise InputError(f"{count} obstacles cannot be drawn from {len(FIG54_SITES)} sites")
    drawn = np.random.default_rng((seed, count)).choice(len(FIG54_SITES), count, replace=False)
    return World(tuple(FIG54_SITES[i] for i in sorted(drawn)), FIG54_BOUNDS, FIG54_GOAL)


def random_circles(
    count: int,
    bounds: Bounds,
    seed: int,
    *,
    radius: tuple[float, float] = (0.05, 0.15),
    gap: float = 0.0,
    clear: tuple[tuple[float, float, float], ...] = (),
) -> tuple[Circle, ...]:
    """Return circles with uniformly distributed centres in a rectangle and uniformly distributed radii.

    Args:
        count: number of circles.
        bounds: rectangle of the centres.
        seed: random seed.
        radius: smallest and largest radius, m.
        gap: smallest distance between the edges of two circles, m; a negative gap allows an overlap.
        clear: discs (x, y, radius) that no circle may touch, such as start and goal.

    Raises:
        InputError: the circles do not fit.
    """
    rng = np.random.default_rng(seed)
    circles: list[Circle] = []
    for _ in range(count * _MAX_TRIES):
        if len(circles) == count:
            break
        x, y, r = rng.uniform(*bounds.x), rng.uniform(*bounds.y), rng.uniform(*radius)
        separate = all(math.hypot(x - c.x, y - c.y) >= r + c.radius + gap for c in circles)
        if separate and all(math.hypot(x - cx, y - cy) >= r + cr for cx, cy, cr in clear):
            circles.append(Circle(x, y, r))
    if len(circles) < count:
        raise InputError(
            f"{count} circles do not fit with gaps of {gap:g} m: {len(circles)} did; take fewer or smaller"
        )
    return tuple(circles)
