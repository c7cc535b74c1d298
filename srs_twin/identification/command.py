"""`srs-twin calibrate`: robot parameters from recordings and from simulated runs, with their sources."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.console import RunCounter, console, interruptible, new_table, say
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    FloorOption,
    JobsOption,
    JsonOption,
    OverwriteOption,
    PressureOption,
    QuietOption,
    RobotArgument,
    ScenarioArgument,
    argument,
    expand_option_groups,
    jobs_option,
    option,
    parse_plants,
    print_json,
)
from srs_twin.errors import InputError
from srs_twin.identification.fitting import (
    NOTHING_WRITTEN,
    FilesArgument,
    FindOption,
    FitOptions,
    FitOutput,
    RobotOption,
    ValidateOption,
    check_name,
    parse_names,
    print_table,
)
from srs_twin.io.files import display_path
from srs_twin.recordings.commands import FrequencyOption, OffsetOption, ReadingOptions, ValvesOption

if TYPE_CHECKING:
    from srs_twin.identification.footprint import FootprintMeasurement
    from srs_twin.planning.footprint import Transient
    from srs_twin.recordings.recording import Recording
    from srs_twin.recordings.takes import RecordingReader
    from srs_twin.robot.spec import RobotSpec


FOOTPRINTS = "calibration/footprints"

_LOCOMOTION = "friction.mu_t,friction.mu_n,geometry.rigid_gap_m,bending.stiffness_nm_per_rad"
"""Parameters that `calibrate locomotion` fits by default."""

_FREQUENCY_HZ = {"gait": 2.0, "ilc": 1.5}
"""Default gait frequency of a footprint, by controller."""

_DEFAULT_READING = ReadingOptions()
_DEFAULT_OUTPUT = FitOptions()

app = typer.Typer(
    rich_markup_mode=None, no_args_is_help=True, help="Robot parameters from recordings and runs."
)


@app.callback()
def calibrate() -> None:
    """Estimate parameters of a robot from recordings, and footprints and margins from simulated runs."""


@app.command()
@expand_option_groups
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
@expand_option_groups
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

    from srs_twin.cli.console import console, new_table
    from srs_twin.identification.design import choose_experiments
    from srs_twin.robot.file import load_robot, load_robot_file
    from srs_twin.robot.priors import Priors

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
@expand_option_groups
def actuator(
    context: typer.Context,
    files: FilesArgument,
    robot: RobotOption,
    valves: ValvesOption = None,
    validate: ValidateOption = None,
    pressure: PressureOption = None,
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
    output = FitOutput.from_options(context, "actuator", robot, fit)
    from srs_twin.identification import actuator as fits
    from srs_twin.robot.file import load_robot

    spec, kept, names = load_robot(robot), validate or [], parse_names(find)

    def finish_static(tables: list[fits.StaticTable], validation: list[fits.StaticTable]) -> None:
        with output.progress() as watch:
            fitted = [fits.merge_tables(tables)] if static else tables
            estimate = fits.fit_static(fitted, spec, names=names, validation=validation, watch=watch)
        title = f"Actuators of {spec.name} from held pressures"
        output.finish(estimate, "static", title, tables, validation)
        if static:
            fits.write_static_table(fitted[0], path := output.path.with_suffix(".table.csv"))
            say(f"{len(fitted[0].bend)} plateaus in {display_path(path)}", quiet=fit.quiet)

    if _all_of_kind([*files, *kept], fits.is_static_table, "table of constant pressures", "recording"):
        _refuse_option(valves, "--valves", "tables of constant pressures have no log")
        _refuse_option(static, "--static", "tables of constant pressures already contain plateaus")
        finish_static(*([fits.read_static_table(path, spec) for path in paths] for paths in (files, kept)))
        return
    reader = markers.reader(offset_s=offset)
    supply = _supply(spec, pressure)
    recordings, count = _read_recordings([*files, *kept], valves, reader, spec, fit.quiet), len(files)
    if static:
        tables = fits.plateau_tables(recordings[:count], spec, supply)
        validation_tables = [
            fits.StaticTable.from_recording(recording, path, spec, supply)
            for path, recording in recordings[count:]
        ]
        finish_static(tables, validation_tables)
        return
    responses = [fits.Response.from_recording(recording, path, supply) for path, recording in recordings]
    fitted, validation = responses[:count], responses[count:]
    with output.progress() as watch:
        estimate = fits.fit_actuator(
            fitted, spec, names=names, validation=validation, starts=starts, watch=watch
        )
    output.finish(estimate, "actuator", f"Actuators of {spec.name} from responses", fitted, validation)


@app.command()
@expand_option_groups
def locomotion(
    context: typer.Context,
    files: FilesArgument,
    robot: RobotOption,
    valves: ValvesOption = None,
    validate: ValidateOption = None,
    pressure: PressureOption = None,
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
    output = FitOutput.from_options(context, "locomotion", robot, fit)
    from srs_twin.identification.locomotion import PlantModel, fit_locomotion, gait_run, measured_length
    from srs_twin.identification.parameters import with_values
    from srs_twin.recordings.takes import starts_at_rest
    from srs_twin.robot.file import load_robot

    spec, kept, names = load_robot(robot), validate or [], parse_names(find) or []
    plant_model = PlantModel(plant, _plant_settings(plant, model, law))
    reader = markers.reader(offset_s=offset, gait_frequency_hz=frequency)
    supply, count = _supply(spec, pressure), len(files)
    with interruptible(NOTHING_WRITTEN):
        recordings = _read_recordings([*files, *kept], valves, reader, spec, fit.quiet)
        length = measured_length([recording for _, recording in recordings[:count]], spec, names)
        if length is not None:  # bends and centre of mass depend on the length, so read the recordings again
            spec = with_values(spec, {length.name: length.value or 0.0})
            recordings = _read_recordings([*files, *kept], valves, reader, spec, quiet=True)
            length = measured_length([recording for _, recording in recordings[:count]], spec, names)
    for path, recording in recordings:
        if not starts_at_rest(recording):
            warning = f"warning: {path}: chambers are filling at the start; the plants start with empty ones"
            say(warning, quiet=fit.quiet)
    runs = [gait_run(recording, path, supply) for path, recording in recordings]
    fitted, validation = runs[:count], runs[count:]
    with output.progress() as watch:
        estimate = fit_locomotion(
            fitted,
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
    output.finish(estimate, "locomotion", title, fitted, validation)


@app.command()
@expand_option_groups
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


def _read_recordings(
    files: Sequence[str], valves: Sequence[str] | None, reader: RecordingReader, spec: RobotSpec, quiet: bool
) -> list[tuple[str, Recording]]:
    """Return (path, recording with its log) of each file, and print their summaries."""
    from srs_twin.recordings.takes import logs_of

    recordings = []
    for path, log in zip(files, logs_of(files, valves or []), strict=True):
        recording = reader.take(path, log, spec)
        say(recording.summary.text(), "", quiet=quiet)
        recordings.append((path, recording))
    return recordings


def _supply(spec: RobotSpec, pressure_kpa: float | None) -> float:
    """Return the gauge pressure of the supply, Pa."""
    if pressure_kpa is None:
        return spec.supply.nominal
    if not 0.1 <= pressure_kpa <= 2000.0:
        raise InputError(f"--pressure: {pressure_kpa:g} kPa is not allowed; it must be from 0.1 to 2000")
    return 1e3 * pressure_kpa


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


@app.command()
@expand_option_groups
def footprint(
    robot: RobotArgument,
    controller: Annotated[str, option("--controller NAME")] = "gait",
    frequency: Annotated[float | None, option("--frequency HZ")] = None,
    pressure: PressureOption = None,
    target: Annotated[float, option("--target RAD")] = 0.7,
    plant: Annotated[str, option("--plant NAME")] = "twin",
    contact: Annotated[str | None, option("--contact NAME")] = None,
    chambers: Annotated[str, option("--chambers NAME")] = "lag",
    offsets: Annotated[str | None, option("--offsets LIST")] = None,
    transients: Annotated[bool, option("--transients/--no-transients")] = True,
    periods: Annotated[int, option("--periods N")] = 6,
    phases: Annotated[int, option("--phases N")] = 4,
    threads: Annotated[int | None, jobs_option("--threads -j N")] = None,
    out: Annotated[str, option("--out DIR")] = FOOTPRINTS,
    name: Annotated[str | None, option("--name NAME")] = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure the area swept at each offset.

    With --transients, the area swept during changes of offset is measured as well.

    Options:
        controller: Controller: gait (open loop) or ilc (learning).
        frequency: Gait frequency. [default: 2, ilc 1.5]
        target: Target bend amplitude of ilc, rad.
        plant: Simulated plant: twin or analytical.
        contact: Contact of the twin, loaded or preloaded. [default: the twin's]
        chambers: Pneumatic model: lag, or orifice for compressible flow.
        offsets: Offsets, e.g. --offsets=-0.3,0,0.3. [default: -0.4 to 0.4; ilc: -0.3 to 0.3]
        transients: Also measure changes of offset.
        periods: Measured gait periods of each run.
        phases: Runs per offset, with different initial phases.
        out: Output folder.
        name: Name of the footprint and its file. [default: ROBOT_CONTROLLER]
    """
    requested_offsets = None if offsets is None else _parse_numbers(offsets)
    from srs_twin.identification.footprint import (
        GaitSetup,
        check_same_study,
        footprint_file,
        footprint_study,
        header_lines,
    )
    from srs_twin.io.files import check_output_folder
    from srs_twin.planning.footprint_file import save_footprint
    from srs_twin.robot.file import load_robot
    from srs_twin.scenario.provenance import versions

    spec = load_robot(robot)
    supply = spec.supply.nominal if pressure is None else 1000 * pressure
    frequency_hz = _FREQUENCY_HZ.get(controller, 1.0) if frequency is None else frequency
    setup = GaitSetup(
        spec, frequency_hz, supply, controller, target, plant, chambers=chambers, contact=contact
    )
    changes = None if transients else ()
    study = footprint_study(setup, offsets=requested_offsets, changes=changes, periods=periods, phases=phases)
    file_name = check_name(f"{spec.name}_{controller}" if name is None else name, "--name")
    path = Path(out) / f"{file_name}.yaml"
    if not overwrite:
        check_same_study(path, study, robot, file_name)
    check_output_folder(path.parent, (path.name,))
    with interruptible(NOTHING_WRITTEN), RunCounter(file_name, study.runs, quiet=quiet) as counting:
        measured = study.measure(threads=threads, progress=lambda done: counting(failed=False))
    file = footprint_file(measured, file_name)
    if as_json:
        print_json(file.model_dump(mode="json", exclude_none=True))
    elif not quiet:
        _print_footprint(measured)
    save_footprint(file, path, header=header_lines(study, robot, file_name, versions()))
    say(f"footprint in {display_path(path)}", quiet=quiet)


