r"""Time steps of the analytical models and adaptive division of the steps.

Every valve event ends a time step (`TimeSteps`). When the slip velocity of a connector
changes sign, the friction force reverses over a velocity range of a few times the slip
speed ε. The reversal usually takes much less time than a step. A step that misses the
reversal has an error as large as the whole friction impulse. The models `complete` and
`simplified` therefore divide steps in which friction reverses.

**Error estimate.** A step of length h has two stages, at the times γ h and h after the
start of the step. The rate of change of momentum is k₀ at the start, k₁ at the first
stage and k₂ at the second stage. If the rate changes linearly, k₁ is the linear
interpolation between k₀ and k₂. The deviation of k₁ from this interpolation changes the
velocity of the mass M over the step by

$$ \eta = \frac{h}{M}\,\bigl|\,k_1 - (1-\gamma)\,k_0 - \gamma\,k_2\,\bigr| . $$

The estimate η is at least 0.7 times the error that a reversal of friction at any time
in the step causes. If friction is smooth, η is of third order in h. The rate of change
of angular momentum is divided by the radius of gyration of the straight body and thus
has the unit of a force.

A step with η above the tolerance is repeated in two or four substeps, which may be
divided again. If η is well below the tolerance, the next substep is twice as long. The
bends and bend rates of the substeps are interpolated by cubic Hermite polynomials
between the start and the stages of the step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, inlined, kernel_only
from srs_twin.plants.analytical.floor import with_reduced_slip_speed
from srs_twin.plants.analytical.kernels import (
    GAMMA,
    MOMENT,
    STATE_VX,
    STATE_VY,
    Bends,
    PrescribedModel,
    Samples,
    StepArrays,
    copy,
    is_slow,
    record,
    step,
)
from srs_twin.pneumatics import Trace


@dataclass(frozen=True)
class TimeSteps:
    """Immutable time steps of a schedule, which equal schedules may share.

    Attributes:
        ends: time from the start of the schedule to the end of each step, ascending,
            shape (steps,), s.
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
    ) -> TimeSteps:
        """Divide a schedule into steps that end at all samples and valve events.

        Args:
            span: length of the schedule, s.
            events: times of the valve events, ascending, s.
            samples: number of equally spaced samples, of which the last is at the end.
            longest: maximum length of a step, s.
            same: maximum difference between the times of two events, or of an event and
                the end of a step, that count as simultaneous, s.
        """
        per_sample = math.ceil(span / samples / longest * (1 - 1e-12))
        even = _even(span, samples, per_sample)
        if not len(events):
            return even
        grid = span / (samples * per_sample)
        steps = events / grid
        # Due to rounding, an event may differ slightly from the end of a step.
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
        """Start time and times of all stages, shape (1 + 2 · steps,), s."""
        times = np.zeros(1 + 2 * len(self.ends))
        times[1::2] = self._starts + GAMMA * self.lengths
        times[2::2] = self._starts + self.lengths
        return times

    def chunks(self, length: float) -> Iterator[tuple[float, float, TimeSteps]]:
        """Yield start (s), end (s) and steps of chunks that last about `length` (s)."""
        starts = self._starts
        firsts = np.unique(
            np.floor(self.ends / length * (1 - 1e-9)), return_index=True
        )[1]
        for first, last in zip(firsts, [*firsts[1:], len(self.ends)], strict=True):
            begun = float(starts[first])
            inside = (
                self.sample_steps[
                    (self.sample_steps > first) & (self.sample_steps <= last)
                ]
                - first
            )
            yield (
                begun,
                float(self.ends[last - 1]),
                TimeSteps(self.ends[first:last] - begun, inside),
            )

    @property
    def _starts(self) -> np.ndarray:
        return np.append(0.0, self.ends[:-1])


@lru_cache(maxsize=64)
def _even(span: float, samples: int, per_sample: int) -> TimeSteps:
    # The result is cached, because all ticks of a run have the same even steps.
    count = samples * per_sample
    ends = span / count * np.arange(1, count + 1)
    return TimeSteps(ends, np.arange(per_sample, count + 1, per_sample))


MAX_SUBSTEPS = 64
"""Maximum number of substeps of a step, a power of 2."""

# Ratios of the error estimate to the tolerance. Above the first ratio, the step is
# quartered, because half steps would fail as well. Below the second ratio, the length
# of the next substep is doubled.
_QUARTER_ABOVE = 4.0
_DOUBLE_BELOW = 0.5


@kernel_only
def _cubic(at, span, bends, first, out, row):  # type: ignore[no-untyped-def]
    # Evaluates the cubic Hermite polynomials and their derivatives at the fraction `at`
    # of an interval of length `span` (s).
    q0 = bends.bend[first]
    q1 = bends.bend[first + 1]
    r0 = bends.rate[first]
    r1 = bends.rate[first + 1]
    q = out.bend[row]
    r = out.rate[row]
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
def bend_within(at, h, bends, out, row):  # type: ignore[no-untyped-def]
    """Interpolate bends and bend rates within a step.

    Args:
        at: fraction of the step, 0 to 1.
        h: length of the step, s.
        bends: bends and rates at the start, first stage and end of the step, shape (3,
            segments).
        out: output for bends and rates, shape (rows, segments).
        row: index of the output row.
    """
    if at < GAMMA:
        _cubic(at / GAMMA, GAMMA * h, bends, 0, out, row)
    else:
        rest = 1 - GAMMA
        _cubic((at - GAMMA) / rest, rest * h, bends, 1, out, row)


