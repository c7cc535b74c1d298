"""Commands `srs-twin view`, `play` and `render`."""

from __future__ import annotations

import os
import re
import signal
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.catalogue import is_robot
from srs_twin.cli.console import ScenarioProgress, handle_signals, say
from srs_twin.cli.options import ChangeOptions, OptionRange, QuietOption, argument
from srs_twin.errors import InputError
from srs_twin.io.files import display_path, escape_unprintable

if TYPE_CHECKING:
    from srs_twin.experiment import FinishedRun
    from srs_twin.io.documents import Override
    from srs_twin.robot.spec import RobotSpec
    from srs_twin.scenario.modified import Changes
    from srs_twin.trajectory import Trajectory
    from srs_twin.viewing.mujoco.render import Size


def view(
    runs: Annotated[list[str], argument("RUN")],
    web: bool = False,
    port: Annotated[int | None, OptionRange(1, 65535)] = None,
) -> None:
    """Open the recordings of finished runs in the Rerun viewer.

    Options:
        runs: Folders of runs, names of folders in runs/, or recordings (.rrd). Several
            runs are shown side by side.
        --web: Serve the viewer to a browser on this machine until you press Ctrl-C.
        --port N: TCP port of the page in the browser. [default: any free port]
    """
    recordings = [find_recording(run) for run in runs]
    if port is not None and not web:
        raise InputError("--port requires --web; add --web or remove --port")
    with tempfile.TemporaryDirectory(prefix="srs-twin-view-") as folder:
        recording = recordings[0]
        if len(recordings) > 1:
            from srs_twin.viewing.rerun.viewer import require_rerun

            require_rerun()
            from srs_twin.viewing.rerun.recording import write_side_by_side

            recording = Path(folder) / "side-by-side.rrd"
            write_side_by_side(recording, name_recordings(recordings))
        if web:
            _serve(recording, port or 0)
        else:
            from srs_twin.viewing.rerun.viewer import open_recording

            open_recording(recording)


def _serve(recording: Path, port: int) -> None:
    from srs_twin.viewing.rerun.viewer import serve_recordings

    handle_signals(signal.default_int_handler, signal.SIGINT, signal.SIGTERM)
    try:
        with serve_recordings([recording], port) as (address, serve):
            typer.echo(address)
            say("open this address in a browser; press Ctrl-C to stop")
            serve()
    except KeyboardInterrupt:
        return


def find_recording(run: str) -> Path:
    """Return the path of a recording, given its path, a run folder or a run name.

    Raises:
        InputError: no recording was found, or the file is not a recording.
    """
    candidates = [
        Path(run),
        Path(run) / "recording.rrd",
        Path("runs") / run / "recording.rrd",
    ]
    for path in candidates:
        if os.path.isfile(path):
            if path.suffix != ".rrd":
                raise InputError(
                    f"{path}: this is not a recording; give a run folder or a file"
                    " that ends in .rrd"
                )
            return path
    searched = ", ".join(str(path) for path in candidates[1:])
    raise InputError(
        f"{run}: no recording was found (looked for {searched}); run `srs-twin run"
        " SCENARIO` to write a recording"
    )


def name_recordings(recordings: Sequence[Path]) -> dict[str, Path]:
    """Return the recordings, keyed by unique names.

    Each name consists of the last parts of the path, as few as necessary.

    Raises:
        InputError: a recording is given twice.
    """
    paths = [path.resolve() for path in recordings]
    paths = [path.parent if path.name == "recording.rrd" else path for path in paths]
    if len(set(paths)) < len(paths):
        duplicate = next(path for path in paths if paths.count(path) > 1)
        raise InputError(
            f"{duplicate}: this recording is given twice; give each recording once"
        )
    count = 1
    while len({path.parts[-count:] for path in paths}) < len(paths):
        count += 1
    return dict(
        zip(("/".join(path.parts[-count:]) for path in paths), recordings, strict=True)
    )


