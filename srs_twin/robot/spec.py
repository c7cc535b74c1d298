"""RobotSpec: everything a plant needs to know of one snake, frozen, SI, validated.

Modules: by how much each module of a snake departs from the nominal one (Section 5.1).

No two are cast alike: air pressure bends one chamber further than another, a body at rest is not quite
straight, air flows faster here than there, a sensor has drifted since its calibration.

Numbers come from ``calibration/robots/*.yaml``, where each carries its source and status; here they are
plain floats. Signs and frames: connectors i = 1…N from head to tail, segment j between connectors j and
j+1, bend q_j = θ_j − θ_{j+1} > 0 turns the head end to the left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from srs_twin.errors import InputError

PerChamber = tuple[tuple[float, float], ...]

PER_CHAMBER = ("gain", "tau_fill", "tau_vent")
"""What each chamber of a module has of its own."""


@dataclass(frozen=True)
class Modules:
    """What is each module's own, segments head first, + chamber before −.

    Attributes:
        gain: bend over pressure of each chamber as a multiple of the actuator's, shape (segments, 2).
        bias: bend of each free segment without pressure, shape (segments,), rad.
        tau_fill: τ₁ of filling as a multiple of the actuator's, shape (segments, 2).
        tau_vent: τ₁ of venting as a multiple of the actuator's, shape (segments, 2).
        sensor_gain: sensed over actual bend, shape (segments,).
        sensor_bias: what a straight segment's sensor says, shape (segments,), rad.
    """

    gain: PerChamber
    bias: tuple[float, ...]
    tau_fill: PerChamber
    tau_vent: PerChamber
    sensor_gain: tuple[float, ...]
    sensor_bias: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in (each.name for each in fields(self)):
            values = np.asarray(getattr(self, name), dtype=float)
            shape = (len(self.gain), 2) if name in PER_CHAMBER else (len(self.gain),)
            low, high = (-math.pi, math.pi) if name.endswith("bias") else (0.01, 100.0)
            if values.shape != shape:
                raise InputError(f"modules.{name} has shape {values.shape}; allowed: {shape}")
            if not ((values >= low) & (values <= high)).all():
                wrong = values[~((values >= low) & (values <= high))][0]
                raise InputError(f"modules.{name} {wrong:g} is not allowed; it must be {low:g} to {high:g}")

    @classmethod
    def alike(cls, segments: int) -> Modules:
        """Return modules that are all nominal."""
        both, ones, none = ((1.0, 1.0),) * segments, (1.0,) * segments, (0.0,) * segments
        return cls(both, none, both, both, ones, none)

    @classmethod
    def of(cls, **arrays: np.ndarray) -> Modules:
        """Return modules from arrays of the attributes' shapes."""
        tuples: dict[str, Any] = {each.name: _tuples(arrays[each.name]) for each in fields(cls)}
        return cls(**tuples)

    def array(self, name: str) -> np.ndarray:
        """Return an attribute as an array."""
        return np.array(getattr(self, name), dtype=float)


def _tuples(values: np.ndarray) -> tuple[Any, ...]:
    return tuple(_tuples(row) if np.ndim(row) else float(row) for row in values)


GRAVITY = 9.81
"""m/s²; loads of the friction laws and weight in MuJoCo alike."""


def _require(ok: bool, name: str, value: float, allowed: str) -> None:
    if not ok:
        raise InputError(f"{name}: {value!r} is not allowed; {allowed}")


def _positive(owner: object, *names: str) -> None:
    for name in names:
        value = getattr(owner, name)
        _require(math.isfinite(value) and value > 0, name, value, "it must be finite and above 0")


def _not_negative(owner: object, *names: str) -> None:
    for name in names:
        value = getattr(owner, name)
        _require(math.isfinite(value) and value >= 0, name, value, "it must be finite and 0 or more")


@dataclass(frozen=True)
class Geometry:
    """Lengths of the body.

    Attributes:
        connectors: N, number of connectors (the text's links), 2 or more.
        segment_length: l, the pressurised part of a segment, which bends, m.
        rigid_gap: L_o, the part of a segment that stays straight, half of it at each end, m (Fig. 35).
        half_track: distance of each wheel's contact from the connector's centre line, m.
        wheel_radius: m.
        com_height: height of a connector's centre of mass above the floor, m.
        width: width of the soft body, m (drawn and swept, no effect on the motion).
    """

    connectors: int
    segment_length: float
    rigid_gap: float
    half_track: float
    wheel_radius: float
    com_height: float
    width: float

    def __post_init__(self) -> None:
        _require(self.connectors >= 2, "connectors", self.connectors, "a snake has 2 or more")
        _positive(self, "segment_length", "half_track", "wheel_radius", "com_height", "width")
        _not_negative(self, "rigid_gap")

    @property
    def segments(self) -> int:
        """Number of bending segments, N − 1."""
        return self.connectors - 1

    @property
    def pitch(self) -> float:
        """Length of a straight segment with its gap, l + L_o, m."""
        return self.segment_length + self.rigid_gap

    @property
    def body_length(self) -> float:
        """Distance from head to tail of the straight snake, gaps included, m."""
        return self.segments * self.pitch


