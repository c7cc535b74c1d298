"""Robot files: parameters of one snake with unit, status and source, given by name, path or override.

The published robots are in calibration/robots. A file may list individual properties of the modules, and
standard deviations for random differences between them. Each quantity has its own random stream, so that a
new standard deviation does not change the other draws. Draws are limited to three standard deviations. They
are combined with the listed values: factors are multiplied, biases are added.
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
from srs_twin.io.files import find_file
from srs_twin.io.validation import StrictModel, load_model, validate
from srs_twin.robot.friction import SkinLaw
from srs_twin.robot.scale import Scale
from srs_twin.robot.sourced import Record, Records, bounded, number_field, replace_value, split_unit
from srs_twin.robot.spec import (
    GRAVITY,
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
    Skin,
    Supply,
    Tail,
)

Factor = Annotated[float, bounded(0.1, 10.0)]
ChamberPair = Annotated[list[Factor], Field(min_length=2, max_length=8)]
ChamberFactors = Record[Annotated[list[ChamberPair], Field(min_length=1, max_length=63)], Literal["1"]]
SegmentFactors = Record[Annotated[list[Factor], Field(min_length=1, max_length=63)], Literal["1"]]
Directions = Record[
    Annotated[list[Annotated[float, bounded(-360.0, 360.0)]], Field(min_length=3, max_length=8)],
    Literal["deg"],
]
BendList = Record[
    Annotated[list[Annotated[float, bounded(-1.0, 1.0)]], Field(min_length=1, max_length=63)], Literal["rad"]
]
RelativeStd = Record[Annotated[float, bounded(0.0, 0.3)], Literal["1"]]
AngleStd = Record[Annotated[float, bounded(0.0, 0.5)], Literal["rad"]]

_MAX_DEVIATIONS = 3.0
"""Limit of random draws, in standard deviations."""

# Bounds of files. They admit the shipped robots scaled by 1/40 to 100: lengths by s, masses by s³, and
# stiffness by s⁴.
LENGTHS_M = (1e-5, 100.0)
"""Smallest and largest length of a robot, m."""
MASSES_KG = (1e-10, 1e6)
"""Smallest and largest mass of a part, kg."""
STIFFNESSES_NM_PER_RAD = (1e-10, 1e9)
"""Smallest and largest stiffness of a segment, N·m/rad."""

# Numbers outside these ranges are taken as wrong units.
_LENGTH_RATIOS = (1e-3, 100.0)  # of a length and the distance between connectors, 1
_DENSITIES = (0.1, 1e5)  # of a connector with its part of the body, kg/m³; lead has 11 000

_SUSPICIOUS_RATIO = 300.0
"""Ratio of an override to the base's number above which a wrong unit (mm, Pa) is likely."""

# Quantity → key of its standard deviation. The position is the number of the random stream: append new ones.
SPREAD_KEYS = {
    "gain": "gain_spread",
    "tau_fill": "tau_spread",
    "tau_vent": "tau_spread",
    "bias": "bias_spread_rad",
    "sensor_gain": "sensor_gain_spread",
    "sensor_bias": "sensor_bias_spread_rad",
}


