"""`srs-twin calibrate`: robot parameters from recordings and from simulated runs, with their sources."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.console import console, interruptible, new_table, say
from srs_twin.cli.options import (
    FloorOption,
    JsonOption,
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
    NOTHING_WRITTEN,
    DataOptions,
    FilesArgument,
    FindOption,
    FitOptions,
    FitOutput,
    RobotOption,
    ValidateOption,
    parse_names,
)
from srs_twin.identification.footprint_command import footprint, margin
from srs_twin.io.files import display_path
from srs_twin.recordings.commands import FrequencyOption, OffsetOption, ReadingOptions

if TYPE_CHECKING:
    from srs_twin.identification.locomotion import GaitRun
    from srs_twin.identification.static_tables import NamedRecordings, StaticTable
    from srs_twin.robot.spec import RobotSpec

with_options = partial(expand_option_groups, plugins=True)

_LOCOMOTION = "friction.mu_t,friction.mu_n,geometry.rigid_gap_m,bending.stiffness_nm_per_rad"
"""Parameters that `calibrate locomotion` fits by default."""

_DEFAULT_READING = ReadingOptions()
_DEFAULT_OUTPUT = FitOptions()

app = typer.Typer(
    rich_markup_mode=None, no_args_is_help=True, help="Robot parameters from recordings and runs."
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
    law: Annotated[str, option("--law NAME")] = "wheel",
    wheel_inertia: Annotated[bool, option("--wheel-inertia/--no-wheel-inertia")] = True,
    markers: ReadingOptions = _DEFAULT_READING,
    fit: FitOptions = _DEFAULT_OUTPUT,
) -> None:
    """Estimate mu_t and mu_n from pulls or coasting tests.

    Pulls are a table of spring deformations, measured with a spring car; coasting tests are recordings.

    Options:
        law: Friction law of coasting tests: wheel, axis or ellipse (skids).
        wheel_inertia: Include the rotational inertia of the wheels in coasting tests.
    """
    output = FitOutput.from_options(context, "friction", robot, fit)
    from srs_twin.identification.friction import (
        PULL_COLUMNS,
        CoastingTest,
        fit_coasting,
        fit_pulls,
        is_pull_table,
        read_pull_table,
    )
    from srs_twin.recordings.formats import UnknownFormatError
    from srs_twin.robot.file import load_robot

    spec, kept = load_robot(robot), validate or []
    if _all_of_kind([*files, *kept], is_pull_table, "table of pulls", "recording of a coasting test"):
        if len(files) > 1:
            raise InputError(f"{files[1]}: a fit uses one table of pulls; give further ones with --validate")
        pulls, validation_pulls = read_pull_table(files[0]), [read_pull_table(path) for path in kept]
        estimate = fit_pulls(pulls, validation=validation_pulls)
        output.finish(estimate, "pulls", f"Friction of {spec.name} from pulls", [pulls], validation_pulls)
        return
    reader = markers.reader()

    def coasting_test(path: str) -> CoastingTest:
        try:
            recording = reader.motion(path, spec)
        except UnknownFormatError as error:
            raise InputError(f"{error}; a table of pulls has the columns {PULL_COLUMNS}") from None
        say(recording.summary.text(), quiet=fit.quiet)
        return CoastingTest.from_trajectory(recording.trajectory, path)

    runs, validation = [coasting_test(path) for path in files], [coasting_test(path) for path in kept]
    with output.progress() as watch:
        estimate = fit_coasting(
            runs, spec, validation=validation, law=law, wheel_inertia=wheel_inertia, watch=watch
        )
    output.finish(estimate, "coasting", f"Friction of {spec.name} from coasting tests", runs, validation)


@app.command()
@with_options
def design(
    robot: RobotArgument,
    want: Annotated[str, option("--want NAMES")],
    as_json: JsonOption = False,
) -> None:
    """Choose the recordings for a requested accuracy.

    Candidates are pulls, weighing, markers, constant pressures, pressure steps and gait runs.

    Options:
        want: Parameters and target half-widths of their 95 % intervals, e.g.
            friction.mu_t=5%,bending.stiffness_nm_per_rad=10%.
    """
    import numpy as np

    from srs_twin.identification.design import choose_experiments
    from srs_twin.identification.priors import Priors
    from srs_twin.robot.file import load_robot, load_robot_file

    targets = {}
    for text in want.split(","):
        name, _, share = text.strip().partition("=")
        try:
            targets[name] = float(share.removesuffix("%") or 10) / 100
        except ValueError:
            raise InputError(f"--want {text}: must be NAME=PERCENT, as in friction.mu_t=5%") from None
    file, shares = load_robot_file(robot), (np.arange(64) + 0.5) / 64
    has_priors = any(record.uncertain for record in file.records().values())
    priors = Priors.from_robot(file).parameters if has_priors else ()
    known = {prior.path: (prior.value, float(prior.quantile(shares).std())) for prior in priors}
    with interruptible("nothing was chosen"):
        plan = choose_experiments(load_robot(robot), known, targets)
    if as_json:
        print_json(plan.document())
        return
    table = new_table("half of the 95 % interval", "min", *(name.partition(".")[2] for name in targets))
    table.add_row("robot file", "", *(f"{100 * width:.0f} %" for width in plan.before.values()))
    for k, experiment in enumerate(plan.chosen):
        after = (f"{100 * row[k]:.1f} %" for row in plan.after.values())
        table.add_row(f"after {k + 1}", f"{experiment.minutes:g}", *after)
    console().print(table)
    for k, experiment in enumerate(plan.chosen, start=1):
        print(f"{k}. {experiment.description}")
    print("The model is assumed to be right.")
    for name in plan.unmet:
        print(f"{name}: no further experiment of these kinds reaches {100 * targets[name]:g} %")


@app.command()
@with_options
def actuator(
    context: typer.Context,
    files: FilesArgument,
    data: DataOptions,
    find: FindOption = None,
    offset: OffsetOption = None,
    static: Annotated[bool, option("--static")] = False,
    starts: Annotated[int, option("--starts N", min=1, max=100)] = 1,
    markers: ReadingOptions = _DEFAULT_READING,
    fit: FitOptions = _DEFAULT_OUTPUT,
) -> None:
    """Estimate time constants, gains and rest bends.

    Data are recordings of step responses, or tables or recordings of constant pressures (gains only).

    Options:
        static: Fit plateaus of constant pressure in recordings, and write them to NAME.table.csv.
        starts: Number of searches.
    """
    output = FitOutput.from_options(context, "actuator", data.robot, fit)
    from srs_twin.identification.actuator import Response, fit_actuator
    from srs_twin.identification.static_tables import is_static_table, read_static_table
    from srs_twin.robot.file import load_robot

    spec, kept, names = load_robot(data.robot), data.validate or [], parse_names(find)
    if _all_of_kind([*files, *kept], is_static_table, "table of constant pressures", "recording"):
        _refuse_option(data.valves, "--valves", "tables of constant pressures have no log")
        _refuse_option(static, "--static", "tables of constant pressures already contain plateaus")
        tables, kept_tables = ([read_static_table(path, spec) for path in paths] for paths in (files, kept))
        _fit_static(output, spec, names, tables, kept_tables)
        return
    reader, supply = markers.reader(offset_s=offset), data.supply_pa(spec)
    recordings, kept_recordings = data.recordings(files, reader, spec, quiet=fit.quiet)
    if static:
        _fit_plateaus(output, spec, names, supply, recordings, kept_recordings)
        return
    fitted, validation = (
        [Response.from_recording(recording, path, supply) for path, recording in named]
        for named in (recordings, kept_recordings)
    )
    with output.progress() as watch:
        estimate = fit_actuator(fitted, spec, names=names, validation=validation, starts=starts, watch=watch)
    output.finish(estimate, "actuator", f"Actuators of {spec.name} from responses", fitted, validation)


def _fit_plateaus(
    output: FitOutput,
    spec: RobotSpec,
    names: list[str] | None,
    supply_pa: float,
    recordings: NamedRecordings,
    validation: NamedRecordings,
) -> None:
    """Fit the plateaus of recordings and write them as a table."""
    from srs_twin.identification import static_tables

    tables = static_tables.plateau_tables(recordings, spec, supply_pa)
    kept = [static_tables.StaticTable.from_recording(r, path, spec, supply_pa) for path, r in validation]
    merged = static_tables.merge_tables(tables)
    _fit_static(output, spec, names, tables, kept, merged)
    static_tables.write_static_table(merged, path := output.path.with_suffix(".table.csv"))
    say(f"{len(merged.bend)} plateaus in {display_path(path)}", quiet=output.quiet)


def _fit_static(
    output: FitOutput,
    spec: RobotSpec,
    names: list[str] | None,
    tables: list[StaticTable],
    validation: list[StaticTable],
    merged: StaticTable | None = None,
) -> None:
    """Fit static tables, or one table with the points of all of them."""
    from srs_twin.identification.static_tables import fit_static

    with output.progress() as watch:
        fitted = tables if merged is None else [merged]
        estimate = fit_static(fitted, spec, names=names, validation=validation, watch=watch)
    title = f"Actuators of {spec.name} from held pressures"
    output.finish(estimate, "static", title, tables, validation)


@app.command()
@with_options
def locomotion(
    context: typer.Context,
    files: FilesArgument,
    data: DataOptions,
    find: FindOption = _LOCOMOTION,
    plant: Annotated[str, option("--plant NAME")] = "analytical",
    model: Annotated[str | None, option("--model NAME")] = None,
    law: FloorOption = None,
    against: Annotated[str, option("--against WHAT")] = "both",
    starts: Annotated[int | None, option("--starts N", min=1, max=100)] = None,
    frequency: FrequencyOption = None,
    offset: OffsetOption = None,
    markers: ReadingOptions = _DEFAULT_READING,
    fit: FitOptions = _DEFAULT_OUTPUT,
) -> None:
    """Estimate friction, gap, masses or stiffness.

    If there are markers, the rigid gap (or the length of a segment) is measured from them.

    Options:
        plant: Simulated plant: analytical or twin.
        model: Analytical model. [default: compliant]
        against: Compared signals: averages, shapes or both.
        starts: Number of searches. [default: 3; 1 with the twin's shapes]
    """
    output = FitOutput.from_options(context, "locomotion", data.robot, fit)
    from srs_twin.identification.locomotion import PlantModel, fit_locomotion, measured_length
    from srs_twin.identification.parameters import with_values
    from srs_twin.robot.file import load_robot

    spec, names = load_robot(data.robot), parse_names(find) or []
    plant_model = PlantModel(plant, _plant_settings(plant, model, law))
    reader = markers.reader(offset_s=offset, gait_frequency_hz=frequency)
    supply = data.supply_pa(spec)  # checked before the recordings are read
    with interruptible(NOTHING_WRITTEN):
        recordings, kept = data.recordings(files, reader, spec, quiet=fit.quiet)
        length = measured_length([recording for _, recording in recordings], spec, names)
        if length is not None:  # bends and centre of mass depend on the length, so read the recordings again
            spec = with_values(spec, {length.name: length.value or 0.0})
            recordings, kept = data.recordings(files, reader, spec, quiet=True)
            length = measured_length([recording for _, recording in recordings], spec, names)
    runs, validation = (_gait_runs(named, supply, fit.quiet) for named in (recordings, kept))
    with output.progress() as watch:
        estimate = fit_locomotion(
            runs,
            spec,
            names,
            model=plant_model,
            against=against,
            validation=validation,
            starts=starts or (1 if plant == "twin" and against != "averages" else 3),
            watch=watch,
            reference=None if plant == "twin" else PlantModel("twin"),
            known=[length] if length else [],
        )
    title = f"Locomotion of {spec.name} against the {plant} plant"
    output.finish(estimate, "locomotion", title, runs, validation)


def _gait_runs(recordings: NamedRecordings, supply_pa: float, quiet: bool) -> list[GaitRun]:
    """Return recordings as gait runs, with a warning if chambers are filling at the start."""
    from srs_twin.identification.locomotion import gait_run

    for path, recording in recordings:
        if not recording.starts_at_rest():
            warning = f"warning: {path}: chambers are filling at the start; the plants start with empty ones"
            say(warning, quiet=quiet)
    return [gait_run(recording, path, supply_pa) for path, recording in recordings]


@app.command()
@with_options
def robot(
    fits: Annotated[list[str], argument("FIT")],
    name: Annotated[str, option("--name NAME")],
    out: Annotated[str | None, option("--out FILE.yaml")] = None,
    weak: Annotated[bool, option("--weak/--no-weak")] = True,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a robot file with the results of fits.

    Options:
        fits: Fit files of one robot; later ones override earlier ones.
        name: Name of the new robot and its file.
        out: Robot file. [default: robots/NAME.yaml]
        weak: Include weakly identified parameters.
    """
    from srs_twin.identification.fitted_robot import fitted_robot, write_robot
    from srs_twin.io.files import check_output_folder

    path = Path(out) if out else Path("robots") / f"{name}.yaml"
    check_output_folder(path.parent, (path.name,))
    if os.path.lexists(path) and not overwrite:
        raise InputError(
            f"{display_path(path)}: the file exists; --overwrite replaces it, --out chooses another"
        )
    robot_file = fitted_robot(fits, name, weak=weak)
    write_robot(robot_file, path)
    if as_json:
        print_json(robot_file.model_dump(mode="json", exclude_none=True))
    say(f"robot in {path}", quiet=quiet)


def _all_of_kind(files: Sequence[str], is_first: Callable[[str], bool], first: str, second: str) -> bool:
    """Return whether all files are of the first kind, False if all are of the second.

    Raises:
        InputError: both kinds occur, or a file cannot be read.
    """
    kinds = [is_first(path) for path in files]
    if len(set(kinds)) > 1:
        one, other = files[kinds.index(True)], files[kinds.index(False)]
        raise InputError(f"{one} is a {first}, {other} a {second}; fit them separately")
    return kinds[0]


def _plant_settings(plant: str, model: str | None, law: str | None) -> dict[str, str]:
    """Return the settings of a fit's plant."""
    if plant == "analytical":
        return {"model": model or "compliant", "friction": law or "wheel"}
    _refuse_option(model, "--model", "it is only for --plant analytical")
    _refuse_option(law, "--law", "it is only for --plant analytical")
    return {}


def _refuse_option(value: object, option: str, why: str) -> None:
    if value:
        raise InputError(f"{option}: remove this option; {why}")


for _command in (footprint, margin):
    app.command()(with_options(_command))
