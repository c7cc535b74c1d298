"""Robot parameters that a fit can estimate.

The name of a parameter has the form `section.key` as in robot files. For example,
``actuator.bend_rad`` is the bend at the nominal supply pressure. The name of a list
element ends with the number of the connector or segment, as in ``mass.connectors_kg_5``
or ``modules.gain_plus_2``. Without a number, ``mass.connectors_kg`` is the mean
connector mass. A change of this mean scales all masses, including the wheel masses. The
parameter ``modules.sensor_bias_rad`` applies to the sensors of all modules.

A search uses the coordinate z = ln(value), or z = value/scale if the value may be 0 or
negative. A change of z by 1, which is considered significant, multiplies the value by e
or changes the value by `scale`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.robot.rules import WHEEL_FRACTION
from srs_twin.robot.spec import Modules, RobotSpec


@dataclass(frozen=True)
class FreeParameter:
    """Free parameter of a search.

    Attributes:
        name: name of the robot parameter, or any name for a nuisance parameter.
        start: initial value of the search.
        scale: change of the value that is considered significant, in `unit`. If `scale`
            is None, the value is positive and z is the logarithm of the value.
        nuisance: whether the parameter is needed for the fit but omitted from the
            result, such as the initial velocity of a coasting test.
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
                f"{self.name}: the initial value {self.start:g} of the fit"
                f" is not allowed; it must be between {self.low:g} and {self.high:g}"
                f" {self.unit}"
            )

    def coordinate(self, value: float) -> float:
        """Return the coordinate z of a value."""
        if self.scale is None:
            return math.log(value)
        return value / self.scale

    def value(self, coordinate: float) -> float:
        """Return the value at the coordinate z, clipped to the bounds."""
        if self.scale is None:
            value = math.exp(coordinate)
        else:
            value = coordinate * self.scale
        return min(max(value, self.low), self.high)

    def derivative(self, value: float) -> float:
        """Return the derivative of the value with respect to z."""
        if self.scale is None:
            return value
        return self.scale


@dataclass(frozen=True)
class _Accessor:
    """Functions that get and set a parameter of the robot or of one list element k."""

    unit: str
    low: float
    high: float
    get: Callable[[RobotSpec, int], float]
    set: Callable[[RobotSpec, float, int], RobotSpec]
    scale: float | None = None
    numbered: str | None = None
    lowest_allowed: Callable[[RobotSpec], float] = lambda spec: -math.inf


def free_parameters(
    spec: RobotSpec, names: Iterable[str], *, starts: Mapping[str, float] | None = None
) -> tuple[FreeParameter, ...]:
    """Return free parameters that start from the values of a robot.

    The mapping `starts` contains initial values that replace those of the robot.
    """
    parameters: list[FreeParameter] = []
    for name in names:
        if any(name == parameter.name for parameter in parameters):
            raise InputError(
                f"{name}: this parameter is given twice; give each name once"
            )
        accessor, k = _checked_accessor(spec, name)
        low = max(accessor.low, accessor.lowest_allowed(spec))
        start = (starts or {}).get(name)
        if start is None:
            start = min(max(accessor.get(spec, k), low), accessor.high)
        parameters.append(
            FreeParameter(
                name, accessor.unit, start, low, accessor.high, accessor.scale
            )
        )
    return tuple(parameters)


def with_values(spec: RobotSpec, values: Mapping[str, float]) -> RobotSpec:
    """Return a copy of a robot with the given parameter values.

    Names that are not robot parameters are ignored. The result keeps the scale of
    `spec`, so that the numerical settings do not change during a fit.
    """
    scale = spec.scale
    for name, value in values.items():
        if is_parameter(name):
            accessor, k = _checked_accessor(spec, name)
            spec = accessor.set(spec, value, k)
    vars(spec)["scale"] = scale  # `cached_property` reads this value
    return spec


def is_parameter(name: str) -> bool:
    """Return whether a robot parameter has the given name."""
    key, _ = _key(name)
    return key in _ACCESSORS


def parameter_unit(name: str) -> str:
    """Return the unit of a robot parameter."""
    accessor, _ = _accessor(name)
    return accessor.unit


def parameter_names() -> list[str]:
    """Return the names of all parameters that can be fitted, with "N" for a number."""
    return list(_ACCESSORS)


def per_segment(spec: RobotSpec, *names: str) -> tuple[str, ...]:
    """Return the names with segment numbers, such as ``modules.bias_rad_1``."""
    return tuple(f"{name}_{j}" for name in names for j in range(1, spec.segments + 1))


def _key(name: str) -> tuple[str, int]:
    match = re.fullmatch(r"(.+_)([1-9]\d?)", name, flags=re.ASCII)
    if match is not None:
        return f"{match[1]}N", int(match[2]) - 1
    # A name that contains the letter N instead of a number is invalid.
    return "" if name.endswith("_N") else name, 0


def _accessor(name: str) -> tuple[_Accessor, int]:
    key, k = _key(name)
    if key not in _ACCESSORS:
        raise UnknownNameError(
            "parameter", name, parameter_names(), "docs/identification.md"
        )
    return _ACCESSORS[key], k


def _checked_accessor(spec: RobotSpec, name: str) -> tuple[_Accessor, int]:
    accessor, k = _accessor(name)
    count = {"connector": spec.geometry.connectors, "segment": spec.segments}.get(
        accessor.numbered or "", 1
    )
    if k >= count:
        raise InputError(
            f"{name}: this parameter does not exist, because {spec.name} has {count}"
            f" {accessor.numbered}s; give a number between 1 and {count}"
        )
    return accessor, k


