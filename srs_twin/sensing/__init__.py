"""Curvature sensors: what controllers are told of the bends."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.robot.spec import RobotSpec
from srs_twin.sensing.calibration import Calibration, calibrate
from srs_twin.sensing.hall import SPAN, HallSensor, Strip
from srs_twin.sensing.sensors import (
    CurvatureSensor,
    DeadSensor,
    DriftedSensor,
    FaultySensor,
    IdealSensor,
    Sensor,
)

KINDS = (IdealSensor.kind, CurvatureSensor.kind)

__all__ = [
    "KINDS",
    "Calibration",
    "CurvatureSensor",
    "DeadSensor",
    "DriftedSensor",
    "FaultySensor",
    "HallSensor",
    "IdealSensor",
    "Sensor",
    "Strip",
    "calibrate",
    "make_sensor",
]

_STRIP = {each.name for each in fields(Strip)} - {"segment_length"}
_HALL = {each.name for each in fields(HallSensor)} - {"strip"}


def make_sensor(kind: str | Sensor, spec: RobotSpec, *, span: float = SPAN, **options: Any) -> Sensor:
    """Return the sensors of a robot.

    Args:
        kind: a name in `KINDS`, or a sensor made beforehand, which is returned as it is.
        spec: the robot; its segments' length decides how far a strip bends, its modules' drift is theirs.
        span: angles over which a Hall sensor is trimmed (unless `gain` is given) and calibrated, ± rad;
            nothing to other sensors.
        **options: attributes of `Strip` and `HallSensor`.

    Raises:
        UnknownNameError: another name, or an option that the kind does not have.
        InputError: as the kind raises it, or options for a sensor that needs none.
    """
    if options and (isinstance(kind, Sensor) or kind == IdealSensor.kind):
        raise InputError(f"this sensor takes no options; given: {', '.join(options)}")
    if isinstance(kind, Sensor):
        return kind
    sensor: Sensor
    if kind == IdealSensor.kind:
        sensor = IdealSensor()
    elif kind in KINDS:
        sensor = _hall(spec, span, options)
    else:
        raise UnknownNameError("sensor", kind, KINDS)
    modules = spec.modules
    if any(gain != 1 for gain in modules.sensor_gain) or any(modules.sensor_bias):
        return DriftedSensor(sensor, modules.sensor_gain, modules.sensor_bias)
    return sensor


def _hall(spec: RobotSpec, span: float, options: dict[str, Any]) -> Sensor:
    for name in options.keys() - _STRIP - _HALL:
        raise UnknownNameError("option of sensor 'hall'", name, _STRIP | _HALL)
    strip = Strip(spec.geometry.segment_length, **{k: v for k, v in options.items() if k in _STRIP})
    electronics = {k: v for k, v in options.items() if k in _HALL}
    if "gain" in electronics:
        hall = HallSensor(strip, **electronics)
    else:
        hall = HallSensor.trimmed(strip, span=span, **electronics)
    return CurvatureSensor.calibrated(hall, span)
