"""Robot files: one snake, every number with its unit, status and source; robots by name, path or override.

The published robots are in calibration/robots. What a file says of the modules are numbers of each, and
spreads from which the rest is drawn. A spread is a standard deviation. Each quantity is drawn from a stream
of its own, so that one spread more does not change what the others give; numbers beyond three standard
deviations are taken at three. What is drawn comes on top of what is listed: factors multiply, biases add.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Discriminator, Field, Tag

from srs_twin.errors import InputError, InputFileError, UnknownNameError
from srs_twin.io.documents import Document, Loc, child
from srs_twin.io.files import find
from srs_twin.io.validation import Strict, load_model, validate
from srs_twin.robot.sourced import Record, Records, between, number, restated, split_unit
from srs_twin.robot.spec import (
    PER_CHAMBER,
    WHEEL_SHARE,
    Actuator,
    Bending,
    Chamber,
    Friction,
    Geometry,
    Mass,
    Modules,
    RobotSpec,
    Supply,
    Tail,
)

Factor = Annotated[float, between(0.1, 10.0)]
Both = Annotated[list[Factor], Field(min_length=2, max_length=2)]
Chambers = Record[Annotated[list[Both], Field(min_length=1, max_length=63)], Literal["1"]]
Segments = Record[Annotated[list[Factor], Field(min_length=1, max_length=63)], Literal["1"]]
Bends = Record[
    Annotated[list[Annotated[float, between(-1.0, 1.0)]], Field(min_length=1, max_length=63)], Literal["rad"]
]
Share = Record[Annotated[float, between(0.0, 0.3)], Literal["1"]]
Spread = Record[Annotated[float, between(0.0, 0.5)], Literal["rad"]]

_MOST = 3.0
_FAR = 300.0  # times: somebody meant another unit

# Quantity → its spread. Their order is that of the streams: new ones go to the end.
SPREADS = {
    "gain": "gain_spread",
    "tau_fill": "tau_spread",
    "tau_vent": "tau_spread",
    "bias": "bias_spread_rad",
    "sensor_gain": "sensor_gain_spread",
    "sensor_bias": "sensor_bias_spread_rad",
}


class ModulesFile(Records):
    """How each module departs from the nominal one."""

    gain: Chambers | None = None
    """Bend over pressure, times the nominal, 0.1 to 10 for the + and the - chamber of each segment, head
    first."""
    tau_fill: Chambers | None = None
    """tau_fill, times the nominal, 0.1 to 10 for the + and the - chamber of each segment, head first."""
    tau_vent: Chambers | None = None
    """tau_vent, times the nominal, 0.1 to 10 for the + and the - chamber of each segment, head first."""
    bias_rad: Bends | None = None
    """Bend without pressure, rad, -1 to 1 for each segment, head first."""
    sensor_gain: Segments | None = None
    """Sensed over actual bend, 0.1 to 10 for each segment, head first."""
    sensor_bias_rad: Bends | None = None
    """What is sensed of a straight segment, rad, -1 to 1 for each segment, head first."""
    gain_spread: Share | None = None
    """Standard deviation of the chambers' gains, 0 to 0.3."""
    tau_spread: Share | None = None
    """Standard deviation of the chambers' tau_fill and tau_vent, 0 to 0.3."""
    bias_spread_rad: Spread | None = None
    """Standard deviation of the bends without pressure, rad, 0 to 0.5."""
    sensor_gain_spread: Share | None = None
    """Standard deviation of the sensors' gains, 0 to 0.3."""
    sensor_bias_spread_rad: Spread | None = None
    """Standard deviation of the sensors' biases, rad, 0 to 0.5."""
    seed: Annotated[int, between(0, 2**32 - 1)] | None = None
    """Of what is drawn, 0 to 4294967295 (default: the scenario's seed)."""

    def draw(self, segments: int, seed: int) -> Modules:
        """Return the modules.

        Args:
            segments: how many.
            seed: where the file names none.
        """
        seed = seed if self.seed is None else self.seed
        arrays = {}
        for stream, (name, spread_name) in enumerate(SPREADS.items()):
            chambers, bends = name in PER_CHAMBER, name.endswith("bias")
            shape = (segments, 2) if chambers else (segments,)
            listed, spread = getattr(self, f"{name}_rad" if bends else name), getattr(self, spread_name)
            base = np.full(shape, 0.0 if bends else 1.0) if listed is None else np.array(listed.value)
            normal = np.random.default_rng([seed, stream]).standard_normal(shape)
            drawn = (spread.value if spread else 0.0) * np.clip(normal, -_MOST, _MOST)
            arrays[name] = base + drawn if bends else base * (1.0 + drawn)
        return Modules.of(**arrays)

    def contradictions(self, segments: int) -> Iterator[tuple[Loc, str]]:
        """Yield path and message of lists that do not fit the number of segments."""
        for name, record in self:
            given = record.value if isinstance(record, Record) else None
            if isinstance(given, list) and len(given) != segments:
                text = f"{len(given)} entries for {segments} segments; give {segments}, head first"
                yield ("modules", name, "value"), text


