"""World: what surrounds the snake on the floor. Planar, SI, world frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Pose:
    """Where the centre of mass is, and the way ahead.

    Attributes:
        x: m.
        y: m.
        heading: counter-clockwise from x, rad.
    """

    x: float
    y: float
    heading: float

    def __iter__(self) -> Iterator[float]:
        """Yield x, y and heading."""
        return iter((self.x, self.y, self.heading))


@dataclass(frozen=True)
class Circle:
    """A round obstacle.

    Attributes:
        x: of the centre, m.
        y: of the centre, m.
        radius: m.
    """

    x: float
    y: float
    radius: float


@dataclass(frozen=True)
class Polygon:
    """An obstacle with straight sides that do not cross each other; either sense of rotation.

    Attributes:
        corners: (x, y) of each, m, three at least; the last is joined to the first.
    """

    corners: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Bounds:
    """The rectangle that the snake is to stay in.

    Attributes:
        x: lowest and highest, m.
        y: lowest and highest, m.
    """

    x: tuple[float, float]
    y: tuple[float, float]


@dataclass(frozen=True)
class Goal:
    """Where the centre of mass is to arrive.

    Attributes:
        x: m.
        y: m.
        heading: arrival heading, rad; None where any will do.
        radius: how near is near enough, m.
        heading_tolerance: how near the arrival heading is near enough, rad.
    """

    x: float
    y: float
    heading: float | None
    radius: float
    heading_tolerance: float = 0.1


@dataclass(frozen=True)
class Floor:
    """A plane that may slope; x and y are along it, z is off it.

    Attributes:
        tilt: angle of the slope, rad.
        uphill: which way it rises, counter-clockwise from x, rad.
    """

    tilt: float = 0.0
    uphill: float = 0.0

    @property
    def down(self) -> tuple[float, float, float]:
        """Which way things fall, a unit vector; exactly (0, 0, −1) on a level floor."""
        slope = math.sin(self.tilt)
        return 0.0 - slope * math.cos(self.uphill), 0.0 - slope * math.sin(self.uphill), -math.cos(self.tilt)


@dataclass(frozen=True)
class Step:
    """Where the floor rises or falls, along the whole line at x.

    Attributes:
        x: m.
        height: by how much it is higher beyond, m.
    """

    x: float
    height: float


@dataclass(frozen=True)
class World:
    """Floor, obstacles, bounds and goal; all may be absent."""

    obstacles: tuple[Circle, ...] = ()
    bounds: Bounds | None = None
    goal: Goal | None = None
    polygons: tuple[Polygon, ...] = ()
    floor: Floor = Floor()
    steps: tuple[Step, ...] = ()

    @property
    def uneven(self) -> bool:
        """Whether the floor slopes or has steps."""
        return self.floor.tilt != 0.0 or bool(self.steps)

    @property
    def solid(self) -> bool:
        """Whether there is anything to run into."""
        return bool(self.obstacles or self.polygons)
