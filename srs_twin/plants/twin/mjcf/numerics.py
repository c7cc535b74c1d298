"""Numerical settings of a twin: time step, discretisation and floor contact."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, get_args

import numpy as np

from srs_twin.errors import InputError, check_choice
from srs_twin.robot.spec import RobotSpec

TIMESTEP_S = 0.001
"""Default time step for a robot with a time unit of 1 (`robot.scale`), s."""

MAX_STEP_RATIO = 1.5
"""Maximum ratio of the time step to the damping time of the segments.

The simulation diverges if the ratio is 2 or more.
"""

SLIP_SPEED_M_S = 0.001
"""Default slip speed for a robot with a time unit of 1, m/s."""

SLIP_TIME_S = 0.0003
"""Default slip time of preloaded contact for a robot with a time unit of 1, s."""

AXLE_TIME_S = 0.002
"""Default axle time of preloaded contact for a robot with a time unit of 1, s."""

LawOnLoads = Literal["wheel", "ellipse", "axis", "cosine"]
LAWS_ON_LOADS: tuple[LawOnLoads, ...] = get_args(LawOnLoads)
"""Friction laws that are available with loaded contact."""

LOADS = ("instantaneous", "across", "static")
"""Values of `LoadedContact.load`, which selects the wheel load in the friction law.

- instantaneous: the instantaneous normal force.
- across: the weight of the connector, distributed in proportion to the normal forces on
  its two wheels, as in the analytical model.
- static: half of the weight of the connector.
"""

Wheels = Literal["rolling", "skid"]
WHEELS: tuple[Wheels, ...] = get_args(Wheels)

FRICTION_LAW_OF: dict[Wheels, LawOnLoads] = {"rolling": "wheel", "skid": "ellipse"}

PRELOAD = {"rolling": 39.0, "skid": 99.0}
"""Default preload κ of wheels and skids, dimensionless.

A skid slides in both directions, so its contact opens more easily than that of a wheel.
With κ = 19, connectors rock from one skid to the other, and the loads oscillate with an
amplitude as large as the mean load. With κ = 59, such strong oscillations occur only at
the tail.
"""


@dataclass(frozen=True)
class LoadedContact:
    """Floor contact with normal forces from MuJoCo and friction from a friction law.

    Attributes:
        law: friction law, "wheel", "ellipse", "axis" or "cosine" (docs/friction.md). A
            robot with skin uses the friction law of the skin instead.
        load: wheel load in the friction law, one of `LOADS`. Values other than
            "instantaneous" are intended for comparisons.
        slip_speed: slip speed ε, m/s. The default is `SLIP_SPEED_M_S` times the time
            unit of the robot (`robot.scale`). Below its limit μN, friction changes by
            μN/ε times the slip velocity in each step, so that a resting contact does
            not creep (`stick_slip`).
    """

    name: ClassVar[Literal["loaded"]] = "loaded"
    rolling: ClassVar = True

    law: LawOnLoads = "wheel"
    load: str = "instantaneous"
    slip_speed: float | None = None

    def __post_init__(self) -> None:
        check_choice("law", self.law, LAWS_ON_LOADS)
        check_choice("load", self.load, LOADS)
        _check_positive(self, "slip_speed")

    def for_robot(self, spec: RobotSpec) -> LoadedContact:
        """Return a copy in which the robot's default values replace None."""
        return replace(self, slip_speed=_scaled(self.slip_speed, SLIP_SPEED_M_S, spec))


@dataclass(frozen=True)
class PreloadedContact:
    """Floor contact with MuJoCo's own friction, for wheels or skids with a preload.

    Friction acts as if each wheel carried its static load, as in the analytical model.

    Attributes:
        wheels: kind of feet, "rolling" (wheels on hinges) or "skid" (runners).
        preload: preload κ, the ratio of the additional normal force on each wheel to
            its static load, dimensionless. The defaults are in `PRELOAD`.
        slip_time: time constant with which contact friction stops slipping
            (`solreffriction`), s. The default is `SLIP_TIME_S` times the time unit of
            the robot (`robot.scale`).
        axle_time: time constant with which axle friction stops the rotation of a wheel,
            s. The default is `AXLE_TIME_S` times the time unit.
        slip_speed: slip speed of the axial drag, m/s. The default is `SLIP_SPEED_M_S`
            times the time unit.
    """

    name: ClassVar[Literal["preloaded"]] = "preloaded"

    wheels: Wheels = "rolling"
    preload: float | None = None
    slip_time: float | None = None
    axle_time: float | None = None
    slip_speed: float | None = None

    def __post_init__(self) -> None:
        check_choice("wheels", self.wheels, WHEELS)
        _check_positive(self, "slip_time", "axle_time", "slip_speed")
        if not 0.0 <= self.preload_ratio < math.inf:
            raise InputError(
                f"`preload` {self.preload} is not allowed; it must be finite and at"
                " least 0"
            )

    def for_robot(self, spec: RobotSpec) -> PreloadedContact:
        """Return a copy in which the robot's default values replace None."""
        return replace(
            self,
            slip_time=_scaled(self.slip_time, SLIP_TIME_S, spec),
            axle_time=_scaled(self.axle_time, AXLE_TIME_S, spec),
            slip_speed=_scaled(self.slip_speed, SLIP_SPEED_M_S, spec),
        )

    @property
    def rolling(self) -> bool:
        """Whether the snake has wheels instead of skids."""
        return self.wheels == "rolling"

    @property
    def preload_ratio(self) -> float:
        """Preload κ, by default the value in `PRELOAD`, dimensionless."""
        if self.preload is None:
            return PRELOAD[self.wheels]
        return self.preload


