"""Bodies, paths and plans seen from above.

Bodies and paths seen from above: the stroboscopic plan view, and the picture for the front page.

A plan from above: obstacles, path, the floor planned for the body, and what the snakes made of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon, Rectangle
from shapely import LineString

from srs_twin.comparison.centre_line import centre_lines
from srs_twin.comparison.following import following, footprint_of, segments_of
from srs_twin.robot.spec import Geometry, RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.signals import body_line, pressure_difference, wheel_centres
from srs_twin.viewing.plots.style import MINUS_RGB, PLUS_RGB, Style, finish, panels, pressure_colors, style_of

if TYPE_CHECKING:
    from srs_twin.planning import Footprint, Segment


_MOST_SHOWN = 6
# Bodies closer together than this many body lengths hide each other.
_APART = 1.35
_HERO_WIDTH, _LEGEND_HEIGHT = 11.0, 0.35
_HERO_BODIES = 4
_GRID_M = 0.1


def plan_view(trajectories: Mapping[str, Trajectory], spec: RobotSpec) -> Figure:
    """Return the paths of the centres of mass with the bodies at a few equal times (after Fig. 36).

    Args:
        trajectories: plant → run; the twin's bodies are filled, the others' are outlines.
        spec: the robot that ran.
    """
    moments = strobe_times(trajectories, spec.geometry)
    low, high = _bounds(trajectories, spec.geometry, moments)
    tall = float(np.clip(8.0 * (high[1] - low[1]) / (high[0] - low[0]) + 1.2, 2.4, 7.0))
    figure, (axes,) = panels(tall)
    for index, (plant, run) in enumerate(trajectories.items()):
        style = style_of(plant, index)
        for moment in rows_at(run, moments):
            outline(axes, moment, spec.geometry, style, filled=plant == "twin")
        axes.plot(
            *run.com.T, color=style.color, linestyle=style.dash, linewidth=style.width, label=style.label
        )
    axes.set_aspect("equal", adjustable="datalim")
    finish(axes, "y (m)")
    axes.set_xlabel("x (m)")
    shown = ", ".join(f"{moment:.3g}" for moment in moments)
    axes.set_title(
        f"Seen from above: paths of the centre of mass, bodies (dot: head) at t = {shown} s", fontsize=10
    )
    figure.legend(loc="lower right", ncols=len(trajectories), fontsize=9, frameon=False)
    return figure


def hero_figure(trajectories: Mapping[str, Trajectory], spec: RobotSpec) -> Figure:
    """Return the picture for the front page: a strip along the first few body lengths of the path.

    The twin's segments have the colour of their pressure difference, the analytical model is a dashed
    outline, both at the same moments and on the same scale.
    """
    geometry = spec.geometry
    moments = strobe_times(trajectories, geometry, most=_HERO_BODIES)
    low, high = _bounds(trajectories, geometry, moments)
    width, height = high - low
    tall = float(np.clip(_HERO_WIDTH * height / width, 1.5, 8.0))
    figure = Figure(figsize=(_HERO_WIDTH, tall + _LEGEND_HEIGHT))
    below = _LEGEND_HEIGHT / (tall + _LEGEND_HEIGHT)
    axes = figure.add_axes((0.0, below, 1.0, 1.0 - below))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal", adjustable="datalim")
    for index, (plant, run) in enumerate(trajectories.items()):
        style = style_of(plant, index)
        until = run.time <= moments[-1] + 1e-9
        axes.plot(*run.com[until].T, color=style.color, linestyle=style.dash, linewidth=1.4, zorder=1)
        colored = plant == "twin" or "twin" not in trajectories
        # One scale of colour for the whole run, whichever moments are shown.
        colors = pressure_colors(pressure_difference(run)) / 255.0
        rows = np.searchsorted(run.time, np.array(moments) - 1e-9).clip(max=len(run) - 1)
        for row, moment in zip(rows, rows_at(run, moments), strict=True):
            if colored:
                _snake(axes, moment, geometry, colors[row])
            else:
                outline(axes, moment, geometry, style, filled=False)
    axes.apply_aspect()
    _dress(axes, trajectories, spec, moments)
    return figure


def strobe_times(
    trajectories: Mapping[str, Trajectory], geometry: Geometry, most: int | None = None
) -> list[float]:
    """Return equally spaced times at which to draw bodies, few enough that they stay apart, s.

    Args:
        trajectories: plant → run.
        geometry: of the robot.
        most: stop where this many bodies have found room; None spreads six over the whole run.
    """
    run = next(iter(trajectories.values()))
    last = min(float(each.time[-1]) for each in trajectories.values())
    moved = np.hypot(*(run.com - run.com[0]).T)
    room = _APART * geometry.body_length
    if most is not None:
        far = np.flatnonzero(moved > (most - 1) * room)
        last = min(last, float(run.time[far[0]])) if far.size else last
    apart = int(np.interp(last, run.time, moved) / room + 1e-6) + 1
    # A snake that hardly moved is shown at the start and the end.
    return np.linspace(float(run.time[0]), last, int(np.clip(apart, 2, most or _MOST_SHOWN))).tolist()


def rows_at(run: Trajectory, moments: list[float]) -> list[Trajectory]:
    """Return the samples at given times as one-sample trajectories."""
    rows = np.searchsorted(run.time, np.array(moments) - 1e-9).clip(max=len(run) - 1)
    return [Trajectory({name: column[[row]] for name, column in run.columns.items()}) for row in rows]


def outline(axes: Axes, moment: Trajectory, geometry: Geometry, style: Style, *, filled: bool) -> None:
    """Draw the outline of a body, with a dot at its head."""
    shape = np.asarray(LineString(body_line(moment, geometry)[0]).buffer(geometry.width / 2).exterior.coords)
    if filled:
        axes.fill(*shape.T, facecolor=style.color, alpha=0.25, linewidth=0)
    axes.plot(*shape.T, color=style.color, linestyle=style.dash, linewidth=1.0, zorder=5)
    axes.plot(*moment.position[0, 0], "o", color=style.color, markersize=2.5, zorder=5)


def _snake(axes: Axes, moment: Trajectory, geometry: Geometry, colors: np.ndarray) -> None:
    """Draw wheels, connectors and segments, each segment in one of `colors`, (segments, 4)."""
    theta = moment.stack("theta")[0]
    along = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    left = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    wheels = wheel_centres(moment, geometry)[0].reshape(-1, 2)
    turned = np.repeat(along, 2, axis=0), np.repeat(left, 2, axis=0)
    radius = geometry.wheel_radius
    plates = _boxes(moment.position[0], along, left, 0.18 * radius, geometry.half_track)
    axes.add_collection(PolyCollection(plates, facecolors="#464a52", zorder=2))
    axes.add_collection(
        PolyCollection(_boxes(wheels, *turned, radius, 0.25 * radius), facecolors="#1c1e22", zorder=2)
    )
    for line, color in zip(centre_lines(moment, geometry)[0], colors, strict=True):
        tube = LineString(line).buffer(geometry.width / 2, cap_style="flat")
        axes.fill(
            *np.asarray(tube.exterior.coords).T, facecolor=color, edgecolor="#30333a", linewidth=0.6, zorder=4
        )
    axes.plot(*moment.position[0, 0], "o", color="white", markeredgecolor="#30333a", markersize=4.5, zorder=4)


def _boxes(
    centre: np.ndarray, along: np.ndarray, left: np.ndarray, half_length: float, half_width: float
) -> list[np.ndarray]:
    """Return rectangles, each (4, 2), from centres and axes, each (n, 2)."""
    corners = [(1, 1), (1, -1), (-1, -1), (-1, 1)]
    return [  # one (4, 2) array a rectangle
        np.array([c + a * half_length * ahead + b * half_width * side for a, b in corners])
        for c, ahead, side in zip(centre, along, left, strict=True)
    ]


def _bounds(
    trajectories: Mapping[str, Trajectory], geometry: Geometry, moments: list[float]
) -> tuple[np.ndarray, np.ndarray]:
    drawn = [row.position[0] for run in trajectories.values() for row in rows_at(run, moments)]
    points = np.concatenate(drawn)
    margin = 1.6 * geometry.half_track + geometry.width
    return points.min(axis=0) - margin, points.max(axis=0) + margin


def _hex(rgb: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*rgb)


def _dress(axes: Axes, trajectories: Mapping[str, Trajectory], spec: RobotSpec, moments: list[float]) -> None:
    """Put the floor's grid, times and names on the picture."""
    axes.set_facecolor("#e9ebee")
    for side in axes.spines.values():
        side.set_visible(False)
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        axis.set_ticks(_GRID_M * np.arange(np.ceil(low / _GRID_M), np.floor(high / _GRID_M) + 1), labels=[])
    axes.tick_params(length=0)
    axes.grid(True, color="white", linewidth=1.0)
    axes.set_axisbelow(True)
    shown = trajectories.get("twin") or next(iter(trajectories.values()))
    for moment, row in zip(moments, rows_at(shown, moments), strict=True):
        top = row.position[0].max(axis=0)[1] + spec.geometry.half_track + spec.geometry.wheel_radius
        axes.text(row.com[0, 0], top, f"t = {moment:.1f} s", ha="center", va="bottom", fontsize=9)
    names: list[Line2D | Patch] = [
        Line2D([], [], color=style.color, linestyle=style.dash, label=f"{style.label}, centre of mass")
        for style in map(style_of, trajectories, range(len(trajectories)))
    ]
    names += [
        Patch(color=_hex(PLUS_RGB), label="$p^+ > p^-$ (bends left)"),
        Patch(color=_hex(MINUS_RGB), label="$p^+ < p^-$ (bends right)"),
        Line2D([], [], marker="o", color="white", markeredgecolor="#30333a", label="head"),
        Patch(facecolor="none", label=f"grid {_GRID_M:g} m"),
    ]
    axes.figure.legend(handles=names, loc="lower center", ncols=len(names), frameon=False, fontsize=8.5)


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
