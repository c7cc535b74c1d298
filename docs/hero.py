"""Images of the front page: an animated plan view, and the scene of a recording with its signals."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image
from shapely import LineString

from srs_twin.comparison.centre_line import centre_lines
from srs_twin.robot.spec import Geometry, RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.from_above import draw_body, samples_at
from srs_twin.viewing.plots.signals import (
    gait_period,
    period_speed,
    pressure_difference,
    wheel_centres,
)
from srs_twin.viewing.plots.style import (
    MINUS_COLOR,
    PLUS_COLOR,
    finish,
    pressure_colors,
    style_of,
)

Runs = Mapping[str, Trajectory]

GRID_M = 0.1
_DPI = 100
_WIDTH = 8.0
"""Width of the animation, inches."""

_LEGEND_HEIGHT = 0.66
"""Height of the legend below the floor, inches."""

_FRAME_S = 0.08
_LAST_FRAME_MS = 1500
_COLORS = 96
"""Number of colours of a frame; fewer colours halve the file size."""

_TEXT_COLOR = "#30333a"


def write_plan_animation(
    path: Path, runs: Runs, spec: RobotSpec, seconds: float = 7.0
) -> None:
    """Write an animated WebP in real time: the plants in a plan view that follows them.

    The segments of the twin have the colour of their pressure difference; other plants
    are dashed outlines.
    """
    end = min(seconds, *(float(run.time[-1]) for run in runs.values()))
    times = np.arange(0.0, end + 1e-9, _FRAME_S)
    first, *others = [
        Image.fromarray(frame)
        .quantize(_COLORS, dither=Image.Dither.NONE)
        .convert("RGB")
        for frame in _frames(runs, spec.geometry, times)
    ]
    duration = [round(1e3 * _FRAME_S)] * len(others) + [_LAST_FRAME_MS]
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=duration,
        loop=0,
        lossless=True,
        method=4,
    )


def _frames(runs: Runs, geometry: Geometry, times: np.ndarray) -> Iterator[np.ndarray]:
    """Yield a frame (height, width, 3) at each time."""
    coms = np.array(
        [[np.interp(times, run.time, x) for x in run.com.T] for run in runs.values()]
    )
    centre = coms.mean(axis=0)
    floor_width = (
        2 * float(np.abs(coms - centre)[:, 0].max()) + 1.7 * geometry.body_length
    )
    floor_height = (
        2 * float(np.abs(coms - centre[:, :1])[:, 1].max())
        + 0.75 * geometry.body_length
    )
    half = np.array([-0.5, 0.5])
    height = _WIDTH * floor_height / floor_width
    # The colour scale covers the whole run, so that it does not depend on the drawn
    # times.
    colors = {
        plant: pressure_colors(pressure_difference(run)) / 255.0
        for plant, run in runs.items()
    }
    total = height + _LEGEND_HEIGHT
    for k, time in enumerate(times):
        figure = Figure(figsize=(_WIDTH, total), dpi=_DPI)
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0.0, _LEGEND_HEIGHT / total, 1.0, height / total))
        for index, (plant, run) in enumerate(runs.items()):
            style, (row,) = style_of(plant, index), samples_at(run, [float(time)])
            path = run.com[run.time <= time]
            axes.plot(
                *path.T,
                color=style.color,
                linestyle=style.dash,
                linewidth=2.0,
                zorder=1,
            )
            if plant == "twin" or "twin" not in runs:
                sample = min(np.searchsorted(run.time, time - 1e-9), len(run) - 1)
                _draw_snake(axes, row, geometry, colors[plant][sample])
            else:
                draw_body(axes, row, geometry, style, filled=True)
        axes.set(
            xlim=centre[0, k] + floor_width * half,
            ylim=centre[1, 0] + floor_height * half,
        )
        _add_annotations(axes, runs, float(time))
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_snake(
    axes: Axes, sample: Trajectory, geometry: Geometry, colors: np.ndarray
) -> None:
    """Draw wheels, connectors and segments; colors: of the segments, (segments, 4)."""
    theta = sample.stack("connector_heading")[0]
    along = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    left = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    wheels = wheel_centres(sample, geometry)[0].reshape(-1, 2)
    wheel_axes = np.repeat(along, 2, axis=0), np.repeat(left, 2, axis=0)
    radius = geometry.wheel_radius
    connectors = _boxes(
        sample.position[0], along, left, 0.18 * radius, geometry.half_track
    )
    axes.add_collection(PolyCollection(connectors, facecolors="#464a52", zorder=2))
    axes.add_collection(
        PolyCollection(
            _boxes(wheels, *wheel_axes, radius, 0.25 * radius),
            facecolors="#1c1e22",
            zorder=2,
        )
    )
    for line, color in zip(centre_lines(sample, geometry)[0], colors, strict=True):
        tube = LineString(line).buffer(geometry.width / 2, cap_style="flat")
        axes.fill(
            *np.asarray(tube.exterior.coords).T,
            facecolor=color,
            edgecolor="#30333a",
            linewidth=0.6,
            zorder=4,
        )
    axes.plot(
        *sample.position[0, 0],
        "o",
        color="white",
        markeredgecolor="#30333a",
        markersize=4.5,
        zorder=4,
    )


def _boxes(
    centre: np.ndarray,
    along: np.ndarray,
    left: np.ndarray,
    half_length: float,
    half_width: float,
) -> list[np.ndarray]:
    """Return rectangles, each (4, 2), from centres and axes, each (n, 2)."""
    corners = [(1, 1), (1, -1), (-1, -1), (-1, 1)]
    return [
        np.array(
            [c + a * half_length * forward + b * half_width * side for a, b in corners]
        )
        for c, forward, side in zip(centre, along, left, strict=True)
    ]


def _add_annotations(axes: Axes, runs: Runs, time: float) -> None:
    """Add floor, grid, time and legend to a frame."""
    axes.set_facecolor("#e9ebee")
    for side in axes.spines.values():
        side.set_visible(False)
    for axis, (low, high) in (
        (axes.xaxis, axes.get_xlim()),
        (axes.yaxis, axes.get_ylim()),
    ):
        ticks = np.arange(np.ceil(low / GRID_M), np.floor(high / GRID_M) + 1)
        axis.set_ticks(
            GRID_M * ticks,
            labels=[f"{GRID_M * k:.1f} m" if k % 2 == 0 else "" for k in ticks],
        )
    axes.yaxis.set_tick_params(labelleft=False)
    axes.tick_params(length=0, labelsize=12, colors=_TEXT_COLOR)
    axes.grid(True, color="white", linewidth=1.4)
    axes.set_axisbelow(True)
    axes.text(
        0.012,
        0.95,
        f"t = {time:.1f} s",
        transform=axes.transAxes,
        va="top",
        fontsize=15,
        color=_TEXT_COLOR,
    )
    handles: list[Patch | Line2D] = [
        Patch(color=PLUS_COLOR, label="$p^+ > p^-$"),
        Patch(color=MINUS_COLOR, label="$p^+ < p^-$"),
    ]
    for index, plant in enumerate(runs):
        style = style_of(plant, index)
        handles.insert(index, Line2D([], [], **style.line))
    axes.figure.legend(
        handles=handles,
        loc="lower center",
        ncols=len(handles),
        frameon=False,
        fontsize=13,
    )


_HERO_SIZE = (8.5, 4.4)
"""Width and height of the figure, inches."""

_HERO_DPI = 150
_SCENE_WIDTH = 0.585
"""Width of the scene relative to the figure."""

_PANELS = ((0.755, 0.225), (0.47, 0.225), (0.095, 0.3))
"""Bottom and height of the panels relative to the figure, top first."""


def hero_figure(scene: bytes, runs: Runs, time: float) -> Figure:
    """Return a figure with the scene of a recording, and bend, pressure and speed of its plants.

    Args:
        scene: PNG of the 3-D view.
        runs: plant → trajectory.
        time: time of the scene, s.
    """
    figure = Figure(figsize=_HERO_SIZE, dpi=_HERO_DPI)
    scene_axes = figure.add_axes((0.0, 0.0, _SCENE_WIDTH, 1.0))
    image = imread(io.BytesIO(scene))
    cropped = (
        max(
            0,
            round(
                len(image)
                - image.shape[1] * _HERO_SIZE[1] / (_SCENE_WIDTH * _HERO_SIZE[0])
            ),
        )
        // 2
    )
    scene_axes.imshow(image[cropped : len(image) - cropped], aspect="auto")
    scene_axes.axis("off")
    caption = f"t = {time:g} s, grid {GRID_M:g} m"
    scene_axes.text(
        0.02,
        0.97,
        caption,
        transform=scene_axes.transAxes,
        va="top",
        fontsize=11,
        color=_TEXT_COLOR,
    )
    bend, pressure, speed = (
        figure.add_axes((0.665, bottom, 0.325, height)) for bottom, height in _PANELS
    )
    first = next(iter(runs.values()))
    j = len(pressure_difference(first)[0]) // 2
    period = gait_period(first) or 1.0
    for index, (plant, run) in enumerate(runs.items()):
        line = style_of(plant, index).line | {"zorder": style_of(plant, index).zorder}
        bend.plot(run.time, run.stack("bend")[:, j], **line)
        pressure.plot(run.time, 1e-3 * pressure_difference(run)[:, j], **line)
        speed.plot(*period_speed(run, period), **line)
    for axes, label in (
        (bend, f"bend {j + 1} (rad)"),
        (pressure, "$p^+ - p^-$ (kPa)"),
        (speed, "speed (m/s)"),
    ):
        axes.axvline(time, color="0.4", linewidth=0.8)
        axes.set_xlim(time - 2 * period, time + 2 * period)
        finish(axes, label)
    bend.set_xticklabels([])
    speed.set(xlim=(first.time[0], first.time[-1]), ylim=(0.0, None))
    speed.set_xlabel("time (s)", fontsize=9, labelpad=1)
    speed.legend(loc="lower right", fontsize=9, frameon=False)
    return figure
