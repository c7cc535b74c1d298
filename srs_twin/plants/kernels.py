r"""Compiled kernel of the `complete` analytical model.

Point masses m_i sit at the connectors; the bends q(t) are given by the actuators; the pose of the body is
what moves. With ρ_i(q) the connectors about the centre of mass in the frame of the mean heading θ,

$$ M \dot v = \sum f_i, \qquad \dot L = \sum \bigl(r_i - r_c\bigr) \times f_i + n_i, \qquad
   L = I(q)\,\dot\theta + h(q, \dot q), $$

with I = Σ m_i |ρ_i|², h = Σ m_i ρ_i × ρ̇_i and n_i the yaw moment of connector i's wheels. Using the moment
of momentum L as the state needs no q̈, so its jumps at valve events cost no accuracy. This is Eq. 11
contracted with eᵀ (segment torques cancel).
The friction is stiff, so the three velocities are solved implicitly with the two-stage, second-order,
L-stable SDIRK method of Alexander (1977), Newton's method in each stage.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from srs_twin import friction, shape
from srs_twin.spec import GRAVITY

GAMMA = 1 - math.sqrt(0.5)
"""Diagonal of the SDIRK2 method: stages at GAMMA·h and h."""

X, Y, HEADING, VX, VY, MOMENT = range(6)
"""Indices into the state: centre of mass (m), mean heading (rad), its velocity (m/s), L (kg·m²/s)."""

_NEWTON_STEPS = 100
_NEWTON_TOLERANCE = 1e-11
_DECREASE = 0.999  # by which a Newton step must shrink the squared residual; 1 would let it cycle

_chord = njit(cache=True)(shape.chord)
_chord_slope = njit(cache=True)(shape.chord_slope)
_axis = njit(cache=True)(friction.axis)
_wheel = njit(cache=True)(friction.wheel)
_viscous = njit(cache=True)(friction.viscous)


@njit(cache=True)
def friction_law(law, v_t, v_n, load, mu_t, mu_n, slip):  # type: ignore[no-untyped-def]
    """Return force and slopes by the law's number in `friction.LAWS`."""
    if law == 0:
        return _axis(v_t, v_n, load, mu_t, mu_n, slip)
    if law == 1:
        return _wheel(v_t, v_n, load, mu_t, mu_n, slip)
    return _viscous(v_t, v_n, load, mu_t, mu_n, slip)


@njit(cache=True)
def pose_body(q, rate, mass, length, gap, out):  # type: ignore[no-untyped-def]
    """Fill `out` (N, 6) with φ_i, φ̇_i, ρ_i (2), ρ̇_i (2); return I and h.

    Args:
        q: bends, shape (segments,), rad.
        rate: their rates, rad/s.
        mass: connector masses, shape (N,), kg.
        length: l, m.
        gap: L_o, m.
        out: work array, shape (N, 6).
    """
    n = mass.shape[0]
    mean = mean_rate = 0.0
    out[0, 0] = out[0, 1] = 0.0
    for i in range(1, n):
        out[i, 0] = out[i - 1, 0] - q[i - 1]
        out[i, 1] = out[i - 1, 1] - rate[i - 1]
        mean += out[i, 0]
        mean_rate += out[i, 1]
    mean /= n
    mean_rate /= n
    total = cx = cy = cvx = cvy = 0.0
    for i in range(n):
        out[i, 0] -= mean
        out[i, 1] -= mean_rate
        if i == 0:
            out[i, 2:6] = 0.0
        else:
            along = 0.5 * (out[i, 0] + out[i - 1, 0])
            turn = 0.5 * (out[i, 1] + out[i - 1, 1])
            span = _chord(q[i - 1], length, gap)
            stretch = _chord_slope(q[i - 1], length, gap) * rate[i - 1]
            c, s = math.cos(along), math.sin(along)
            out[i, 2] = out[i - 1, 2] - span * c
            out[i, 3] = out[i - 1, 3] - span * s
            out[i, 4] = out[i - 1, 4] - stretch * c + span * turn * s
            out[i, 5] = out[i - 1, 5] - stretch * s - span * turn * c
        total += mass[i]
        cx += mass[i] * out[i, 2]
        cy += mass[i] * out[i, 3]
        cvx += mass[i] * out[i, 4]
        cvy += mass[i] * out[i, 5]
    inertia = moment = 0.0
    for i in range(n):
        out[i, 2] -= cx / total
        out[i, 3] -= cy / total
        out[i, 4] -= cvx / total
        out[i, 5] -= cvy / total
        inertia += mass[i] * (out[i, 2] ** 2 + out[i, 3] ** 2)
        moment += mass[i] * (out[i, 2] * out[i, 5] - out[i, 3] * out[i, 4])
    return inertia, moment


