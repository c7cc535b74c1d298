"""Videos and pictures of the twin as MuJoCo draws it, without a screen.

The camera goes along with the snake and does not sway with its body; videos are MP4 files (H.264, which
every browser plays).
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
from srs_twin.io.files import atomic_write, shown
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.mujoco.canvas import Canvas
from srs_twin.viewing.mujoco.stage import Ghost, Stage
from srs_twin.viewing.plots.signals import gait_period

AddPicture = Callable[[np.ndarray], None]


def encoder() -> Any:
    """Return PyAV, the encoder.

    Raises:
        InputError: it is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise InputError(
            "videos need the encoder PyAV, which is an extra: `uv sync --extra video`, or "
            f"`pip install 'srs-twin[video]'` ({error})"
        ) from error
    return av


@contextmanager
def film(path: Path, *, width: int, height: int, fps: int) -> Iterator[AddPicture]:
    """Give a function that adds a picture; the file is there once the block has ended without an error.

    Args:
        path: of the file, ending in .mp4.
        width: of the pictures, pixels, even.
        height: likewise.
        fps: pictures a second.

    Raises:
        InputError: no encoder, or the file cannot be written.
    """
    av = encoder()
    with atomic_write(path) as part:
        try:
            with av.open(str(part), "w", format="mp4", options={"movflags": "+faststart"}) as container:
                stream = container.add_stream(
                    "libx264", rate=fps, options={"crf": "20", "preset": "veryfast"}
                )
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"

                def add(picture: np.ndarray) -> None:
                    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
                    container.mux(stream.encode(frame))

                yield add
                container.mux(stream.encode(None))
        except av.FFmpegError as error:
            raise InputError(f"{shown(path)}: the video cannot be written ({error})") from error


_STEADY_S = 0.5  # a mean over this much where there is no gait period
_AHEAD_DEG = 25.0  # how far it looks ahead of straight across the snake
_FURTHER = 0.7  # how much further away it is, over how far apart the plants come
_ON_A_BENCH = (-60.0, 2.6)
_ON_THE_FLOOR = (-35.0, 1.7)


class FollowCamera:
    """Looks at the centre of mass from the snake's right, smoothed over a gait period.

    With a ghost it looks at the middle of both, from as far away as they need. What hangs on a bench is
    looked at from above, always at the same place.
    """

    def __init__(
        self, run: Trajectory, body_length: float, *, bench: bool, ghost: Trajectory | None = None
    ) -> None:
        """Prepare for a run.

        Args:
            run: what is seen.
            body_length: of the snake, m; how far away the camera is goes with it.
            bench: whether it hangs at its head.
            ghost: what is seen besides.
        """
        elevation, lengths = _ON_A_BENCH if bench else _ON_THE_FLOOR
        self._at = np.tile(run.position[0].mean(axis=0), (len(run), 1)) if bench else _steady(run)
        distance = lengths * body_length
        if ghost is not None and not bench:
            other = np.column_stack([np.interp(run.time, ghost.time, each) for each in _steady(ghost).T])
            distance += _FURTHER * float(np.linalg.norm(other - self._at, axis=1).max())
            self._at = (self._at + other) / 2
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.azimuth = math.degrees(float(run["heading"][0])) + 90.0 - _AHEAD_DEG
        self._camera.elevation, self._camera.distance = elevation, distance

    def at(self, row: int) -> mujoco.MjvCamera:
        """Return the camera as it stands at a sample."""
        self._camera.lookat = [*self._at[row], 0.0]
        return self._camera


def _steady(run: Trajectory) -> np.ndarray:
    """Return the centre of mass averaged over a gait period around each sample, shape (samples, 2), m."""
    span = gait_period(run) or _STEADY_S
    time, whole = run.time, float(run.time[-1] - run.time[0])
    half = min(span, whole) / 2
    if half <= 0:
        return run.com
    # The integral of the path, so that samples need not be equally spaced.
    steps = np.diff(time)[:, None] * (run.com[1:] + run.com[:-1]) / 2
    area = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    begin, end = np.clip(time - half, time[0], None), np.clip(time + half, None, time[-1])
    mean = [np.interp(end, time, a) - np.interp(begin, time, a) for a in area.T]
    return np.column_stack(mean) / (end - begin)[:, None]


@dataclass(frozen=True)
class Size:
    """Size of a picture, pixels; both even, as video encoders want it."""

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
    progress: Callable[[float], None] = lambda part: None,
) -> int:
    """Write a run as a video in which the camera goes along; return the number of pictures.

    Args:
        path: of the MP4 file.
        scenario: what was run.
        run: what the twin did.
        size: of the pictures.
        fps: pictures a second.
        speed: simulated over shown time: 0.25 is slow motion.
        ghost: another plant, shown see-through.
        progress: called with the part that is done, 0 to 1.

    Raises:
        InputError: nothing to draw, no OpenGL, no encoder, or the file cannot be written.
    """
    encoder()  # before a minute of drawing
    stage, camera = _scene(scenario, run, ghost)
    count = int(stage.duration / speed * fps + 1e-9) + 1
    times = run.time[0] + np.arange(count) * speed / fps
    with (
        Canvas(stage.model, size.width, size.height) as canvas,
        film(path, width=size.width, height=size.height, fps=fps) as add,
    ):
        for k, time in enumerate(times):
            row = stage.row_at(float(time))
            add(stage.picture(canvas, camera.at(row), row))
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
    """Write a picture of a run at a moment as PNG, from where the video's camera is then.

    Args:
        path: of the file.
        scenario: what was run.
        run: what the twin did.
        time: s; the nearest sample is shown.
        size: of the picture.
        ghost: as in `write_video`.

    Raises:
        InputError: the run does not have that moment, or as in `write_video`.
    """
    stage, camera = _scene(scenario, run, ghost)
    first, last = float(run.time[0]), float(run.time[-1])
    if not first - 1e-9 <= time <= last + 1e-9:
        raise InputError(f"t = {time:g} s is not in the run, which goes from {first:g} to {last:g} s")
    with Canvas(stage.model, size.width, size.height) as canvas:
        row = stage.row_at(time)
        picture = stage.picture(canvas, camera.at(row), row)
    write_png(path, picture)


def _scene(scenario: Scenario, run: Trajectory, ghost: Ghost | None) -> tuple[Stage, FollowCamera]:
    stage = Stage(scenario, run, ghost)
    other = None if ghost is None else ghost[1]
    length = scenario.robot.geometry.body_length
    return stage, FollowCamera(run, length, bench=stage.bench, ghost=other)


def write_png(path: Path, picture: np.ndarray) -> None:
    """Write a picture, shape (height, width, 3), bytes.

    Raises:
        InputError: it cannot be written.
    """
    from matplotlib.image import imsave

    with atomic_write(path) as part:
        imsave(part, np.ascontiguousarray(picture), format="png")