PA_PER_KPA = 1000.0
M3_PER_ML = 1e-6


def _one_or_many(value: Any) -> str:
    return "each" if isinstance(value, list) else "all"


def _one_or_each(value: Any) -> Any:
    many = Annotated[list[value], Field(min_length=2, max_length=64)]
    return Annotated[Annotated[value, Tag("all")] | Annotated[many, Tag("each")], Discriminator(_one_or_many)]


# A record with a number, a whole one or a list; what it may be stands in its field.
Number = Record[Any, str]


class GeometryFile(Records):
    """Lengths of the body."""

    connectors: Number = number(2, 64, int)
    """Number of connectors N (the text's links); one more than segments."""
    segment_length_m: Number = number(1e-3, 1.0)
    """Length of the part of a segment that bends."""
    rigid_gap_m: Number = number(0.0, 1.0)
    """Length of the part of a segment that stays straight, half of it at each end."""
    half_track_m: Number = number(1e-4, 1.0)
    """Distance of a wheel from the centre line."""
    wheel_radius_m: Number = number(1e-4, 1.0)
    """Radius of a wheel."""
    com_height_m: Number = number(1e-4, 1.0)
    """Height of the centre of mass over the floor."""
    width_m: Number = number(1e-4, 1.0)
    """Width of the soft body; no effect on the motion."""


class MassFile(Records):
    """Masses."""

    connectors_kg: Number = number(1e-4, 100.0, shape=_one_or_each)
    """Mass at a connector with its wheels and its share of the body; one for all, or a list, head first."""
    wheel_kg: Number = number(1e-6, 100.0)
    """Mass of one wheel, part of its connector's."""
    connector_gyration_m: Number | None = number(1e-4, 1.0, optional=True)
    """Radius of gyration of a connector without its wheels (default: of a uniform block as long as the rigid
    gap and as wide as the track)."""


class FrictionFile(Records):
    """Coulomb coefficients of the wheels on the floor."""

    mu_t: Number = number(0.0, 10.0)
    """Along the heading (drag of a rolling wheel)."""
    mu_n: Number = number(0.0, 10.0)
    """Across the heading (a wheel that slides sideways)."""
    drag_n: Number | None = number(0.0, 100.0, optional=True)
    """Axial drag of tubes and belly in all, whatever the load; connectors share it (default: none)."""


class BendingFile(Records):
    """Compliance of one segment."""

    stiffness_nm_per_rad: Number = number(1e-4, 1e6)
    """Stiffness of bending."""
    damping_time_s: Number = number(1e-6, 100.0)
    """Damping over stiffness; the actuator's tau_mode makes a free module obey Eq. 14 exactly."""
    pitch_stiffness_nm_per_rad: Number = number(1e-4, 1e6)
    """Stiffness against bending out of the floor plane."""
    roll_stiffness_nm_per_rad: Number = number(1e-4, 1e6)
    """Stiffness against twisting."""
    out_of_plane_damping_time_s: Number = number(1e-6, 100.0)
    """Damping over stiffness of pitch and roll."""


