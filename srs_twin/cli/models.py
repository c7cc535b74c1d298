"""`srs-twin models`: MJCF from the robots' numbers, and whether MJCF or URDF is fit for use."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.options import JsonOption, argument, option, print_json, with_options
from srs_twin.errors import InputError, UnknownNameError

if TYPE_CHECKING:
    from srs_twin.plants.twin.mjcf.check import ModelReport

app = typer.Typer(rich_markup_mode=None, no_args_is_help=True, help="MJCF models: export and check.")


@app.command()
@with_options
def export(
    names: Annotated[list[str] | None, argument("NAME", of=["robot"])] = None,
    out: Annotated[str, option("--out DIR")] = "models",
    contact: Annotated[str, option("--contact NAME")] = "preloaded",
) -> None:
    """Write robots as MJCF, each in a folder of its own.

    Options:
        names: Robots, or files of robots; default all.
        out: Where models/<robot>/ go.
        contact: How the floor holds the snake; `preloaded`, the only one that an MJCF file can carry.
    """
    from srs_twin.io.files import check_output_folder, escape_unprintable, shipped_names
    from srs_twin.plants.twin.mjcf.export import SCENE, export_robot
    from srs_twin.plants.twin.mjcf.numerics import as_contact
    from srs_twin.robot.file import load_robot

    if as_contact(contact).name != "preloaded":
        raise InputError(
            "--contact loaded is not allowed: its friction is a law of srs_twin's own, which no MJCF file "
            "carries; without it the snake would slide freely. Only preloaded can be written"
        )
    robots = [load_robot(name) for name in names or shipped_names("robot")]
    folders = {Path(out) / robot.name: robot for robot in robots}
    for folder, robot in folders.items():
        check_output_folder(folder, (f"{robot.name}.xml", SCENE))
    for folder, robot in folders.items():
        export_robot(robot, folder)
        typer.echo(escape_unprintable(str(folder / SCENE)))


@app.command()
@with_options
def check(
    models: Annotated[list[str] | None, argument("FILE|NAME", of=["robot"])] = None,
    as_json: JsonOption = False,
) -> None:
    """Compile models and give each a second of random control.

    Shipped ones must be what an export of their robots would write.

    Options:
        models: MJCF or URDF files, or robots; default all.
    """
    from srs_twin.io.files import display_path, escape_unprintable, shipped_names
    from srs_twin.plants.twin.mjcf.check import check_mjcf
    from srs_twin.plants.twin.mjcf.export import stale_files
    from srs_twin.robot.file import load_robot

    bad, reports = 0, []
    for model in models or shipped_names("robot"):
        path, robot = _find(model)
        report = check_mjcf(path)
        faults = list(report.faults)
        if robot is not None:
            remedy = f"is not current; `srs-twin models export {robot}` writes it anew"
            faults += [f"{name} {remedy}" for name in stale_files(load_robot(robot), path.parent)]
        bad += bool(faults)
        reports.append({"model": model, "faults": faults, "notes": list(report.notes), **report.sizes})
        for line in faults or [_praise(report, current=robot is not None), *report.notes]:
            typer.echo(f"{display_path(path)}: {escape_unprintable(line)}", err=bool(faults) or as_json)
    if as_json:
        print_json({"models": reports})
    if bad:
        raise typer.Exit(InputError.exit_code)


def _praise(report: ModelReport, *, current: bool) -> str:
    s = report.sizes
    return (
        f"{'current and ' if current else ''}fit for use ({s['bodies']} bodies, {s['joints']} joints, "
        f"{s['actuators']} actuators, {s['mass_kg']:.4g} kg, {1e3 * s['timestep_s']:g} ms; "
        "1 s of random control without a warning)"
    )


def _find(model: str) -> tuple[Path, str | None]:
    """Return the scene of a shipped robot and the robot's name, or the file that a path means."""
    from srs_twin.io.files import data_root, shipped_names
    from srs_twin.plants.twin.mjcf.check import MODEL_SUFFIXES

    names = shipped_names("robot")
    if model in names:
        return data_root() / "models" / model / "scene.xml", model
    if not (Path(model).suffix in MODEL_SUFFIXES or "/" in model or os.path.lexists(model)):
        files = [path.name for path in Path().glob("*") if path.suffix in MODEL_SUFFIXES]
        raise UnknownNameError("robot or model file", model, [*names, *files])
    return Path(model), None