WHEEL_SHARE = 0.9
"""Most of a connector's mass that its two wheels may make up."""


@dataclass(frozen=True)
class Mass:
    """Masses.

    Attributes:
        connectors: mass at each connector with its wheels, head first, shape (N,), kg.
        wheel: mass of one wheel, part of its connector's mass, kg.
        connector_gyration: radius of gyration of a connector without its wheels, m; None: derived, see
            `RobotSpec.connector_gyration`.
    """

    connectors: tuple[float, ...]
    wheel: float
    connector_gyration: float | None = None

    def __post_init__(self) -> None:
        _positive(self, "wheel", *(["connector_gyration"] if self.connector_gyration is not None else []))
        for i, mass in enumerate(self.connectors, start=1):
            _require(math.isfinite(mass) and mass > 0, f"mass of connector {i}", mass, "it must be above 0")
            heaviest = WHEEL_SHARE * mass / 2
            _require(self.wheel <= heaviest, "wheel", self.wheel, f"it must weigh at most {heaviest:g} kg")

    @property
    def total(self) -> float:
        """Mass of the whole snake, kg."""
        return sum(self.connectors)

    def array(self) -> np.ndarray:
        """Connector masses as an array, shape (N,), kg."""
        return np.array(self.connectors)


@dataclass(frozen=True)
class Friction:
    """Coulomb coefficients of a connector's wheels on the floor (Eq. 17).

    Attributes:
        mu_t: along the heading (axle drag of a rolling wheel).
        mu_n: across it (a wheel that slides sideways).
        drag: of tubes and belly, against the motion of the connectors along their headings, whatever their
            loads; connectors share it equally, N.
    """

    mu_t: float
    mu_n: float
    drag: float = 0.0

    def __post_init__(self) -> None:
        _not_negative(self, "mu_t", "mu_n", "drag")


@dataclass(frozen=True)
class Bending:
    """Compliance of one segment. Only dynamic bends (twin, `compliant`) feel it.

    Attributes:
        stiffness: k, bending stiffness about z, N·m/rad.
        damping_time: c/k, s. With τ₂ of the actuator here, a free module obeys Eq. 14 exactly.
        pitch_stiffness: stiffness against bending out of the floor plane, N·m/rad.
        roll_stiffness: stiffness against twisting, N·m/rad.
        out_of_plane_damping_time: damping over stiffness of pitch and roll, s.
    """

    stiffness: float
    damping_time: float
    pitch_stiffness: float
    roll_stiffness: float
    out_of_plane_damping_time: float

    def __post_init__(self) -> None:
        _positive(self, "stiffness", "damping_time", "pitch_stiffness", "roll_stiffness")
        _positive(self, "out_of_plane_damping_time")

    @property
    def damping(self) -> float:
        """Bending damping c, N·m·s/rad."""
        return self.stiffness * self.damping_time


@dataclass(frozen=True)
class Actuator:
    """Pneumatic response of one module (Eq. 14–16 as corrected by E1 and E2).

    Attributes:
        tau_fill: τ₁ of a filling chamber, s.
        tau_vent: τ₁ of a venting chamber, s.
        tau_mode: τ₂, valve and fast mechanical mode, s.
        gain: free bend per differential chamber pressure, rad/Pa (C₀ over the pressure that gave it).
        bend_limit: q_m, bend that no pressure exceeds, rad; infinite where there is none.
        onset_share: s, share of the slope that is missing in the dead zone about no pressure; 0: none.
        onset: d, linear bend up to which that zone reaches, rad.
        onset_width: w, linear bend over which it ends, rad.
    """

    tau_fill: float
    tau_vent: float
    tau_mode: float
    gain: float
    bend_limit: float = math.inf
    onset_share: float = 0.0
    onset: float = 0.3
    onset_width: float = 0.1

    def __post_init__(self) -> None:
        _positive(self, "tau_fill", "tau_vent", "tau_mode", "gain", "onset", "onset_width")
        _require(0 <= self.onset_share <= 1, "onset_share", self.onset_share, "it must be 0 to 1")
        _require(self.bend_limit > 0, "bend_limit", self.bend_limit, "it must be above 0")


