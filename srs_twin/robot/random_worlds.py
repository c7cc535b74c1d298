"""Worlds with random round obstacles: the 18 sites of the dissertation, and uniformly distributed circles."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.errors import InputError
from srs_twin.robot.world import Bounds, Circle, Goal, Pose, World

PEG_DISTANCE_M = 0.2
"""Default distance of the first pegs ahead of the start at a length unit of 1 (`robot.scale`), m."""

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


def peg_field(
    pitch: float,
    radius: float,
    rows: int,
    columns: int,
    first: tuple[float, float],
    seed: int,
    *,
    jitter: float = 0.0,
    staggered: bool = False,
) -> tuple[Circle, ...]:
    """Return a field of posts on a square grid, symmetric about the line y = first[1], column by column.

    Args:
        pitch: distance between neighbouring rows and columns, m.
        radius: radius of all posts, m.
        rows: number of posts in a column, along y.
        columns: number of columns, along x.
        first: x of the first column, and y of the middle of all columns, m.
        seed: random seed of the displacements.
        jitter: largest displacement of a post along x and along y, uniformly distributed, m.
        staggered: shift every second column by half a pitch, to alternate sides.

    Raises:
        InputError: displaced posts could overlap.
    """
    if not 2 * (radius + jitter) < pitch:
        raise InputError(
            f"pegs of radius {radius:g} m that are displaced by up to {jitter:g} m overlap at a pitch of "
            f"{pitch:g} m; the pitch must be above {2 * (radius + jitter):g} m"
        )
    shifts = np.random.default_rng(seed).uniform(-jitter, jitter, (columns, rows, 2))
    pegs = []
    for i in range(columns):
        stagger = ((i + 1) % 2 - 0.5) / 2 * pitch if staggered else 0.0
        for j in range(rows):
            x, y = first[0] + i * pitch, first[1] + (j - (rows - 1) / 2) * pitch + stagger
            pegs.append(Circle(x + float(shifts[i, j, 0]), y + float(shifts[i, j, 1]), radius))
    return tuple(pegs)


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
