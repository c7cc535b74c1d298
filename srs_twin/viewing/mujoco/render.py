"""Off-screen videos and images of the twin, rendered by MuJoCo.

The camera follows the period-averaged path of the snake. Videos are MP4 files with the codec H.264, which all
browsers support.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write, display_path
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.mujoco.canvas import Canvas
from srs_twin.viewing.mujoco.stage import Ghost, Stage
from srs_twin.viewing.plots.signals import gait_period

AddFrame = Callable[[np.ndarray], None]


def encoder() -> Any:
    """Return the module `av` (PyAV), the video encoder.

    Raises:
        InputError: PyAV is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise InputError(
            "videos need the encoder PyAV; install the extra with `uv sync --extra video`, or "
            f"`pip install 'srs-twin[video]'` ({error})"
        ) from error
    return av


@contextmanager
def video_writer(path: Path, *, width: int, height: int, fps: int) -> Iterator[AddFrame]:
    """Yield a function that appends a frame, shape (height, width, 3), bytes; the file is written atomically.

    Args:
        path: output file, ending in .mp4.
        width: width of the frames, pixels; even.
        height: height of the frames, pixels; even.
        fps: frame rate, Hz.

    Raises:
        InputError: there is no encoder, or the file cannot be written.
    """
    av = encoder()
    with atomic_write(path) as temporary:
        try:
            with av.open(str(temporary), "w", format="mp4", options={"movflags": "+faststart"}) as container:
                stream = container.add_stream(
                    "libx264", rate=fps, options={"crf": "20", "preset": "veryfast"}
                )
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"

                def add(pixels: np.ndarray) -> None:
                    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
                    container.mux(stream.encode(frame))

                yield add
                container.mux(stream.encode(None))
        except av.FFmpegError as error:
            raise InputError(f"{display_path(path)}: the video cannot be written ({error})") from error


_SMOOTHING_S = 0.5
"""Averaging time of the camera path without a gait, s."""

_FORWARD_DEG = 25.0
"""Rotation of the view towards the direction of motion, degrees; 0 looks across the snake."""

_DISTANCE_PER_SEPARATION = 0.7
"""Additional camera distance, relative to the largest distance of the plants from the centre of the view."""

_ELEVATION_DEG = {"bench": -60.0, "floor": -35.0}
_DISTANCE_LENGTHS = {"bench": 2.6, "floor": 1.7}
"""Camera distance in body lengths."""


class FollowCamera:
    """Camera on the right of the snake that follows its centre of mass, averaged over a gait period.

    With a ghost, the camera follows the midpoint of both bodies, at a distance that shows both. A snake on a
    bench is viewed from above by a fixed camera.
    """

    def __init__(
        self, run: Trajectory, body_length: float, *, bench: bool, ghost: Trajectory | None = None
    ) -> None:
        """Compute the camera path of a run.

        Args:
            run: trajectory of the twin.
            body_length: length of the body, m; scales the camera distance.
            bench: whether the head is clamped.
            ghost: trajectory of another plant.
        """
        setup = "bench" if bench else "floor"
        self._target = np.tile(run.position[0].mean(axis=0), (len(run), 1)) if bench else _smooth_path(run)
        distance = _DISTANCE_LENGTHS[setup] * body_length
        if ghost is not None and not bench:
            path = _smooth_path(ghost)
            other = np.column_stack([np.interp(run.time, ghost.time, coordinate) for coordinate in path.T])
            separation = float(np.linalg.norm(other - self._target, axis=1).max())
            distance += _DISTANCE_PER_SEPARATION * separation
            self._target = (self._target + other) / 2
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.azimuth = math.degrees(float(run["heading"][0])) + 90.0 - _FORWARD_DEG
        self._camera.elevation, self._camera.distance = _ELEVATION_DEG[setup], distance

    def at(self, row: int) -> mujoco.MjvCamera:
        """Return the camera at a sample."""
        self._camera.lookat = [*self._target[row], 0.0]
        return self._camera


def _smooth_path(run: Trajectory) -> np.ndarray:
    """Return the centre of mass averaged over a gait period around each sample, shape (samples, 2), m."""
    window = gait_period(run) or _SMOOTHING_S
    time, duration = run.time, float(run.time[-1] - run.time[0])
    half = min(window, duration) / 2
    if half <= 0:
        return run.com
    # Compute the mean from the integral of the path, because samples may not be equally spaced.
    steps = np.diff(time)[:, None] * (run.com[1:] + run.com[:-1]) / 2
    integral = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    begin, end = np.clip(time - half, time[0], None), np.clip(time + half, None, time[-1])
    mean = [np.interp(end, time, a) - np.interp(begin, time, a) for a in integral.T]
    return np.column_stack(mean) / (end - begin)[:, None]


@dataclass(frozen=True)
class Size:
    """Size of an image, pixels; both sides even, as video encoders require."""

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
    """Write a run as a video; return the number of frames.

    Args:
        path: MP4 file.
        scenario: scenario of the run.
        run: trajectory of the twin.
        size: size of the frames.
        fps: frame rate, Hz.
        speed: simulated time per playback time; 0.25 is slow motion.
        ghost: another plant, drawn translucently.
        progress: callback with the completed fraction, 0 to 1.

    Raises:
        InputError: there is nothing to draw, no OpenGL or no encoder, or the file cannot be written.
    """
    encoder()  # report a missing encoder before the frames are rendered
    stage, camera = _scene(scenario, run, ghost)
    count = int(stage.duration / speed * fps + 1e-9) + 1
    times = run.time[0] + np.arange(count) * speed / fps
    with (
        Canvas(stage.model, size.width, size.height) as canvas,
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
    """Write an image of a run at a given time as PNG, with the camera of the video.

    Args:
        path: output file.
        scenario: scenario of the run.
        run: trajectory of the twin.
        time: time, s; the nearest sample is drawn.
        size: size of the image.
        ghost: another plant, drawn translucently.

    Raises:
        InputError: the time is outside the run, or as in `write_video`.
    """
    stage, camera = _scene(scenario, run, ghost)
    first, last = float(run.time[0]), float(run.time[-1])
    if not first - 1e-9 <= time <= last + 1e-9:
        raise InputError(f"t = {time:g} s is outside the run, which lasts from {first:g} to {last:g} s")
    with Canvas(stage.model, size.width, size.height) as canvas:
        row = stage.row_at(time)
        pixels = stage.render(canvas, camera.at(row), row)
    write_png(path, pixels)


def _scene(scenario: Scenario, run: Trajectory, ghost: Ghost | None) -> tuple[Stage, FollowCamera]:
    stage = Stage(scenario, run, ghost)
    other = None if ghost is None else ghost[1]
    length = scenario.robot.geometry.body_length
    return stage, FollowCamera(run, length, bench=stage.bench, ghost=other)


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write an image, shape (height, width, 3), bytes.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.image import imsave

    with atomic_write(path) as temporary:
        imsave(temporary, np.ascontiguousarray(pixels), format="png")
