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

All this is linear in the number of segments. With z a connector's velocity, spin and the rate of its velocity
while u stays, each relative to those of the frame, a segment hands on

$$ z_{j+1} = z_j + \tau_j\,\omega_j + t_j\,\dot q_j, $$

and Newton's matrix is the sum of Zᵀ B Z over the connectors, with B their masses, slopes and, between
velocities and rates, ± a m. It is solved as an articulated body is: from tail to head each bend is eliminated
from the matrix of all that is behind it, from head to tail the bends follow. The head's z is then unknown,
and rates are to be relative to the centre of mass; what keeps them so, Σ m ż = 0, are two multipliers, which
carried along with z turn out as v_c.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
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
from srs_twin.plants.analytical.kinematics import COS, ROWS, SIN, SPIN, VX, VY, X, Y, chord_terms, pose_body

BENDS = STATES
"""Index of the first bend in the state; the first are those of `kernels`, the bends' momenta end it."""

_NEWTON_STEPS = 1000  # at rest on a slope the law is a kink
_NEWTON_TOLERANCE = 1e-9
_OVERSHOT = 0.1  # rise after a Newton step, over the fall before it, from which it was too long


@compiled
def _link(body, q, u, solid, links):  # type: ignore[no-untyped-def]
    """Fill what carries z from each connector to the next: τ and t.

    Args:
        body: what `pose_body` filled, shape (ROWS, N).
        q: bends, shape (segments,), rad.
        u: velocities, shape (3 + segments,).
        solid: the body.
        links: out, by which τ and then t change velocity (2) and its rate (2), shape (segments, 8); the spin
            is changed by 0 and by −1.
    """
    for j in range(q.shape[0]):
        spin = u[2] + 0.5 * (body[SPIN, j] + body[SPIN, j + 1])
        # Direction of the chord: half a bend behind the heading of its front end.
        half_c, half_s, span, slope, curvature = chord_terms(q[j], solid)
        c = body[COS, j] * half_c + body[SIN, j] * half_s
        s = body[SIN, j] * half_c - body[COS, j] * half_s
        stretch = slope * u[3 + j]
        forth, aside = curvature * u[3 + j] + 0.5 * span * spin, slope * spin - 0.5 * stretch
        link = links[j]
        link[0], link[1] = span * s, -span * c
        link[2], link[3] = span * spin * c + stretch * s, span * spin * s - stretch * c
        link[4], link[5] = -slope * c - 0.5 * span * s, 0.5 * span * c - slope * s
        link[6], link[7] = aside * s - forth * c, -forth * s - aside * c


@compiled
def _load(body, u, a, solid, floor, loads):  # type: ignore[no-untyped-def]
    """Fill every connector's momentum, its friction and the even part of Newton's matrix.

    Args:
        body: what `pose_body` filled, shape (ROWS, N).
        u: velocities, shape (3 + segments,).
        a: s.
        solid: the body.
        floor: the floor.
        loads: out, shape (N, 12): momentum relative to the centre of mass x, y and of the spin; friction x,
            y and moment; mass less a times friction's slope: xx, xy, xm, yy, ym, mm.

    Returns:
        The floor's force (x, y) and moment about the centre of mass; the power it takes, W.
    """
    fx = fy = moment = power = 0.0
    for i in range(solid.mass.shape[0]):
        mass, load = solid.mass[i], loads[i]
        c, s, x, y = body[COS, i], body[SIN, i], body[X, i], body[Y, i]
        vx, vy, spin = body[VX, i] - u[2] * y, body[VY, i] + u[2] * x, u[2] + body[SPIN, i]
        load[0], load[1], load[2] = mass * vx, mass * vy, solid.inertia[i] * spin
        along, across = (vx + u[0]) * c + (vy + u[1]) * s, (vy + u[1]) * c - (vx + u[0]) * s
        t, n, m, tt, tn, tm, nn, nm, mm = connector_friction(along, across, spin, mass * floor.down, floor)
        load[3], load[4], load[5] = t * c - n * s, t * s + n * c, m
        power -= t * along + n * across + m * spin
        fx, fy, moment = fx + load[3], fy + load[4], moment + x * load[4] - y * load[3] + m
        on_x_t, on_x_n, on_y_t, on_y_n = tt * c - tn * s, tn * c - nn * s, tt * s + tn * c, tn * s + nn * c
        load[6], load[7] = mass - a * (on_x_t * c - on_x_n * s), -a * (on_x_t * s + on_x_n * c)
        load[8], load[9] = -a * (tm * c - nm * s), mass - a * (on_y_t * s + on_y_n * c)
        load[10], load[11] = -a * (tm * s + nm * c), solid.inertia[i] - a * mm
    return fx, fy, moment, power


