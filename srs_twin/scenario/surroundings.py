"""The world of a scenario in SI: what the file names, and what it has drawn by a seed."""

from __future__ import annotations

from srs_twin.scenario.file import ScenarioFile
from srs_twin.scenario.world_file import BoundsFile, RandomFile
from srs_twin.world import Bounds, Circle, Goal, Polygon, Pose, World


def start_of(file: ScenarioFile) -> Pose:
    """Return where the snake lies at first."""
    return Pose(file.start.x_m, file.start.y_m, file.start.heading_rad)


def world_of(file: ScenarioFile) -> World:
    """Return what surrounds the snake.

    Raises:
        InputError: circles that are to be drawn do not fit.
    """
    given = file.world
    goal = given.goal
    drawn = _drawn(given.random, file) if given.random else ()
    return World(
        obstacles=tuple(Circle(each.x_m, each.y_m, each.radius_m) for each in given.obstacles) + drawn,
        bounds=_bounds(given.bounds),
        goal=Goal(goal.x_m, goal.y_m, goal.heading_rad, goal.radius_m, goal.heading_tolerance_rad)
        if goal
        else None,
        polygons=tuple(Polygon(tuple((x, y) for x, y in each.corners_m)) for each in given.polygons),
    )


def _bounds(given: BoundsFile | None) -> Bounds | None:
    return Bounds((given.x_m[0], given.x_m[1]), (given.y_m[0], given.y_m[1])) if given else None


def _drawn(given: RandomFile, file: ScenarioFile) -> tuple[Circle, ...]:
    from srs_twin.planning.fields import fig54_world, strewn

    seed = file.seed if given.seed is None else given.seed
    if given.kind == "fig54":
        return fig54_world(given.count, seed).obstacles
    area = _bounds(given.area or file.world.bounds)
    if area is None:
        return ()
    ends = [(file.start.x_m, file.start.y_m)]
    if goal := file.world.goal:
        ends.append((goal.x_m, goal.y_m))
    return strewn(
        given.count, area, seed, radius=(given.radius_m[0], given.radius_m[1]), gap=given.gap_m,
        clear=tuple((x, y, given.clear_m) for x, y in ends),
    )  # fmt: skip
