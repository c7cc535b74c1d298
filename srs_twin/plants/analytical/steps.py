r"""Steps of the analytical models, and how `complete` and `simplified` cut theirs where friction turns.

Steps end on valve events (`Steps`). Those of `complete` and `simplified` are short where the friction turns
and long elsewhere. Where the slip of a connector changes its sign, its friction turns from one side to the
other within a few times ε, mostly far less than a step. A step that takes such a turn at the wrong moment
errs by an impulse. The three rates of momentum that a step knows anyhow, k₀ at its start (the last stage of
the step before), k₁ and k₂, tell: as long as they change evenly, k₁ lies on the line between the other two.
What it lies off, over the step, as a velocity,

$$ \eta = \frac{h}{M}\,\bigl|\,k_1 - (1-\gamma)\,k_0 - \gamma\,k_2\,\bigr|, $$

is at least 0.7 of the error of a turn wherever in the step it falls, and of third order in h where friction
is smooth. The moment of momentum counts by the radius of gyration of a straight body. A step with η above the
tolerance is made anew in halves, each of which may be halved again; parts that fall well below it are doubled
again. Bends between the stages, where the chambers have told them, are cubics through bends and rates.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.plants.analytical.floor import smoothed
from srs_twin.plants.analytical.kernels import (
    GAMMA,
    MOMENT,
    SPEED_LIMIT,
    STATE_VX,
    STATE_VY,
    STATES,
    copy,
    step,
)
from srs_twin.plants.analytical.kinematics import ROWS


@dataclass(frozen=True)
class Steps:
    """The steps of a stretch; equal stretches without valve events share one, so nothing may be written to.

    Attributes:
        ends: ascending, from the stretch's start, shape (steps,), s.
        marks: numbers of steps after which a sample is due, ascending, shape (samples,).
    """

    ends: np.ndarray
    marks: np.ndarray

    @classmethod
    def between(cls, span: float, events: np.ndarray, samples: int, *, longest: float, same: float) -> Steps:
        """Return steps on an even grid, in step with the samples, and on every valve event in between.

        Args:
            span: length of the stretch, s.
            events: when valves change, ascending, s from its start.
            samples: how many, equally spaced, the last at the end.
            longest: no step is longer, s.
            same: events that are closer to the end of another step, or to each other, end none of their own,
                s.
        """
        per_sample = math.ceil(span / samples / longest * (1 - 1e-12))
        even = _even(span, samples, per_sample)
        if not len(events):
            return even
        grid = span / (samples * per_sample)
        steps = events / grid
        # Whichever of them rounding puts first.
        events = events[np.abs(steps - np.round(steps)) * grid > same]
        events = events[np.diff(events, prepend=-1.0) > same]
        marks = even.marks + np.searchsorted(events, even.ends[even.marks - 1])
        return cls(np.sort(np.concatenate([even.ends, events])), marks)

    @cached_property
    def lengths(self) -> np.ndarray:
        """Return the steps' lengths, shape (steps,), s."""
        return self.ends - self._starts

    @cached_property
    def moments(self) -> np.ndarray:
        """Return the start and each step's two stages, shape (1 + 2 · steps,), s."""
        found = np.zeros(1 + 2 * len(self.ends))
        found[1::2], found[2::2] = self._starts + GAMMA * self.lengths, self._starts + self.lengths
        return found

    def pieces(self, turn: float) -> Iterator[tuple[float, float, Steps]]:
        """Yield begin and end (s) and steps of pieces about as long as `turn` (s), of a step at least."""
        firsts = np.unique(np.floor(self.ends / turn * (1 - 1e-9)), return_index=True)[1]
        for first, last in zip(firsts, [*firsts[1:], len(self.ends)], strict=True):
            begun = float(self.ends[first - 1]) if first else 0.0
            inside = self.marks[(self.marks > first) & (self.marks <= last)] - first
            yield begun, float(self.ends[last - 1]), Steps(self.ends[first:last] - begun, inside)

    @property
    def _starts(self) -> np.ndarray:
        return np.append(0.0, self.ends[:-1])


@lru_cache(maxsize=64)
def _even(span: float, samples: int, per_sample: int) -> Steps:
    """Return steps on the even grid alone; a controller's ticks ask for the same ones again and again."""
    count = samples * per_sample
    ends = span / count * np.arange(1, count + 1)
    return Steps(ends, np.arange(per_sample, count + 1, per_sample))


PARTS = 64
"""Into how many parts a step may be cut at most, a power of 2."""

_FAR = 4.0  # times the tolerance: beyond it, halves would be cut again
_NEAR = 0.5  # times the tolerance: below it, parts twice as long are tried


