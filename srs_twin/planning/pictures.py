"""Bodies and paths seen from above: the stroboscopic view, and plans with what the snakes made of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from srs_twin.planning.metrics import following, footprint_of, segments_of
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import FloorLine, FollowedSignal, RunPictures
from srs_twin.viewing.html.page import Table, cell, picture, piece
from srs_twin.viewing.plots.from_above import draw_run, lines_plot, strobe_times
from srs_twin.viewing.plots.signals import goal_ring
from srs_twin.viewing.plots.style import GOAL_COLOR, STYLES, finish, panels, style_of

if TYPE_CHECKING:
    from pathlib import Path

    from srs_twin.planning.explored import Explored
    from srs_twin.planning.footprint import Footprint
    from srs_twin.planning.plan import Plan
    from srs_twin.planning.problem import Segment

_SPACING = 0.01


def segment_points(
    segment: Segment, offset: float = 0.0, behind: float = 0.0, ahead: float = 0.0
) -> np.ndarray:
    """Return points along a segment of a plan, about a centimetre apart, shape (n, 2), m.

    Args:
        segment: of the plan.
        offset: how far to the left of it, m.
        behind: how far before its begin, m.
        ahead: how far beyond its end, m.
    """
    low, high = -behind, segment.length + ahead
    poses = [segment.pose(s) for s in np.linspace(low, high, max(2, int((high - low) / _SPACING)))]
    return np.array([(p.x - offset * np.sin(p.heading), p.y + offset * np.cos(p.heading)) for p in poses])


_OBSTACLE, _SWEPT, _PATH, _EDGE = "0.35", "#c9dcec", STYLES["plan"].color, "#78a5cd"


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
        draw_run(axes, run, style, spec.geometry, moments, filled=plant == "twin")
        for later in told.get(plant, about)["plans"][1:]:
            x, y = path_points(segments_of(later)).T
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
    axes.set_title(title, fontsize=10, wrap=True)
    return figure


_EXPLORED, _REJECTED, _GATE = "0.72", "#d8746a", "#3a7d44"


def search_plot(
    about: Mapping[str, Any], segments: Sequence[Segment], footprint: Footprint, seen: Explored
) -> Figure:
    """Return a plan with the search that found it, or did not; arguments as `plan_plot`."""
    figure, axes = _sheet(about, segments, footprint)
    counts = Counter(seen.reasons).most_common(3)
    told = ", ".join(f"{count} at {name}" for name, count in counts)
    rejected = f"{len(seen.rejected)} rejected arcs" + (f": {told}" if told else "")
    for lines, color, zorder, label in (
        (seen.arcs, _EXPLORED, 0.5, f"arcs to {seen.nodes} nodes"),
        (seen.rejected, _REJECTED, 0.6, rejected),
        (seen.gates, _GATE, 0.7, f"{len(seen.gates)} ways through gaps"),
    ):
        drawn = LineCollection(list(lines), colors=color, linewidths=0.5, zorder=zorder, label=label)
        axes.add_collection(drawn, autolim=False)
    axes.legend(loc="best", fontsize=8, frameon=False)
    axes.set_title("The search: explored, rejected, and what came of it", fontsize=10)
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
        x, y = path_points(segments).T
        axes.plot(x, y, color=_PATH, linewidth=1.0, zorder=2, label="plan")
        starts = np.array([(each.start.x, each.start.y) for each in segments])
        axes.plot(*starts.T, ".", color=_PATH, markersize=3, zorder=2)
    axes.add_patch(Circle((goal["x"], goal["y"]), goal["radius"], fill=False, edgecolor=GOAL_COLOR, zorder=2))
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    finish(axes, "y (m)", "x (m)", title="Plan, the floor planned for the body, obstacles and goal")
    return figure, axes


def _band(segment: Segment, footprint: Footprint) -> np.ndarray:
    """Return the outline of what is planned for the body along a segment, shape (k, 2)."""
    motion, beyond = footprint.at(segment.curvature), (footprint.behind, footprint.ahead)
    left, right = (segment_points(segment, n, *beyond) for n in (motion.left, -motion.right))
    return np.concatenate([left, right[::-1]])


def path_points(segments: Sequence[Segment]) -> np.ndarray:
    """Return points along a path, shape (k, 2)."""
    return np.concatenate([segment_points(segment) for segment in segments])


def plan_page(plan: Plan) -> str:
    """Return a plan as HTML for a notebook."""
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
    return piece(f"{plan.outcome.value}: {plan.reason}", Table(["", "unit", "value"], rows, [2]), path)


def write_search(path: Path, plan: Plan, explored: Explored, title: str) -> None:
    """Write a Rerun recording of a search: world, plan, explored and rejected arcs.

    Args:
        path: file to write; an existing one is replaced.
        plan: answer of the planner, with its problem.
        explored: arcs of its trees.
        title: name of the recording in the viewer.
    """
    from srs_twin.viewing.rerun.recording import write_floor
    from srs_twin.viewing.rerun.scene import FORCE_COLOR

    problem = plan.problem
    assert problem is not None, "the planner sets it"
    lines = plan_lines(plan.segments, problem.footprint, asdict(problem.goal))
    lines.append(FloorLine("search/explored", tuple(explored.arcs), "#aaaaaa", 0.0005))
    lines.append(FloorLine("search/gates", tuple(explored.gates), GOAL_COLOR, 0.0015))
    for reason in sorted(set(explored.reasons)):
        pairs = zip(explored.rejected, explored.reasons, strict=True)
        arcs = tuple(arc for arc, why in pairs if why == reason)
        lines.append(FloorLine(f"search/rejected/{reason.replace(' ', '_')}", arcs, FORCE_COLOR, 0.0005))
    write_floor(path, title, problem.world, lines)


def plan_lines(segments: Sequence[Segment], footprint: Footprint, goal: Mapping[str, Any]) -> list[FloorLine]:
    """Return a plan as lines on the floor: its path, the edges of the planned footprint, the goal."""
    lines = []
    if segments:
        lines.append(FloorLine("plan/path", tuple(map(segment_points, segments)), _PATH, 0.002))
        edges = tuple(
            segment_points(segment, offset)
            for segment in segments
            for motion in [footprint.at(segment.curvature)]
            for offset in (motion.left, -motion.right)
        )
        lines.append(FloorLine("plan/edges", edges, _EDGE, 0.0015))
    return [*lines, FloorLine("plan/goal", (goal_ring(goal),), GOAL_COLOR, 0.002)]


class FollowingPictures(RunPictures):
    """Pictures of runs that follow a plan."""

    kind = "following"
    legend = {"plan": _PATH, "goal": GOAL_COLOR}  # noqa: RUF012
    signals = (
        FollowedSignal("cross_track", "cross_track", 1e3, "Distance from the path, left positive (mm)"),
        FollowedSignal("offset_commanded", "offset", 1.0, "Offset commanded"),
    )

    def applies(self, run: Trajectory) -> bool:
        """See `RunPictures.applies`."""
        return following(run) is not None

    def figures(self, runs: Mapping[str, Trajectory], spec: RobotSpec) -> dict[str, Figure]:
        """See `RunPictures.figures`."""
        figure = following_plot(runs, spec)
        caption = "The plan, the floor planned for the body (blue), obstacles, goal, and what came of it."
        return {} if figure is None else {caption: figure}

    def floor_lines(self, run: Trajectory) -> list[FloorLine]:
        """See `RunPictures.floor_lines`."""
        about = following(run)
        assert about is not None, "applies() was asked"
        return plan_lines(segments_of(about["plans"][0]), footprint_of(about), about["goal"])


PICTURES = FollowingPictures()
"""Registry entry."""