class ModulesFile(Records):
    """Individual properties of the modules and their random differences."""

    gain: ChamberFactors | None = None
    """Gain as a multiple of the nominal one, 0.1 to 10 for the + and the - chamber (or each of
    chamber.directions_deg) of each segment, head first."""
    tau_fill: ChamberFactors | None = None
    """tau_fill as a multiple of the nominal one, 0.1 to 10 for the + and the - chamber of each segment, head
    first."""
    tau_vent: ChamberFactors | None = None
    """tau_vent as a multiple of the nominal one, 0.1 to 10 for the + and the - chamber of each segment, head
    first."""
    bias_rad: BendList | None = None
    """Rest bend, rad, -1 to 1 for each segment, head first."""
    sensor_gain: SegmentFactors | None = None
    """Ratio of sensor reading to actual bend, 0.1 to 10 for each segment, head first."""
    sensor_bias_rad: BendList | None = None
    """Sensor reading of a straight segment, rad, -1 to 1 for each segment, head first."""
    gain_spread: RelativeStd | None = None
    """Standard deviation of the relative gains of the chambers, 0 to 0.3."""
    tau_spread: RelativeStd | None = None
    """Standard deviation of the relative tau_fill and tau_vent of the chambers, 0 to 0.3."""
    bias_spread_rad: AngleStd | None = None
    """Standard deviation of the rest bends, rad, 0 to 0.5."""
    sensor_gain_spread: RelativeStd | None = None
    """Standard deviation of the sensor gains, 0 to 0.3."""
    sensor_bias_spread_rad: AngleStd | None = None
    """Standard deviation of the sensor biases, rad, 0 to 0.5."""
    seed: Annotated[int, bounded(0, 2**32 - 1)] | None = None
    """Random seed of the differences, 0 to 4294967295 (default: seed of the scenario)."""

    def draw(self, segments: int, seed: int, chambers: int = 2) -> Modules:
        """Return modules with the listed properties and random differences.

        Args:
            segments: number of segments.
            seed: random seed if the file has none.
            chambers: number of chambers of a segment.
        """
        seed = seed if self.seed is None else self.seed
        arrays = {}
        for stream, (name, std_name) in enumerate(SPREAD_KEYS.items()):
            per_chamber, additive = name in PER_CHAMBER, name.endswith("bias")
            shape = (segments, chambers) if per_chamber else (segments,)
            listed, std = getattr(self, f"{name}_rad" if additive else name), getattr(self, std_name)
            base = np.full(shape, 0.0 if additive else 1.0) if listed is None else np.array(listed.value)
            normal = np.random.default_rng([seed, stream]).standard_normal(shape)
            drawn = (std.value if std else 0.0) * np.clip(normal, -_MAX_DEVIATIONS, _MAX_DEVIATIONS)
            arrays[name] = base + drawn if additive else base * (1.0 + drawn)
        return Modules.from_arrays(**arrays)

    def contradictions(self, segments: int, chambers: int) -> Iterator[tuple[Loc, str]]:
        """Yield path and message of lists whose length is not the number of segments or chambers."""
        for name, record in self:
            values = record.value if isinstance(record, Record) else None
            if name in PER_CHAMBER and isinstance(values, list):
                for j, row in enumerate(values):
                    if len(row) != chambers:
                        text = f"{len(row)} factors for {chambers} chambers; give {chambers}"
                        yield ("modules", name, "value", j), text
            if isinstance(values, list) and len(values) != segments:
                text = f"{len(values)} entries for {segments} segments; give {segments}, head first"
                yield ("modules", name, "value"), text


PA_PER_KPA = 1000.0
M3_PER_ML = 1e-6


def _mass_tag(value: object) -> str:
    return "each" if isinstance(value, list) else "all"


def _one_or_each(value: Any) -> Any:
    """Return the type of one value for all connectors, or of a list with one for each."""
    many = Annotated[list[value], Field(min_length=2, max_length=64)]
    return Annotated[Annotated[value, Tag("all")] | Annotated[many, Tag("each")], Discriminator(_mass_tag)]


# Record with a float, an integer or a list; `number_field` defines which.
Number = Record[Any, str]


class GeometryFile(Records):
    """Dimensions of the body."""

    connectors: Number = number_field(2, 64, int)
    """Number of connectors N ("links" in the dissertation); one more than segments."""
    segment_length_m: Number = number_field(*LENGTHS_M)
    """Length of the bending part of a segment."""
    rigid_gap_m: Number = number_field(0.0, LENGTHS_M[1])
    """Length of the straight part of a segment, half of it at each end."""
    half_track_m: Number | None = number_field(*LENGTHS_M, optional=True)
    """Distance of a wheel from the centre line; wheels only."""
    wheel_radius_m: Number | None = number_field(*LENGTHS_M, optional=True)
    """Radius of a wheel; wheels only."""
    com_height_m: Number = number_field(*LENGTHS_M)
    """Height of the centre of mass above the floor."""
    width_m: Number = number_field(*LENGTHS_M)
    """Width of the soft body; only that of a skin has an effect on the motion."""


class MassFile(Records):
    """Masses."""

    connectors_kg: Number | None = number_field(*MASSES_KG, shape=_one_or_each, optional=True)
    """Mass of a connector with its wheels and its part of the body; one number for all, or a list, head
    first. Wheels only."""
    wheel_kg: Number | None = number_field(*MASSES_KG, optional=True)
    """Mass of one wheel, included in that of its connector; wheels only."""
    connector_gyration_m: Number | None = number_field(*LENGTHS_M, optional=True)
    """Radius of gyration of a connector without its wheels (default: that of a uniform block with the length
    of the rigid gap and the width of the track); wheels only."""
    segments_kg: Number | None = number_field(*MASSES_KG, shape=_one_or_each, optional=True)
    """Mass of the body from one connector to the next, spread evenly over its length; one number for all, or
    a list, head first. Skin only."""


class FrictionFile(Records):
    """Friction of the wheels on the floor, and axial drag; a skin has its coefficients in contact."""

    mu_t: Number | None = number_field(0.0, 10.0, optional=True)
    """Friction coefficient along the heading (drag of a rolling wheel); wheels only."""
    mu_n: Number | None = number_field(0.0, 10.0, optional=True)
    """Friction coefficient across the heading (a wheel that slides sideways); wheels only."""
    drag_n: Number | None = number_field(0.0, 1e7, optional=True)
    """Total axial drag of tubes and belly, independent of the load; equal parts act on the connectors
    (default: none)."""


