r"""Valves, chambers and the free bend they give: one law for both plants.

A valve state +1 fills its chamber from the supply, −1 vents it, 0 holds it. Between valve events each
chamber relaxes exponentially, p(t) = P + (p₀ − P) e^{−at}, with a = 1/τ₁ plus the leak. The bend of a
module without load follows the chambers' difference with the lag τ₂,

$$ \tau_2\,\dot q + q = G\,(p^+ - p^-), $$

so that for τ_fill = τ_vent = τ₁ it obeys Eq. 14–15 as corrected by E1 and E2:
q̈ + (1/τ₁ + 1/τ₂) q̇ + q/(τ₁τ₂) = C₀ u/(τ₁τ₂). Everything is evaluated in closed form, at any time.
A valve's 3 ms of switching are part of τ₂, not a delay of their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError
from srs_twin.spec import RobotSpec

LAYOUTS = {"3/2": (-1, 1), "in_out": (-1, 0, 1)}
"""Valve layout → states it can take: one 3/2 valve a chamber, or an inlet and an outlet valve."""


@dataclass(frozen=True)
class Trace:
    """What the chambers did at given times.

    Attributes:
        pressure: gauge, shape (times, segments, 2), Pa.
        bend: free bend, shape (times, segments), rad.
        bend_rate: its rate, shape (times, segments), rad/s.
        valves: valve states that led there, shape (times, segments, 2).
    """

    pressure: np.ndarray
    bend: np.ndarray
    bend_rate: np.ndarray
    valves: np.ndarray


class LagPneumatics:
    """Chambers that fill and vent with a first-order lag, in closed form.

    Attributes:
        pressure: gauge pressures now, shape (segments, 2), Pa.
        bend: free bends now, shape (segments,), rad.
        openings: how often each chamber's inlet has opened, shape (segments, 2).
        valves: last valve states, shape (segments, 2).
    """

    def __init__(
        self, spec: RobotSpec, *, supply_pa: float, layout: str = "3/2", leak_per_s: float = 0.0
    ) -> None:
        if layout not in LAYOUTS:
            raise InputError(f"valve layout '{layout}' is unknown; allowed: {', '.join(LAYOUTS)}")
        self._states = LAYOUTS[layout]
        self._layout = layout
        self._segments = spec.segments
        self._actuator = spec.actuator
        # Relaxation rate a and asymptote P, indexed by valve state + 1.
        rate = np.array([1 / spec.actuator.tau_vent, 0.0, 1 / spec.actuator.tau_fill]) + leak_per_s
        self._rate = rate
        self._asymptote = np.array([0.0, 0.0, supply_pa / spec.actuator.tau_fill / rate[2]])
        self.reset()

    def reset(self) -> None:
        """Empty all chambers and close all inlets."""
        shape = (self._segments, 2)
        self.pressure = np.zeros(shape)
        self.bend = np.zeros(self._segments)
        self.openings = np.zeros(shape, dtype=int)
        self.valves = np.full(shape, -1, dtype=np.int8)

    def slots(self, valves: np.ndarray) -> np.ndarray:
        """Return checked commands as (slots, segments, 2).

        Raises:
            InputError: a wrong shape, or a state that the valve layout does not have.
        """
        commands = np.asarray(valves)
        if commands.ndim == 2:
            commands = commands[None]
        if commands.ndim != 3 or commands.shape[1:] != (self._segments, 2):
            raise InputError(
                f"valves have shape {np.shape(valves)}; allowed: ({self._segments}, 2) or "
                f"(slots, {self._segments}, 2)"
            )
        possible = commands == self._states[0]
        for state in self._states[1:]:
            possible |= commands == state
        if not possible.all():
            raise InputError(
                f"valve state {commands[~possible][0]} is not possible with layout {self._layout}; "
                f"allowed: {self._states}"
            )
        return commands.astype(np.int8)

    def advance(self, commands: np.ndarray, tick: float, times: np.ndarray) -> Trace:
        """Advance by one tick and return what happened at `times`.

        Args:
            commands: valve states as `slots` returns them.
            tick: length of the tick, s.
            times: ascending, within [0, tick], s from the start of the tick.
        """
        trace = Trace(
            np.empty((len(times), self._segments, 2)),
            np.empty((len(times), self._segments)),
            np.empty((len(times), self._segments)),
            np.empty((len(times), self._segments, 2), dtype=np.int8),
        )
        for start, stop, state in valve_runs(commands, tick):
            first, last = np.searchsorted(times, [start, stop], side="right")
            if start == 0.0:
                first = 0
            at = np.append(times[first:last] - start, stop - start)
            pressure, bend, rate = self._relax(state, at)
            trace.pressure[first:last] = pressure[:-1]
            trace.bend[first:last] = bend[:-1]
            trace.bend_rate[first:last] = rate[:-1]
            trace.valves[first:last] = state
            self.openings += (state == 1) & (self.valves != 1)
            self.pressure, self.bend, self.valves = pressure[-1], bend[-1], state
        return trace

    def _relax(self, state: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return pressures (times, segments, 2), bends and bend rates (times, segments) under one state."""
        tau, gain = self._actuator.tau_mode, self._actuator.gain
        rate, asymptote = self._rate[state + 1], self._asymptote[state + 1]
        swing = self.pressure - asymptote
        t = at[:, None, None]
        decay = np.exp(-rate * t)
        pressure = asymptote + swing * decay
        mode = np.exp(-t / tau)
        lagged = asymptote * (1 - mode) + swing * _lag_of_exponential(rate, tau, t, decay, mode)
        bend = self.bend * mode[..., 0] + gain * (lagged[..., 0] - lagged[..., 1])
        bend_rate = (gain * (pressure[..., 0] - pressure[..., 1]) - bend) / tau
        return pressure, bend, bend_rate


def _lag_of_exponential(
    rate: np.ndarray, tau: float, t: np.ndarray, decay: np.ndarray, mode: np.ndarray
) -> np.ndarray:
    """Return the response of τ ẏ + y = e^{−at} from y = 0: (e^{−at} − e^{−t/τ})/(1 − aτ)."""
    gap = 1 - rate * tau
    equal = np.abs(gap) < 1e-6
    return np.where(equal, t / tau * mode, (decay - mode) / np.where(equal, 1.0, gap))


def valve_runs(commands: np.ndarray, tick: float) -> Iterator[tuple[float, float, np.ndarray]]:
    """Yield (start, stop, state) for each stretch of a tick in which no valve changes.

    Args:
        commands: (slots, segments, 2), equal parts of the tick.
        tick: s.
    """
    slots = len(commands)
    changes = np.flatnonzero((commands[1:] != commands[:-1]).any(axis=(1, 2))) + 1
    edges = [0, *changes.tolist(), slots]
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        yield tick * begin / slots, tick * end / slots, commands[begin]