class ActuatorFile(Records):
    """Pneumatic response of one module; its gain is bend_rad over at_pressure_kpa."""

    tau_fill_s: Number = number(1e-6, 100.0)
    """tau_1 of filling."""
    tau_vent_s: Number = number(1e-6, 100.0)
    """tau_1 of venting."""
    tau_mode_s: Number = number(1e-6, 100.0)
    """tau_2, the valve and the fast mechanical mode."""
    bend_rad: Number = number(1e-3, 6.3)
    """Bend of a free module at rest under at_pressure_kpa."""
    at_pressure_kpa: Number = number(0.1, 2000.0)
    """Pressure in one chamber that gives bend_rad."""
    bend_limit_rad: Number | None = number(0.1, 6.3, optional=True)
    """Bend that no pressure exceeds; the law flattens towards it (default: none, linear throughout)."""
    onset_share: Number | None = number(0.0, 1.0, optional=True)
    """Share of the slope that is missing in a dead zone about no pressure (default: 1 with onset_rad)."""
    onset_rad: Number | None = number(0.01, 6.3, optional=True)
    """Bend of the linear law up to which the zone reaches; s times it is lost for good (default: 0.3)."""
    onset_width_rad: Number | None = number(0.01, 6.3, optional=True)
    """Bend of the linear law over which the zone ends; small for a corner (default: 0.1)."""


class ChamberFile(Records):
    """Air space of one chamber."""

    dead_volume_ml: Number = number(0.1, 10_000.0)
    """Volume of a straight segment's chamber with its tube."""
    air_volume_ml: Number = number(0.1, 10_000.0)
    """Volume by which a chamber grows to a bend of 90 degrees."""


class SupplyFile(Records):
    """Gauge pressures."""

    nominal_kpa: Number = number(0.1, 2000.0)
    """What a scenario gets that names no pressure."""
    continuous_limit_kpa: Number = number(0.1, 2000.0)
    """Most that a chamber may hold."""
    pulsed_limit_kpa: Number = number(0.1, 2000.0)
    """Most that may be supplied while chambers alternate (a gait, PWM)."""


class GaitFile(Records):
    """What the robot's gaits have in common."""

    phase_step_rad: Number = number(-6.3, 6.3)
    """Lag of a segment's gait behind the one before it (E18)."""


class TailFile(Records):
    """A tail assembly with a second axle behind the last connector's; a preloaded twin refuses it."""

    axle_m: Number = number(1e-3, 1.0)
    """From the last connector's axle back to the second."""
    com_m: Number = number(0.0, 1.0)
    """From the last connector's axle back to the assembly's centre of mass; at most axle_m."""
    com_height_m: Number = number(1e-4, 1.0)
    """Height of that over the floor."""
    gyration_m: Number = number(1e-4, 1.0)
    """Radius of gyration of the assembly with its wheels."""


class CorrelationFile(Strict):
    """How two uncertain numbers go together."""

    of: Annotated[list[str], Field(min_length=2, max_length=2)]
    """Their paths, as friction.mu_t; without effect where one of them is not uncertain."""
    r: Annotated[float, between(-0.999, 0.999)]
    """Correlation of the normal variables that they are made from, -0.999 to 0.999."""


