"""What a scenario file says of where the snake lies and what surrounds it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from srs_twin.scenario.fields import quantity, section
from srs_twin.validation import Strict

Metres = Annotated[float, Field(ge=-1000.0, le=1000.0)]


class StartFile(Strict):
    """Where the snake lies at first, straight and at rest."""

    x_m: float = quantity("x of the centre of mass", "m", -1000.0, 1000.0, 0.0)
    y_m: float = quantity("y of the centre of mass", "m", -1000.0, 1000.0, 0.0)
    heading_rad: float = quantity("Mean heading, counter-clockwise from x", "rad", -6.3, 6.3, 0.0)


class ObstacleFile(Strict):
    """A round obstacle."""

    x_m: float = quantity("x of the centre", "m", -1000.0, 1000.0)
    y_m: float = quantity("y of the centre", "m", -1000.0, 1000.0)
    radius_m: float = quantity("Radius", "m", 0.001, 100.0)


class BoundsFile(Strict):
    """The rectangle that the snake is to stay in."""

    x_m: Annotated[list[Metres], Field(min_length=2, max_length=2)] = section("Lowest and highest x, m.")
    y_m: Annotated[list[Metres], Field(min_length=2, max_length=2)] = section("Lowest and highest y, m.")

    @field_validator("x_m", "y_m")
    @classmethod
    def _ordered(cls, ends: list[float]) -> list[float]:
        if not ends[0] < ends[1]:
            raise ValueError(f"the lowest comes first, but {ends[0]:g} is not below {ends[1]:g}")
        return ends


class GoalFile(Strict):
    """Where the centre of mass is to arrive."""

    x_m: float = quantity("x", "m", -1000.0, 1000.0)
    y_m: float = quantity("y", "m", -1000.0, 1000.0)
    heading_rad: float | None = quantity("Heading on arrival (default: any)", "rad", -6.3, 6.3, None)
    radius_m: float = quantity("How near is near enough", "m", 0.001, 100.0, 0.05)


class WorldFile(Strict):
    """What surrounds the snake."""

    obstacles: Annotated[list[ObstacleFile], Field(max_length=1000)] = section("Round obstacles.", [])
    bounds: BoundsFile | None = section("The rectangle to stay in.", None)
    goal: GoalFile | None = section("Where to arrive.", None)
