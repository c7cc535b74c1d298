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
from numba import njit

from srs_twin import shape
from srs_twin.plants import kernels
from srs_twin.plants.kernels import GAMMA, HEADING, MOMENT, VX, VY, X, Y
from srs_twin.spec import GRAVITY

BENDS = MOMENT + 1
"""Index of the first bend in the state; the first six are those of `kernels`, the bends' momenta end it."""

_NEWTON_STEPS = 100
_NEWTON_TOLERANCE = 1e-9
_OVERSHOT = 0.1  # rise after a Newton step, over the fall before it, from which it was too long


_chord = njit(cache=True)(shape.chord)
_chord_slope = njit(cache=True)(shape.chord_slope)
_chord_curvature = njit(cache=True)(shape.chord_curvature)


@njit(cache=True)
def fill_rows(body, q, u, mass, length, gap, rows, rates):  # type: ignore[no-untyped-def]
    """Fill how each connector's motion depends on the velocities u, and how fast that changes.

    Args:
        body: what `kernels.pose_body` filled, shape (N, 6).
        q: bends, shape (segments,), rad.
        u: velocities, shape (3 + segments,).
        mass: shape (N,), kg.
        length: l, m.
        gap: L_o, m.
        rows: out, shape (N, 3, 3 + segments): velocity along, across, and yaw rate by u.
        rates: out, shape (N, 2, 3 + segments): their inertial rates, along and across.
    """
    n = mass.shape[0]
    rows[0, :2, 3:] = 0.0
    rates[0, :2, 3:] = 0.0
    for i in range(1, n):
        j = i - 1
        along = 0.5 * (body[j, 0] + body[i, 0])
        spin = u[2] + 0.5 * (body[j, 1] + body[i, 1])
        c, s = math.cos(along), math.sin(along)
        span = _chord(q[j], length, gap)
        slope = _chord_slope(q[j], length, gap)
        stretch = slope * u[3 + j]
        bulge = _chord_curvature(q[j], length, gap) * u[3 + j]
        for k in range(n - 1):
            # Bend k turns all behind it by −1, and everything by this much, so that the mean stays.
            turn = (n - 1 - k) / n - (1.0 if k < j else 0.5 if k == j else 0.0)
            own = 1.0 if k == j else 0.0
            forth, aside = own * slope, span * turn
            forth_rate, aside_rate = own * bulge - aside * spin, stretch * turn + own * slope * spin
            rows[i, 0, 3 + k] = rows[j, 0, 3 + k] - forth * c + aside * s
            rows[i, 1, 3 + k] = rows[j, 1, 3 + k] - forth * s - aside * c
            rates[i, 0, 3 + k] = rates[j, 0, 3 + k] - forth_rate * c + aside_rate * s
            rates[i, 1, 3 + k] = rates[j, 1, 3 + k] - forth_rate * s - aside_rate * c
    total = mass.sum()
    for k in range(3, n + 2):
        for axis in range(2):
            mean = mean_rate = 0.0
            for i in range(n):
                mean += mass[i] / total * rows[i, axis, k]
                mean_rate += mass[i] / total * rates[i, axis, k]
            for i in range(n):
                rows[i, axis, k] -= mean
                rates[i, axis, k] -= mean_rate
    for i in range(n):
        row, rate = rows[i], rates[i]
        row[0, 0], row[0, 1], row[0, 2] = 1.0, 0.0, -body[i, 3]
        row[1, 0], row[1, 1], row[1, 2] = 0.0, 1.0, body[i, 2]
        rate[0, 0] = rate[0, 1] = rate[1, 0] = rate[1, 1] = 0.0
        rate[0, 2] = -body[i, 5] - u[2] * body[i, 2]
        rate[1, 2] = body[i, 4] - u[2] * body[i, 3]
        c, s = math.cos(body[i, 0]), math.sin(body[i, 0])
        for k in range(n + 2):
            row[0, k], row[1, k] = row[0, k] * c + row[1, k] * s, row[1, k] * c - row[0, k] * s
            rate[0, k], rate[1, k] = rate[0, k] * c + rate[1, k] * s, rate[1, k] * c - rate[0, k] * s
            if k >= 3:
                row[2, k] = (n + 2 - k) / n - (1.0 if k - 3 < i else 0.0)
        row[2, 0], row[2, 1], row[2, 2] = 0.0, 0.0, 1.0


