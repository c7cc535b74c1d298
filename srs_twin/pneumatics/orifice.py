r"""OrificePneumatics: valves as orifices (ISO 6358), isothermal chambers that grow as they bend, one supply.

Unknown are the amounts of air n = P V of every chamber, the free bends, and the line before the inlets:

$$ \dot n = \dot n_{in} - \dot n_{out} - \Lambda\,(P - P_a),\qquad P = n / V(q),\qquad
\tau_2\,\dot x + x = G\,(g^+ p^+ - g^- p^-),\qquad q_f = b + \varphi(x). $$

φ, b and the gains g are those of `chambers.py`, which has V(q) as well, the flows are those of
`flow.py`. Conductances follow from the robot's τ₁ (`flow.conductances`); Λ is such that a held chamber of a
nominal module at the working point loses its pressure at the rate
`leak_per_s`. Without a flow limit the line holds the supply's pressure. With one, a compressor with a
regulator feeds the line's volume: at most the limit, measured at ambient, and less within the last
hundredth of its pressure; all inlets share the line, so all segments starve together.

Integration: SDIRK2 (two stages, second order, L-stable) with Newton's method over all chambers, in sub-steps
of its own that end on valve events; in between, cubics through values and slopes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.errors import InputError
from srs_twin.pneumatics.base import Known, Pneumatics, Trace, not_negative
from srs_twin.pneumatics.chambers import AMBIENT_PA, bend_law, gains, reached, unbent, volume
from srs_twin.pneumatics.flow import REFERENCE_PA, conductances
from srs_twin.pneumatics.orifice_kernels import Plumbing, follow
from srs_twin.pneumatics.valves import Schedule
from srs_twin.robot.spec import RobotSpec

CRITICAL_RATIO = 0.3
"""b of a small solenoid valve, estimated; such valves have 0.2 to 0.5."""

MOST_CRITICAL = 0.8
"""Above it the flow at a working point might be choked, and τ₁ would not determine C."""

LINE_VOLUME = 50e-6
"""m³ between a limited supply and the inlets, estimated: a compressor's outlet, tubes and manifold."""

REGULATED = 0.01
"""Share of the supply's gauge pressure over which its regulator closes."""


