"""From a checked scenario file to a Scenario in SI, and to a document with all defaults written out."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.robot.file import PA_PER_KPA, RobotFile
from srs_twin.scenario.air_file import PneumaticsFile
from srs_twin.scenario.checks import recorded_pressures, tick_of
from srs_twin.scenario.control import ControllerSettings
from srs_twin.scenario.expectation import COMPARISON, Expectation
from srs_twin.scenario.expectation_file import ExpectationFile
from srs_twin.scenario.file import ScenarioFile
from srs_twin.scenario.following import FollowSettings
from srs_twin.scenario.plants_file import NOT_ON_A_BENCH
from srs_twin.scenario.scenario import Scenario
from srs_twin.scenario.sensor_file import SensorFile
from srs_twin.scenario.settings import (
    AnalyticalSettings,
    PlantSettings,
    PneumaticsSettings,
    SensorSettings,
    TwinSettings,
)
from srs_twin.trajectory import Trajectory
from srs_twin.world import World

if TYPE_CHECKING:
    from srs_twin.recordings.recording import Recording

L_PER_MIN = 60_000.0
ML = 1e6
"""Litres a minute in a cubic metre a second, millilitres in a cubic metre."""

# Key of a Hall sensor → attribute of `SensorSettings` and units of the file in one of SI.
_HALL = {
    "span_rad": ("span", 1.0), "distance_mm": ("distance", 1e3), "orientation": ("orientation", None),
    "chamber": ("chamber", None), "noise_uv": ("noise", 1e6), "bits": ("bits", None), "bias_v": ("bias", 1.0),
    "gain_error": ("gain_error", 1.0),
}  # fmt: skip


def build(
    file: ScenarioFile,
    robot: RobotFile,
    name: str,
    controller: ControllerSettings | FollowSettings,
    layout: str,
    warnings: tuple[str, ...],
    world: World,
    recording: Recording | None = None,
) -> Scenario:
    """Return the scenario of a file that has passed all checks."""
    title, supply_pa, pose = file.title or name, supply(file, robot), _start(file, recording)
    pneumatics, pneumatics_document = _pneumatics(file.pneumatics)
    sensor, sensor_document = sensors(file.sensor)
    allow_overpressure = file.allow_overpressure or file.supply.allow_overpressure
    document = file.model_dump(mode="json", exclude_none=True, exclude={"start"} if file.bench else None) | {
        "name": name,
        "title": title,
        "robot": robot.model_dump(mode="json", exclude_none=True),
        "supply": {"pressure_kpa": supply_kpa(file, robot)},
        "pneumatics": pneumatics_document,
        "valves": {"layout": layout},
        "sensor": sensor_document,
        "allow_overpressure": allow_overpressure,
    }
    if not file.bench:
        document["start"] = dict(zip(("x_m", "y_m", "heading_rad"), pose, strict=True))
    if recording is not None:
        _resolve(document["recording"])
        if recorded_pressures(recording):
            del document["pneumatics"]
    for kind, plant in document["plants"].items():
        plant["tick_s"] = tick_of(file, kind)
        for key in NOT_ON_A_BENCH[kind] if file.bench else ():
            del plant[key]
    return Scenario(
        name=name,
        title=title,
        robot=robot.spec(file.seed),
        duration=file.duration_s,
        seed=file.seed,
        record_hz=file.record_hz,
        supply_pa=supply_pa,
        pneumatics=pneumatics,
        allow_overpressure=allow_overpressure,
        layout=layout,
        sensor=sensor,
        faults=tuple(fault.make() for fault in file.faults),
        bench=file.bench,
        controller=controller,
        pose=pose,
        world=world,
        plants=_plants(file),
        measured=None if recording is None else _measured(recording.trajectory, file.duration_s),
        gap_factor=file.comparison.gap_factor,
        expect=tuple(_expectation(each) for each in file.expect),
        document=document,
        warnings=warnings,
    )


def _start(file: ScenarioFile, recording: Recording | None) -> tuple[float, float, float]:
    """Return where the snake lies at first: as the file says, or as it was measured."""
    if recording is None or file.bench or "start" in file.model_fields_set:
        return file.start.x_m, file.start.y_m, file.start.heading_rad
    from srs_twin.identification.takes import start_pose

    x, y, heading = start_pose(recording)
    return x, y, math.remainder(heading, 2 * math.pi)


def _resolve(files: dict[str, Any]) -> None:
    """Write the paths of a recording out, so that a run's folder can be read from any other folder."""
    for key in ("motion", "valves"):
        if key in files:
            files[key] = str(Path(files[key]).resolve())


