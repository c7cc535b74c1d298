"""Sections of robot files, with bounds on all numbers.

A file may list individual module properties, and standard deviations of random
differences between modules. Each quantity has a separate random stream, so that adding
a standard deviation does not change the random numbers of other quantities. Random
numbers are truncated at three standard deviations. Random factors multiply the listed
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
"""Truncation limit of the random numbers, in standard deviations."""

# The bounds allow robots from 1/40 to 100 times the size s of the shipped robots, where
# lengths scale with s, masses with s³ and stiffnesses with s⁴.
LENGTHS_M = (1e-5, 100.0)
"""Minimum and maximum of all lengths, m."""
MASSES_KG = (1e-10, 1e6)
"""Minimum and maximum mass of a part, kg."""
STIFFNESSES_NM_PER_RAD = (1e-10, 1e9)
"""Minimum and maximum stiffness of a segment, N·m/rad."""

# Key of the standard deviation of each quantity. The order determines which random
# stream a quantity uses, so new quantities must be appended.
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
    """Gain relative to the nominal gain, 0.1 to 10 for each chamber of each segment,
    head first; + before -, or in the order of chamber.directions_deg."""
    tau_fill: ChamberFactors | None = None
    """tau_fill relative to the nominal value, 0.1 to 10 for the + and - chamber of each
    segment, head first."""
    tau_vent: ChamberFactors | None = None
    """tau_vent relative to the nominal value, 0.1 to 10 for the + and - chamber of each
    segment, head first."""
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
    """Standard deviation of the relative tau_fill and tau_vent of the chambers, 0 to
    0.3."""
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

        `seed` is used if the file contains no seed.
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
        """Yield lists whose length differs from the number of segments or chambers."""
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
    """Number of connectors N ("links" in the dissertation); one more than segments."""
    segment_length_m: Number = number_field(*LENGTHS_M)
    """Length of the bending part of a segment."""
    rigid_gap_m: Number = number_field(0.0, LENGTHS_M[1])
    """Length of the straight part of a segment; half of this length is at each end."""
    half_track_m: Number | None = number_field(*LENGTHS_M, needed_by="wheels")
    """Distance between a wheel and the centre line; wheels only."""
    wheel_radius_m: Number | None = number_field(*LENGTHS_M, needed_by="wheels")
    """Radius of a wheel; wheels only."""
    com_height_m: Number = number_field(*LENGTHS_M)
    """Height of the centre of mass above the floor."""
    width_m: Number = number_field(*LENGTHS_M)
    """Width of the soft body; it affects the motion only if the robot has a skin."""


class MassFile(Records):
    """Masses of the robot's parts."""

    connectors_kg: Number | None = number_field(
        *MASSES_KG, shape=_one_or_each, needed_by="wheels"
    )
    """Mass of a connector including the wheels and the adjacent half segments; one
    number for all connectors or a list, head first. Wheels only."""
    wheel_kg: Number | None = number_field(*MASSES_KG, needed_by="wheels")
    """Mass of one wheel, which is included in the connector mass; wheels only."""
    connector_gyration_m: Number | None = number_field(*LENGTHS_M, only_for="wheels")
    """Radius of gyration of a connector without wheels; wheels only. By default, the
    connector is a uniform block as long as the rigid gap and as wide as the track."""
    segments_kg: Number | None = number_field(
        *MASSES_KG, shape=_one_or_each, needed_by="skin"
    )
    """Mass of a segment, distributed evenly between two connectors; one number for all
    segments or a list, head first. Skin only."""


class FrictionFile(Records):
    """Friction of the wheels on the floor, and axial drag.

    The friction coefficients of a skin belong to the section contact.
    """

    mu_t: Number | None = number_field(0.0, 10.0, needed_by="wheels")
    """Friction coefficient along the heading, due to axle drag; wheels only."""
    mu_n: Number | None = number_field(0.0, 10.0, needed_by="wheels")
    """Friction coefficient across the heading, for sideways slip; wheels only."""
    drag_n: Number | None = number_field(0.0, 1e7, optional=True)
    """Total axial drag of tubes and belly (default: none); the drag does not depend on
    the load and is divided equally among the connectors."""