@compiled
def _cubic(at, span, q0, q1, r0, r1, q, r):  # type: ignore[no-untyped-def]
    """Fill bends and rates at the share `at` of an interval (s) from those at its ends."""
    rest = 1 - at
    rise, begins, ends = at * at * (3 - 2 * at), at * rest * rest * span, at * at * rest * span
    rising, beginning, ending = 6 * at * rest / span, rest * (1 - 3 * at), at * (3 * at - 2)
    for j in range(q.shape[0]):
        way = q1[j] - q0[j]
        q[j] = q0[j] + rise * way + begins * r0[j] - ends * r1[j]
        r[j] = rising * way + beginning * r0[j] + ending * r1[j]


@compiled
def bend_within(at, h, bends, rates, q, r):  # type: ignore[no-untyped-def]
    """Fill bends and rates at the share `at` of a step from those at its start, first stage and end."""
    if at < GAMMA:
        _cubic(at / GAMMA, GAMMA * h, bends[0], bends[1], rates[0], rates[1], q, r)
    else:
        _cubic((at - GAMMA) / (1 - GAMMA), (1 - GAMMA) * h, bends[1], bends[2], rates[1], rates[2], q, r)


@compiled
def _unevenness(h, k0, k1, k2, weight, arm):  # type: ignore[no-untyped-def]
    """Return η (m/s) of a step, see above."""
    x = k1[STATE_VX] - (1 - GAMMA) * k0[STATE_VX] - GAMMA * k2[STATE_VX]
    y = k1[STATE_VY] - (1 - GAMMA) * k0[STATE_VY] - GAMMA * k2[STATE_VY]
    turning = (k1[MOMENT] - (1 - GAMMA) * k0[MOMENT] - GAMMA * k2[MOMENT]) / (weight * arm)
    return h * math.sqrt(x * x + y * y + turning * turning)


@allocating
def advance(now, steps, trace, marks, model, tolerance, seen):  # type: ignore[no-untyped-def]
    """Advance a body in place over the given steps.

    Args:
        now: state by the indices in `kernels` and its rates, shape (STATES,) each, velocity in the body frame
            and yaw rate, shape (3,); the latter two are kept from call to call, as first guess.
        steps: step lengths, shape (steps,), s.
        trace: what the chambers do at the start and at each step's two stages, 1 + 2 steps rows.
        marks: numbers of steps after which to look, ascending, shape (samples,).
        model: a `kinematics.Solid`, a `floor.FloorFriction`, and whether the friction's moment about the
            centre of mass acts.
        tolerance: of η, m/s.
        seen: out, states and velocities at the marks, shapes (samples, STATES) and (samples, 3).

    Returns:
        How many steps were made, fewer if one failed, and in how many parts, those made anew included.
    """
    (state, slope, u), (states, velocities) = now, seen
    (solid, floor, turning), bends, rates = model, trace.bend, trace.bend_rate
    reach = (solid.length + solid.gap) / 2
    n = solid.mass.shape[0]
    body = np.empty((ROWS, n))
    weight = solid.mass.sum()
    arm = (solid.length + solid.gap) * math.sqrt((n * n - 1) / 12)
    k1, k2, after = np.empty(STATES), np.empty(STATES), np.empty(STATES)
    drift, guess, pace = np.zeros(3), np.empty(3), np.empty(3)
    own_bends, own_rates = np.empty((2, n - 1)), np.empty((2, n - 1))
    mark = parts = 0
    for i in range(steps.shape[0]):
        given_bends, given_rates = bends[2 * i : 2 * i + 3], rates[2 * i : 2 * i + 3]
        done, size = 0, PARTS
        fastest = max(abs(u[0]) + abs(u[1]), reach * abs(u[2]))
        for j in range(n - 1):
            fastest = max(fastest, reach * abs(given_rates[0, j]))
        model = solid, smoothed(floor, fastest), turning
        while done < PARTS:
            h = steps[i] * size / PARTS
            copy(u, guess)
            copy(drift, pace)
            if size == PARTS:
                stage_bends, stage_rates = given_bends[1:], given_rates[1:]
            else:
                for k, share in ((0, GAMMA), (1, 1.0)):
                    at = (done + share * size) / PARTS
                    bend_within(at, steps[i], given_bends, given_rates, own_bends[k], own_rates[k])
                stage_bends, stage_rates = own_bends, own_rates
            solved = step(state, h, stage_bends, stage_rates, model, guess, pace, k1, k2, after, body)
            parts += 1
            eta = _unevenness(h, slope, k1, k2, weight, arm)
            if size > 1 and not (solved and eta < tolerance):
                size = max(size // (2 if eta < _FAR * tolerance else 4), 1)
                continue
            # Not a number fails every comparison.
            if not (solved and abs(after[STATE_VX]) < SPEED_LIMIT and abs(after[STATE_VY]) < SPEED_LIMIT):
                return i, parts
            copy(after, state)
            copy(k2, slope)
            copy(guess, u)
            copy(pace, drift)
            done += size
            if size < PARTS and eta < _NEAR * tolerance and done % (2 * size) == 0:
                size *= 2
        while mark < marks.shape[0] and marks[mark] == i + 1:
            copy(state, states[mark])
            copy(u, velocities[mark])
            mark += 1
    return steps.shape[0], parts
