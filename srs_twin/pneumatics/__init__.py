"""Valves, chambers and free bends for both plants, with two chamber models."""

from __future__ import annotations

from collections.abc import Callable

from srs_twin.extensions import part
from srs_twin.pneumatics.base import Pneumatics as Pneumatics, Trace as Trace
from srs_twin.pneumatics.lag import LagPneumatics as LagPneumatics
from srs_twin.pneumatics.orifice import OrificePneumatics as OrificePneumatics
from srs_twin.pneumatics.spatial import SpatialLagPneumatics as SpatialLagPneumatics
from srs_twin.pneumatics.valves import LAYOUTS as LAYOUTS, Schedule as Schedule
from srs_twin.robot.spec import RobotSpec

SPATIAL_KINDS: dict[str, Callable[..., Pneumatics]] = {"lag": SpatialLagPneumatics}
"""Chamber models for a robot whose segments bend in two directions."""

KINDS: dict[str, Callable[..., Pneumatics]] = {
    "lag": LagPneumatics,
    "orifice": OrificePneumatics,
}


def make_pneumatics(
    kind: str | Pneumatics,
    spec: RobotSpec,
    *,
    supply_pa: float,
    layout: str,
    **options: float | None,
) -> Pneumatics:
    """Return the chambers of a robot.

    Args:
        kind: a name in `KINDS`, a part from outside (`extensions.part`), or existing
            chambers, which are returned unchanged.
        spec: the robot.
        supply_pa: supply pressure, gauge, Pa.
        layout: valve layout, one of `LAYOUTS`.
        **options: further arguments of the class of that kind.

    Raises:
        UnknownNameError: the kind is unknown.
        InputError: the class refuses an argument.
    """
    if isinstance(kind, Pneumatics):
        return kind
    if kind not in KINDS:
        own = part("pneumatics", kind, (Pneumatics,), KINDS)
        chambers: Pneumatics = own(spec, supply_pa=supply_pa, layout=layout, **options)
        return chambers
    if spec.is_spatial and kind in SPATIAL_KINDS:
        return SPATIAL_KINDS[kind](spec, supply_pa=supply_pa, layout=layout, **options)
    spec.require_planar(f"pneumatics '{kind}'")
    return KINDS[kind](spec, supply_pa=supply_pa, layout=layout, **options)
