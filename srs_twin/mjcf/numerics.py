"""What belongs to the simulation of a snake and not to the robot: time step, discretisation, contact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from srs_twin.errors import InputError

WALL_M = 0.001
"""Radius of the capsules along the sides of a polygon: what obstacles are larger by than drawn."""

PRELOAD = {"rolling": 39.0, "skid": 99.0}
"""What a snake may stand on → by how many times its static load each wheel or skid is pressed down.

A skid slides along as well as across, so its contact wants to open more: with κ = 19 connectors rocked from
one skid to the other and their loads swung by as much as their mean, with κ = 59 still the tail's.
"""

WHEELS = tuple(PRELOAD)

Contact = Literal["preloaded", "loaded"]
CONTACTS: tuple[Contact, ...] = get_args(Contact)
"""How the floor holds a snake: wheels or skids pressed down, with MuJoCo's friction; or normals by MuJoCo and
friction by a law of `friction` on the momentary loads."""

LawOnLoads = Literal["wheel", "ellipse", "axis"]
ON_LOADS: tuple[LawOnLoads, ...] = get_args(LawOnLoads)
"""Laws that can act on momentary loads."""

LOADS = ("momentary", "across", "static")
"""Of a wheel, that such a law takes: what presses it at that moment; its connector's weight, shared between
the two as these are at that moment, which is what the analytical model has; half of that weight."""

LAW_OF: dict[str, LawOnLoads] = {"rolling": "wheel", "skid": "ellipse"}
"""What a snake stands on → the friction law that describes it."""


@dataclass(frozen=True)
class Numerics:
    """What belongs to the simulation and not to the robot.

    Attributes:
        timestep: s.
        hinges_per_segment: bending hinges a segment, 1 or more.
        contact: one of `CONTACTS`.
        wheels: what the snake stands on, one of `WHEELS`; "rolling" under `loaded`.
        friction: law on the momentary loads, under `loaded`.
        load: of a wheel, that this law takes, one of `LOADS`.
        slip_speed: below which a contact yields before it slides under that law (`friction_held.held`), m/s.
        contact_time: time constant of the normal contact, s; MuJoCo takes no less than the time step, and
            under `loaded` loads flutter below 2 of them.
        slip_time: time constant with which contact friction stops a slip (`solreffriction`), s.
        axle_time: the same for the axles' friction, s.
        preload: κ, by how many times its static load each wheel is pressed down besides; 0: none. What
            suits the wheels stands in `PRELOAD`.
        link_share: mass between the hinges of a segment, as a share of the lightest connector's; the text
            lumps all of it at the connectors.
        wheel_spin: the wheels' inertia about their axles, as a multiple of what they have.
        base: "free", or "clamped": the head is held, the rest hangs in the air and bends in the plane only.
        constant_curvature: force the hinges of a segment to bend alike, as the analytical model has it; left
            alone a segment under load takes the shape of an S besides.
    """

    timestep: float = 0.001
    hinges_per_segment: int = 2
    contact: Contact = "preloaded"
    wheels: str = "rolling"
    friction: LawOnLoads = "wheel"
    load: str = "momentary"
    slip_speed: float = 0.001
    contact_time: float = 0.001
    slip_time: float = 0.0003
    axle_time: float = 0.002
    preload: float = PRELOAD["rolling"]
    link_share: float = 0.02
    wheel_spin: float = 1.0
    constant_curvature: bool = False
    base: str = "free"


Preset = Literal["reference", "fast"]
PRESETS: dict[str, dict[str, Any]] = {
    "reference": {key: getattr(Numerics, key) for key in ("contact", "timestep", "hinges_per_segment")},
    "fast": {"contact": "loaded", "timestep": 0.002, "hinges_per_segment": 2},
}
"""Name → settings of a twin: `TwinSnake(spec, **PRESETS["fast"])`. What `fast` costs in accuracy was measured
by benchmarks/presets.py; 2 ms is the longest step below the segments' damping time.
"""


def preset_of(numerics: Numerics) -> str | None:
    """Return the preset that gives these settings, if one does."""
    return next((name for name, given in PRESETS.items() if given.items() <= vars(numerics).items()), None)


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
