"""`srs-twin calibrate`: numbers of a robot from its recordings and from runs, written with their source."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.console import console, interruptible, new_table, say
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
    at_once,
    option,
    plants_of,
    print_json,
    with_options,
)
from srs_twin.cli.progress import Counting
from srs_twin.errors import InputError
from srs_twin.identification.fitting import (
    NOTHING_WRITTEN,
    FitDestination,
    checked_name,
    names_in,
    print_table,
)
from srs_twin.identification.options import FilesArgument, FindOption, FitOptions, RobotOption, ValidateOption
from srs_twin.io.files import shown
from srs_twin.recordings.options import FrequencyOption, OffsetOption, ReadingOptions, ValvesOption

if TYPE_CHECKING:
    from srs_twin.identification.footprint import Measured
    from srs_twin.planning.footprint import Transient
    from srs_twin.recordings.recording import Recording
    from srs_twin.recordings.takes import RecordingReader
    from srs_twin.robot.spec import RobotSpec


FOOTPRINTS = "calibration/footprints"

_LOCOMOTION = "friction.mu_t,friction.mu_n,geometry.rigid_gap_m,bending.stiffness_nm_per_rad"
_FREQUENCY_HZ = {"gait": 2.0, "ilc": 1.5}
_AS_FOUND, _BESIDE = ReadingOptions(), FitOptions()

app = typer.Typer(
    rich_markup_mode=None, no_args_is_help=True, help="Numbers of a robot from recordings and runs."
)


@app.callback()
def calibrate() -> None:
    """Find numbers of a robot from its recordings, and what files hold from runs."""


@app.command()
@with_options
def friction(
    context: typer.Context,
    files: FilesArgument,
    robot: RobotOption,
    validate: ValidateOption = None,
    law: Annotated[str, option("--law NAME")] = "wheel",
    wheel_inertia: Annotated[bool, option("--wheel-inertia/--no-wheel-inertia")] = True,
    markers: ReadingOptions = _AS_FOUND,
    fit: FitOptions = _BESIDE,
) -> None:
    """Find mu_t and mu_n from pulls or from throws.

    Pulls are a table of deflections of a spring car, throws recordings.

    Options:
        law: Of sliding throws: wheel, axis or ellipse (skids).
        wheel_inertia: Whether throws spin wheels up.
    """
    place = FitDestination.of(context, "friction", robot, fit)
    from srs_twin.identification.friction import Coasting, fit_coasting, fit_pulls, is_pulls, read_pulls
    from srs_twin.robot.file import load_robot

    spec, kept = load_robot(robot), validate or []
    if _alike([*files, *kept], is_pulls, "tables of pulls", "recordings of throws"):
        if len(files) > 1:
            raise InputError(f"{files[1]}: one table of pulls makes a fit; give others with --validate")
        pulls, others = read_pulls(files[0]), [read_pulls(each) for each in kept]
        found = fit_pulls(pulls, validation=others)
        place.finish(found, "pulls", f"Friction of {spec.name} from pulls", [pulls], others)
        return
    how = markers.reader()

    def throw(path: str) -> Coasting:
        recording = how.motion(path, spec)
        say(recording.summary.text(), quiet=fit.quiet)
        return Coasting.of(recording.trajectory, path)

    throws, held = [throw(each) for each in files], [throw(each) for each in kept]
    with place.searching() as watch:
        found = fit_coasting(throws, spec, validation=held, law=law, wheel_inertia=wheel_inertia, watch=watch)
    place.finish(found, "coasting", f"Friction of {spec.name} from throws", throws, held)


@app.command()
@with_options
def design(
    robot: RobotArgument,
    want: Annotated[str, option("--want NAMES")],
    as_json: JsonOption = False,
) -> None:
    """Choose what to record, as a sheet for the lab.

    Candidates are pulls, weighing, markers, held pressures, steps and walks.

    Options:
        want: Numbers and half of their 95 % intervals, as friction.mu_t=5%,bending.stiffness_nm_per_rad=10%.
    """
    import numpy as np

    from srs_twin.cli.console import console, new_table
    from srs_twin.identification.design import design as designed
    from srs_twin.robot.file import load_robot, load_robot_file
    from srs_twin.robot.priors import Priors

    wanted = {}
    for text in want.split(","):
        name, _, share = text.strip().partition("=")
        try:
            wanted[name] = float(share.removesuffix("%") or 10) / 100
        except ValueError:
            raise InputError(f"--want {text}: must be NAME=PERCENT, as in friction.mu_t=5%") from None
    file, shares = load_robot_file(robot), (np.arange(64) + 0.5) / 64
    doubted = any(record.uncertain for record in file.records().values())
    priors = Priors.of(file).each if doubted else ()
    known = {prior.path: (prior.value, float(prior.at(shares).std())) for prior in priors}
    with interruptible("nothing was chosen"):
        found = designed(load_robot(robot), known, wanted)
    if as_json:
        print_json(found.document())
        return
    lines = new_table("half of the 95 % interval", "min", *(name.partition(".")[2] for name in wanted))
    lines.add_row("as the file knows them", "", *(f"{100 * each:.0f} %" for each in found.before.values()))
    for k, each in enumerate(found.chosen):
        after = (f"{100 * row[k]:.1f} %" for row in found.after.values())
        lines.add_row(f"after {k + 1}", f"{each.minutes:g}", *after)
    console().print(lines)
    for k, each in enumerate(found.chosen, start=1):
        print(f"{k}. {each.what}")
    print("The model is taken to be right.")
    for name in found.unmet:
        print(f"{name}: no further recording of these kinds narrows it to {100 * wanted[name]:g} %")


@app.command()
@with_options
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
    markers: ReadingOptions = _AS_FOUND,
    fit: FitOptions = _BESIDE,
) -> None:
    """Find time constants, gains and biases of free segments.

    From recordings of step responses, or gains alone from tables or recordings of held pressures.

    Options:
        static: Recordings hold pressures: fit plateaus, and write them as NAME.table.csv.
        starts: Searches.
    """
    place = FitDestination.of(context, "actuator", robot, fit)
    from srs_twin.identification import actuator as fits
    from srs_twin.robot.file import load_robot

    spec, kept, names = load_robot(robot), validate or [], names_in(find)

    def finish_static(tables: list[fits.StaticTable], others: list[fits.StaticTable]) -> None:
        with place.searching() as watch:
            one = [fits.merged(tables)] if static else tables
            found = fits.fit_static(one, spec, names=names, validation=others, watch=watch)
        place.finish(found, "static", f"Actuators of {spec.name} from held pressures", tables, others)
        if static:
            fits.write_static(one[0], path := place.path.with_suffix(".table.csv"))
            say(f"{len(one[0].bend)} plateaus in {shown(path)}", quiet=fit.quiet)

    if _alike([*files, *kept], fits.is_static, "tables of held pressures", "recordings"):
        _needless(valves, "--valves", "tables of held pressures have no log")
        _needless(static, "--static", "tables of held pressures hold plateaus already")
        finish_static(*([fits.read_static(each, spec) for each in given] for given in (files, kept)))
        return
    how = markers.reader(offset_s=offset)
    supply = _supply(spec, pressure)
    takes, at = _takes([*files, *kept], valves, how, spec, fit.quiet), len(files)
    if static:
        others = [fits.StaticTable.of_recording(take, path, spec, supply) for path, take in takes[at:]]
        finish_static(fits.static_tables(takes[:at], spec, supply), others)
        return
    responses = [fits.Response.of_recording(take, path, supply) for path, take in takes]
    fitted, held = responses[:at], responses[at:]
    with place.searching() as watch:
        found = fits.fit_actuator(fitted, spec, names=names, validation=held, starts=starts, watch=watch)
    place.finish(found, "actuator", f"Actuators of {spec.name} from responses", fitted, held)


@app.command()
@with_options
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
    markers: ReadingOptions = _AS_FOUND,
    fit: FitOptions = _BESIDE,
) -> None:
    """Find friction, gap, masses or stiffness from crawling runs.

    The rigid gap (or the length of a segment) is measured from markers where there are any.

    Options:
        plant: Stands for the robot: analytical or twin.
        model: Analytical model. [default: compliant]
        against: What is compared: averages, shapes or both.
        starts: Searches. [default: 3; 1 where the twin's shapes lead]
    """
    place = FitDestination.of(context, "locomotion", robot, fit)
    from srs_twin.identification.locomotion import PlantModel, fit_locomotion
    from srs_twin.identification.recorded_runs import gait_run, measured_length
    from srs_twin.identification.unknowns import with_values
    from srs_twin.recordings.takes import starts_at_rest
    from srs_twin.robot.file import load_robot

    spec, kept, names = load_robot(robot), validate or [], names_in(find) or []
    stands = PlantModel(plant, _plant_settings(plant, model, law))
    how = markers.reader(offset_s=offset, gait_frequency_hz=frequency)
    supply = _supply(spec, pressure)
    with interruptible(NOTHING_WRITTEN):
        takes = _takes([*files, *kept], valves, how, spec, fit.quiet)
        known = measured_length([take for _, take in takes[: len(files)]], spec, names)
        if known is not None:  # bends and centre of mass, too, are those of a body with this length
            spec = with_values(spec, {known.name: known.value or 0.0})
            takes = _takes([*files, *kept], valves, how, spec, quiet=True)
            known = measured_length([take for _, take in takes[: len(files)]], spec, names)
    for path, take in takes:
        if not starts_at_rest(take):
            warning = f"warning: {path}: it begins while chambers fill; the plants begin with empty ones"
            say(warning, quiet=fit.quiet)
    runs = [gait_run(take, path, supply) for path, take in takes]
    fitted, held = runs[: len(files)], runs[len(files) :]
    starts = starts or (1 if plant == "twin" and against != "averages" else 3)
    fit_runs = partial(fit_locomotion, fitted, spec, names, model=stands, against=against)
    better, lengths = (None if plant == "twin" else PlantModel("twin")), ([known] if known else [])
    with place.searching() as watch:
        found = fit_runs(validation=held, starts=starts, watch=watch, reference=better, known=lengths)
    place.finish(found, "locomotion", f"Locomotion of {spec.name} against the {plant} plant", fitted, held)


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
    """Write a robot file: where fits began, with what they found.

    Options:
        fits: Fit files of one robot; later ones count.
        name: Of the new robot and its file.
        out: [default: robots/NAME.yaml]
        weak: Take what is only weakly identified as well.
    """
    from srs_twin.identification.fitted_robot import fitted_robot, write_robot
    from srs_twin.io.files import open_folder

    path = Path(out) if out else Path("robots") / f"{name}.yaml"
    open_folder(path.parent, (path.name,))
    if os.path.lexists(path) and not overwrite:
        raise InputError(f"{shown(path)}: exists already; --overwrite replaces it, --out leads elsewhere")
    found = fitted_robot(fits, name, weak=weak)
    write_robot(found, path)
    if as_json:
        print_json(found.model_dump(mode="json", exclude_none=True))
    say(f"robot in {path}", quiet=quiet)


def _alike(files: Sequence[str], tells: Callable[[str], bool], one: str, other: str) -> bool:
    """Say whether files are of one kind; refuse some of each.

    Raises:
        InputError: they are of both kinds, or one cannot be read.
    """
    kinds = [tells(each) for each in files]
    if len(set(kinds)) > 1:
        first, second = files[kinds.index(True)], files[kinds.index(False)]
        raise InputError(f"{first} is one of {one}, {second} one of {other}: give them to a fit each")
    return kinds[0]


def _takes(
    files: Sequence[str], valves: Sequence[str] | None, how: RecordingReader, spec: RobotSpec, quiet: bool
) -> list[tuple[str, Recording]]:
    """Return (path, recording with its log) of each file, and say what was read."""
    from srs_twin.recordings.takes import logs_of

    found = []
    for path, log in zip(files, logs_of(files, valves or []), strict=True):
        take = how.take(path, log, spec)
        say(take.summary.text(), "", quiet=quiet)
        found.append((path, take))
    return found


def _supply(spec: RobotSpec, pressure_kpa: float | None) -> float:
    """Return the supply's gauge pressure, Pa."""
    if pressure_kpa is None:
        return spec.supply.nominal
    if not 0.1 <= pressure_kpa <= 2000.0:
        raise InputError(f"--pressure: {pressure_kpa:g} kPa is not allowed; it must be from 0.1 to 2000")
    return 1e3 * pressure_kpa


def _plant_settings(plant: str, model: str | None, law: str | None) -> dict[str, str]:
    """Return the settings of the plant that stands for the robot."""
    if plant == "analytical":
        return {"model": model or "compliant", "friction": law or "wheel"}
    _needless(model, "--model", "it belongs to --plant analytical")
    _needless(law, "--law", "it belongs to --plant analytical")
    return {}


def _needless(given: object, option: str, why: str) -> None:
    if given:
        raise InputError(f"{option}: take it out; {why}")


@app.command()
@with_options
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
    threads: Annotated[int | None, at_once("--threads -j N")] = None,
    out: Annotated[str, option("--out DIR")] = FOOTPRINTS,
    name: Annotated[str | None, option("--name NAME")] = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure what a robot sweeps at each offset, for the planner.

    With transients also what it sweeps as the offset changes.

    Options:
        controller: gait (open loop) or ilc (learning).
        frequency: Of the gait. [default: 2, ilc 1.5]
        target: Bend that ilc aims at.
        plant: twin or analytical.
        contact: Contact of the twin, loaded or preloaded. [default: the twin's]
        chambers: lag, or orifice for compressible flow.
        offsets: As --offsets=-0.3,0,0.3. [default: to +-0.4; ilc: to +-0.3]
        transients: Measure changes of offset.
        periods: Gait periods measured of each run.
        phases: Runs an offset, each begun at another phase.
        out: Folder of the file.
        name: Of the footprint and its file. [default: ROBOT_CONTROLLER]
    """
    wanted = None if offsets is None else _numbers(offsets)
    from srs_twin.identification.footprint import Drive, footprint_file, header, refuse_other
    from srs_twin.identification.footprint import study as study_of
    from srs_twin.io.files import open_folder
    from srs_twin.planning.footprint import save_footprint
    from srs_twin.robot.file import load_robot
    from srs_twin.scenario.provenance import versions

    spec = load_robot(robot)
    supply = spec.supply.nominal if pressure is None else 1000 * pressure
    beat = _FREQUENCY_HZ.get(controller, 1.0) if frequency is None else frequency
    drive = Drive(spec, beat, supply, controller, target, plant, chambers=chambers, contact=contact)
    study = study_of(
        drive, offsets=wanted, changes=None if transients else (), periods=periods, phases=phases
    )
    called = checked_name(f"{spec.name}_{controller}" if name is None else name, "--name")
    path = Path(out) / f"{called}.yaml"
    if not overwrite:
        refuse_other(path, study, robot, called)
    open_folder(path.parent, (path.name,))
    with interruptible(NOTHING_WRITTEN), Counting(called, study.runs, quiet=quiet) as counting:
        measured = study.measure(threads=threads, progress=lambda done: counting(failed=False))
    file = footprint_file(measured, called)
    if as_json:
        print_json(file.model_dump(mode="json", exclude_none=True))
    elif not quiet:
        _show(measured)
    save_footprint(file, path, header=header(study, robot, called, versions()))
    say(f"footprint in {shown(path)}", quiet=quiet)


@app.command()
@with_options
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
    """Measure how far a follower leaves its footprint.

    Random ways are followed under the conditions of a scenario. The excursions go into the footprint's file,
    where planner.margin_probability finds them.

    Options:
        runs: On each plant.
        plants: analytical, twin or both. [default: the scenario's]
        out: Folder of the footprint's file.
    """
    from srs_twin.identification.excursions import excursions
    from srs_twin.io.documents import Change
    from srs_twin.io.files import find, open_folder, read_text
    from srs_twin.planning.footprint import load_footprint_file, save_footprint
    from srs_twin.planning.margins import excursion_quantile
    from srs_twin.scenario.loading import load_scenario

    # Whatever margin the scenario wants, it is not what is measured.
    none = Change("a margin to be measured", ("planner", "margin_probability"), None)
    found = load_scenario(scenario, set=[*changes.changes(), none])
    chosen = plants_of(plants) or list(found.plants)
    assert found.file.section("planner") is not None, "a margin of it was set"
    place = find("footprint", found.file.section("planner").footprint)
    path = Path(out) / f"{load_footprint_file(place).name}.yaml"
    open_folder(path.parent, (path.name,))
    with interruptible(NOTHING_WRITTEN), Counting(found.name, runs * len(chosen), quiet=quiet) as counting:
        measured = [
            excursions(found, plant, runs, workers=jobs, progress=lambda: counting(failed=False))
            for plant in chosen
        ]
    file = load_footprint_file(place)
    fresh = [each.conditions for each in measured]
    kept = [each for each in file.excursions or () if each.conditions not in fresh]
    comments = [line[2:] for line in read_text(place).splitlines() if line.startswith("# ")]
    save_footprint(file.model_copy(update={"excursions": [*kept, *measured]}), path, header=comments)
    if as_json:
        print_json([each.model_dump(mode="json", exclude_none=True) for each in measured])
    elif not quiet:
        table = new_table("plant", "half of the runs", "90 %", "95 %", "all, mm")
        for each in measured:
            shares = [excursion_quantile(each.path_m, share) for share in (0.5, 0.9, 0.95)] + [
                each.path_m[-1]
            ]
            table.add_row(each.conditions.plant, *(f"{1000 * value:.0f}" for value in shares))
        console().print(table)
    say(f"excursions in {shown(path)}", quiet=quiet)


def _numbers(text: str) -> list[float]:
    """Return the numbers of a list such as -0.3,0,0.3, sorted.

    Raises:
        InputError: something in it is none.
    """
    try:
        return sorted(float(each) for each in text.split(","))
    except ValueError:
        raise InputError(f"--offsets: '{text}' is no list of numbers such as -0.3,0,0.3") from None


def _show(measured: Measured) -> None:
    """Print the table, and what changes of offset cost."""
    from srs_twin.identification.footprint import rows

    print_table(("offset", "speed m/s", "curvature 1/m", "left m", "right m"), rows(measured))
    if measured.transients:
        headings = ("offset", "left m", "right m", "over m", "dx m", "dy m", "dheading rad")
        print_table(headings, map(_change_row, measured.transients))


def _change_row(each: Transient) -> tuple[str, ...]:
    numbers = (each.left, each.right, each.length, each.dx, each.dy, each.dheading)
    return f"{each.before:g} to {each.after:g}", *(f"{number:.3f}" for number in numbers)