class ContactFile(Records):
    """Kind of contact with the floor."""

    kind: Literal["wheels", "skin"]
    """wheels: two wheels on each connector, described in geometry, mass and friction; skin: a body that
    slides on its belly along its whole length."""
    law: SkinLaw | None = None
    """Friction law of a skin; ellipse: the force with the largest dissipation (default), cosine: each
    component proportional to the direction cosine of the slip (docs/models.md)."""
    forward: Number | None = number_field(0.0, 10.0, optional=True)
    """Friction coefficient along the body for slip towards the head; skin only."""
    backward: Number | None = number_field(0.0, 10.0, optional=True)
    """Friction coefficient along the body for slip towards the tail (default: forward); skin only."""
    transverse: Number | None = number_field(0.0, 10.0, optional=True)
    """Friction coefficient across the body; skin only."""
    points_per_segment: Number | None = number_field(1, 64, int, optional=True)
    """Contact points along each segment (default: 6); skin only."""

    @property
    def is_skin(self) -> bool:
        """Whether the robot slides on its belly."""
        return self.kind == "skin"

    def friction(self) -> dict[str, float]:
        """Return the coefficients of a skin as arguments of `Friction`."""
        names = {"mu_t": self.forward, "mu_back": self.backward, "mu_n": self.transverse}
        return {name: record.value for name, record in names.items() if record is not None}

    def skin(self) -> Skin:
        """Return the skin."""
        given = {"law": self.law, "points": self.points_per_segment and self.points_per_segment.value}
        values: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        return Skin(**values)


_NEEDED: dict[tuple[str, str], tuple[str, ...]] = {
    ("contact", "wheels"): (
        "geometry.half_track_m", "geometry.wheel_radius_m", "mass.connectors_kg", "mass.wheel_kg",
        "friction.mu_t", "friction.mu_n",
    ),
    ("contact", "skin"): ("mass.segments_kg", "contact.forward", "contact.transverse"),
    ("actuator", "pressure"): (
        "bending.stiffness_nm_per_rad", "bending.damping_time_s", "actuator.tau_fill_s",
        "actuator.tau_vent_s", "actuator.tau_mode_s", "actuator.at_pressure_kpa",
        "chamber.dead_volume_ml", "chamber.air_volume_ml",
        "supply.nominal_kpa", "supply.continuous_limit_kpa", "supply.pulsed_limit_kpa",
    ),
    ("actuator", "position"): ("actuator.response_time_s",),
}  # fmt: skip
"""Section and kind → keys that a robot of this kind needs, and that one of the other kind does not have."""

_POSSIBLE: dict[tuple[str, str], tuple[str, ...]] = {
    ("contact", "wheels"): ("mass.connector_gyration_m",),
    ("contact", "skin"): ("contact.law", "contact.backward", "contact.points_per_segment"),
    ("actuator", "pressure"): (
        "actuator.bend_limit_rad", "actuator.onset_share", "actuator.onset_rad", "actuator.onset_width_rad",
        "actuator.extension_m_per_kpa",
    ),
    ("actuator", "position"): (),
}  # fmt: skip
"""Section and kind → further keys that a robot of the other kind does not have."""

_OTHER_KIND = {"wheels": "skin", "skin": "wheels", "pressure": "position", "position": "pressure"}

SERVO_PRESSURE_KPA = 100.0
"""Pressure that stands for the full command of a servo, kPa: commands of all robots are valve states."""

_SERVO_VOLUME_M3 = 1e-12
"""Volumes of the chambers that a servo does not have, m³: they take no air worth counting."""

_ROUND_TRACK = 1e-3
"""Half the distance of two contact points side by side over the width, 1: both are below the axis."""

_ROUNDNESS = 0.01
"""Relative difference of width and height at which a section still counts as round, 1."""

_TWIST_RATIO = 2 / 3
"""GJ/EI of a solid, incompressible, round section: J = 2 I and G = E/3."""

_RIGID_RATIO = 1000.0
"""Stiffness of a servo joint over weight times body length, 1: floor loads bend it by less than 1 mrad."""


