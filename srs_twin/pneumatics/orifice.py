r"""Isothermal chambers with bend-dependent volumes and valve flows (ISO 6358).

One supply line feeds all chambers. The unknowns are the amount of air n = P V in each
chamber, the linear bend x of each segment, and the amount of air in the line between
the supply and the inlets. The chambers and segments satisfy these equations:

$$ \dot n = \dot n_{in} - \dot n_{out} - \Lambda\,(P - P_a),\qquad P = n / V(q),\qquad
\tau_2\,\dot x + x = G\,(g^+ p^+ - g^- p^-),\qquad q_f = b + \varphi(x). $$

The module `chambers` defines φ, b, V(q) and the gains g, and the module `flow` defines
the flows ṅ. The valve conductances are computed from the time constants of the robot
(`flow.conductances`). The leak conductance Λ is chosen so that the pressure in a closed
nominal chamber falls at the relative rate `leak_per_s` at the working point.

Without a flow limit, the line is always at the supply pressure. With a flow limit, a
compressor with a regulator feeds the line. The limit is the maximum flow from the
compressor, measured at ambient pressure. As the line pressure rises through the last
hundredth of the gauge supply pressure, the flow decreases linearly to 0. All inlets
share the line, so a limited flow slows down all segments.

**Integration.** All chambers are integrated together by SDIRK2, an L-stable method of
second order with two stages. The stage equations are solved by Newton's method. A step
ends at every valve event. Within a step, states are interpolated by cubic Hermite
polynomials.
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
"""Estimated critical pressure ratio b of a small solenoid valve, dimensionless.

Such valves have critical pressure ratios between 0.2 and 0.5.
"""

MAX_CRITICAL_RATIO = 0.8
"""Maximum critical pressure ratio, dimensionless.

With a larger ratio, the flow could be choked at the working point from which the
conductance C is computed (`flow.conductances`).
"""

LINE_VOLUME = 50e-6
"""Estimated total volume of the compressor outlet, the tubes and the manifold, m³."""

_SUBSTEP_S = 5e-4

REGULATOR_BAND = 0.01
"""Pressure range over which the regulator closes, as a fraction of the gauge supply
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
    """Options for the valves and the supply line of orifice chambers.

    Attributes:
        critical_ratio: critical pressure ratio b of all valves, dimensionless.
        flow_limit: maximum volume flow from the supply, measured at ambient pressure,
            m³/s, or None for unlimited flow.
        line_volume: volume of the line between the supply and the inlets, m³, used only
            with a flow limit.
        initial_line_pressure: initial gauge pressure in the line, Pa, or None for the
            supply pressure.
        leak_per_s: relative rate at which the pressure in a closed chamber falls, 1/s.
        substep: maximum integration step, s, or None for 0.5 ms times the robot's time
            unit (`robot.scale`).
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
        """Return the settings that are recorded with a run, as JSON values."""
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
    """Planar chambers that fill and vent through orifices.

    Attributes:
        conductances: sonic conductances of the inlets and of the outlets, shape
            (segments, 2) each, m³/(s Pa).
        parameters: parameters of the chambers, the valves and the supply line.
    """

    kind = "orifice"
    state_attributes = (
        "_state",
        "_amounts",
        "parameters",
        "_energy_per_amount",
        "_energy_offset",
    )
    depends_on_bend = True
    # A closed chamber is compressed when the opposite chamber bends the segment. In
    # gen3, the pressure ratio then reaches 1.6.
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
            spec: robot specification.
            supply_pa: gauge supply pressure, Pa.
            layout: valve layout, a key of `LAYOUTS`.
            valve_delay_s: time between a command and the switching of the valve, s.
            **options: fields of `OrificeOptions`, such as flow_limit=2e-4.

        Raises:
            InputError: the layout is unknown, or an option is out of range.
        """
        valves = OrificeOptions(**options)
        critical = valves.critical_ratio
        flow_limit = valves.flow_limit
        limited = flow_limit is not None
        begins = valves.line_pressure(supply_pa)
        self._substep = valves.substep or _SUBSTEP_S * spec.scale.time
        # A closed chamber acts as a stiff spring, which limits the coupling step.
        # Without a flow limit, the speed of gen2 differs by 0.5 % between coupling
        # steps of 1 ms and 0.25 ms, and the simulation diverges with a step of 2 ms.
        # A flow limit couples all chambers, so that the solution oscillates with a
        # step of 1 ms.
        self.coupling_step_s = (0.00025 if limited else 0.001) * spec.scale.time
        self.stiffness = _closed_stiffness(spec, supply_pa)
        if limited:
            self.line_energy = supply_pa * valves.line_volume
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
        """Vent all chambers, close all inlets, and set the initial line pressure."""
        super().reset()
        self._state = np.zeros((self._segments, 3))
        self._energy_offset = 0.0
        self._fill(self.pressure, self.parameters.bias)
        # The entries are the air in the line, the delivered air and the lost air.
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
        before = self._energy_per_amount
        self._energy_per_amount = supply_pa / (supply_pa + AMBIENT_PA)
        # The air that was drawn before keeps its energy.
        self._energy_offset += (before - self._energy_per_amount) * self.drawn

    def leak(self, segment: int, side: int, per_s: float) -> None:
        """Set the leak of one chamber. The leak persists after `reset`.

        Args:
            segment: segment number, counted from 1 at the head.
            side: 0 for the + chamber, 1 for the − chamber.
            per_s: relative rate at which the pressure in the closed chamber falls, 1/s.
        """
        leaks = self.parameters.leak.copy()
        leaks[segment - 1, side] = per_s * self._capacity
        self.parameters = self.parameters._replace(leak=leaks)

    @property
    def line_pressure(self) -> float:
        """Current gauge pressure in the supply line, Pa."""
        return float(self._amounts[LINE]) / self.parameters.line_volume - AMBIENT_PA

    @property
    def drawn(self) -> float:
        """Amount of air P V delivered by the supply since `reset`, J."""
        return float(self._amounts[DRAWN])

    @property
    def lost(self) -> float:
        """Amount of air P V vented or leaked since `reset`, J."""
        return float(self._amounts[LOST])

    def describe(self) -> dict[str, object]:
        """Return the settings that are recorded with a run, as JSON values."""
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
        energy = trace.pneumatic_energy
        energy *= self._energy_per_amount
        energy += self._energy_offset
        self._state, self._amounts, self.pressure, self.bend = now
        energy_drawn = self._energy_per_amount * self.drawn
        self.pneumatic_energy = energy_drawn + self._energy_offset
        return trace


def _closed_stiffness(spec: RobotSpec, supply_pa: float) -> float:
    """Return the stiffness k G P A/V₀ of a closed chamber (N·m/rad).

    P is the absolute supply pressure.
    """
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
    # The conductances are computed once for all chambers with equal parameters.
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
