r"""Chambers that fill and vent with a first-order lag, solved in closed form.

The valve of a chamber has the state +1 (filling), 0 (closed) or −1 (venting). Between
two valve events, the gauge pressure of the chamber approaches an asymptote P
exponentially:

$$ p(t) = P + (p_0 - P)\,e^{-a t}. $$

Here, S is the supply pressure and λ the leak rate. A filling chamber has the rate a =
1/τ_fill + λ and the asymptote P = S/(τ_fill a). A venting chamber has a = 1/τ_vent + λ,
a closed chamber has a = λ, and the asymptote of both is 0. The linear bend x lags the
pressures with the mode time constant τ₂, and determines the free bend q:

$$ \tau_2\,\dot x + x = G\,(g^+ p^+ - g^- p^-),\qquad q = b + \varphi(x). $$

The module `chambers` defines φ, b and the gains. Nominal modules with τ_fill = τ_vent =
τ₁ satisfy Eqs. 14–15 with the corrections E1 and E2, that is, q̈ + (1/τ₁ + 1/τ₂) q̇ +
q/(τ₁τ₂) = C₀ u/(τ₁τ₂). The default valve delay is 0, because τ₂ includes the valve
switching time of 3 ms.

A valve may rapidly alternate between filling for a fraction o of the time and venting
for the remaining time. The mean pressure then approaches P = (o S/τ_fill + r)/a at the
rate a = o/τ_fill + (1 − o)/τ_vent + λ. Here, r is an additional rate of pressure change
(`relaxation_of`).

**Pneumatic energy.** The amount of air n = (p + p_a) V(q) in a filling chamber, with
the ambient pressure p_a, increases by the inflow minus the leak. A filling chamber
therefore consumes the amount Δn + λ ∫ p V dt. This amount is negative if the supply
pressure falls below the pressure of the chamber.
The increase Δn is computed exactly from the volume at the free bend. The integral is
approximated by Simpson's rule between the requested times.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, inlined, kernel_only
from srs_twin.pneumatics.base import (
    OptionalArray,
    Pneumatics,
    Trace,
    check_not_negative,
    check_supply,
)
from srs_twin.pneumatics.chambers import (
    AMBIENT_PA,
    apply_bend_law,
    bend_law_of,
    chamber_gains,
    check_pressure,
    invert_bend_law,
    volume,
)
from srs_twin.pneumatics.valves import Schedule
from srs_twin.robot.spec import RobotSpec


def relaxation_of(
    fill: np.ndarray,
    vent: np.ndarray,
    supply: np.ndarray | float,
    leak: np.ndarray | float = 0.0,
    other: np.ndarray | float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the relaxation rate a (1/s) and the asymptote P (Pa) of a pressure.

    Args:
        fill: filling rate o/τ_fill, 1/s.
        vent: venting rate (1 − o)/τ_vent, 1/s.
        supply: gauge supply pressure S, Pa.
        leak: leak rate λ, 1/s.
        other: additional rate of pressure change r, Pa/s.
    """
    rate = fill + vent + leak
    return rate, (fill * supply + other) / np.where(rate == 0.0, 1.0, rate)


def relax(
    pressure: np.ndarray, rate: np.ndarray, end: np.ndarray, time: np.ndarray | float
) -> np.ndarray:
    """Return the pressures (Pa) after exponential relaxation for a given time (s)."""
    return np.asarray(end + (pressure - end) * np.exp(-rate * time))