class ContactFile(Records):
    """Kind of contact with the floor."""

    only_for = {"law": "skin"}

    kind: Literal["wheels", "skin"]
    """Kind of contact; "wheels" means two wheels on each connector, whose parameters
    are in geometry, mass and friction. "skin" means that the whole body slides on the
    floor."""
    law: SkinLaw | None = None
    """Friction law of a skin; "ellipse" maximises the dissipation (default). "cosine"
    makes each force component proportional to the direction cosine of the slip
    (docs/friction.md#skin)."""
    forward: Number | None = number_field(0.0, 10.0, needed_by="skin")
    """Friction coefficient along the body for slip towards the head; skin only."""
    backward: Number | None = number_field(0.0, 10.0, only_for="skin")
    """Friction coefficient along the body for slip towards the tail (default: forward);
    skin only."""
    transverse: Number | None = number_field(0.0, 10.0, needed_by="skin")
    """Friction coefficient across the body; skin only."""
    points_per_segment: Number | None = number_field(1, 64, int, only_for="skin")
    """Number of contact points along each segment (default: 6); skin only."""

    @property
    def is_skin(self) -> bool:
        """Whether the robot has a skin instead of wheels."""
        return self.kind == "skin"

    def friction(self) -> dict[str, float]:
        """Return the skin's friction coefficients as arguments of `Friction`."""
        names = {
            "mu_t": self.forward,
            "mu_back": self.backward,
            "mu_n": self.transverse,
        }
        return {
            name: record.value for name, record in names.items() if record is not None
        }

    def skin(self) -> Skin:
        """Build the skin."""
        given = {
            "friction_law": self.law,
            "points": self.points_per_segment and self.points_per_segment.value,
        }
        values: dict[str, Any] = {
            name: value for name, value in given.items() if value is not None
        }
        return Skin(**values)


class BendingFile(Records):
    """Compliance of one segment."""

    only_for = {"lead": "pressure"}

    lead: bool | None = None
    """Whether the air moment leads the pressures, so that a free segment obeys Eq. 14
    for any damping (default: true); pressure only. If false, the damping delays the
    free bend: damping_time_s replaces tau_mode_s. tau_fill_s and tau_vent_s are then
    shortened by damping_time_s - tau_mode_s."""
    stiffness_nm_per_rad: Number | None = number_field(
        *STIFFNESSES_NM_PER_RAD, needed_by="pressure"
    )
    """Bending stiffness; pressure only."""
    damping_time_s: Number | None = number_field(1e-6, 100.0, needed_by="pressure")
    """Ratio of damping to stiffness for deviations from the free bend
    (docs/planar-models.md); pressure only."""
    pitch_stiffness_nm_per_rad: Number | None = number_field(
        *STIFFNESSES_NM_PER_RAD, optional=True
    )
    """Stiffness against bending out of the floor plane; optional for a spatial robot,
    where the default is the bending stiffness."""
    roll_stiffness_nm_per_rad: Number | None = number_field(
        *STIFFNESSES_NM_PER_RAD, optional=True
    )
    """Stiffness against twisting; optional for a spatial robot. The default is two
    thirds of the bending stiffness, because GJ = 2/3 EI for a solid, incompressible,
    round cross-section."""
    out_of_plane_damping_time_s: Number = number_field(1e-6, 100.0)
    """Ratio of damping to stiffness for pitch and roll."""