def play(
    name: Annotated[str, argument("SCENARIO|ROBOT", shipped=["scenario", "robot"])],
    set_: list[str] | None = None,
) -> None:
    """Play a scenario or steer a robot in MuJoCo's viewer.

    The left and right keys change the steering offset of the gait, and the home key
    resets the offset. The up and down keys change the gait frequency, and the page up
    and page down keys change the supply pressure. The space key pauses the simulation,
    and the backspace key restarts it. The controller of a scenario acts until you
    change the offset, the frequency or the pressure.

    Options:
        name: Name of a shipped scenario or robot, or path of a scenario or robot file.
        --set FIELD=VALUE: Override one field, for example robot.friction.mu_t=0.1. Can
            be repeated.
    """
    from srs_twin.scenario.modified import changes_text

    overrides = ChangeOptions(set_).changes()
    scenario = None
    robot = None
    if is_robot(name):
        robot, changes = _changed_robot(name, overrides)
    else:
        from srs_twin.scenario.loading import load_scenario

        scenario = load_scenario(name, set=overrides)
        changes = scenario.changes
    from srs_twin.viewing.mujoco.live import MujocoWindow, require_display

    require_display()
    from srs_twin.viewing.mujoco.live import LiveSnake, steer

    # MuJoCo's viewer displays only ASCII characters.
    snake = LiveSnake(
        robot, scenario=scenario, modified=changes_text(changes).replace("→", "to")
    )
    with MujocoWindow(snake) as window:
        steer(snake, window)


def _changed_robot(
    name: str, overrides: Sequence[Override]
) -> tuple[RobotSpec, Changes]:
    from srs_twin.io.documents import Document
    from srs_twin.robot.file import load_robot_file, robot_in
    from srs_twin.scenario.modified import changed_fields

    document = Document(name, {"robot": name})
    for override in overrides:
        if override.loc[0] != "robot":
            raise InputError(
                f"{override.label}: without a scenario, only fields of the robot can"
                " be set; write the field as `robot.FIELD`"
            )
        document.apply(override)
    robot_file = robot_in(document, "robot")
    before = {"robot": load_robot_file(name).model_dump(mode="json")}
    after = {"robot": robot_file.model_dump(mode="json")}
    return robot_file.spec(), changed_fields(
        before, after, [override.loc for override in overrides]
    )


VIDEO_SUFFIX = ".mp4"
IMAGE_SUFFIX = ".png"
_GHOST = "analytical"
"""Plant that `--ghost` draws as a translucent body."""

_MIN_SAMPLES = 2
"""Minimum number of samples in a video or strobe image."""

# Minimum and maximum of both the width and the height of an image.
_MIN_SIDE_PX = 64
_MAX_SIDE_PX = 4096


@dataclass(frozen=True)
class PictureOptions:
    """Options of `srs-twin render`.

    Options:
        --video FILE.mp4: Render a video to this file. For several runs, give a folder.
        --image t=2.5: Render an image of the run at this time in seconds.
        --strobe: Render an image from above that shows the robot at several times.
        --ghost: Also draw the analytical model as a translucent body.
        --out FILE.png: Image file, or folder for the images of several runs. [default:
            the run's folder]
        --size WxH: Width and height of the picture in pixels. With --strobe, only the
            width is used.
        --fps N: Frame rate of the video in Hz.
        --speed X: Playback speed of the video relative to real time, for example 0.25.
        --from S: Time in seconds at which the video or the strobe image starts.
            [default: start of the run]
        --to S: Time in seconds at which the video or the strobe image ends. [default:
            end of the run]
    """

    video: str | None = None
    image: str | None = None
    strobe: bool = False
    ghost: bool = False
    out: str | None = None
    size: str = "1280x720"
    fps: Annotated[int, OptionRange(1, 120)] = 30
    speed: Annotated[float, OptionRange(0.001, 1000)] = 1.0
    from_: float | None = None
    to: float | None = None

    def check(self) -> None:
        """Raise an `InputError` if the options contradict each other."""
        if sum((self.video is not None, self.image is not None, self.strobe)) != 1:
            raise InputError(
                "give exactly one of the options --video FILE.mp4, --image t=2.5 and"
                " --strobe"
            )
        if self.video is not None and self.out is not None:
            raise InputError(
                "--out sets the output of images, but --video already names the output"
                " of the video; remove --out"
            )
        if self.ghost and self.strobe:
            raise InputError("--ghost requires --video or --image; remove --ghost")
        if self.image is not None and (self.from_, self.to) != (None, None):
            raise InputError(
                "--from and --to apply only to --video and --strobe, because --image"
                " shows a single time; remove --from and --to"
            )

    def drawing(self) -> tuple[str, Callable[..., object]]:
        """Return the file suffix and the function that writes the file.

        Raises:
            InputError: the size or the time is invalid.
        """
        from srs_twin.viewing.mujoco.render import (
            write_image,
            write_strobe,
            write_video,
        )

        size = _parse_size(self.size)
        if self.video is not None:
            write = partial(write_video, size=size, fps=self.fps, speed=self.speed)
            return VIDEO_SUFFIX, write
        if self.image is not None:
            time = _parse_time(self.image)
            return f"-{time:g}s{IMAGE_SUFFIX}", partial(
                write_image, time=time, size=size
            )
        return f"-strobe{IMAGE_SUFFIX}", partial(write_strobe, width=size.width)

    def target(self, runs: int) -> Path | None:
        """Return the output file or folder, or None for output in the run folders.

        Raises:
            InputError: the suffix is wrong, or one file is given for several runs.
        """
        output = self.out
        suffix = IMAGE_SUFFIX
        if self.video is not None:
            output = self.video
            suffix = VIDEO_SUFFIX
        if output is None:
            return None
        target = Path(output)
        if target.suffix == suffix and runs > 1:
            raise InputError(
                f"{target}: {runs} runs cannot be written to one file; give a folder"
            )
        if target.suffix not in ("", suffix):
            raise InputError(f"{target}: the name of the file must end in {suffix}")
        return target

    def part(self, run: FinishedRun) -> Trajectory:
        """Return the trajectory of the twin in the selected time interval.

        Raises:
            InputError: the run lacks a required plant, or has fewer than two samples in
                the interval.
        """
        if "twin" not in run.trajectories:
            raise InputError(
                f"{display_path(run.folder)}: the run contains no twin, but MuJoCo"
                " renders only the twin; use `srs-twin view` for the analytical model"
            )
        if self.ghost and _GHOST not in run.trajectories:
            raise InputError(
                f"{display_path(run.folder)}: the run contains no analytical model;"
                " remove --ghost"
            )
        whole = run.trajectories["twin"]
        first = float(whole.time[0])
        last = float(whole.time[-1])
        low = first if self.from_ is None else self.from_
        high = last if self.to is None else self.to
        part = whole.between(low, high)
        if len(part) < _MIN_SAMPLES:
            raise InputError(
                f"the interval from {low:g} to {high:g} s has fewer than two samples;"
                f" choose --from and a later --to from {first:g} to {last:g} s"
            )
        return part