class RobotFile(Strict):
    """A robot file."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$", min_length=1, max_length=40)
    """Short name."""
    title: str = Field(min_length=1, max_length=200)
    """One line for people."""
    geometry: GeometryFile
    mass: MassFile
    friction: FrictionFile
    bending: BendingFile
    actuator: ActuatorFile
    chamber: ChamberFile
    supply: SupplyFile
    gait: GaitFile
    modules: ModulesFile | None = None
    """How each module departs from the nominal one (default: not at all)."""
    tail: TailFile | None = None
    """What the last connector carries on two axles (default: it is like the others)."""
    correlated: Annotated[list[CorrelationFile], Field(max_length=500)] | None = None
    """Which uncertain numbers go together (default: none), as a fit leaves them."""

    def records(self) -> dict[str, Record[Any, Any]]:
        """Return all records by path, e.g. ``"bending.stiffness_nm_per_rad"``."""
        return {
            f"{name}.{key}": each
            for name, section in self
            if isinstance(section, Records)
            for key, each in section
            if isinstance(each, Record)
        }

    def spec(self, seed: int = 0) -> RobotSpec:
        """Return the robot in SI.

        Args:
            seed: of what its modules leave to chance, where they name none themselves.
        """
        actuator, chamber = self.actuator.in_si(), self.chamber
        gain = actuator.pop("bend") / actuator.pop("at_pressure")
        zone = bool(actuator.keys() & {"onset", "onset_width"})
        segments = self.geometry.connectors.value - 1
        return RobotSpec(
            name=self.name,
            title=self.title,
            geometry=Geometry(**self.geometry.in_si()),
            mass=Mass(**self.mass.in_si() | {"connectors": tuple(self.masses())}),
            friction=Friction(**self.friction.in_si()),
            bending=Bending(**self.bending.in_si()),
            actuator=Actuator(**{"bend_limit": math.inf, "onset_share": float(zone)} | actuator, gain=gain),
            chamber=Chamber(
                dead_volume=chamber.dead_volume_ml.value * M3_PER_ML,
                displacement=chamber.air_volume_ml.value * M3_PER_ML / (math.pi / 2),
            ),
            supply=Supply(**self.supply.in_si(), limit_source=self.supply.pulsed_limit_kpa.source),
            phase_step=self.gait.phase_step_rad.value,
            variation=self.modules.draw(segments, seed) if self.modules else None,
            tail=Tail(**self.tail.in_si()) if self.tail else None,
        )

    def masses(self) -> list[float]:
        """Return the mass of each connector as written, kg, head first."""
        value = self.mass.connectors_kg.value
        return list(value) if isinstance(value, list) else [value] * self.geometry.connectors.value

    def contradictions(self) -> Iterator[tuple[Loc, str]]:
        """Yield path and message of what does not fit together."""
        connectors, masses = self.geometry.connectors.value, self.masses()
        if len(masses) != connectors:
            yield (
                ("mass", "connectors_kg", "value"),
                f"{len(masses)} masses for {connectors} connectors; give {connectors}, or one number for all",
            )
        if 2 * (wheel := self.mass.wheel_kg.value) > WHEEL_SHARE * min(masses):
            yield (
                ("mass", "wheel_kg", "value"),
                f"two wheels of {wheel:g} kg are too much for the lightest connector, {min(masses):g} kg; "
                f"{WHEEL_SHARE * min(masses) / 2:g} kg each at most",
            )
        if self.modules is not None:
            yield from self.modules.contradictions(connectors - 1)
        if self.tail is not None and (com := self.tail.com_m.value) > (axle := self.tail.axle_m.value):
            text = f"{com:g} m is behind the second axle at {axle:g} m; the assembly would tip over"
            yield ("tail", "com_m", "value"), text
        yield from self._doubts()
        nominal, limit = self.supply.nominal_kpa.value, self.supply.pulsed_limit_kpa.value
        if nominal > limit:
            yield (
                ("supply", "nominal_kpa", "value"),
                f"{nominal:g} kPa is above pulsed_limit_kpa, {limit:g} kPa",
            )

    def _doubts(self) -> Iterator[tuple[Loc, str]]:
        """Yield path and message of what is uncertain and cannot be."""
        records = self.records()
        for path, record in records.items():
            section, key = path.split(".")
            given, value = record.uncertain, record.value
            loc, bounds = (section, key, "uncertain"), getattr(self, section).bounds.get(key)
            if given is None:
                continue
            if bounds is None or isinstance(value, list | int):
                yield loc, "only a number of its own can be uncertain, not a list or a count"
            elif given.kind == "lognormal" and value <= 0:
                yield loc, f"lognormal needs a number above 0, not {value:g}"
            elif given.low is not None and given.high is not None:
                low, high = max(bounds[0], given.low), min(bounds[1], given.high)
                if (low, high) != (given.low, given.high):
                    yield (
                        loc,
                        f"{given.low:g} to {given.high:g} leaves the allowed {bounds[0]:g} to {bounds[1]:g}",
                    )
                elif not low <= value <= high:
                    yield loc, f"the number itself, {value:g}, lies outside of {low:g} to {high:g}"
        for i, pair in enumerate(self.correlated or ()):
            for k, path in enumerate(pair.of):
                if path not in records:
                    yield ("correlated", i, "of", k), str(UnknownNameError("number", path, records))


def units_of(section: str) -> dict[str, str]:
    """Return the units of a section's records by key; nothing for what is no section."""
    field = RobotFile.model_fields.get(section)
    kinds = (get_args(field.annotation) or (field.annotation,)) if field else ()
    sections = [each for each in kinds if isinstance(each, type) and issubclass(each, Records)]
    keys: Mapping[str, Any] = sections[0].model_fields if sections else {}
    return {key: split_unit(key)[1] for key in keys if key != "seed"}


