r"""Chambers that fill and vent with a first-order lag, in closed form.

A valve state of +1 fills the chamber from the supply, −1 vents it, and 0 holds it.
Between valve events the gauge pressure of each chamber relaxes exponentially,

$$ p(t) = P + (p_0 - P)\,e^{-a t}, $$

to the asymptote P with the rate a, which is 1/τ₁ plus the leak rate λ. The linear bend
x of a segment without load follows the pressures with the mode time constant τ₂,

$$ \tau_2\,\dot x + x = G\,(g^+ p^+ - g^- p^-),\qquad q = b + \varphi(x), $$

with φ, b and the gains of `chambers`. Nominal modules with τ_fill = τ_vent = τ₁ obey
Eq. 14–15 as corrected by E1 and E2: q̈ + (1/τ₁ + 1/τ₂) q̇ + q/(τ₁τ₂) = C₀ u/(τ₁τ₂). The
switching time of a valve, 3 ms, is part of τ₂; a further valve delay is 0 by default.

A valve that fills for the fraction o of the time and vents for the rest relaxes the
chamber at the rate a = o/τ_fill + (1 − o)/τ_vent + λ towards P = (o S/τ_fill + r)/a,
with the supply pressure S and an additional rate of change r (`relaxation_of`, which
takes arrays of any shape).

**Pneumatic energy.** The content n = P V(q) of a filling chamber increases by the
inflow less the leak, so that a fill draws Δn + λ ∫ p V dt. Δn is exact, with V at the
free bend; the integral of the leak is evaluated by Simpson's rule between the requested
times.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, kernel_only
from srs_twin.pneumatics.base import (
    OptionalArray,
    Pneumatics,
    Trace,
    check_not_negative,
    check_supply,
)
from srs_twin.pneumatics.chambers import (
    AMBIENT_PA,
    BendLaw,
    apply_bend_law,
    bend_law,
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
    """Return the relaxation rate a (1/s) of pressures, and their asymptote P (Pa).

    Args:
        fill: o/τ_fill, any shape, 1/s.
        vent: (1 − o)/τ_vent, 1/s.
        supply: S, gauge, Pa.
        leak: λ, 1/s.
        other: r, Pa/s.
    """
    rate = fill + vent + leak
    return rate, (fill * supply + other) / np.where(rate == 0.0, 1.0, rate)


def relaxed(
    pressure: np.ndarray, rate: np.ndarray, end: np.ndarray, time: np.ndarray | float
) -> np.ndarray:
    """Return the pressures after a time (s), Pa."""
    return np.asarray(end + (pressure - end) * np.exp(-rate * time))


def followed(
    lagged: np.ndarray,
    pressure: np.ndarray,
    relaxation: tuple[np.ndarray, np.ndarray],
    tau: float,
    time: float | np.ndarray,
) -> np.ndarray:
    """Return the state of a lag τ₂ behind pressures after a time (s).

    Args:
        lagged: initial state of the lag, Pa.
        pressure: initial pressures, Pa.
        relaxation: rates and asymptotes, as returned by `relaxation_of`.
        tau: τ₂, s.
        time: s.
    """
    rate, end = relaxation
    mode = (
        np.exp(-time / tau) if isinstance(time, np.ndarray) else math.exp(-time / tau)
    )
    gap = 1 - rate * tau
    gap = np.where(np.abs(gap) < _SAME, _SAME, gap)
    return np.asarray(
        end
        + (pressure - end) * (np.exp(-rate * time) - mode) / gap
        + (lagged - end) * mode
    )


class Relaxation(NamedTuple):
    """Exact propagation of the chambers over a time without valve events, for the device engine.

    Kinds group chambers with equal time constants. Factors by kind and valve state have
    the shape (kinds, 3), with the columns −1, 0, +1.

    Attributes:
        kinds: kind of each chamber, shape (segments, 2).
        asymptotes: P by kind and valve state, Pa.
        decay: factor e^{−at} of the deviation p − P, by kind and valve state, 1.
        lag: response of x to this deviation, per gain, by kind and valve state, 1.
        mode: factor e^{−t/τ₂} of x, 1.
        tau: τ₂, s.
        damping_time: c/k of a segment, s.
        gain: gain of each chamber, shape (segments, 2), rad/Pa.
        bias: rest bends, shape (segments,), rad.
        law: a `BendLaw`.
        space: dead volume V₀ (m³) and A (m³/rad) of a chamber.
        worth: pneumatic energy per amount of air drawn, 1.
    """

    kinds: np.ndarray
    asymptotes: np.ndarray
    decay: np.ndarray
    lag: np.ndarray
    mode: float
    tau: float
    damping_time: float
    gain: np.ndarray
    bias: np.ndarray
    law: BendLaw
    space: tuple[float, float]
    worth: float


_SAME = 1e-6
"""Value of 1 − a τ₂ below which the two time constants count as equal."""


class LagChambers(Pneumatics):
    """Common settings of chambers with a first-order lag."""

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
            spec: the robot.
            supply_pa: supply pressure, gauge, Pa.
            layout: valve layout, one of `LAYOUTS`.
            leak_per_s: leak rate λ, the relative rate at which a held pressure falls,
                1/s.
            valve_delay_s: time from a command until the valve switches, s.

        Raises:
            InputError: the layout is unknown, or leak or delay are negative.
        """
        check_not_negative(leak_per_s=leak_per_s)
        self._leak = leak_per_s
        self._max_supply = supply_pa
        tau_fill, tau_vent = (
            spec.modules.array(name) for name in ("tau_fill", "tau_vent")
        )
        self._prepare(
            spec, spec.actuator.tau_fill * tau_fill, spec.actuator.tau_vent * tau_vent
        )
        self.set_supply_pressure(supply_pa)
        super().__init__(spec, layout=layout, valve_delay_s=valve_delay_s)

    @abstractmethod
    def _prepare(
        self, spec: RobotSpec, tau_fill: np.ndarray, tau_vent: np.ndarray
    ) -> None:
        """Prepare the laws for the time constants of the chambers, shape (segments, chambers), s."""

    def describe(self) -> dict[str, object]:
        """See `Pneumatics.describe`."""
        return super().describe() | {"leak_per_s": self._leak}


