"""Air of a scenario: supply, chambers, valves."""

from __future__ import annotations

from typing import Literal

from pydantic import model_validator

from srs_twin.pneumatics import OrificePneumatics, Pneumatics, make_pneumatics
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.fields import Section, quantity


class SupplyFile(Section):
    """Compressed air."""

    pressure_kpa: float | None = quantity(0.1, 2000.0, None)
    """Supply pressure, gauge (default: the robot's nominal one)."""
    allow_overpressure: bool = False
    """The same as allow_overpressure of the scenario."""


class PneumaticsFile(Section):
    """Valves and chambers."""

    constructors = (make_pneumatics, OrificePneumatics)
    only = {
        ("kind", "orifice"): ("critical_ratio", "flow_limit_l_per_min", "line_volume_ml", "line_begins_kpa")
    }

    kind: Literal["lag", "orifice"] = "lag"
    """How chambers fill; lag: exponentially, with tau_1; orifice: compressible flow (ISO 6358) into
    chambers that grow as they bend, from one supply."""
    leak_per_s: float = quantity(0.0, 100.0)
    """Share of its pressure that a held chamber loses a second."""
    valve_delay_s: float = quantity(0.0, 1.0)
    """How much later than commanded a valve switches, besides tau_2."""
    critical_ratio: float | None = quantity(0.0, 0.8, None)
    """Critical pressure ratio of the valves (orifice; default {default:g})."""
    flow_limit_l_per_min: float | None = quantity(0.01, 1e4)
    """Most that the supply delivers, measured at ambient pressure (orifice; default: no limit)."""
    line_volume_ml: float | None = quantity(1.0, 1e6, None)
    """Volume between a limited supply and the inlets (orifice; default {default:g})."""
    line_begins_kpa: float | None = quantity(0.0, 2000.0)
    """Pressure in that line at first, gauge (orifice; default: the supply's)."""

    @model_validator(mode="after")
    def _line_is_limited(self) -> PneumaticsFile:
        given = [key for key in ("line_volume_ml", "line_begins_kpa") if getattr(self, key) is not None]
        if given and self.flow_limit_l_per_min is None:
            raise ValueError(f"{given[0]} is felt only with flow_limit_l_per_min; give that too")
        return self

    def resolved(self) -> PneumaticsFile:
        """Return the section with the defaults written out that matter."""
        if self.kind == "lag":
            return self
        limited = self.flow_limit_l_per_min is not None
        return self.with_defaults("critical_ratio", *(["line_volume_ml"] if limited else []))

    def chambers(self, robot: RobotSpec, supply_pa: float, layout: str) -> Pneumatics:
        """Return fresh chambers of a robot."""
        return make_pneumatics(spec=robot, supply_pa=supply_pa, layout=layout, **self.arguments())


class ValvesFile(Section):
    """The valves of each chamber."""

    layout: Literal["3/2", "in_out"] | None = None
    """3/2: one valve, which fills or vents; in_out: an inlet and an outlet valve, which can hold as well
    (default: what the controller drives)."""