@njit(cache=True)
def floor_forces(body, mass, u, law, track, mu_t, mu_n, slip, force, total, slope):  # type: ignore[no-untyped-def]
    """Sum the friction on a moving body, in its mean-heading frame.

    Args:
        body: what `pose_body` filled, shape (N, 6).
        mass: shape (N,), kg; connector i carries the load m_i g.
        u: velocity of the centre of mass in the body frame (m/s) and yaw rate (rad/s), shape (3,).
        law: number of the friction law.
        track: distance of each of two contacts from the centre line, m; 0: one contact.
        mu_t: coefficient along.
        mu_n: coefficient across.
        slip: ε, m/s.
        force: out, force on each connector, shape (N, 2), N.
        total: out, net force and moment about the centre of mass, shape (3,).
        slope: out, d total/d u, shape (3, 3).
    """
    total[:] = 0.0
    slope[:] = 0.0
    contacts = 1 if track == 0.0 else 2
    for i in range(mass.shape[0]):
        c, s = math.cos(body[i, 0]), math.sin(body[i, 0])
        px, py = body[i, 2], body[i, 3]
        spin = u[2] + body[i, 1]
        vx = u[0] - u[2] * py + body[i, 4]
        vy = u[1] + u[2] * px + body[i, 5]
        along = vx * c + vy * s
        across = -vx * s + vy * c
        load = mass[i] * GRAVITY / contacts
        force[i, 0] = force[i, 1] = 0.0
        for side in range(contacts):
            arm = 0.0 if contacts == 1 else (track if side == 0 else -track)
            f_t, f_n, tt, tn, nt, nn = friction_law(law, along - spin * arm, across, load, mu_t, mu_n, slip)
            # Rows: how the contact's velocity along and across depends on u; by d'Alembert the same rows
            # carry its force into the net force and moment.
            along_w = -py * c + px * s - arm
            across_w = py * s + px * c
            force[i, 0] += f_t * c - f_n * s
            force[i, 1] += f_t * s + f_n * c
            total[0] += f_t * c - f_n * s
            total[1] += f_t * s + f_n * c
            total[2] += f_t * along_w + f_n * across_w
            t_row = (c, s, along_w)
            n_row = (-s, c, across_w)
            for k in range(3):
                d_t = tt * t_row[k] + tn * n_row[k]
                d_n = nt * t_row[k] + nn * n_row[k]
                for j in range(3):
                    slope[j, k] += t_row[j] * d_t + n_row[j] * d_n


@njit(cache=True)
def _solve3(a, b, x):  # type: ignore[no-untyped-def]
    """Solve the 3 × 3 system a x = b by Cramer's rule."""
    c0 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    c1 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
    c2 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
    det = a[0, 0] * c0 + a[0, 1] * c1 + a[0, 2] * c2
    x[0] = (
        b[0] * c0
        + b[1] * (a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2])
        + b[2] * (a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1])
    ) / det
    x[1] = (
        b[0] * c1
        + b[1] * (a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0])
        + b[2] * (a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2])
    ) / det
    x[2] = (
        b[0] * c2
        + b[1] * (a[0, 1] * a[2, 0] - a[0, 0] * a[2, 1])
        + b[2] * (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0])
    ) / det