class LagPneumatics(LagChambers):
    """Chambers with a first-order lag (module docstring)."""

    state_attributes = ("_linear", "_asymptote", "_energy_per_amount")

    def _prepare(
        self, spec: RobotSpec, tau_fill: np.ndarray, tau_vent: np.ndarray
    ) -> None:
        actuator = spec.actuator
        chamber = spec.chamber
        # Chambers of one kind have the same time constants and share the evaluation of
        # exponentials.
        kinds, kind = np.unique(
            np.stack([tau_fill.ravel(), tau_vent.ravel()]), axis=1, return_inverse=True
        )
        self._kind = kind.reshape(tau_fill.shape)
        # Relaxation rate a and asymptote P, by kind and valve state + 1.
        self._rate = (
            np.stack([1 / kinds[1], np.zeros_like(kinds[0]), 1 / kinds[0]], axis=1)
            + self._leak
        )
        self._asymptote = np.zeros_like(self._rate)
        self._tau_fill = kinds[0]
        self._tau_mode = actuator.tau_mode
        self._gain = chamber_gains(spec)
        self._damping_time = spec.bending.damping_time
        self._law = bend_law(spec)
        self._volume_law = chamber.dead_volume, chamber.displacement

    def reset(self) -> None:
        """See `Pneumatics.reset`."""
        super().reset()
        self._linear = np.zeros(self._segments)

    def place(self, pressure: np.ndarray, bend: np.ndarray) -> None:
        """See `Pneumatics.place`."""
        self._linear = invert_bend_law(bend - self.rest_bend, self._law)
        self.pressure = check_pressure(pressure, self._max_supply)
        self.bend = np.array(bend, dtype=float)

    def set_supply_pressure(self, supply_pa: float) -> None:
        """See `Pneumatics.set_supply_pressure`; the pressure changes immediately."""
        check_supply(supply_pa, self._max_supply)
        # A leak lowers the equilibrium pressure below that of the supply.
        self._asymptote[:, 2] = supply_pa / self._tau_fill / self._rate[:, 2]
        self._energy_per_amount = supply_pa / (supply_pa + AMBIENT_PA)

    def relaxation(self, time: float) -> Relaxation:
        """Return the propagation over a time (s), in which each chamber is a kind of its own."""
        rate = self._rate[self._kind.ravel()]
        asymptote = self._asymptote[self._kind.ravel()]
        decay = np.empty_like(rate)
        lag = np.empty_like(rate)
        mode = _decay_factors(time, rate, self._tau_mode, decay, lag)
        kinds = np.arange(self._kind.size).reshape(self._kind.shape)
        return Relaxation(
            kinds,
            asymptote,
            decay,
            lag,
            mode,
            self._tau_mode,
            self._damping_time,
            self._gain,
            self.rest_bend,
            self._law,
            self._volume_law,
            self._energy_per_amount,
        )

    def _simulate(
        self,
        schedule: Schedule,
        times: np.ndarray,
        bend: OptionalArray,
        bend_rate: OptionalArray,
    ) -> Trace:
        trace = self._empty_trace(len(times))
        pressure = self.pressure.copy()
        linear = self._linear.copy()
        free = np.empty(self._segments)
        relaxation = self._kind, self._rate, self._asymptote, self._leak
        bending = self._tau_mode, self._gain, self.rest_bend, self._law
        start = (pressure, linear, free)
        factors = (np.empty_like(self._rate), np.empty_like(self._rate))
        drawn = _fill_trace(
            start,
            schedule,
            times,
            relaxation,
            bending,
            self._volume_law,
            trace,
            factors,
        )
        np.multiply(trace.air, self._energy_per_amount, out=trace.air)
        np.add(trace.air, self.air, out=trace.air)
        self._linear = linear
        self.pressure = pressure
        self.bend = free
        self.air = self.air + self._energy_per_amount * drawn
        return trace


