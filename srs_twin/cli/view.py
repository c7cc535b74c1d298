"""`srs-twin view`, `play` and `render`: runs in Rerun, a twin in MuJoCo's viewer, and videos and images."""

from __future__ import annotations

import os
import re
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.catalogue import is_robot
from srs_twin.cli.console import ScenarioProgress, handle_signals
from srs_twin.cli.options import Bounds, ChangeOptions, QuietOption, argument
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
    port: Annotated[int | None, Bounds(1, 65535)] = None,
) -> None:
    """Open recordings of runs in Rerun.

    Options:
        runs: Run folders, recordings, or names of folders in runs/; several are shown
            side by side.
        --web: Serve the viewer to a browser on this machine until Ctrl-C.
        --port N: TCP port of the web viewer. [default: free]
    """
    recordings = [find_recording(run) for run in runs]
    if port is not None and not web:
        raise InputError("--port needs --web")
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
    """Serve a recording until an interrupt, which is the normal end."""
    from srs_twin.viewing.rerun.viewer import serve_recordings

    handle_signals(signal.default_int_handler, signal.SIGTERM)
    try:
        with serve_recordings([recording], port) as (address, serve):
            typer.echo(address)
            sys.stdout.flush()
            print(
                "open this address in a browser; Ctrl-C ends it",
                file=sys.stderr,
                flush=True,
            )
            serve()
    except KeyboardInterrupt:
        return


def find_recording(run: str) -> Path:
    """Return the path of the recording of a run.

    Args:
        run: run folder, recording, or name of a folder in ``./runs``.

    Raises:
        InputError: no recording was found.
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
                    f"{path}: not a recording; give a run folder or a file that ends in"
                    " .rrd"
                )
            return path
    searched = ", ".join(str(path) for path in candidates[1:])
    raise InputError(
        f"{run}: no recording found (looked for {searched}); `srs-twin run SCENARIO`"
        " writes one"
    )


def name_recordings(recordings: Sequence[Path]) -> dict[str, Path]:
    """Return unique name → recording; a name has as many of the last parts of its path as necessary.

    Raises:
        InputError: a recording is given twice.
    """
    paths = [path.resolve() for path in recordings]
    paths = [path.parent if path.name == "recording.rrd" else path for path in paths]
    if len(set(paths)) < len(paths):
        duplicate = next(path for path in paths if paths.count(path) > 1)
        raise InputError(f"{duplicate}: given twice")
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
    """Play a scenario, or steer a robot by keyboard, in MuJoCo.

    Keys: left and right change the offset, up and down the frequency, page up and page
    down the supply pressure; home resets the offset, space pauses, backspace restarts.
    The controller of a scenario acts until one of the first six keys is pressed.

    Options:
        name: Shipped scenario or robot, or a scenario or robot file.
        --set FIELD=VALUE: Override a field, e.g. robot.friction.mu_t=0.1 (repeatable).
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

    # The font of MuJoCo contains only ASCII.
    snake = LiveSnake(
        robot, scenario=scenario, modified=changes_text(changes).replace("→", "to")
    )
    with MujocoWindow(snake) as window:
        steer(snake, window)


