"""`srs-twin render`: a video or a picture of finished runs, drawn by MuJoCo without a screen."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from srs_twin.cli.options import QuietOption, argument, option
from srs_twin.cli.progress import ScenarioProgress
from srs_twin.errors import InputError
from srs_twin.io.files import display_path, escape_unprintable

if TYPE_CHECKING:
    from srs_twin.experiment import FinishedRun
    from srs_twin.viewing.mujoco.render import Size

VIDEO, PICTURE = ".mp4", ".png"
_GHOST = "analytical"
_SMALLEST, _LARGEST = 64, 4096  # pixels


def render(
    runs: Annotated[list[str], argument("RUN")],
    video: Annotated[str | None, option("--video FILE.mp4")] = None,
    image: Annotated[str | None, option("--image t=2.5")] = None,
    strobe: Annotated[bool, option("--strobe")] = False,
    ghost: Annotated[bool, option("--ghost")] = False,
    out: Annotated[str | None, option("--out FILE.png")] = None,
    size: Annotated[str, option("--size WxH")] = "1280x720",
    fps: Annotated[int, option("--fps N", min=1, max=120)] = 30,
    speed: Annotated[float, option("--speed X", min=0.001, max=1000)] = 1.0,
    quiet: QuietOption = False,
) -> None:
    """Draw finished runs with MuJoCo, no screen needed.

    Options:
        runs: Run folders, or names in runs/.
        video: A video; of several runs, their folder.
        image: A picture of that moment, s.
        strobe: A picture from above of several moments.
        ghost: The analytical model as well, see-through.
        out: Where the picture goes; of several runs, a folder. [default: the run's folder]
        size: Pixels; of --strobe the width counts.
        fps: Pictures a second of a video.
        speed: Of a video; 0.25: slow motion.
    """
    if sum((video is not None, image is not None, strobe)) != 1:
        raise InputError("give one of --video FILE.mp4, --image t=2.5 and --strobe")
    if video is not None and out is not None:
        raise InputError("--out is for pictures; the video goes where --video says")
    if ghost and strobe:
        raise InputError("--ghost is for --video and --image")
    from srs_twin.viewing.mujoco.opengl import usable_opengl

    usable_opengl()  # first: MuJoCo, imported from here on, refuses a name in MUJOCO_GL that it does not know
    from srs_twin.experiment import load_run
    from srs_twin.io.files import check_output_folder

    ending, write = _writing(video, image, _size(size), fps, speed)
    suffix = VIDEO if video is not None else PICTURE
    given = video if video is not None else out
    target = None if given is None else Path(given)
    if target is not None and target.suffix == suffix and len(runs) > 1:
        raise InputError(f"{target}: one file for {len(runs)} runs; give a folder")
    if target is not None and target.suffix not in ("", suffix):
        raise InputError(f"{target}: the file must end in {suffix}")
    work: list[tuple[FinishedRun, Path]] = []
    for run in map(load_run, runs):
        one = target is not None and target.suffix
        path = target if target and one else (target or run.folder) / f"{run.name}{ending}"
        work.append((run, path))
    for run, path in work:
        if "twin" not in run.trajectories:
            raise InputError(
                f"{display_path(run.folder)}: the twin did not run, and MuJoCo draws nothing else; "
                "`srs-twin view` shows the analytical model"
            )
        if ghost and _GHOST not in run.trajectories:
            raise InputError(
                f"{display_path(run.folder)}: the analytical model did not run; leave out --ghost"
            )
        check_output_folder(path.parent, (path.name,))
    for run, path in work:
        with ScenarioProgress(run.name, quiet=quiet) as progress:
            told: dict[str, Any] = {"progress": partial(progress, "drawing")} if video is not None else {}
            told |= {"ghost": (_GHOST, run.trajectories[_GHOST])} if ghost else {}
            write(path, run.scenario, run.trajectories["twin"], **told)
        if not quiet:
            typer.echo(escape_unprintable(str(path)))


def _writing(
    video: str | None, image: str | None, size: Size, fps: int, speed: float
) -> tuple[str, Callable[..., object]]:
    """Return how a file's name ends after that of the run, and what writes it; a video takes `progress`."""
    from srs_twin.viewing.mujoco.render import write_image, write_video
    from srs_twin.viewing.mujoco.strobe import write_strobe

    if video is not None:
        return VIDEO, partial(write_video, size=size, fps=fps, speed=speed)
    if image is not None:
        time = _moment(image)
        return f"-{time:g}s{PICTURE}", partial(write_image, time=time, size=size)
    return f"-strobe{PICTURE}", partial(write_strobe, width=size.width)


def _moment(given: str) -> float:
    """Return the time that 't=2.5' or '2.5' means, s."""
    try:
        return float(given.strip().removeprefix("t="))
    except ValueError as error:
        raise InputError(f"--image {given}: not a moment; give seconds, such as t=2.5") from error


def _size(given: str) -> Size:
    from srs_twin.viewing.mujoco.render import Size

    match = re.fullmatch(r"(\d{1,5})[x×](\d{1,5})", given)
    sides = [int(side) for side in match.groups()] if match else []
    if not sides or not all(_SMALLEST <= side <= _LARGEST and side % 2 == 0 for side in sides):
        raise InputError(
            f"--size {given}: give width and height in pixels, such as 1280x720, "
            f"both even and from {_SMALLEST} to {_LARGEST}"
        )
    return Size(*sides)