@dataclass(frozen=True)
class Chamber:
    """Air space of one chamber of a segment: V(q) = dead_volume + displacement · max(0, ± q).

    Attributes:
        dead_volume: of a straight segment's chamber with its tube, m³; it never gets smaller.
        displacement: growth per angle by which the segment bends the chamber's own way, m³/rad.
    """

    dead_volume: float
    displacement: float

    def __post_init__(self) -> None:
        _positive(self, "dead_volume", "displacement")


@dataclass(frozen=True)
class Supply:
    """Pressures, gauge.

    Attributes:
        nominal: what a scenario gets that names no pressure, Pa.
        continuous_limit: most that a chamber may hold, Pa.
        pulsed_limit: most that may be supplied while chambers alternate (a gait, PWM), Pa.
        limit_source: where the limits are stated, quoted in the refusal.
    """

    nominal: float
    continuous_limit: float
    pulsed_limit: float
    limit_source: str

    def __post_init__(self) -> None:
        _positive(self, "nominal", "continuous_limit", "pulsed_limit")


@dataclass(frozen=True)
class Tail:
    """A tail assembly on two axles: the last connector, with a second axle behind its own.

    Attributes:
        axle: from the last connector's axle back to the second, m.
        com: from there back to the assembly's centre of mass, between the two, m.
        com_height: of that above the floor, m.
        gyration: the assembly's radius of gyration with its wheels, m.
    """

    axle: float
    com: float
    com_height: float
    gyration: float

    def __post_init__(self) -> None:
        _positive(self, "axle", "com_height", "gyration")
        _require(
            0 <= self.com <= self.axle, "com", self.com, f"it lies between the axles, 0 to {self.axle:g}"
        )


class Axle(NamedTuple):
    """Two wheels.

    Attributes:
        connector: which they carry, 1 the head.
        behind: its middle, m.
        mass: that they carry of a snake at rest on a level floor, kg.
    """

    connector: int
    behind: float
    mass: float


@dataclass(frozen=True)
class RobotSpec:
    """One snake.

    Attributes:
        name: short name, also the name of its MJCF model.
        title: one line for people.
        geometry: lengths and the number of connectors.
        mass: of connectors and wheels.
        friction: of the wheels on the floor.
        bending: compliance of a segment.
        actuator: response of a module to its valves.
        chamber: air spaces.
        supply: pressures and their limits.
        phase_step: β, by which the gait of a segment lags the one before it, rad (E18).
        variation: what is each module's own; None where all are nominal.
        tail: None where the last connector is like the others.
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

    def __post_init__(self) -> None:
        given, wanted = len(self.mass.connectors), self.geometry.connectors
        _require(given == wanted, "mass.connectors", given, f"the robot has {wanted} connectors")
        _require(math.isfinite(self.phase_step), "phase_step", self.phase_step, "it must be finite")
        if self.variation is not None:
            given = len(self.variation.gain)
            _require(given == self.segments, "modules", given, f"the robot has {self.segments}")

    @property
    def segments(self) -> int:
        """Number of bending segments, N − 1."""
        return self.geometry.segments

    @cached_property
    def modules(self) -> Modules:
        """What is each module's own."""
        return self.variation or Modules.alike(self.segments)

    @cached_property
    def axles(self) -> tuple[Axle, ...]:
        """All axles, head first."""
        each = [Axle(i, 0.0, mass) for i, mass in enumerate(self.mass.connectors, start=1)]
        if self.tail is not None:
            last, share = each.pop(), self.tail.com / self.tail.axle
            each += [last._replace(mass=(1 - share) * last.mass)]
            each += [last._replace(mass=share * last.mass, behind=self.tail.axle)]
        return tuple(each)

    @property
    def connector_gyration(self) -> float:
        """Radius of gyration of a connector without its wheels, m.

        Where the robot file gives none, that of a uniform block as long as the rigid gap and as wide as the
        track: √((L_o² + (2 w)²)/12).
        """
        g = self.geometry
        derived = math.hypot(g.rigid_gap, 2 * g.half_track) / math.sqrt(12)
        return derived if self.mass.connector_gyration is None else self.mass.connector_gyration

    def yaw_inertia(self) -> np.ndarray:
        """Return each connector's moment of inertia about its own vertical, wheels included, (N,), kg·m²."""
        wheel, g = self.mass.wheel, self.geometry
        wheels = 2 * wheel * (g.half_track**2 + g.wheel_radius**2 / 4)
        inertia: np.ndarray = (self.mass.array() - 2 * wheel) * self.connector_gyration**2 + wheels
        return inertia