def load_robot_file(name_or_path: str | os.PathLike[str]) -> RobotFile:
    """Load and check a robot file.

    Raises:
        InputError: not found or not readable.
        InputFileError: everything that is wrong with it.
    """
    return load_model(RobotFile, find("robot", name_or_path))


def load_robot(name_or_path: str | os.PathLike[str]) -> RobotSpec:
    """Load a robot: a shipped name (gen1 to gen4, gen4_module) or the path of a robot file.

    Raises:
        InputError: not found, not readable, or everything that is wrong with it (`InputFileError`).
    """
    return load_robot_file(name_or_path).spec()


def resolve_robot(document: Document, given: Any, *, prefix: Loc) -> RobotFile | None:
    """Return the robot that a scenario names, overrides or writes out; None after reporting problems.

    Args:
        document: the scenario.
        given: a name, a path, a mapping with `base`, or a whole robot.
        prefix: path of `given` in the document.

    Raises:
        InputFileError: the robot's own file is wrong (its lines name that file).
    """
    base = given.get("base") if isinstance(given, Mapping) else given
    if isinstance(given, Mapping) and "base" not in given:
        return validate(RobotFile, document, given, prefix=prefix)
    where = (*prefix, "base") if isinstance(given, Mapping) else prefix
    if not isinstance(base, str):
        document.report(where, "must be a robot's name, a path, or a block of keys with base")
        return None
    try:
        file = load_robot_file(base)
    except InputFileError:
        raise
    except InputError as error:
        document.report(where, str(error))
        return None
    if not isinstance(given, Mapping):
        return file
    merged = _override(file.model_dump(), given, lambda loc: f"{document.setter(prefix + loc)} over {base}")
    return validate(RobotFile, document, merged, prefix=prefix)


def far_off(given: Any) -> Iterator[tuple[Loc, str]]:
    """Yield path and question of numbers that an override sets some hundred times off its base's."""
    if not isinstance(given, Mapping) or not isinstance(given.get("base"), str):
        return
    for path, record in load_robot_file(given["base"]).records().items():
        section, key = path.split(".")
        new, old = child(child(given, section), key), record.value
        new = child(new, "value") if isinstance(new, Mapping) else new
        if not all(isinstance(each, int | float) and each for each in (new, old)):
            continue
        if not 1 / _FAR < abs(new / old) < _FAR:
            ratio = new / old
            times = f"{ratio:.0f} times" if abs(ratio) > 1 else f"1/{1 / ratio:.0f} of"
            times += f" the {old:.4g} of {given['base']}"
            factor = 1e-3 if abs(new) > abs(old) else 1e3
            yield (section, key), f"{new:g} {record.unit} is {times}; did you mean {factor * new:.4g}?"


def _override(
    base: Mapping[str, Any], override: Mapping[str, Any], source: Callable[[Loc], str]
) -> dict[str, Any]:
    """Return the base with plain numbers put into its records and whole records replaced."""
    merged = dict(base)
    if any(isinstance(value, Mapping) for value in override.values()) and "title" not in override:
        merged["title"] = f"{base['title']}, modified"
    for name, value in override.items():
        if name == "base":
            continue
        section = base.get(name)
        if section is None and name in base and isinstance(value, Mapping):
            section = {}
        if not (isinstance(section, Mapping) and isinstance(value, Mapping)):
            merged[name] = value
            continue
        units = units_of(name)
        merged[name] = dict(section)
        for key, entry in value.items():
            plain = key in units and not isinstance(entry, Mapping)
            merged[name][key] = (
                restated(section.get(key), entry, units[key], source((name, key))) if plain else entry
            )
    return merged


def robot_sources(name_or_path: str | os.PathLike[str]) -> dict[str, Record[Any, Any]]:
    """Return every number of a robot with unit, status and source, by path.

    Raises:
        InputError, InputFileError: as `load_robot_file`.
    """
    return load_robot_file(name_or_path).records()
