"""`srs-twin models`: export of robots as MJCF, and checks of MJCF and URDF models."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.console import as_started
from srs_twin.cli.options import (
    Bounds,
    JsonOption,
    argument,
    expand_option_groups,
    print_json,
)
from srs_twin.errors import InputError, UnknownNameError

if TYPE_CHECKING:
    from srs_twin.plants.twin.mjcf.check import ModelReport

app = typer.Typer(
    rich_markup_mode=None, no_args_is_help=True, help="MJCF models: export and check."
)


@app.command()
@expand_option_groups
def export(
    names: Annotated[list[str] | None, argument("NAME", shipped=["robot"])] = None,
    out: str = "models",
    contact: str = "preloaded",
    pressure: Annotated[float, Bounds(0.0, 2000.0)] = 0.0,
    linear: bool = False,
) -> None:
    """Write robots as MJCF, one folder per robot.

    Lines on stderr name what the files lack or approximate.

    Options:
        names: Robots on wheels, or their files; default all.
        --out DIR: Output folder; each robot gets a subfolder.
        --contact NAME: Contact model; MJCF files support only `preloaded`.
        --pressure KPA: Highest pressure of the controls, kPa; at least the limits of
            the robot are used.
        --linear: Export robots with a dead zone for controls that you convert
            (models/README.md).
    """
    from srs_twin.cli.console import say
    from srs_twin.io.files import check_output_folder, escape_unprintable
    from srs_twin.plants.twin.mjcf.export import (
        SCENE,
        describe_departures,
        robot_files,
        write_files,
    )
    from srs_twin.plants.twin.mjcf.numerics import as_contact
    from srs_twin.robot.file import PA_PER_KPA, load_robot_file

    if as_contact(contact).name != "preloaded":
        raise InputError(
            "--contact loaded is not allowed: srs_twin computes its friction, so an"
            " MJCF file would contain none and the snake would slide freely; use"
            " --contact preloaded"
        )
    robots = {
        robot.name: robot
        for robot in map(load_robot_file, names or _exportable_robots())
    }
    exports = {
        name: robot_files(robot.spec(), supply_pa=PA_PER_KPA * pressure, linear=linear)
        for name, robot in robots.items()
    }
    for name, files in exports.items():
        check_output_folder(Path(out) / name, tuple(files))
    for name, files in exports.items():
        write_files(files, Path(out) / name)
        typer.echo(escape_unprintable(str(Path(out) / name / SCENE)))
        say(*(f"{name}: {line}" for line in describe_departures(robots[name])))


@app.command()
@expand_option_groups
def check(
    models: Annotated[
        list[str] | None, argument("FILE|NAME", shipped=["robot"])
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compile models and simulate 1 s of random control.

    Shipped models must also equal the export of their robots.

    Options:
        models: MJCF or URDF files, or robots; default all.
    """
    from srs_twin.io.files import display_path, escape_unprintable
    from srs_twin.plants.twin.mjcf.check import check_mjcf
    from srs_twin.plants.twin.mjcf.export import stale_files
    from srs_twin.robot.file import load_robot

    failed = 0
    reports = []
    for model in models or _exportable_robots():
        path, robot = _find_model(model)
        report = check_mjcf(path)
        faults = list(report.faults)
        if robot is not None:
            remedy = f"is out of date; `srs-twin models export {robot}` writes it again"
            faults += [
                f"{name} {remedy}"
                for name in stale_files(load_robot(robot), path.parent)
            ]
        failed += bool(faults)
        reports.append(
            {
                "model": model,
                "faults": faults,
                "notes": list(report.notes),
                **report.sizes,
            }
        )
        for line in faults or [
            _success_message(report, current=robot is not None),
            *report.notes,
        ]:
            text = escape_unprintable(as_started(line))
            typer.echo(f"{display_path(path)}: {text}", err=bool(faults) or as_json)
    if as_json:
        print_json({"models": reports})
    if failed:
        raise typer.Exit(InputError.exit_code)


def _exportable_robots() -> list[str]:
    """Return the shipped robots on wheels: MJCF has no friction law for a skin."""
    from srs_twin.io.files import shipped_names
    from srs_twin.robot.file import load_robot

    return [name for name in shipped_names("robot") if load_robot(name).skin is None]


def _success_message(report: ModelReport, *, current: bool) -> str:
    sizes = report.sizes
    return (
        f"{'up to date and ' if current else ''}valid ({sizes['bodies']} bodies,"
        f" {sizes['joints']} joints, {sizes['actuators']} actuators,"
        f" {sizes['mass_kg']:.4g} kg, {1e3 * sizes['timestep_s']:g} ms; 1 s of random"
        " control without warnings)"
    )


def _find_model(model: str) -> tuple[Path, str | None]:
    """Return the scene and the name of a shipped robot, or the path of a model file and None."""
    from srs_twin.io.files import data_root
    from srs_twin.plants.twin.mjcf.check import MODEL_SUFFIXES

    names = _exportable_robots()
    if model in names:
        return data_root() / "models" / model / "scene.xml", model
    if not (
        Path(model).suffix in MODEL_SUFFIXES or "/" in model or os.path.lexists(model)
    ):
        files = [
            path.name for path in Path().glob("*") if path.suffix in MODEL_SUFFIXES
        ]
        raise UnknownNameError("robot or model file", model, [*names, *files])
    return Path(model), None
