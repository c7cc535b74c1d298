"""World around the snake: floor, obstacles, objects, bounds and goal, in SI units and the world frame.

Random obstacles are posts in rows, uniformly distributed circles, and the 18 sites of
the dissertation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError

OBSTACLE_FRICTION = 0.5
"""Default friction coefficient of silicone on a smooth obstacle, 1.

Estimate; the dissertation gives none.
"""

WALL_M = 0.001
"""Rounding radius of the sides of a polygon, m; the solid polygon extends this far beyond its corners."""


@dataclass(frozen=True)
class Pose:
    """Pose of the snake: position of the centre of mass and heading.

    Attributes:
        x: position, m.
        y: position, m.
        heading: angle from the x axis, counter-clockwise, rad.
    """

    x: float
    y: float
    heading: float

    def __iter__(self) -> Iterator[float]:
        """Yield x, y and heading as floats: integers would have kernels compiled once more."""
        return iter((float(self.x), float(self.y), float(self.heading)))


@dataclass(frozen=True)
class Circle:
    """Round obstacle.

    Attributes:
        x: centre, m.
        y: centre, m.
        radius: radius, m.
    """

    x: float
    y: float
    radius: float


@dataclass(frozen=True)
class Polygon:
    """Obstacle with straight sides that do not cross each other.

    Attributes:
        corners: (x, y) of three or more corners, m, in either sense of rotation; the
            polygon is closed.
    """

    corners: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Bounds:
    """Rectangle that the snake should not leave.

    Attributes:
        x: minimum and maximum, m.
        y: minimum and maximum, m.
    """

    x: tuple[float, float]
    y: tuple[float, float]


@dataclass(frozen=True)
class Goal:
    """Goal of the centre of mass.

    Attributes:
        x: position, m.
        y: position, m.
        heading: heading at the goal, rad; None for any heading.
        radius: largest distance from the goal position, m.
        heading_tolerance: largest deviation from the heading, rad.
    """

    x: float
    y: float
    heading: float | None
    radius: float
    heading_tolerance: float = 0.1


@dataclass(frozen=True)
class Floor:
    """Plane floor with an optional slope; x and y are in the plane, z is normal to it.

    Attributes:
        tilt: angle of the slope, rad.
        uphill: direction in which the floor rises, counter-clockwise from x, rad.
    """

    tilt: float = 0.0
    uphill: float = 0.0

    @property
    def down(self) -> tuple[float, float, float]:
        """Unit vector of gravity; exactly (0, 0, −1) on a level floor."""
        slope = math.sin(self.tilt)
        return (
            0.0 - slope * math.cos(self.uphill),
            0.0 - slope * math.sin(self.uphill),
            -math.cos(self.tilt),
        )


@dataclass(frozen=True)
class Step:
    """Step of the floor along a line of constant x.

    Attributes:
        x: position of the step, m.
        height: height of the floor beyond x relative to the floor before it, m;
            negative for a step down.
    """

    x: float
    height: float


@dataclass(frozen=True)
class MovableObject:
    """Cylinder or box that stands on the floor and slides on it.

    Attributes:
        size: radius of a cylinder, or length and width of a box, m.
        mass: kg.
        friction: friction coefficient between object and floor, 1.
        x: initial position of the centre, m.
        y: initial position of the centre, m.
        heading: initial direction of the length of a box, counter-clockwise from x,
            rad.
    """

    size: tuple[float, ...]
    mass: float
    friction: float
    x: float
    y: float
    heading: float = 0.0

    @property
    def is_box(self) -> bool:
        """Whether the object is a box."""
        return len(self.size) == 2

    @property
    def gyration(self) -> float:
        """Radius of gyration about the vertical axis of a uniform body, m."""
        if self.is_box:
            return math.hypot(*self.size) / math.sqrt(12)
        return self.size[0] / math.sqrt(2)

    @property
    def supports(self) -> tuple[tuple[float, float], ...]:
        """Places of the four points that carry equal loads, in the frame of the object, m.

        For a box they are those of a Gauss rule, with the second moments of a uniform
        pressure. For a cylinder they are at two thirds of the radius, so that friction
        resists a pure spin with the moment of a uniform pressure, 2/3 μ m g R. For a
        square this moment is 7 % too large.
        """
        reach = 1 / math.sqrt(12) if self.is_box else math.sqrt(2) / 3
        a, b = (reach * side for side in (self.size if self.is_box else self.size * 2))
        return (a, b), (-a, b), (-a, -b), (a, -b)


@dataclass(frozen=True)
class World:
    """Floor, obstacles, objects, bounds and goal, all optional.

    Attributes:
        obstacles: round obstacles.
        bounds: allowed area, or None.
        goal: goal of the planner, or None.
        polygons: obstacles with straight sides.
        floor: slope of the floor.
        steps: steps of the floor.
        objects: movable objects; on the twin only.
        friction: coefficient of Coulomb friction between the body and obstacles, 1.
    """

    obstacles: tuple[Circle, ...] = ()
    bounds: Bounds | None = None
    goal: Goal | None = None
    polygons: tuple[Polygon, ...] = ()
    floor: Floor = Floor()
    steps: tuple[Step, ...] = ()
    objects: tuple[MovableObject, ...] = ()
    friction: float = OBSTACLE_FRICTION

    @property
    def uneven(self) -> bool:
        """Whether the floor slopes or has steps."""
        return self.floor.tilt != 0.0 or bool(self.steps)

    @property
    def has_obstacles(self) -> bool:
        """Whether there are obstacles."""
        return bool(self.obstacles or self.polygons)

    @property
    def is_solid(self) -> bool:
        """Whether there are obstacles or objects that the body can touch."""
        return self.has_obstacles or bool(self.objects)


PEG_DISTANCE_M = 0.2
"""Default distance of the first pegs ahead of the start at a length unit of 1 (`robot.scale`), m."""

FIG54_START = Pose(0.0, 0.0, math.pi / 4)
"""Start of Section 5.2.1 in the world of Fig. 54."""

FIG54_GOAL = Goal(2.0, 1.0, math.pi / 4, radius=0.02, heading_tolerance=0.05)
"""Goal of Section 5.2.1; the printed heading −3/4 π is that of the tree that starts at the goal."""

FIG54_BOUNDS = Bounds((-0.3, 2.3), (-0.3, 1.3))
"""Border in the definition of the h score; its position in the lost figure is our assumption."""

FIG54_SITES = tuple(
    Circle(
        0.4 + 0.3 * column, 0.5 + 0.4 * (row - 1) + 0.1 * (1 if column % 2 else -1), 0.1
    )
    for column in range(5)
    for row in range(3)
) + tuple(Circle(x, y, 0.1) for x, y in ((0.1, 0.6), (1.9, 0.4), (1.85, 0.05)))
"""18 sites of circles with a diameter of 200 mm between start and goal; assumed, as Fig. 54 is lost."""

_MAX_TRIES = 200
"""Largest mean number of tries per circle; with more, the circles count as not fitting.
"""


def fig54_world(count: int, seed: int) -> World:
    """Return a world with random circles at some of the 18 sites of Fig. 54.

    Args:
        count: number of circles, 0 to 18.
        seed: random seed; each pair of count and seed gives an independent draw.

    Raises:
        InputError: the count is not 0 to 18.
    """
    if not 0 <= count <= len(FIG54_SITES):
        raise InputError(
            f"{count} obstacles cannot be drawn from {len(FIG54_SITES)} sites"
        )
    drawn = np.random.default_rng((seed, count)).choice(
        len(FIG54_SITES), count, replace=False
    )
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
        jitter: largest displacement of a post along x and along y, uniformly
            distributed, m.
        staggered: shift every second column by half a pitch, to alternate sides.

    Raises:
        InputError: displaced posts could overlap.
    """
    if not 2 * (radius + jitter) < pitch:
        raise InputError(
            f"pegs of radius {radius:g} m that are displaced by up to {jitter:g} m"
            f" overlap at a pitch of {pitch:g} m; the pitch must be above"
            f" {2 * (radius + jitter):g} m"
        )
    shifts = np.random.default_rng(seed).uniform(-jitter, jitter, (columns, rows, 2))
    pegs = []
    for i in range(columns):
        stagger = ((i + 1) % 2 - 0.5) / 2 * pitch if staggered else 0.0
        for j in range(rows):
            x = first[0] + i * pitch
            y = first[1] + (j - (rows - 1) / 2) * pitch + stagger
            pegs.append(
                Circle(x + float(shifts[i, j, 0]), y + float(shifts[i, j, 1]), radius)
            )
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
        gap: smallest distance between the edges of two circles, m; a negative gap
            allows an overlap.
        clear: discs (x, y, radius) that no circle may touch, such as start and goal.

    Raises:
        InputError: the circles do not fit.
    """
    rng = np.random.default_rng(seed)
    circles: list[Circle] = []
    for _ in range(count * _MAX_TRIES):
        if len(circles) == count:
            break
        x = rng.uniform(*bounds.x)
        y = rng.uniform(*bounds.y)
        r = rng.uniform(*radius)
        separate = all(
            math.hypot(x - c.x, y - c.y) >= r + c.radius + gap for c in circles
        )
        if separate and all(
            math.hypot(x - cx, y - cy) >= r + cr for cx, cy, cr in clear
        ):
            circles.append(Circle(x, y, r))
    if len(circles) < count:
        raise InputError(
            f"only {len(circles)} of {count} circles fit with gaps of {gap:g} m; use"
            " fewer or smaller circles"
        )
    return tuple(circles)
