r"""Time steps of the analytical models, and the adaptive substeps of `complete` and `simplified`.

Steps end on valve events (`Steps`). Where the slip of a connector changes its sign, its
friction reverses within a few times the slip speed ε, in a time mostly far shorter than
a step. A step that misses the time of such a reversal makes the error of a whole
impulse. `complete` and `simplified` divide steps where friction reverses.

**Error estimate.** A step knows three rates of momentum: k₀ at its start, which is the
last stage of the previous step, and k₁ and k₂ at its stages. If they change linearly,
k₁ is on the line between the other two. Its deviation, as a velocity change over the
step,

$$ \eta = \frac{h}{M}\,\bigl|\,k_1 - (1-\gamma)\,k_0 - \gamma\,k_2\,\bigr|, $$

is at least 0.7 times the error of a reversal anywhere in the step, and of third order
in h where friction is smooth. The rate of the angular momentum is divided by the radius
of gyration of the straight body. A step with η above the tolerance is repeated in
halves, which may be divided again; substeps well below the tolerance are doubled. Bends
within a step are cubic Hermite polynomials through the bends and rates that the
chambers give at its stages.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, kernel_only
from srs_twin.plants.analytical.floor import FloorFriction, with_reduced_slip_speed
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
from srs_twin.plants.analytical.kinematics import ROWS, BodyParameters
from srs_twin.pneumatics import Trace


@dataclass(frozen=True)
class Steps:
    """Time steps of a schedule; equal schedules without valve events share an object, so do not modify it.

    Attributes:
        ends: end of each step, ascending, from the start of the schedule, shape
            (steps,), s.
        sample_steps: number of steps before each sample, ascending, shape (samples,).
    """

    ends: np.ndarray
    sample_steps: np.ndarray

    @classmethod
    def between(
        cls,
        span: float,
        events: np.ndarray,
        samples: int,
        *,
        longest: float,
        same: float,
    ) -> Steps:
        """Return steps on an even grid that contains the samples, and on the valve events.

        Args:
            span: length of the schedule, s.
            events: times of valve events, ascending, s.
            samples: number of equally spaced samples, the last one at the end.
            longest: longest step, s.
            same: events that are closer to the end of another step, or to each other,
                do not end a step, s.
        """
        per_sample = math.ceil(span / samples / longest * (1 - 1e-12))
        even = _even(span, samples, per_sample)
        if not len(events):
            return even
        grid = span / (samples * per_sample)
        steps = events / grid
        # On either side of a grid point, because of rounding.
        events = events[np.abs(steps - np.round(steps)) * grid > same]
        events = events[np.diff(events, prepend=-1.0) > same]
        sample_steps = even.sample_steps + np.searchsorted(
            events, even.ends[even.sample_steps - 1]
        )
        return cls(np.sort(np.concatenate([even.ends, events])), sample_steps)

    @cached_property
    def lengths(self) -> np.ndarray:
        """Lengths of the steps, shape (steps,), s."""
        lengths: np.ndarray = self.ends - self._starts
        return lengths

    @cached_property
    def stage_times(self) -> np.ndarray:
        """Start of the schedule and the two stages of each step, shape (1 + 2 · steps,), s."""
        times = np.zeros(1 + 2 * len(self.ends))
        times[1::2] = self._starts + GAMMA * self.lengths
        times[2::2] = self._starts + self.lengths
        return times

    def chunks(self, length: float) -> Iterator[tuple[float, float, Steps]]:
        """Yield begin, end and steps of chunks with about the given length (s), at least one step each."""
        firsts = np.unique(
            np.floor(self.ends / length * (1 - 1e-9)), return_index=True
        )[1]
        for first, last in zip(firsts, [*firsts[1:], len(self.ends)], strict=True):
            begun = float(self.ends[first - 1]) if first else 0.0
            inside = (
                self.sample_steps[
                    (self.sample_steps > first) & (self.sample_steps <= last)
                ]
                - first
            )
            yield (
                begun,
                float(self.ends[last - 1]),
                Steps(self.ends[first:last] - begun, inside),
            )

    @property
    def _starts(self) -> np.ndarray:
        return np.append(0.0, self.ends[:-1])


@lru_cache(maxsize=64)
def _even(span: float, samples: int, per_sample: int) -> Steps:
    """Return the steps of the even grid; the cache serves a controller's ticks, which all have the same."""
    count = samples * per_sample
    ends = span / count * np.arange(1, count + 1)
    return Steps(ends, np.arange(per_sample, count + 1, per_sample))


