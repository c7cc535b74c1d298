r"""Compiled kernel of the analytical models whose bends are given, `complete` and `simplified`.

Point masses m_i sit at the connectors; the bends q(t) are given by the actuators; the pose of the body is
what moves. With ρ_i(q) the connectors about the centre of mass in the frame of the mean heading θ and
φ_i(q) their headings in it,

$$ M \dot v = \sum f_i, \qquad \dot L = \sum \bigl(r_i - r_c\bigr) \times f_i + n_i, \qquad
   L = I(q)\,\dot\theta + h(q, \dot q), $$

with I = Σ m_i |ρ_i|² + J_i, h = Σ m_i ρ_i × ρ̇_i + J_i φ̇_i, J_i = 0 for point masses, and n_i the yaw moment
of connector i's wheels. Using the moment of momentum L as the state needs no q̈, so its jumps at valve events
cost no accuracy. This is Eq. 11 contracted with eᵀ (segment torques cancel).
The friction is stiff, so the three velocities are solved implicitly with the two-stage, second-order,
L-stable SDIRK method of Alexander (1977), Newton's method in each stage. Friction has a convex potential; its
slope along a step tells whether the step was too long.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.plants.floor import floor_forces
from srs_twin.plants.kinematics import COLUMNS, pose_body

GAMMA = 1 - math.sqrt(0.5)
"""Diagonal of the SDIRK2 method: stages at GAMMA·h and h."""

X, Y, HEADING, VX, VY, MOMENT, SPENT = range(7)
"""Indices into the state: centre of mass (m), mean heading (rad), its velocity (m/s), L (kg·m²/s), and the
energy that the floor has taken (J)."""

STATES = 7
SPEED_LIMIT = 100.0
"""m/s: beyond it a state is not plausible."""

_NEWTON_STEPS = 100
_NEWTON_TOLERANCE = 1e-8
_OVERSHOT = 0.1  # rise after a Newton step, over the fall before it, from which it was too long


@compiled
def _solve3(a, b, x):  # type: ignore[no-untyped-def]
    """Solve the 3 × 3 system a x = b by Cramer's rule."""
    c0 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    c1 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
    c2 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
    scale = 1 / (a[0, 0] * c0 + a[0, 1] * c1 + a[0, 2] * c2)
    x[0] = scale * (
        b[0] * c0
        + b[1] * (a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2])
        + b[2] * (a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1])
    )
    x[1] = scale * (
        b[0] * c1
        + b[1] * (a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0])
        + b[2] * (a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2])
    )
    x[2] = scale * (
        b[0] * c2
        + b[1] * (a[0, 1] * a[2, 0] - a[0, 0] * a[2, 1])
        + b[2] * (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0])
    )


@compiled
def _turned(c, s, angle):  # type: ignore[no-untyped-def]
    """Return cosine and sine of an angle that grows by a little, by their series: sines are dear."""
    if abs(angle) > 0.02:  # rad: there the next term is 3e-16
        turned = math.atan2(s, c) + angle
        return math.cos(turned), math.sin(turned)
    p = angle * angle
    dc, ds = 1 - p / 2 * (1 - p / 12 * (1 - p / 30)), angle * (1 - p / 6 * (1 - p / 20))
    return c * dc - s * ds, s * dc + c * ds