def _check_positive(contact: LoadedContact | PreloadedContact, *names: str) -> None:
    for name in names:
        value = getattr(contact, name)
        if value is not None and not 0.0 < value < math.inf:
            raise InputError(
                f"{name} {value} is not allowed; it must be finite and above 0"
            )


def _scaled(value: float | None, default: float, spec: RobotSpec) -> float:
    if value is None:
        return default * spec.scale.time
    return value


def stated(setting: float | None) -> float:
    """Return a contact setting that is not None.

    The method `for_robot` replaces settings that are None.
    """
    assert setting is not None
    return setting


Contact = LoadedContact | PreloadedContact
ContactName = Literal["loaded", "preloaded"]
UNSTATED_CONTACT: ContactName = "preloaded"
"""Contact that is assumed for stored results that do not name their contact."""


def as_contact(contact: Contact | str) -> Contact:
    """Return a contact unchanged, or create the named contact with default options.

    Raises:
        InputError: the argument is neither a contact nor a known name.
    """
    if isinstance(contact, LoadedContact | PreloadedContact):
        return contact
    check_choice("contact", str(contact), get_args(ContactName))
    return LoadedContact() if contact == LoadedContact.name else PreloadedContact()


@dataclass(frozen=True)
class Numerics:
    """Settings that only studies of the twin itself change.

    Attributes:
        link_fraction: mass of the links between the hinges of a segment as a fraction
            of the lightest connector's mass, dimensionless. In the dissertation, the
            links have no mass.
        wheel_spin: factor that multiplies the moment of inertia of each wheel about its
            axle, dimensionless.
        constant_curvature: whether the hinges of a segment are constrained to equal
            angles, as in the analytical model. Without this constraint, a loaded
            segment can also bend into an S shape.
    """

    link_fraction: float = 0.02
    wheel_spin: float = 1.0
    constant_curvature: bool = False


@dataclass(frozen=True)
class ModelSettings:
    """Settings of an MJCF model that are not properties of the robot.

    Attributes:
        timestep: time step, s.
        hinges_per_segment: number of bending hinges per segment, 1 or more.
        base: support of the chain, either "free" on the floor or "clamped" in the air
            at its head. A clamped planar robot bends only in the horizontal plane.
    """

    timestep: float = TIMESTEP_S
    hinges_per_segment: int = 2
    contact: Contact = LoadedContact()
    base: str = "free"
    numerics: Numerics = Numerics()

    @property
    def loaded(self) -> bool:
        """Whether the robot is on the floor and has loaded contact."""
        return isinstance(self.contact, LoadedContact) and self.base == "free"

    def for_robot(self, spec: RobotSpec) -> ModelSettings:
        """Return a copy in which the robot's default contact settings replace None."""
        return replace(self, contact=self.contact.for_robot(spec))

    def link_mass(self, spec: RobotSpec) -> float:
        """Return the mass of a link between two hinges, kg."""
        links = max(1, self.hinges_per_segment - 1)
        return self.numerics.link_fraction * min(spec.mass.connectors) / links

    def contact_time(self, spec: RobotSpec) -> float:
        """Return the time constant of the normal contact, s.

        With loaded contact, the time constant is two time steps, because the normal
        forces would oscillate with a time constant of one step. With preloaded contact,
        the time constant is a fraction of the damping time of the pitch and roll
        joints, which distribute the load.
        """
        if self.loaded:
            return 2 * self.timestep
        return spec.bending.out_of_plane_damping_time / _CONTACT_RATIO


_CONTACT_RATIO = 10.0
"""Ratio of the out-of-plane damping time to the preloaded contact's time constant."""

Preset = Literal["reference", "fast"]
PRESETS: dict[str, dict[str, float]] = {
    "reference": {"timestep": 0.00025},
    "fast": {"timestep": 0.002},
}
"""Arguments of `TwinSnake` for each preset.

The script benchmarks/presets.py measures the errors of each preset. A time step of 2 ms
is the longest round value below the damping time of the segments.
"""


def preset_of(settings: ModelSettings) -> str | None:
    """Return the name of the preset with the time step of `settings`, or None."""
    if not settings.loaded:
        return None
    for name, preset in PRESETS.items():
        if preset["timestep"] == settings.timestep:
            return name
    return None


def bend_joints(spec: RobotSpec) -> tuple[str, ...]:
    """Return the names of the joint classes that bend a segment."""
    if spec.is_spatial:
        return ("hinge", "tilt")
    return ("hinge",)


def hinge_stations(hinges: int, length: float, gap: float) -> np.ndarray:
    """Return the distances of the hinges from the front connector, shape (n,), m.

    If n ≥ 2, the outer hinges are at a distance of l/(2(n+1)) from the ends of the
    bending part. The other hinges are evenly spaced between them. With equal hinge
    angles, the chord then equals that of an arc with bend q, l sin(q/2)/(q/2), up to
    order q².

    Args:
        hinges: number of hinges n.
        length: length l of the part that bends, m.
        gap: total length L_o of the two straight ends, m.

    Raises:
        InputError: n is less than 1.
    """
    if hinges < 1:
        raise InputError(
            f"`hinges_per_segment` {hinges} is not allowed; a segment needs 1 or more"
        )
    edge = 1 / (2 * (hinges + 1)) if hinges > 1 else 0.5
    return gap / 2 + length * np.linspace(edge, 1 - edge, hinges)


def stable_step(step: float, damping_time: float) -> float:
    """Return the longest stable time step that divides a given step, s.

    The damping time of the segments (s) limits the time step.
    """
    return step / math.floor(step / (MAX_STEP_RATIO * damping_time) + 1)