def render(
    runs: Annotated[list[str], argument("RUN")],
    picture: PictureOptions,
    quiet: QuietOption = False,
) -> None:
    """Render videos or images of finished runs with MuJoCo.

    Options:
        runs: Folders of runs, or names of folders in runs/.
    """
    picture.check()
    from srs_twin.viewing.mujoco.opengl import usable_opengl

    # The OpenGL check must precede the import of MuJoCo, which fails for unknown values
    # of MUJOCO_GL.
    usable_opengl()
    from srs_twin.experiment import load_run
    from srs_twin.io.files import check_output_folder

    suffix, write = picture.drawing()
    target = picture.target(len(runs))
    jobs: list[tuple[FinishedRun, Trajectory, Path]] = []
    for run in map(load_run, runs):
        path = (target or run.folder) / f"{run.name}{suffix}"
        if target is not None and target.suffix:
            path = target
        jobs.append((run, picture.part(run), path))
        check_output_folder(path.parent, (path.name,))
    for run, part, path in jobs:
        with ScenarioProgress(run.name, quiet=quiet) as progress:
            options: dict[str, object] = {}
            if picture.video is not None:
                options["progress"] = partial(progress, "drawing")
            if picture.ghost:
                options["ghost"] = (_GHOST, run.trajectories[_GHOST])
            write(path, run.scenario, part, **options)
        if not quiet:
            typer.echo(escape_unprintable(str(path)))


def _parse_time(text: str) -> float:
    try:
        return float(text.strip().removeprefix("t="))
    except ValueError as error:
        raise InputError(
            f"--image {text} is not a time; give seconds, for example t=2.5"
        ) from error


def _parse_size(text: str) -> Size:
    from srs_twin.viewing.mujoco.render import Size

    match = re.fullmatch(r"(\d{1,5})[x×](\d{1,5})", text)
    sides = [int(side) for side in match.groups()] if match else []
    if not sides or not all(
        _MIN_SIDE_PX <= side <= _MAX_SIDE_PX and side % 2 == 0 for side in sides
    ):
        raise InputError(
            f"--size {text} is not allowed; give width and height in pixels, for"
            f" example 1280x720, both even and between {_MIN_SIDE_PX} and"
            f" {_MAX_SIDE_PX}"
        )
    return Size(*sides)
