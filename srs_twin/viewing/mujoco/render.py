"""Videos, images and stroboscopic figures of the twin, rendered off screen by MuJoCo.

A stroboscopic figure is a plan view that shows the snake at several times of a run, as
in Fig. 36 of the dissertation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import mujoco
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from srs_twin.errors import InputError, WriteError
from srs_twin.io.files import atomic_write, display_path
from srs_twin.robot.world import Circle, Goal
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.mujoco.canvas import Canvas
from srs_twin.viewing.mujoco.stage import Ghost, Stage
from srs_twin.viewing.plots.from_above import strobe_times
from srs_twin.viewing.plots.signals import gait_period
from srs_twin.viewing.plots.style import (
    MINUS_COLOR,
    PLUS_COLOR,
    STYLES,
    add_legend,
    drawing,
)

AddFrame = Callable[[np.ndarray], None]


def encoder() -> ModuleType:
    """Import and return the video encoder PyAV."""
    try:
        import av
    except ImportError as error:
        raise InputError(
            "videos need the encoder PyAV; install the extra with `uv sync --extra"
            f" video`, or `pip install 'srs-twin[video]'` ({error})"
        ) from error
    return av


@contextmanager
def video_writer(
    path: Path, *, width: int, height: int, fps: int
) -> Iterator[AddFrame]:
    """Open an MP4 file and yield a function that appends a frame.

    Frames have shape (height, width, 3) and type uint8, with even height and width.
    """
    av = encoder()
    with atomic_write(path) as temporary:
        try:
            with av.open(
                str(temporary), "w", format="mp4", options={"movflags": "+faststart"}
            ) as container:
                stream = container.add_stream(
                    "libx264", rate=fps, options={"crf": "20", "preset": "veryfast"}
                )
                stream.width = width
                stream.height = height
                stream.pix_fmt = "yuv420p"

                def add(pixels: np.ndarray) -> None:
                    frame = av.VideoFrame.from_ndarray(
                        np.ascontiguousarray(pixels), format="rgb24"
                    )
                    container.mux(stream.encode(frame))

                yield add
                container.mux(stream.encode(None))
        except av.FFmpegError as error:
            raise WriteError(
                f"{display_path(path)}: the video cannot be written ({error})"
            ) from error


_SMOOTHING_S = 0.5
"""Averaging time for the camera path in runs without a gait, s."""

_FORWARD_DEG = 25.0
"""Angle by which the camera is turned from a side view towards a rear view, degrees.
"""

_DISTANCE_PER_SEPARATION = 0.7
"""Ratio of the additional camera distance to the distance between the plants."""

_ELEVATION_DEG = {"bench": -60.0, "floor": -35.0}
_DISTANCE_LENGTHS = {"bench": 2.6, "floor": 1.7}
"""Camera distance, in body lengths."""


class FollowCamera:
    """Camera that follows the centre of mass of a snake and views it from the right.

    The path of the centre of mass is averaged over one gait period. If there is a
    ghost, the camera follows the midpoint between twin and ghost and keeps both in
    view. On a bench, a fixed camera views the snake obliquely from above.
    """

    def __init__(
        self,
        run: Trajectory,
        body_length: float,
        *,
        bench: bool,
        ghost: Trajectory | None = None,
    ) -> None:
        setup = "bench" if bench else "floor"
        distance = _DISTANCE_LENGTHS[setup] * body_length
        if bench:
            self._target = np.tile(run.position[0].mean(axis=0), (len(run), 1))
        else:
            self._target = _smooth_path(run)
        if ghost is not None and not bench:
            path = _smooth_path(ghost)
            other = np.column_stack(
                [np.interp(run.time, ghost.time, coordinate) for coordinate in path.T]
            )
            separation = float(np.linalg.norm(other - self._target, axis=1).max())
            distance += _DISTANCE_PER_SEPARATION * separation
            self._target = (self._target + other) / 2
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.azimuth = (
            math.degrees(float(run["heading"][0])) + 90.0 - _FORWARD_DEG
        )
        self._camera.elevation = _ELEVATION_DEG[setup]
        self._camera.distance = distance

    def at(self, row: int) -> mujoco.MjvCamera:
        """Return the camera for the sample with index `row`."""
        self._camera.lookat = [*self._target[row], 0.0]
        return self._camera


def _smooth_path(run: Trajectory) -> np.ndarray:
    window = gait_period(run) or _SMOOTHING_S
    time = run.time
    duration = float(run.time[-1] - run.time[0])
    half = min(window, duration) / 2
    if half <= 0:
        return run.com
    # The moving average is computed from the integral of the path, because the samples
    # may be unequally spaced.
    steps = np.diff(time)[:, None] * (run.com[1:] + run.com[:-1]) / 2
    integral = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    begin = np.clip(time - half, time[0], None)
    end = np.clip(time + half, None, time[-1])
    mean = [np.interp(end, time, a) - np.interp(begin, time, a) for a in integral.T]
    return np.column_stack(mean) / (end - begin)[:, None]


class Size(NamedTuple):
    """Width and height of an image in pixels, which must be even for videos."""

    width: int = 1280
    height: int = 720


def write_video(
    path: Path,
    scenario: Scenario,
    run: Trajectory,
    *,
    size: Size = Size(),  # noqa: B008 (frozen)
    fps: int = 30,
    speed: float = 1.0,
    ghost: Ghost | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> int:
    """Write a video of a run and return the number of frames.

    Args:
        path: path of the MP4 file.
        scenario: simulated scenario.
        run: trajectory of the twin.
        size: frame size.
        fps: frame rate, Hz.
        speed: ratio of simulated time to playback time, less than 1 for slow motion.
        ghost: name and trajectory of a plant that is drawn translucent, or None.
        progress: callback that receives the completed fraction, from 0 to 1.
    """
    encoder()  # report a missing encoder before the frames are rendered
    stage, camera = _scene(scenario, run, ghost)
    duration = float(run.time[-1] - run.time[0])
    count = int(duration / speed * fps + 1e-9) + 1
    times = run.time[0] + np.arange(count) * speed / fps
    with (
        Canvas(stage.model, *size) as canvas,
        video_writer(path, width=size.width, height=size.height, fps=fps) as add,
    ):
        for k, time in enumerate(times):
            row = stage.row_at(float(time))
            add(stage.render(canvas, camera.at(row), row))
            progress((k + 1) / count)
    return count


def write_image(
    path: Path,
    scenario: Scenario,
    run: Trajectory,
    time: float,
    *,
    size: Size = Size(),  # noqa: B008
    ghost: Ghost | None = None,
) -> None:
    """Write a PNG image of a run from the camera position used in videos.

    Args:
        path: path of the PNG file.
        scenario: simulated scenario.
        run: trajectory of the twin.
        time: time of the image, s, which is rounded to the nearest sample.
        size: image size.
        ghost: name and trajectory of a plant that is drawn translucent, or None.
    """
    stage, camera = _scene(scenario, run, ghost)
    first = float(run.time[0])
    last = float(run.time[-1])
    if not first - 1e-9 <= time <= last + 1e-9:
        raise InputError(
            f"t = {time:g} s is outside the run; choose a time from {first:g} to"
            f" {last:g} s"
        )
    with Canvas(stage.model, *size) as canvas:
        row = stage.row_at(time)
        pixels = stage.render(canvas, camera.at(row), row)
    write_png(path, pixels)


def _scene(
    scenario: Scenario, run: Trajectory, ghost: Ghost | None
) -> tuple[Stage, FollowCamera]:
    stage = Stage(scenario, run, ghost)
    _, other = ghost or (None, None)
    length = scenario.robot.geometry.body_length
    return stage, FollowCamera(run, length, bench=stage.bench, ghost=other)


@drawing
def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write an image, shape (height, width, 3), uint8, to a PNG file."""
    from matplotlib.image import imsave

    with atomic_write(path) as temporary:
        imsave(temporary, np.ascontiguousarray(pixels), format="png")