def _measured(trajectory: Trajectory, duration: float) -> Trajectory:
    """Return a recorded motion on the clock of the run, as long as the run."""
    time = trajectory.time - trajectory.time[0]
    kept = time <= duration + 1e-9
    columns = {name: column[kept] for name, column in trajectory.columns.items()} | {"time": time[kept]}
    return replace(trajectory, columns=columns)


def supply_kpa(file: ScenarioFile, robot: RobotFile) -> float:
    """Return the supply pressure, the robot's nominal one where none is given, kPa."""
    given = file.supply.pressure_kpa
    return float(robot.supply.nominal_kpa.value) if given is None else given


def supply(file: ScenarioFile, robot: RobotFile) -> float:
    """Return the supply pressure, Pa."""
    return supply_kpa(file, robot) * PA_PER_KPA


def sensors(file: SensorFile) -> tuple[SensorSettings, dict[str, Any]]:
    """Return the sensors' settings, and what a file with all defaults written out says of them."""
    if file.kind != "hall":
        return SensorSettings(file.kind), {"kind": file.kind}
    settings = SensorSettings("hall")
    document: dict[str, Any] = {"kind": "hall"}
    for key, (attribute, units) in _HALL.items():
        given = getattr(file, key)
        if given is not None:
            settings = replace(settings, **{attribute: given if units is None else given / units})
            document[key] = given
        else:
            default = getattr(settings, attribute)
            document[key] = default if units in (None, 1.0) else round(default * units, 6)
    return settings, document


def _pneumatics(file: PneumaticsFile) -> tuple[PneumaticsSettings, dict[str, Any]]:
    """Return the chambers' settings, and what a file with all defaults written out says of them."""
    settings = PneumaticsSettings(file.kind, file.leak_per_s, file.valve_delay_s)
    document = file.model_dump(exclude_none=True)
    if file.critical_ratio is not None:
        settings = replace(settings, critical_ratio=file.critical_ratio)
    elif file.kind == "orifice":
        document["critical_ratio"] = settings.critical_ratio
    if file.flow_limit_l_per_min is not None:
        settings = replace(settings, flow_limit=file.flow_limit_l_per_min / L_PER_MIN)
        if file.line_volume_ml is None:
            document["line_volume_ml"] = round(settings.line_volume * ML, 6)
        else:
            settings = replace(settings, line_volume=file.line_volume_ml / ML)
        if file.line_begins_kpa is not None:
            settings = replace(settings, line_begins=file.line_begins_kpa * PA_PER_KPA)
    return settings, document


def _plants(file: ScenarioFile) -> dict[str, PlantSettings]:
    plants: dict[str, PlantSettings] = {}
    if model := file.plants.analytical:
        plants["analytical"] = AnalyticalSettings(
            gaps=model.gaps,
            timestep=model.timestep_s,
            tick=tick_of(file, "analytical"),
            model=model.model,
            friction=model.friction,
            slip_speed=model.slip_speed_m_s,
            friction_torque=model.friction_torque,
            inertia=model.inertia,
        )
    if twin := file.plants.twin:
        plants["twin"] = TwinSettings(
            gaps=twin.gaps,
            timestep=twin.timestep_s,
            tick=tick_of(file, "twin"),
            wheels=twin.wheels,
            hinges_per_segment=twin.hinges_per_segment,
        )
    return plants


def _expectation(file: ExpectationFile) -> Expectation:
    of = file.plant or COMPARISON
    low = -math.inf if file.above is None else file.above
    high = math.inf if file.below is None else file.below
    if file.near is not None:
        tolerance = file.abs if file.abs is not None else (file.rel or 0.0) * abs(file.near)
        low, high = file.near - tolerance, file.near + tolerance
    return Expectation(file.metric, of, low, high, file.near, file.source, file.known)
