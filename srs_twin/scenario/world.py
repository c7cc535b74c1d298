"""World of a scenario: where the snake lies, what surrounds it, and what is drawn by a seed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator

from srs_twin.errors import InputError
from srs_twin.robot.drawn_worlds import fig54_world, strewn
from srs_twin.robot.world import Bounds, Circle, Floor, Goal, Polygon, Pose, Step, World
from srs_twin.scenario.fields import FilePath, Section, constructor_default, quantity
from srs_twin.scenario.map_file import read_circles, read_map

Metres = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Pair = Annotated[tuple[Metres, ...], Field(min_length=2, max_length=2)]
Radius = Annotated[float, Field(ge=0.001, le=100.0)]


class ObstacleFile(Section):
    """A round obstacle."""

    constructors = (Circle,)

    x_m: float = quantity(-1000.0, 1000.0)
    """x of the centre."""
    y_m: float = quantity(-1000.0, 1000.0)
    """y of the centre."""
    radius_m: float = quantity(0.001, 100.0)
    """Radius."""


class PolygonFile(Section):
    """An obstacle with straight sides."""

    constructors = (Polygon,)

    corners_m: Annotated[tuple[Pair, ...], Field(min_length=3, max_length=1000)]
    """[x, y] of each corner, m; the last is joined to the first, sides do not cross."""

    @field_validator("corners_m")
    @classmethod
    def _simple(cls, corners: tuple[Pair, ...]) -> tuple[Pair, ...]:
        from shapely import Polygon

        if not Polygon(corners).is_valid:
            raise ValueError("these corners do not bound an area: sides cross or fall on each other")
        return corners


class BoundsFile(Section):
    """The rectangle that the snake is to stay in."""

    constructors = (Bounds,)

    x_m: Pair
    """Lowest and highest x, m."""
    y_m: Pair
    """Lowest and highest y, m."""

    @field_validator("x_m", "y_m")
    @classmethod
    def _ordered(cls, ends: Pair) -> Pair:
        if not ends[0] < ends[1]:
            raise ValueError(f"the lowest comes first, but {ends[0]:g} is not below {ends[1]:g}")
        return ends


class GoalFile(Section):
    """Where the centre of mass is to arrive."""

    constructors = (Goal,)

    x_m: float = quantity(-1000.0, 1000.0)
    """x."""
    y_m: float = quantity(-1000.0, 1000.0)
    """y."""
    heading_rad: float | None = quantity(-6.3, 6.3, None)
    """Heading on arrival (default: any)."""
    radius_m: float = quantity(0.001, 100.0, 0.05)
    """How near is near enough."""
    heading_tolerance_rad: float = quantity(0.0, 3.14)
    """How near that heading is near enough."""


class RandomFile(Section):
    """Round obstacles drawn by a seed."""

    constructors = (strewn,)

    kind: Literal["strewn", "fig54"] = "strewn"
    """strewn: uniformly over a rectangle; fig54: of the 18 sites of planning.fields."""
    count: int = quantity(0, 1000)
    """Number of circles."""
    seed: int | None = quantity(0, 2**32 - 1, None)
    """Of the draw (default: the scenario's)."""
    area: BoundsFile | None = None
    """Where their centres lie (strewn; default: the bounds)."""
    radius_m: Annotated[tuple[Radius, ...], Field(min_length=2, max_length=2)] = constructor_default()
    """Smallest and largest radius (strewn), m."""
    gap_m: float = quantity(0.0, 100.0)
    """Least distance between two (strewn)."""
    clear_m: float = quantity(0.0, 100.0, 0.3)
    """No circle is so near to start or goal (strewn)."""

    @field_validator("radius_m")
    @classmethod
    def _ordered(cls, ends: tuple[float, ...]) -> tuple[float, ...]:
        if not ends[0] <= ends[1]:
            raise ValueError(f"the smallest comes first, but {ends[0]:g} is above {ends[1]:g}")
        return ends

    def draw(self, bounds: BoundsFile | None, seed: int, places: list[Pose | Goal]) -> tuple[Circle, ...]:
        """Return the circles.

        Args:
            bounds: where they lie if the section does not say.
            seed: of the draw if the section does not say.
            places: start and goal, which stay clear.

        Raises:
            InputError: they do not fit.
        """
        seed = seed if self.seed is None else self.seed
        if self.kind == "fig54":
            return fig54_world(self.count, seed).obstacles
        area = self.area or bounds
        clear = tuple((each.x, each.y, self.clear_m) for each in places)
        given = self.arguments() | {"seed": seed, "clear": clear}
        return strewn(bounds=area.build(), **given) if area else ()


class FloorFile(Section):
    """What the snake lies on; x and y are along it."""

    constructors = (Floor,)

    tilt_deg: float = quantity(0.0, 60.0)
    """Angle of its slope."""
    uphill_deg: float = quantity(-360.0, 360.0)
    """Which way it rises, counter-clockwise from x."""


class StepFile(Section):
    """Where the floor rises or falls, along the whole line at x."""

    constructors = (Step,)

    x_m: float = quantity(-1000.0, 1000.0)
    """x of the line."""
    height_m: float = quantity(-0.1, 0.1)
    """By how much the floor is higher beyond it."""


class WorldFile(Section):
    """What surrounds the snake."""

    obstacles: Annotated[list[ObstacleFile], Field(max_length=1000)] = []
    """Round obstacles."""
    circles: FilePath | None = None
    """CSV file of more: columns x_m, y_m, radius_m; path from the current folder."""
    map: FilePath | None = None
    """Occupancy map as ROS has it: YAML file with a PGM or PNG picture; path from the current folder."""
    polygons: Annotated[list[PolygonFile], Field(max_length=1000)] = []
    """Obstacles with straight sides."""
    random: RandomFile | None = None
    """More round obstacles, drawn by a seed."""
    floor: FloorFile = FloorFile()
    """The floor's slope."""
    steps: Annotated[list[StepFile], Field(max_length=100)] = []
    """Steps of the floor."""
    bounds: BoundsFile | None = None
    """The rectangle to stay in."""
    goal: GoalFile | None = None
    """Where to arrive."""

    @field_validator("circles", "map")
    @classmethod
    def _readable(cls, path: str | None, info: ValidationInfo) -> str | None:
        try:
            if path is not None:
                (read_map if info.field_name == "map" else read_circles)(Path(path))
        except InputError as error:
            raise ValueError(str(error)) from None
        return path

    def surroundings(self, start: Pose, seed: int) -> World:
        """Return what surrounds a snake that lies at `start`.

        Raises:
            InputError: circles that are to be drawn do not fit, or a file cannot be used.
        """
        goal = self.goal.build() if self.goal else None
        places = [start, goal] if goal else [start]
        drawn = self.random.draw(self.bounds, seed, places) if self.random else ()
        listed = read_circles(Path(self.circles)) if self.circles else ()
        return World(
            obstacles=tuple(each.build() for each in self.obstacles) + listed + drawn,
            bounds=self.bounds.build() if self.bounds else None,
            goal=goal,
            polygons=tuple(each.build() for each in self.polygons)
            + (read_map(Path(self.map)) if self.map else ()),
            floor=self.floor.build(),
            steps=tuple(each.build() for each in self.steps),
        )
