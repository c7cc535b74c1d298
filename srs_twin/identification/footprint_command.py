"""Commands `srs-twin calibrate footprint` and `srs-twin calibrate margin`."""

from __future__ import annotations

from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from srs_twin.cli.console import RunCounter, interruptible, say
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    JsonOption,
    OptionRange,
    OverwriteOption,
    PressureOption,
    QuietOption,
    RobotArgument,
    ScenarioArgument,
    WorkersOption,
    parse_plants,
    print_json,
    workers_option,
)
from srs_twin.errors import InputError
from srs_twin.identification.fitting import NOTHING_WRITTEN, print_table
from srs_twin.io.files import display_path

if TYPE_CHECKING:
    from srs_twin.identification.footprint import FootprintMeasurement

FOOTPRINTS = "calibration/footprints"
"""Default folder of footprint files."""


@dataclass(frozen=True)
class MeasurementOptions:
    """Options for the runs from which a footprint is measured.

    Options:
        --controller NAME: Controller of the robot: gait (open loop) or ilc (iterative
            learning control).
        --frequency HZ: Frequency of the gait in Hz. [default: 2, or 1.5 for ilc]
        --target RAD: Target bend amplitude in rad, used only by the ilc controller.
        --plant NAME: Model to simulate: twin or analytical.
        --contact NAME: Contact model of the twin: loaded (friction depends on the
            instantaneous wheel load) or preloaded (friction under static loads).
            [default: loaded]
        --chambers NAME: Pneumatic model of the chambers: lag (first order) or orifice
            (compressible flow).
        --offsets LIST: Steering offsets of the gait that are measured, for example
            --offsets=-0.3,0,0.3. [default: from -0.4 to 0.4, or from -0.3 to 0.3 for
            ilc]
        --transients/--no-transients: Also measure the area that the robot sweeps while
            the offset changes.
        --periods N: Number of gait periods measured in each run.
        --phases N: Number of runs per offset, which start at different phases of the
            gait.
    """

    controller: str = "gait"
    frequency: float | None = None
    pressure: PressureOption = None
    target: float = 0.7
    plant: str = "twin"
    contact: str | None = None
    chambers: str = "lag"
    offsets: str | None = None
    transients: bool = True
    periods: int = 6
    phases: int = 4
    workers: Annotated[int | None, workers_option("--workers -j N")] = None

    def given(self) -> dict[str, Any]:
        """Return the options as arguments of `calibrate_footprint`."""
        given = asdict(self)
        given["frequency_hz"] = given.pop("frequency")
        given["target_rad"] = given.pop("target")
        pressure = given.pop("pressure")
        if pressure is not None:
            given["supply_pa"] = 1000 * pressure
        if self.offsets is not None:
            try:
                given["offsets"] = [float(text) for text in self.offsets.split(",")]
            except ValueError:
                raise InputError(
                    f"--offsets '{self.offsets}' is not allowed; give a list of"
                    " numbers, for example --offsets=-0.3,0,0.3"
                ) from None
        return given


_DEFAULT_MEASUREMENT = MeasurementOptions()


def footprint(
    robot: RobotArgument,
    measurement: MeasurementOptions = _DEFAULT_MEASUREMENT,
    out: str = FOOTPRINTS,
    name: str | None = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure the area that a robot sweeps at each steering offset.

    The result is the footprint that the path planner uses for this robot.

    Options:
        --out DIR: Output folder for the footprint file.
        --name NAME: Name of the footprint and of its file. [default: names of robot and
            controller, for example gen2_gait]
    """
    from srs_twin.robot.file import load_robot

    given = measurement.given()
    from srs_twin.identification.footprint_report import (
        calibrate_footprint,
        footprint_file,
    )

    file_name = name or f"{load_robot(robot).name}_{measurement.controller}"
    with (
        interruptible(NOTHING_WRITTEN),
        RunCounter(file_name, 0, quiet=quiet) as counting,
    ):
        measured = calibrate_footprint(
            robot,
            out=out,
            name=file_name,
            overwrite=overwrite,
            progress=counting.count,
            **given,
        )
    if as_json:
        file = footprint_file(measured, file_name)
        print_json(file.model_dump(mode="json", exclude_none=True))
    elif not quiet:
        _print_footprint(measured)
    say(
        f"footprint written to {display_path(Path(out) / f'{file_name}.yaml')}",
        quiet=quiet,
    )


def margin(
    scenario: ScenarioArgument,
    runs: Annotated[int, OptionRange(20, 10_000)] = 100,
    plants: str | None = None,
    jobs: WorkersOption = None,
    out: str = FOOTPRINTS,
    changes: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure how far a robot leaves its footprint on random paths.

    The robot follows the paths under the conditions of a scenario. The maximum distance
    in each run is written to the footprint file. If a scenario sets
    planner.margin_probability, the planner computes the margin from these distances.

    Options:
        --runs N: Number of runs with each model.
        --plants LIST: Models to simulate: analytical, twin, or both as analytical,twin.
            [default: the models named in the scenario]
        --out DIR: Output folder for the footprint file.
    """
    from srs_twin.identification.excursions import NO_MARGIN, calibrate_margin
    from srs_twin.planning.footprint_file import excursion_quantile, load_footprint_file
    from srs_twin.scenario.loading import load_scenario

    loaded = load_scenario(scenario, set=[*changes.changes(), NO_MARGIN])
    with (
        interruptible(NOTHING_WRITTEN),
        RunCounter(loaded.name, 0, quiet=quiet) as counting,
    ):
        measured = calibrate_margin(
            loaded,
            out=out,
            runs=runs,
            plants=parse_plants(plants),
            workers=jobs,
            progress=counting.count,
        )
    if as_json:
        print_json(
            [result.model_dump(mode="json", exclude_none=True) for result in measured]
        )
    elif not quiet:
        rows = []
        for result in measured:
            path = result.path_m
            quantiles = (
                excursion_quantile(path, fraction) for fraction in (0.5, 0.9, 0.95)
            )
            widths = (f"{1000 * value:.0f}" for value in (*quantiles, path[-1]))
            rows.append((result.conditions.plant, *widths))
        print_table(
            ("plant", "half of the runs", "90 %", "95 %", "all, mm"), rows, left=(0,)
        )
    name = load_footprint_file(loaded.file.section("planner").footprint).name
    say(
        f"excursions written to {display_path(Path(out) / f'{name}.yaml')}", quiet=quiet
    )


def _print_footprint(measured: FootprintMeasurement) -> None:
    paths = zip(measured.offsets, measured.steady, measured.spread, strict=True)
    rows = []
    for offset, path, spread in paths:
        cells = (
            f"{getattr(path, name):.4f} ± {getattr(spread, name):.4f}"
            for name in ("speed", "curvature", "left", "right")
        )
        rows.append((f"{offset:g}", *cells))
    print_table(("offset", "speed m/s", "curvature 1/m", "left m", "right m"), rows)
    if not measured.transients:
        return
    rows = []
    for change in measured.transients:
        before, after, *numbers = astuple(change)
        rows.append((f"{before:g} to {after:g}", *(f"{n:.3f}" for n in numbers)))
    headings = "offset,left m,right m,over m,dx m,dy m,dheading rad"
    print_table(headings.split(","), rows)
