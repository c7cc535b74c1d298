"""Plots, notebook pages and Rerun recordings of plans and path-following runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from srs_twin.planning.metrics import GoalRecord, following, footprint_of, segments_of
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import FloorLine, FollowedSignal, RunPictures
from srs_twin.viewing.html import Table, cell, notebook_output, picture
from srs_twin.viewing.plots.from_above import (
    draw_run,
    lines_plot,
    obstacle_patches,
    strobe_times,
)
from srs_twin.viewing.plots.signals import goal_ring
from srs_twin.viewing.plots.style import (
    GOAL_COLOR,
    STYLES,
    add_legend,
    drawing,
    finish_floor,
    panels,
    style_of,
)

if TYPE_CHECKING:
    from srs_twin.planning.footprint import Footprint
    from srs_twin.planning.path import Segment
    from srs_twin.planning.problem import Plan, Problem

_SPACING_M = 0.01
"""Distance between the drawn points of a path, m."""

_FOOTPRINT_COLOUR = "#c9dcec"
_PATH_COLOUR = STYLES["plan"].color
_EDGE_COLOUR = "#78a5cd"


def segment_points(
    segment: Segment, offset: float = 0.0, behind: float = 0.0, ahead: float = 0.0
) -> np.ndarray:
    """Return points along a segment, about 1 cm apart, m, shape (n, 2).

    The points lie `offset` (m) to the left of the segment, which is extended by
    `behind` (m) at its start and by `ahead` (m) at its end.
    """
    low = -behind
    high = segment.length + ahead
    places = np.linspace(low, high, max(2, int((high - low) / _SPACING_M)))
    x, y, heading = np.array([[*segment.pose(s)] for s in places]).T
    return np.column_stack([x - offset * np.sin(heading), y + offset * np.cos(heading)])


@drawing
def following_plot(
    trajectories: Mapping[str, Trajectory], spec: RobotSpec
) -> Figure | None:
    """Plot the first plan with the paths and bodies of runs that follow it.

    Later plans of each run are drawn as thin dotted lines. If no run follows a plan,
    the result is None.
    """
    followers = {
        plant: metadata
        for plant, run in trajectories.items()
        if (metadata := following(run)) is not None
    }
    if not followers:
        return None
    metadata = next(iter(followers.values()))
    first = metadata["plans"][0]
    figure, axes = _sheet(metadata, segments_of(first), footprint_of(metadata))
    moments = strobe_times(trajectories, spec.geometry)
    for index, (plant, run) in enumerate(trajectories.items()):
        style = style_of(plant, index)
        draw_run(axes, run, style, spec.geometry, moments, filled=plant == "twin")
        for later in followers.get(plant, metadata)["plans"][1:]:
            x, y = path_points(segments_of(later)).T
            axes.plot(x, y, color=style.color, linewidth=0.7, linestyle=":")
    add_legend(axes)
    return figure


@drawing
def plan_plot(problem: Problem, segments: Sequence[Segment], title: str) -> Figure:
    """Plot the world and the goal of a problem, and the segments of a plan, if any."""
    metadata = {"world": asdict(problem.world), "goal": asdict(problem.goal)}
    figure, axes = _sheet(metadata, segments, problem.footprint)
    axes.set_title(title, fontsize=10, wrap=True)
    return figure


def _sheet(
    metadata: Mapping[str, Any], segments: Sequence[Segment], footprint: Footprint
) -> tuple[Figure, Axes]:
    figure, (axes,) = panels(6.0)
    for segment in segments:
        left, right = _edges(segment, footprint, footprint.behind, footprint.ahead)
        band = np.concatenate([left, right[::-1]])
        axes.add_patch(
            Polygon(band, facecolor=_FOOTPRINT_COLOUR, edgecolor="none", zorder=0)
        )
    world = metadata["world"]
    goal = metadata["goal"]
    circles = (
        (circle["x"], circle["y"], circle["radius"]) for circle in world["obstacles"]
    )
    for patch in obstacle_patches(
        circles, (polygon["corners"] for polygon in world["polygons"])
    ):
        axes.add_patch(patch)
    if bounds := world["bounds"]:
        (x0, x1), (y0, y1) = bounds["x"], bounds["y"]
        axes.add_patch(
            Rectangle(
                (x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor="0.6", linestyle="--"
            )
        )
    if segments:
        x, y = path_points(segments).T
        axes.plot(x, y, color=_PATH_COLOUR, linewidth=1.0, zorder=2, label="plan")
        starts = np.array([(segment.start.x, segment.start.y) for segment in segments])
        axes.plot(*starts.T, ".", color=_PATH_COLOUR, markersize=3, zorder=2)
    axes.add_patch(
        Circle(
            (goal["x"], goal["y"]),
            goal["radius"],
            fill=False,
            edgecolor=GOAL_COLOR,
            zorder=2,
        )
    )
    axes.autoscale_view()
    finish_floor(axes, "Plan with footprint, obstacles and goal")
    return figure, axes


def _edges(
    segment: Segment, footprint: Footprint, *beyond: float
) -> tuple[np.ndarray, np.ndarray]:
    motion = footprint.at(segment.curvature)
    left = segment_points(segment, motion.left, *beyond)
    return left, segment_points(segment, -motion.right, *beyond)


def path_points(segments: Sequence[Segment]) -> np.ndarray:
    """Return points along a path, m, shape (k, 2)."""
    return np.concatenate([segment_points(segment) for segment in segments])


def plan_page(plan: Plan) -> str:
    """Return the HTML representation of a plan for notebooks."""
    rows = [
        ["length", "m", cell(plan.length)],
        ["time", "s", cell(plan.duration)],
        ["segments", "1", str(len(plan.segments))],
        ["nodes", "1", str(plan.expanded)],
    ]
    path = None
    if plan.segments:
        figure = lines_plot({"path": path_points(plan.segments)})
        path = picture(figure, "Path of the centre of mass.")
    return notebook_output(
        f"{plan.outcome.value}: {plan.reason}",
        Table(["", "unit", "value"], rows, [2]),
        path,
    )


def plan_lines(
    segments: Sequence[Segment], footprint: Footprint, goal: GoalRecord
) -> list[FloorLine]:
    """Return floor lines for the path, the edges of the footprint and the goal."""
    lines = []
    if segments:
        lines.append(
            FloorLine(
                "plan/path", tuple(map(segment_points, segments)), _PATH_COLOUR, 0.002
            )
        )
        edges = tuple(
            edge for segment in segments for edge in _edges(segment, footprint)
        )
        lines.append(FloorLine("plan/edges", edges, _EDGE_COLOUR, 0.0015))
    ring = goal_ring(goal["x"], goal["y"], goal["radius"])
    return [*lines, FloorLine("plan/goal", (ring,), GOAL_COLOR, 0.002)]


class FollowingPictures(RunPictures):
    """Pictures of runs that follow a plan."""

    kind = "following"
    legend = {"plan": _PATH_COLOUR, "goal": GOAL_COLOR}  # noqa: RUF012
    signals = (
        FollowedSignal(
            "cross_track",
            "cross_track",
            1e3,
            "Distance from the path, left positive (mm)",
        ),
        FollowedSignal("offset_commanded", "offset", 1.0, "Offset commanded"),
    )

    def applies(self, run: Trajectory) -> bool:
        """See `RunPictures.applies`."""
        return following(run) is not None

    def figures(
        self, runs: Mapping[str, Trajectory], spec: RobotSpec
    ) -> dict[str, Figure]:
        """See `RunPictures.figures`."""
        caption = (
            "Plan with footprint (blue), obstacles and goal, and the runs that"
            " follow it."
        )
        if figure := following_plot(runs, spec):
            return {caption: figure}
        return {}

    def floor_lines(self, run: Trajectory, *, latest: bool = False) -> list[FloorLine]:
        """See `RunPictures.floor_lines`."""
        metadata = following(run)
        assert metadata is not None, "applies() is true"
        plan = metadata["plans"][-1 if latest else 0]
        return plan_lines(segments_of(plan), footprint_of(metadata), metadata["goal"])


PICTURES = FollowingPictures()
