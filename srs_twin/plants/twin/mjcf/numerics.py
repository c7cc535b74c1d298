"""Numerical settings of a twin: time step, discretisation and floor contact."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, get_args

import numpy as np

from srs_twin.errors import InputError, check_choice
from srs_twin.robot.spec import RobotSpec

TIMESTEP_S = 0.001
"""Default time step at a time unit of 1 (`robot.scale`), s."""

MAX_STEP_RATIO = 1.5
"""Maximum ratio of the time step to the damping time of the segments.

The springs diverge if the ratio is 2 or more.
"""

SLIP_SPEED_M_S = 0.001
"""Default slip speed at a time unit of 1, m/s."""

SLIP_TIME_S = 0.0003
"""Default slip time of a preloaded contact at a time unit of 1, s."""

AXLE_TIME_S = 0.002
"""Default axle time of a preloaded contact at a time unit of 1, s."""

LawOnLoads = Literal["wheel", "ellipse", "axis", "cosine"]
LAWS_ON_LOADS: tuple[LawOnLoads, ...] = get_args(LawOnLoads)
"""Friction laws for loaded contact."""

LOADS = ("instantaneous", "across", "static")
"""Values of `LoadedContact.load`, which select the wheel load of the friction law.

- instantaneous: the instantaneous normal force.
- across: the weight of the connector, divided in the ratio of the normal forces on its
  two wheels, as in the analytical model.
- static: half of the weight of the connector.
"""

Wheels = Literal["rolling", "skid"]
WHEELS: tuple[Wheels, ...] = get_args(Wheels)

FRICTION_LAW_OF: dict[Wheels, LawOnLoads] = {"rolling": "wheel", "skid": "ellipse"}

PRELOAD = {"rolling": 39.0, "skid": 99.0}
"""Preload κ of a wheel and of a skid, dimensionless.

A skid slides in both directions, so its contact opens more easily than the contact of a
wheel. With κ = 19, connectors rocked from one skid to the opposite one, and the
amplitude of the loads was as large as the mean load. With κ = 59, only the loads of the
tail oscillated so strongly.
"""


@dataclass(frozen=True)
class LoadedContact:
    """Floor contact with normal forces from MuJoCo and friction from a friction law.

    Attributes:
        law: friction law, "wheel", "ellipse", "axis" or "cosine" (docs/friction.md). A
            robot with skin has the friction law of the skin instead.
        load: load of a wheel in the friction law, one of `LOADS`. The values other than
            the default "instantaneous" are only for comparison.
        slip_speed: slip speed ε, m/s. The default is `SLIP_SPEED_M_S` times the time
            unit of the robot (`robot.scale`). Below the friction limit μN, the force
            changes in each step by μN/ε times the velocity, so that a resting contact
            does not creep (`stick_slip`).
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
    """Floor contact with MuJoCo's own friction, on wheels or skids with a preload.

    Friction acts as if each wheel carried its static load, as in the analytical model.

    Attributes:
        wheels: kind of feet, "rolling" (wheels on hinges) or "skid" (runners).
        preload: preload κ, the ratio of the additional normal force on each wheel to
            the static load, dimensionless. `PRELOAD` contains the defaults.
        slip_time: time constant with which contact friction stops a slip
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
        """Preload κ (dimensionless), by default the value in `PRELOAD`."""
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
    """Return a contact setting, which `for_robot` must have set if it was None."""
    assert setting is not None
    return setting


Contact = LoadedContact | PreloadedContact
ContactName = Literal["loaded", "preloaded"]
UNSTATED_CONTACT: ContactName = "preloaded"
"""Contact assumed for stored results that do not name their contact."""


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
        link_fraction: fraction of the lightest connector's mass that is placed between
            the hinges of a segment, dimensionless. In the dissertation the connectors
            have all the mass.
        wheel_spin: factor on the wheels' moment of inertia about their axles,
            dimensionless.
        constant_curvature: whether the hinges of a segment are constrained to equal
            angles, as in the analytical model. Without this constraint, a loaded
            segment can also bend into an S.
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
        base: support of the chain, "free" or "clamped". A chain with a clamped head
            hangs in the air and bends only in the horizontal plane.
        numerics: settings that only studies of the twin itself change.
    """

    timestep: float = TIMESTEP_S
    hinges_per_segment: int = 2
    contact: Contact = LoadedContact()
    base: str = "free"
    numerics: Numerics = Numerics()

    @property
    def loaded(self) -> bool:
        """Whether the loaded contact is used, which requires a robot on the floor."""
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

        Under loaded contact, the time constant is two time steps, because the normal
        forces oscillate with a single time step. Under a preload, the time constant is
        a fraction of the damping time of the pitch and roll joints, which distribute
        the load.
        """
        if self.loaded:
            return 2 * self.timestep
        return spec.bending.out_of_plane_damping_time / _CONTACT_RATIO


_CONTACT_RATIO = 10.0
"""Ratio of the damping time of pitch and roll to the contact time under a preload."""

Preset = Literal["reference", "fast"]
PRESETS: dict[str, dict[str, float]] = {
    "reference": {"timestep": 0.00025},
    "fast": {"timestep": 0.002},
}
"""Arguments of `TwinSnake` for each preset.

The script benchmarks/presets.py measures the errors of each preset. A step of 2 ms is
the longest round step below the damping time of the segments.
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
    """Return the kinds of joints that bend a segment."""
    if spec.is_spatial:
        return ("hinge", "tilt")
    return ("hinge",)


def hinge_stations(hinges: int, length: float, gap: float) -> np.ndarray:
    """Return the distances of the hinges from the front connector, shape (n,), m.

    The first and the last of n ≥ 2 hinges are at 1/(2(n+1)) of the length from the
    ends, and the remaining hinges are evenly spaced between them. If the hinges have
    equal angles, the chord agrees with the chord l sin(q/2)/(q/2) of the arc through
    order q², where q is the bend.

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
    """Return the longest stable step that divides the time step, s.

    `damping_time` is the damping time of the segments, s.
    """
    return step / math.floor(step / (MAX_STEP_RATIO * damping_time) + 1)
