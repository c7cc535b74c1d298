"""Immutable, validated robot parameters in SI units.

The parameters of the shipped robots come from ``calibration/robots/*.yaml``, where each
number has a source and a status. `Modules` stores the differences between the modules
of a snake (Section 5.1), such as chamber gain, rest bend and sensor drift.

Connectors are numbered i = 1…N from head to tail. Segment j lies between connectors j
and j+1. A positive bend q_j = θ_j − θ_{j+1} turns the head end to the left.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from srs_twin.compute.arrays import Array
from srs_twin.errors import InputError, check_choice
from srs_twin.robot.friction import SKIN_LAWS, SkinLaw
from srs_twin.robot.rules import (
    Violation,
    direction_violations,
    kind_violations,
    mass_violations,
    raise_violations,
    spatial_refusal,
    tail_violations,
    wheel_violations,
)
from srs_twin.robot.scale import Scale

PerChamber = tuple[tuple[float, ...], ...]

PER_CHAMBER = ("gain", "tau_fill", "tau_vent")
"""Names of the `Modules` attributes with one value per chamber."""


@dataclass(frozen=True)
class Modules:
    """Properties of the individual modules, ordered from the head.

    For a planar robot, the last axis of a chamber property is (+ chamber, − chamber).
    For a spatial robot, this axis has the order of `Chamber.directions`.

    Attributes:
        gain: gain of each chamber relative to the nominal gain, shape (segments,
            chambers).
        bias: rest bend of each segment, shape (segments,), rad.
        tau_fill: ratio of each chamber's fill time constant τ₁ to the nominal value,
            shape (segments, chambers).
        tau_vent: ratio of each chamber's vent time constant τ₁ to the nominal value,
            shape (segments, chambers).
        sensor_gain: ratio of sensor reading to actual bend, shape (segments,).
        sensor_bias: sensor reading of a straight segment, shape (segments,), rad.
    """

    gain: PerChamber
    bias: tuple[float, ...]
    tau_fill: PerChamber
    tau_vent: PerChamber
    sensor_gain: tuple[float, ...]
    sensor_bias: tuple[float, ...]

    def __post_init__(self) -> None:
        segments = len(self.gain)
        chambers = len(self.gain[0])
        for field in fields(self):
            name = field.name
            values = np.asarray(getattr(self, name), dtype=float)
            shape = (segments, chambers) if name in PER_CHAMBER else (segments,)
            low, high = (-math.pi, math.pi) if name.endswith("bias") else (0.01, 100.0)
            if values.shape != shape:
                raise InputError(
                    f"modules.{name} has shape {values.shape}, but the robot needs"
                    f" shape {shape}"
                )
            wrong = values[~((values >= low) & (values <= high))]
            if wrong.size:
                raise InputError(
                    f"modules.{name} {wrong[0]:g} is not allowed; it must be between"
                    f" {low:g} and {high:g}"
                )

    @classmethod
    def nominal(cls, segments: int, chambers: int = 2) -> Modules:
        """Return identical modules with nominal properties."""
        per_chamber = ((1.0,) * chambers,) * segments
        ones = (1.0,) * segments
        zeros = (0.0,) * segments
        return cls(per_chamber, zeros, per_chamber, per_chamber, ones, zeros)

    @classmethod
    def from_arrays(cls, **arrays: np.ndarray) -> Modules:
        """Build modules from one array per attribute."""
        tuples: dict[str, Any] = {
            field.name: _tuples(arrays[field.name]) for field in fields(cls)
        }
        return cls(**tuples)

    def array(self, name: str) -> np.ndarray:
        """Return an attribute as an array."""
        return np.array(getattr(self, name), dtype=float)


def _tuples(values: np.ndarray) -> tuple[object, ...]:
    return tuple(_tuples(row) if np.ndim(row) else float(row) for row in values)


GRAVITY = 9.81
"""Gravitational acceleration, m/s²."""


def _require(ok: bool, name: str, value: float, allowed: str) -> None:
    if not ok:
        raise InputError(f"{name}: {value!r} is not allowed; {allowed}")


def _positive(owner: object, *names: str) -> None:
    for name in names:
        value = getattr(owner, name)
        _require(0 < value < math.inf, name, value, "it must be finite and above 0")


def _not_negative(owner: object, *names: str) -> None:
    for name in names:
        value = getattr(owner, name)
        _require(0 <= value < math.inf, name, value, "it must be finite and at least 0")


@dataclass(frozen=True)
class Geometry:
    """Dimensions of the body.

    Attributes:
        connectors: number N of connectors, called "links" in the dissertation, at least
            2.
        segment_length: length l of the bending part of a segment, m.
        rigid_gap: total length L_o of the two equal, straight end pieces of a segment,
            m (Fig. 35).
        half_track: distance of each contact point from the centre line, m. For a planar
            robot with a skin of width w, this is the distance w/(2√3) of the Gauss
            points.
        wheel_radius: radius of a wheel, m. For a robot with skin, this is the radius of
            the spheres with which the twin touches the floor.
        com_height: height of a connector's centre of mass above the floor, m.
        width: width of the soft body, used in pictures and collision checks, m.
    """

    connectors: int
    segment_length: float
    rigid_gap: float
    half_track: float
    wheel_radius: float
    com_height: float
    width: float

    def __post_init__(self) -> None:
        _require(
            self.connectors >= 2,
            "connectors",
            self.connectors,
            "a snake needs 2 or more of them",
        )
        _positive(
            self, "segment_length", "half_track", "wheel_radius", "com_height", "width"
        )
        _not_negative(self, "rigid_gap")

    @property
    def segments(self) -> int:
        """Number of bending segments, N − 1."""
        return self.connectors - 1

    @property
    def pitch(self) -> float:
        """Distance l + L_o between adjacent connectors of a straight snake, m."""
        return self.segment_length + self.rigid_gap

    @property
    def body_length(self) -> float:
        """Distance between the first and the last connector of a straight snake, m."""
        return self.segments * self.pitch


@dataclass(frozen=True)
class Mass:
    """Masses of the robot's parts.

    Attributes:
        connectors: mass of each connector including its wheels, head first, shape (N,),
            kg.
        wheel: mass of one wheel (included in the connector mass), kg, or 0 for a robot
            with skin.
        connector_gyration: radius of gyration of a connector without wheels, m, or None
            for the default of `RobotSpec.connector_gyration`.
        segments: mass of each segment, head first, shape (N − 1,), kg, distributed
            evenly along the segment, or None for a robot on wheels.
    """

    connectors: tuple[float, ...]
    wheel: float
    connector_gyration: float | None = None
    segments: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        _not_negative(self, "wheel")
        if self.connector_gyration is not None:
            _positive(self, "connector_gyration")
        for i, mass in enumerate(self.connectors, start=1):
            _require(
                0 < mass < math.inf,
                f"mass of connector {i}",
                mass,
                "it must be above 0",
            )
        raise_violations(wheel_violations(self.wheel, self.connectors))

    @classmethod
    def along_body(cls, segments: tuple[float, ...]) -> Mass:
        """Return the masses of a robot with skin from the segment masses (kg).

        Each connector gets half of the mass of each adjacent segment.
        """
        halves = (0.0, *segments), (*segments, 0.0)
        connectors = tuple(
            (front + rear) / 2 for front, rear in zip(*halves, strict=True)
        )
        return cls(connectors, wheel=0.0, segments=segments)

    @property
    def total(self) -> float:
        """Mass of the whole snake, kg."""
        return sum(self.connectors)

    def array(self) -> np.ndarray:
        """Return the connector masses as an array, shape (N,), kg."""
        return np.array(self.connectors)


@dataclass(frozen=True)
class Friction:
    """Friction coefficients of wheels (Eq. 17) or of a skin, and axial drag.

    Attributes:
        mu_t: friction coefficient along the heading, which represents the axle drag of
            wheels or applies to a skin that slips towards the head.
        mu_n: friction coefficient across the heading.
        drag: total axial drag of the tubes and the belly, N. The drag opposes axial
            motion, does not depend on the load and is divided equally among the
            connectors.
        mu_back: friction coefficient of a skin for slip towards the tail, by default
            equal to `mu_t`.
    """

    mu_t: float
    mu_n: float
    drag: float = 0.0
    mu_back: float | None = None

    def __post_init__(self) -> None:
        _not_negative(self, "mu_t", "mu_n", "drag")
        if self.mu_back is not None:
            _not_negative(self, "mu_back")

    @property
    def backward(self) -> float:
        """Friction coefficient along the heading for slip towards the tail."""
        return self.mu_t if self.mu_back is None else self.mu_back


@dataclass(frozen=True)
class Skin:
    """Contact of a body without wheels that lies on the floor along its whole length.

    Attributes:
        friction_law: friction law, "ellipse" or "cosine" (see `robot.friction`).
        points: number of contact point pairs along a segment.
    """

    friction_law: SkinLaw = "ellipse"
    points: int = 6

    def __post_init__(self) -> None:
        check_choice("friction law of a skin", self.friction_law, SKIN_LAWS)
        _require(self.points >= 1, "points", self.points, "a segment needs 1 or more")


@dataclass(frozen=True)
class Bending:
    """Stiffness and damping of a segment in the twin and in the `compliant` model.

    Attributes:
        stiffness: bending stiffness k about the z axis, N·m/rad.
        damping_time: ratio c/k of damping to stiffness for deviations from the free
            bend, s. The loss factor of the material at frequency f is 2π f c/k.
        pitch_stiffness: stiffness against bending out of the floor plane, N·m/rad.
        roll_stiffness: stiffness against twisting, N·m/rad.
        out_of_plane_damping_time: ratio of damping to stiffness for bending out of the
            floor plane and twisting, s.
    """

    stiffness: float
    damping_time: float
    pitch_stiffness: float
    roll_stiffness: float
    out_of_plane_damping_time: float

    def __post_init__(self) -> None:
        _positive(
            self, "stiffness", "damping_time", "pitch_stiffness", "roll_stiffness"
        )
        _positive(self, "out_of_plane_damping_time")

    @property
    def damping(self) -> float:
        """Bending damping c, N·m·s/rad."""
        return self.stiffness * self.damping_time

    def moment(self, deviation: Array, rate: Array) -> Array:
        """Return the moment k (q_f − q) + c (q̇_f − q̇) of each segment, N·m.

        Args:
            deviation: difference q_f − q between free bend and bend, rad.
            rate: time derivative of the deviation, rad/s.
        """
        return self.stiffness * deviation + self.damping * rate


@dataclass(frozen=True)
class Actuator:
    """Pneumatic response of one module (Eqs. 14 to 16 with the corrections E1 and E2).

    Attributes:
        tau_fill: fill time constant τ₁, s.
        tau_vent: vent time constant τ₁, s.
        tau_mode: mode time constant τ₂, with which the free bend lags the chamber
            pressures, s.
        gain: ratio C₀ of free bend to chamber pressure, rad/Pa.
        bend_limit: limit q_m of the free bend at high pressure, rad, infinite for a
            linear gain.
        onset_fraction: fraction s of the gain that is missing in the dead zone around
            zero pressure.
        dead_zone: free bend d that a linear gain would yield at the end of the dead
            zone, rad.
        dead_zone_transition: width w of the transition at the end of the dead zone, as
            a bend at linear gain, rad.
        extension: extension e of a spatial robot's segment per mean chamber pressure,
            m/Pa.
    """

    tau_fill: float
    tau_vent: float
    tau_mode: float
    gain: float
    bend_limit: float = math.inf
    onset_fraction: float = 0.0
    dead_zone: float = 0.3
    dead_zone_transition: float = 0.1
    extension: float = 0.0

    def __post_init__(self) -> None:
        _positive(
            self,
            "tau_fill",
            "tau_vent",
            "tau_mode",
            "gain",
            "dead_zone",
            "dead_zone_transition",
        )
        _require(
            0 <= self.onset_fraction <= 1,
            "onset_fraction",
            self.onset_fraction,
            "it must be between 0 and 1",
        )
        _require(
            self.bend_limit > 0, "bend_limit", self.bend_limit, "it must be above 0"
        )
        _not_negative(self, "extension")


@dataclass(frozen=True)
class Chamber:
    """Air volume of one chamber of a segment.

    The volume of a chamber is V(q) = dead_volume + displacement · max(0, ± q).

    Attributes:
        dead_volume: volume of the chamber and its tube when the segment is straight,
            m³.
        displacement: derivative of the volume with respect to a bend in the direction
            of the chamber, m³/rad.
        directions: direction in which each chamber of a spatial robot bends the
            segment, rad, where 0 is to the left and π/2 is upwards, or None for a
            planar robot with a left and a right chamber.
    """

    dead_volume: float
    displacement: float
    directions: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        _positive(self, "dead_volume", "displacement")
        if self.directions is not None:
            directions = tuple(map(math.degrees, self.directions))
            raise_violations(direction_violations(directions))

    @property
    def axes(self) -> np.ndarray:
        """Left and upward components of the chamber directions, shape (chambers, 2)."""
        directions = self.directions or (0.0, math.pi)
        vectors = np.stack([np.cos(directions), np.sin(directions)], axis=-1)
        axes: np.ndarray = np.round(vectors, 15)
        return axes


@dataclass(frozen=True)
class Supply:
    """Supply pressure and pressure limits (gauge).

    Attributes:
        nominal: default supply pressure, Pa.
        continuous_limit: maximum pressure that a chamber may hold, Pa.
        pulsed_limit: maximum supply pressure if chambers are filled and vented in turn,
            as in a gait or with PWM, Pa.
        limit_source: source of the limits, cited in error messages.
    """

    nominal: float
    continuous_limit: float
    pulsed_limit: float
    limit_source: str

    def __post_init__(self) -> None:
        _positive(self, "nominal", "continuous_limit", "pulsed_limit")


@dataclass(frozen=True)
class Tail:
    """Tail assembly with a second axle behind the axle of the last connector.

    Attributes:
        axle: distance from the axle of the last connector back to the second axle, m.
        com: distance from the axle of the last connector back to the centre of mass, m,
            at most `axle`.
        com_height: height of the assembly's centre of mass above the floor, m.
        gyration: radius of gyration of the assembly including its wheels, m.
    """

    axle: float
    com: float
    com_height: float
    gyration: float

    def __post_init__(self) -> None:
        _positive(self, "axle", "com_height", "gyration")
        _not_negative(self, "com")
        raise_violations(tail_violations(self.com, self.axle))


class Axle(NamedTuple):
    """Axle with two wheels.

    Attributes:
        connector: number of the connector on the axle, counted from 1 at the head.
        behind: distance of the axle behind the centre of the connector, m.
        mass: mass carried by the axle at rest on a level floor, kg.
    """

    connector: int
    behind: float
    mass: float


@dataclass(frozen=True)
class RobotSpec:
    """Parameters of one snake robot.

    Attributes:
        name: short name of the robot and of its MJCF model.
        title: one-line description of the robot.
        geometry: dimensions and number of connectors.
        mass: masses of the robot's parts.
        friction: friction on the floor.
        bending: stiffness and damping of a segment.
        actuator: response of a module to its valves.
        chamber: air volume of a chamber.
        supply: supply pressure and pressure limits.
        phase_step: phase lag β of the gait from one segment to the next, rad (E18).
        variation: properties of the individual modules, or None if all modules are
            nominal.
        tail: tail assembly, or None if the robot has none.
        skin: contact of a body without wheels, or None for a robot on wheels.
    """

    name: str
    title: str
    geometry: Geometry
    mass: Mass
    friction: Friction
    bending: Bending
    actuator: Actuator
    chamber: Chamber
    supply: Supply
    phase_step: float
    variation: Modules | None = None
    tail: Tail | None = None
    skin: Skin | None = None

    def __post_init__(self) -> None:
        raise_violations(self._violations())
        _require(
            math.isfinite(self.phase_step),
            "phase_step",
            self.phase_step,
            "it must be finite",
        )

    def _violations(self) -> Iterator[Violation]:
        connectors = self.geometry.connectors
        yield from mass_violations(self.mass.connectors, connectors, "connectors")
        if self.mass.segments is not None:
            yield from mass_violations(self.mass.segments, self.segments, "segments")
        yield from kind_violations(
            is_spatial=self.is_spatial,
            has_skin=self.skin is not None,
            has_tail=self.tail is not None,
            extends=self.actuator.extension > 0.0,
        )
        if (self.skin is None) != (self.mass.segments is None):
            yield Violation(
                "mass",
                "a robot has either a skin and segment masses, or wheels and connector"
                " masses; do not mix them",
            )
        if self.variation is not None:
            shape = len(self.variation.gain), len(self.variation.gain[0])
            if shape != (self.segments, self.chambers):
                yield Violation(
                    "modules",
                    f"the variation has {shape[0]} segments with {shape[1]} chambers,"
                    f" but the robot has {self.segments} segments with"
                    f" {self.chambers} chambers",
                )

    @property
    def segments(self) -> int:
        """Number of bending segments, N − 1."""
        return self.geometry.segments

    @property
    def is_spatial(self) -> bool:
        """Whether the segments bend vertically as well as horizontally."""
        return self.chamber.directions is not None

    @property
    def chambers(self) -> int:
        """Number of chambers of a segment."""
        directions = self.chamber.directions
        return 2 if directions is None else len(directions)

    @property
    def axial_stiffness(self) -> float:
        """Axial stiffness of a segment of a spatial robot, N/m.

        A solid round cross-section of radius r has A / I = 4 / r², so the axial
        stiffness is E A / l = (E I / l) · 4 / r².
        """
        return 4 * self.bending.stiffness / self.geometry.com_height**2

    def require_planar(self, feature: str) -> None:
        """Check that the robot is planar.

        Args:
            feature: name of the feature that requires a planar robot, used in the
                message.

        Raises:
            InputError: the robot is spatial.
        """
        if self.is_spatial:
            raise InputError(spatial_refusal(self.name, feature))

    @cached_property
    def modules(self) -> Modules:
        """Properties of the individual modules."""
        return self.variation or Modules.nominal(self.segments, self.chambers)

    @cached_property
    def scale(self) -> Scale:
        """Units of the numerical settings, which depend on the robot's size."""
        return Scale.of_pitch(self.geometry.pitch)

    def connector_weights(self, behind_head: np.ndarray) -> np.ndarray:
        """Return interpolation weights of the connectors at points along the body.

        A connector's weight decreases linearly from 1 at the connector to 0 at the
        neighbouring connectors.

        Args:
            behind_head: distance of each point behind the first connector of the
                straight body, shape (points,), m.

        Returns:
            Weights, shape (N, points), dimensionless.
        """
        stations = behind_head / self.geometry.pitch
        distance = np.abs(np.arange(self.geometry.connectors)[:, None] - stations)
        weights: np.ndarray = np.maximum(1 - distance, 0.0)
        return weights

    @cached_property
    def axles(self) -> tuple[Axle, ...]:
        """Axles of a robot on wheels, head first."""
        axles = [
            Axle(i, 0.0, mass) for i, mass in enumerate(self.mass.connectors, start=1)
        ]
        if self.tail is not None:
            # By the lever rule, the mass on an axle is proportional to the distance
            # from the centre of mass to the other axle.
            last = axles.pop()
            fraction = self.tail.com / self.tail.axle
            axles.append(last._replace(mass=(1 - fraction) * last.mass))
            axles.append(
                last._replace(mass=fraction * last.mass, behind=self.tail.axle)
            )
        return tuple(axles)

    @property
    def connector_gyration(self) -> float:
        """Radius of gyration of a connector without wheels, m.

        The default is the value √((L_o² + (2 w)²)/12) of a uniform block as long as the
        rigid gap L_o and as wide as the track 2 w.
        """
        if self.mass.connector_gyration is not None:
            return self.mass.connector_gyration
        g = self.geometry
        return math.hypot(g.rigid_gap, 2 * g.half_track) / math.sqrt(12)

    def yaw_inertia(self) -> np.ndarray:
        """Return the yaw inertia of each connector with wheels, shape (N,), kg·m²."""
        wheel = self.mass.wheel
        g = self.geometry
        # The yaw inertia of a wheel is m r²/4, as for a thin disc about a diameter,
        # plus the parallel-axis term due to the half track.
        wheels = 2 * wheel * (g.half_track**2 + g.wheel_radius**2 / 4)
        inertia: np.ndarray = (
            self.mass.array() - 2 * wheel
        ) * self.connector_gyration**2 + wheels
        return inertia