_DPI = 150
# Margins of the figure, inches.
_LEFT = 0.7
_RIGHT = 0.15
_TOP = 0.35
_BOTTOM = 0.85

_MAX_ASPECT = 5.0
"""Maximum width-to-height ratio of the drawn floor."""

_MIN_ASPECT = 1.0
_LINE_PIXELS = 3.0
_MARGIN_LENGTHS = 0.35
"""Margin around bodies and obstacles, in body lengths."""


@drawing
def write_strobe(
    path: Path, scenario: Scenario, run: Trajectory, *, width: int = 1280
) -> None:
    """Write a stroboscopic figure of a run as a PNG file, `width` pixels wide.

    The projection is orthographic, so that positions on the floor can be read from the
    axes (m).
    """
    stage = Stage(scenario, run)
    times = strobe_times({"twin": run}, scenario.robot.geometry)
    rows = [stage.row_at(time) for time in times]
    low, high = _floor_corners(scenario, run)
    floor_width, floor_height = high - low
    axes_width = width / _DPI - _LEFT - _RIGHT
    axes_height = axes_width * floor_height / floor_width
    size = Size(2 * round(axes_width * _DPI / 2), 2 * round(axes_height * _DPI / 2))
    image = _render_from_above(stage, rows, (low + high) / 2, float(floor_height), size)
    figure = Figure(figsize=(width / _DPI, axes_height + _TOP + _BOTTOM), dpi=_DPI)
    inches = figure.get_size_inches()
    left, right = np.array([_LEFT, axes_width]) / inches[0]
    bottom, top = np.array([_BOTTOM, axes_height]) / inches[1]
    axes = figure.add_axes((left, bottom, right, top))
    extent = (low[0], high[0], low[1], high[1])
    axes.imshow(image, extent=extent, interpolation="antialiased")
    above = 1.8 * scenario.robot.geometry.half_track
    for time, row in zip(times, rows, strict=True):
        place = (run.com[row, 0], run.position[row, :, 1].max() + above)
        axes.annotate(f"{time:.3g} s", place, ha="center", va="bottom", fontsize=8)
    axes.set_xlabel("x (m)", fontsize=9)
    axes.set_ylabel("y (m)", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.set_title(scenario.title, fontsize=9, loc="left", wrap=True)
    _add_legend(figure, stage.legend)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=_DPI)


