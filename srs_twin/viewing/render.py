"""Render: videos and pictures of the twin as MuJoCo draws it, without a screen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from srs_twin.errors import InputError
from srs_twin.files import atomic_write
from srs_twin.scenario import Scenario
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.canvas import Canvas
from srs_twin.viewing.film import encoder, film
from srs_twin.viewing.follow_camera import FollowCamera
from srs_twin.viewing.stage import Stage


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
        progress: called with the part that is done, 0 to 1.

    Raises:
        InputError: nothing to draw, no OpenGL, no encoder, or the file cannot be written.
    """
    encoder()  # before a minute of drawing
    stage = Stage(scenario, run)
    camera = FollowCamera(run, scenario.robot.geometry.body_length, bench=stage.bench)
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
) -> None:
    """Write a picture of a run at a moment as PNG, from where the video's camera is then.

    Args:
        path: of the file.
        scenario: what was run.
        run: what the twin did.
        time: s; the nearest sample is shown.
        size: of the picture.

    Raises:
        InputError: the run does not have that moment, or as in `write_video`.
    """
    stage = Stage(scenario, run)
    first, last = float(run.time[0]), float(run.time[-1])
    if not first - 1e-9 <= time <= last + 1e-9:
        raise InputError(f"t = {time:g} s is not in the run, which goes from {first:g} to {last:g} s")
    camera = FollowCamera(run, scenario.robot.geometry.body_length, bench=stage.bench)
    with Canvas(stage.model, size.width, size.height) as canvas:
        row = stage.row_at(time)
        picture = stage.picture(canvas, camera.at(row), row)
    write_png(path, picture)


def write_png(path: Path, picture: np.ndarray) -> None:
    """Write a picture, shape (height, width, 3), bytes.

    Raises:
        InputError: it cannot be written.
    """
    from matplotlib.image import imsave

    with atomic_write(path) as part:
        imsave(part, np.ascontiguousarray(picture), format="png")
