"""Command `srs-twin calibrate`, which estimates robot parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from srs_twin.cli.console import interruptible, say
from srs_twin.cli.options import (
    FloorOption,
    JsonOption,
    OptionRange,
    OverwriteOption,
    QuietOption,
    RobotArgument,
    argument,
    expand_option_groups,
    option,
    print_json,
)
from srs_twin.errors import InputError
from srs_twin.identification.fitting import (
    DataOptions,
    FilesArgument,
    FitOptions,
    FitOutput,
    ParametersOption,
    RobotOption,
    ValidateOption,
    parse_names,
    print_table,
)
from srs_twin.identification.footprint_command import footprint, margin
from srs_twin.recordings.commands import FrequencyOption, OffsetOption, ReadingOptions

with_options = partial(expand_option_groups, plugins=True)

_LOCOMOTION = (
    "friction.mu_t,friction.mu_n,geometry.rigid_gap_m,bending.stiffness_nm_per_rad"
)
"""Parameters that `calibrate locomotion` fits by default."""

_INERTIA = (
    "Moment of inertia of the body at the end of the segment, about the centre of the"
    " body, in kg*m^2. [default: from the robot file]"
)
InertiaOption = Annotated[
    float | None, option("--inertia KGM2", _INERTIA, min=0, max=1)
]

_DEFAULT_READING = ReadingOptions()
_DEFAULT_OUTPUT = FitOptions()

app = typer.Typer(
    rich_markup_mode=None,
    no_args_is_help=True,
    help="Estimate robot parameters from recordings and runs.",
)


@app.callback()
def calibrate() -> None:
    """Estimate robot parameters from recordings, or footprints from simulated runs."""


def _fits(declaration: Callable[..., None]) -> None:
    """Register the declared command NAME, which calls the function `calibrate_NAME`."""

    @app.command()
    @with_options
    @wraps(declaration)
    def run(
        context: typer.Context, files: list[str], fit: FitOptions, **given: Any
    ) -> None:
        data = given.pop("data", None)
        if data is not None:
            given |= data.given()
        reading = {
            "offset_s": given.pop("offset", None),
            "gait_frequency_hz": given.pop("frequency", None),
        }
        name = declaration.__name__
        output = FitOutput(context, name, given["robot"], fit)
        from srs_twin.identification import calibration

        if "markers" in given:
            given["reader"] = given.pop("markers").reader(**reading)
        settings = {key: value for key, value in given.items() if value is not None}
        if "parameters" in settings:
            settings["parameters"] = parse_names(settings["parameters"])
        output.run(getattr(calibration, f"calibrate_{name}"), files, **settings)


@_fits
def friction(
    context: typer.Context,
    files: FilesArgument,
    robot: RobotOption,
    validate: ValidateOption = None,
    friction_law: str = "wheel",
    wheel_inertia: bool = True,
    markers: ReadingOptions = _DEFAULT_READING,
    fit: FitOptions = _DEFAULT_OUTPUT,
) -> None:
    """Estimate friction coefficients from pulls or coasting tests.

    Pulls require a table of the maximum deformations of the spring with which a car
    pulls the robot. Coasting tests require recordings.

    Options:
        --friction-law NAME: Friction law for coasting tests: wheel, axis, cosine, or
            ellipse for a robot on skids.
        --wheel-inertia/--no-wheel-inertia: Include the rotational inertia of the wheels
            in the model of coasting tests.
    """


@app.command()
@with_options
def design(
    robot: RobotArgument,
    target_accuracy: str,
    as_json: JsonOption = False,
) -> None:
    """Choose experiments that reach a target accuracy.

    The candidate experiments are pulls, weighing, marker recordings, constant
    pressures, pressure steps and gait runs.

    Options:
        --target-accuracy NAMES: Parameters, each with the required half-width of its
            95 % interval, for example
            friction.mu_t=5%,bending.stiffness_nm_per_rad=10%.
    """
    from srs_twin.identification.design import calibrate_design

    targets = _parse_targets(target_accuracy)
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
        after = [f"{100 * row[k]:.1f} %" for row in plan.after.values()]
        rows.append((f"after {k + 1}", f"{experiment.minutes:g}", *after))
    print_table(headings, rows, left=(0,))
    for k, experiment in enumerate(plan.chosen, start=1):
        print(f"{k}. {experiment.description}")
    print("The predictions assume that the model is correct.")
    for name in plan.unmet:
        print(
            f"{name}: no further experiment of these kinds reaches"
            f" {100 * targets[name]:g} %"
        )


def _parse_targets(text: str) -> dict[str, float]:
    targets = {}
    for entry in text.split(","):
        name, _, fraction = entry.strip().partition("=")
        try:
            targets[name] = float(fraction.removesuffix("%") or 10) / 100
        except ValueError:
            targets[name] = math.nan
        if not 0 < targets[name] < math.inf:
            raise InputError(
                f"--target-accuracy {entry}: each entry must have the form"
                " NAME=PERCENT, for example friction.mu_t=5%"
            )
    return targets


@_fits
def actuator(
    context: typer.Context,
    files: FilesArgument,
    data: DataOptions,
    parameters: ParametersOption = None,
    offset: OffsetOption = None,
    static: bool = False,
    starts: Annotated[int, OptionRange(1, 100)] = 1,
    markers: ReadingOptions = _DEFAULT_READING,
    fit: FitOptions = _DEFAULT_OUTPUT,
) -> None:
    """Estimate time constants, gains and rest bends.

    The data are recordings of step responses. Tables or recordings of constant
    pressures are also allowed, but they do not determine the time constants.

    Options:
        --static: Fit only the intervals of constant pressure in the recordings, and
            write these intervals to NAME.table.csv.
        --starts N: Number of searches, each from a different starting point.
    """


@_fits
def locomotion(
    context: typer.Context,
    files: FilesArgument,
    data: DataOptions,
    parameters: ParametersOption = _LOCOMOTION,
    plant: str = "analytical",
    model: str | None = None,
    friction_law: FloorOption = None,
    compare_signals: str = "both",
    starts: Annotated[int | None, OptionRange(1, 100)] = None,
    frequency: FrequencyOption = None,
    offset: OffsetOption = None,
    markers: ReadingOptions = _DEFAULT_READING,
    fit: FitOptions = _DEFAULT_OUTPUT,
) -> None:
    """Estimate friction, lengths, masses or stiffness.

    If the recordings contain markers, the markers also determine the length of a
    segment or of its straight part (rigid gap).

    Options:
        --plant NAME: Model that simulates the robot in the fit: analytical or twin.
        --model NAME: Kind of analytical model: complete, simplified, compliant or
            quasistatic. [default: compliant]
        --compare-signals WHAT: Signals that are compared: averages (speed and yaw
            rate), shapes (path, heading and bends over time) or both.
        --starts N: Number of searches, each from a different starting point. [default:
            3, or 1 if the twin is fitted to shapes]
    """


@_fits
def damping(
    context: typer.Context,
    files: FilesArgument,
    robot: RobotOption,
    valves: str = "open",
    mass_kg: Annotated[float | None, OptionRange(1e-4, 50)] = None,
    inertia_kg_m2: InertiaOption = None,
    leak_per_s: Annotated[float | None, OptionRange(0, 30)] = None,
    noise_rad: Annotated[float | None, OptionRange(1e-7, 1)] = None,
    from_s: float | None = None,
    fit: FitOptions = _DEFAULT_OUTPUT,
) -> None:
    """Estimate stiffness, damping time and loss factor.

    The data are recordings of a hanging segment that is bent and then released. The
    frame rate must be at least 100 Hz.

    Options:
        --valves STATE: State of the chambers during the recordings: open or closed.
        --mass-kg KG: Mass in kg of the body at the end of the segment. [default: from
            the robot file]
        --leak-per-s RATE: Leak rate of closed chambers in 1/s. [default: estimated]
        --noise-rad RAD: Standard deviation of the recorded bends in rad. [default:
            estimated]
        --from-s S: Time in seconds from which the segment swings freely. [default:
            detected]
    """


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
        fits: Fit files of one robot. If several files contain the same parameter, the
            last file sets its value.
        --name NAME: Name of the new robot and of its file.
        --out FILE.yaml: Path of the robot file. [default: robots/NAME.yaml]
        --weak/--no-weak: Include parameters that the data determine only weakly.
    """
    from srs_twin.identification.fitted_robot import calibrate_robot

    path = Path(out) if out else Path("robots") / f"{name}.yaml"
    robot_file = calibrate_robot(fits, name, out=path, weak=weak, overwrite=overwrite)
    if as_json:
        print_json(robot_file.model_dump(mode="json", exclude_none=True))
    say(f"robot file written to {path}", quiet=quiet)


for _command in (footprint, margin):
    app.command()(with_options(_command))
