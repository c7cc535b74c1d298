"""Command `srs-twin models`, which exports robots as MJCF models."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from srs_twin.cli.options import (
    OptionRange,
    argument,
    expand_option_groups,
)
from srs_twin.errors import InputError

app = typer.Typer(
    rich_markup_mode=None, no_args_is_help=True, help="Export robots as MJCF models."
)


@app.command()
@expand_option_groups
def export(
    names: Annotated[list[str] | None, argument("NAME", shipped=["robot"])] = None,
    out: str = "models",
    contact: str = "preloaded",
    pressure: Annotated[float | None, OptionRange(0.0, 2000.0)] = None,
    linear: bool = False,
) -> None:
    """Write MJCF models of robots, one folder per robot.

    Messages on stderr state what the MJCF files omit or approximate.

    Options:
        names: Names of shipped robots with wheels, or paths of robot files. [default:
            all shipped robots with wheels]
        --out DIR: Output folder, in which each robot gets a subfolder.
        --contact NAME: Contact model of the wheels. MJCF files support only
            `preloaded`.
        --pressure KPA: Maximum pressure of the actuator controls in kPa. Values below
            the robot's pressure limit have no effect. [default: the pressure limit of
            the robot]
        --linear: Export a robot with a dead zone as a model with linear actuators. You
            must then convert pressures to controls (models/README.md).
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
            "--contact loaded is not allowed, because srs-twin itself computes the"
            " friction of this contact and an exported snake would slide freely; use"
            " --contact preloaded"
        )
    robots = {
        robot.name: robot
        for robot in map(load_robot_file, names or _exportable_robots())
    }
    supply_pa = None if pressure is None else PA_PER_KPA * pressure
    exports = {
        name: robot_files(robot.spec(), supply_pa=supply_pa, linear=linear)
        for name, robot in robots.items()
    }
    for name, files in exports.items():
        check_output_folder(Path(out) / name, tuple(files))
    for name, files in exports.items():
        write_files(files, Path(out) / name)
        typer.echo(escape_unprintable(str(Path(out) / name / SCENE)))
        say(*(f"{name}: {line}" for line in describe_departures(robots[name])))


_ANY_ARGUMENTS = {"allow_extra_args": True, "ignore_unknown_options": True}


@app.command(hidden=True, context_settings=_ANY_ARGUMENTS)
def check() -> None:
    """Report that this command was removed."""
    raise InputError(
        "`models check` was retired; to check an MJCF or URDF file, open it with"
        " `python -m mujoco.viewer --mjcf=FILE`, and to write the robot models again,"
        " use `srs-twin models export`"
    )


def _exportable_robots() -> list[str]:
    from srs_twin.io.files import shipped_names
    from srs_twin.robot.file import load_robot

    return [name for name in shipped_names("robot") if load_robot(name).skin is None]
