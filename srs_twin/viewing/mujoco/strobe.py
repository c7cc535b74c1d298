"""Stroboscopic figure: the snake at several times of a run in one plan view (after Fig. 36)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from srs_twin.io.files import atomic_write
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.mujoco.canvas import Canvas
from srs_twin.viewing.mujoco.stage import Stage
from srs_twin.viewing.plots.from_above import strobe_times
from srs_twin.viewing.plots.style import MINUS_COLOR, PLUS_COLOR, STYLES

_DPI = 150
# Margins of the figure, inches.
_LEFT = 0.7
_RIGHT = 0.15
_TOP = 0.35
_BOTTOM = 0.85

_MAX_ASPECT = 5.0
"""Largest width per height of the drawn floor."""

_MIN_ASPECT = 1.0
_LINE_PIXELS = 3.0
_MARGIN_LENGTHS = 0.35
"""Margin around bodies and obstacles, body lengths."""


def write_strobe(path: Path, scenario: Scenario, run: Trajectory, *, width: int = 1280) -> None:
    """Write the stroboscopic figure of a run as PNG.

    The projection is orthographic, so that the axes in metres hold everywhere on the floor.

    Args:
        path: output file.
        scenario: scenario of the run.
        run: trajectory of the twin.
        width: width of the figure, pixels.

    Raises:
        InputError: there is nothing to draw or no OpenGL, or the file cannot be written.
    """
    stage = Stage(scenario, run)
    times = strobe_times({"twin": run}, scenario.robot.geometry)
    rows = [stage.row_at(time) for time in times]
    low, high = _floor_corners(scenario, run)
    floor_width, floor_height = high - low
    axes_width = width / _DPI - _LEFT - _RIGHT
    axes_height = axes_width * floor_height / floor_width
    pixels = 2 * round(axes_width * _DPI / 2), 2 * round(axes_height * _DPI / 2)
    image = _render_from_above(stage, rows, (low + high) / 2, float(floor_height), pixels)
    figure = Figure(figsize=(width / _DPI, axes_height + _TOP + _BOTTOM), dpi=_DPI)
    size = figure.get_size_inches()
    axes = figure.add_axes((_LEFT / size[0], _BOTTOM / size[1], axes_width / size[0], axes_height / size[1]))
    axes.imshow(image, extent=(low[0], high[0], low[1], high[1]), interpolation="antialiased")
    for time, row in zip(times, rows, strict=True):
        x, y = run.com[row]
        label_offset = run.position[row, :, 1].max() - y + 1.8 * scenario.robot.geometry.half_track
        axes.annotate(f"{time:.3g} s", (x, y + label_offset), ha="center", va="bottom", fontsize=8)
    axes.set_xlabel("x (m)", fontsize=9)
    axes.set_ylabel("y (m)", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.set_title(scenario.title, fontsize=9, loc="left", wrap=True)
    _add_legend(figure, stage.legend)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=_DPI)


def _floor_corners(scenario: Scenario, run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower left and upper right corner of a floor that contains the run and the world, m."""
    points = [run.position.reshape(-1, 2)]
    points += [np.array(polygon.corners) for polygon in scenario.world.polygons]
    if run.has("object_x"):
        points.append(np.stack([run.stack("object_x"), run.stack("object_y")], axis=-1).reshape(-1, 2))
    circles: list[Any] = [*scenario.world.obstacles, *filter(None, [scenario.world.goal])]
    for circle in circles:
        points += [np.array([[circle.x, circle.y]]) + side * circle.radius for side in (-1, 1)]
    corners = np.concatenate(points)
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = _MARGIN_LENGTHS * scenario.robot.geometry.body_length
    low, high = low - margin, high + margin
    size, centre = high - low, (low + high) / 2
    size = np.array([max(size[0], _MIN_ASPECT * size[1]), max(size[1], size[0] / _MAX_ASPECT)])
    return centre - size / 2, centre + size / 2


def _render_from_above(
    stage: Stage, rows: list[int], centre: np.ndarray, height: float, pixels: tuple[int, int]
) -> np.ndarray:
    """Return an orthographic image from above that shows several samples at once.

    Args:
        stage: scene of the run.
        rows: samples to draw.
        centre: centre of the view, m.
        height: height of the view, m.
        pixels: width and height of the image.
    """
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.azimuth, camera.elevation, camera.distance = 90.0, -90.0, 2.0
    camera.lookat, camera.orthographic = [*centre, 0.0], 1
    view = stage.model.vis.global_
    view.orthographic, view.fovy = 1, height
    *earlier, last = rows
    option, moving = mujoco.MjvOption(), mujoco.mjtCatBit.mjCAT_DYNAMIC.value

    def add(scene: mujoco.MjvScene) -> None:
        stage.add_lines(scene, last, _LINE_PIXELS / 2 * height / pixels[1])
        for row in earlier:
            stage.show(row)
            mujoco.mjv_addGeoms(stage.model, stage.data, option, mujoco.MjvPerturb(), moving, scene)

    with Canvas(stage.model, *pixels) as canvas:
        stage.show(last)
        return canvas.draw(stage.data, camera, add)


def _add_legend(figure: Figure, floor_lines: Mapping[str, str]) -> None:
    handles = [
        Line2D([], [], color=STYLES["twin"].color, label="CoM"),
        *(Line2D([], [], color=color, label=name) for name, color in floor_lines.items()),
        Patch(color=PLUS_COLOR, label="$p^+ > p^-$ (left)"),
        Patch(color=MINUS_COLOR, label="$p^+ < p^-$ (right)"),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=8)