def lag_response(
    lagged: np.ndarray,
    pressure: np.ndarray,
    relaxation: tuple[np.ndarray, np.ndarray],
    tau: float,
    time: float | np.ndarray,
) -> np.ndarray:
    """Return the response (Pa) of a first-order lag τ₂ to relaxing pressures.

    Args:
        lagged: initial output of the lag, Pa.
        pressure: initial pressures, Pa.
        relaxation: rates and asymptotes, as returned by `relaxation_of`.
        tau: time constant τ₂, s.
        time: elapsed time, s.
    """
    rate, end = relaxation
    mode = (
        np.exp(-time / tau) if isinstance(time, np.ndarray) else math.exp(-time / tau)
    )
    gap = 1 - rate * tau
    same = np.abs(gap) < _SAME
    response = (
        (pressure - end) * (np.exp(-rate * time) - mode) / np.where(same, 1.0, gap)
    )
    # This is the limit of the response for 1/a → τ₂.
    limit = (pressure - end) * time / tau * mode
    return np.asarray(end + np.where(same, limit, response) + (lagged - end) * mode)


class Relaxation(NamedTuple):
    """Chamber parameters, and decay factors for a time t without valve events.

    Chambers with equal time constants form one kind. The columns of arrays with shape
    (kinds, 3) correspond to the valve states −1, 0 and +1.

    Attributes:
        kinds: index of the kind of each chamber, shape (segments, 2).
        rates, asymptotes: relaxation rate a (1/s) and asymptote P (Pa), shape
            (kinds, 3).
        decay: factor e^{−at} by which the deviation p − P decreases in a time t, shape
            (kinds, 3).
        lag: response of x after the time t to an initial deviation p − P, divided by
            this deviation and by the gain, shape (kinds, 3).
        mode: factor e^{−t/τ₂} by which the initial x decreases, shape (1,).
        tau, leak: mode time constant τ₂ (s) and leak rate λ (1/s).
        damping_time: ratio of damping to stiffness of a segment, c/k, s.
        gain: gain of each chamber, shape (segments, 2), rad/Pa.
        bias: rest bends, shape (segments,), rad.
        bend_limit, onset_fraction, dead_zone, dead_zone_transition: fields of
            `BendLaw`.
        dead_volume, displacement: dead volume V₀ (m³) and displacement A (m³/rad) of a
            chamber.
        worth: ratio of the pneumatic energy to the amount of consumed air,
            dimensionless.
    """

    kinds: np.ndarray
    rates: np.ndarray
    asymptotes: np.ndarray
    decay: np.ndarray
    lag: np.ndarray
    mode: np.ndarray
    tau: float
    leak: float
    damping_time: float
    gain: np.ndarray
    bias: np.ndarray
    bend_limit: float
    onset_fraction: float
    dead_zone: float
    dead_zone_transition: float
    dead_volume: float
    displacement: float
    worth: float = 0.0


class _Chambers(NamedTuple):
    """Gauge pressures (Pa), linear bends (rad) and free bends (rad) of all segments."""

    pressure: np.ndarray
    linear: np.ndarray
    bend: np.ndarray


_SAME = 1e-6
"""Value of |1 − a τ₂| below which 1/a and τ₂ are treated as equal."""


class LagChambers(Pneumatics):
    """Base class for planar and spatial chambers with a first-order lag."""

    kind = "lag"

    def __init__(
        self,
        spec: RobotSpec,
        *,
        supply_pa: float,
        layout: str = "3/2",
        leak_per_s: float = 0.0,
        valve_delay_s: float = 0.0,
    ) -> None:
        """Construct the chambers.

        Args:
            spec: robot specification.
            supply_pa: gauge supply pressure, Pa.
            layout: valve layout, a key of `LAYOUTS`.
            leak_per_s: rate λ at which the gauge pressure of a closed chamber decays,
                1/s.
            valve_delay_s: time between a command and the switching of the valve, s.

        Raises:
            InputError: the layout is unknown, or the leak rate or the delay is
                negative.
        """
        check_not_negative(leak_per_s=leak_per_s)
        self._leak = leak_per_s
        self._max_supply = supply_pa
        self._prepare(
            spec,
            spec.actuator.tau_fill * spec.modules.array("tau_fill"),
            spec.actuator.tau_vent * spec.modules.array("tau_vent"),
        )
        self.set_supply_pressure(supply_pa)
        super().__init__(spec, layout=layout, valve_delay_s=valve_delay_s)

    @abstractmethod
    def _prepare(
        self, spec: RobotSpec, tau_fill: np.ndarray, tau_vent: np.ndarray
    ) -> None:
        """Prepare work arrays from time constants (s), shape (segments, chambers)."""

    def describe(self) -> dict[str, object]:
        """Return the settings that are recorded with a run, as JSON values."""
        return super().describe() | {"leak_per_s": self._leak}


