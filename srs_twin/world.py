"""World: what surrounds the snake on the floor. Planar, SI, world frame."""

from __future__ import annotations

from dataclasses import dataclass


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
    """

    x: float
    y: float
    heading: float | None
    radius: float


@dataclass(frozen=True)
class World:
    """Obstacles, bounds and goal; all may be absent."""

    obstacles: tuple[Circle, ...] = ()
    bounds: Bounds | None = None
    goal: Goal | None = None
