"""`srs-twin view`: finished runs in Rerun; `play`: steer a robot's twin by keys."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from srs_twin.cli.options import ChangeOptions, RobotArgument, argument, option
from srs_twin.errors import InputError


def view(
    runs: Annotated[list[str], argument("RUN")],
    web: Annotated[bool, option("--web")] = False,
    port: Annotated[int | None, option("--port N", min=1, max=65535)] = None,
) -> None:
    """Open the recordings of runs.

    Options:
        runs: Run folders, recordings, or names in runs/; several stand side by side.
        web: Serve it for a browser on this machine, until Ctrl-C.
        port: Of the page. [default: free]
    """
    recordings = [find_recording(run) for run in runs]
    if port is not None and not web:
        raise InputError("--port is for --web")
    with tempfile.TemporaryDirectory(prefix="srs-twin-view-") as folder:
        shown = recordings[0]
        if len(recordings) > 1:
            from srs_twin.viewing.rerun.recording import write_side_by_side

            shown = Path(folder) / "side-by-side.rrd"
            write_side_by_side(shown, named(recordings))
        if web:
            _serve(shown, port or 0)
        else:
            from srs_twin.viewing.rerun.viewer import open_recording

            open_recording(shown)


def _serve(recording: Path, port: int) -> None:
    """Serve a recording until somebody ends it, which is no failure."""
    from srs_twin.viewing.rerun.web import served

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with served([recording], port) as (address, serve):
            typer.echo(address)
            sys.stdout.flush()
            print("open this address in a browser; Ctrl-C ends it", file=sys.stderr, flush=True)
            serve()
    except KeyboardInterrupt:
        return


def find_recording(run: str) -> Path:
    """Return the recording that a run left.

    Args:
        run: the run's folder, the recording itself, or a scenario that ran into ``./runs``.

    Raises:
        InputError: there is none.
    """
    looked = [Path(run), Path(run) / "recording.rrd", Path("runs") / run / "recording.rrd"]
    for path in looked:
        if os.path.isfile(path):
            if path.suffix != ".rrd":
                raise InputError(f"{path}: not a recording; give a run folder or a file that ends in .rrd")
            return path
    tried = ", ".join(str(path) for path in looked[1:])
    raise InputError(f"{run}: no recording there (looked for {tried}); `srs-twin run SCENARIO` makes one")


def named(recordings: Sequence[Path]) -> dict[str, Path]:
    """Give recordings the names of their folders, longer where these are alike.

    Raises:
        InputError: one is given twice.
    """
    places = [path.resolve() for path in recordings]
    places = [path.parent if path.name == "recording.rrd" else path for path in places]
    if len(set(places)) < len(places):
        twice = next(path for path in places if places.count(path) > 1)
        raise InputError(f"{twice}: given twice")
    count = 1
    while len({path.parts[-count:] for path in places}) < len(places):
        count += 1
    return dict(zip(("/".join(path.parts[-count:]) for path in places), recordings, strict=True))


def play(
    robot: RobotArgument,
    change: Annotated[list[str] | None, option("--set FIELD=VALUE")] = None,
) -> None:
    """Steer the twin of a robot live, in MuJoCo's viewer.

    Keys: arrows, page up and page down.

    Options:
        change: Another value of a field, as robot.friction.mu_t=0.1; repeatable.
    """
    from srs_twin.io.documents import Document
    from srs_twin.robot.file import load_robot_file, resolve_robot
    from srs_twin.scenario.modified import changed_fields, changes_text

    document = Document(robot, {"robot": robot})
    changed = ChangeOptions(change).changes()
    for each in changed:
        if each.loc[0] != "robot":
            raise InputError(f"{each.label}: play has no scenario; set a field of robot")
        document.apply(each)
    found = resolve_robot(document, document.get("robot"), prefix=("robot",))
    document.raise_problems()
    assert found is not None, "a robot without a problem was resolved"
    from srs_twin.viewing.mujoco.live import MujocoWindow, refuse_without_display

    refuse_without_display()
    from srs_twin.viewing.mujoco.live import LiveSnake, steer

    before = {"robot": load_robot_file(robot).model_dump(mode="json")}
    after = {"robot": found.model_dump(mode="json")}
    changes = changed_fields(before, after, [each.loc for each in changed])
    # MuJoCo's font has ASCII alone.
    snake = LiveSnake(found.spec(), modified=changes_text(changes).replace("→", "to"))
    with MujocoWindow(snake) as window:
        steer(snake, window)
