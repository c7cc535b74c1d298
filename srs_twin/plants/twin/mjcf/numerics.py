"""Settings of a twin that are not the robot's: time step, discretisation, contact with the floor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from srs_twin.errors import InputError, one_of

WALL_M = 0.001
"""Radius of the capsules along the sides of a polygon: what obstacles are larger by than drawn."""

Law = Literal["wheel", "ellipse", "axis"]
LAWS_ON_LOADS: tuple[Law, ...] = get_args(Law)
"""Friction laws that can act on momentary loads."""

LOADS = ("momentary", "across", "static")
"""Load of a wheel that such a law takes. momentary: the contact force; across: the connector's weight,
divided in the ratio of the contact forces of its two wheels (as in the analytical model); static: half of
that weight."""

Wheels = Literal["rolling", "skid"]
WHEELS: tuple[Wheels, ...] = get_args(Wheels)

LAW_OF: dict[Wheels, Law] = {"rolling": "wheel", "skid": "ellipse"}
"""Friction law of wheels and of skids."""

PRELOAD = {"rolling": 39.0, "skid": 99.0}
"""Preload of a wheel and of a skid, as a multiple of its static load.

A skid slides along as well as across, so its contact wants to open more: with κ = 19 connectors rocked from
one skid to the other and their loads swung by as much as their mean, with κ = 59 still the tail's.
"""


@dataclass(frozen=True)
class LoadedContact:
    """Floor contact whose normal forces come from MuJoCo and whose friction is a law on these loads.

    Attributes:
        law: friction law, "wheel", "ellipse" or "axis" (docs/models.md).
        load: which load of a wheel the law takes, one of `LOADS`; all but "momentary" are for comparison.
        slip_speed: below which a contact yields before it slides (`friction_held.held`), m/s.
    """

    name: ClassVar[Literal["loaded"]] = "loaded"
    rolling: ClassVar = True

    law: Law = "wheel"
    load: str = "momentary"
    slip_speed: float = 0.001

    def __post_init__(self) -> None:
        one_of("law", self.law, LAWS_ON_LOADS)
        one_of("load", self.load, LOADS)
        _check_positive(self, "slip_speed")


@dataclass(frozen=True)
class PreloadedContact:
    """Floor contact with MuJoCo's own friction, on wheels or skids with a preload.

    Friction is then that of the static load, as in the analytical model.

    Attributes:
        wheels: "rolling" (wheels on hinges) or "skid" (runners).
        preload: κ, by how many times its static load each wheel is pressed down; None: `PRELOAD`.
        slip_time: time constant with which contact friction stops a slip (`solreffriction`), s.
        axle_time: the same for the axles' friction, s.
        slip_speed: below which the body's drag is smoothed, m/s.
    """

    name: ClassVar[Literal["preloaded"]] = "preloaded"

    wheels: Wheels = "rolling"
    preload: float | None = None
    slip_time: float = 0.0003
    axle_time: float = 0.002
    slip_speed: float = 0.001

    def __post_init__(self) -> None:
        one_of("wheels", self.wheels, WHEELS)
        _check_positive(self, "slip_time", "axle_time", "slip_speed")
        if not 0.0 <= self.pressed < math.inf:
            raise InputError(f"preload {self.preload} is not allowed; it must be finite and 0 or more")

    @property
    def rolling(self) -> bool:
        """Whether the snake has wheels, not skids."""
        return self.wheels == "rolling"

    @property
    def pressed(self) -> float:
        """By how many times its static load each wheel is pressed down."""
        return PRELOAD[self.wheels] if self.preload is None else self.preload


def _check_positive(contact: LoadedContact | PreloadedContact, *names: str) -> None:
    for name in names:
        if not 0.0 < (value := getattr(contact, name)) < math.inf:
            raise InputError(f"{name} {value} is not allowed; it must be finite and above 0")


Contact = LoadedContact | PreloadedContact
ContactName = Literal["loaded", "preloaded"]
UNSTATED_CONTACT: ContactName = "preloaded"
"""Contact of the twin in kept results that do not state it; they are older than the choice."""


def as_contact(contact: Contact | str) -> Contact:
    """Return a contact; a name gives the contact with its default options.

    Raises:
        InputError: something else.
    """
    if isinstance(contact, LoadedContact | PreloadedContact):
        return contact
    kinds: dict[str, type[LoadedContact] | type[PreloadedContact]] = {
        kind.name: kind for kind in (LoadedContact, PreloadedContact)
    }
    one_of("contact", str(contact), kinds)
    return kinds[contact]()


@dataclass(frozen=True)
class Numerics:
    """Switches that only studies of the twin itself change.

    Attributes:
        link_share: mass between the hinges of a segment, as a share of the lightest connector's; the
            dissertation lumps all of it at the connectors.
        wheel_spin: the wheels' inertia about their axles, as a multiple of what they have.
        constant_curvature: force equal angles on the hinges of a segment, as in the analytical model;
            otherwise a loaded segment also bends into an S.
    """

    link_share: float = 0.02
    wheel_spin: float = 1.0
    constant_curvature: bool = False


@dataclass(frozen=True)
class ModelSettings:
    """Settings of an MJCF model that are not properties of the robot.

    Attributes:
        timestep: s.
        hinges_per_segment: bending hinges per segment, 1 or more.
        contact: how the floor holds the snake.
        base: "free", or "clamped": the head is held, the rest hangs in the air and bends in the plane only.
        numerics: rarely changed switches.
    """

    timestep: float = 0.001
    hinges_per_segment: int = 2
    contact: Contact = LoadedContact()
    base: str = "free"
    numerics: Numerics = Numerics()

    @property
    def loaded(self) -> bool:
        """Whether there is a floor, and its friction acts on the loads that MuJoCo finds."""
        return isinstance(self.contact, LoadedContact) and self.base == "free"

    @property
    def contact_time(self) -> float:
        """Time constant of the normal contact, s; loaded: two steps, because loads oscillate with one."""
        return 2 * self.timestep if self.loaded else _PRESSED_CONTACT_S


_PRESSED_CONTACT_S = 0.001

Preset = Literal["reference", "fast"]
PRESETS: dict[str, dict[str, Any]] = {"reference": {"timestep": 0.00025}, "fast": {"timestep": 0.002}}
"""Name → settings of a twin: `TwinSnake(spec, **PRESETS["fast"])`. Their errors were measured by
benchmarks/presets.py; 2 ms is the longest step below the segments' damping time.
"""


def preset_of(settings: ModelSettings) -> str | None:
    """Return the preset that gives these settings, if one does."""
    if not settings.loaded:
        return None
    return next((name for name, given in PRESETS.items() if given.items() <= vars(settings).items()), None)


def hinge_stations(hinges: int, length: float, gap: float) -> np.ndarray:
    """Return where the bending hinges of a straight segment stand, m from its front connector.

    With n ≥ 2 hinges that share a bend q equally, the chord agrees with the arc's l·sin(q/2)/(q/2) through
    order q² when the first and last lie 1/(2(n+1)) of the length from its ends and the others evenly between.

    Args:
        hinges: n.
        length: l, of the part that bends, m.
        gap: L_o, of the straight ends together, m.

    Returns:
        Shape (n,).

    Raises:
        InputError: there is no hinge.
    """
    if hinges < 1:
        raise InputError(f"hinges_per_segment: {hinges} is not allowed; a segment needs 1 or more")
    edge = 1 / (2 * (hinges + 1)) if hinges > 1 else 0.5
    return gap / 2 + length * np.linspace(edge, 1 - edge, hinges)
