"""Command `srs-twin replay`, which compares a recorded run with simulations."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from srs_twin.cli.cases import Case
from srs_twin.cli.console import say
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    CheckOption,
    FloorOption,
    JsonOption,
    PressureOption,
    QuietOption,
    StrictOption,
    argument,
    parse_plants,
)
from srs_twin.cli.run import RUNS_FOLDER, ReportOptions, run_all
from srs_twin.errors import InputError
from srs_twin.recordings.commands import FrequencyOption, OffsetOption, ReadingOptions

_DEFAULT_READING = ReadingOptions()


def replay(
    motion: Annotated[str, argument("MOTION")],
    robot: str,
    valves: str | None = None,
    fit: list[str] | None = None,
    expect: str | None = None,
    check: CheckOption = False,
    strict: StrictOption = False,
    bench: bool = False,
    pressure: PressureOption = None,
    plants: str = "analytical,twin",
    model: str = "complete",
    friction_law: FloorOption = None,
    offset: OffsetOption = None,
    frequency: FrequencyOption = None,
    markers: ReadingOptions = _DEFAULT_READING,
    changed: ChangeOptions = NO_CHANGES,
    out: str | None = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Simulate a recorded run with its recorded valve states.

    The output compares the simulated motion with the measured motion. The command also
    writes the scenario file scenario.resolved.yaml to the output folder. `srs-twin run`
    repeats the replay from this file.

    Options:
        motion: File with the recorded motion, from motion capture or from a bend
            measurement on a bench.
        --robot -r ROBOT: Name of a shipped robot, or path of a robot file.
        --valves LOG: Log with the recorded valve states or pressures. [default:
            NAME.valves.csv in the folder of the recording]
        --fit FIT: Fit file whose parameters replace those of the robot file. Can be
            repeated.
        --expect FILE.yaml: YAML file with expected ranges of results, under the key
            `expect` as in a scenario.
        --bench: Simulate the robot, or a single module, clamped at its head on a bench
            instead of free on the floor.
        --plants LIST: Models to simulate: analytical, twin, or both as analytical,twin.
        --model NAME: Kind of analytical model: complete, simplified, compliant or
            quasistatic.
        --out DIR: Output folder. [default: runs/MOTION]
    """
    from srs_twin.identification.replay import replay_scenario
    from srs_twin.io.files import results_name

    report = ReportOptions(check=check, strict=strict, quiet=quiet, as_json=as_json)
    if report.fails and expect is None:
        flag = "--check" if check else "--strict"
        raise InputError(
            f"{flag} needs expectations; give them with --expect FILE.yaml"
        )
    recording = {"valves": valves, "offset_s": offset, "gait_frequency_hz": frequency}
    given = {key: value for key, value in recording.items() if value is not None}
    supply_pa = None if pressure is None else 1e3 * pressure
    scenario = replay_scenario(
        motion,
        robot,
        recording=given | markers.given(),
        set=changed.changes(),
        fits=fit or (),
        expect=expect,
        bench=bench,
        supply_pa=supply_pa,
        plants=parse_plants(plants),
        model=model,
        friction_law=friction_law,
        notify=partial(say, quiet=quiet),
    )
    folder = out or RUNS_FOLDER / results_name(Path(motion))
    cases = [Case(scenario.name, scenario)]
    run_all(cases, report, out=str(folder))
