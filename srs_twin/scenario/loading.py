"""From a scenario file to a Scenario, with everything that is wrong reported at once."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from srs_twin.errors import InputError, InputFileError, UnknownNameError
from srs_twin.io.documents import Document, load_yaml
from srs_twin.io.files import find, results_name
from srs_twin.io.validation import validate
from srs_twin.planning.footprint import load_footprint
from srs_twin.robot.file import RobotFile, resolve_robot
from srs_twin.scenario.building import build, sensors, supply
from srs_twin.scenario.checks import (
    check,
    check_damping,
    check_faults,
    check_recording,
    check_sensor,
    checked_controller,
    overpressure,
)
from srs_twin.scenario.control import ControllerSettings, GaitSettings, LearningSettings
from srs_twin.scenario.control_file import FollowFile, ReplayFile
from srs_twin.scenario.file import ScenarioFile
from srs_twin.scenario.following import FollowSettings, follow_settings
from srs_twin.scenario.route_finding import planner_settings
from srs_twin.scenario.scenario import Scenario
from srs_twin.scenario.surroundings import start_of, world_of
from srs_twin.world import World

if TYPE_CHECKING:
    from srs_twin.recordings.recording import Recording

Found = TypeVar("Found")


def load_scenario(name_or_path: str | os.PathLike[str]) -> Scenario:
    """Load a scenario: a shipped name (gen2_straight) or the path of a scenario file.

    Raises:
        InputError: not found or not readable.
        InputFileError: everything that is wrong with it, one line each.
    """
    path = find("scenario", name_or_path)
    return _scenario(load_yaml(path), results_name(path))


def parse_scenario(data: Mapping[str, Any], *, name: str = "scenario") -> Scenario:
    """Make a scenario of plain data, as `Scenario.document` holds them.

    Raises:
        InputFileError: everything that is wrong with them; lines have no line numbers.
    """
    return _scenario(Document(name, data), name)


def _scenario(document: Document, name: str) -> Scenario:
    file = validate(ScenarioFile, document, document.data)
    robot, foreign = _robot(document)
    warnings = overpressure(document, robot) if robot else []
    controller: ControllerSettings | FollowSettings | None = None
    layout, world, recording = "", World(), None
    if file:
        world = _world(document, file)
        check(document, file)
        if robot:
            check_damping(document, file, robot)
            check_faults(document, file, robot)
            check_sensor(document, sensors(file.sensor)[0], robot)
            recording = _recording(document, file, robot)
            if recording is not None:
                warnings += check_recording(document, file, recording)
            if recording is not None or not isinstance(file.controller, ReplayFile):
                driving, layout, said = checked_controller(
                    document, file, robot, supply(file, robot), recording
                )
                warnings += said
                controller = _followed(document, file, driving, world)
    document.finish(foreign)
    assert file is not None and robot is not None and controller is not None, "no problem was reported"
    if file.planner is None and (world.goal or world.bounds):
        warnings.append(
            "world: no plant or controller takes notice of its goal and bounds; controller.kind: follow does"
        )
    found = build(file, robot, file.name or name, controller, layout, tuple(warnings), world, recording)
    return replace(found, source=document.name)


def _recording(document: Document, file: ScenarioFile, robot: RobotFile) -> Recording | None:
    """Return what is replayed; report at its key why it cannot be read."""
    given = file.recording
    if given is None:
        return None
    from srs_twin.identification.takes import NO_MARKERS, Reading, logs_of, only_bends, repeats
    from srs_twin.recordings.logs import on_bench, read_valves

    reading = Reading(
        given.up, given.layout, given.head, given.longest_gap_s, given.offset_s, given.gait_frequency_hz
    )
    spec = robot.spec(file.seed)
    (path,) = logs_of([given.motion], [given.valves] if given.valves else [])
    log = _read(document, "valves", lambda: read_valves(path, spec))
    frequency = repeats(log) if log else None
    body = _read(document, "motion", lambda: reading.body(given.motion, spec, frequency))
    if body is None or log is None:
        return None
    if not file.bench and only_bends(body.trajectory):
        document.report(("recording", "motion"), f"{NO_MARKERS}, or bench: true")
        return None
    one_file = path == given.motion
    joined = _read(document, "offset_s", lambda: reading.joined(body, log, spec, one_file=one_file))
    if joined is None or not file.bench:
        return joined
    return _read(document, "motion", lambda: on_bench(joined, spec))


def _read(document: Document, key: str, read: Callable[[], Found]) -> Found | None:
    """Return what a key of the recording leads to; report why there is nothing."""
    try:
        return read()
    except UnknownNameError as error:
        # The file itself was read: it is the marker that is not in it.
        document.report(("recording", "head"), str(error))
    except InputError as error:
        document.report(("recording", key), str(error))
    return None


def _world(document: Document, file: ScenarioFile) -> World:
    try:
        return world_of(file)
    except InputError as error:
        document.report(("world", "random"), str(error))
        return World()


def _followed(
    document: Document, file: ScenarioFile, gait: ControllerSettings, world: World
) -> ControllerSettings | FollowSettings:
    """Put a follower on top of the gait where the file has one; report why it cannot be had."""
    if file.planner is None or not isinstance(file.controller, FollowFile) or document.problems:
        return gait
    assert isinstance(gait, GaitSettings | LearningSettings)
    try:
        footprint = load_footprint(file.planner.footprint)
    except InputError as error:
        document.report(("planner", "footprint"), str(error).splitlines()[0])
        return gait
    try:
        planner = planner_settings(file.planner, footprint, start_of(file), world)
    except InputError as error:
        document.report(("planner",), str(error))
        return gait
    return follow_settings(file.controller, gait, planner)


def _robot(document: Document) -> tuple[RobotFile | None, tuple[str, ...]]:
    """Return the robot, and what is wrong with a robot file of its own."""
    given = document.get("robot")
    if given is None and document.known(("robot",)) == ():
        return None, ()
    try:
        return resolve_robot(document, given, prefix=("robot",)), ()
    except InputFileError as error:
        return None, error.lines
