"""Models of the valves, the chambers and the free bends, used by both plants."""

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
"""Pneumatic models for spatial robots, keyed by name."""

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
    """Create the pneumatic model of a robot.

    Args:
        kind: key of `KINDS`, name of a plug-in class (`extensions.part`), or an
            existing model, which is returned unchanged.
        spec: robot specification.
        supply_pa: gauge supply pressure, Pa.
        layout: valve layout, a key of `LAYOUTS`.
        **options: further keyword arguments of the constructor.

    Raises:
        UnknownNameError: the kind is unknown.
        InputError: the constructor rejects an argument, or the kind does not support
            spatial robots.
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
