"""Sections of robot files, with bounds on all numbers.

The section `modules` may list properties of individual modules, and standard deviations
of random differences between modules. Each property has a separate random stream, so a
new standard deviation does not change the random numbers of other properties. Random
numbers are clipped at three standard deviations. Random factors multiply the listed
factors, and random biases are added to the listed biases.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag

from srs_twin.io.documents import Loc
from srs_twin.io.validation import StrictModel
from srs_twin.robot.friction import SkinLaw
from srs_twin.robot.sourced import Record, Records, bounded, number_field
from srs_twin.robot.spec import PER_CHAMBER, Modules, Skin

Factor = Annotated[float, bounded(0.1, 10.0)]
ChamberPair = Annotated[list[Factor], Field(min_length=2, max_length=8)]
ChamberFactors = Record[
    Annotated[list[ChamberPair], Field(min_length=1, max_length=63)], Literal["1"]
]
SegmentFactors = Record[
    Annotated[list[Factor], Field(min_length=1, max_length=63)], Literal["1"]
]
Directions = Record[
    Annotated[
        list[Annotated[float, bounded(-360.0, 360.0)]],
        Field(min_length=3, max_length=8),
    ],
    Literal["deg"],
]
BendList = Record[
    Annotated[
        list[Annotated[float, bounded(-1.0, 1.0)]], Field(min_length=1, max_length=63)
    ],
    Literal["rad"],
]
RelativeStd = Record[Annotated[float, bounded(0.0, 0.3)], Literal["1"]]
AngleStd = Record[Annotated[float, bounded(0.0, 0.5)], Literal["rad"]]

_MAX_DEVIATIONS = 3.0
"""Limit at which random numbers are clipped, in standard deviations."""

# The bounds allow robots from 1/40 to 100 times the size of the shipped robots. Lengths
# scale with the robot size s, masses with s³ and stiffnesses with s⁴.
LENGTHS_M = (1e-5, 100.0)
"""Minimum and maximum length, m."""
MASSES_KG = (1e-10, 1e6)
"""Minimum and maximum mass of a part, kg."""
STIFFNESSES_NM_PER_RAD = (1e-10, 1e9)
"""Minimum and maximum stiffness of a segment, N·m/rad."""

# Key of the standard deviation for each module property. The order determines which
# random stream a property uses, so new properties must be appended.
SPREAD_KEYS = {
    "gain": "gain_spread",
    "tau_fill": "tau_spread",
    "tau_vent": "tau_spread",
    "bias": "bias_spread_rad",
    "sensor_gain": "sensor_gain_spread",
    "sensor_bias": "sensor_bias_spread_rad",
}


class ModulesFile(Records):
    """Properties of individual modules, and random differences between modules."""

    gain: ChamberFactors | None = None
    """Ratio of each chamber's gain to the nominal gain, 0.1 to 10, as one list per
    segment, head first. Each list contains the + and the - chamber of a planar robot,
    or the chambers of a spatial robot in the order of chamber.directions_deg."""
    tau_fill: ChamberFactors | None = None
    """Ratio of each chamber's fill time constant to the nominal value, 0.1 to 10, in
    the same order as gain."""
    tau_vent: ChamberFactors | None = None
    """Ratio of each chamber's vent time constant to the nominal value, 0.1 to 10, in
    the same order as gain."""
    bias_rad: BendList | None = None
    """Rest bend of each segment, rad, -1 to 1, head first."""
    sensor_gain: SegmentFactors | None = None
    """Ratio of sensor reading to actual bend for each segment, 0.1 to 10, head first.
    """
    sensor_bias_rad: BendList | None = None
    """Sensor reading of each segment at zero bend, rad, -1 to 1, head first."""
    gain_spread: RelativeStd | None = None
    """Standard deviation of the relative chamber gains, 0 to 0.3."""
    tau_spread: RelativeStd | None = None
    """Standard deviation of the relative fill and vent time constants of the chambers,
    0 to 0.3."""
    bias_spread_rad: AngleStd | None = None
    """Standard deviation of the rest bends, rad, 0 to 0.5."""
    sensor_gain_spread: RelativeStd | None = None
    """Standard deviation of the sensor gains, 0 to 0.3."""
    sensor_bias_spread_rad: AngleStd | None = None
    """Standard deviation of the sensor biases, rad, 0 to 0.5."""
    seed: Annotated[int, bounded(0, 2**32 - 1)] | None = None
    """Random seed of the differences between modules, 0 to 4294967295 (default: seed of
    the scenario)."""

    def draw(self, segments: int, seed: int, chambers: int = 2) -> Modules:
        """Return modules with the listed properties and random differences.

        The argument `seed` is ignored if the file contains a seed.
        """
        seed = seed if self.seed is None else self.seed
        arrays = {}
        for stream, (name, std_name) in enumerate(SPREAD_KEYS.items()):
            per_chamber = name in PER_CHAMBER
            additive = name.endswith("bias")
            shape = (segments, chambers) if per_chamber else (segments,)
            listed = getattr(self, f"{name}_rad" if additive else name)
            std = getattr(self, std_name)
            if listed is None:
                base = np.full(shape, 0.0 if additive else 1.0)
            else:
                base = np.array(listed.value)
            normal = np.random.default_rng([seed, stream]).standard_normal(shape)
            drawn = (std.value if std else 0.0) * np.clip(
                normal, -_MAX_DEVIATIONS, _MAX_DEVIATIONS
            )
            if additive:
                arrays[name] = base + drawn
            else:
                arrays[name] = base * (1.0 + drawn)
        return Modules.from_arrays(**arrays)

    def contradictions(self, segments: int, chambers: int) -> Iterator[tuple[Loc, str]]:
        """Yield the path and a message for each list that has the wrong length."""
        for name, record in self:
            values = record.value if isinstance(record, Record) else None
            if name in PER_CHAMBER and isinstance(values, list):
                for j, row in enumerate(values):
                    if len(row) != chambers:
                        text = (
                            f"{len(row)} factors are given for {chambers} chambers;"
                            f" give {chambers} factors"
                        )
                        yield ("modules", name, "value", j), text
            if isinstance(values, list) and len(values) != segments:
                text = (
                    f"{len(values)} entries are given for {segments} segments; give"
                    f" {segments} entries, head first"
                )
                yield ("modules", name, "value"), text


def _mass_tag(value: object) -> str:
    if isinstance(value, list):
        return "each"
    return "all"


def _one_or_each(value: Any) -> Any:
    many = Annotated[list[value], Field(min_length=2, max_length=64)]
    return Annotated[
        Annotated[value, Tag("all")] | Annotated[many, Tag("each")],
        Discriminator(_mass_tag),
    ]


# A `Number` is a record whose value is a float, an integer or a list.
Number = Record[Any, str]


class GeometryFile(Records):
    """Dimensions of the body."""

    connectors: Number = number_field(2, 64, int)
    """Number of connectors, called "links" in the dissertation (number of segments plus
    one)."""
    segment_length_m: Number = number_field(*LENGTHS_M)
    """Length of the bending part of a segment."""
    rigid_gap_m: Number = number_field(0.0, LENGTHS_M[1])
    """Total length of the two equal, straight end pieces of a segment."""
    half_track_m: Number | None = number_field(*LENGTHS_M, needed_by="wheels")
    """Distance between a wheel and the centre line; only for robots on wheels."""
    wheel_radius_m: Number | None = number_field(*LENGTHS_M, needed_by="wheels")
    """Radius of a wheel; only for robots on wheels."""
    com_height_m: Number = number_field(*LENGTHS_M)
    """Height of the centre of mass above the floor."""
    width_m: Number = number_field(*LENGTHS_M)
    """Width of the soft body; only the motion of robots with skin depends on this
    width."""


class MassFile(Records):
    """Masses of the robot's parts."""

    connectors_kg: Number | None = number_field(
        *MASSES_KG, shape=_one_or_each, needed_by="wheels"
    )
    """Mass of a connector with its wheels and the adjacent half segments, as one number
    for all connectors or as a list, head first; only for robots on wheels."""
    wheel_kg: Number | None = number_field(*MASSES_KG, needed_by="wheels")
    """Mass of one wheel, which is part of the connector mass; only for robots on
    wheels."""
    connector_gyration_m: Number | None = number_field(*LENGTHS_M, only_for="wheels")
    """Radius of gyration of a connector without wheels (default: value of a uniform
    block as long as the rigid gap and as wide as the track); only for robots on wheels.
    """
    segments_kg: Number | None = number_field(
        *MASSES_KG, shape=_one_or_each, needed_by="skin"
    )
    """Evenly distributed mass of a segment, as one number for all segments or as a
    list, head first; only for robots with skin."""