MAX_SUBSTEPS = 64
"""Largest number of substeps of a step, a power of 2."""

# Ratios of error to tolerance, 1. Above the first one a step is quartered, because
# halves would fail again; below the second one the next substep is doubled.
_QUARTER_ABOVE = 4.0
_DOUBLE_BELOW = 0.5


@kernel_only
def _cubic(at, span, q0, q1, r0, r1, q, r):  # type: ignore[no-untyped-def]  # noqa: D417
    """Fill bends and rates at a fraction of an interval from those at its ends (cubic Hermite polynomial).

    Args:
        at: fraction of the interval, 0 to 1.
        span: length of the interval, s.
        q0, q1: bends at its ends, shape (segments,), rad.
        r0, r1: bend rates at its ends, shape (segments,), rad/s.
        q: out, bends.
        r: out, bend rates.
    """
    rest = 1 - at
    rise = at * at * (3 - 2 * at)
    begins = at * rest * rest * span
    ends = at * at * rest * span
    rising = 6 * at * rest / span
    beginning = rest * (1 - 3 * at)
    ending = at * (3 * at - 2)
    for j in range(q.shape[0]):
        change = q1[j] - q0[j]
        q[j] = q0[j] + rise * change + begins * r0[j] - ends * r1[j]
        r[j] = rising * change + beginning * r0[j] + ending * r1[j]


@compiled
def bend_within(at, h, bends, rates, q, r):  # type: ignore[no-untyped-def]
    """Fill bends and rates at the fraction `at` of a step of length h (s).

    Args:
        at: fraction of the step, 0 to 1.
        h: length of the step, s.
        bends: at the start, first stage and end of the step, shape (3, segments), rad.
        rates: bend rates there, shape (3, segments), rad/s.
        q: out, bends.
        r: out, bend rates.
    """
    if at < GAMMA:
        _cubic(at / GAMMA, GAMMA * h, bends[0], bends[1], rates[0], rates[1], q, r)
    else:
        _cubic(
            (at - GAMMA) / (1 - GAMMA),
            (1 - GAMMA) * h,
            bends[1],
            bends[2],
            rates[1],
            rates[2],
            q,
            r,
        )


@kernel_only
def _step_error(h, k0, k1, k2, weight, arm):  # type: ignore[no-untyped-def]
    """Return η of a step (module docstring), m/s."""
    x = k1[STATE_VX] - (1 - GAMMA) * k0[STATE_VX] - GAMMA * k2[STATE_VX]
    y = k1[STATE_VY] - (1 - GAMMA) * k0[STATE_VY] - GAMMA * k2[STATE_VY]
    moment = (k1[MOMENT] - (1 - GAMMA) * k0[MOMENT] - GAMMA * k2[MOMENT]) / (
        weight * arm
    )
    return h * math.sqrt(x * x + y * y + moment * moment)


class StepArrays(NamedTuple):
    """Work arrays of `advance` for N connectors.

    Attributes:
        body: posed body, shape (ROWS, N).
        rates: rates of the state at the stages, shape (2, STATES).
        after: state after a substep, shape (STATES,).
        drift: rates of change of the velocities, and those after a substep, shape (2,
            3).
        guess: velocities after a substep, shape (3,).
        bends: bends and bend rates at the stages of a substep, shape (2, 2, segments).
    """

    body: np.ndarray
    rates: np.ndarray
    after: np.ndarray
    drift: np.ndarray
    guess: np.ndarray
    bends: np.ndarray

    @classmethod
    def of(cls, n: int) -> StepArrays:
        """Return the arrays for n connectors."""
        shapes = [(ROWS, n), (2, STATES), (STATES,), (2, 3), (3,), (2, 2, n - 1)]
        return cls(*map(np.zeros, shapes))


