r"""Compiled kernel of the `compliant` analytical model.

Kinematics and floor are those of `complete` (`kernels`), but the bends q are unknowns. With the velocities
u = (v_c in the frame of the mean heading, θ̇, q̇), every connector has a velocity along and across its heading
and a yaw rate that are linear in u: three rows R_i(q). Lagrange's equations in Hamilton's variables are

$$ p = M(q)\,u, \quad M = \sum m_i \bigl(R_{t,i}^T R_{t,i} + R_{n,i}^T R_{n,i}\bigr), \qquad
   \dot p_q = \frac{\partial T}{\partial q} + \tau - k q - c \dot q + \sum R_i^T f_i, $$

with T the kinetic energy, τ = k G (p⁺ − p⁻) the chambers' moment and f_i a connector's friction force and
moment. The first three momenta are M v_c and L, as in `complete`: the floor alone changes them, so without
friction the scheme keeps them exactly, and no acceleration appears.

SDIRK2 as in `kernels`; a stage solves for u by Newton's method. Its matrix holds friction, stiffness, damping
and, as an odd part, the forces that come of turning; what friction and M change with q is left out (of order
GAMMA² h²). The odd part matters: at the straight shape connectors that turn to and fro move no point mass, so
M is singular there and only damping holds that motion. Friction has a convex potential; its slope along a
step tells whether the step was too long.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compiled import allocating, compiled
from srs_twin.plants.analytical.floor import connector_friction, smoothed
from srs_twin.plants.analytical.kernels import (
    GAMMA,
    HEADING,
    MOMENT,
    SPEED_LIMIT,
    SPENT,
    STATE_VX,
    STATE_VY,
    STATE_X,
    STATE_Y,
    STATES,
    copy,
)
from srs_twin.plants.analytical.kinematics import ROWS, fill_rows, pose_body

BENDS = STATES
"""Index of the first bend in the state; the first are those of `kernels`, the bends' momenta end it."""

_NEWTON_STEPS = 1000  # at rest on a slope the law is a kink
_NEWTON_TOLERANCE = 1e-9
_OVERSHOT = 0.1  # rise after a Newton step, over the fall before it, from which it was too long


@compiled
def add_connectors(u, a, solid, floor, rows, rates, momentum, force, matrix):  # type: ignore[no-untyped-def]
    """Add every connector's momentum, ∂T/∂q and friction, and its part of Newton's matrix.

    Args:
        u: velocities, shape (3 + segments,).
        a: s.
        solid: the body.
        floor: the floor.
        rows: what `fill_rows` filled.
        rates: likewise.
        momentum: added to, shape (3 + segments,).
        force: added to, same shape.
        matrix: added to, shape (3 + segments, 3 + segments).

    Returns:
        The power that friction takes, W.
    """
    mass, inertia = solid.mass, solid.inertia
    size = u.shape[0]
    power = 0.0
    for i in range(mass.shape[0]):
        row, rate = rows[i], rates[i]
        along = across = spin = 0.0
        for k in range(size):
            along += row[0, k] * u[k]
            across += row[1, k] * u[k]
            spin += row[2, k] * u[k]
        t, n, m, tt, tn, tm, nn, nm, mm = connector_friction(along, across, spin, mass[i] * floor.down, floor)
        power -= t * along + n * across + m * spin
        p_t, p_n, p_m = mass[i] * along, mass[i] * across, inertia[i] * spin
        tt, nn, mm = mass[i] - a * tt, mass[i] - a * nn, inertia[i] - a * mm
        tn, tm, nm = -a * tn, -a * tm, -a * nm
        for j in range(size):
            x, y, z = row[0, j], row[1, j], row[2, j]
            momentum[j] += x * p_t + y * p_n + z * p_m
            force[j] += x * t + y * n + z * m + rate[0, j] * p_t + rate[1, j] * p_n
            on_t, on_n, on_m = x * tt + y * tn + z * tm, x * tn + y * nn + z * nm, x * tm + y * nm + z * mm
            turn = a * mass[i]
            for k in range(j + 1):
                even = on_t * row[0, k] + on_n * row[1, k] + on_m * row[2, k]
                odd = x * rate[0, k] + y * rate[1, k] - row[0, k] * rate[0, j] - row[1, k] * rate[1, j]
                matrix[j, k] += even + turn * odd
                if k < j:
                    matrix[k, j] += even - turn * odd
    return power


