r"""LagPneumatics: chambers that fill and vent with a first-order lag, in closed form.

A valve state +1 fills its chamber from the supply, −1 vents it, 0 holds it. Between valve events each
chamber relaxes exponentially, p(t) = P + (p₀ − P) e^{−at}, with a = 1/τ₁ plus the leak. The linear bend x of
a module without load follows the chambers' difference with the lag τ₂,

$$ \tau_2\,\dot x + x = G\,(g^+ p^+ - g^- p^-),\qquad q = b + \varphi(x), $$

so that nominal modules with τ_fill = τ_vent = τ₁ obey Eq. 14–15 as corrected by E1 and E2:
q̈ + (1/τ₁ + 1/τ₂) q̇ + q/(τ₁τ₂) = C₀ u/(τ₁τ₂). φ, b and the gains g are those of `bending`. Everything is
evaluated in closed form, at any time.
A valve's 3 ms of switching are part of τ₂; a delay besides is 0 unless asked for.

Air drawn: while a chamber fills, its content n = P V(q) grows by what comes in less what leaks, so a fill
draws Δn + λ ∫ p V dt. Δn is exact, with V from the free bend; the leak's integral is taken by Simpson's
rule between the times asked for.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.errors import InputError
from srs_twin.pneumatics.base import Known, Pneumatics, Trace, not_negative
from srs_twin.pneumatics.chambers import AMBIENT_PA, BendLaw, bend_law, bent, gains, reached, unbent, volume
from srs_twin.pneumatics.valves import Schedule
from srs_twin.robot.spec import RobotSpec


class Relaxation(NamedTuple):
    """What chambers do in a time in which no valve switches, for who follows them elsewhere.

    Attributes:
        kinds: of each chamber, shape (segments, 2): a row of what follows.
        asymptotes: where a pressure relaxes to, by kind and valve state + 1, Pa.
        decay: what is left of its swing, same shape.
        lag: and of that in x, same shape.
        mode: what is left of x.
        gain: of each chamber, shape (segments, 2), rad/Pa.
        bias: b, shape (segments,), rad.
        law: of the bend.
        space: V₀ (m³) and A (m³/rad) of a chamber.
        worth: what an amount of air that is drawn costs as work.
    """

    kinds: np.ndarray
    asymptotes: np.ndarray
    decay: np.ndarray
    lag: np.ndarray
    mode: float
    gain: np.ndarray
    bias: np.ndarray
    law: BendLaw
    space: tuple[float, float]
    worth: float


class LagPneumatics(Pneumatics):
    """Chambers with a first-order lag each (module docstring)."""

    kind = "lag"
    state_attributes = ("_linear", "_asymptote", "_worth")

    def __init__(
        self,
        spec: RobotSpec,
        *,
        supply_pa: float,
        layout: str = "3/2",
        leak_per_s: float = 0.0,
        valve_delay_s: float = 0.0,
    ) -> None:
        """Make the chambers.

        Args:
            spec: the robot.
            supply_pa: supply pressure, gauge, Pa.
            layout: valve layout, one of `LAYOUTS`.
            leak_per_s: λ, rate at which a held pressure falls, as a share of itself, 1/s.
            valve_delay_s: how much later than commanded a valve switches, s.

        Raises:
            InputError: an unknown layout, or a leak or delay below 0.
        """
        not_negative(leak_per_s=leak_per_s)
        actuator, chamber = spec.actuator, spec.chamber
        self._leak = leak_per_s
        fill = actuator.tau_fill * spec.modules.array("tau_fill")
        vent = actuator.tau_vent * spec.modules.array("tau_vent")
        # Chambers with the same time constants are of one kind, and share what is an exponential.
        kinds, kind = np.unique(np.stack([fill.ravel(), vent.ravel()]), axis=1, return_inverse=True)
        self._kind = kind.reshape(fill.shape)
        # Relaxation rate a and asymptote P, by kind and valve state + 1.
        self._rate = np.stack([1 / kinds[1], np.zeros_like(kinds[0]), 1 / kinds[0]], axis=1) + leak_per_s
        self._asymptote = np.zeros_like(self._rate)
        self._tau_fill, self._largest = kinds[0], supply_pa
        self.regulate(supply_pa)
        self._tau, self._gain = actuator.tau_mode, gains(spec)
        self._law = bend_law(spec)
        self._space = chamber.dead_volume, chamber.displacement
        super().__init__(spec, layout=layout, valve_delay_s=valve_delay_s)

    def reset(self) -> None:
        """See `Pneumatics.reset`."""
        super().reset()
        self._linear = np.zeros(self._segments)

    def place(self, pressure: np.ndarray, bend: np.ndarray) -> None:
        """See `Pneumatics.place`."""
        self._linear = unbent(bend - self.rest_bend, self._law)
        self.pressure, self.bend = reached(pressure, self._largest), np.array(bend, dtype=float)

    def regulate(self, supply_pa: float) -> None:
        """See `Pneumatics.regulate`: a regulator without a lag of its own."""
        if not 0 <= supply_pa <= self._largest:
            raise InputError(
                f"supply pressure {supply_pa!r} Pa is not allowed; it must be 0 to {self._largest:g} Pa, "
                "which these chambers were made for"
            )
        self._asymptote[:, 2] = supply_pa / self._tau_fill / self._rate[:, 2]
        self._worth = supply_pa / (supply_pa + AMBIENT_PA)

    def describe(self) -> dict[str, Any]:
        """See `Pneumatics.describe`."""
        return super().describe() | {"leak_per_s": self._leak}

    def relaxation(self, time: float) -> Relaxation:
        """Return what the chambers do in a time (s); a kind each, however many are alike."""
        rate, asymptote = self._rate[self._kind.ravel()], self._asymptote[self._kind.ravel()]
        decay, lag = np.empty_like(rate), np.empty_like(rate)
        mode = _fade(time, rate, self._tau, decay, lag)
        kinds = np.arange(self._kind.size).reshape(self._kind.shape)
        return Relaxation(
            kinds,
            asymptote,
            decay,
            lag,
            mode,
            self._gain,
            self.rest_bend,
            self._law,
            self._space,
            self._worth,
        )

    @property
    def leaks(self) -> bool:
        """Whether closed chambers lose air."""
        return self._leak > 0

    def _follow(self, schedule: Schedule, times: np.ndarray, bend: Known, bend_rate: Known) -> Trace:
        trace = Trace.empty(len(times), self._segments)
        pressure, linear = self.pressure.copy(), self._linear.copy()
        free = np.empty(self._segments)
        law = self._kind, self._rate, self._asymptote, self._leak
        bending = self._tau, self._gain, self.rest_bend, self._law
        drawn = _relax(pressure, linear, free, schedule, times, law, bending, self._space, trace)
        np.multiply(trace.air, self._worth, out=trace.air)
        np.add(trace.air, self.air, out=trace.air)
        self._linear = linear
        self.pressure, self.bend, self.air = pressure, free, self.air + self._worth * drawn
        return trace


@allocating
def _relax(pressure, linear, bend, schedule, times, law, bending, space, trace):  # type: ignore[no-untyped-def]
    """Fill a trace at `times`, advance to the end of a schedule, return the air drawn (J).

    Args:
        pressure: at the start, in place, shape (segments, 2), Pa.
        linear: x at the start, in place, shape (segments,), rad.
        bend: out, at the end, same shape, rad.
        schedule: of the valves.
        times: ascending, shape (times,), s.
        law: kind of each chamber, shape (segments, 2); relaxation rates by kind and valve state + 1, 1/s;
            where the pressure relaxes to, same shape, Pa; λ, 1/s.
        bending: τ₂, s; gain of each chamber, shape (segments, 2), rad/Pa; b, shape (segments,), and its law.
        space: V₀ (m³) and A (m³/rad) of a chamber.
        trace: out; air as amount drawn since the start, J.
    """
    span, starts, states = schedule
    kinds, rates, asymptotes, leak = law
    tau, gain, bias, curved = bending
    decay, lag = np.empty_like(rates), np.empty_like(rates)
    row, drawn = 0, 0.0
    for run in range(starts.shape[0]):
        state, start = states[run], starts[run]
        stop = starts[run + 1] if run + 1 < starts.shape[0] else span
        held, leaked, last = 0.0, 0.0, 0.0
        for j in range(bend.shape[0]):
            free = bias[j] + bent(linear[j], curved)[0]
            held += _filling(state[j], pressure[j, 0], pressure[j, 1], free, space, AMBIENT_PA)
        while True:
            # Rows up to and at the end of the run, then the end itself, from which the next run starts.
            within = row < times.shape[0] and (times[row] <= stop or run + 1 == starts.shape[0])
            t = (times[row] if within else stop) - start
            if leak > 0.0:
                for at, weight in ((last, 1 / 6), (0.5 * (last + t), 4 / 6), (t, 1 / 6)):
                    mode = _fade(at, rates, tau, decay, lag)
                    for j in range(bend.shape[0]):
                        plus, minus, x = _segment(
                            state[j], kinds[j], pressure[j], linear[j], asymptotes, gain[j], decay, lag, mode
                        )
                        free = bias[j] + bent(x, curved)[0]
                        inside = _filling(state[j], plus, minus, free, space, 0.0)
                        leaked += leak * (t - last) * weight * inside
                last = t
            mode = _fade(t, rates, tau, decay, lag)
            content = 0.0
            for j in range(bend.shape[0]):
                plus, minus, x = _segment(
                    state[j], kinds[j], pressure[j], linear[j], asymptotes, gain[j], decay, lag, mode
                )
                turned, slope, curve = bent(x, curved)
                turned += bias[j]
                content += _filling(state[j], plus, minus, turned, space, AMBIENT_PA)
                if not within:
                    pressure[j, 0], pressure[j, 1], linear[j], bend[j] = plus, minus, x, turned
                    continue
                up, down = state[j, 0] + 1, state[j, 1] + 1
                first, second = kinds[j, 0], kinds[j, 1]
                rise = gain[j, 0] * rates[first, up] * (asymptotes[first, up] - plus)
                rise -= gain[j, 1] * rates[second, down] * (asymptotes[second, down] - minus)
                speed = (gain[j, 0] * plus - gain[j, 1] * minus - x) / tau
                trace.pressure[row, j, 0], trace.pressure[row, j, 1] = plus, minus
                trace.bend[row, j], trace.bend_rate[row, j] = turned, slope * speed
                trace.bend_acceleration[row, j] = slope * (rise - speed) / tau + curve * speed * speed
                trace.valves[row, j, 0], trace.valves[row, j, 1] = state[j, 0], state[j, 1]
            amount = drawn + leaked + content - held
            if not within:
                drawn = amount
                break
            trace.air[row] = amount
            row += 1
    return drawn


@compiled
def _fade(t, rates, tau, decay, lag):  # type: ignore[no-untyped-def]
    """Fill what is left of a pressure's swing after t, and of its lag; return what is left of τ₂'s."""
    mode = math.exp(-t / tau)
    for kind in range(rates.shape[0]):
        for s in range(3):
            decay[kind, s] = math.exp(-rates[kind, s] * t)
            lag[kind, s] = _lag_of_exponential(rates[kind, s], tau, t, decay[kind, s], mode)
    return mode


@compiled
def _segment(state, kind, pressure, linear, asymptotes, gain, decay, lag, mode):  # type: ignore[no-untyped-def]
    """Return both pressures and the linear bend of a segment from those of the run's start."""
    first, second, up, down = kind[0], kind[1], state[0] + 1, state[1] + 1
    end, other = asymptotes[first, up], asymptotes[second, down]
    high, low = pressure[0] - end, pressure[1] - other
    lagged = gain[0] * (end * (1.0 - mode) + high * lag[first, up])
    lagged -= gain[1] * (other * (1.0 - mode) + low * lag[second, down])
    return end + high * decay[first, up], other + low * decay[second, down], linear * mode + lagged


@compiled
def _filling(state, plus, minus, bend, space, ambient):  # type: ignore[no-untyped-def]
    """Return the sum of (p + ambient) V over the chambers of a segment that fill, J."""
    total = float(0.0)
    if state[0] == 1:
        size, _ = volume(space[0], space[1], bend, 0)
        total += (plus + ambient) * size
    if state[1] == 1:
        size, _ = volume(space[0], space[1], bend, 1)
        total += (minus + ambient) * size
    return total


@compiled
def _lag_of_exponential(rate, tau, t, decay, mode):  # type: ignore[no-untyped-def]
    """Return the response of τ ẏ + y = e^{−at} from y = 0: (e^{−at} − e^{−t/τ})/(1 − aτ)."""
    gap = 1 - rate * tau
    if abs(gap) < 1e-6:
        return t / tau * mode
    return (decay - mode) / gap
