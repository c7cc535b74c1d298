"""World around the snake, with floor, obstacles, movable objects, bounds and goal.

All quantities are in SI units and in the world frame. The functions generate peg
fields, uniformly distributed circles, and circles at the 18 sites of Fig. 54.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError

OBSTACLE_FRICTION = 0.5
"""Default friction coefficient of silicone on a smooth obstacle, estimated because the
dissertation states no value."""

WALL_M = 0.001
"""Corner radius of a polygonal obstacle, which extends beyond its polygon by this
distance, m."""


@dataclass(frozen=True)
class Pose:
    """Pose of the snake.

    Attributes:
        x: x coordinate of the centre of mass, m.
        y: y coordinate of the centre of mass, m.
        heading: mean heading, counter-clockwise from the x axis, rad.
    """

    x: float
    y: float
    heading: float

    def __iter__(self) -> Iterator[float]:
        """Yield x, y and heading as floats, as compiled kernels require."""
        return iter((float(self.x), float(self.y), float(self.heading)))


@dataclass(frozen=True)
class Circle:
    """Round obstacle.

    Attributes:
        x: x coordinate of the centre, m.
        y: y coordinate of the centre, m.
        radius: radius of the obstacle, m.
    """

    x: float
    y: float
    radius: float


@dataclass(frozen=True)
class Polygon:
    """Polygonal obstacle, whose sides do not cross each other.

    Attributes:
        corners: (x, y) coordinates of at least three corners, clockwise or
            counter-clockwise, m.
    """

    corners: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Bounds:
    """Rectangle that the snake should not leave.

    Attributes:
        x: minimum and maximum x coordinate, m.
        y: minimum and maximum y coordinate, m.
    """

    x: tuple[float, float]
    y: tuple[float, float]


@dataclass(frozen=True)
class Goal:
    """Goal for the snake's centre of mass, with an optional heading.

    Attributes:
        x: x coordinate of the goal, m.
        y: y coordinate of the goal, m.
        heading: required heading at the goal, rad, or None for any heading.
        radius: maximum distance of the centre of mass from the goal, m.
        heading_tolerance: maximum deviation from the required heading, rad.
    """

    x: float
    y: float
    heading: float | None
    radius: float
    heading_tolerance: float = 0.1


@dataclass(frozen=True)
class Floor:
    """Flat floor with an optional slope.

    The x and y axes lie in the plane of the floor, and the z axis is normal to it.

    Attributes:
        tilt: slope angle, rad.
        uphill: direction in which the floor rises, counter-clockwise from the x axis,
            rad.
    """

    tilt: float = 0.0
    uphill: float = 0.0

    @property
    def down(self) -> tuple[float, float, float]:
        """Unit vector along gravity, exactly (0, 0, −1) on a level floor."""
        slope = math.sin(self.tilt)
        return (
            0.0 - slope * math.cos(self.uphill),
            0.0 - slope * math.sin(self.uphill),
            -math.cos(self.tilt),
        )


@dataclass(frozen=True)
class FloorStep:
    """Step of the floor along a line of constant x.

    Attributes:
        x: x coordinate of the step, m.
        height: height of the floor at larger x relative to the floor at smaller x, m.
    """

    x: float
    height: float


@dataclass(frozen=True)
class MovableObject:
    """Cylinder or box that stands on the floor and slides on it.

    Attributes:
        size: radius of a cylinder, or length and width of a box, m.
        mass: mass of the object, kg.
        friction: friction coefficient between the object and the floor.
        x: initial x coordinate of the centre, m.
        y: initial y coordinate of the centre, m.
        heading: initial direction of the length axis of a box, counter-clockwise from
            the x axis, rad.
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
        """Radius of gyration about the vertical axis for uniform density, m."""
        if self.is_box:
            return math.hypot(*self.size) / math.sqrt(12)
        return self.size[0] / math.sqrt(2)

    @property
    def supports(self) -> tuple[tuple[float, float], ...]:
        """Positions of four points that carry equal loads, in the object's frame, m.

        For a box, the points are the Gauss points, which have the same second moments
        as a uniform pressure. For a cylinder, the points lie at two thirds of the
        radius, so that the friction moment in a pure spin is 2/3 μ m g R, as for a
        uniform pressure. For a square box, the friction moment in a pure spin is 7 %
        too large.
        """
        reach = 1 / math.sqrt(12) if self.is_box else math.sqrt(2) / 3
        a, b = (reach * side for side in (self.size if self.is_box else self.size * 2))
        return (a, b), (-a, b), (-a, -b), (a, -b)


