"""`srs-twin calibrate footprint` and `margin`: footprints, and excursions from followed paths."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from srs_twin.cli.console import RunCounter, console, interruptible, new_table, say
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    JobsOption,
    JsonOption,
    OverwriteOption,
    PressureOption,
    QuietOption,
    RobotArgument,
    ScenarioArgument,
    jobs_option,
    option,
    parse_plants,
    print_json,
)
from srs_twin.errors import InputError
from srs_twin.identification.fitting import NOTHING_WRITTEN, check_name, print_table
from srs_twin.io.files import display_path

if TYPE_CHECKING:
    from srs_twin.identification.footprint import FootprintMeasurement
    from srs_twin.planning.footprint import Transient

FOOTPRINTS = "calibration/footprints"
"""Default folder of footprint files."""

_FREQUENCY_HZ = {"gait": 2.0, "ilc": 1.5}
"""Default gait frequency of a footprint, by controller."""


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
    from srs_twin.identification.footprint import GaitSetup, footprint_study
    from srs_twin.identification.footprint_report import check_same_study, footprint_file, header_lines
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
    from srs_twin.planning.footprint_file import excursion_quantile, load_footprint_file, save_footprint
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
    """Print the tables of steady paths, with half the range over the repeats, and of transients."""
    rows = [
        (
            f"{offset:g}",
            *(
                f"{getattr(path, name):.4f} ± {getattr(spread, name):.4f}"
                for name in ("speed", "curvature", "left", "right")
            ),
        )
        for offset, path, spread in zip(measured.offsets, measured.steady, measured.spread, strict=True)
    ]
    print_table(("offset", "speed m/s", "curvature 1/m", "left m", "right m"), rows)
    if measured.transients:
        headings = ("offset", "left m", "right m", "over m", "dx m", "dy m", "dheading rad")
        print_table(headings, map(_transient_row, measured.transients))


def _transient_row(change: Transient) -> tuple[str, ...]:
    before, after, *numbers = astuple(change)
    return f"{before:g} to {after:g}", *(f"{number:.3f}" for number in numbers)
