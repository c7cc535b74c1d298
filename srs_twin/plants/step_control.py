r"""Step control of `complete` and `simplified`: short steps where the friction turns, long ones elsewhere.

Where the slip of a connector changes its sign, its friction turns from one side to the other within a few
times ε, mostly far less than a step. A step that takes such a turn at the wrong moment errs by an impulse.
The three rates of momentum that a step knows anyhow, k₀ at its start (the last stage of the step before),
k₁ and k₂, tell: as long as they change evenly, k₁ lies on the line between the other two. What it lies off,
over the step, as a velocity,

$$ \eta = \frac{h}{M}\,\bigl|\,k_1 - (1-\gamma)\,k_0 - \gamma\,k_2\,\bigr|, $$

is at least 0.7 of the error of a turn wherever in the step it falls, and of third order in h where friction
is smooth. The moment of momentum counts by the radius of gyration of a straight body. A step with η above the
tolerance is made anew in halves, each of which may be halved again; parts that fall well below it are doubled
again. Bends between the stages, where the chambers have told them, are cubics through bends and rates.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.plants.kernels import GAMMA, MOMENT, SPEED_LIMIT, STATES, VX, VY, step
from srs_twin.plants.kinematics import ROWS

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
    x = k1[VX] - (1 - GAMMA) * k0[VX] - GAMMA * k2[VX]
    y = k1[VY] - (1 - GAMMA) * k0[VY] - GAMMA * k2[VY]
    turning = (k1[MOMENT] - (1 - GAMMA) * k0[MOMENT] - GAMMA * k2[MOMENT]) / (weight * arm)
    return h * math.sqrt(x * x + y * y + turning * turning)


@compiled
def _copy(values, out):  # type: ignore[no-untyped-def]
    """Copy one array into another: a loop, for a slice is checked for overlap each time."""
    for j in range(out.shape[0]):
        out[j] = values[j]


@compiled
def advance(  # type: ignore[no-untyped-def]
    state, slope, steps, bends, rates, marks, solid, floor, turning, tolerance, u, seen, velocities
):
    """Advance `state` in place over the given steps.

    Args:
        state: shape (STATES,), see the indices in `kernels`.
        slope: its rates, shape (STATES,); kept from call to call.
        steps: step lengths, shape (steps,), s.
        bends: bends at the start and at each step's two stages, shape (1 + 2 steps, segments), rad.
        rates: bend rates there, rad/s.
        marks: numbers of steps after which to look, ascending, shape (samples,).
        solid: the body, a `kinematics.Solid`.
        floor: a `floor.Floor`.
        turning: whether the friction's moment about the centre of mass acts.
        tolerance: of η, m/s.
        u: velocity in the body frame and yaw rate, shape (3,); kept from call to call as first guess.
        seen: out, states at the marks, shape (samples, STATES).
        velocities: out, u there, shape (samples, 3).

    Returns:
        How many steps were made, fewer if one failed, and in how many parts, those made anew included.
    """
    n = solid.mass.shape[0]
    model, body = (solid, floor, turning), np.empty((ROWS, n))
    weight = solid.mass.sum()
    arm = (solid.length + solid.gap) * math.sqrt((n * n - 1) / 12)
    k1, k2, after = np.empty(STATES), np.empty(STATES), np.empty(STATES)
    drift, guess, pace = np.zeros(3), np.empty(3), np.empty(3)
    own_bends, own_rates = np.empty((2, n - 1)), np.empty((2, n - 1))
    mark = parts = 0
    for i in range(steps.shape[0]):
        given_bends, given_rates = bends[2 * i : 2 * i + 3], rates[2 * i : 2 * i + 3]
        done, size = 0, PARTS
        while done < PARTS:
            h = steps[i] * size / PARTS
            _copy(u, guess)
            _copy(drift, pace)
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
            if not (solved and abs(after[VX]) < SPEED_LIMIT and abs(after[VY]) < SPEED_LIMIT):
                return i, parts
            _copy(after, state)
            _copy(k2, slope)
            _copy(guess, u)
            _copy(pace, drift)
            done += size
            if size < PARTS and eta < _NEAR * tolerance and done % (2 * size) == 0:
                size *= 2
        while mark < marks.shape[0] and marks[mark] == i + 1:
            seen[mark] = state
            velocities[mark] = u
            mark += 1
    return steps.shape[0], parts