class FrictionFile(Records):
    """Wheel friction coefficients and axial drag.

    The friction coefficients of a skin are in the section contact.
    """

    mu_t: Number | None = number_field(0.0, 10.0, needed_by="wheels")
    """Friction coefficient along the heading, due to axle drag; only for robots on
    wheels."""
    mu_n: Number | None = number_field(0.0, 10.0, needed_by="wheels")
    """Friction coefficient across the heading, for sideways slip; only for robots on
    wheels."""
    drag_n: Number | None = number_field(0.0, 1e7, optional=True)
    """Total axial drag of the tubes and the belly, which does not depend on the load
    and is divided equally among the connectors (default: none)."""


class ContactFile(Records):
    """Kind of contact with the floor."""

    only_for = {"law": "skin"}

    kind: Literal["wheels", "skin"]
    """Kind of contact, "wheels" for two wheels on each connector, or "skin" for a body
    that slides on the floor along its whole length."""
    law: SkinLaw | None = None
    """Friction law of a skin (default: ellipse). The law "ellipse" maximises the
    dissipated power, and "cosine" makes each force component proportional to a
    direction cosine of the slip velocity (docs/friction.md#skin)."""
    forward: Number | None = number_field(0.0, 10.0, needed_by="skin")
    """Friction coefficient along the body for slip towards the head; only for robots
    with skin."""
    backward: Number | None = number_field(0.0, 10.0, only_for="skin")
    """Friction coefficient along the body for slip towards the tail (default: value of
    forward); only for robots with skin."""
    transverse: Number | None = number_field(0.0, 10.0, needed_by="skin")
    """Friction coefficient across the body; only for robots with skin."""
    points_per_segment: Number | None = number_field(1, 64, int, only_for="skin")
    """Number of contact point pairs along each segment (default: 6); only for robots
    with skin."""

    @property
    def is_skin(self) -> bool:
        """Whether the robot has a skin instead of wheels."""
        return self.kind == "skin"

    def friction(self) -> dict[str, float]:
        """Return the friction coefficients of the skin as arguments of `Friction`."""
        names = {
            "mu_t": self.forward,
            "mu_back": self.backward,
            "mu_n": self.transverse,
        }
        return {
            name: record.value for name, record in names.items() if record is not None
        }

    def skin(self) -> Skin:
        """Return the skin parameters."""
        given = {
            "friction_law": self.law,
            "points": self.points_per_segment and self.points_per_segment.value,
        }
        values: dict[str, Any] = {
            name: value for name, value in given.items() if value is not None
        }
        return Skin(**values)