@app.command()
@expand_option_groups
def margin(
    scenario: ScenarioArgument,
    runs: Annotated[int, option("--runs N", min=20, max=10_000)] = 100,
    plants: Annotated[str | None, option("--plants LIST")] = None,
    jobs: JobsOption = None,
    out: Annotated[str, option("--out DIR")] = FOOTPRINTS,
    changes: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure excursions from a followed path.

    Random paths are followed under the conditions of a scenario. The excursions are written to the footprint
    file, from which planner.margin_probability derives a margin.

    Options:
        runs: Number of runs on each plant.
        plants: Plants: analytical, twin or both. [default: the scenario's]
        out: Output folder of the footprint file.
    """
    from srs_twin.identification.excursions import measure_excursions
    from srs_twin.io.documents import Override
    from srs_twin.io.files import check_output_folder, find_file, read_text
    from srs_twin.planning.footprint_file import load_footprint_file, save_footprint
    from srs_twin.planning.footprint_file import excursion_quantile
    from srs_twin.scenario.loading import load_scenario

    # Remove the margin of the scenario, which would hide the excursions to be measured.
    no_margin = Override("a margin to be measured", ("planner", "margin_probability"), None)
    loaded = load_scenario(scenario, set=[*changes.changes(), no_margin])
    plant_names = parse_plants(plants) or list(loaded.plants)
    assert loaded.file.section("planner") is not None, "a change of the planner requires one"
    source = find_file("footprint", loaded.file.section("planner").footprint)
    path = Path(out) / f"{load_footprint_file(source).name}.yaml"
    check_output_folder(path.parent, (path.name,))
    total = runs * len(plant_names)
    with interruptible(NOTHING_WRITTEN), RunCounter(loaded.name, total, quiet=quiet) as counting:
        measured = [
            measure_excursions(loaded, plant, runs, workers=jobs, progress=lambda: counting(failed=False))
            for plant in plant_names
        ]
    file = load_footprint_file(source)
    new_conditions = [result.conditions for result in measured]
    kept = [old for old in file.excursions or () if old.conditions not in new_conditions]
    comments = [line[2:] for line in read_text(source).splitlines() if line.startswith("# ")]
    save_footprint(file.model_copy(update={"excursions": [*kept, *measured]}), path, header=comments)
    if as_json:
        print_json([result.model_dump(mode="json", exclude_none=True) for result in measured])
    elif not quiet:
        table = new_table("plant", "half of the runs", "90 %", "95 %", "all, mm")
        for result in measured:
            quantiles = [excursion_quantile(result.path_m, share) for share in (0.5, 0.9, 0.95)] + [
                result.path_m[-1]
            ]
            table.add_row(result.conditions.plant, *(f"{1000 * value:.0f}" for value in quantiles))
        console().print(table)
    say(f"excursions in {display_path(path)}", quiet=quiet)


def _parse_numbers(text: str) -> list[float]:
    """Return the numbers in a list such as -0.3,0,0.3, in ascending order.

    Raises:
        InputError: an entry is not a number.
    """
    try:
        return sorted(float(number) for number in text.split(","))
    except ValueError:
        raise InputError(f"--offsets: '{text}' is not a list of numbers such as -0.3,0,0.3") from None


def _print_footprint(measured: FootprintMeasurement) -> None:
    """Print the tables of steady paths and transients."""
    from srs_twin.identification.footprint import table_rows

    print_table(("offset", "speed m/s", "curvature 1/m", "left m", "right m"), table_rows(measured))
    if measured.transients:
        headings = ("offset", "left m", "right m", "over m", "dx m", "dy m", "dheading rad")
        print_table(headings, map(_transient_row, measured.transients))


def _transient_row(change: Transient) -> tuple[str, ...]:
    numbers = (change.left, change.right, change.length, change.dx, change.dy, change.dheading)
    return f"{change.before:g} to {change.after:g}", *(f"{number:.3f}" for number in numbers)