class LagPneumatics(LagChambers):
    """First-order lag chambers of a planar robot."""

    state_attributes = ("_linear", "_asymptote", "_energy_per_amount")

    def _prepare(
        self, spec: RobotSpec, tau_fill: np.ndarray, tau_vent: np.ndarray
    ) -> None:
        # Each exponential is evaluated only once for all chambers with equal time
        # constants.
        kinds, kind = np.unique(
            np.stack([tau_fill.ravel(), tau_vent.ravel()]), axis=1, return_inverse=True
        )
        rates = (
            np.stack([1 / kinds[1], np.zeros_like(kinds[0]), 1 / kinds[0]], axis=1)
            + self._leak
        )
        self._tau_fill = kinds[0]
        self._bend_law = bend_law_of(spec)
        self._relaxation = Relaxation(
            kinds=kind.reshape(tau_fill.shape),
            rates=rates,
            asymptotes=np.zeros_like(rates),
            decay=np.zeros_like(rates),
            lag=np.zeros_like(rates),
            mode=np.zeros(1),
            tau=spec.actuator.tau_mode,
            leak=self._leak,
            damping_time=spec.bending.damping_time,
            gain=chamber_gains(spec),
            bias=spec.modules.array("bias"),
            **self._bend_law._asdict(),
            dead_volume=spec.chamber.dead_volume,
            displacement=spec.chamber.displacement,
        )

    @property
    def _asymptote(self) -> np.ndarray:
        return self._relaxation.asymptotes

    @_asymptote.setter
    def _asymptote(self, asymptotes: np.ndarray) -> None:
        self._relaxation.asymptotes[:] = asymptotes

    def reset(self) -> None:
        """Vent all chambers to ambient pressure and close all inlets."""
        super().reset()
        self._linear = np.zeros(self._segments)

    def set_state(self, pressure: np.ndarray, bend: np.ndarray) -> None:
        """Set the pressures (Pa) and the free bends (rad)."""
        pressure = check_pressure(pressure, self._max_supply)
        self._linear = invert_bend_law(bend - self.rest_bend, self._bend_law)
        self.pressure = pressure
        self.bend = np.array(bend, dtype=float)

    def set_supply_pressure(self, supply_pa: float) -> None:
        """Set the gauge supply pressure (Pa), which takes effect immediately."""
        check_supply(supply_pa, self._max_supply)
        # A leak lowers the equilibrium pressure below the supply pressure.
        filling = supply_pa / self._tau_fill / self._relaxation.rates[:, 2]
        self._relaxation.asymptotes[:, 2] = filling
        self._energy_per_amount = supply_pa / (supply_pa + AMBIENT_PA)

    def relaxation(self, time: float) -> Relaxation:
        """Return the `Relaxation` for a time (s), with one kind per chamber."""
        kinds = self._relaxation.kinds
        rates = self._relaxation.rates[kinds.ravel()]
        relaxation = self._relaxation._replace(
            kinds=np.arange(kinds.size).reshape(kinds.shape),
            rates=rates,
            asymptotes=self._relaxation.asymptotes[kinds.ravel()],
            decay=np.empty_like(rates),
            lag=np.empty_like(rates),
            mode=np.empty(1),
            worth=self._energy_per_amount,
        )
        _fill_decay(time, relaxation)
        return relaxation

    def _simulate(
        self,
        schedule: Schedule,
        times: np.ndarray,
        bend: OptionalArray,
        bend_rate: OptionalArray,
    ) -> Trace:
        trace = self._empty_trace(len(times))
        free = np.empty(self._segments)
        now = _Chambers(self.pressure.copy(), self._linear.copy(), free)
        drawn = _fill_trace(now, schedule, times, self._relaxation, trace)
        energy = trace.pneumatic_energy
        energy *= self._energy_per_amount
        energy += self.pneumatic_energy
        self.pressure, self._linear, self.bend = now
        self.pneumatic_energy = self.pneumatic_energy + self._energy_per_amount * drawn
        return trace


