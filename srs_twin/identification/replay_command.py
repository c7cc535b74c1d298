"""`srs-twin replay`: a recorded run of the robot, with both plants under the same valves beside it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from srs_twin.cli.batch import RUNS, failing, run_all
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
    plants_of,
)
from srs_twin.errors import InputError
from srs_twin.recordings.options import FrequencyOption, OffsetOption, ReadingOptions

if TYPE_CHECKING:
    from srs_twin.robot.file import RobotFile

_LONGEST = 3600.0  # s, of a scenario
_BENCH_HZ = 1000  # bends follow valves within milliseconds
_AS_FOUND = ReadingOptions()


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
    markers: ReadingOptions = _AS_FOUND,
    changed: ChangeOptions = NO_CHANGES,
    out: Annotated[str | None, option("--out DIR")] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Drive both plants with a recording's valve commands.

    Measures how far each is from what the robot did. The folder's scenario.resolved.yaml is the same replay
    as a scenario, for `srs-twin run`.

    Options:
        motion: What cameras saw, or bends on a bench.
        robot: A shipped robot or a file.
        valves: Valves or pressures. [default: NAME.valves.csv beside it]
        fit: A fit of this robot; repeatable.
        expect: Expectations, as a scenario has them: `expect: …`.
        bench: It hung in air, held at its head; also one module.
        plants: analytical, twin or both.
        model: Of the analytical plant.
        out: Folder for the files. [default: runs/MOTION]
    """
    from srs_twin.io.files import results_name
    from srs_twin.scenario.loading import parse_scenario

    fails = failing(check=check, strict=strict)
    if fails and expect is None:
        asked = "--check" if check else "--strict"
        raise InputError(f"{asked}: nothing is expected; give --expect FILE.yaml")
    snake = _robot(robot, fit or [])
    given = {"motion": motion, "valves": valves, "offset_s": offset, "gait_frequency_hz": frequency}
    recording = {key: value for key, value in given.items() if value is not None} | markers.given()
    name = results_name(Path(motion))
    document = {
        "name": name,
        "title": f"{Path(motion).name} replayed, {snake.name}",
        "robot": snake.model_dump(mode="json", exclude_none=True),
        "duration_s": _duration(recording, snake, quiet),
        "controller": {"kind": "replay"},
        "recording": recording,
        "plants": _plants(plants, model, law, bench),
        "expect": [] if expect is None else _expectations(expect),
    }
    if bench:
        document |= {"bench": True, "record_hz": _BENCH_HZ}
    if pressure is not None:
        document["supply"] = {"pressure_kpa": pressure}
    scenario = parse_scenario(document, name="replay", set=changed.changes())
    cases = [Case(scenario.name, scenario)]
    run_all(cases, out=out or str(RUNS / name), fails=fails, quiet=quiet, as_json=as_json)


def _robot(robot: str, fits: Sequence[str]) -> RobotFile:
    """Return a robot with what fits found of it."""
    from srs_twin.identification.fitted_robot import overrides_of
    from srs_twin.io.documents import Document
    from srs_twin.robot.file import load_robot_file, resolve_robot

    if not fits:
        return load_robot_file(robot)
    document = Document("--fit", overrides_of(fits, base=robot))
    found = resolve_robot(document, document.data, prefix=())
    document.finish()
    assert found is not None, "a robot without a problem was resolved"
    return found


def _duration(recording: dict[str, Any], robot: RobotFile, quiet: bool) -> float:
    """Return how many whole ticks the recording lasts, s, and say what was read."""
    from srs_twin.recordings.recording_map import read_map
    from srs_twin.recordings.takes import RecordingReader, logs_of
    from srs_twin.scenario.plants import TICK_S

    known = {key: value for key, value in recording.items() if key not in ("motion", "valves")}
    motion, valves = recording["motion"], recording.get("valves")
    (log,) = logs_of([motion], [valves] if valves else [])
    known["map"] = read_map(known.get("map", {}))
    take = RecordingReader(**known).take(motion, log, robot.spec())
    say(take.summary.text(), "", quiet=quiet)
    time = take.trajectory.time
    ticks = math.floor(min(float(time[-1] - time[0]), _LONGEST) / TICK_S + 1e-6)
    return round(ticks * TICK_S, 6)


def _plants(names: str, model: str, law: str | None, bench: bool) -> dict[str, Any]:
    if bench and law is not None:
        raise InputError("--law: take it out; on a bench there is no floor")
    floor = {} if bench else {"friction": law or "wheel"}
    settings: dict[str, Any] = {"analytical": {"model": model, **floor}, "twin": {}}
    return {name: settings[name] for name in plants_of(names) or settings}


def _expectations(path: str) -> list[Any]:
    """Return the expectations of a file.

    Raises:
        InputFileError: everything that is wrong with it.
    """
    from srs_twin.io.files import existing
    from srs_twin.io.validation import load_model
    from srs_twin.scenario.expectation import ExpectationsFile

    file = load_model(ExpectationsFile, existing(Path(path)))
    return [each.model_dump(mode="json", exclude_none=True) for each in file.expect]