@kernel_only
def _step_error(h, k0, k1, k2, weight, arm):  # type: ignore[no-untyped-def]
    x = k1[STATE_VX] - (1 - GAMMA) * k0[STATE_VX] - GAMMA * k2[STATE_VX]
    y = k1[STATE_VY] - (1 - GAMMA) * k0[STATE_VY] - GAMMA * k2[STATE_VY]
    moment = (k1[MOMENT] - (1 - GAMMA) * k0[MOMENT] - GAMMA * k2[MOMENT]) / (
        weight * arm
    )
    return h * math.sqrt(x * x + y * y + moment * moment)


class PrescribedState(NamedTuple):
    """State of a body with prescribed bends.

    Attributes:
        state, rate: state in the layout of `kernels`, and time derivative of the state
            at the end of the previous step, shape (STATES,).
        velocity: velocity in the body frame (m/s) and yaw rate (rad/s), from which the
            next solve starts, shape (3,).
    """

    state: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray


class _AdvanceArrays(NamedTuple):
    step: StepArrays
    drift: np.ndarray
    stages: Bends


def advance(
    now: PrescribedState,
    steps: np.ndarray,
    trace: Trace,
    marks: np.ndarray,
    model: PrescribedModel,
    tolerance: float,
    samples: Samples,
) -> tuple[int, int]:
    """Advance a body with prescribed bends by several time steps.

    Args:
        now: state of the body, changed in place.
        steps: lengths of the steps, shape (steps,), s.
        trace: chamber states at the start and at the two stages of each step, 1 + 2 ·
            steps rows.
        marks: number of steps before each sample, ascending, shape (samples,).
        model: constants of body and floor.
        tolerance: maximum allowed error estimate η, m/s.
        samples: output for states and velocities at the samples, shapes (samples,
            STATES) and (samples, 3).

    Returns:
        Number of steps completed before the first failure, and number of computed
        substeps.
    """
    n = len(model.solid.mass)
    stages = Bends(np.zeros((2, n - 1)), np.zeros((2, n - 1)))
    workspace = _AdvanceArrays(StepArrays.of(n), np.zeros(3), stages)
    free = Bends(trace.bend, trace.bend_rate)
    done, substeps = _advance(
        now, steps, free, marks, model, tolerance, samples, workspace
    )
    return done, substeps


@inlined
def _fastest_point(u, rates, reach):  # type: ignore[no-untyped-def]
    fastest = max(abs(u[0]) + abs(u[1]), reach * abs(u[2]))
    for j in range(rates.shape[1]):
        fastest = max(fastest, reach * abs(rates[0, j]))
    return fastest


@inlined
def _fill_stages(done, size, length, bends, stages):  # type: ignore[no-untyped-def]
    # `done` and `size` are multiples of the minimum length of a substep.
    for stage in range(2):
        at = (done + (GAMMA if stage == 0 else 1.0) * size) / MAX_SUBSTEPS
        bend_within(at, length, bends, stages, stage)


@compiled
def _advance(now, steps, free, marks, model, tolerance, samples, workspace):  # type: ignore[no-untyped-def]
    u = now.velocity
    solid = model.solid
    drift = workspace.drift
    arrays = workspace.step
    k = arrays.rates
    reach = solid.pitch / 2
    n = solid.mass.shape[0]
    arm = solid.pitch * math.sqrt((n * n - 1) / 12)
    mark = substeps = 0
    for i in range(steps.shape[0]):
        bends = Bends(free.bend[2 * i : 2 * i + 3], free.rate[2 * i : 2 * i + 3])
        fastest = _fastest_point(u, bends.rate, reach)
        floor = with_reduced_slip_speed(model.floor, fastest)
        reduced = PrescribedModel(solid, floor, model.friction_moment)
        done = 0
        size = MAX_SUBSTEPS
        while done < MAX_SUBSTEPS:
            h = steps[i] * size / MAX_SUBSTEPS
            copy(u, arrays.guess)
            copy(drift, arrays.pace)
            stages = Bends(bends.bend[1:], bends.rate[1:])
            if size < MAX_SUBSTEPS:
                stages = workspace.stages
                _fill_stages(done, size, steps[i], bends, stages)
            solved = step(now.state, h, stages, reduced, arrays)
            substeps += 1
            eta = _step_error(h, now.rate, k[0], k[1], solid.weight, arm)
            if size > 1 and not (solved and eta < tolerance):
                size = max(size // (2 if eta < _QUARTER_ABOVE * tolerance else 4), 1)
                continue
            if not (solved and is_slow(arrays.after)):
                return i, substeps
            copy(arrays.after, now.state)
            copy(k[1], now.rate)
            copy(arrays.guess, u)
            copy(arrays.pace, drift)
            done += size
            fits_twice = size < MAX_SUBSTEPS and done % (2 * size) == 0
            if fits_twice and eta < _DOUBLE_BELOW * tolerance:
                size *= 2
        mark = record(now.state, u, marks, i + 1, mark, samples)
    return steps.shape[0], substeps
