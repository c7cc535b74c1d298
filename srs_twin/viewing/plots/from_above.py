"""Paths and bodies seen from above."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from shapely import LineString

from srs_twin.robot.spec import Geometry, RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.signals import body_line
from srs_twin.viewing.plots.style import Style, finish, panels, style_of

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
        draw_run(axes, run, style_of(plant, index), spec.geometry, moments, filled=plant == "twin")
    axes.set_aspect("equal", adjustable="datalim")
    shown = ", ".join(f"{moment:.3g}" for moment in moments)
    title = f"Seen from above: paths of the centre of mass, bodies (dot: head) at t = {shown} s"
    finish(axes, "y (m)", "x (m)", title=title)
    figure.legend(loc="lower right", ncols=len(trajectories), fontsize=9, frameon=False)
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


def draw_run(
    axes: Axes, run: Trajectory, style: Style, geometry: Geometry, moments: list[float], *, filled: bool
) -> None:
    """Draw the path of the centre of mass, and the body at some times (s), filled or as outlines."""
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


def lines_plot(lines: Mapping[str, np.ndarray]) -> Figure:
    """Return lines on the floor, each of shape (k, 2), m, by what they are."""
    figure, (axes,) = panels(3.0)
    for name, points in lines.items():
        axes.plot(*points.T, label=name)
    axes.set_aspect("equal", adjustable="datalim")
    finish(axes, "y (m)", "x (m)", title="")
    axes.legend(fontsize=9, frameon=False)
    return figure
