"""World around the snake: floor, obstacles, objects, bounds and goal, in SI units and the world frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

OBSTACLE_FRICTION = 0.5
"""Default friction coefficient of silicone on a smooth obstacle, 1. Estimate; the dissertation gives none."""

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
        """Yield x, y and heading."""
        return iter((self.x, self.y, self.heading))


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
        corners: (x, y) of three or more corners, m, in either sense of rotation; the polygon is closed.
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
        return 0.0 - slope * math.cos(self.uphill), 0.0 - slope * math.sin(self.uphill), -math.cos(self.tilt)


@dataclass(frozen=True)
class Step:
    """Step of the floor along a line of constant x.

    Attributes:
        x: position of the step, m.
        height: height of the floor beyond x relative to the floor before it, m; negative for a step down.
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
        heading: initial direction of the length of a box, counter-clockwise from x, rad.
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
        return math.hypot(*self.size) / math.sqrt(12) if self.is_box else self.size[0] / math.sqrt(2)

    @property
    def supports(self) -> tuple[tuple[float, float], ...]:
        """Places of the four points that carry equal loads, in the frame of the object, m.

        For a box they are those of a Gauss rule, with the second moments of a uniform pressure. For a
        cylinder they are at two thirds of the radius, so that friction resists a pure spin with the moment of
        a uniform pressure, 2/3 μ m g R. For a square this moment is 7 % too large.
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