def _changed_robot(
    name: str, overrides: Sequence[Override]
) -> tuple[RobotSpec, Changes]:
    """Return a robot with overridden fields, and the changes."""
    from srs_twin.io.documents import Document
    from srs_twin.robot.file import load_robot_file, robot_in
    from srs_twin.scenario.modified import changed_fields

    document = Document(name, {"robot": name})
    for override in overrides:
        if override.loc[0] != "robot":
            raise InputError(
                f"{override.label}: a robot has no scenario; set a field of robot"
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
"""Plant that `--ghost` draws translucently."""

_MIN_SAMPLES = 2
"""Smallest number of samples of a video or strobe picture."""

_MIN_SIDE_PX = 64
"""Smallest width and height of an image, pixels."""

_MAX_SIDE_PX = 4096
"""Largest width and height of an image, pixels."""


@dataclass(frozen=True)
class PictureOptions:
    """Kind, contents and file of the pictures of runs.

    Options:
        --video FILE.mp4: Output video; with several runs, output folder.
        --image t=2.5: Render an image at this time, s.
        --strobe: Render several times in one image from above.
        --ghost: Also draw the analytical model, translucently.
        --out FILE.png: Output image; with several runs, output folder. [default: the
            run's folder]
        --size WxH: Width and height, pixels; --strobe uses the width only.
        --fps N: Frame rate of the video, Hz.
        --speed X: Playback speed of the video; 0.25: slow motion.
        --from S: Start of the video or of the strobe picture, s. [default: start of the
            run]
        --to S: End of the video or of the strobe picture, s. [default: end of the run]
    """

    video: str | None = None
    image: str | None = None
    strobe: bool = False
    ghost: bool = False
    out: str | None = None
    size: str = "1280x720"
    fps: Annotated[int, Bounds(1, 120)] = 30
    speed: Annotated[float, Bounds(0.001, 1000)] = 1.0
    from_: float | None = None
    to: float | None = None

    def check(self) -> None:
        """Check that the options can be combined.

        Raises:
            InputError: they contradict each other.
        """
        if sum((self.video is not None, self.image is not None, self.strobe)) != 1:
            raise InputError(
                "give exactly one of --video FILE.mp4, --image t=2.5 and --strobe"
            )
        if self.video is not None and self.out is not None:
            raise InputError(
                "--out is for images; --video already names the output of a video"
            )
        if self.ghost and self.strobe:
            raise InputError("--ghost needs --video or --image")
        if self.image is not None and (self.from_, self.to) != (None, None):
            raise InputError(
                "--from and --to are for --video and --strobe; --image t=2.5 is at one"
                " time"
            )

    def drawing(self) -> tuple[str, Callable[..., object]]:
        """Return the suffix that follows the run in a file name, and the function that writes the file.

        Raises:
            InputError: the size or the time cannot be read.
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
        """Return the output file or folder; None: the folders of the runs.

        Raises:
            InputError: it has another suffix, or is a file for several runs.
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
                f"{target}: {runs} runs cannot share one file; give a folder"
            )
        if target.suffix not in ("", suffix):
            raise InputError(f"{target}: the file must end in {suffix}")
        return target

    def part(self, run: FinishedRun) -> Trajectory:
        """Return the samples of the twin between the two times.

        Raises:
            InputError: the run lacks a plant that is drawn, or has less than two
                samples in this interval.
        """
        if "twin" not in run.trajectories:
            raise InputError(
                f"{display_path(run.folder)}: the run contains no twin, and MuJoCo"
                " renders only the twin; `srs-twin view` shows the analytical model"
            )
        if self.ghost and _GHOST not in run.trajectories:
            raise InputError(
                f"{display_path(run.folder)}: the run contains no analytical model;"
                " omit --ghost"
            )
        whole = run.trajectories["twin"]
        first = float(whole.time[0])
        last = float(whole.time[-1])
        low = first if self.from_ is None else self.from_
        high = last if self.to is None else self.to
        part = whole.between(low, high)
        if len(part) < _MIN_SAMPLES:
            raise InputError(
                f"--from {low:g} --to {high:g} contains no part of the run, which lasts"
                f" from {first:g} to {last:g} s"
            )
        return part


def render(
    runs: Annotated[list[str], argument("RUN")],
    picture: PictureOptions,
    quiet: QuietOption = False,
) -> None:
    """Render a video or image of finished runs with MuJoCo.

    Options:
        runs: Run folders, or names of folders in runs/.
    """
    picture.check()
    from srs_twin.viewing.mujoco.opengl import usable_opengl

    # Before the import of MuJoCo, which fails for an unknown name in MUJOCO_GL.
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
    """Return the time in 't=2.5' or '2.5', s."""
    try:
        return float(text.strip().removeprefix("t="))
    except ValueError as error:
        raise InputError(
            f"--image {text}: not a time; give seconds, such as t=2.5"
        ) from error


def _parse_size(text: str) -> Size:
    from srs_twin.viewing.mujoco.render import Size

    match = re.fullmatch(r"(\d{1,5})[x×](\d{1,5})", text)
    sides = [int(side) for side in match.groups()] if match else []
    if not sides or not all(
        _MIN_SIDE_PX <= side <= _MAX_SIDE_PX and side % 2 == 0 for side in sides
    ):
        raise InputError(
            f"--size {text}: give width and height in pixels, such as 1280x720, "
            f"both even and from {_MIN_SIDE_PX} to {_MAX_SIDE_PX}"
        )
    return Size(*sides)
