"""The pictures of the front page: an animated plan view, and the scene of a recording beside its signals."""

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
from srs_twin.viewing.plots.from_above import outline, rows_at
from srs_twin.viewing.plots.signals import gait_period, period_speed, pressure_difference, wheel_centres
from srs_twin.viewing.plots.style import MINUS_COLOR, PLUS_COLOR, finish, pressure_colors, style_of

Runs = Mapping[str, Trajectory]

GRID_M = 0.1
_DPI, _WIDE, _KEY = 100, 8.0, 0.66  # inches of the animation, and of the room below the floor
_FRAME_S, _COLORS = 0.08, 96
_INK = "#30333a"


def write_plan_animation(path: Path, runs: Runs, spec: RobotSpec, seconds: float = 7.0) -> None:
    """Write an animated WebP of the plants crawling, seen from above, in real time.

    The view goes along with them. The twin's segments have the colour of their pressure difference; other
    plants are dashed outlines.
    """
    last = min(seconds, *(float(run.time[-1]) for run in runs.values()))
    times = np.arange(0.0, last + 1e-9, _FRAME_S)
    # Fewer colours halve the file.
    first, *others = [
        Image.fromarray(picture).quantize(_COLORS, dither=Image.Dither.NONE).convert("RGB")
        for picture in _frames(runs, spec.geometry, times)
    ]
    duration = [round(1e3 * _FRAME_S)] * len(others) + [1500]  # ms; the end stays for a while
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0, lossless=True, method=4)


def _frames(runs: Runs, geometry: Geometry, times: np.ndarray) -> Iterator[np.ndarray]:
    """Yield pictures (height, width, 3) at some times."""
    coms = np.array([[np.interp(times, r.time, each) for each in r.com.T] for r in runs.values()])
    middle = coms.mean(axis=0)
    across = 2 * float(np.abs(coms - middle)[:, 0].max()) + 1.7 * geometry.body_length
    up = 2 * float(np.abs(coms - middle[:, :1])[:, 1].max()) + 0.75 * geometry.body_length
    half, tall = np.array([-0.5, 0.5]), _WIDE * up / across
    # One scale of colour for the whole run, whichever moments are shown.
    colors = {plant: pressure_colors(pressure_difference(run)) / 255.0 for plant, run in runs.items()}
    for k, time in enumerate(times):
        figure = Figure(figsize=(_WIDE, tall + _KEY), dpi=_DPI)
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0.0, _KEY / (tall + _KEY), 1.0, tall / (tall + _KEY)))
        for index, (plant, run) in enumerate(runs.items()):
            style, (row,) = style_of(plant, index), rows_at(run, [float(time)])
            path = run.com[run.time <= time]
            axes.plot(*path.T, color=style.color, linestyle=style.dash, linewidth=2.0, zorder=1)
            if plant == "twin" or "twin" not in runs:
                _snake(
                    axes,
                    row,
                    geometry,
                    colors[plant][min(np.searchsorted(run.time, time - 1e-9), len(run) - 1)],
                )
            else:
                outline(axes, row, geometry, style, filled=True)
        axes.set(xlim=middle[0, k] + across * half, ylim=middle[1, 0] + up * half)
        _dress(axes, runs, float(time))
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


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


def _dress(axes: Axes, runs: Runs, time: float) -> None:
    """Put floor, ruler, time and names on a picture."""
    axes.set_facecolor("#e9ebee")
    for side in axes.spines.values():
        side.set_visible(False)
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        ticks = np.arange(np.ceil(low / GRID_M), np.floor(high / GRID_M) + 1)
        axis.set_ticks(GRID_M * ticks, labels=[f"{GRID_M * k:.1f} m" if k % 2 == 0 else "" for k in ticks])
    axes.yaxis.set_tick_params(labelleft=False)
    axes.tick_params(length=0, labelsize=12, colors=_INK)
    axes.grid(True, color="white", linewidth=1.4)
    axes.set_axisbelow(True)
    axes.text(0.012, 0.95, f"t = {time:.1f} s", transform=axes.transAxes, va="top", fontsize=15, color=_INK)
    handles: list[Patch | Line2D] = [
        Patch(color=PLUS_COLOR, label="$p^+ > p^-$"),
        Patch(color=MINUS_COLOR, label="$p^+ < p^-$"),
    ]
    for index, plant in enumerate(runs):
        style = style_of(plant, index)
        handles.insert(index, Line2D([], [], **style.line))
    axes.figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=13)


_HERO, _HERO_DPI, _SCENE = (8.5, 4.4), 150, 0.585  # inches, and the scene's share of the width
_PANELS = ((0.755, 0.225), (0.47, 0.225), (0.095, 0.3))  # bottom and height


def hero_figure(scene: bytes, runs: Runs, moment: float) -> Figure:
    """Return the scene of a recording at a moment beside bend, pressure and speed of its plants.

    Args:
        scene: PNG of the 3-D view alone.
        runs: plant → what it did.
        moment: s.
    """
    figure = Figure(figsize=_HERO, dpi=_HERO_DPI)
    picture, shown = figure.add_axes((0.0, 0.0, _SCENE, 1.0)), imread(io.BytesIO(scene))
    cut = max(0, round(len(shown) - shown.shape[1] * _HERO[1] / (_SCENE * _HERO[0]))) // 2
    picture.imshow(shown[cut : len(shown) - cut], aspect="auto")
    picture.axis("off")
    said = f"t = {moment:g} s, grid {GRID_M:g} m"
    picture.text(0.02, 0.97, said, transform=picture.transAxes, va="top", fontsize=11, color=_INK)
    bend, pressure, speed = (figure.add_axes((0.665, low, 0.325, up)) for low, up in _PANELS)
    first = next(iter(runs.values()))
    j, period = len(pressure_difference(first)[0]) // 2, gait_period(first) or 1.0
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
        axes.axvline(moment, color="0.4", linewidth=0.8)
        axes.set_xlim(moment - 2 * period, moment + 2 * period)
        finish(axes, label)
    bend.set_xticklabels([])
    speed.set(xlim=(first.time[0], first.time[-1]), ylim=(0.0, None))
    speed.set_xlabel("time (s)", fontsize=9, labelpad=1)
    speed.legend(loc="lower right", fontsize=9, frameon=False)
    return figure