def _scalar(
    section: str,
    attribute: str,
    unit: str,
    low: float,
    high: float,
    scale: float | None = None,
) -> _Accessor:
    def get(spec: RobotSpec, k: int) -> float:
        return float(getattr(getattr(spec, section), attribute))

    def put(spec: RobotSpec, value: float, k: int) -> RobotSpec:
        changed = replace(getattr(spec, section), **{attribute: value})
        return replace(spec, **{section: changed})

    return _Accessor(unit, low, high, get, put, scale)


def _module(
    attribute: str,
    side: int | None,
    unit: str,
    low: float,
    high: float,
    scale: float | None = None,
) -> _Accessor:
    place = () if side is None else (side,)

    def get(spec: RobotSpec, k: int) -> float:
        return float(spec.modules.array(attribute)[k, *place])

    def put(spec: RobotSpec, value: float, k: int) -> RobotSpec:
        modules = spec.modules
        arrays = {field.name: modules.array(field.name) for field in fields(Modules)}
        arrays[attribute][k, *place] = value
        return replace(spec, variation=Modules.from_arrays(**arrays))

    return _Accessor(unit, low, high, get, put, scale, numbered="segment")


def _mean_mass(spec: RobotSpec, k: int) -> float:
    return spec.mass.total / spec.geometry.connectors


def _scale_masses(spec: RobotSpec, value: float, k: int) -> RobotSpec:
    factor = value / _mean_mass(spec, 0)
    masses = tuple(factor * mass for mass in spec.mass.connectors)
    return replace(
        spec, mass=replace(spec.mass, connectors=masses, wheel=factor * spec.mass.wheel)
    )


def _set_mass(spec: RobotSpec, value: float, k: int) -> RobotSpec:
    masses = list(spec.mass.connectors)
    masses[k] = value
    return replace(spec, mass=replace(spec.mass, connectors=tuple(masses)))


def _lightest(spec: RobotSpec) -> float:
    """Return the minimum mass of a connector (kg), which depends on the wheel mass."""
    return 2.01 * spec.mass.wheel / WHEEL_FRACTION


def _set_sensor_bias(spec: RobotSpec, value: float, k: int) -> RobotSpec:
    return replace(
        spec, variation=replace(spec.modules, sensor_bias=(value,) * spec.segments)
    )


def _set_bend(spec: RobotSpec, value: float, k: int) -> RobotSpec:
    return replace(
        spec, actuator=replace(spec.actuator, gain=value / spec.supply.nominal)
    )


# These bounds lie within those of robot files, so that every result can be written.
_ACCESSORS: dict[str, _Accessor] = {
    "geometry.segment_length_m": _scalar("geometry", "segment_length", "m", 0.005, 0.5),
    "geometry.rigid_gap_m": _scalar("geometry", "rigid_gap", "m", 0.0, 0.2, scale=0.02),
    "geometry.half_track_m": _scalar("geometry", "half_track", "m", 1e-3, 0.2),
    "geometry.width_m": _scalar("geometry", "width", "m", 1e-3, 0.5),
    "mass.connectors_kg": _Accessor("kg", 1e-3, 50.0, _mean_mass, _scale_masses),
    "mass.connectors_kg_N": _Accessor(
        "kg",
        1e-3,
        50.0,
        lambda spec, k: spec.mass.connectors[k],
        _set_mass,
        numbered="connector",
        lowest_allowed=_lightest,
    ),
    "friction.mu_t": _scalar("friction", "mu_t", "1", 1e-3, 5.0),
    "friction.mu_n": _scalar("friction", "mu_n", "1", 1e-3, 5.0),
    "friction.drag_n": _scalar("friction", "drag", "N", 0.0, 50.0, scale=0.1),
    "bending.stiffness_nm_per_rad": _scalar(
        "bending", "stiffness", "N*m/rad", 1e-3, 1e3
    ),
    "bending.damping_time_s": _scalar("bending", "damping_time", "s", 1e-5, 10.0),
    "actuator.tau_fill_s": _scalar("actuator", "tau_fill", "s", 1e-5, 50.0),
    "actuator.tau_vent_s": _scalar("actuator", "tau_vent", "s", 1e-5, 50.0),
    "actuator.tau_mode_s": _scalar("actuator", "tau_mode", "s", 1e-5, 50.0),
    "actuator.bend_rad": _Accessor(
        "rad",
        2e-3,
        6.2,
        lambda spec, k: spec.actuator.gain * spec.supply.nominal,
        _set_bend,
    ),
    "actuator.bend_limit_rad": _scalar("actuator", "bend_limit", "rad", 0.1, 6.3),
    "actuator.onset_fraction": _scalar(
        "actuator", "onset_fraction", "1", 0.0, 1.0, scale=0.5
    ),
    "actuator.dead_zone_rad": _scalar("actuator", "dead_zone", "rad", 0.02, 6.2),
    "actuator.dead_zone_transition_rad": _scalar(
        "actuator", "dead_zone_transition", "rad", 0.02, 6.2
    ),
    **{
        f"modules.{name}_{side}_N": _module(name, k, "1", 0.11, 9.0)
        for name in ("gain", "tau_fill", "tau_vent")
        for k, side in enumerate(("plus", "minus"))
    },
    "modules.bias_rad_N": _module("bias", None, "rad", -0.99, 0.99, scale=0.3),
    "modules.sensor_bias_rad": _Accessor(
        "rad",
        -0.99,
        0.99,
        lambda spec, k: float(spec.modules.array("sensor_bias").mean()),
        _set_sensor_bias,
        scale=0.3,
    ),
}