class BendingFile(Records):
    """Compliance of one segment."""

    stiffness_nm_per_rad: Number | None = number_field(*STIFFNESSES_NM_PER_RAD, optional=True)
    """Bending stiffness; pressure only."""
    damping_time_s: Number | None = number_field(1e-6, 100.0, optional=True)
    """Damping over stiffness; with the value of tau_mode_s, a free module obeys Eq. 14 exactly. Pressure
    only."""
    pitch_stiffness_nm_per_rad: Number | None = number_field(*STIFFNESSES_NM_PER_RAD, optional=True)
    """Stiffness against bending out of the floor plane; a spatial robot may leave it out (default: that of
    bending)."""
    roll_stiffness_nm_per_rad: Number | None = number_field(*STIFFNESSES_NM_PER_RAD, optional=True)
    """Stiffness against twisting; a spatial robot may leave it out (default: two thirds of the bending
    stiffness, GJ = 2/3 EI of a solid, incompressible, round section)."""
    out_of_plane_damping_time_s: Number = number_field(1e-6, 100.0)
    """Damping over stiffness of pitch and roll."""


class ActuatorFile(Records):
    """Response of one module: pneumatic with the gain bend_rad over at_pressure_kpa, or that of a servo."""

    kind: Literal["pressure", "position"] | None = None
    """pressure: air in chambers bends the segment against its stiffness (default); position: a servo turns a
    joint to the commanded angle regardless of the load, bend_rad where a valve would fill the + chamber."""
    response_time_s: Number | None = number_field(1e-4, 100.0, optional=True)
    """Time constant of the critically damped response of a servo; position only."""
    tau_fill_s: Number | None = number_field(1e-6, 100.0, optional=True)
    """Fill time constant tau_1; pressure only."""
    tau_vent_s: Number | None = number_field(1e-6, 100.0, optional=True)
    """Vent time constant tau_1; pressure only."""
    tau_mode_s: Number | None = number_field(1e-6, 100.0, optional=True)
    """Mode time constant tau_2, with which the free bend follows the pressures; pressure only."""
    bend_rad: Number = number_field(1e-3, 6.3)
    """Static bend of a free module under at_pressure_kpa, or the largest angle that a servo is commanded."""
    at_pressure_kpa: Number | None = number_field(0.1, 2000.0, optional=True)
    """Pressure in one chamber that causes bend_rad; pressure only."""
    bend_limit_rad: Number | None = number_field(0.1, 6.3, optional=True)
    """Limit of the free bend at high pressure (default: none, the gain is linear)."""
    onset_share: Number | None = number_field(0.0, 1.0, optional=True)
    """Missing fraction s of the gain in a dead zone around zero pressure (default: 1 if another
    onset key is present, otherwise 0)."""
    onset_rad: Number | None = number_field(0.01, 6.3, optional=True)
    """Bend of the linear law at the end of the dead zone; beyond it s times this bend is missing (default:
    0.3)."""
    onset_width_rad: Number | None = number_field(0.01, 6.3, optional=True)
    """Width of the transition at the end of the dead zone, as a bend of the linear law (default: 0.1)."""
    extension_m_per_kpa: Number | None = number_field(0.0, 0.01, optional=True)
    """Extension of a segment of a spatial robot over the mean pressure of its chambers (default: 0)."""


class ChamberFile(Records):
    """Air space of one chamber."""

    dead_volume_ml: Number = number_field(1e-6, 1e8)
    """Volume of the chamber of a straight segment with its tube."""
    air_volume_ml: Number = number_field(1e-6, 1e8)
    """Increase of the volume at a bend of 90 degrees."""
    directions_deg: Directions | None = None
    """Directions in which the chambers of a spatial robot bend a segment, -360 to 360, 0 to the left, 90
    upwards; four make two antagonistic pairs (default: one chamber to the left and one to the right)."""


class SupplyFile(Records):
    """Gauge pressures of the supply and their limits."""

    nominal_kpa: Number = number_field(0.1, 2000.0)
    """Supply pressure of scenarios that do not specify one."""
    continuous_limit_kpa: Number = number_field(0.1, 2000.0)
    """Highest pressure that a chamber may hold."""
    pulsed_limit_kpa: Number = number_field(0.1, 2000.0)
    """Highest supply pressure while chambers alternate (gait, PWM)."""


class GaitFile(Records):
    """Common parameters of all gaits of the robot."""

    phase_step_rad: Number = number_field(-6.3, 6.3)
    """Phase lag of the gait from one segment to the next (E18)."""


class TailFile(Records):
    """Tail assembly with a second axle behind that of the last connector; not available with preload."""

    axle_m: Number = number_field(*LENGTHS_M)
    """Distance of the second axle behind the axle of the last connector."""
    com_m: Number = number_field(0.0, LENGTHS_M[1])
    """Distance of the centre of mass behind the axle of the last connector; at most axle_m."""
    com_height_m: Number = number_field(*LENGTHS_M)
    """Height of the centre of mass of the assembly above the floor."""
    gyration_m: Number = number_field(*LENGTHS_M)
    """Radius of gyration of the assembly including its wheels."""


