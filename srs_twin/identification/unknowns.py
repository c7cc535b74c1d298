"""Unknowns: numbers of a robot that a fit may look for, by their names in a robot file.

A name is `section.key` of a robot file, with the number of a connector or segment behind it where the file
has a list: ``mass.connectors_kg_5``, ``modules.gain_plus_2``, ``modules.bias_rad_1``. Values are in the
unit that the key names. ``mass.connectors_kg`` alone is the mean, and scales all masses, the wheels' too.
``actuator.bend_rad`` is the bend under the robot's nominal supply pressure; ``modules.sensor_bias_rad`` is
one number for the sensors of all modules.

What is searched is not the value but its coordinate z: ln(value), or value/scale where values may be 0 or
change sign. One unit of z, a factor e or one scale, is a difference that matters.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.robot.spec import WHEEL_SHARE, Modules, RobotSpec


@dataclass(frozen=True)
class Unknown:
    """One number that a fit looks for.

    Attributes:
        name: as above, or any name of a nuisance.
        unit: of the value.
        start: where the search begins.
        low: least value allowed.
        high: greatest value allowed.
        scale: a difference that matters, in the unit; None: values are positive and searched as logarithms.
        nuisance: whether it is of no interest in itself, such as the velocity of a throw.
    """

    name: str
    unit: str
    start: float
    low: float
    high: float
    scale: float | None = None
    nuisance: bool = False

    def __post_init__(self) -> None:
        if not self.low <= self.start <= self.high or not self.low < self.high:
            raise InputError(
                f"{self.name}: the start {self.start:g} is not allowed; it must be {self.low:g} to "
                f"{self.high:g} {self.unit}"
            )

    def coordinate(self, value: float) -> float:
        """Return z of a value."""
        return math.log(value) if self.scale is None else value / self.scale

    def value(self, coordinate: float) -> float:
        """Return the value at z, within the bounds."""
        value = math.exp(coordinate) if self.scale is None else coordinate * self.scale
        return min(max(value, self.low), self.high)

    def slope(self, value: float) -> float:
        """Return dvalue/dz."""
        return value if self.scale is None else self.scale


@dataclass(frozen=True)
class _Field:
    """How a number is read from a robot and put into one; k is the number behind the name, from 0."""

    unit: str
    low: float
    high: float
    get: Callable[[RobotSpec, int], float]
    put: Callable[[RobotSpec, float, int], RobotSpec]
    scale: float | None = None
    numbered: str | None = None
    least: Callable[[RobotSpec], float] = lambda spec: -math.inf


def unknowns(
    spec: RobotSpec, names: Iterable[str], *, starts: Mapping[str, float] | None = None
) -> tuple[Unknown, ...]:
    """Return unknowns that start from a robot's numbers.

    Args:
        spec: the robot.
        names: of what is unknown.
        starts: other values to start from, by name.

    Raises:
        UnknownNameError: no such number of a robot.
        InputError: a number that this robot has not, a name twice, or a start beyond its bounds.
    """
    found: list[Unknown] = []
    for name in names:
        if any(name == each.name for each in found):
            raise InputError(f"{name}: given twice")
        field, k = _field_of(spec, name)
        low = max(field.low, field.least(spec))
        given = (starts or {}).get(name)
        start = min(max(field.get(spec, k), low), field.high) if given is None else given
        found.append(Unknown(name, field.unit, start, low, field.high, field.scale))
    return tuple(found)


def with_values(spec: RobotSpec, values: Mapping[str, float]) -> RobotSpec:
    """Return a robot with other numbers; names that are no robot's are left alone.

    Raises:
        InputError: values that no robot can have.
    """
    for name, value in values.items():
        if known(name):
            field, k = _field_of(spec, name)
            spec = field.put(spec, value, k)
    return spec


def known(name: str) -> bool:
    """Say whether a name is of a robot's number."""
    return _key(name)[0] in _FIELDS


def unit_of(name: str) -> str:
    """Return the unit of a robot's number.

    Raises:
        UnknownNameError: no such number.
    """
    return _field(name)[0].unit


def names_of_fields() -> list[str]:
    """Return the names of all numbers that a fit may look for, N standing for a connector or segment."""
    return list(_FIELDS)


def per_segment(spec: RobotSpec, *names: str) -> tuple[str, ...]:
    """Return names numbered from 1 to the number of segments, such as ``modules.bias_rad_1``."""
    return tuple(f"{name}_{j}" for name in names for j in range(1, spec.segments + 1))


def _key(name: str) -> tuple[str, int]:
    """Return a name with N in place of its number, and the number from 0; 0 where it has none."""
    match = re.fullmatch(r"(.+_)([1-9]\d?)", name, flags=re.ASCII)
    if match is None:
        return "" if name.endswith("_N") else name, 0  # N itself is no number
    return f"{match[1]}N", int(match[2]) - 1


def _field(name: str) -> tuple[_Field, int]:
    """Return a robot's number and which it is of its list, from 0.

    Raises:
        UnknownNameError: no such number.
    """
    key, k = _key(name)
    if key not in _FIELDS:
        raise UnknownNameError("parameter", name, names_of_fields(), "docs/identification.md")
    return _FIELDS[key], k


def _field_of(spec: RobotSpec, name: str) -> tuple[_Field, int]:
    """Return a number that this robot has, as `_field`."""
    field, k = _field(name)
    count = {"connector": spec.geometry.connectors, "segment": spec.segments}.get(field.numbered or "", 1)
    if k >= count:
        raise InputError(f"{name}: {spec.name} has {count} {field.numbered}s")
    return field, k