def advance(
    now: tuple[np.ndarray, ...],
    steps: np.ndarray,
    trace: Trace,
    marks: np.ndarray,
    model: tuple[BodyParameters, FloorFriction, bool],
    tolerance: float,
    samples: tuple[np.ndarray, np.ndarray],
) -> tuple[int, int]:
    """Advance a body in place over given steps.

    Args:
        now: state (indices in `kernels`) and its rates, shape (STATES,) each; velocity
            in the body frame and yaw rate, shape (3,). The latter two are kept between
            calls as first guesses.
        steps: lengths of the steps, shape (steps,), s.
        trace: trace of the chambers at the start and the two stages of each step, 1 + 2
            steps rows.
        marks: number of steps before each sample, ascending, shape (samples,).
        model: body, floor, and whether the friction moment acts.
        tolerance: largest allowed η, m/s.
        samples: out, states and velocities at the samples, shapes (samples, STATES) and
            (samples, 3).

    Returns:
        The number of completed steps, which is smaller than requested after a failure,
        and the number of substeps including repeated ones.
    """
    bends = (trace.bend, trace.bend_rate)
    work = StepArrays.of(len(model[0].mass))
    done, substeps = _advance(now, steps, bends, marks, model, tolerance, samples, work)
    return done, substeps


@compiled
def _advance(now, steps, free, marks, model, tolerance, samples, work):  # type: ignore[no-untyped-def]
    """Advance a body, see `advance`; `free` are the bends and bend rates of the trace."""
    (state, slope, u), (states, velocities) = now, samples
    (solid, floor, friction_moment), (bends, rates) = model, free
    body = work.body
    k = work.rates
    after = work.after
    guess = work.guess
    drift = work.drift[0]
    pace = work.drift[1]
    mid_bends = work.bends[0]
    mid_rates = work.bends[1]
    reach = solid.pitch / 2
    n = solid.mass.shape[0]
    arm = solid.pitch * math.sqrt((n * n - 1) / 12)
    mark = substeps = 0
    for i in range(steps.shape[0]):
        step_bends = bends[2 * i : 2 * i + 3]
        step_rates = rates[2 * i : 2 * i + 3]
        done = 0
        size = MAX_SUBSTEPS
        fastest = max(abs(u[0]) + abs(u[1]), reach * abs(u[2]))
        for j in range(n - 1):
            fastest = max(fastest, reach * abs(step_rates[0, j]))
        model = solid, with_reduced_slip_speed(floor, fastest), friction_moment
        while done < MAX_SUBSTEPS:
            h = steps[i] * size / MAX_SUBSTEPS
            copy(u, guess)
            copy(drift, pace)
            if size == MAX_SUBSTEPS:
                stage_bends = step_bends[1:]
                stage_rates = step_rates[1:]
            else:
                for stage in range(2):
                    at = (done + (GAMMA if stage == 0 else 1.0) * size) / MAX_SUBSTEPS
                    bend_within(
                        at,
                        steps[i],
                        step_bends,
                        step_rates,
                        mid_bends[stage],
                        mid_rates[stage],
                    )
                stage_bends = mid_bends
                stage_rates = mid_rates
            solved = step(
                state, h, stage_bends, stage_rates, model, guess, pace, k, after, body
            )
            substeps += 1
            eta = _step_error(h, slope, k[0], k[1], solid.weight, arm)
            if size > 1 and not (solved and eta < tolerance):
                size = max(size // (2 if eta < _QUARTER_ABOVE * tolerance else 4), 1)
                continue
            # A NaN fails every comparison.
            if not (
                solved
                and abs(after[STATE_VX]) < SPEED_LIMIT
                and abs(after[STATE_VY]) < SPEED_LIMIT
            ):
                return i, substeps
            copy(after, state)
            copy(k[1], slope)
            copy(guess, u)
            copy(pace, drift)
            done += size
            if (
                size < MAX_SUBSTEPS
                and eta < _DOUBLE_BELOW * tolerance
                and done % (2 * size) == 0
            ):
                size *= 2
        while mark < marks.shape[0] and marks[mark] == i + 1:
            copy(state, states[mark])
            copy(u, velocities[mark])
            mark += 1
    return steps.shape[0], substeps