class BendingFile(Records):
    """Stiffness and damping of one segment."""

    only_for = {"lead": "pressure"}

    lead: bool | None = None
    """Whether the moment of a pneumatic actuator leads the pressures, so that a segment
    without load obeys Eq. 14 for any damping (default: true). If false, the damping
    delays the free bend, so damping_time_s replaces tau_mode_s, and tau_fill_s and
    tau_vent_s are shortened by damping_time_s - tau_mode_s."""
    stiffness_nm_per_rad: Number | None = number_field(
        *STIFFNESSES_NM_PER_RAD, needed_by="pressure"
    )
    """Bending stiffness; only for pneumatic actuators."""
    damping_time_s: Number | None = number_field(1e-6, 100.0, needed_by="pressure")
    """Ratio of damping to stiffness for deviations from the free bend
    (docs/planar-models.md); only for pneumatic actuators."""
    pitch_stiffness_nm_per_rad: Number | None = number_field(
        *STIFFNESSES_NM_PER_RAD, optional=True
    )
    """Stiffness against bending out of the floor plane, which planar robots must
    specify (default for spatial robots: bending stiffness)."""
    roll_stiffness_nm_per_rad: Number | None = number_field(
        *STIFFNESSES_NM_PER_RAD, optional=True
    )
    """Stiffness against twisting, which planar robots must specify (default for spatial
    robots: two thirds of the bending stiffness, because GJ = 2/3 EI for a solid,
    incompressible, round cross-section)."""
    out_of_plane_damping_time_s: Number = number_field(1e-6, 100.0)
    """Ratio of damping to stiffness for bending out of the floor plane and for
    twisting."""


