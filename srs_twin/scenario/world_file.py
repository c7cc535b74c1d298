"""What a scenario file says of where the snake lies and what surrounds it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from srs_twin.io.validation import Strict
from srs_twin.scenario.fields import quantity, section

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


class PolygonFile(Strict):
    """An obstacle with straight sides."""

    corners_m: Annotated[list[Annotated[list[Metres], Field(min_length=2, max_length=2)]],
                         Field(min_length=3, max_length=1000)] = section(
        "[x, y] of each corner, m; the last is joined to the first, sides do not cross."
    )  # fmt: skip

    @field_validator("corners_m")
    @classmethod
    def _simple(cls, corners: list[list[float]]) -> list[list[float]]:
        from shapely import Polygon

        if not Polygon(corners).is_valid:
            raise ValueError("these corners do not bound an area: sides cross or fall on each other")
        return corners


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
    heading_tolerance_rad: float = quantity("How near that heading is near enough", "rad", 0.0, 3.14, 0.1)


class RandomFile(Strict):
    """Round obstacles drawn by a seed."""

    kind: Literal["strewn", "fig54"] = section(
        "strewn: uniformly over a rectangle; fig54: of the 18 sites of planning.fields.", "strewn"
    )
    count: int = quantity("Number of circles", "", 0, 1000)
    seed: int | None = quantity("Of the draw (default: the scenario's)", "", 0, 2**32 - 1, None)
    area: BoundsFile | None = section("Where their centres lie (strewn; default: the bounds).", None)
    radius_m: Annotated[list[Annotated[float, Field(ge=0.001, le=100.0)]],
                        Field(min_length=2, max_length=2)] = section(
        "Smallest and largest radius (strewn), m.", [0.05, 0.15]
    )  # fmt: skip
    gap_m: float = quantity("Least distance between two (strewn)", "m", 0.0, 100.0, 0.0)
    clear_m: float = quantity("No circle is so near to start or goal (strewn)", "m", 0.0, 100.0, 0.3)

    @field_validator("radius_m")
    @classmethod
    def _ordered(cls, ends: list[float]) -> list[float]:
        if not ends[0] <= ends[1]:
            raise ValueError(f"the smallest comes first, but {ends[0]:g} is above {ends[1]:g}")
        return ends


class WorldFile(Strict):
    """What surrounds the snake."""

    obstacles: Annotated[list[ObstacleFile], Field(max_length=1000)] = section("Round obstacles.", [])
    polygons: Annotated[list[PolygonFile], Field(max_length=1000)] = section(
        "Obstacles with straight sides.", []
    )
    random: RandomFile | None = section("More round obstacles, drawn by a seed.", None)
    bounds: BoundsFile | None = section("The rectangle to stay in.", None)
    goal: GoalFile | None = section("Where to arrive.", None)
