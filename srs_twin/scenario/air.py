"""Air of a scenario: supply, chambers, valves."""

from __future__ import annotations

from typing import Literal

from pydantic import model_validator

from srs_twin.pneumatics import OrificePneumatics, Pneumatics, make_pneumatics
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.fields import Section, quantity, section

ORIFICE_ONLY = ("critical_ratio", "flow_limit_l_per_min", "line_volume_ml", "line_begins_kpa")


class SupplyFile(Section):
    """Compressed air."""

    pressure_kpa: float | None = quantity(
        "Supply pressure, gauge (default: the robot's nominal one)", 0.1, 2000.0, None
    )
    allow_overpressure: bool = section("The same as allow_overpressure of the scenario.", False)


class PneumaticsFile(Section):
    """Valves and chambers."""

    constructors = (make_pneumatics, OrificePneumatics)

    kind: Literal["lag", "orifice"] = section(
        "How chambers fill; lag: exponentially, with tau_1; orifice: compressible flow (ISO 6358) into "
        "chambers that grow as they bend, from one supply.",
        "lag",
    )
    leak_per_s: float = quantity("Share of its pressure that a held chamber loses a second", 0.0, 100.0)
    valve_delay_s: float = quantity("How much later than commanded a valve switches, besides tau_2", 0.0, 1.0)
    critical_ratio: float | None = quantity(
        "Critical pressure ratio of the valves (orifice; default {default:g})", 0.0, 0.8, None
    )
    flow_limit_l_per_min: float | None = quantity(
        "Most that the supply delivers, measured at ambient pressure (orifice; default: no limit)", 0.01, 1e4
    )
    line_volume_ml: float | None = quantity(
        "Volume between a limited supply and the inlets (orifice; default {default:g})", 1.0, 1e6, None
    )
    line_begins_kpa: float | None = quantity(
        "Pressure in that line at first, gauge (orifice; default: the supply's)", 0.0, 2000.0
    )

    @model_validator(mode="after")
    def _what_belongs_together(self) -> PneumaticsFile:
        given = [name for name in ORIFICE_ONLY if getattr(self, name) is not None]
        if given and self.kind != "orifice":
            raise ValueError(f"{given[0]} belongs to kind: orifice; set that, or take {given[0]} out")
        of_the_line = [name for name in given if name.startswith("line")]
        if of_the_line and self.flow_limit_l_per_min is None:
            raise ValueError(f"{of_the_line[0]} is felt only with flow_limit_l_per_min; give that too")
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

    layout: Literal["3/2", "in_out"] | None = section(
        "3/2: one valve, which fills or vents; in_out: an inlet and an outlet valve, which can hold as well "
        "(default: what the controller drives).",
        None,
    )
