"""`srs-twin view` and `play`: finished runs in Rerun, and a twin in MuJoCo's viewer."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.catalogue import is_robot
from srs_twin.cli.options import ChangeOptions, argument, option
from srs_twin.errors import InputError

if TYPE_CHECKING:
    from srs_twin.io.documents import Override
    from srs_twin.robot.spec import RobotSpec
    from srs_twin.scenario.modified import Changes


def view(
    runs: Annotated[list[str], argument("RUN")],
    web: Annotated[bool, option("--web")] = False,
    port: Annotated[int | None, option("--port N", min=1, max=65535)] = None,
) -> None:
    """Open recordings of runs in Rerun.

    Options:
        runs: Run folders, recordings, or names of folders in runs/; several are shown side by side.
        web: Serve the viewer to a browser on this machine until Ctrl-C.
        port: TCP port of the web viewer. [default: free]
    """
    recordings = [find_recording(run) for run in runs]
    if port is not None and not web:
        raise InputError("--port needs --web")
    with tempfile.TemporaryDirectory(prefix="srs-twin-view-") as folder:
        recording = recordings[0]
        if len(recordings) > 1:
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

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with serve_recordings([recording], port) as (address, serve):
            typer.echo(address)
            sys.stdout.flush()
            print("open this address in a browser; Ctrl-C ends it", file=sys.stderr, flush=True)
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
    candidates = [Path(run), Path(run) / "recording.rrd", Path("runs") / run / "recording.rrd"]
    for path in candidates:
        if os.path.isfile(path):
            if path.suffix != ".rrd":
                raise InputError(f"{path}: not a recording; give a run folder or a file that ends in .rrd")
            return path
    searched = ", ".join(str(path) for path in candidates[1:])
    raise InputError(f"{run}: no recording found (looked for {searched}); `srs-twin run SCENARIO` writes one")


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
    return dict(zip(("/".join(path.parts[-count:]) for path in paths), recordings, strict=True))


def play(
    name: Annotated[str, argument("SCENARIO|ROBOT", shipped=["scenario", "robot"])],
    set_: Annotated[list[str] | None, option("--set FIELD=VALUE")] = None,
) -> None:
    """Play a scenario, or steer a robot by keyboard, in MuJoCo.

    Keys: left and right change the offset, up and down the frequency, page up and page down the supply
    pressure; home resets the offset, space pauses, backspace restarts. The controller of a scenario acts
    until one of the first six keys is pressed.

    Options:
        name: Shipped scenario or robot, or a scenario or robot file.
        set_: Override a field, e.g. robot.friction.mu_t=0.1 (repeatable).
    """
    from srs_twin.scenario.modified import changes_text

    overrides = ChangeOptions(set_).changes()
    scenario, robot = None, None
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
    snake = LiveSnake(robot, scenario=scenario, modified=changes_text(changes).replace("→", "to"))
    with MujocoWindow(snake) as window:
        steer(snake, window)


def _changed_robot(name: str, overrides: Sequence[Override]) -> tuple[RobotSpec, Changes]:
    """Return a robot with overridden fields, and the changes."""
    from srs_twin.io.documents import Document
    from srs_twin.robot.file import load_robot_file, resolve_robot
    from srs_twin.scenario.modified import changed_fields

    document = Document(name, {"robot": name})
    for override in overrides:
        if override.loc[0] != "robot":
            raise InputError(f"{override.label}: a robot has no scenario; set a field of robot")
        document.apply(override)
    robot_file = resolve_robot(document, document.get("robot"), prefix=("robot",))
    document.raise_problems()
    assert robot_file is not None, "`raise_problems` raises if the robot is invalid"
    before = {"robot": load_robot_file(name).model_dump(mode="json")}
    after = {"robot": robot_file.model_dump(mode="json")}
    return robot_file.spec(), changed_fields(before, after, [override.loc for override in overrides])