@compiled
def balance(q, u, moment, a, model, momentum, force, matrix, work):  # type: ignore[no-untyped-def]
    """Evaluate both sides of Lagrange's equations in the frame of the mean heading.

    Args:
        q: bends, shape (segments,), rad.
        u: velocity of the centre of mass in that frame (m/s), yaw rate and bend rates (rad/s),
            shape (3 + segments,).
        moment: what the chambers exert on each segment, N·m.
        a: s; 0 makes `matrix` the mass matrix.
        model: solid; stiffness k (N·m/rad) and damping c (N·m·s/rad) of a segment; floor.
        momentum: out, p, shape (3 + segments,).
        force: out, dp/dt, same shape.
        matrix: out, slope of p − a dp/dt by u while q moves by a u, but for some terms in a².
        work: arrays of shapes (ROWS, N), (N, 3, 3 + segments) and (N, 2, 3 + segments).

    Returns:
        The power that friction takes, W.
    """
    solid, (stiffness, damping), floor = model
    body, rows, rates = work
    pose_body(q, u[3:], solid, body)
    fill_rows(body, q, u, solid, rows, rates)
    momentum[:] = 0.0
    force[:] = 0.0
    matrix[:] = 0.0
    power = add_connectors(u, a, solid, floor, rows, rates, momentum, force, matrix)
    for j in range(q.shape[0]):
        force[3 + j] += moment[j] - stiffness * q[j] - damping * u[3 + j]
        matrix[3 + j, 3 + j] += a * damping + a * a * stiffness
    return power


@compiled
def _solve(matrix, b, x):  # type: ignore[no-untyped-def]
    """Solve matrix x = b by elimination in place; without pivots, for the even part is positive definite."""
    size = b.shape[0]
    for j in range(size):
        x[j] = b[j]
    for j in range(size):
        for i in range(j + 1, size):
            factor = matrix[i, j] / matrix[j, j]
            x[i] -= factor * x[j]
            for k in range(j + 1, size):
                matrix[i, k] -= factor * matrix[j, k]
    for j in range(size - 1, -1, -1):
        value = x[j]
        for k in range(j + 1, size):
            value -= matrix[j, k] * x[k]
        x[j] = value / matrix[j, j]


@compiled
def _residual(known, a, u, weight, floor, momentum, force, out):  # type: ignore[no-untyped-def]
    """Fill out = p(u) − p_known − a dp/dt in the frame of the mean heading."""
    heading = known[HEADING] + a * u[2]
    c, s = math.cos(heading), math.sin(heading)
    size = u.shape[0]
    for j in range(size):
        out[j] = momentum[j] - a * force[j]
    v_x, v_y = known[STATE_VX] + a * floor.pull_x, known[STATE_VY] + a * floor.pull_y
    out[0] -= weight * (v_x * c + v_y * s)
    out[1] -= weight * (v_y * c - v_x * s)
    out[2] -= known[MOMENT]
    for j in range(3, size):
        out[j] -= known[BENDS + size - 6 + j]