class ActuatorFile(Records):
    """Response of one module, which is driven by air pressure or by a servo.

    The gain of a pneumatic module is bend_rad / at_pressure_kpa.
    """

    kind: Literal["pressure", "position"] | None = None
    """Kind of actuator, "pressure" for air chambers (default) or "position" for a
    servo. A servo turns its joint to the commanded angle regardless of the load. The
    angle is bend_rad while the valve command would fill the + chamber."""
    response_time_s: Number | None = number_field(1e-4, 100.0, needed_by="position")
    """Time constant of a servo's critically damped response; only for servos."""
    tau_fill_s: Number | None = number_field(1e-6, 100.0, needed_by="pressure")
    """Fill time constant tau_1; only for pneumatic actuators."""
    tau_vent_s: Number | None = number_field(1e-6, 100.0, needed_by="pressure")
    """Vent time constant tau_1; only for pneumatic actuators."""
    tau_mode_s: Number | None = number_field(1e-6, 100.0, needed_by="pressure")
    """Mode time constant tau_2, with which the free bend lags the chamber pressures;
    only for pneumatic actuators."""
    bend_rad: Number = number_field(1e-3, 6.3)
    """Static bend of a segment without load at the pressure at_pressure_kpa, or maximum
    commanded angle of a servo."""
    at_pressure_kpa: Number | None = number_field(0.1, 2000.0, needed_by="pressure")
    """Pressure in one chamber that causes the bend bend_rad; only for pneumatic
    actuators."""
    bend_limit_rad: Number | None = number_field(0.1, 6.3, only_for="pressure")
    """Limit of the free bend at high pressure (default: no limit, linear gain)."""
    onset_fraction: Number | None = number_field(0.0, 1.0, only_for="pressure")
    """Fraction s of the gain that is missing in a dead zone around zero pressure
    (default: 1 if a dead-zone key is present, otherwise 0)."""
    dead_zone_rad: Number | None = number_field(0.01, 6.3, only_for="pressure")
    """Bend that a linear gain would yield at the end of the dead zone (default: 0.3);
    beyond the dead zone, the bend is smaller by onset_fraction times this value."""
    dead_zone_transition_rad: Number | None = number_field(
        0.01, 6.3, only_for="pressure"
    )
    """Width of the transition at the end of the dead zone, as a bend at linear gain
    (default: 0.1)."""
    extension_m_per_kpa: Number | None = number_field(0.0, 0.01, only_for="pressure")
    """Extension of a spatial robot's segment per mean chamber pressure (default: 0)."""


class ChamberFile(Records, needed_by="pressure"):
    """Air volume of one chamber."""

    dead_volume_ml: Number = number_field(1e-6, 1e8)
    """Volume of a chamber and its tube when the segment is straight."""
    air_volume_ml: Number = number_field(1e-6, 1e8)
    """Increase in chamber volume at a bend of 90 degrees."""
    directions_deg: Directions | None = None
    """Direction in which each chamber of a spatial robot bends a segment, deg, -360 to
    360, where 0 is to the left and 90 is upwards. Without this key, the robot is
    planar, and its two chambers bend a segment to the left and to the right."""


class SupplySection(Records, needed_by="pressure"):
    """Supply pressure and pressure limits (gauge)."""

    nominal_kpa: Number = number_field(0.1, 2000.0)
    """Supply pressure of scenarios that specify no other pressure."""
    continuous_limit_kpa: Number = number_field(0.1, 2000.0)
    """Maximum pressure that a chamber may hold."""
    pulsed_limit_kpa: Number = number_field(0.1, 2000.0)
    """Maximum supply pressure if chambers are filled and vented in turn, as in a gait
    or with PWM."""


class GaitSection(Records):
    """Parameters shared by all gaits of the robot."""

    phase_step_rad: Number = number_field(-6.3, 6.3)
    """Phase lag of the gait from one segment to the next (E18)."""


class TailFile(Records):
    """Tail assembly with a second axle behind the axle of the last connector.

    The contact model `preloaded` does not support a tail.
    """

    axle_m: Number = number_field(*LENGTHS_M)
    """Distance from the axle of the last connector back to the second axle."""
    com_m: Number = number_field(0.0, LENGTHS_M[1])
    """Distance from the axle of the last connector back to the centre of mass; at most
    axle_m."""
    com_height_m: Number = number_field(*LENGTHS_M)
    """Height of the assembly's centre of mass above the floor."""
    gyration_m: Number = number_field(*LENGTHS_M)
    """Radius of gyration of the assembly including its wheels."""


class CorrelationFile(StrictModel):
    """Correlation between two uncertain numbers."""

    of: Annotated[list[str], Field(min_length=2, max_length=2)]
    """Paths of the two numbers, such as friction.mu_t. The correlation is ignored
    unless both numbers are uncertain."""
    r: Annotated[float, bounded(-0.999, 0.999)]
    """Correlation coefficient of the normal variables from which the two numbers are
    computed, -0.999 to 0.999."""