class ActuatorFile(Records):
    """Response of one module, driven by air pressure or by a servo.

    The gain of a pneumatic module is bend_rad / at_pressure_kpa.
    """

    kind: Literal["pressure", "position"] | None = None
    """Kind of actuator; "pressure" means that air in chambers bends the segment against
    the bending stiffness (default). "position" means that a servo turns a joint to the
    commanded angle regardless of the load. The commanded angle is bend_rad when a valve
    would fill the + chamber."""
    response_time_s: Number | None = number_field(1e-4, 100.0, needed_by="position")
    """Time constant of a servo's critically damped response; position only."""
    tau_fill_s: Number | None = number_field(1e-6, 100.0, needed_by="pressure")
    """Fill time constant tau_1; pressure only."""
    tau_vent_s: Number | None = number_field(1e-6, 100.0, needed_by="pressure")
    """Vent time constant tau_1; pressure only."""
    tau_mode_s: Number | None = number_field(1e-6, 100.0, needed_by="pressure")
    """Mode time constant tau_2 of the free bend's response to the pressures; pressure
    only."""
    bend_rad: Number = number_field(1e-3, 6.3)
    """Static bend of a free module at at_pressure_kpa, or maximum commanded angle of a
    servo."""
    at_pressure_kpa: Number | None = number_field(0.1, 2000.0, needed_by="pressure")
    """Pressure in one chamber that causes bend_rad; pressure only."""
    bend_limit_rad: Number | None = number_field(0.1, 6.3, only_for="pressure")
    """Limit of the free bend at high pressure (default: no limit, linear gain)."""
    onset_fraction: Number | None = number_field(0.0, 1.0, only_for="pressure")
    """Fraction s of the gain that is missing in a dead zone around zero pressure
    (default: 1 if another onset key is present, otherwise 0)."""
    dead_zone_rad: Number | None = number_field(0.01, 6.3, only_for="pressure")
    """Bend at the end of the dead zone according to the linear law (default: 0.3);
    beyond the dead zone, s times this bend is missing."""
    dead_zone_transition_rad: Number | None = number_field(
        0.01, 6.3, only_for="pressure"
    )
    """Width of the transition at the end of the dead zone, in terms of the linear law's
    bend (default: 0.1)."""
    extension_m_per_kpa: Number | None = number_field(0.0, 0.01, only_for="pressure")
    """Extension of a spatial robot's segment per mean chamber pressure (default: 0)."""


class ChamberFile(Records, needed_by="pressure"):
    """Air volume of one chamber."""

    dead_volume_ml: Number = number_field(1e-6, 1e8)
    """Volume of a chamber and its tube when the segment is straight."""
    air_volume_ml: Number = number_field(1e-6, 1e8)
    """Increase of the chamber volume at a bend of 90 degrees."""
    directions_deg: Directions | None = None
    """Directions in which the chambers of a spatial robot bend a segment, -360 to 360,
    0 to the left and 90 upwards; four directions form two antagonistic pairs. By
    default, one chamber bends the segment to the left and one to the right."""


class SupplySection(Records, needed_by="pressure"):
    """Supply pressures (gauge) and limits."""

    nominal_kpa: Number = number_field(0.1, 2000.0)
    """Supply pressure of scenarios that do not specify one."""
    continuous_limit_kpa: Number = number_field(0.1, 2000.0)
    """Maximum pressure that a chamber may hold."""
    pulsed_limit_kpa: Number = number_field(0.1, 2000.0)
    """Maximum supply pressure if the chambers are filled and vented in turn (gait, PWM).
    """


class GaitSection(Records):
    """Parameters shared by all gaits of the robot."""

    phase_step_rad: Number = number_field(-6.3, 6.3)
    """Phase lag of the gait from one segment to the next (E18)."""


class TailFile(Records):
    """Tail assembly with a second axle behind the axle of the last connector.

    The preloaded contact does not support a tail.
    """

    axle_m: Number = number_field(*LENGTHS_M)
    """Distance of the second axle behind the axle of the last connector."""
    com_m: Number = number_field(0.0, LENGTHS_M[1])
    """Distance of the centre of mass behind the axle of the last connector; this
    distance is at most axle_m."""
    com_height_m: Number = number_field(*LENGTHS_M)
    """Height of the centre of mass of the assembly above the floor."""
    gyration_m: Number = number_field(*LENGTHS_M)
    """Radius of gyration of the assembly including the wheels."""


class CorrelationFile(StrictModel):
    """Correlation between two uncertain numbers."""

    of: Annotated[list[str], Field(min_length=2, max_length=2)]
    """Paths of the two numbers, such as friction.mu_t; the correlation is ignored unless
    both numbers are uncertain."""
    r: Annotated[float, bounded(-0.999, 0.999)]
    """Correlation between the normal variables from which the numbers are computed,
    -0.999 to 0.999."""