@compiled
def _fill_trace(now, schedule, times, relaxation, trace):  # type: ignore[no-untyped-def]
    """Simulate a schedule, fill the trace, and return the amount of consumed air, J.

    The field `pneumatic_energy` of the trace receives the amount of air that has been
    consumed since the start of the schedule, J.
    """
    starts = schedule.starts
    row = 0
    drawn = 0.0
    for run in range(starts.shape[0]):
        state = schedule.states[run]
        begin = starts[run]
        is_last = run + 1 == starts.shape[0]
        stop = schedule.span if is_last else starts[run + 1]
        # Only filling chambers consume air. The consumption is the leaked air plus the
        # increase in the amount of air in the chamber.
        content_before = _filling_content(state, now, relaxation)
        leaked = last = 0.0
        while True:
            # All trace rows before the next valve event are computed first. The state
            # at this event is computed last and becomes the initial state of the next
            # interval.
            requested = row < times.shape[0] and (times[row] <= stop or is_last)
            t = (times[row] if requested else stop) - begin
            if relaxation.leak > 0.0:
                leaked += _leaked(last, t, state, now, relaxation)
                last = t
            _fill_decay(t, relaxation)
            content = 0.0
            for j in range(now.bend.shape[0]):
                plus, minus, x = advance_segment(
                    state[j], j, now.pressure[j], now.linear[j], relaxation
                )
                free, derivative, curve = apply_bend_law(x, relaxation)
                free += relaxation.bias[j]
                content += filling_content(
                    state[j], plus, minus, free, relaxation, AMBIENT_PA
                )
                if not requested:
                    now.pressure[j, 0] = plus
                    now.pressure[j, 1] = minus
                    now.linear[j] = x
                    now.bend[j] = free
                    continue
                rise = _drive_rate(state[j], j, plus, minus, relaxation)
                speed = (
                    relaxation.gain[j, 0] * plus - relaxation.gain[j, 1] * minus - x
                ) / relaxation.tau
                trace.pressure[row, j, 0] = plus
                trace.pressure[row, j, 1] = minus
                trace.bend[row, j] = free
                trace.bend_rate[row, j] = derivative * speed
                trace.bend_acceleration[row, j] = (
                    derivative * (rise - speed) / relaxation.tau + curve * speed * speed
                )
                trace.valves[row, j, 0] = state[j, 0]
                trace.valves[row, j, 1] = state[j, 1]
            amount = drawn + leaked + content - content_before
            if not requested:
                drawn = amount
                break
            trace.pneumatic_energy[row] = amount
            row += 1
    return drawn


@inlined
def _filling_content(state, now, relaxation):  # type: ignore[no-untyped-def]
    content = 0.0
    for j in range(now.linear.shape[0]):
        free = relaxation.bias[j] + apply_bend_law(now.linear[j], relaxation)[0]
        content += filling_content(
            state[j],
            now.pressure[j, 0],
            now.pressure[j, 1],
            free,
            relaxation,
            AMBIENT_PA,
        )
    return content


@kernel_only
def _drive_rate(state, j, plus, minus, relaxation):  # type: ignore[no-untyped-def]
    first = relaxation.kinds[j, 0]
    second = relaxation.kinds[j, 1]
    up = state[0] + 1
    down = state[1] + 1
    rise = (
        relaxation.gain[j, 0]
        * relaxation.rates[first, up]
        * (relaxation.asymptotes[first, up] - plus)
    )
    fall = relaxation.rates[second, down] * (
        relaxation.asymptotes[second, down] - minus
    )
    return rise - relaxation.gain[j, 1] * fall