class OrificePneumatics(Pneumatics):
    """Chambers behind orifices (module docstring).

    Attributes:
        conductances: of the inlets and of the outlets, each of shape (segments, 2), m³/(s Pa).
        line_pressure: between supply and inlets now, gauge, Pa.
        drawn: amount of air drawn from the supply since `reset`, P V, J.
        lost: amount vented and leaked since `reset`, P V, J.
    """

    kind = "orifice"
    state_attributes = ("_state", "_books", "_plumbing", "_worth")
    feels_bend = True
    # A full chamber that its opposite squeezes: 1.6 times was seen in gen 3.
    overshoot = 4.0

    def __init__(
        self,
        spec: RobotSpec,
        *,
        supply_pa: float,
        layout: str = "3/2",
        critical_ratio: float = CRITICAL_RATIO,
        flow_limit: float | None = None,
        line_volume: float = LINE_VOLUME,
        line_begins: float | None = None,
        leak_per_s: float = 0.0,
        valve_delay_s: float = 0.0,
        substep: float = 5e-4,
    ) -> None:
        """Make the chambers.

        Args:
            spec: the robot.
            supply_pa: supply pressure, gauge, Pa.
            layout: valve layout, one of `LAYOUTS`.
            critical_ratio: b of all valves.
            flow_limit: most that the supply delivers, measured at ambient pressure, m³/s; None: no limit.
            line_volume: of the line between supply and inlets, m³; felt with a flow limit only.
            line_begins: pressure in the line at first, gauge, Pa; default the supply's.
            leak_per_s: rate at which a held pressure falls, as a share of itself, 1/s.
            valve_delay_s: how much later than commanded a valve switches, s.
            substep: longest step of the integrator, s.

        Raises:
            InputError: an unknown layout, or a number out of range.
        """
        not_negative(leak_per_s=leak_per_s)
        limited = flow_limit is not None
        # A closed chamber is a stiff spring. With air to spare gen 2 runs alike at 1 and at 0.25 ms, within
        # 0.5 % in speed, and diverges at 2 ms; a starved line couples all chambers, and 1 ms swings.
        self.felt_s = 0.00025 if limited else 0.001
        most = 1.0 if flow_limit is None else flow_limit
        given = {"flow_limit": most, "line_volume": line_volume, "substep": substep}
        for name, value in given.items():
            check_positive(name, value)
        if not 0 <= critical_ratio <= MOST_CRITICAL:
            raise InputError(
                f"critical_ratio {critical_ratio!r} is not allowed; it must be 0 to {MOST_CRITICAL}"
            )
        *nominal, capacity = conductances(spec, critical_ratio)
        self._capacity, self._largest = capacity, supply_pa
        begins = supply_pa if line_begins is None else line_begins
        if not 0 <= begins <= supply_pa:
            raise InputError(
                f"line_begins {begins!r} Pa is not allowed; it must be 0 to the supply's {supply_pa:g}"
            )
        chamber, strongest = spec.chamber, float(gains(spec).max()) * spec.bending.stiffness
        grows = chamber.displacement / chamber.dead_volume
        self.stiffness = strongest * grows * (supply_pa + AMBIENT_PA)
        self._line_begins = begins + AMBIENT_PA
        fill, vent = self.conductances = _each_chambers(spec, critical_ratio)
        self._plumbing = Plumbing(
            dead=spec.chamber.dead_volume,
            displacement=spec.chamber.displacement,
            gain=gains(spec),
            bias=spec.modules.array("bias"),
            law=bend_law(spec),
            tau=spec.actuator.tau_mode,
            critical=critical_ratio,
            fill=REFERENCE_PA * fill,
            vent=REFERENCE_PA * vent,
            leak=np.full((spec.segments, 2), leak_per_s * capacity),
            supply=supply_pa + AMBIENT_PA,
            most=AMBIENT_PA * most,
            band=REGULATED * supply_pa,
            line=line_volume,
            limited=limited,
        )
        self._substep, self._worth = substep, supply_pa / (supply_pa + AMBIENT_PA)
        self._settings = {
            "critical_ratio": critical_ratio,
            "flow_limit_l_per_min": None if flow_limit is None else flow_limit * 60_000,
            "line_volume_ml": line_volume * 1e6 if limited else None,
            "line_begins_kpa": begins / 1000 if limited else None,
            "leak_per_s": leak_per_s,
            "conductance_fill_m3_per_s_pa": nominal[0],
            "conductance_vent_m3_per_s_pa": nominal[1],
        }
        super().__init__(spec, layout=layout, valve_delay_s=valve_delay_s)

    def reset(self) -> None:
        """Empty all chambers, close all inlets, fill the line."""
        super().reset()
        air = self._plumbing
        self._state = np.zeros((self._segments, 3))
        for j in range(self._segments):
            for side in range(2):
                size, _ = volume(air.dead, air.displacement, air.bias[j], side)
                self._state[j, side] = AMBIENT_PA * size
        # Amount in the line, drawn, lost.
        self._books = np.array([self._line_begins * air.line, 0.0, 0.0])

    def place(self, pressure: np.ndarray, bend: np.ndarray) -> None:
        """See `Pneumatics.place`; the bends are the segments' own as well."""
        air = self._plumbing
        linear = unbent(bend - self.rest_bend, air.law)
        self.pressure = reached(pressure, self.overshoot * (air.supply - AMBIENT_PA))
        self.bend = np.array(bend, dtype=float)
        for j in range(self._segments):
            for side in range(2):
                size, _ = volume(air.dead, air.displacement, bend[j], side)
                self._state[j, side] = (AMBIENT_PA + self.pressure[j, side]) * size
        self._state[:, 2] = linear

    def regulate(self, supply_pa: float) -> None:
        """See `Pneumatics.regulate`."""
        if not 0 <= supply_pa <= self._largest:
            raise InputError(
                f"supply pressure {supply_pa!r} Pa is not allowed; it must be 0 to {self._largest:g} Pa, "
                "which these chambers were made for"
            )
        band = REGULATED * max(supply_pa, 1.0)
        self._plumbing = self._plumbing._replace(supply=supply_pa + AMBIENT_PA, band=band)
        self._worth = supply_pa / (supply_pa + AMBIENT_PA)

    def leak(self, segment: int, side: int, per_s: float) -> None:
        """Let one chamber leak from now on.

        Args:
            segment: from 1, at the head.
            side: 0 for +, 1 for −.
            per_s: rate at which its pressure falls while it is held, as a share of itself, 1/s.
        """
        leaks = self._plumbing.leak.copy()
        leaks[segment - 1, side] = per_s * self._capacity
        self._plumbing = self._plumbing._replace(leak=leaks)

    @property
    def line_pressure(self) -> float:
        """Gauge pressure between supply and inlets now, Pa."""
        return float(self._books[0]) / self._plumbing.line - AMBIENT_PA

    @property
    def drawn(self) -> float:
        """Amount of air drawn from the supply since `reset`, P V, J."""
        return float(self._books[1])

    @property
    def lost(self) -> float:
        """Amount of air vented and leaked since `reset`, P V, J."""
        return float(self._books[2])

    def describe(self) -> dict[str, Any]:
        """See `Pneumatics.describe`."""
        return super().describe() | self._settings

    def _follow(self, schedule: Schedule, times: np.ndarray, bend: Known, bend_rate: Known) -> Trace:
        trace = Trace.empty(len(times), self._segments)
        state, books = self._state.copy(), self._books.copy()
        actual = np.zeros((2, self._segments))
        if bend is not None:
            actual[0] = bend
            actual[1] = 0.0 if bend_rate is None else bend_rate
        end = np.empty((self._segments, 2)), np.empty(self._segments)
        given = bend is not None
        follow(state, books, schedule, times, self._substep, given, actual, self._plumbing, end, trace)
        np.multiply(trace.air, self._worth, out=trace.air)
        self._state, self._books = state, books
        self.pressure, self.bend = end
        self.air = self._worth * float(books[1])
        return trace


def _each_chambers(spec: RobotSpec, critical: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the conductances of each chamber's inlet and outlet, shape (segments, 2), m³/(s Pa)."""
    modules, actuator = spec.modules, spec.actuator
    rows = np.stack([modules.array(name).ravel() for name in ("gain", "tau_fill", "tau_vent")], axis=1)
    known, which = np.unique(rows, axis=0, return_inverse=True)
    found = []
    for gain, fill, vent in known:
        own = {"gain": gain * actuator.gain}
        own |= {"tau_fill": fill * actuator.tau_fill, "tau_vent": vent * actuator.tau_vent}
        found.append(conductances(replace(spec, actuator=replace(actuator, **own)), critical)[:2])
    fill, vent = np.array(found)[which.ravel()].T.reshape(2, spec.segments, 2)
    return fill, vent