@dataclass(frozen=True)
class World:
    """Floor, obstacles, movable objects, bounds and goal.

    Attributes:
        obstacles: round obstacles.
        bounds: rectangle that the snake should not leave, or None.
        goal: goal of the planner, or None.
        polygons: polygonal obstacles.
        floor: slope of the floor.
        steps: steps of the floor.
        objects: movable objects, which only the twin supports.
        friction: Coulomb friction coefficient between the body and obstacles.
    """

    obstacles: tuple[Circle, ...] = ()
    bounds: Bounds | None = None
    goal: Goal | None = None
    polygons: tuple[Polygon, ...] = ()
    floor: Floor = Floor()
    steps: tuple[FloorStep, ...] = ()
    objects: tuple[MovableObject, ...] = ()
    friction: float = OBSTACLE_FRICTION

    @property
    def uneven(self) -> bool:
        """Whether the floor has a slope or steps."""
        return self.floor.tilt != 0.0 or bool(self.steps)

    @property
    def has_obstacles(self) -> bool:
        """Whether the world has obstacles."""
        return bool(self.obstacles or self.polygons)

    @property
    def is_solid(self) -> bool:
        """Whether the world has obstacles or movable objects."""
        return self.has_obstacles or bool(self.objects)


PEG_DISTANCE_M = 0.2
"""Default distance from the start to the first pegs, m, for a robot with a length unit
of 1."""

FIG54_START = Pose(0.0, 0.0, math.pi / 4)
"""Initial pose in the world of Fig. 54, from Section 5.2.1."""

FIG54_GOAL = Goal(2.0, 1.0, math.pi / 4, radius=0.02, heading_tolerance=0.05)
"""Goal of Section 5.2.1. The heading −3/4 π printed in the dissertation belongs to the
search tree that starts at the goal."""

FIG54_BOUNDS = Bounds((-0.3, 2.3), (-0.3, 1.3))
"""Bounds of the world of Fig. 54, which are assumed, because the figure is lost."""

FIG54_SITES = tuple(
    Circle(
        0.4 + 0.3 * column, 0.5 + 0.4 * (row - 1) + 0.1 * (1 if column % 2 else -1), 0.1
    )
    for column in range(5)
    for row in range(3)
) + tuple(Circle(x, y, 0.1) for x, y in ((0.1, 0.6), (1.9, 0.4), (1.85, 0.05)))
"""Circles with a diameter of 200 mm at 18 sites between start and goal. The sites are
assumed, because Fig. 54 is lost."""

_MAX_TRIES = 200
"""Maximum number of tries per requested circle, averaged over all circles."""


def fig54_world(count: int, seed: int) -> World:
    """Return a world with circles at randomly chosen sites of Fig. 54.

    Args:
        count: number of circles, 0 to 18.
        seed: random seed. Worlds with different seeds or counts are independent.

    Raises:
        InputError: the count is not between 0 and 18.
    """
    if not 0 <= count <= len(FIG54_SITES):
        raise InputError(
            f"{count} obstacles do not fit; Fig. 54 has only {len(FIG54_SITES)} sites"
        )
    drawn = np.random.default_rng((seed, count)).choice(
        len(FIG54_SITES), count, replace=False
    )
    return World(tuple(FIG54_SITES[i] for i in sorted(drawn)), FIG54_BOUNDS, FIG54_GOAL)


def peg_field(
    spacing: float,
    radius: float,
    rows: int,
    columns: int,
    first: tuple[float, float],
    seed: int,
    *,
    jitter: float = 0.0,
    staggered: bool = False,
) -> tuple[Circle, ...]:
    """Return pegs on a square grid that is centred on the line y = first[1].

    Args:
        spacing: distance between neighbouring rows and columns, m.
        radius: radius of all pegs, m.
        rows: number of pegs in a column, along y.
        columns: number of columns, along x.
        first: x coordinate of the first column and y coordinate of the grid's centre,
            m.
        seed: random seed of the displacements.
        jitter: maximum displacement of a peg along each axis, m. Displacements are
            uniformly distributed.
        staggered: whether every second column is shifted by half the spacing.

    Raises:
        InputError: displaced pegs could overlap.
    """
    if not 2 * (radius + jitter) < spacing:
        raise InputError(
            f"pegs of radius {radius:g} m that are displaced by up to {jitter:g} m may"
            f" overlap at a spacing of {spacing:g} m; the spacing must be above"
            f" {2 * (radius + jitter):g} m"
        )
    shifts = np.random.default_rng(seed).uniform(-jitter, jitter, (columns, rows, 2))
    pegs = []
    for i in range(columns):
        stagger = ((i + 1) % 2 - 0.5) / 2 * spacing if staggered else 0.0
        for j in range(rows):
            x = first[0] + i * spacing
            y = first[1] + (j - (rows - 1) / 2) * spacing + stagger
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
    """Return circles with uniformly distributed centres and radii.

    Args:
        count: number of circles.
        bounds: rectangle that contains the centres of the circles.
        seed: random seed.
        radius: minimum and maximum radius, m.
        gap: minimum distance between the edges of two circles, m. If the gap is
            negative, circles may overlap.
        clear: circular areas (x, y, radius) that no circle may overlap, m.

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