@compiled
def balance(q, u, moment, a, model, momentum, force, work):  # type: ignore[no-untyped-def]
    """Evaluate both sides of Lagrange's equations in the frame of the mean heading.

    Args:
        q: bends, shape (segments,), rad.
        u: velocity of the centre of mass in that frame (m/s), yaw rate and bend rates (rad/s),
            shape (3 + segments,).
        moment: what the chambers exert on each segment, N·m.
        a: s, for `solve`.
        model: solid; stiffness k (N·m/rad) and damping c (N·m·s/rad) of a segment; floor.
        momentum: out, p, shape (3 + segments,).
        force: out, dp/dt, same shape.
        work: from `room`; out, what `solve` takes.

    Returns:
        The power that friction takes, W.
    """
    solid, (stiffness, damping), floor = model
    body, links, loads, _, _ = work
    n, weight = solid.mass.shape[0], solid.mass.sum()
    inertia, turning = pose_body(q, u[3:], solid, body)
    _link(body, q, u, solid, links)
    fx, fy, turned, power = _load(body, u, a, solid, floor, loads)
    momentum[0], momentum[1], momentum[2] = weight * u[0], weight * u[1], inertia * u[2] + turning
    force[0], force[1], force[2] = fx, fy, turned
    # Of all behind a segment, about the connector at its front end.
    px = py = pm = x = y = m = 0.0
    for j in range(n - 2, -1, -1):
        load, link, share = loads[j + 1], links[j], (n - 1 - j) / n
        own = solid.mass[j + 1] / weight
        px, py, pm = px + load[0], py + load[1], pm + load[2]
        x, y, m = x + load[3] - own * fx, y + load[4] - own * fy, m + load[5]
        momentum[3 + j] = link[4] * px + link[5] * py - pm + share * momentum[2]
        force[3 + j] = link[4] * x + link[5] * y - m + link[6] * px + link[7] * py + share * turned
        force[3 + j] += moment[j] - stiffness * q[j] - damping * u[3 + j]
        pm += link[0] * px + link[1] * py
        m += link[0] * x + link[1] * y + link[2] * px + link[3] * py
    return power


@compiled
def _add(matrix, load, mass, weight, share, a, pushed):  # type: ignore[no-untyped-def]
    """Add B of a connector with the multipliers, and the momentum that the whole body lacks at its share."""
    matrix[0, 0] += load[6]
    matrix[0, 1] += load[7]
    matrix[1, 0] += load[7]
    matrix[0, 2] += load[8]
    matrix[2, 0] += load[8]
    matrix[1, 1] += load[9]
    matrix[1, 2] += load[10]
    matrix[2, 1] += load[10]
    matrix[2, 2] += load[11]
    matrix[2, 7] += pushed[2] * share
    for i in range(2):
        matrix[i, 3 + i] += a * mass
        matrix[3 + i, i] -= a * mass
        matrix[3 + i, 5 + i] += a * mass
        matrix[5 + i, 3 + i] -= a * mass
        matrix[i, 7] += mass / weight * pushed[i]


