"""`srs-twin calibrate`: robot parameters from recordings and from simulated runs, with their sources."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from srs_twin.cli.console import interruptible, say
from srs_twin.cli.options import (
    Bounds,
    FloorOption,
    JsonOption,
    OverwriteOption,
    QuietOption,
    RobotArgument,
    argument,
    expand_option_groups,
    print_json,
)
from srs_twin.errors import InputError
from srs_twin.identification.fitting import (
    DataOptions,
    FilesArgument,
    FindOption,
    FitOptions,
    FitOutput,
    RobotOption,
    ValidateOption,
    parse_names,
    print_table,
)
from srs_twin.identification.footprint_command import footprint, margin
from srs_twin.io.files import display_path
from srs_twin.recordings.commands import FrequencyOption, OffsetOption, ReadingOptions

with_options = partial(expand_option_groups, plugins=True)

_LOCOMOTION = (
    "friction.mu_t,friction.mu_n,geometry.rigid_gap_m,bending.stiffness_nm_per_rad"
)
"""Parameters that `calibrate locomotion` fits by default."""

_DEFAULT_READING = ReadingOptions()
_DEFAULT_OUTPUT = FitOptions()

app = typer.Typer(
    rich_markup_mode=None,
    no_args_is_help=True,
    help="Robot parameters from recordings and runs.",
)


@app.callback()
def calibrate() -> None:
    """Estimate parameters of a robot from recordings, and footprints and margins from simulated runs."""


@app.command()
@with_options
def friction(
    context: typer.Context,
    files: FilesArgument,
    robot: RobotOption,
    validate: ValidateOption = None,
    law: str = "wheel",
    wheel_inertia: bool = True,
    markers: ReadingOptions = _DEFAULT_READING,
    fit: FitOptions = _DEFAULT_OUTPUT,
) -> None:
    """Estimate mu_t and mu_n from pulls or coasting tests.

    Pulls are a table of spring deformations, measured with a spring car; coasting tests
    are recordings.

    Options:
        --law NAME: Friction law of coasting tests: wheel, axis or ellipse (skids).
        --wheel-inertia/--no-wheel-inertia: Include the rotational inertia of the wheels
            in coasting tests.
    """
    output = FitOutput.from_options(context, "friction", robot, fit)
    from srs_twin.identification.calibration import calibrate_friction

    output.run(
        calibrate_friction,
        files,
        robot,
        validate=validate or (),
        law=law,
        wheel_inertia=wheel_inertia,
        reader=markers.reader(),
    )


@app.command()
@with_options
def design(
    robot: RobotArgument,
    want: str,
    as_json: JsonOption = False,
) -> None:
    """Choose the recordings for a requested accuracy.

    Candidates are pulls, weighing, markers, constant pressures, pressure steps and gait
    runs.

    Options:
        --want NAMES: Parameters and target half-widths of their 95 % intervals, e.g.
            friction.mu_t=5%,bending.stiffness_nm_per_rad=10%.
    """
    from srs_twin.identification.design import calibrate_design

    targets = {}
    for text in want.split(","):
        name, _, share = text.strip().partition("=")
        try:
            targets[name] = float(share.removesuffix("%") or 10) / 100
        except ValueError:
            targets[name] = math.nan
        if not 0 < targets[name] < math.inf:
            raise InputError(
                f"--want {text}: must be NAME=PERCENT, as in friction.mu_t=5%"
            )
    with interruptible("nothing was chosen"):
        plan = calibrate_design(robot, targets)
    if as_json:
        print_json(plan.document())
        return
    headings = (
        "half of the 95 % interval",
        "min",
        *(name.partition(".")[2] for name in targets),
    )
    rows = [
        ("robot file", "", *(f"{100 * width:.0f} %" for width in plan.before.values()))
    ]
    for k, experiment in enumerate(plan.chosen):
        after = (f"{100 * row[k]:.1f} %" for row in plan.after.values())
        rows.append((f"after {k + 1}", f"{experiment.minutes:g}", *after))
    print_table(headings, rows, left=(0,))
    for k, experiment in enumerate(plan.chosen, start=1):
        print(f"{k}. {experiment.description}")
    print("The model is assumed to be right.")
    for name in plan.unmet:
        print(
            f"{name}: no further experiment of these kinds reaches"
            f" {100 * targets[name]:g} %"
        )


@app.command()
@with_options
def actuator(
    context: typer.Context,
    files: FilesArgument,
    data: DataOptions,
    find: FindOption = None,
    offset: OffsetOption = None,
    static: bool = False,
    starts: Annotated[int, Bounds(1, 100)] = 1,
    markers: ReadingOptions = _DEFAULT_READING,
    fit: FitOptions = _DEFAULT_OUTPUT,
) -> None:
    """Estimate time constants, gains and rest bends.

    Data are recordings of step responses, or tables or recordings of constant pressures
    (gains only).

    Options:
        --static: Fit plateaus of constant pressure in recordings, and write them to
            NAME.table.csv.
        --starts N: Number of searches.
    """
    output = FitOutput.from_options(context, "actuator", data.robot, fit)
    from srs_twin.identification.calibration import calibrate_actuator
    from srs_twin.identification.static_tables import write_static_table

    result = output.run(
        calibrate_actuator,
        files,
        data.robot,
        **data.given(),
        find=parse_names(find),
        static=static,
        starts=starts,
        reader=markers.reader(offset_s=offset),
    )
    if result.plateaus is not None:
        write_static_table(
            result.plateaus, path := output.path.with_suffix(".table.csv")
        )
        output.say(f"{len(result.plateaus.bend)} plateaus in {display_path(path)}")


@app.command()
@with_options
def locomotion(
    context: typer.Context,
    files: FilesArgument,
    data: DataOptions,
    find: FindOption = _LOCOMOTION,
    plant: str = "analytical",
    model: str | None = None,
    law: FloorOption = None,
    against: str = "both",
    starts: Annotated[int | None, Bounds(1, 100)] = None,
    frequency: FrequencyOption = None,
    offset: OffsetOption = None,
    markers: ReadingOptions = _DEFAULT_READING,
    fit: FitOptions = _DEFAULT_OUTPUT,
) -> None:
    """Estimate friction, gap, masses or stiffness.

    If there are markers, the rigid gap (or the length of a segment) is measured from
    them.

    Options:
        --plant NAME: Simulated plant: analytical or twin.
        --model NAME: Analytical model. [default: compliant]
        --against WHAT: Compared signals: averages, shapes or both.
        --starts N: Number of searches. [default: 3; 1 with the twin's shapes]
    """
    output = FitOutput.from_options(context, "locomotion", data.robot, fit)
    from srs_twin.identification.calibration import calibrate_locomotion

    output.run(
        calibrate_locomotion,
        files,
        data.robot,
        **data.given(),
        find=parse_names(find) or (),
        plant=plant,
        model=model,
        law=law,
        against=against,
        starts=starts,
        reader=markers.reader(offset_s=offset, gait_frequency_hz=frequency),
    )


@app.command()
@with_options
def damping(
    context: typer.Context,
    files: FilesArgument,
    robot: RobotOption,
    valves: str = "open",
    mass_kg: Annotated[float | None, Bounds(1e-4, 50)] = None,
    inertia: Annotated[float | None, Bounds(0, 1)] = None,
    leak_per_s: Annotated[float | None, Bounds(0, 30)] = None,
    noise_rad: Annotated[float | None, Bounds(1e-7, 1)] = None,
    from_s: float | None = None,
    fit: FitOptions = _DEFAULT_OUTPUT,
) -> None:
    """Estimate stiffness, damping time and loss factor.

    Data are recordings of a hanging segment that is released from a bend, at 100 Hz or
    more.

    Options:
        --valves STATE: Chambers during the recordings: open or closed.
        --mass-kg KG: Mass of the body at the end of the segment. [default: the robot's]
        --inertia KGM2: Moment of inertia of the body about its centre, kg*m^2.
            [default: the robot's]
        --leak-per-s RATE: Leak rate of closed chambers, 1/s. [default: estimated]
        --noise-rad RAD: Standard deviation of a recorded bend, rad. [default:
            estimated]
        --from-s S: Time from which the segment swings freely, s. [default: detected]
    """
    output = FitOutput.from_options(context, "damping", robot, fit)
    from srs_twin.identification.calibration import calibrate_damping

    output.run(
        calibrate_damping,
        files,
        robot,
        valves=valves,
        mass_kg=mass_kg,
        inertia_kg_m2=inertia,
        leak_per_s=leak_per_s,
        noise_rad=noise_rad,
        from_s=from_s,
    )


@app.command()
@with_options
def robot(
    fits: Annotated[list[str], argument("FIT")],
    name: str,
    out: str | None = None,
    weak: bool = True,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a robot file with the results of fits.

    Options:
        fits: Fit files of one robot; later ones override earlier ones.
        --name NAME: Name of the new robot and its file.
        --out FILE.yaml: Robot file. [default: robots/NAME.yaml]
        --weak/--no-weak: Include weakly identified parameters.
    """
    from srs_twin.identification.fitted_robot import calibrate_robot

    path = Path(out) if out else Path("robots") / f"{name}.yaml"
    robot_file = calibrate_robot(fits, name, out=path, weak=weak, overwrite=overwrite)
    if as_json:
        print_json(robot_file.model_dump(mode="json", exclude_none=True))
    say(f"robot in {path}", quiet=quiet)


for _command in (footprint, margin):
    app.command()(with_options(_command))