@njit(cache=True)
def add_connectors(u, mass, inertia, a, floor, rows, rates, momentum, force, matrix):  # type: ignore[no-untyped-def]
    """Add every connector's momentum, ∂T/∂q and friction, and its part of Newton's matrix.

    Args:
        u: velocities, shape (3 + segments,).
        mass: shape (N,), kg; connector i carries the load m_i g.
        inertia: moments of inertia about the connectors, shape (N,), kg·m²; 0: point masses.
        a: s.
        floor: as in `advance`.
        rows: what `fill_rows` filled.
        rates: likewise.
        momentum: added to, shape (3 + segments,).
        force: added to, same shape.
        matrix: added to, shape (3 + segments, 3 + segments).
    """
    law, track, mu_t, mu_n, slip = floor
    contacts = 1 if track == 0.0 else 2
    size = u.shape[0]
    for i in range(mass.shape[0]):
        row, rate = rows[i], rates[i]
        along = across = spin = 0.0
        for k in range(size):
            along += row[0, k] * u[k]
            across += row[1, k] * u[k]
            spin += row[2, k] * u[k]
        load = mass[i] * GRAVITY / contacts
        # Force along (t) and across (n) and moment (m) on the connector, and their slopes.
        t = n = m = tt = tn = nt = nn = tm = nm = mm = 0.0
        for side in range(contacts):
            arm = 0.0 if contacts == 1 else (track if side == 0 else -track)
            f_t, f_n, t_t, t_n, n_t, n_n = kernels.friction_law(
                law, along - spin * arm, across, load, mu_t, mu_n, slip
            )
            t, n, m = t + f_t, n + f_n, m - arm * f_t
            tt, tn, nt, nn = tt + t_t, tn + t_n, nt + n_t, nn + n_n
            tm, nm, mm = tm - arm * t_t, nm - arm * n_t, mm + arm * arm * t_t
        p_t, p_n, p_m = mass[i] * along, mass[i] * across, inertia[i] * spin
        tt, nn, mm = mass[i] - a * tt, mass[i] - a * nn, inertia[i] - a * mm
        # Friction is steepest descent of a potential: its slopes are symmetric.
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


@njit(cache=True)
def balance(q, u, moment, a, solid, floor, momentum, force, matrix, body, rows, rates):  # type: ignore[no-untyped-def]
    """Evaluate both sides of Lagrange's equations in the frame of the mean heading.

    Args:
        q: bends, shape (segments,), rad.
        u: velocity of the centre of mass in that frame (m/s), yaw rate and bend rates (rad/s),
            shape (3 + segments,).
        moment: what the chambers exert on each segment, N·m.
        a: s; 0 makes `matrix` the mass matrix.
        solid: as in `advance`.
        floor: as in `advance`.
        momentum: out, p, shape (3 + segments,).
        force: out, dp/dt, same shape.
        matrix: out, slope of p − a dp/dt by u while q moves by a u, but for some terms in a².
        body: work array, shape (N, 6).
        rows: work array, shape (N, 3, 3 + segments).
        rates: work array, shape (N, 2, 3 + segments).
    """
    mass, inertia, length, gap, stiffness, damping = solid
    kernels.pose_body(q, u[3:], mass, length, gap, body)
    fill_rows(body, q, u, mass, length, gap, rows, rates)
    momentum[:] = 0.0
    force[:] = 0.0
    matrix[:] = 0.0
    add_connectors(u, mass, inertia, a, floor, rows, rates, momentum, force, matrix)
    for j in range(q.shape[0]):
        force[3 + j] += moment[j] - stiffness * q[j] - damping * u[3 + j]
        matrix[3 + j, 3 + j] += a * damping + a * a * stiffness


@njit(cache=True)
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


