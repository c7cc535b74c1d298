"""What a scenario file says of the air: supply, chambers, valves."""

from __future__ import annotations

from typing import Literal

from pydantic import model_validator

from srs_twin.io.validation import Strict
from srs_twin.scenario.fields import quantity, section

ORIFICE_ONLY = ("critical_ratio", "flow_limit_l_per_min", "line_volume_ml", "line_begins_kpa")
_OF_THE_LINE = ("line_volume_ml", "line_begins_kpa")


class SupplyFile(Strict):
    """Compressed air."""

    pressure_kpa: float | None = quantity(
        "Supply pressure, gauge (default: the robot's nominal one)", "kPa", 0.1, 2000.0, None
    )
    allow_overpressure: bool = section("The same as allow_overpressure of the scenario.", False)


class PneumaticsFile(Strict):
    """Valves and chambers."""

    kind: Literal["lag", "orifice"] = section(
        "How chambers fill; lag: exponentially, with tau_1; orifice: compressible flow (ISO 6358) into "
        "chambers that grow as they bend, from one supply.",
        "lag",
    )
    leak_per_s: float = quantity(
        "Share of its pressure that a held chamber loses a second", "1/s", 0.0, 100.0, 0.0
    )
    valve_delay_s: float = quantity(
        "How much later than commanded a valve switches, besides tau_2", "s", 0.0, 1.0, 0.0
    )
    critical_ratio: float | None = quantity(
        "Critical pressure ratio of the valves (orifice; default 0.3)", "", 0.0, 0.8, None
    )
    flow_limit_l_per_min: float | None = quantity(
        "Most that the supply delivers, measured at ambient pressure (orifice; default: no limit)",
        "L/min", 0.01, 10_000.0, None,
    )  # fmt: skip
    line_volume_ml: float | None = quantity(
        "Volume between a limited supply and the inlets (orifice; default 50)", "ml", 1.0, 1e6, None
    )

    line_begins_kpa: float | None = quantity(
        "Pressure in that line at first, gauge (orifice; default: the supply's)", "kPa", 0.0, 2000.0, None
    )

    @model_validator(mode="after")
    def _what_belongs_together(self) -> PneumaticsFile:
        given = [name for name in ORIFICE_ONLY if getattr(self, name) is not None]
        if given and self.kind != "orifice":
            raise ValueError(f"{given[0]} belongs to kind: orifice; set that, or take {given[0]} out")
        felt = [name for name in _OF_THE_LINE if getattr(self, name) is not None]
        if felt and self.flow_limit_l_per_min is None:
            raise ValueError(f"{felt[0]} is felt only with flow_limit_l_per_min; give that too")
        return self


class ValvesFile(Strict):
    """The valves of each chamber."""

    layout: Literal["3/2", "in_out"] | None = section(
        "3/2: one valve, which fills or vents; in_out: an inlet and an outlet valve, which can hold as well "
        "(default: what the controller drives).",
        None,
    )