@compiled
def solve(a, model, residual, step, work):  # type: ignore[no-untyped-def]
    """Fill `step` so that Newton's matrix times it is the residual, at what `balance` was given.

    Args:
        a: s, above 0.
        model: as in `balance`.
        residual: shape (3 + segments,).
        step: out, same shape.
        work: what `balance` filled.
    """
    solid, (stiffness, damping), _ = model
    _, links, loads, gains, matrix = work
    n, weight, held = solid.mass.shape[0], solid.mass.sum(), a * damping + a * a * stiffness
    for i in range(7):
        for k in range(8):
            matrix[i, k] = 0.0
    for j in range(n - 2, -1, -1):
        link, gain = links[j], gains[j]
        _add(matrix, loads[j + 1], solid.mass[j + 1], weight, 1 / n, a, residual)
        # The bend by all that is behind it, eliminated; then all that is carried to the connector before.
        for k in range(8):
            gain[k] = link[4] * matrix[0, k] + link[5] * matrix[1, k] - matrix[2, k]
            gain[k] += link[6] * matrix[3, k] + link[7] * matrix[4, k]
        gain[7] += residual[3 + j]
        stiff = held + link[4] * gain[0] + link[5] * gain[1] - gain[2] + link[6] * gain[3] + link[7] * gain[4]
        for k in range(8):
            gain[k] /= stiff
        for i in range(7):
            row = matrix[i]
            by = link[4] * row[0] + link[5] * row[1] - row[2] + link[6] * row[3] + link[7] * row[4]
            for k in range(8):
                row[k] -= by * gain[k]
            row[2] += link[0] * row[0] + link[1] * row[1] + link[2] * row[3] + link[3] * row[4]
        for k in range(8):
            matrix[2, k] += link[0] * matrix[0, k] + link[1] * matrix[1, k]
            matrix[2, k] += link[2] * matrix[3, k] + link[3] * matrix[4, k]
        gain[2] += link[0] * gain[0] + link[1] * gain[1] + link[2] * gain[3] + link[3] * gain[4]
    _add(matrix, loads[0], solid.mass[0], weight, 1 / n, a, residual)
    x, y, m, ax, ay, vx, vy = _eliminate(matrix)
    step[0], step[1], step[2] = vx, vy, m
    for j in range(n - 1):
        link, gain = links[j], gains[j]
        bend = gain[7] - gain[0] * x - gain[1] * y - gain[2] * m - gain[3] * ax - gain[4] * ay
        bend -= gain[5] * vx + gain[6] * vy
        step[3 + j] = bend
        step[2] -= (n - 1 - j) / n * bend
        x, y = x + link[0] * m + link[4] * bend, y + link[1] * m + link[5] * bend
        ax, ay, m = ax + link[2] * m + link[6] * bend, ay + link[3] * m + link[7] * bend, m - bend


@compiled
def _eliminate(matrix):  # type: ignore[no-untyped-def]
    """Solve for the last column in place; without pivots, for the even part is not negative."""
    for j in range(7):
        for i in range(j + 1, 7):
            factor = matrix[i, j] / matrix[j, j]
            for k in range(j + 1, 8):
                matrix[i, k] -= factor * matrix[j, k]
    for j in range(6, -1, -1):
        for k in range(j + 1, 7):
            matrix[j, 7] -= matrix[j, k] * matrix[k, 7]
        matrix[j, 7] /= matrix[j, j]
    return matrix[0, 7], matrix[1, 7], matrix[2, 7], matrix[3, 7], matrix[4, 7], matrix[5, 7], matrix[6, 7]


@allocating
def room(n):  # type: ignore[no-untyped-def]
    """Return the work arrays of `balance` and `solve` for so many connectors."""
    return (
        np.empty((ROWS, n)),
        np.empty((n - 1, 8)),
        np.empty((n, 12)),
        np.empty((n - 1, 8)),
        np.empty((7, 8)),
    )


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
    momentum, force, posed, q, residual, step = work
    segments, size = moment.shape[0], u.shape[0]
    floor, weight = model[2], model[0].mass.sum()
    share = 0.0  # of the last step that has been made
    fall = 0.0  # of the potential along that step, at its start
    converged = False
    power = 0.0
    for _ in range(_NEWTON_STEPS):
        for j in range(segments):
            q[j] = known[BENDS + j] + a * u[3 + j]
        power = balance(q, u, moment, a, model, momentum, force, posed)
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
        solve(a, model, residual, step, posed)
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
    n, size = solid.mass.shape[0], u.shape[0]
    work = np.empty(size), np.empty(size), room(n), np.empty(n - 1), np.empty(size), np.zeros(size)
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
