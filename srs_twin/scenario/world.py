"""Section `world` of a scenario: floor, obstacles, objects, bounds and goal."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from srs_twin.errors import InputError
from srs_twin.robot.scale import Scale
from srs_twin.robot.world import (
    OBSTACLE_FRICTION,
    PEG_DISTANCE_M,
    Bounds,
    Circle,
    Floor,
    FloorStep,
    Goal,
    MovableObject,
    Polygon,
    Pose,
    World,
    fig54_world,
    peg_field,
    random_circles,
)
from srs_twin.scenario.fields import FilePath, Section, constructor_default, quantity
from srs_twin.scenario.map_file import read_circles, read_map

Metres = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Pair = Annotated[tuple[Metres, ...], Field(min_length=2, max_length=2)]
MAX_PEGS = 1000

Radius = Annotated[float, Field(ge=0.001, le=100.0)]


class ObstacleFile(Section):
    """Round obstacle."""

    constructors = (Circle,)

    x_m: float = quantity(-1000.0, 1000.0)
    """x coordinate of the centre."""
    y_m: float = quantity(-1000.0, 1000.0)
    """y coordinate of the centre."""
    radius_m: float = quantity(1e-5, 100.0)
    """Radius."""


class PolygonFile(Section):
    """Polygonal obstacle."""

    constructors = (Polygon,)

    corners_m: Annotated[tuple[Pair, ...], Field(min_length=3, max_length=1000)]
    """Coordinates [x, y] of each corner, m; a side joins the last corner to the first,
    and sides must not cross."""

    @field_validator("corners_m")
    @classmethod
    def _simple(cls, corners: tuple[Pair, ...]) -> tuple[Pair, ...]:
        from shapely import Polygon

        if not Polygon(corners).is_valid:
            raise ValueError(
                "the polygon has crossing or overlapping sides, or encloses no area;"
                " change the corners"
            )
        return corners


class BoundsFile(Section):
    """Rectangle in which the snake must stay."""

    constructors = (Bounds,)

    x_m: Pair
    """Minimum and maximum x, m."""
    y_m: Pair
    """Minimum and maximum y, m."""

    @field_validator("x_m", "y_m")
    @classmethod
    def _ordered(cls, ends: Pair) -> Pair:
        if not ends[0] < ends[1]:
            raise ValueError(
                f"the range is not ascending; the minimum {ends[0]:g} must be below"
                f" the maximum {ends[1]:g}"
            )
        return ends


class GoalFile(Section):
    """Goal for the centre of mass."""

    constructors = (Goal,)

    x_m: float = quantity(-1000.0, 1000.0)
    """x coordinate of the goal."""
    y_m: float = quantity(-1000.0, 1000.0)
    """y coordinate of the goal."""
    heading_rad: float | None = quantity(-6.3, 6.3, None)
    """Required heading on arrival (default: any heading)."""
    radius_m: float = quantity(1e-5, 100.0, 0.05)
    """Position tolerance (default: 0.05 times the robot's length unit)."""
    heading_tolerance_rad: float = quantity(0.0, 3.14)
    """Heading tolerance."""


class RandomFile(Section):
    """Randomly placed round obstacles."""

    constructors = (random_circles,)

    kind: Literal["strewn", "fig54"] = "strewn"
    """Distribution of the obstacles; "strewn" is uniform over a rectangle, and "fig54"
    selects some of the 18 sites in Fig. 54."""
    count: int = quantity(0, 1000)
    """Number of circles."""
    seed: int | None = quantity(0, 2**32 - 1, None)
    """Random seed (default: seed of the scenario)."""
    area: BoundsFile | None = None
    """Rectangle that contains all centres (strewn only, default: bounds)."""
    radius_m: Annotated[tuple[Radius, ...], Field(min_length=2, max_length=2)] = (
        constructor_default()
    )
    """Minimum and maximum radius, m (strewn only)."""
    gap_m: float = quantity(0.0, 100.0)
    """Minimum distance between two circles (strewn only)."""
    clear_m: float = quantity(0.0, 100.0, 0.3)
    """Minimum distance of circles from start and goal (strewn only)."""

    @field_validator("radius_m")
    @classmethod
    def _ordered(cls, ends: tuple[float, ...]) -> tuple[float, ...]:
        if not ends[0] <= ends[1]:
            raise ValueError(
                f"the radii are not ascending; the smaller radius {ends[0]:g} must not"
                f" be above the larger radius {ends[1]:g}"
            )
        return ends

    def draw(
        self, bounds: BoundsFile | None, seed: int, places: list[Pose | Goal]
    ) -> tuple[Circle, ...]:
        """Draw the circles at random.

        Raises:
            InputError: the circles do not fit into the area.
        """
        seed = seed if self.seed is None else self.seed
        if self.kind == "fig54":
            return fig54_world(self.count, seed).obstacles
        area = self.area or bounds
        clear = tuple((place.x, place.y, self.clear_m) for place in places)
        arguments = self.arguments() | {"seed": seed, "clear": clear}
        if area:
            return random_circles(bounds=area.build(), **arguments)
        return ()


class PegsFile(Section):
    """Rectangular field of pegs."""

    constructors = (peg_field,)

    spacing_m: float = quantity(1e-4, 100.0)
    """Distance between neighbouring pegs."""
    radius_m: float = quantity(1e-5, 100.0)
    """Radius of the pegs."""
    rows: int = quantity(1, 1000)
    """Number of pegs in each column (along y)."""
    columns: int = quantity(1, 1000)
    """Number of columns (along x)."""
    jitter_m: float = quantity(0.0, 100.0)
    """Maximum random displacement of a peg along x and along y."""
    staggered: bool = constructor_default()
    """Whether every second column is shifted by half the peg spacing."""
    x_m: float | None = quantity(-1000.0, 1000.0, None)
    """x coordinate of the first column (default: 0.2 times the robot's length unit
    beyond the start)."""
    y_m: float | None = quantity(-1000.0, 1000.0, None)
    """y coordinate of the field centre (default: y coordinate of the start)."""
    seed: int | None = quantity(0, 2**32 - 1, None)
    """Random seed for the displacements (default: seed of the scenario)."""

    @model_validator(mode="after")
    def _fits(self) -> PegsFile:
        if (count := self.rows * self.columns) > MAX_PEGS:
            raise ValueError(
                f"{count} pegs are too many; at most {MAX_PEGS} are allowed"
            )
        return self

    def draw(self, start: Pose, seed: int, length: float) -> tuple[Circle, ...]:
        """Return the pegs of the field.

        Args:
            start: initial pose of the snake.
            seed: random seed for a section without its own seed.
            length: length unit of the robot, dimensionless.

        Raises:
            InputError: displaced pegs could overlap.
        """
        x = self.x_m
        if x is None:
            x = start.x + PEG_DISTANCE_M * length
        y = start.y if self.y_m is None else self.y_m
        seed = seed if self.seed is None else self.seed
        return peg_field(**self.arguments() | {"first": (x, y), "seed": seed})


class FloorFile(Section):
    """Slope of the floor. The x and y axes lie in the plane of the floor."""

    constructors = (Floor,)

    tilt_deg: float = quantity(0.0, 60.0)
    """Slope angle."""
    uphill_deg: float = quantity(-360.0, 360.0)
    """Direction in which the floor rises (counter-clockwise from the x axis)."""


class FloorStepFile(Section):
    """Step in the floor along a line of constant x."""

    constructors = (FloorStep,)

    x_m: float = quantity(-1000.0, 1000.0)
    """x coordinate of the line."""
    height_m: float = quantity(-10.0, 10.0)
    """Height of the floor beyond the line, relative to the floor before the line."""


class _ObjectFile(Section):
    constructors = (MovableObject,)
    size_keys: ClassVar[tuple[str, ...]]

    mass_kg: float = quantity(1e-4, 1000.0)
    """Mass."""
    friction: float = quantity(0.0, 10.0)
    """Friction coefficient between object and floor."""
    x_m: float = quantity(-1000.0, 1000.0)
    """Initial x coordinate of the centre."""
    y_m: float = quantity(-1000.0, 1000.0)
    """Initial y coordinate of the centre."""
    heading_rad: float = quantity(-6.3, 6.3)
    """Initial heading (counter-clockwise from the x axis)."""

    def build(self) -> MovableObject:
        """Return the object in SI units."""
        size = tuple(getattr(self, key) for key in self.size_keys)
        return MovableObject(size=size, **self.arguments())


class CylinderFile(_ObjectFile):
    """Cylinder that stands on the floor and slides on it."""

    size_keys = ("radius_m",)

    kind: Literal["cylinder"]
    """Shape of the object."""
    radius_m: float = quantity(1e-3, 100.0)
    """Radius."""


class BoxFile(_ObjectFile):
    """Box that stands on the floor and slides on it."""

    size_keys = ("length_m", "width_m")

    kind: Literal["box"]
    """Shape of the object."""
    length_m: float = quantity(1e-3, 100.0)
    """Length along the heading."""
    width_m: float = quantity(1e-3, 100.0)
    """Width."""


ObjectFile = Annotated[CylinderFile | BoxFile, Field(discriminator="kind")]


class WorldFile(Section):
    """Obstacles, objects, floor, bounds and goal."""

    obstacles: Annotated[list[ObstacleFile], Field(max_length=1000)] = []
    """Round obstacles."""
    circles: FilePath | None = None
    """CSV file of round obstacles with the columns x_m, y_m and radius_m."""
    map: FilePath | None = None
    """ROS occupancy map (YAML file with a PGM or PNG picture)."""
    polygons: Annotated[list[PolygonFile], Field(max_length=1000)] = []
    """Polygonal obstacles."""
    random: RandomFile | None = None
    """Randomly placed round obstacles."""
    # The default is None so that scenarios without this key keep their digests.
    pegs: PegsFile | None = None
    """Field of pegs."""
    obstacle_friction: float | None = quantity(0.0, 10.0, None)
    """Coulomb friction coefficient between body and obstacles (default: 0.5, which is
    an estimate)."""
    floor: FloorFile = FloorFile()
    """Slope of the floor."""
    steps: Annotated[list[FloorStepFile], Field(max_length=100)] = []
    """Steps in the floor."""
    # The default is None so that scenarios without objects keep their digests.
    objects: Annotated[list[ObjectFile], Field(max_length=10)] | None = None
    """Movable objects, which only the twin simulates."""
    bounds: BoundsFile | None = None
    """Rectangle in which the snake must stay."""
    goal: GoalFile | None = None
    """Goal for the centre of mass."""

    def scaled_to(self, scale: Scale) -> WorldFile:
        """Return the section with default lengths scaled to a robot's length unit."""
        goal = self.goal
        random = self.random
        unit = scale.length
        scaled = self.model_copy()
        if goal is not None:
            scaled.__dict__["goal"] = goal.with_scaled_defaults(["radius_m"], unit)
        if random is not None:
            scaled.__dict__["random"] = random.with_scaled_defaults(
                ["radius_m", "gap_m", "clear_m"], unit
            )
        return scaled

    @field_validator("circles", "map")
    @classmethod
    def _readable(cls, path: str | None, info: ValidationInfo) -> str | None:
        if path is None:
            return None
        try:
            if info.field_name == "map":
                read_map(Path(path))
            else:
                read_circles(Path(path))
        except InputError as error:
            raise ValueError(str(error)) from None
        return path

    def place_of(self, number: int, world: World) -> tuple[str | int, ...]:
        """Return the path of an obstacle in this section, or () if the path is unknown.

        Args:
            number: index of the obstacle, counted from 0 over round obstacles, polygons
                and objects in this order.
            world: world returned by `build_world`.
        """
        round_ones = len(world.obstacles)
        firsts = {
            "obstacles": 0,
            "polygons": round_ones,
            "objects": round_ones + len(world.polygons),
        }
        for key, first in firsts.items():
            if 0 <= number - first < len(getattr(self, key) or ()):
                return key, number - first
        drawn = [
            key for key in ("pegs", "random", "circles", "map") if getattr(self, key)
        ]
        if len(drawn) == 1:
            return tuple(drawn)
        return ()

    def build_world(self, start: Pose, seed: int, length: float = 1.0) -> World:
        """Return the world around a snake that starts at a given pose.

        Args:
            start: initial pose, from which random obstacles keep a distance.
            seed: random seed of the scenario.
            length: length unit of the robot, dimensionless.

        Raises:
            InputError: random circles or pegs do not fit into the area, or an obstacle
                file cannot be used.
        """
        goal = self.goal.build() if self.goal else None
        bounds = self.bounds.build() if self.bounds else None
        circles = [circle.build() for circle in self.obstacles]
        polygons = [polygon.build() for polygon in self.polygons]
        if self.circles:
            circles += read_circles(Path(self.circles))
        if self.random:
            places = [start, goal] if goal else [start]
            circles += self.random.draw(self.bounds, seed, places)
        if self.pegs:
            circles += self.pegs.draw(start, seed, length)
        if self.map:
            polygons += read_map(Path(self.map))
        friction = self.obstacle_friction
        if friction is None:
            friction = OBSTACLE_FRICTION
        return World(
            obstacles=tuple(circles),
            bounds=bounds,
            goal=goal,
            polygons=tuple(polygons),
            floor=self.floor.build(),
            steps=tuple(step.build() for step in self.steps),
            objects=tuple(item.build() for item in self.objects or ()),
            friction=friction,
        )
