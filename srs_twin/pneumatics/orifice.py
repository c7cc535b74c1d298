r"""Isothermal chambers behind orifices (ISO 6358) whose volumes grow with the bend.

One supply feeds all chambers. The unknowns are the amounts of air n = P V in the
chambers, the linear bends x, and the amount of air in the line from the supply to the
inlets:

$$ \dot n = \dot n_{in} - \dot n_{out} - \Lambda\,(P - P_a),\qquad P = n / V(q),\qquad
\tau_2\,\dot x + x = G\,(g^+ p^+ - g^- p^-),\qquad q_f = b + \varphi(x). $$

The module `chambers` defines φ, b, V(q) and the gains g, and `flow` defines the flows.
The conductances are computed from the robot's τ₁ (`flow.conductances`). At the working
point, the leak conductance Λ makes the pressure of a held nominal chamber fall at the
relative rate `leak_per_s`.

Without a flow limit, the line is always at the supply pressure. With a flow limit, a
compressor with a regulator feeds the line. The flow of the compressor is at most the
limit, measured at ambient pressure, and decreases to 0 over the last hundredth of the
supply pressure. All inlets share the line, so a limited flow slows down all segments.

**Integration.** SDIRK2 (two stages, second order, L-stable) integrates all chambers
together. The stage equations are solved by Newton's method. A step ends at every valve
event. Within a step, states are interpolated by cubic Hermite polynomials.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypedDict, Unpack

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.errors import InputError
from srs_twin.pneumatics.base import (
    OptionalArray,
    Pneumatics,
    Trace,
    check_not_negative,
    check_supply,
)
from srs_twin.pneumatics.chambers import (
    AMBIENT_PA,
    bend_law_of,
    chamber_gains,
    check_pressure,
    invert_bend_law,
    volume,
)
from srs_twin.pneumatics.flow import REFERENCE_PA, conductances
from srs_twin.pneumatics.orifice_kernels import (
    DRAWN,
    LINE,
    LOST,
    ActualBends,
    OrificeParameters,
    OrificeState,
    simulate,
)
from srs_twin.pneumatics.valves import Schedule
from srs_twin.robot.spec import RobotSpec

CRITICAL_RATIO = 0.3
"""Critical pressure ratio b of a small solenoid valve, dimensionless.

This estimate lies in the range of small solenoid valves, 0.2 to 0.5.
"""

MAX_CRITICAL_RATIO = 0.8
"""Maximum critical pressure ratio, dimensionless.

