"""The stroboscopic figure: a run in one picture from above, the snake at several moments (after Fig. 36)."""

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
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.7, 0.15, 0.35, 0.85  # margins, inches
_FLATTEST, _TALLEST = 5.0, 1.0  # width over height of the floor that is shown
_LINE_PIXELS = 3.0
_MARGIN = 0.35  # of a body length around everything


def write_strobe(path: Path, scenario: Scenario, run: Trajectory, *, width: int = 1280) -> None:
    """Write the stroboscopic figure of a run as PNG.

    MuJoCo draws the snakes without perspective, so that the axes in metres hold everywhere on the floor.

    Args:
        path: of the file.
        scenario: what was run.
        run: what the twin did.
        width: of the whole figure, pixels.

    Raises:
        InputError: nothing to draw, no OpenGL, or the file cannot be written.
    """
    stage = Stage(scenario, run)
    moments = strobe_times({"twin": run}, scenario.robot.geometry)
    rows = [stage.row_at(moment) for moment in moments]
    low, high = _floor(scenario, run)
    across, up = high - low
    inside = width / _DPI - _LEFT - _RIGHT
    tall = inside * up / across
    pixels = 2 * round(inside * _DPI / 2), 2 * round(tall * _DPI / 2)
    picture = _from_above(stage, rows, (low + high) / 2, float(up), pixels)
    figure = Figure(figsize=(width / _DPI, tall + _TOP + _BOTTOM), dpi=_DPI)
    whole = figure.get_size_inches()
    axes = figure.add_axes((_LEFT / whole[0], _BOTTOM / whole[1], inside / whole[0], tall / whole[1]))
    axes.imshow(picture, extent=(low[0], high[0], low[1], high[1]), interpolation="antialiased")
    for moment, row in zip(moments, rows, strict=True):
        x, y = run.com[row]
        reach = run.position[row, :, 1].max() - y + 1.8 * scenario.robot.geometry.half_track
        axes.annotate(f"{moment:.3g} s", (x, y + reach), ha="center", va="bottom", fontsize=8)
    axes.set_xlabel("x (m)", fontsize=9)
    axes.set_ylabel("y (m)", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.set_title(scenario.title, fontsize=9, loc="left", wrap=True)
    _add_key(figure, stage.legend)
    with atomic_write(path) as part:
        figure.savefig(part, dpi=_DPI)


def _floor(scenario: Scenario, run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the floor that is shown, m: all of the run and of the world, not too slim."""
    points = [run.position.reshape(-1, 2)]
    points += [np.array(polygon.corners) for polygon in scenario.world.polygons]
    circles: list[Any] = [*scenario.world.obstacles, *filter(None, [scenario.world.goal])]
    for circle in circles:
        points += [np.array([[circle.x, circle.y]]) + side * circle.radius for side in (-1, 1)]
    every = np.concatenate(points)
    low, high = every.min(axis=0), every.max(axis=0)
    margin = _MARGIN * scenario.robot.geometry.body_length
    low, high = low - margin, high + margin
    size, middle = high - low, (low + high) / 2
    size = np.array([max(size[0], _TALLEST * size[1]), max(size[1], size[0] / _FLATTEST)])
    return middle - size / 2, middle + size / 2


def _from_above(
    stage: Stage, rows: list[int], centre: np.ndarray, height: float, pixels: tuple[int, int]
) -> np.ndarray:
    """Return a picture straight from above without perspective that shows all these samples at once."""
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


def _add_key(figure: Figure, floor_lines: Mapping[str, str]) -> None:
    handles = [
        Line2D([], [], color=STYLES["twin"].color, label="CoM"),
        *(Line2D([], [], color=color, label=name) for name, color in floor_lines.items()),
        Patch(color=PLUS_COLOR, label="$p^+ > p^-$ (left)"),
        Patch(color=MINUS_COLOR, label="$p^+ < p^-$ (right)"),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=8)