@njit(cache=True)
def _stage(known, a, q, rate, mass, length, gap, law, track, mu_t, mu_n, slip, u, k, work):  # type: ignore[no-untyped-def]
    """Solve one implicit stage Y = known + a f(Y) from the guess `u`; fill k = f(Y), shape (6,)."""
    body, force, total, slope, matrix, residual, step = work
    inertia, moment = pose_body(q, rate, mass, length, gap, body)
    weight = mass.sum()
    best = np.inf
    converged = False
    for _ in range(_NEWTON_STEPS):
        heading = known[HEADING] + a * u[2]
        c, s = math.cos(heading), math.sin(heading)
        bx = known[VX] * c + known[VY] * s
        by = -known[VX] * s + known[VY] * c
        floor_forces(body, mass, u, law, track, mu_t, mu_n, slip, force, total, slope)
        residual[0] = u[0] - bx - a / weight * total[0]
        residual[1] = u[1] - by - a / weight * total[1]
        residual[2] = u[2] - (known[MOMENT] - moment + a * total[2]) / inertia
        size = weight * (residual[0] ** 2 + residual[1] ** 2) + inertia * residual[2] ** 2
        if size > _DECREASE * best:
            # Overshot across a kink of the friction law, or mirrored on it: go half the way back.
            step *= 0.5
            u += step
            continue
        best = size
        for j in range(3):
            scale = a / weight if j < 2 else a / inertia
            for m in range(3):
                matrix[j, m] = -scale * slope[j, m]
            matrix[j, j] += 1.0
        matrix[0, 2] -= a * by
        matrix[1, 2] += a * bx
        _solve3(matrix, residual, step)
        u -= step
        if abs(step[0]) + abs(step[1]) + 0.1 * abs(step[2]) < _NEWTON_TOLERANCE:
            converged = True
            break
    heading = known[HEADING] + a * u[2]
    c, s = math.cos(heading), math.sin(heading)
    floor_forces(body, mass, u, law, track, mu_t, mu_n, slip, force, total, slope)
    k[X] = u[0] * c - u[1] * s
    k[Y] = u[0] * s + u[1] * c
    k[HEADING] = u[2]
    k[VX] = (total[0] * c - total[1] * s) / weight
    k[VY] = (total[0] * s + total[1] * c) / weight
    k[MOMENT] = total[2]
    return converged


@njit(cache=True)
def advance(state, steps, bends, rates, mass, length, gap, law, track, mu_t, mu_n, slip, u):  # type: ignore[no-untyped-def]
    """Advance `state` in place over the given steps; return the number of steps that did not converge.

    Args:
        state: (6,), see the indices above.
        steps: step lengths, shape (steps,), s.
        bends: bends at each step's two stages, shape (steps, 2, segments), rad.
        rates: bend rates there, rad/s.
        mass: connector masses, shape (N,), kg.
        length: l, m.
        gap: L_o, m.
        law: number of the friction law in `friction.LAWS`.
        track: half track, m; 0: one contact a connector.
        mu_t: coefficient along.
        mu_n: coefficient across.
        slip: regularisation speed ε, m/s.
        u: body-frame velocity and yaw rate, shape (3,); kept from call to call as Newton's first guess.
    """
    n = mass.shape[0]
    work = (
        np.empty((n, 6)), np.empty((n, 2)), np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty(3),
        np.empty(3),
    )  # fmt: skip
    k1, k2, known = np.empty(6), np.empty(6), np.empty(6)
    failed = 0
    for i in range(steps.shape[0]):
        h = steps[i]
        a = GAMMA * h
        fine = _stage(
            state, a, bends[i, 0], rates[i, 0], mass, length, gap, law, track, mu_t, mu_n, slip, u, k1, work
        )
        known[:] = state + (1 - GAMMA) * h * k1
        fine &= _stage(
            known, a, bends[i, 1], rates[i, 1], mass, length, gap, law, track, mu_t, mu_n, slip, u, k2, work
        )
        state[:] = known + a * k2
        failed += not fine
    return failed