def _of(section: str, attribute: str, unit: str, low: float, high: float, **more: Any) -> _Field:
    """Return the field of a plain number of a section."""

    def get(spec: RobotSpec, k: int) -> float:
        return float(getattr(getattr(spec, section), attribute))

    def put(spec: RobotSpec, value: float, k: int) -> RobotSpec:
        changed: Any = replace(getattr(spec, section), **{attribute: value})
        return replace(spec, **{section: changed})

    return _Field(unit, low, high, get, put, **more)


def _module(attribute: str, side: int | None, unit: str, low: float, high: float, **more: Any) -> _Field:
    """Return the field of each module's own number; side 0 is the + chamber."""

    def get(spec: RobotSpec, k: int) -> float:
        row = spec.modules.array(attribute)[k]
        return float(row if side is None else row[side])

    def put(spec: RobotSpec, value: float, k: int) -> RobotSpec:
        modules = spec.modules
        arrays = {each.name: modules.array(each.name) for each in fields(Modules)}
        arrays[attribute][k if side is None else (k, side)] = value
        return replace(spec, variation=Modules.from_arrays(**arrays))

    return _Field(unit, low, high, get, put, numbered="segment", **more)


def _mean_mass(spec: RobotSpec, k: int) -> float:
    return spec.mass.total / spec.geometry.connectors


def _scale_masses(spec: RobotSpec, value: float, k: int) -> RobotSpec:
    by = value / _mean_mass(spec, 0)
    masses = tuple(by * mass for mass in spec.mass.connectors)
    return replace(spec, mass=replace(spec.mass, connectors=masses, wheel=by * spec.mass.wheel))


def _mass(spec: RobotSpec, k: int) -> float:
    return spec.mass.connectors[k]


def _put_mass(spec: RobotSpec, value: float, k: int) -> RobotSpec:
    masses = list(spec.mass.connectors)
    masses[k] = value
    return replace(spec, mass=replace(spec.mass, connectors=tuple(masses)))


def _lightest(spec: RobotSpec) -> float:
    """Return the mass of a connector that is hardly more than its wheels, kg."""
    return 2.01 * spec.mass.wheel / WHEEL_SHARE


def _mean_sensor_bias(spec: RobotSpec, k: int) -> float:
    return float(spec.modules.array("sensor_bias").mean())


def _put_sensor_bias(spec: RobotSpec, value: float, k: int) -> RobotSpec:
    return replace(spec, variation=replace(spec.modules, sensor_bias=(value,) * spec.segments))


def _put_bend(spec: RobotSpec, value: float, k: int) -> RobotSpec:
    return replace(spec, actuator=replace(spec.actuator, gain=value / spec.supply.nominal))


# Bounds lie within those of robot files.
_FIELDS: dict[str, _Field] = {
    "geometry.segment_length_m": _of("geometry", "segment_length", "m", 0.005, 0.5),
    "geometry.rigid_gap_m": _of("geometry", "rigid_gap", "m", 0.0, 0.2, scale=0.02),
    "geometry.half_track_m": _of("geometry", "half_track", "m", 1e-3, 0.2),
    "geometry.width_m": _of("geometry", "width", "m", 1e-3, 0.5),
    "mass.connectors_kg": _Field("kg", 1e-3, 50.0, _mean_mass, _scale_masses),
    "mass.connectors_kg_N": _Field("kg", 1e-3, 50.0, _mass, _put_mass, numbered="connector", least=_lightest),
    "friction.mu_t": _of("friction", "mu_t", "1", 1e-3, 5.0),
    "friction.mu_n": _of("friction", "mu_n", "1", 1e-3, 5.0),
    "friction.drag_n": _of("friction", "drag", "N", 0.0, 50.0, scale=0.1),
    "bending.stiffness_nm_per_rad": _of("bending", "stiffness", "N*m/rad", 1e-3, 1e3),
    "bending.damping_time_s": _of("bending", "damping_time", "s", 1e-5, 10.0),
    "actuator.tau_fill_s": _of("actuator", "tau_fill", "s", 1e-5, 50.0),
    "actuator.tau_vent_s": _of("actuator", "tau_vent", "s", 1e-5, 50.0),
    "actuator.tau_mode_s": _of("actuator", "tau_mode", "s", 1e-5, 50.0),
    "actuator.bend_rad": _Field(
        "rad", 2e-3, 6.2, lambda spec, k: spec.actuator.gain * spec.supply.nominal, _put_bend
    ),
    "actuator.bend_limit_rad": _of("actuator", "bend_limit", "rad", 0.1, 6.3),
    "actuator.onset_share": _of("actuator", "onset_share", "1", 0.0, 1.0, scale=0.5),
    "actuator.onset_rad": _of("actuator", "onset", "rad", 0.02, 6.2),
    "actuator.onset_width_rad": _of("actuator", "onset_width", "rad", 0.02, 6.2),
    "modules.gain_plus_N": _module("gain", 0, "1", 0.11, 9.0),
    "modules.gain_minus_N": _module("gain", 1, "1", 0.11, 9.0),
    "modules.tau_fill_plus_N": _module("tau_fill", 0, "1", 0.11, 9.0),
    "modules.tau_fill_minus_N": _module("tau_fill", 1, "1", 0.11, 9.0),
    "modules.tau_vent_plus_N": _module("tau_vent", 0, "1", 0.11, 9.0),
    "modules.tau_vent_minus_N": _module("tau_vent", 1, "1", 0.11, 9.0),
    "modules.bias_rad_N": _module("bias", None, "rad", -0.99, 0.99, scale=0.3),
    "modules.sensor_bias_rad": _Field("rad", -0.99, 0.99, _mean_sensor_bias, _put_sensor_bias, scale=0.3),
}