@compiled
def _fill_trace(start, schedule, times, relaxation, bending, space, trace, factors):  # type: ignore[no-untyped-def]
    """Fill a trace at `times`, advance to the end of a schedule, and return the amount of air drawn (J).

    Args:
        start: gauge pressure, shape (segments, 2), Pa, and linear bend x, shape
            (segments,), rad, at the start, both in place; and, out, free bend at the
            end, shape (segments,), rad.
        schedule: effective valve states.
        times: ascending, shape (times,), s.
        relaxation: kind of each chamber, shape (segments, 2); rates a (1/s) and
            asymptotes P (Pa) by kind and valve state + 1, shape (kinds, 3); leak rate λ
            (1/s).
        bending: τ₂ (s); gain of each chamber, shape (segments, 2), rad/Pa; rest bends,
            shape (segments,), rad; a `BendLaw`.
        space: dead volume V₀ (m³) and A (m³/rad) of a chamber.
        trace: out; its air is the amount drawn since the start, J.
        factors: work arrays, shape (kinds, 3) each.
    """
    (pressure, linear, bend), (span, starts, states), (decay, lag) = (
        start,
        schedule,
        factors,
    )
    kinds, rates, asymptotes, leak = relaxation
    tau, gain, bias, law = bending
    row = 0
    drawn = 0.0
    for run in range(starts.shape[0]):
        state = states[run]
        begin = starts[run]
        stop = starts[run + 1] if run + 1 < starts.shape[0] else span
        # Filling chambers draw the increase of their content plus their leak; other
        # chambers draw nothing.
        content_before = 0.0
        leaked = 0.0
        last = 0.0
        for j in range(bend.shape[0]):
            free = bias[j] + apply_bend_law(linear[j], law)[0]
            content_before += filling_content(
                state[j], pressure[j, 0], pressure[j, 1], free, space, AMBIENT_PA
            )
        while True:
            # The rows of the trace within the run, then the end of the run, from which
            # the next one starts.
            requested = row < times.shape[0] and (
                times[row] <= stop or run + 1 == starts.shape[0]
            )
            t = (times[row] if requested else stop) - begin
            if leak > 0.0:
                leaked += _leaked(
                    last,
                    t,
                    state,
                    (pressure, linear),
                    relaxation,
                    bending,
                    space,
                    (decay, lag),
                )
                last = t
            mode = _decay_factors(t, rates, tau, decay, lag)
            content = 0.0
            for j in range(bend.shape[0]):
                plus, minus, x = advance_segment(
                    state[j],
                    kinds[j],
                    pressure[j],
                    linear[j],
                    asymptotes,
                    gain[j],
                    decay,
                    lag,
                    mode,
                )
                free, slope, curve = apply_bend_law(x, law)
                free += bias[j]
                content += filling_content(
                    state[j], plus, minus, free, space, AMBIENT_PA
                )
                if not requested:
                    pressure[j, 0] = plus
                    pressure[j, 1] = minus
                    linear[j] = x
                    bend[j] = free
                    continue
                rise = _drive_rate(
                    state[j], kinds[j], plus, minus, rates, asymptotes, gain[j]
                )
                speed = (gain[j, 0] * plus - gain[j, 1] * minus - x) / tau
                trace.pressure[row, j, 0] = plus
                trace.pressure[row, j, 1] = minus
                trace.bend[row, j] = free
                trace.bend_rate[row, j] = slope * speed
                trace.bend_acceleration[row, j] = (
                    slope * (rise - speed) / tau + curve * speed * speed
                )
                trace.valves[row, j, 0] = state[j, 0]
                trace.valves[row, j, 1] = state[j, 1]
            amount = drawn + leaked + content - content_before
            if not requested:
                drawn = amount
                break
            trace.air[row] = amount
            row += 1
    return drawn