@njit(cache=True)
def _residual(known, a, u, weight, momentum, force, out):  # type: ignore[no-untyped-def]
    """Fill out = p(u) − p_known − a dp/dt in the frame of the mean heading."""
    heading = known[HEADING] + a * u[2]
    c, s = math.cos(heading), math.sin(heading)
    size = u.shape[0]
    for j in range(size):
        out[j] = momentum[j] - a * force[j]
    out[0] -= weight * (known[VX] * c + known[VY] * s)
    out[1] -= weight * (known[VY] * c - known[VX] * s)
    out[2] -= known[MOMENT]
    for j in range(3, size):
        out[j] -= known[size + j]


@njit(cache=True)
def _stage(known, a, moment, solid, floor, u, k, work):  # type: ignore[no-untyped-def]
    """Solve one implicit stage Y = known + a f(Y) from the guess `u`; fill k = f(Y); return the success."""
    momentum, force, matrix, body, rows, rates, q, residual, step = work
    segments, size = moment.shape[0], u.shape[0]
    weight = solid[0].sum()
    share = 0.0  # of the last step that has been made
    fall = 0.0  # of the potential along that step, at its start
    converged = False
    for _ in range(_NEWTON_STEPS):
        for j in range(segments):
            q[j] = known[BENDS + j] + a * u[3 + j]
        balance(q, u, moment, a, solid, floor, momentum, force, matrix, body, rows, rates)
        _residual(known, a, u, weight, momentum, force, residual)
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
    k[X] = u[0] * c - u[1] * s
    k[Y] = u[0] * s + u[1] * c
    k[VX] = (force[0] * c - force[1] * s) / weight
    k[VY] = (force[0] * s + force[1] * c) / weight
    k[HEADING], k[MOMENT] = u[2], force[2]
    for j in range(segments):
        k[BENDS + j], k[BENDS + segments + j] = u[3 + j], force[3 + j]
    return converged


@njit(cache=True)
def _draw_on(u, rate, time, last):  # type: ignore[no-untyped-def]
    """Keep u in `last` and add rate · time to it."""
    for j in range(u.shape[0]):
        last[j] = u[j]
        u[j] += rate[j] * time


@njit(cache=True)
def advance(state, steps, moments, solid, floor, u):  # type: ignore[no-untyped-def]
    """Advance `state` in place over the given steps; return the number of steps that did not converge.

    Args:
        state: the six of `kernels`, bends (rad), their momenta (kg·m²/s), shape (6 + 2 segments,).
        steps: step lengths, shape (steps,), s.
        moments: chambers' moments at each step's two stages, shape (steps, 2, segments), N·m.
        solid: masses (N,), moments of inertia about the connectors (N,), l, L_o, k (N·m/rad), c (N·m·s/rad).
        floor: number of the law in `friction.LAWS`, half track (m; 0: one contact), mu_t, mu_n, slip (m/s).
        u: velocities as in `balance`; kept from call to call as Newton's first guess.
    """
    n, size = solid[0].shape[0], u.shape[0]
    work = (
        np.empty(size), np.empty(size), np.empty((size, size)), np.empty((n, 6)), np.empty((n, 3, size)),
        np.empty((n, 2, size)), np.empty(n - 1), np.empty(size), np.zeros(size),
    )  # fmt: skip
    k1, k2, known = np.empty_like(state), np.empty_like(state), np.empty_like(state)
    last, rate = u.copy(), np.zeros(size)
    failed = 0
    for i in range(steps.shape[0]):
        h = steps[i]
        a = GAMMA * h
        # Velocities drawn on in a straight line from stage to stage save every second of Newton's steps.
        _draw_on(u, rate, a, last)
        fine = _stage(state, a, moments[i, 0], solid, floor, u, k1, work)
        for j in range(state.shape[0]):
            known[j] = state[j] + (1 - GAMMA) * h * k1[j]
        for j in range(size):
            rate[j] = (u[j] - last[j]) / a
        _draw_on(u, rate, h - a, last)
        fine &= _stage(known, a, moments[i, 1], solid, floor, u, k2, work)
        for j in range(state.shape[0]):
            state[j] = known[j] + a * k2[j]
        for j in range(size):
            rate[j] = (u[j] - last[j]) / (h - a)
        failed += not fine
    return failed