@kernel_only
def _leaked(last, t, state, now, relaxation):  # type: ignore[no-untyped-def]
    """Return the amount of air that leaks from the filling chambers, λ ∫ p V dt, J.

    Simpson's rule is applied to the interval from `last` to `t`. Both times are
    measured from the latest valve event, s.
    """
    leaked = 0.0
    for at, weight in ((last, 1 / 6), (0.5 * (last + t), 4 / 6), (t, 1 / 6)):
        _fill_decay(at, relaxation)
        for j in range(now.linear.shape[0]):
            plus, minus, x = advance_segment(
                state[j], j, now.pressure[j], now.linear[j], relaxation
            )
            free = relaxation.bias[j] + apply_bend_law(x, relaxation)[0]
            content = filling_content(state[j], plus, minus, free, relaxation, 0.0)
            leaked += relaxation.leak * (t - last) * weight * content
    return leaked


@compiled
def _fill_decay(t, relaxation):  # type: ignore[no-untyped-def]
    mode = math.exp(-t / relaxation.tau)
    relaxation.mode[0] = mode
    for kind in range(relaxation.rates.shape[0]):
        for s in range(3):
            rate = relaxation.rates[kind, s]
            decay = math.exp(-rate * t)
            relaxation.decay[kind, s] = decay
            relaxation.lag[kind, s] = _exponential_response(
                rate, relaxation.tau, t, decay, mode
            )


@kernel_only
def advance_segment(state, j, pressure, linear, relaxation):  # type: ignore[no-untyped-def]
    """Return the pressures (Pa) and the linear bend (rad) of a segment after a time t.

    The valve states are constant during this time.

    Args:
        state: valve states, shape (2,).
        j: segment index, counted from 0.
        pressure: initial gauge pressures, shape (2,), Pa.
        linear: initial linear bend, rad.
        relaxation: `Relaxation` with decay factors for the time t.
    """
    first = relaxation.kinds[j, 0]
    second = relaxation.kinds[j, 1]
    up = state[0] + 1
    down = state[1] + 1
    mode = relaxation.mode[0]
    target_plus = relaxation.asymptotes[first, up]
    target_minus = relaxation.asymptotes[second, down]
    deviation_plus = pressure[0] - target_plus
    deviation_minus = pressure[1] - target_minus
    # This is the response of x to both pressures if x starts at 0.
    lagged = relaxation.gain[j, 0] * (
        target_plus * (1.0 - mode) + deviation_plus * relaxation.lag[first, up]
    )
    lagged -= relaxation.gain[j, 1] * (
        target_minus * (1.0 - mode) + deviation_minus * relaxation.lag[second, down]
    )
    return (
        target_plus + deviation_plus * relaxation.decay[first, up],
        target_minus + deviation_minus * relaxation.decay[second, down],
        linear * mode + lagged,
    )


@kernel_only
def filling_content(state, plus, minus, bend, relaxation, ambient):  # type: ignore[no-untyped-def]
    """Return the sum of (p + ambient) V over the filling chambers of a segment, J.

    Args:
        state: valve states, shape (2,).
        plus: gauge pressure of the + chamber, Pa.
        minus: gauge pressure of the − chamber, Pa.
        bend: bend q of the segment, rad.
        relaxation: chamber parameters (`Relaxation`).
        ambient: pressure that is added to the gauge pressures, Pa.
    """
    total = float(0.0)
    pressure = float(plus)
    for side in range(2):
        if state[side] == 1:
            size, _ = volume(
                relaxation.dead_volume, relaxation.displacement, bend, side
            )
            total += (pressure + ambient) * size
        pressure = float(minus)
    return total


@kernel_only
def _exponential_response(rate, tau, t, decay, mode):  # type: ignore[no-untyped-def]
    gap = 1 - rate * tau
    if abs(gap) < _SAME:
        return t / tau * mode
    return (decay - mode) / gap
