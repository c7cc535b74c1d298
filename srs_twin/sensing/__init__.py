"""Curvature sensors that measure the bends for the controllers."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.extensions import part
from srs_twin.robot.spec import RobotSpec
from srs_twin.sensing.hall import (
    SPAN,
    HallSensor as HallSensor,
    Strip as Strip,
    calibrate as calibrate,
)
from srs_twin.sensing.sensors import (
    CurvatureSensor as CurvatureSensor,
    DeadSensor as DeadSensor,
    DriftedSensor as DriftedSensor,
    FaultySensor as FaultySensor,
    IdealSensor as IdealSensor,
    Sensor as Sensor,
    TwoAxisSensor as TwoAxisSensor,
)

KINDS = (IdealSensor.kind, CurvatureSensor.kind)

_STRIP_OPTIONS = {field.name for field in fields(Strip)} - {"segment_length"}
_HALL_OPTIONS = {field.name for field in fields(HallSensor)} - {"strip"}


def make_sensor(
    kind: str | Sensor, spec: RobotSpec, *, span: float = SPAN, **options: object
) -> Sensor:
    """Create the curvature sensors of a robot.

    The sensors of a spatial robot measure the bends about two axes.

    Args:
        kind: name in `KINDS`, name of an extension (`extensions.part`), or a `Sensor`.
        spec: robot specification, which contains the strip length and the sensor drift.
        span: maximum bend to either side for which a Hall sensor is calibrated, rad.
            The amplifier gain is chosen for this span unless the option `gain` is
            given. Other sensors ignore the span.
        **options: attributes of `Strip` and `HallSensor`, or arguments of an extension.

    Raises:
        UnknownNameError: the kind or an option is unknown.
        InputError: the sensor takes no options, or an option has an invalid value.
    """
    if options and (isinstance(kind, Sensor) or kind == IdealSensor.kind):
        raise InputError(f"this sensor has no options; remove {', '.join(options)}")
    sensor: Sensor
    if isinstance(kind, Sensor):
        if spec.is_spatial and kind.axes == 1:
            return TwoAxisSensor(kind)
        return kind
    if kind == IdealSensor.kind:
        sensor = IdealSensor()
    elif kind in KINDS:
        sensor = _hall_sensor(spec, span, options)
    else:
        return make_sensor(part("sensor", kind, (Sensor,), KINDS)(**options), spec)
    modules = spec.modules
    if any(gain != 1 for gain in modules.sensor_gain) or any(modules.sensor_bias):
        sensor = DriftedSensor(sensor, modules.sensor_gain, modules.sensor_bias)
    if spec.is_spatial:
        return TwoAxisSensor(sensor)
    return sensor


def _hall_sensor(spec: RobotSpec, span: float, options: dict[str, Any]) -> Sensor:
    for name in options.keys() - _STRIP_OPTIONS - _HALL_OPTIONS:
        raise UnknownNameError(
            "option of sensor 'hall'", name, _STRIP_OPTIONS | _HALL_OPTIONS
        )
    geometry = {name: options.pop(name) for name in _STRIP_OPTIONS & options.keys()}
    strip = Strip(spec.geometry.segment_length, **geometry)
    if "gain" in options:
        hall = HallSensor(strip, **options)
    else:
        hall = HallSensor.trimmed(strip, span=span, **options)
    return CurvatureSensor.calibrated(hall, span)
