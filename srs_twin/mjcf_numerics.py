"""What belongs to the simulation of a snake and not to the robot: time step, discretisation, contact."""

from __future__ import annotations

from dataclasses import dataclass

PRELOAD = {"rolling": 39.0, "skid": 99.0}
"""What a snake may stand on → by how many times its static load each wheel or skid is pressed down.

A skid slides along as well as across, so its contact wants to open more: with κ = 19 connectors rocked from
one skid to the other and their loads swung by as much as their mean, with κ = 59 still the tail's.
"""

WHEELS = tuple(PRELOAD)


@dataclass(frozen=True)
class Numerics:
    """What belongs to the simulation and not to the robot.

    Attributes:
        timestep: s.
        hinges_per_segment: bending hinges a segment, 1 or more.
        wheels: what the snake stands on, one of `WHEELS`.
        contact_time: time constant of the normal contact, s; MuJoCo takes no less than the time step.
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
    wheels: str = "rolling"
    contact_time: float = 0.001
    slip_time: float = 0.0003
    axle_time: float = 0.002
    preload: float = PRELOAD["rolling"]
    link_share: float = 0.02
    wheel_spin: float = 1.0
    constant_curvature: bool = False
    base: str = "free"