def _floor_corners(
    scenario: Scenario, run: Trajectory
) -> tuple[np.ndarray, np.ndarray]:
    world = scenario.world
    points = [run.position.reshape(-1, 2)]
    points += [np.array(polygon.corners) for polygon in world.polygons]
    if run.has("object_x"):
        objects = np.stack([run.stack("object_x"), run.stack("object_y")], axis=-1)
        points.append(objects.reshape(-1, 2))
    circles: list[Circle | Goal] = [*world.obstacles]
    if world.goal is not None:
        circles.append(world.goal)
    for circle in circles:
        centre = np.array([[circle.x, circle.y]])
        points += [centre - circle.radius, centre + circle.radius]
    corners = np.concatenate(points)
    margin = _MARGIN_LENGTHS * scenario.robot.geometry.body_length
    low = corners.min(axis=0) - margin
    high = corners.max(axis=0) + margin
    width, height = high - low
    size = np.array(
        [max(width, _MIN_ASPECT * height), max(height, width / _MAX_ASPECT)]
    )
    middle = (low + high) / 2
    return middle - size / 2, middle + size / 2


def _render_from_above(
    stage: Stage,
    rows: list[int],
    centre: np.ndarray,
    height: float,
    size: Size,
) -> np.ndarray:
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.azimuth = 90.0
    camera.elevation = -90.0
    camera.distance = 2.0
    camera.lookat = [*centre, 0.0]
    camera.orthographic = 1
    view = stage.model.vis.global_
    view.orthographic = 1
    view.fovy = height
    *earlier, last = rows
    option = mujoco.MjvOption()
    moving = mujoco.mjtCatBit.mjCAT_DYNAMIC.value

    def add(scene: mujoco.MjvScene) -> None:
        stage.add_lines(scene, last, _LINE_PIXELS / 2 * height / size.height)
        for row in earlier:
            stage.show(row)
            mujoco.mjv_addGeoms(
                stage.model, stage.data, option, mujoco.MjvPerturb(), moving, scene
            )

    with Canvas(stage.model, *size) as canvas:
        stage.show(last)
        return canvas.draw(stage.data, camera, add)


def _add_legend(figure: Figure, floor_lines: Mapping[str, str]) -> None:
    lines = {"CoM": STYLES["twin"].color, **floor_lines}
    handles = [
        *(Line2D([], [], color=color, label=name) for name, color in lines.items()),
        Patch(color=PLUS_COLOR, label="$p^+ > p^-$ (left)"),
        Patch(color=MINUS_COLOR, label="$p^+ < p^-$ (right)"),
    ]
    add_legend(figure, "lower center", handles=handles, ncols=len(handles))
