"""`srs-twin calibrate`: numbers from runs and measurements, written as files with their source."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli import INTERRUPTED, calibrate_fits, console, say
from srs_twin.cli.batch import QuietOption
from srs_twin.cli.counting import Counting
from srs_twin.errors import InputError
from srs_twin.files import shown

if TYPE_CHECKING:
    from srs_twin.identification.measured import Measured

FOOTPRINTS = "calibration/footprints"
_WIDTH = 100
_FREQUENCY_HZ = {"gait": 2.0, "ilc": 1.5}

app = typer.Typer(
    rich_markup_mode=None, no_args_is_help=True, help="Numbers of a robot from recordings and runs."
)
app.command("friction")(calibrate_fits.friction)
app.command("actuator")(calibrate_fits.actuator)
app.command("locomotion")(calibrate_fits.locomotion)
app.command("robot")(calibrate_fits.robot)


@app.callback()
def calibrate() -> None:
    """Find numbers of a robot from its recordings, and what files hold from runs."""


@app.command()
def footprint(
    robot: Annotated[str, typer.Argument(metavar="ROBOT", help="A shipped robot or a file.")],
    controller: Annotated[
        str,
        typer.Option("--controller", metavar="NAME", help="gait (open loop) or ilc (iterative learning)."),
    ] = "gait",
    frequency: Annotated[
        float | None, typer.Option("--frequency", metavar="HZ", help="Of the gait. [default: 2; ilc: 1.5]")
    ] = None,
    pressure: Annotated[
        float | None,
        typer.Option("--pressure", metavar="KPA", help="Supply. [default: the robot's own]"),
    ] = None,
    target: Annotated[float, typer.Option("--target", metavar="RAD", help="Bend that ilc aims at.")] = 0.7,
    plant: Annotated[str, typer.Option("--plant", metavar="NAME", help="twin or analytical.")] = "twin",
    offsets: Annotated[
        str | None,
        typer.Option(
            "--offsets",
            metavar="LIST",
            help="As --offsets=-0.3,0,0.3. [default: to +-0.4; ilc: to +-0.3]",
        ),
    ] = None,
    transients: Annotated[
        bool, typer.Option("--transients/--no-transients", help="Measure changes of offset as well.")
    ] = True,
    periods: Annotated[
        int, typer.Option("--periods", metavar="N", help="Gait periods measured of each run.")
    ] = 6,
    phases: Annotated[
        int, typer.Option("--phases", metavar="N", help="Runs an offset, each begun at another phase.")
    ] = 4,
    threads: Annotated[
        int | None,
        typer.Option(
            "--threads", "-j", metavar="N", min=1, max=4096, help="Runs at once. [default: one a processor]"
        ),
    ] = None,
    out: Annotated[str, typer.Option("--out", metavar="DIR", help="Folder of the file.")] = FOOTPRINTS,
    name: Annotated[
        str | None,
        typer.Option(
            "--name", metavar="NAME", help="Of the footprint and its file. [default: ROBOT_CONTROLLER]"
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace another file.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Measure what a robot sweeps at each offset, for the planner.

    With transients also what it sweeps as the offset changes.
    """
    wanted = None if offsets is None else _numbers(offsets)
    from srs_twin.folders import open_folder
    from srs_twin.identification.drive import Drive
    from srs_twin.identification.footprint import study as study_of
    from srs_twin.identification.footprint_record import footprint_file, header, refuse_other
    from srs_twin.planning.footprint_file import save_footprint
    from srs_twin.provenance import versions
    from srs_twin.spec import load_robot

    spec = load_robot(robot)
    supply = spec.supply.nominal if pressure is None else 1000 * pressure
    beat = _FREQUENCY_HZ.get(controller, 1.0) if frequency is None else frequency
    drive = Drive(spec, beat, supply, controller, target, plant)
    study = study_of(
        drive, offsets=wanted, changes=None if transients else (), periods=periods, phases=phases
    )
    called = _name(f"{spec.name}_{controller}" if name is None else name)
    path = Path(out) / f"{called}.yaml"
    if not overwrite:
        refuse_other(path, study, robot, called)
    open_folder(path.parent, (path.name,))
    try:
        with Counting(called, study.runs, quiet=quiet) as counting:
            measured = study.measure(threads=threads, progress=lambda done: counting(failed=False))
    except KeyboardInterrupt:
        say("interrupted; nothing was written")
        raise typer.Exit(INTERRUPTED) from None
    if not quiet:
        _show(measured)
    save_footprint(footprint_file(measured, called), path, header=header(study, robot, called, versions()))
    if not quiet:
        say(f"footprint in {shown(path)}")


def _numbers(text: str) -> list[float]:
    """Return the numbers of a list such as -0.3,0,0.3, sorted.

    Raises:
        InputError: something in it is none.
    """
    try:
        return sorted(float(each) for each in text.split(","))
    except ValueError:
        raise InputError(f"--offsets: '{text}' is no list of numbers such as -0.3,0,0.3") from None


def _name(text: str) -> str:
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,59}", text):
        raise InputError(
            f"--name: '{text}' is not allowed; lower-case letters, digits and _, a letter first, 60 at most"
        )
    return text


def _show(measured: Measured) -> None:
    """Print the table, and what changes of offset cost."""
    from srs_twin.identification.footprint_record import rows

    _table(("offset", "speed m/s", "curvature 1/m", "left m", "right m"), rows(measured))
    if measured.transients:
        headings = ("offset", "left m", "right m", "over m", "dx m", "dy m", "dheading rad")
        _table(headings, [
            (f"{t.before:g} to {t.after:g}", f"{t.left:.3f}", f"{t.right:.3f}", f"{t.length:.3f}",
             f"{t.dx:.3f}", f"{t.dy:.3f}", f"{t.dheading:.3f}")
            for t in measured.transients
        ])  # fmt: skip


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    terminal = console()
    terminal.width = max(terminal.width, _WIDTH)  # cut numbers would be wrong numbers
    terminal.print(table)
