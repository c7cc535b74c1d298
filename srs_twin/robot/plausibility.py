"""Detection of robot parameters that are probably given in a wrong unit.

All numbers of one physical quantity, such as all lengths, are compared with each other.
A robot that is scaled as a whole therefore remains plausible. Each number is divided by
a typical ratio, which yields an estimate of the robot's size. The median of these
estimates is robust against a single mistake. A number is implausible if the ratio of
its size estimate to the median exceeds `_Quantity.above` or is less than
1/`_Quantity.below`.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from srs_twin.robot.spec import GRAVITY

# Conversion factors from units that users may confuse with the unit of a key.
_OTHER_UNITS = {
    "m": {"cm": 0.01, "mm": 0.001, "": 0.1},
    "kg": {"g": 0.001},
    "s": {"ms": 0.001},
    "kPa": {"bar": 100.0, "psi": 6.894757, "mbar": 0.1, "Pa": 0.001},
    "N*m/rad": {"mN*m/rad": 0.001},
    "rad": {"deg": math.pi / 180},
}


class _Quantity(NamedTuple):
    """Robot parameters of one physical quantity, with plausibility limits.

    Attributes:
        name: plural name of the quantity, used in messages.
        unit: unit of the quantity in robot files.
        below: maximum plausible ratio of the median size to a size estimate.
        above: maximum plausible ratio of a size estimate to the median size.
        usual: typical ratio of each parameter to the robot's size, keyed by path.
    """

    name: str
    unit: str
    below: float
    above: float
    usual: dict[str, float]


_LENGTHS = {
    "geometry.segment_length_m": 0.35,
    "geometry.rigid_gap_m": 0.3,
    "geometry.half_track_m": 0.22,
    "geometry.wheel_radius_m": 0.12,
    "geometry.com_height_m": 0.25,
    "geometry.width_m": 0.6,
    "mass.connector_gyration_m": 0.2,
    "tail.axle_m": 1.0,
    "tail.com_m": 0.8,
    "tail.com_height_m": 0.25,
    "tail.gyration_m": 0.3,
}
_TIMES = {
    "actuator.tau_fill_s": 1.5,
    "actuator.tau_vent_s": 1.5,
    "actuator.response_time_s": 1.5,
    "actuator.tau_mode_s": 0.03,
    "bending.damping_time_s": 0.05,
    "bending.out_of_plane_damping_time_s": 0.12,
}
_PRESSURES = ("actuator.at_pressure_kpa",) + tuple(
    f"supply.{name}_kpa" for name in ("nominal", "continuous_limit", "pulsed_limit")
)
_STIFFNESSES = [
    f"bending.{name}stiffness_nm_per_rad" for name in ("", "pitch_", "roll_")
]
_QUANTITIES = (
    _Quantity("lengths", "m", 36.0, 6.5, _LENGTHS),
    _Quantity("times", "s", 1600.0, 40.0, _TIMES),
    _Quantity("pressures", "kPa", 6.0, 6.0, dict.fromkeys(_PRESSURES, 1.0)),
    _Quantity(
        "volumes",
        "ml",
        100.0,
        100.0,
        {"chamber.dead_volume_ml": 0.05, "chamber.air_volume_ml": 0.18},
    ),
    _Quantity("stiffnesses", "N*m/rad", 150.0, 150.0, dict.fromkeys(_STIFFNESSES, 1.0)),
)

_CERTAIN = 100.0
"""Minimum factor by which a certainly wrong number exceeds the plausible range."""

_DENSITY = 500.0
"""Typical density of a connector with the adjacent half segments, kg/m³."""

_DENSITY_RATIO = 50.0
"""Maximum plausible ratio of a density to `_DENSITY`. A density above four times this
limit is certainly wrong, because even osmium has only 22 600 kg/m³."""


class Doubt(NamedTuple):
    """Number that is probably given in a wrong unit."""

    path: str
    text: str
    is_certain: bool


def likely_unit(value: float, unit: str, expected: float) -> str:
    """Suggest the unit that a number probably has, as in "0.4 bar would be 40 kPa"."""
    factors = {unit: 1.0} | _OTHER_UNITS.get(unit, {})
    other = min(
        factors, key=lambda name: abs(math.log(factors[name] * value / expected))
    )
    if other == unit:
        return "check the unit"
    given = f"{value:g} {other}" if other else "a tenth of it"
    return f"{given} would be {factors[other] * value:.4g} {unit}"


def find_doubts(values: Mapping[str, Any], masses: Sequence[float]) -> Iterator[Doubt]:
    """Yield the numbers that do not fit the other numbers of a robot.

    Args:
        values: values in the robot file, keyed by path.
        masses: connector masses, or segment masses of a robot with skin, kg.
    """
    pitch = values["geometry.segment_length_m"] + values["geometry.rigid_gap_m"]
    stiffnesses = {
        "weight times body length": GRAVITY * sum(masses) * pitch * len(masses)
    }
    if "chamber.air_volume_ml" in values and "actuator.at_pressure_kpa" in values:
        # The product of a pressure in kPa and a volume in ml is in mJ.
        moment = (
            1e-3
            * values["actuator.at_pressure_kpa"]
            * values["chamber.air_volume_ml"]
            / (math.pi / 2)
        )
        stiffnesses["bending moment due to air pressure, divided by the bend"] = (
            moment / values["actuator.bend_rad"]
        )
    lengths = list(_outliers(values, _QUANTITIES[0], {}))
    yield from lengths
    for quantity in _QUANTITIES[1:]:
        yield from _outliers(
            values, quantity, stiffnesses if quantity.name == "stiffnesses" else {}
        )
    if not lengths:
        yield from _wrong_masses(values, pitch, masses)


def _outliers(
    values: Mapping[str, Any], quantity: _Quantity, derived: Mapping[str, float]
) -> Iterator[Doubt]:
    given = {path: values[path] for path in quantity.usual if values.get(path)}
    numbers = {**given, **derived}
    sizes = {
        name: number / quantity.usual.get(name, 1.0) for name, number in numbers.items()
    }
    size = statistics.median(sizes.values() or [1.0])
    for path, value in given.items():
        excess = sizes[path] / size
        excess = max(excess / quantity.above, 1 / (excess * quantity.below))
        if excess <= 1:
            continue
        closest = min(
            sizes, key=lambda name: (name == path, abs(math.log(sizes[name] / size)))
        )
        text = (
            f"{value:g} {quantity.unit} does not fit the other {quantity.name} of the"
            " robot, such as "
        )
        text += f"{closest.rpartition('.')[2]}, {numbers[closest]:.4g} {quantity.unit}"
        hint = likely_unit(value, quantity.unit, quantity.usual[path] * size)
        yield Doubt(path, f"{text}; {hint}", excess > _CERTAIN)


def _wrong_masses(
    values: Mapping[str, Any], pitch: float, masses: Sequence[float]
) -> Iterator[Doubt]:
    width = values["geometry.width_m"]
    usual = _DENSITY * pitch * width**2
    (path,) = values.keys() & {"mass.segments_kg", "mass.connectors_kg"}
    for mass in dict.fromkeys(masses):
        excess = max(mass / usual / _DENSITY_RATIO, usual / mass / 1000)
        if excess > 1:
            text = (
                f"{mass:g} kg is implausible for a part of {pitch:g} m by"
                f" {width:g} m, because the density would be"
            )
            text += f" {mass / usual * _DENSITY:.2g} kg/m³"
            yield Doubt(path, f"{text}; {likely_unit(mass, 'kg', usual)}", excess > 4)