With a larger ratio, the flow at a working point would be choked, and C could not be
computed from the time constant.
"""

LINE_VOLUME = 50e-6
"""Estimated volume of compressor outlet, tubes and manifold, m³."""

_SUBSTEP_S = 5e-4
"""Maximum integration step for a robot with time unit 1 (`robot.scale`), s."""

REGULATOR_BAND = 0.01
"""Pressure range in which the regulator closes, as a fraction of the gauge supply
pressure."""


class OrificeKeywords(TypedDict, total=False):
    """Keyword arguments of `OrificePneumatics` that set fields of `OrificeOptions`."""

    critical_ratio: float
    flow_limit: float | None
    line_volume: float
    initial_line_pressure: float | None
    leak_per_s: float
    substep: float | None


@dataclass(frozen=True)
class OrificeOptions:
    """Valves and supply line of orifice chambers.

    Attributes:
        critical_ratio: critical pressure ratio b of all valves, dimensionless.
        flow_limit: maximum flow of the supply, measured at ambient pressure, m³/s, or
            None for an unlimited flow.
        line_volume: volume of the line between supply and inlets, m³. The volume has an
            effect only with a flow limit.
        initial_line_pressure: initial gauge pressure in the line, by default the supply
            pressure, Pa.
        leak_per_s: relative rate at which the pressure of a held chamber falls, 1/s.
        substep: maximum integration step, s, by default 0.5 ms times the time unit of
            the robot (`robot.scale`).
    """

    critical_ratio: float = CRITICAL_RATIO
    flow_limit: float | None = None
    line_volume: float = LINE_VOLUME
    initial_line_pressure: float | None = None
    leak_per_s: float = 0.0
    substep: float | None = None

    def __post_init__(self) -> None:
        check_not_negative(leak_per_s=self.leak_per_s)
        for name in ("flow_limit", "line_volume", "substep"):
            value = getattr(self, name)
            if value is not None:
                check_positive(name, value)
        if not 0 <= self.critical_ratio <= MAX_CRITICAL_RATIO:
            raise InputError(
                f"`critical_ratio` {self.critical_ratio!r} is not allowed; it must be"
                f" between 0 and {MAX_CRITICAL_RATIO}"
            )

    def line_pressure(self, supply_pa: float) -> float:
        """Return the initial gauge pressure in the line, Pa.

        Raises:
            InputError: the pressure is negative or above the supply pressure.
        """
        begins = (
            supply_pa
            if self.initial_line_pressure is None
            else self.initial_line_pressure
        )
        if not 0 <= begins <= supply_pa:
            raise InputError(
                f"`initial_line_pressure` {begins!r} Pa is not allowed; it must be"
                f" between 0 and the supply pressure {supply_pa:g} Pa"
            )
        return begins

    def describe(self, initial_line_pressure: float) -> dict[str, object]:
        """Return the settings to be recorded with a run."""
        settings: dict[str, object] = {
            "critical_ratio": self.critical_ratio,
            "flow_limit_l_per_min": None,
            "line_volume_ml": None,
            "initial_line_pressure_kpa": None,
            "leak_per_s": self.leak_per_s,
        }
        if self.flow_limit is not None:
            settings["flow_limit_l_per_min"] = self.flow_limit * 60_000
            settings["line_volume_ml"] = self.line_volume * 1e6
            settings["initial_line_pressure_kpa"] = initial_line_pressure / 1000
        return settings


class OrificePneumatics(Pneumatics):
    """Planar chambers behind orifices.

    Attributes:
        conductances: inlet and outlet conductances, shape (segments, 2) each, m³/(s
            Pa).
        line_pressure: current gauge pressure between supply and inlets, Pa.
        drawn: amount of air P V delivered by the supply since `reset`, J.
        lost: amount of air P V that was vented or leaked since `reset`, J.
        parameters: valves and supply line.
    """

    kind = "orifice"
    state_attributes = ("_state", "_amounts", "parameters", "_energy_per_amount")
    depends_on_bend = True
    # A segment that bends away from a closed chamber compresses the air in the chamber.
    # In gen3 the pressure ratio reaches 1.6.
    max_pressure_ratio = 4.0

    def __init__(
        self,
        spec: RobotSpec,
        *,
        supply_pa: float,
        layout: str = "3/2",
        valve_delay_s: float = 0.0,
        **options: Unpack[OrificeKeywords],
    ) -> None:
        """Construct the chambers.

        Args:
            spec: robot.
            supply_pa: gauge supply pressure, Pa.
            layout: valve layout, a key of `LAYOUTS`.
            valve_delay_s: time between a command and the switching of the valve, s.
            **options: fields of `OrificeOptions`, such as flow_limit=2e-4.

        Raises:
            InputError: the layout is unknown, or a number is out of range.
        """
        valves = OrificeOptions(**options)
        critical = valves.critical_ratio
        flow_limit = valves.flow_limit
        limited = flow_limit is not None
        begins = valves.line_pressure(supply_pa)
        self._substep = valves.substep or _SUBSTEP_S * spec.scale.time
        # A closed chamber is a stiff spring, which limits the coupling step. Without a
        # flow limit, the speed of gen2 differs by 0.5 % between steps of 1 ms and
        # 0.25 ms, and the simulation diverges with 2 ms. A flow limit couples all
        # chambers, and the solution oscillates with a step of 1 ms.
        self.coupling_step_s = (0.00025 if limited else 0.001) * spec.scale.time
        self.stiffness = _closed_stiffness(spec, supply_pa)
        nominal = conductances(spec, critical)
        self._capacity = nominal.capacity
        self._max_supply = supply_pa
        self._initial_line_pressure = begins + AMBIENT_PA
        fill, vent = self.conductances = _chamber_conductances(spec, critical)
        self.parameters = OrificeParameters(
            dead=spec.chamber.dead_volume,
            displacement=spec.chamber.displacement,
            gain=chamber_gains(spec),
            bias=spec.modules.array("bias"),
            bend_law=bend_law_of(spec),
            tau=spec.actuator.tau_mode,
            critical=critical,
            fill=REFERENCE_PA * fill,
            vent=REFERENCE_PA * vent,
            leak=np.full((spec.segments, 2), valves.leak_per_s * self._capacity),
            supply=supply_pa + AMBIENT_PA,
            max_flow=AMBIENT_PA * (1.0 if flow_limit is None else flow_limit),
            band=REGULATOR_BAND * supply_pa,
            line_volume=valves.line_volume,
            limited=limited,
        )
        self._energy_per_amount = supply_pa / (supply_pa + AMBIENT_PA)
        self._settings = valves.describe(begins) | {
            "conductance_fill_m3_per_s_pa": nominal.fill,
            "conductance_vent_m3_per_s_pa": nominal.vent,
        }
        super().__init__(spec, layout=layout, valve_delay_s=valve_delay_s)

    def reset(self) -> None:
        """Vent all chambers, close all inlets, and fill the line."""
        super().reset()
        self._state = np.zeros((self._segments, 3))
        self._fill(self.pressure, self.parameters.bias)
        # Amounts of air in the line, delivered by the supply, and lost.
        self._amounts = np.array(
            [self._initial_line_pressure * self.parameters.line_volume, 0.0, 0.0]
        )

    def _fill(self, pressure: np.ndarray, bend: np.ndarray) -> None:
        parameters = self.parameters
        for j, side in np.ndindex(pressure.shape):
            size, _ = volume(parameters.dead, parameters.displacement, bend[j], side)
            self._state[j, side] = (AMBIENT_PA + pressure[j, side]) * size

    def set_state(self, pressure: np.ndarray, bend: np.ndarray) -> None:
        """Set pressures (Pa), and set free and actual bends to equal values (rad)."""
        parameters = self.parameters
        linear = invert_bend_law(bend - self.rest_bend, parameters.bend_law)
        self.pressure = check_pressure(
            pressure, self.max_pressure_ratio * (parameters.supply - AMBIENT_PA)
        )
        self.bend = np.array(bend, dtype=float)
        self._fill(self.pressure, self.bend)
        self._state[:, 2] = linear

    def set_supply_pressure(self, supply_pa: float) -> None:
        """Set the gauge supply pressure, Pa."""
        check_supply(supply_pa, self._max_supply)
        band = REGULATOR_BAND * max(supply_pa, 1.0)
        self.parameters = self.parameters._replace(
            supply=supply_pa + AMBIENT_PA, band=band
        )
        self._energy_per_amount = supply_pa / (supply_pa + AMBIENT_PA)

    def leak(self, segment: int, side: int, per_s: float) -> None:
        """Add a permanent leak to one chamber.

        Args:
            segment: segment number, counted from 1 at the head.
            side: 0 for the + chamber, 1 for the − chamber.
            per_s: relative rate at which the pressure of the held chamber falls, 1/s.
        """
        leaks = self.parameters.leak.copy()
        leaks[segment - 1, side] = per_s * self._capacity
        self.parameters = self.parameters._replace(leak=leaks)

    @property
    def line_pressure(self) -> float:
        """Current gauge pressure between supply and inlets, Pa."""
        return float(self._amounts[LINE]) / self.parameters.line_volume - AMBIENT_PA

    @property
    def drawn(self) -> float:
        """Amount of air P V delivered by the supply since `reset`, J."""
        return float(self._amounts[DRAWN])

    @property
    def lost(self) -> float:
        """Amount of air P V that was vented or leaked since `reset`, J."""
        return float(self._amounts[LOST])

    def describe(self) -> dict[str, object]:
        """Return the settings as JSON values for the provenance of a run."""
        return super().describe() | self._settings

    def _simulate(
        self,
        schedule: Schedule,
        times: np.ndarray,
        bend: OptionalArray,
        bend_rate: OptionalArray,
    ) -> Trace:
        trace = self._empty_trace(len(times))
        segments = self._segments
        now = OrificeState(
            self._state.copy(),
            self._amounts.copy(),
            np.empty((segments, 2)),
            np.empty(segments),
        )
        actual = ActualBends(bend is not None, np.zeros(segments), np.zeros(segments))
        if bend is not None:
            actual.bend[:] = bend
            actual.rate[:] = 0.0 if bend_rate is None else bend_rate
        simulate(now, schedule, times, self._substep, actual, self.parameters, trace)
        np.multiply(
            trace.pneumatic_energy, self._energy_per_amount, out=trace.pneumatic_energy
        )
        self._state, self._amounts, self.pressure, self.bend = now
        self.pneumatic_energy = self._energy_per_amount * self.drawn
        return trace


def _closed_stiffness(spec: RobotSpec, supply_pa: float) -> float:
    """Return the stiffness k G P A/V₀ of a closed chamber at supply pressure."""
    chamber = spec.chamber
    strongest = float(chamber_gains(spec).max()) * spec.bending.stiffness
    return (
        strongest
        * (chamber.displacement / chamber.dead_volume)
        * (supply_pa + AMBIENT_PA)
    )


def _chamber_conductances(
    spec: RobotSpec, critical: float
) -> tuple[np.ndarray, np.ndarray]:
    modules = spec.modules
    actuator = spec.actuator
    # Chambers with equal parameters share their conductances.
    rows = np.stack(
        [modules.array(name).ravel() for name in ("gain", "tau_fill", "tau_vent")],
        axis=1,
    )
    kinds, kind = np.unique(rows, axis=0, return_inverse=True)
    pairs = []
    for gain, fill, vent in kinds:
        own = replace(
            actuator,
            gain=gain * actuator.gain,
            tau_fill=fill * actuator.tau_fill,
            tau_vent=vent * actuator.tau_vent,
        )
        pairs.append(conductances(replace(spec, actuator=own), critical)[:2])
    fill, vent = np.array(pairs)[kind.ravel()].T.reshape(2, spec.segments, 2)
    return fill, vent
