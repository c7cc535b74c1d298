"""The picture for the front page: both plants along the first few body lengths of their paths."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from shapely import LineString

from srs_twin.comparison.centre_line import centre_lines
from srs_twin.robot.spec import Geometry, RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.plan_view import APART, bounds, outline, rows_at, strobe_times
from srs_twin.viewing.plots.signals import pressure_difference, wheel_centres
from srs_twin.viewing.plots.style import MINUS_COLOR, PLUS_COLOR, pressure_colors, style_of

_HERO_WIDTH, _LEGEND_HEIGHT = 11.0, 0.35
_HERO_BODIES = 4
_GRID_M = 0.1


def hero_figure(trajectories: Mapping[str, Trajectory], spec: RobotSpec) -> Figure:
    """Return the picture for the front page: a strip along the first few body lengths of the path.

    The twin's segments have the colour of their pressure difference, the analytical model is a dashed
    outline, both at the same moments and on the same scale.
    """
    geometry = spec.geometry
    moments = _moments(trajectories, geometry)
    low, high = bounds(trajectories, geometry, moments)
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


def _moments(trajectories: Mapping[str, Trajectory], geometry: Geometry) -> list[float]:
    """Return the times at which bodies are drawn, up to where four of them have found room, s."""
    run = next(iter(trajectories.values()))
    far = np.hypot(*(run.com - run.com[0]).T) > (_HERO_BODIES - 1) * APART * geometry.body_length
    last = float(run.time[far.argmax()]) if far.any() else float(run.time[-1])
    begun = {
        plant: Trajectory({name: each[each_run.time <= last] for name, each in each_run.columns.items()})
        for plant, each_run in trajectories.items()
    }
    moments = strobe_times(begun, geometry)
    return np.linspace(moments[0], moments[-1], min(len(moments), _HERO_BODIES)).tolist()


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
        Patch(color=PLUS_COLOR, label="$p^+ > p^-$ (bends left)"),
        Patch(color=MINUS_COLOR, label="$p^+ < p^-$ (bends right)"),
        Line2D([], [], marker="o", color="white", markeredgecolor="#30333a", label="head"),
        Patch(facecolor="none", label=f"grid {_GRID_M:g} m"),
    ]
    axes.figure.legend(handles=names, loc="lower center", ncols=len(names), frameon=False, fontsize=8.5)
