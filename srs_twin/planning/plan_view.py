"""Bodies and paths seen from above: the stroboscopic view, and plans with what the snakes made of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from os.path import commonprefix
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from shapely import LineString

from srs_twin.planning.metrics import following, footprint_of, segments_of
from srs_twin.robot.spec import Geometry, RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.signals import body_line, segment_points
from srs_twin.viewing.plots.style import GOAL_COLOR, PLUS_COLOR, STYLES, Style, finish, panels, style_of

if TYPE_CHECKING:
    from srs_twin.planning import Footprint, Segment
    from srs_twin.planning.explored import Explored
    from srs_twin.recordings.inspection import Scene


_MOST_SHOWN = 6
APART = 1.35
"""Bodies closer together than this many body lengths hide each other."""


def plan_view(trajectories: Mapping[str, Trajectory], spec: RobotSpec) -> Figure:
    """Return the paths of the centres of mass with the bodies at a few equal times (after Fig. 36).

    Args:
        trajectories: plant → run; the twin's bodies are filled, the others' are outlines.
        spec: the robot that ran.
    """
    moments = strobe_times(trajectories, spec.geometry)
    low, high = bounds(trajectories, spec.geometry, moments)
    tall = float(np.clip(8.0 * (high[1] - low[1]) / (high[0] - low[0]) + 1.2, 2.4, 7.0))
    figure, (axes,) = panels(tall)
    for index, (plant, run) in enumerate(trajectories.items()):
        _draw_run(axes, run, style_of(plant, index), spec.geometry, moments, filled=plant == "twin")
    axes.set_aspect("equal", adjustable="datalim")
    shown = ", ".join(f"{moment:.3g}" for moment in moments)
    title = f"Seen from above: paths of the centre of mass, bodies (dot: head) at t = {shown} s"
    finish(axes, "y (m)", "x (m)", title=title)
    figure.legend(loc="lower right", ncols=len(trajectories), fontsize=9, frameon=False)
    return figure


def markers_view(scene: Scene) -> Figure:
    """Return markers from above: their ways, the chain at three moments, rigid pairs, where it crawled."""
    places = scene.places
    low, high = np.nanmin(places, axis=(0, 1)), np.nanmax(places, axis=(0, 1))
    wide, deep = np.maximum(high - low, 1e-3)
    figure, (axes,) = panels(float(np.clip(8.0 * deep / wide + 1.4, 2.8, 7.0)))
    axes.plot(*places.reshape(len(places), -1, 2).transpose(2, 0, 1), color="0.8", linewidth=0.6, zorder=1)
    complete = np.flatnonzero(np.isfinite(places[..., 0]).all(axis=1))
    if complete.size:
        order = list(scene.order) or list(range(places.shape[1]))
        for moment, shade in zip(complete[[0, len(complete) // 2, -1]], ("0.55", "0.35", "0.1"), strict=True):
            along = places[moment, order]
            axes.plot(
                *along.T, "o-" if scene.order else "o", color=shade, markersize=4, linewidth=1.2, zorder=2
            )
            for pair in scene.rigid:
                axes.plot(*places[moment, list(pair)].T, color=PLUS_COLOR, linewidth=2.5, zorder=3)
        same = len(commonprefix(scene.names)) if len(scene.names) > 1 else 0
        for name, place in zip(scene.names, places[complete[0]], strict=True):
            said = name[same:] or name
            axes.annotate(said, place, (1, 4), textcoords="offset points", rotation=60, fontsize=7)
        start, end = (places[complete[k]].mean(axis=0) for k in (0, -1))
        if np.hypot(*(end - start)) > 0.05 * wide:
            axes.annotate(
                "", end, start, arrowprops={"arrowstyle": "->", "color": GOAL_COLOR, "linewidth": 1.2}
            )
    axes.set_aspect("equal", adjustable="datalim")
    title = f"{places.shape[1]} markers; lines: order along the body at the first, middle and last frame"
    finish(axes, "y (m)", "x (m)", title=title)
    return figure


def strobe_times(trajectories: Mapping[str, Trajectory], geometry: Geometry) -> list[float]:
    """Return equally spaced times at which to draw bodies, six at most, so few that they stay apart, s.

    Args:
        trajectories: plant → run.
        geometry: of the robot.
    """
    run = next(iter(trajectories.values()))
    last = min(float(each.time[-1]) for each in trajectories.values())
    moved = np.hypot(*(run.com - run.com[0]).T)
    apart = int(np.interp(last, run.time, moved) / (APART * geometry.body_length) + 1e-6) + 1
    # A snake that hardly moved is shown at the start and the end.
    return np.linspace(float(run.time[0]), last, int(np.clip(apart, 2, _MOST_SHOWN))).tolist()


def rows_at(run: Trajectory, moments: list[float]) -> list[Trajectory]:
    """Return the samples at given times as one-sample trajectories."""
    rows = np.searchsorted(run.time, np.array(moments) - 1e-9).clip(max=len(run) - 1)
    return [Trajectory({name: column[[row]] for name, column in run.columns.items()}) for row in rows]


def _draw_run(
    axes: Axes, run: Trajectory, style: Style, geometry: Geometry, moments: list[float], *, filled: bool
) -> None:
    for moment in rows_at(run, moments):
        outline(axes, moment, geometry, style, filled=filled)
    axes.plot(*run.com.T, **style.line)


def outline(axes: Axes, moment: Trajectory, geometry: Geometry, style: Style, *, filled: bool) -> None:
    """Draw the outline of a body, with a dot at its head."""
    shape = np.asarray(LineString(body_line(moment, geometry)[0]).buffer(geometry.width / 2).exterior.coords)
    if filled:
        axes.fill(*shape.T, facecolor=style.color, alpha=0.25, linewidth=0)
    axes.plot(*shape.T, color=style.color, linestyle=style.dash, linewidth=1.0, zorder=5)
    axes.plot(*moment.position[0, 0], "o", color=style.color, markersize=2.5, zorder=5)


def bounds(
    trajectories: Mapping[str, Trajectory], geometry: Geometry, moments: list[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest corner of the floor that bodies at some times need, m."""
    drawn = [row.position[0] for run in trajectories.values() for row in rows_at(run, moments)]
    points = np.concatenate(drawn)
    margin = 1.6 * geometry.half_track + geometry.width
    return points.min(axis=0) - margin, points.max(axis=0) + margin


_OBSTACLE, _SWEPT, _PATH = "0.35", "#c9dcec", STYLES["plan"].color


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
        _draw_run(axes, run, style, spec.geometry, moments, filled=plant == "twin")
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


def lines_plot(lines: Mapping[str, np.ndarray]) -> Figure:
    """Return lines on the floor, each of shape (k, 2), m, by what they are."""
    figure, (axes,) = panels(3.0)
    for name, points in lines.items():
        axes.plot(*points.T, label=name)
    axes.set_aspect("equal", adjustable="datalim")
    finish(axes, "y (m)", "x (m)", title="")
    axes.legend(fontsize=9, frameon=False)
    return figure


def _band(segment: Segment, footprint: Footprint) -> np.ndarray:
    """Return the outline of what is planned for the body along a segment, shape (k, 2)."""
    motion, beyond = footprint.at(segment.curvature), (footprint.behind, footprint.ahead)
    left, right = (segment_points(segment, n, *beyond) for n in (motion.left, -motion.right))
    return np.concatenate([left, right[::-1]])


def path_points(segments: Sequence[Segment]) -> np.ndarray:
    """Return points along a path, shape (k, 2)."""
    return np.concatenate([segment_points(segment) for segment in segments])