@kernel_only
def _drive_rate(state, kind, plus, minus, rates, asymptotes, gain):  # type: ignore[no-untyped-def]
    """Return the rate of G (g⁺p⁺ − g⁻p⁻) of a segment (rad/s); arguments as in `advance_segment`."""
    first = kind[0]
    second = kind[1]
    up = state[0] + 1
    down = state[1] + 1
    rise = gain[0] * rates[first, up] * (asymptotes[first, up] - plus)
    return rise - gain[1] * rates[second, down] * (asymptotes[second, down] - minus)


@kernel_only
def _leaked(last, t, state, start, relaxation, bending, space, factors):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return λ ∫ p V dt of the filling chambers from `last` to t (s) by Simpson's rule, J.

    Args:
        start: pressures and linear bends at the start of the run.
        factors: work arrays of `_decay_factors`.
    """
    (pressure, linear), (kinds, rates, asymptotes, leak), (tau, gain, bias, law) = (
        start,
        relaxation,
        bending,
    )
    decay, lag = factors
    leaked = 0.0
    for at, weight in ((last, 1 / 6), (0.5 * (last + t), 4 / 6), (t, 1 / 6)):
        mode = _decay_factors(at, rates, tau, decay, lag)
        for j in range(linear.shape[0]):
            plus, minus, x = advance_segment(
                state[j],
                kinds[j],
                pressure[j],
                linear[j],
                asymptotes,
                gain[j],
                decay,
                lag,
                mode,
            )
            free = bias[j] + apply_bend_law(x, law)[0]
            leaked += (
                leak
                * (t - last)
                * weight
                * filling_content(state[j], plus, minus, free, space, 0.0)
            )
    return leaked


@compiled
def _decay_factors(t, rates, tau, decay, lag):  # type: ignore[no-untyped-def]
    """Fill the factors `decay` and `lag` of `Relaxation` after a time t (s); return its factor `mode`.

    Args:
        t: s.
        rates: a by kind and valve state, shape (kinds, 3), 1/s.
        tau: τ₂, s.
        decay: out, shape (kinds, 3).
        lag: out, shape (kinds, 3).
    """
    mode = math.exp(-t / tau)
    for kind in range(rates.shape[0]):
        for s in range(3):
            decay[kind, s] = math.exp(-rates[kind, s] * t)
            lag[kind, s] = _exponential_response(
                rates[kind, s], tau, t, decay[kind, s], mode
            )
    return mode


@kernel_only
def advance_segment(state, kind, pressure, linear, asymptotes, gain, decay, lag, mode):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the pressures (Pa) and the linear bend (rad) of a segment after a time without valve events.

    Args:
        state: valve states, shape (2,).
        kind: kinds of the two chambers, shape (2,).
        pressure: gauge pressures before, shape (2,), Pa.
        linear: linear bend before, rad.
        asymptotes: as in `Relaxation`.
        gain: gains of the two chambers, shape (2,), rad/Pa.
        decay, lag, mode: as in `Relaxation`.
    """
    first = kind[0]
    second = kind[1]
    up = state[0] + 1
    down = state[1] + 1
    target_plus = asymptotes[first, up]
    target_minus = asymptotes[second, down]
    deviation_plus = pressure[0] - target_plus
    deviation_minus = pressure[1] - target_minus
    lagged = gain[0] * (target_plus * (1.0 - mode) + deviation_plus * lag[first, up])
    lagged -= gain[1] * (
        target_minus * (1.0 - mode) + deviation_minus * lag[second, down]
    )
    return (
        target_plus + deviation_plus * decay[first, up],
        target_minus + deviation_minus * decay[second, down],
        linear * mode + lagged,
    )


@kernel_only
def filling_content(state, plus, minus, bend, space, ambient):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the sum of (p + ambient) V over those chambers of a segment that fill, J.

    Args:
        state: valve states, shape (2,).
        plus, minus: gauge pressures, Pa.
        bend: q, rad.
        space: dead volume V₀ (m³) and A (m³/rad) of a chamber.
        ambient: ambient pressure, Pa; 0 for the content by gauge pressure.
    """
    total = float(0.0)
    pressure = float(plus)
    for side in range(2):
        if state[side] == 1:
            size, _ = volume(space[0], space[1], bend, side)
            total += (pressure + ambient) * size
        pressure = float(minus)
    return total


@kernel_only
def _exponential_response(rate, tau, t, decay, mode):  # type: ignore[no-untyped-def]
    """Return y(t) of τ ẏ + y = e^{−at} with y(0) = 0: (e^{−at} − e^{−t/τ})/(1 − aτ).

    Args:
        rate: a, 1/s.
        tau: τ, s.
        t: s.
        decay: e^{−at}.
        mode: e^{−t/τ}.
    """
    gap = 1 - rate * tau
    if abs(gap) < _SAME:
        return t / tau * mode
    return (decay - mode) / gap