@compiled
def _stage(known, a, q, rate, weight, solid, floor, turning, u, k, work):  # type: ignore[no-untyped-def]
    """Solve one implicit stage Y = known + a f(Y) from the guess `u`; fill k = f(Y); return the success."""
    body, total, matrix, residual, step = work
    inertia, moment = pose_body(q, rate, solid, body)
    share = 0.0  # of the last step that has been made
    fall = 0.0  # of the potential along that step, at its start
    step[:] = 0.0
    converged = False
    power = 0.0
    c, s = math.cos(known[HEADING] + a * u[2]), math.sin(known[HEADING] + a * u[2])
    for _ in range(_NEWTON_STEPS):
        bx, by = known[VX] * c + known[VY] * s, known[VY] * c - known[VX] * s
        power = floor_forces(body, solid.mass, u, floor, total, matrix)
        if not turning:
            power += total[2] * u[2]
            total[2] = 0.0
            matrix[2] = 0.0
        residual[0] = weight * (u[0] - bx) - a * total[0]
        residual[1] = weight * (u[1] - by) - a * total[1]
        residual[2] = inertia * u[2] + moment - known[MOMENT] - a * total[2]
        falls = residual[0] * step[0] + residual[1] * step[1] + residual[2] * step[2]
        if falls < -_OVERSHOT * fall:
            # Past the lowest point along the step, across a kink of the friction law: some way back.
            back = share * min(max(fall / (fall - falls), 0.1), 0.7)
            for j in range(3):
                u[j] += (share - back) * step[j]
            c, s = _turned(c, s, a * (share - back) * step[2])
            share = back
            continue
        for j in range(3):
            for m in range(3):
                matrix[j, m] *= -a
        matrix[0, 0] += weight
        matrix[1, 1] += weight
        matrix[2, 2] += inertia
        matrix[0, 2] -= weight * a * by
        matrix[1, 2] += weight * a * bx
        _solve3(matrix, residual, step)
        fall, share = 0.0, 1.0
        for j in range(3):
            u[j] -= step[j]
            fall += residual[j] * step[j]
        c, s = _turned(c, s, -a * step[2])
        if abs(step[0]) + abs(step[1]) + 0.1 * abs(step[2]) < _NEWTON_TOLERANCE:
            converged = True
            break
    # What the stage's equation says of f(Y) costs no further evaluation.
    k[X], k[Y], k[HEADING] = u[0] * c - u[1] * s, u[0] * s + u[1] * c, u[2]
    k[VX], k[VY] = (k[X] - known[VX]) / a, (k[Y] - known[VY]) / a
    k[MOMENT] = (inertia * u[2] + moment - known[MOMENT]) / a
    k[SPENT] = power
    return converged


@compiled
def advance(state, steps, bends, rates, marks, solid, floor, turning, u, seen, velocities):  # type: ignore[no-untyped-def]
    """Advance `state` in place over the given steps; return how many were made: fewer, if one failed.

    Args:
        state: shape (STATES,), see the indices above.
        steps: step lengths, shape (steps,), s.
        bends: bends at each step's two stages, shape (steps, 2, segments), rad.
        rates: bend rates there, rad/s.
        marks: numbers of steps after which to look, ascending, shape (samples,).
        solid: the body, a `kinematics.Solid`.
        floor: a `floor.Floor`.
        turning: whether the friction's moment about the centre of mass acts.
        u: velocity in the body frame and yaw rate, shape (3,); kept from call to call as first guess.
        seen: out, states at the marks, shape (samples, STATES).
        velocities: out, u there, shape (samples, 3).
    """
    work = (
        np.empty((solid.mass.shape[0], COLUMNS)), np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3),
    )  # fmt: skip
    k1, k2, known = np.empty(STATES), np.empty(STATES), np.empty(STATES)
    last, drift = u.copy(), np.zeros(3)
    weight = solid.mass.sum()
    mark = 0
    for i in range(steps.shape[0]):
        h = steps[i]
        a = GAMMA * h
        # Velocities drawn on in a straight line from stage to stage save every second of Newton's steps.
        for j in range(3):
            last[j] = u[j]
            u[j] += drift[j] * a
        fine = _stage(state, a, bends[i, 0], rates[i, 0], weight, solid, floor, turning, u, k1, work)
        for j in range(STATES):
            known[j] = state[j] + (1 - GAMMA) * h * k1[j]
        for j in range(3):
            drift[j] = (u[j] - last[j]) / a
            last[j] = u[j]
            u[j] += drift[j] * (h - a)
        fine &= _stage(known, a, bends[i, 1], rates[i, 1], weight, solid, floor, turning, u, k2, work)
        for j in range(STATES):
            state[j] = known[j] + a * k2[j]
        for j in range(3):
            drift[j] = (u[j] - last[j]) / (h - a)
        # Not a number fails every comparison.
        if not (fine and abs(state[VX]) < SPEED_LIMIT and abs(state[VY]) < SPEED_LIMIT):
            return i
        while mark < marks.shape[0] and marks[mark] == i + 1:
            seen[mark] = state
            velocities[mark] = u
            mark += 1
    return steps.shape[0]
