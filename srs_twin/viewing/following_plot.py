"""A plan from above: obstacles, path, the floor planned for the body, and what the snakes made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from srs_twin.comparison.following import following, footprint_of, segments_of
from srs_twin.spec import RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.colors import style_of
from srs_twin.viewing.figures import finish, panels
from srs_twin.viewing.plan_view import outline, rows_at, strobe_times

if TYPE_CHECKING:
    from srs_twin.planning import Footprint, Segment

_SPACING = 0.01
_OBSTACLE, _SWEPT, _PATH = "0.35", "#c9dcec", "#3a3a3a"


def following_plot(trajectories: Mapping[str, Trajectory], spec: RobotSpec) -> Figure | None:
    """Return the plan with the paths and bodies of the snakes that followed it; None where none did.

    Later plans are thin; each snake has its own, the first one is everybody's.

    Args:
        trajectories: plant → run.
        spec: the robot that ran.
    """
    told = {plant: about for plant, run in trajectories.items() if (about := following(run)) is not None}
    if not told:
        return None
    about = next(iter(told.values()))
    first = about["plans"][0]
    figure, axes = _sheet(about, segments_of(first), footprint_of(about))
    moments = strobe_times(trajectories, spec.geometry)
    for index, (plant, run) in enumerate(trajectories.items()):
        style = style_of(plant, index)
        for moment in rows_at(run, moments):
            outline(axes, moment, spec.geometry, style, filled=plant == "twin")
        axes.plot(
            *run.com.T, color=style.color, linestyle=style.dash, linewidth=style.width, label=style.label
        )
        for later in told.get(plant, about)["plans"][1:]:
            x, y = _path(segments_of(later)).T
            axes.plot(x, y, color=style.color, linewidth=0.7, linestyle=":")
    axes.legend(loc="best", fontsize=8, frameon=False)
    return figure


def plan_plot(
    about: Mapping[str, Any], segments: Sequence[Segment], footprint: Footprint, title: str
) -> Figure:
    """Return the plan alone.

    Args:
        about: "world" and "goal" as plain data.
        segments: the path; empty where there is none.
        footprint: that it was planned with.
        title: over the picture.
    """
    figure, axes = _sheet(about, segments, footprint)
    axes.set_title(title, fontsize=10)
    return figure


def _sheet(
    about: Mapping[str, Any], segments: Sequence[Segment], footprint: Footprint
) -> tuple[Figure, Axes]:
    figure, (axes,) = panels(6.0)
    for segment in segments:
        axes.add_patch(Polygon(_band(segment, footprint), facecolor=_SWEPT, edgecolor="none", zorder=0))
    world, goal = about["world"], about["goal"]
    for each in world["obstacles"]:
        axes.add_patch(Circle((each["x"], each["y"]), each["radius"], facecolor=_OBSTACLE, zorder=1))
    for each in world["polygons"]:
        axes.add_patch(Polygon(np.array(each["corners"]), facecolor=_OBSTACLE, zorder=1))
    if bounds := world["bounds"]:
        (x0, x1), (y0, y1) = bounds["x"], bounds["y"]
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor="0.6", linestyle="--"))
    if segments:
        x, y = _path(segments).T
        axes.plot(x, y, color=_PATH, linewidth=1.0, zorder=2, label="plan")
        starts = np.array([(each.start.x, each.start.y) for each in segments])
        axes.plot(*starts.T, ".", color=_PATH, markersize=3, zorder=2)
    axes.add_patch(Circle((goal["x"], goal["y"]), goal["radius"], fill=False, edgecolor="#b03030", zorder=2))
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    finish(axes, "y (m)")
    axes.set_xlabel("x (m)")
    axes.set_title("Plan, the floor planned for the body, obstacles and goal", fontsize=10)
    return figure, axes


def _band(segment: Segment, footprint: Footprint) -> np.ndarray:
    """Return the outline of what is planned for the body along a segment, shape (k, 2)."""
    motion = footprint.at(segment.curvature)
    low, high = -footprint.behind, segment.length + footprint.ahead
    poses = [segment.pose(s) for s in np.linspace(low, high, max(2, int((high - low) / _SPACING)))]
    sides = [
        [(p.x - n * np.sin(p.heading), p.y + n * np.cos(p.heading)) for p in poses]
        for n in (motion.left, -motion.right)
    ]
    return np.array(sides[0] + sides[1][::-1])


def _path(segments: Sequence[Segment]) -> np.ndarray:
    """Return points along a path, shape (k, 2)."""
    from srs_twin.planning import Outcome, Plan

    return Plan(Outcome.FOUND, "", tuple(segments)).samples(_SPACING)[:, :2]