class CorrelationFile(StrictModel):
    """Correlation of two uncertain numbers."""

    of: Annotated[list[str], Field(min_length=2, max_length=2)]
    """Paths of the two numbers, such as friction.mu_t; no effect if one of them is not uncertain."""
    r: Annotated[float, bounded(-0.999, 0.999)]
    """Correlation of the normal variables that the numbers are computed from, -0.999 to 0.999."""


class RobotFile(StrictModel):
    """Robot file."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$", min_length=1, max_length=40)
    """Short name."""
    title: str = Field(min_length=1, max_length=200)
    """Description in one line."""
    geometry: GeometryFile
    mass: MassFile
    friction: FrictionFile = FrictionFile()
    """Friction of the wheels on the floor, and axial drag."""
    contact: ContactFile | None = None
    """Kind of contact with the floor (default: wheels)."""
    bending: BendingFile
    actuator: ActuatorFile
    chamber: ChamberFile | None = None
    """Air space of one chamber; with actuator pressure."""
    supply: SupplyFile | None = None
    """Gauge pressures of the supply and their limits; with actuator pressure."""
    gait: GaitFile
    modules: ModulesFile | None = None
    """Individual properties of the modules (default: identical nominal modules)."""
    tail: TailFile | None = None
    """Tail assembly of the last connector (default: none)."""
    correlated: Annotated[list[CorrelationFile], Field(max_length=500)] | None = None
    """Correlations of uncertain numbers, such as those of a fit (default: none)."""

    def records(self) -> dict[str, Record[Any, Any]]:
        """Return all records by path, e.g. ``"bending.stiffness_nm_per_rad"``."""
        return {
            f"{name}.{key}": record
            for name, section in self
            if isinstance(section, Records)
            for key, record in section
            if isinstance(record, Record)
        }

    @property
    def scale(self) -> Scale:
        """Units of the numerical settings."""
        return Scale.of_pitch(self.geometry.segment_length_m.value + self.geometry.rigid_gap_m.value)

    def spec(self, seed: int = 0) -> RobotSpec:
        """Return the robot in SI units.

        Args:
            seed: random seed of the modules if `modules` has none.
        """
        bending = self.bending.to_si()
        if self.is_spatial:
            stiffness = bending["stiffness"]
            bending = {"pitch_stiffness": stiffness, "roll_stiffness": _TWIST_RATIO * stiffness} | bending
        if self.has_servos:
            actuator, rigid, chamber, supply = self._servo()
            bending |= rigid
        else:
            actuator, (chamber, supply) = self.actuator.to_si(), self._pneumatics()
        gain = actuator.pop("bend") / actuator.pop("at_pressure")
        has_dead_zone = bool(actuator.keys() & {"onset", "onset_width"})
        segments = self.geometry.connectors.value - 1
        geometry, friction, contact = self.geometry.to_si(), self.friction.to_si(), self.contact
        if contact is None or not contact.is_skin:
            mass, skin = Mass(**self.mass.to_si() | {"connectors": tuple(self.masses())}), None
        else:
            mass, skin = Mass.along_body(tuple(self.masses())), contact.skin()
            friction |= contact.friction()
            # The section of a spatial robot is round and touches the floor along a line.
            track = 1 / _ROUND_TRACK if self.is_spatial else 2 * math.sqrt(3)
            geometry |= {
                "half_track": geometry["width"] / track,
                "wheel_radius": geometry["com_height"],  # spheres around the centre of the body
            }
        return RobotSpec(
            name=self.name,
            title=self.title,
            geometry=Geometry(**geometry),
            mass=mass,
            friction=Friction(**friction),
            bending=Bending(**bending),
            actuator=Actuator(
                **{"bend_limit": math.inf, "onset_share": float(has_dead_zone)} | actuator, gain=gain
            ),
            chamber=chamber,
            supply=supply,
            phase_step=self.gait.phase_step_rad.value,
            variation=self.modules.draw(segments, seed, self._chambers) if self.modules else None,
            tail=Tail(**self.tail.to_si()) if self.tail else None,
            skin=skin,
        )

    @property
    def has_skin(self) -> bool:
        """Whether the robot slides on its belly, without wheels."""
        return self.contact is not None and self.contact.is_skin

    @property
    def is_spatial(self) -> bool:
        """Whether the segments bend in two directions."""
        return self.chamber is not None and self.chamber.directions_deg is not None

    @property
    def _chambers(self) -> int:
        """Number of chambers of a segment."""
        assert not self.is_spatial or (self.chamber and self.chamber.directions_deg)
        return len(self.chamber.directions_deg.value) if self.is_spatial else 2  # type: ignore[union-attr]

    def masses(self) -> list[float]:
        """Return the mass of each connector, or of each segment of a robot with skin, kg, head first."""
        record, count = self.mass.connectors_kg, self.geometry.connectors.value
        if self.has_skin:
            record, count = self.mass.segments_kg, count - 1
        assert record is not None, "`contradictions` reports a missing mass"
        return list(record.value) if isinstance(record.value, list) else [record.value] * count

    @property
    def has_servos(self) -> bool:
        """Whether servos turn the joints, instead of air."""
        return self.actuator.kind == "position"

    def _servo(self) -> tuple[dict[str, float], dict[str, float], Chamber, Supply]:
        """Return actuator, bending, chamber and supply of pneumatic modules that move like servos.

        Two equal time constants make a critically damped response. The stiffness k is so high that loads do
        not matter; with the damping k τ the joints of the twin follow the same response.
        """
        time = self.actuator.response_time_s
        assert time is not None, "`contradictions` reports a missing key"
        g, tau, pressure = self.geometry, float(time.value), SERVO_PRESSURE_KPA * PA_PER_KPA
        body = (g.connectors.value - 1) * (g.segment_length_m.value + g.rigid_gap_m.value)
        mass = sum(self.masses())
        actuator = {"bend": self.actuator.bend_rad.value, "at_pressure": pressure}
        actuator |= dict.fromkeys(("tau_fill", "tau_vent", "tau_mode"), tau)
        bending = {"stiffness": _RIGID_RATIO * GRAVITY * mass * body, "damping_time": tau}
        supply = Supply(pressure, pressure, pressure, "full command of a servo")
        return actuator, bending, Chamber(_SERVO_VOLUME_M3, _SERVO_VOLUME_M3), supply

    def _pneumatics(self) -> tuple[Chamber, Supply]:
        """Return chamber and supply of pneumatic modules."""
        assert self.chamber is not None, "`contradictions` reports missing keys"
        assert self.supply is not None, "`contradictions` reports missing keys"
        directions = self.chamber.directions_deg
        chamber = Chamber(
            dead_volume=self.chamber.dead_volume_ml.value * M3_PER_ML,
            displacement=self.chamber.air_volume_ml.value * M3_PER_ML / (math.pi / 2),
            directions=None if directions is None else tuple(map(math.radians, directions.value)),
        )
        return chamber, Supply(**self.supply.to_si(), limit_source=self.supply.pulsed_limit_kpa.source)

    def _contradictions_of_kinds(self) -> Iterator[tuple[Loc, str]]:
        """Yield path and message of keys that the kinds of contact and actuator lack or do not have."""

        def is_missing(path: str) -> bool:
            section, key = path.split(".")
            return getattr(getattr(self, section), key, None) is None

        kinds = {
            "contact": "skin" if self.has_skin else "wheels",
            "actuator": "position" if self.has_servos else "pressure",
        }
        for section, kind in kinds.items():
            for path in filter(is_missing, _NEEDED[section, kind]):
                yield tuple(path.split(".")), f"missing; a robot with {section} {kind} needs it"
            other = section, _OTHER_KIND[kind]
            for path in _NEEDED[other] + _POSSIBLE[other]:
                if not is_missing(path):
                    key = path.split(".")[1]
                    yield tuple(path.split(".")), f"a robot with {section} {kind} has no {key}; remove it"
        for key in ("pitch_stiffness_nm_per_rad", "roll_stiffness_nm_per_rad"):
            if not self.is_spatial and is_missing(f"bending.{key}"):
                yield ("bending", key), "missing; a planar robot needs it"
        if not self.is_spatial and not is_missing("actuator.extension_m_per_kpa"):
            text = "segments of a planar robot keep their length; remove it, or give chamber.directions_deg"
            yield ("actuator", "extension_m_per_kpa"), text
        if self.is_spatial and not self.has_skin:
            text = "a robot that bends in two directions needs contact skin: its wheels would leave the floor"
            yield ("chamber", "directions_deg"), text
        if self.has_skin and self.tail is not None:
            yield ("tail",), "a robot with contact skin has no axles; remove the tail"

    def contradictions(self) -> Iterator[tuple[Loc, str]]:
        """Yield path and message of numbers that do not fit together."""
        missing = list(self._contradictions_of_kinds())
        yield from missing
        if missing:
            return
        connectors, masses = self.geometry.connectors.value, self.masses()
        key, count = ("segments", connectors - 1) if self.has_skin else ("connectors", connectors)
        if len(masses) != count:
            yield (
                ("mass", f"{key}_kg", "value"),
                f"{len(masses)} masses for {count} {key}; give {count}, or one number for all",
            )
        if self.mass.wheel_kg and 2 * (wheel := self.mass.wheel_kg.value) > WHEEL_SHARE * min(masses):
            yield (
                ("mass", "wheel_kg", "value"),
                f"two wheels of {wheel:g} kg are too much for the lightest connector, {min(masses):g} kg; "
                f"{WHEEL_SHARE * min(masses) / 2:g} kg each at most",
            )
        yield from self._implausible_units()
        if self.modules is not None:
            yield from self.modules.contradictions(connectors - 1, self._chambers)
        if self.is_spatial:
            yield from self._spatial_contradictions()
        if self.tail is not None and (com := self.tail.com_m.value) > (axle := self.tail.axle_m.value):
            text = f"{com:g} m is behind the second axle at {axle:g} m; the assembly would tip over"
            yield ("tail", "com_m", "value"), text
        yield from self._invalid_priors()
        if self.supply is None:
            return
        nominal, limit = self.supply.nominal_kpa.value, self.supply.pulsed_limit_kpa.value
        if nominal > limit:
            yield (
                ("supply", "nominal_kpa", "value"),
                f"{nominal:g} kPa is above pulsed_limit_kpa, {limit:g} kPa",
            )

    def _spatial_contradictions(self) -> Iterator[tuple[Loc, str]]:
        """Yield path and message of numbers that a spatial robot cannot have."""
        assert self.chamber is not None and self.chamber.directions_deg is not None
        ordered = np.sort(np.mod(self.chamber.directions_deg.value, 360.0))
        largest = np.diff(ordered, append=ordered[0] + 360.0).max()
        if largest > 180.0 - 1e-6:
            text = f"no chamber within {largest:g} degrees; neighbours must be less than 180 degrees apart"
            yield ("chamber", "directions_deg", "value"), text
        width, height = self.geometry.width_m.value, self.geometry.com_height_m.value
        if abs(width / (2 * height) - 1) > _ROUNDNESS:
            text = f"{width:g} m is not twice com_height_m; a spatial robot has a round section"
            yield ("geometry", "width_m", "value"), text

    def _implausible_units(self) -> Iterator[tuple[Loc, str]]:
        """Yield path and message of lengths and masses that do not fit the distance between connectors."""
        g = self.geometry
        pitch = g.segment_length_m.value + g.rigid_gap_m.value
        low, high = _LENGTH_RATIOS
        keys = ("half_track_m", "wheel_radius_m", "com_height_m", "width_m")
        values = {key: record.value for key in keys if (record := getattr(g, key)) is not None}
        wrong = {key: value for key, value in values.items() if not low * pitch <= value <= high * pitch}
        if len(wrong) > 1:  # they fit each other, so the distance between connectors is wrong
            key = max(("segment_length_m", "rigid_gap_m"), key=lambda name: getattr(g, name).value)
            wrong = {key: getattr(g, key).value}
        for key, value in wrong.items():
            factor = 1e-3 if value > pitch / 2 else 1e3
            text = f"{value:g} m does not fit the other lengths of the robot"
            yield ("geometry", key, "value"), f"{text}; did you mean {factor * value:.4g}?"
        lightest, heaviest = _DENSITIES
        for mass in set(self.masses()):
            density = mass / (pitch * g.width_m.value**2)
            if not lightest <= density <= heaviest:
                text = (
                    f"{mass:g} kg in {pitch:g} m by {g.width_m.value:g} m is a density of {density:.2g} kg/m³"
                )
                key = "segments_kg" if self.has_skin else "connectors_kg"
                yield ("mass", key, "value"), f"{text}; check the units"

    def _invalid_priors(self) -> Iterator[tuple[Loc, str]]:
        """Yield path and message of prior distributions that do not fit their numbers."""
        records = self.records()
        for path, record in records.items():
            section, key = path.split(".")
            prior, value = record.uncertain, record.value
            loc, bounds = (section, key, "uncertain"), getattr(self, section).bounds.get(key)
            if prior is None:
                continue
            if bounds is None or isinstance(value, list | int):
                yield loc, "only a single number can be uncertain, not a list or a count"
            elif prior.kind == "lognormal" and value <= 0:
                yield loc, f"lognormal needs a number above 0, not {value:g}"
            elif prior.low is not None and prior.high is not None:
                low, high = max(bounds[0], prior.low), min(bounds[1], prior.high)
                if (low, high) != (prior.low, prior.high):
                    text = (
                        f"{prior.low:g} to {prior.high:g} exceeds the allowed {bounds[0]:g} to {bounds[1]:g}"
                    )
                    yield loc, text
                elif not low <= value <= high:
                    yield loc, f"the number itself, {value:g}, is outside {low:g} to {high:g}"
        for i, pair in enumerate(self.correlated or ()):
            for k, path in enumerate(pair.of):
                if path not in records:
                    yield ("correlated", i, "of", k), str(UnknownNameError("number", path, records))


_PLAIN_KEYS = ("seed", "kind", "law")
"""Keys of sections of records whose values are no records."""


def section_units(section: str) -> dict[str, str]:
    """Return the units of the records of a section by key; an empty dict for any other name."""
    field = RobotFile.model_fields.get(section)
    types = (get_args(field.annotation) or (field.annotation,)) if field else ()
    sections = [kind for kind in types if isinstance(kind, type) and issubclass(kind, Records)]
    keys: Mapping[str, object] = sections[0].model_fields if sections else {}
    return {key: split_unit(key)[1] for key in keys if key not in _PLAIN_KEYS}


def load_robot_file(name_or_path: str | os.PathLike[str]) -> RobotFile:
    """Load and validate a robot file.

    Raises:
        InputError: the file was not found or cannot be read.
        InputFileError: the file is not valid; the message lists all problems.
    """
    return load_model(RobotFile, find_file("robot", name_or_path))


def load_robot(name_or_path: str | os.PathLike[str]) -> RobotSpec:
    """Load a robot by the name of a shipped one (gen1 to gen4, gen4_module) or the path of a robot file.

    Raises:
        InputError: the file was not found, cannot be read, or is not valid (`InputFileError`).
    """
    return load_robot_file(name_or_path).spec()


def resolve_robot(document: Document, robot: Any, *, prefix: Loc) -> RobotFile | None:
    """Return the robot of a scenario: a shipped robot, a file, an override or a full definition.

    Problems in the scenario are reported to the document; the result is None then.

    Args:
        document: document of the scenario.
        robot: a name, a path, an override (mapping with `base`), or a mapping with all parameters.
        prefix: path of `robot` in the document.

    Raises:
        InputFileError: the robot file is not valid; the message names that file.
    """
    base = robot.get("base") if isinstance(robot, Mapping) else robot
    if isinstance(robot, Mapping) and "base" not in robot:
        return validate(RobotFile, document, robot, prefix=prefix)
    base_loc = (*prefix, "base") if isinstance(robot, Mapping) else prefix
    if not isinstance(base, str):
        document.report(base_loc, "must be a robot's name, a path, or a block of keys with base")
        return None
    try:
        file = load_robot_file(base)
    except InputFileError:
        raise
    except InputError as error:
        document.report(base_loc, str(error))
        return None
    if not isinstance(robot, Mapping):
        return file
    merged = _merge_override(
        file.model_dump(), robot, lambda loc: f"{document.origin(prefix + loc)} over {base}"
    )
    return validate(RobotFile, document, merged, prefix=prefix)


def find_unit_mistakes(robot: Any) -> Iterator[tuple[Loc, str]]:
    """Yield path and suggestion for numbers of an override that differ from the base by a factor of 300."""
    if not isinstance(robot, Mapping) or not isinstance(robot.get("base"), str):
        return
    for path, record in load_robot_file(robot["base"]).records().items():
        section, key = path.split(".")
        new, old = child(child(robot, section), key), record.value
        new = child(new, "value") if isinstance(new, Mapping) else new
        if not all(isinstance(number, int | float) and number for number in (new, old)):
            continue
        if not 1 / _SUSPICIOUS_RATIO < abs(new / old) < _SUSPICIOUS_RATIO:
            ratio = new / old
            comparison = f"{ratio:.0f} times" if abs(ratio) > 1 else f"1/{1 / ratio:.0f} of"
            comparison += f" the {old:.4g} of {robot['base']}"
            factor = 1e-3 if abs(new) > abs(old) else 1e3
            yield (section, key), f"{new:g} {record.unit} is {comparison}; did you mean {factor * new:.4g}?"


def _merge_override(
    base: Mapping[str, Any], override: Mapping[str, Any], source: Callable[[Loc], str]
) -> dict[str, Any]:
    """Return the data of a base robot with the entries of an override.

    Args:
        base: data of the base robot.
        override: new records, or plain numbers that replace the value of a record.
        source: function from the path of a plain number to the source of the new record.
    """
    merged = dict(base)
    if any(isinstance(value, Mapping) for value in override.values()) and "title" not in override:
        merged["title"] = f"{base['title']}, modified"
    for name, value in override.items():
        if name == "base":
            continue
        section = base.get(name)
        if section is None and name in base and isinstance(value, Mapping):
            section = {}  # optional section that the base lacks
        if not (isinstance(section, Mapping) and isinstance(value, Mapping)):
            merged[name] = value
            continue
        units = section_units(name)
        merged[name] = dict(section)
        for key, entry in value.items():
            if key in units and not isinstance(entry, Mapping):
                entry = replace_value(section.get(key), entry, units[key], source((name, key)))
            merged[name][key] = entry
    return merged


def robot_sources(name_or_path: str | os.PathLike[str]) -> dict[str, Record[Any, Any]]:
    """Return the records of all numbers of a robot by path.

    Raises:
        InputError, InputFileError: as `load_robot_file`.
    """
    return load_robot_file(name_or_path).records()
