"""`srs-twin replay`: a recorded run of the robot compared with both plants under the same valve states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    option,
    parse_plants,
)
from srs_twin.cli.run import RUNS_FOLDER, failing_verdicts, run_all
from srs_twin.errors import InputError
from srs_twin.recordings.commands import FrequencyOption, OffsetOption, ReadingOptions

if TYPE_CHECKING:
    from srs_twin.robot.file import RobotFile

_MAX_DURATION_S = 3600.0
"""Longest replay, s: the limit of a scenario."""

_BENCH_RECORD_HZ = 1000
"""Sampling rate on a bench, where bends follow the valves within milliseconds."""

_DEFAULT_READING = ReadingOptions()


def replay(
    motion: Annotated[str, argument("MOTION")],
    robot: Annotated[str, option("--robot -r ROBOT")],
    valves: Annotated[str | None, option("--valves LOG")] = None,
    fit: Annotated[list[str] | None, option("--fit FIT")] = None,
    expect: Annotated[str | None, option("--expect FILE.yaml")] = None,
    check: CheckOption = False,
    strict: StrictOption = False,
    bench: Annotated[bool, option("--bench")] = False,
    pressure: PressureOption = None,
    plants: Annotated[str, option("--plants LIST")] = "analytical,twin",
    model: Annotated[str, option("--model NAME")] = "complete",
    law: FloorOption = None,
    offset: OffsetOption = None,
    frequency: FrequencyOption = None,
    markers: ReadingOptions = _DEFAULT_READING,
    changed: ChangeOptions = NO_CHANGES,
    out: Annotated[str | None, option("--out DIR")] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Drive both plants with the valve states of a recording.

    The output compares each plant with the measured motion. In the output folder, scenario.resolved.yaml is
    the same replay as a scenario, for `srs-twin run`.

    Options:
        motion: Motion capture, or bends on a bench.
        robot: Shipped robot or robot file.
        valves: Log of valves or pressures. [default: NAME.valves.csv in the same folder]
        fit: Fit file of this robot (repeatable).
        expect: File of expectations, as in a scenario: `expect: …`.
        bench: Robot (or single module) on a bench, clamped at its head, instead of on the floor.
        plants: Plants: analytical, twin or both.
        model: Model of the analytical plant.
        out: Output folder. [default: runs/MOTION]
    """
    from srs_twin.io.files import results_name
    from srs_twin.scenario.loading import parse_scenario

    fails = failing_verdicts(check=check, strict=strict)
    if fails and expect is None:
        flag = "--check" if check else "--strict"
        raise InputError(f"{flag}: there are no expectations; give --expect FILE.yaml")
    robot_file = _load_robot(robot, fit or [])
    files = {"motion": motion, "valves": valves, "offset_s": offset, "gait_frequency_hz": frequency}
    recording = {key: value for key, value in files.items() if value is not None} | markers.given()
    name = results_name(Path(motion))
    document = {
        "name": name,
        "title": f"{Path(motion).name} replayed, {robot_file.name}",
        "robot": robot_file.model_dump(mode="json", exclude_none=True),
        "duration_s": _duration(recording, robot_file, quiet),
        "controller": {"kind": "replay"},
        "recording": recording,
        "plants": _plants(plants, model, law, bench),
        "expect": [] if expect is None else _expectations(expect),
    }
    if bench:
        document |= {"bench": True, "record_hz": _BENCH_RECORD_HZ}
    if pressure is not None:
        document["supply"] = {"pressure_kpa": pressure}
    scenario = parse_scenario(document, name="replay", set=changed.changes())
    cases = [Case(scenario.name, scenario)]
    run_all(cases, out=out or str(RUNS_FOLDER / name), fails=fails, quiet=quiet, as_json=as_json)


def _load_robot(robot: str, fits: Sequence[str]) -> RobotFile:
    """Return a robot with the results of fits."""
    from srs_twin.identification.fitted_robot import merge_overrides
    from srs_twin.io.documents import Document
    from srs_twin.robot.file import load_robot_file, resolve_robot

    if not fits:
        return load_robot_file(robot)
    document = Document("--fit", merge_overrides(fits, base=robot))
    robot_file = resolve_robot(document, document.data, prefix=())
    document.raise_problems()
    assert robot_file is not None, "a document without problems gives a robot"
    return robot_file


def _duration(recording: dict[str, Any], robot: RobotFile, quiet: bool) -> float:
    """Return the duration of the recording in whole ticks, s, and print a summary of the recording."""
    from srs_twin.plants.base import TICK_S
    from srs_twin.recordings.recording_map import read_map
    from srs_twin.recordings.takes import RecordingReader, logs_of

    settings = {key: value for key, value in recording.items() if key not in ("motion", "valves")}
    motion, valves = recording["motion"], recording.get("valves")
    (log,) = logs_of([motion], [valves] if valves else [])
    settings["map"] = read_map(settings.get("map", {}))
    measured = RecordingReader(**settings).take(motion, log, robot.spec())
    say(measured.summary.text(), "", quiet=quiet)
    time = measured.trajectory.time
    ticks = math.floor(min(float(time[-1] - time[0]), _MAX_DURATION_S) / TICK_S + 1e-6)
    return round(ticks * TICK_S, 6)


def _plants(names: str, model: str, law: str | None, bench: bool) -> dict[str, Any]:
    if bench and law is not None:
        raise InputError("--law: remove this option; on a bench there is no floor")
    floor = {} if bench else {"friction": law or "wheel"}
    settings: dict[str, Any] = {"analytical": {"model": model, **floor}, "twin": {}}
    return {name: settings[name] for name in parse_plants(names) or settings}


def _expectations(path: str) -> list[Any]:
    """Return the expectations of a file.

    Raises:
        InputFileError: the file is invalid; lists all problems.
    """
    from srs_twin.io.files import require_file
    from srs_twin.io.validation import load_model
    from srs_twin.scenario.expectation import ExpectationsFile

    file = load_model(ExpectationsFile, require_file(Path(path)))
    return [entry.model_dump(mode="json", exclude_none=True) for entry in file.expect]