@compiled
def _stage(known, a, moment, model, u, k, work):  # type: ignore[no-untyped-def]
    """Solve one implicit stage Y = known + a f(Y) from the guess `u`; fill k = f(Y); return the success."""
    momentum, force, matrix, posed, q, residual, step = work
    segments, size = moment.shape[0], u.shape[0]
    floor, weight = model[2], model[0].mass.sum()
    share = 0.0  # of the last step that has been made
    fall = 0.0  # of the potential along that step, at its start
    converged = False
    power = 0.0
    for _ in range(_NEWTON_STEPS):
        for j in range(segments):
            q[j] = known[BENDS + j] + a * u[3 + j]
        power = balance(q, u, moment, a, model, momentum, force, matrix, posed)
        _residual(known, a, u, weight, floor, momentum, force, residual)
        falls = 0.0
        for j in range(size):
            falls += residual[j] * step[j]
        if falls < -_OVERSHOT * fall:
            # Past the lowest point along the step, across a kink of the friction law: some way back.
            back = share * min(max(fall / (fall - falls), 0.1), 0.7)
            for j in range(size):
                u[j] += (share - back) * step[j]
            share = back
            continue
        _solve(matrix, residual, step)
        fall, share, longest = 0.0, 1.0, 0.0
        for j in range(size):
            u[j] -= step[j]
            fall += residual[j] * step[j]
            longest = max(longest, abs(step[j]) * (1.0 if j < 2 else 0.1))
        if longest < _NEWTON_TOLERANCE:
            converged = True
            break
    for j in range(size):
        step[j] = 0.0
    heading = known[HEADING] + a * u[2]
    c, s = math.cos(heading), math.sin(heading)
    k[STATE_X] = u[0] * c - u[1] * s
    k[STATE_Y] = u[0] * s + u[1] * c
    k[STATE_VX] = (force[0] * c - force[1] * s) / weight + floor.pull_x
    k[STATE_VY] = (force[0] * s + force[1] * c) / weight + floor.pull_y
    power -= weight * (floor.pull_x * k[STATE_X] + floor.pull_y * k[STATE_Y])
    k[HEADING], k[MOMENT], k[SPENT] = u[2], force[2], power
    for j in range(segments):
        k[BENDS + j], k[BENDS + segments + j] = u[3 + j], force[3 + j]
    return converged


@compiled
def _draw_on(u, rate, time, last):  # type: ignore[no-untyped-def]
    """Keep u in `last` and add rate · time to it."""
    for j in range(u.shape[0]):
        last[j] = u[j]
        u[j] += rate[j] * time


@allocating
def advance(now, steps, moments, marks, model, seen):  # type: ignore[no-untyped-def]
    """Advance a body in place over the given steps; return how many were made: fewer, if one failed.

    Args:
        now: state: that of `kernels`, bends (rad), their momenta (kg·m²/s), shape (STATES + 2 segments,); and
            velocities as in `balance`, kept from call to call as Newton's first guess.
        steps: step lengths, shape (steps,), s.
        moments: chambers' moments at each step's two stages, shape (steps, 2, segments), N·m.
        marks: numbers of steps after which to look, ascending, shape (samples,).
        model: as in `balance`.
        seen: out, states and velocities at the marks, shapes (samples, …).
    """
    (state, u), (states, velocities) = now, seen
    solid, spring, floor = model
    reach = (solid.length + solid.gap) / 2
    n, size = model[0].mass.shape[0], u.shape[0]
    posed = np.empty((ROWS, n)), np.empty((n, 3, size)), np.empty((n, 2, size))
    sides = np.empty(size), np.empty(size), np.empty((size, size))
    work = (*sides, posed, np.empty(n - 1), np.empty(size), np.zeros(size))
    k1, k2, known = np.empty_like(state), np.empty_like(state), np.empty_like(state)
    last, drift = u.copy(), np.zeros(size)
    mark = 0
    for i in range(steps.shape[0]):
        h = steps[i]
        a = GAMMA * h
        fastest = abs(u[0]) + abs(u[1])
        for j in range(2, size):
            fastest = max(fastest, reach * abs(u[j]))
        model = solid, spring, smoothed(floor, fastest)
        # Velocities drawn on in a straight line from stage to stage save every second of Newton's steps.
        _draw_on(u, drift, a, last)
        fine = _stage(state, a, moments[i, 0], model, u, k1, work)
        for j in range(state.shape[0]):
            known[j] = state[j] + (1 - GAMMA) * h * k1[j]
        for j in range(size):
            drift[j] = (u[j] - last[j]) / a
        _draw_on(u, drift, h - a, last)
        fine &= _stage(known, a, moments[i, 1], model, u, k2, work)
        for j in range(state.shape[0]):
            state[j] = known[j] + a * k2[j]
        for j in range(size):
            drift[j] = (u[j] - last[j]) / (h - a)
        # Not a number fails every comparison.
        if not (fine and abs(state[STATE_VX]) < SPEED_LIMIT and abs(state[STATE_VY]) < SPEED_LIMIT):
            return i
        while mark < marks.shape[0] and marks[mark] == i + 1:
            copy(state, states[mark])
            copy(u, velocities[mark])
            mark += 1
    return steps.shape[0]
