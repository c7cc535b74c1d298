"""Scenario that simulates a recorded run and compares the result with the recording."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from srs_twin.errors import InputError
from srs_twin.identification.fitted_robot import merge_overrides
from srs_twin.io.arguments import checked
from srs_twin.io.documents import Document, Overrides
from srs_twin.io.files import StrPath, require_file, results_name
from srs_twin.io.validation import load_model
from srs_twin.plants.base import TICK_S
from srs_twin.recordings.recording_map import read_map
from srs_twin.recordings.takes import RecordingReader, default_log
from srs_twin.robot.file import RobotFile, load_robot_file, robot_in
from srs_twin.scenario.expectation import ExpectationsFile
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.scenario import Scenario

_MAX_DURATION_S = 3600.0

_BENCH_RECORD_HZ = 1000
"""Sampling rate of a simulation on a bench, Hz.

On a bench, the bends respond to the valves within milliseconds.
"""


@checked
def replay_scenario(
    motion: StrPath,
    robot: StrPath,
    *,
    recording: Mapping[str, object] = MappingProxyType({}),
    set: Overrides = (),
    fits: Sequence[StrPath] = (),
    expect: StrPath | None = None,
    bench: bool = False,
    supply_pa: float | None = None,
    plants: Sequence[str] | None = None,
    model: str = "complete",
    friction_law: str | None = None,
    notify: Callable[[str], object] = str,
) -> Scenario:
    """Build a scenario that simulates the robot with recorded valve states.

    When `run_scenario` runs this scenario, the resulting metrics compare each plant
    with the recording.

    Args:
        motion: path of a file with motion capture, or with bends measured on a bench.
        robot: name or path of the robot to simulate.
        recording: additional keys for the scenario section `recording`, such as
            `valves`.
        set: values that override fields of the scenario, as in `load_scenario`.
        fits: paths of fit files whose results replace values of the robot.
        expect: path of a file with expectations, as in a scenario.
        bench: whether the head of the robot is clamped on a bench.
        supply_pa: supply pressure, Pa, by default the nominal pressure of the robot.
        plants: names of the plants to simulate, by default "analytical" and "twin".
        model: name of the analytical model.
        friction_law: friction law of the analytical plant, by default "wheel".
        notify: function that receives a summary of the recording.

    Raises:
        InputError: the recording cannot be read or does not match the robot.
    """
    robot_file = _load_robot(robot, fits)
    path = Path(motion)
    given = {"motion": os.fspath(motion), **recording}
    document = {
        "name": results_name(path),
        "title": f"{path.name} replayed, {robot_file.name}",
        "robot": robot_file.model_dump(mode="json", exclude_none=True),
        "duration_s": _duration(given, robot_file, notify),
        "controller": {"kind": "replay"},
        "recording": given,
        "plants": _plants(plants, model, friction_law, bench),
        "expect": [] if expect is None else _expectations(expect),
    }
    if bench:
        document |= {"bench": True, "record_hz": _BENCH_RECORD_HZ}
    if supply_pa is not None:
        document["supply"] = {"pressure_kpa": round(supply_pa / 1e3, 9)}
    return parse_scenario(document, name="replay", set=set)


def _load_robot(robot: StrPath, fits: Sequence[StrPath]) -> RobotFile:
    if not fits:
        return load_robot_file(robot)
    return robot_in(Document("--fit", merge_overrides(fits, base=os.fspath(robot))))


def _duration(
    recording: Mapping[str, Any], robot: RobotFile, notify: Callable[[str], object]
) -> float:
    settings = dict(recording)
    motion = settings.pop("motion")
    valves = settings.pop("valves", None)
    settings["map"] = read_map(settings.get("map", {}))
    reader = RecordingReader(**settings)
    measured = reader.take(motion, valves or default_log(motion), robot.spec())
    notify(f"{measured.summary.text()}\n")
    time = measured.trajectory.time
    duration = min(float(time[-1] - time[0]), _MAX_DURATION_S)
    ticks = math.floor(duration / TICK_S + 1e-6)
    return round(ticks * TICK_S, 6)


def _plants(
    names: Sequence[str] | None, model: str, friction_law: str | None, bench: bool
) -> dict[str, object]:
    if bench and friction_law is not None:
        raise InputError(
            "--friction-law is not allowed, because a robot on a bench touches no floor;"
            " remove this option"
        )
    floor = {} if bench else {"friction": friction_law or "wheel"}
    settings: dict[str, object] = {"analytical": {"model": model, **floor}, "twin": {}}
    return {name: settings[name] for name in names or settings}


def _expectations(path: StrPath) -> list[dict[str, object]]:
    file = load_model(ExpectationsFile, require_file(Path(path)))
    return [entry.model_dump(mode="json", exclude_none=True) for entry in file.expect]
