r"""Compiled kernels of the models whose bends are given (`complete`, `simplified`).

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
slope along a step tells whether the step was too long; `steps` says how long they are.

What the segments must exert for the bends to move as given (`inverse_dynamics`) is found Newton and Euler's
way: first from head to tail, how the connectors accelerate while the head does not and the mean heading turns
at its rate; then what the whole body adds, a and α, from the balance of forces and of moments,

$$ M a = \sum f_i - m_i a_i, \qquad
   I \alpha = \sum n_i - J_i \varepsilon_i + \rho_i \times (f_i - m_i a_i); $$

last, from tail to head, what each segment hands on. A massless segment j with its chord L e along the mean of
its ends' headings gives what is behind it the force F_j and the moment N_j about its rear end, and does no
work but

$$ T_j\,\delta q_j, \qquad T_j = -L'\, F_j \cdot e + \tfrac12 L\, e \times F_j - N_j. $$

This is Eq. 11 solved for T at a cost that grows with the number of segments, not with its square.

`observe` tells what can be seen of such a snake at given moments.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.plants.analytical.floor import fill_forces, floor_forces
from srs_twin.plants.analytical.kinematics import COS, ROWS, SIN, SPIN, VX, VY, X, Y, chord_terms, pose_body

_SLOPE, _SPAN = 0, 2  # columns of L' e and of L e among the chords
_CHORD = 4


@allocating
def inverse_dynamics(velocities, trace, model, torque):  # type: ignore[no-untyped-def]
    """Fill the segments' net moments that the given bends need.

    Args:
        velocities: of the centre of mass in the mean-heading frame (m/s), yaw rate, shape (samples, 3).
        trace: of the chambers, whose free bends they are.
        model: solid, floor and whether the friction's moment about the centre of mass acts.
        torque: out, shape (samples, segments), N·m.
    """
    solid, floor, turning = model
    bends, rates, accelerations = trace.bend, trace.bend_rate, trace.bend_acceleration
    n = solid.mass.shape[0]
    body, pushed = np.empty((ROWS, n)), np.empty((n, 3))
    chords, load = np.empty((n - 1, _CHORD)), np.empty((n, 3))
    for k in range(bends.shape[0]):
        inertia, _ = pose_body(bends[k], rates[k], solid, body)
        fill_forces(body, solid.mass, velocities[k], floor, pushed)
        _accelerate(body, bends[k], rates[k], accelerations[k], velocities[k, 2], solid, chords, load)
        left = _balance(body, inertia, solid, turning, pushed, load)
        _hand_on(chords, load, left, torque[k])


@compiled
def _accelerate(body, q, rate, acceleration, yaw, solid, chords, motion):  # type: ignore[no-untyped-def]  # noqa: D417
    """Fill the connectors' accelerations and the chords from head to tail.

    Args:
        body: what `pose_body` filled, shape (ROWS, N).
        q, rate, acceleration: of the bends, shape (segments,).
        yaw: rate of the mean heading, rad/s.
        solid: the body.
        chords: out, L' e (m/rad) and L e (m), shape (segments, _CHORD).
        motion: out, shape (N, 3): of places (m/s²), relative to the head's, and of headings (rad/s²), while
            their mean turns evenly.
    """
    n = solid.mass.shape[0]
    turned = 0.0
    for j in range(n - 1):
        turned += (n - 1 - j) / n * acceleration[j]
    x = y = 0.0
    motion[0, 0], motion[0, 1], motion[0, 2] = x, y, turned
    for j in range(n - 1):
        # A chord lies half a bend from either end's heading.
        half_c, half_s, span, slope, curvature = chord_terms(q[j], solid)
        c = body[COS, j] * half_c + body[SIN, j] * half_s
        s = body[SIN, j] * half_c - body[COS, j] * half_s
        turn = yaw + body[SPIN, j] - rate[j] / 2
        along = slope * acceleration[j] + curvature * rate[j] * rate[j] - span * turn * turn
        across = span * (turned - acceleration[j] / 2) + 2 * slope * rate[j] * turn
        x, y, turned = x - along * c + across * s, y - along * s - across * c, turned - acceleration[j]
        motion[j + 1, 0], motion[j + 1, 1], motion[j + 1, 2] = x, y, turned
        chords[j, _SLOPE], chords[j, _SLOPE + 1] = slope * c, slope * s
        chords[j, _SPAN], chords[j, _SPAN + 1] = span * c, span * s


@compiled
def _balance(body, inertia, solid, turning, pushed, load):  # type: ignore[no-untyped-def]
    """Turn accelerations into what the connectors must be given, with those of the whole body.

    Args:
        body: what `pose_body` filled, shape (ROWS, N).
        inertia: I, kg·m².
        solid: the body.
        turning: whether the friction's moment about the centre of mass acts.
        pushed: what `fill_forces` filled, shape (N, 3).
        load: in place, what `_accelerate` filled; out, forces (N) and moments (N·m).

    Returns:
        Moment of the loads about the centre of mass, N·m: 0 unless the friction's does not act.
    """
    mass, n = solid.mass, solid.mass.shape[0]
    weight, fx, fy, moment, friction = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        c, s, x, y = body[COS, i], body[SIN, i], body[X, i], body[Y, i]
        floor_x, floor_y = pushed[i, 0] * c - pushed[i, 1] * s, pushed[i, 0] * s + pushed[i, 1] * c
        load[i, 0] = mass[i] * load[i, 0] - floor_x
        load[i, 1] = mass[i] * load[i, 1] - floor_y
        load[i, 2] = solid.inertia[i] * load[i, 2] - pushed[i, 2]
        weight, fx, fy = weight + mass[i], fx + load[i, 0], fy + load[i, 1]
        moment += x * load[i, 1] - y * load[i, 0] + load[i, 2]
        friction += x * floor_y - y * floor_x + pushed[i, 2]
    left = 0.0 if turning else -friction
    ax, ay, turn = -fx / weight, -fy / weight, (left - moment) / inertia
    for i in range(n):
        load[i, 0] += mass[i] * (ax - turn * body[Y, i])
        load[i, 1] += mass[i] * (ay + turn * body[X, i])
        load[i, 2] += solid.inertia[i] * turn
    return left


@compiled
def _hand_on(chords, load, left, torque):  # type: ignore[no-untyped-def]
    """Fill the segments' moments from tail to head.

    Args:
        chords: what `_accelerate` filled.
        load: what each connector must be given, what `_balance` filled.
        left: moment of the loads about the centre of mass, N·m. A bend turns the head by what keeps the mean
            heading, and with it the whole body.
        torque: out, shape (segments,), N·m.
    """
    n = load.shape[0]
    fx = fy = moment = 0.0
    for j in range(n - 2, -1, -1):
        fx, fy, moment = fx + load[j + 1, 0], fy + load[j + 1, 1], moment + load[j + 1, 2]
        arm = chords[j, _SPAN] * fy - chords[j, _SPAN + 1] * fx
        lengthening = chords[j, _SLOPE] * fx + chords[j, _SLOPE + 1] * fy
        torque[j] = arm / 2 - lengthening - moment + (n - 1 - j) / n * left
        moment -= arm


GAMMA = 1 - math.sqrt(0.5)
"""Diagonal of the SDIRK2 method: stages at GAMMA·h and h."""

STATE_X, STATE_Y, HEADING, STATE_VX, STATE_VY, MOMENT, SPENT = range(7)
"""Indices into the state: centre of mass (m), mean heading (rad), its velocity (m/s), L (kg·m²/s), and the
energy that the floor has taken, or height (J)."""

STATES = 7
SPEED_LIMIT = 100.0
"""m/s: beyond it a state is not plausible."""

_NEWTON_STEPS = 100
_NEWTON_TOLERANCE = 1e-8
_OVERSHOT = 0.1  # rise after a Newton step, over the fall before it, from which it was too long


@compiled
def _solve3(a, b, c, p, q, r):  # type: ignore[no-untyped-def]
    """Solve the system with the rows a, b, c and the right side p, q, r by Cramer's rule."""
    c0 = b[1] * c[2] - b[2] * c[1]
    c1 = b[2] * c[0] - b[0] * c[2]
    c2 = b[0] * c[1] - b[1] * c[0]
    scale = 1 / (a[0] * c0 + a[1] * c1 + a[2] * c2)
    return (
        scale * (p * c0 + q * (a[2] * c[1] - a[1] * c[2]) + r * (a[1] * b[2] - a[2] * b[1])),
        scale * (p * c1 + q * (a[0] * c[2] - a[2] * c[0]) + r * (a[2] * b[0] - a[0] * b[2])),
        scale * (p * c2 + q * (a[1] * c[0] - a[0] * c[1]) + r * (a[0] * b[1] - a[1] * b[0])),
    )


@compiled
def _turned(c, s, angle):  # type: ignore[no-untyped-def]
    """Return cosine and sine of an angle that grows by a little, by their series: sines are dear."""
    if abs(angle) > 0.1:  # rad: there the next terms are 1e-17
        dc, ds = math.cos(angle), math.sin(angle)
    else:
        p = angle * angle
        dc = 1 - p / 2 * (1 - p / 12 * (1 - p / 30 * (1 - p / 56)))
        ds = angle * (1 - p / 6 * (1 - p / 20 * (1 - p / 42 * (1 - p / 72))))
    return c * dc - s * ds, s * dc + c * ds


@compiled
def copy(values, out):  # type: ignore[no-untyped-def]
    """Copy one array into another: a loop, for a slice is checked for overlap each time."""
    for j in range(out.shape[0]):
        out[j] = values[j]


@compiled
def _stage(known, a, q, rate, turn, model, u, k, body):  # type: ignore[no-untyped-def]  # noqa: D417
    """Solve one implicit stage Y = known + a f(Y) from the guess `u`; fill k = f(Y).

    Args:
        known: shape (STATES,).
        a: s.
        q, rate: bends (rad) and their rates (rad/s) at the stage, shape (segments,).
        turn: cosine and sine of a heading, and how far `known` has turned from it, rad.
        model: solid, floor and whether the friction's moment acts.
        u: in place, shape (3,).
        k: out, shape (STATES,).
        body: work array, shape (ROWS, N).

    Returns:
        Whether it was solved.
    """
    solid, floor, turning = model
    weight, acts = solid.mass.sum(), 1.0 if turning else 0.0
    inertia, moment = pose_body(q, rate, solid, body)
    known_x, known_y = known[STATE_VX] + a * floor.pull_x, known[STATE_VY] + a * floor.pull_y
    known_moment = known[MOMENT]
    x, y, z = u[0], u[1], u[2]
    step_x = step_y = step_z = 0.0
    share = 0.0  # of the last step that has been made
    fall = 0.0  # of the potential along that step, at its start
    converged = False
    power = 0.0
    c, s = _turned(turn[0], turn[1], turn[2] + a * z)
    for _ in range(_NEWTON_STEPS):
        bx, by = known_x * c + known_y * s, known_y * c - known_x * s
        force, slope, power = floor_forces(body, solid.mass, x, y, z, floor)
        power += (1 - acts) * force[2] * z
        miss_x, miss_y = weight * (x - bx) - a * force[0], weight * (y - by) - a * force[1]
        miss_z = inertia * z + moment - known_moment - a * acts * force[2]
        falls = miss_x * step_x + miss_y * step_y + miss_z * step_z
        if falls < -_OVERSHOT * fall:
            # Past the lowest point along the step, across a kink of the friction law: some way back.
            back = share * min(max(fall / (fall - falls), 0.1), 0.7)
            x, y, z = x + (share - back) * step_x, y + (share - back) * step_y, z + (share - back) * step_z
            c, s = _turned(c, s, a * (share - back) * step_z)
            share = back
            continue
        xx, xy, xz, yy, yz, zz = slope
        step_x, step_y, step_z = _solve3(
            (weight - a * xx, -a * xy, -a * (xz + weight * by)),
            (-a * xy, weight - a * yy, -a * (yz - weight * bx)),
            (-a * acts * xz, -a * acts * yz, inertia - a * acts * zz),
            miss_x, miss_y, miss_z,
        )  # fmt: skip
        share, fall = 1.0, miss_x * step_x + miss_y * step_y + miss_z * step_z
        x, y, z = x - step_x, y - step_y, z - step_z
        c, s = _turned(c, s, -a * step_z)
        if abs(step_x) + abs(step_y) + 0.1 * abs(step_z) < _NEWTON_TOLERANCE:
            converged = True
            break
    u[0], u[1], u[2] = x, y, z
    # What the stage's equation says of f(Y) costs no further evaluation.
    k[STATE_X], k[STATE_Y], k[HEADING] = x * c - y * s, x * s + y * c, z
    k[STATE_VX], k[STATE_VY] = (k[STATE_X] - known[STATE_VX]) / a, (k[STATE_Y] - known[STATE_VY]) / a
    k[MOMENT] = (inertia * z + moment - known_moment) / a
    k[SPENT] = power - weight * (floor.pull_x * k[STATE_X] + floor.pull_y * k[STATE_Y])
    return converged


@compiled
def step(state, h, bends, rates, model, u, drift, k1, k2, after, body):  # type: ignore[no-untyped-def]  # noqa: D417
    """Make one step of SDIRK2.

    Args:
        state: at its start, shape (STATES,).
        h: its length, s.
        bends: at its two stages, shape (2, segments), rad.
        rates: their rates, rad/s.
        model: solid, floor and whether the friction's moment about the centre of mass acts.
        u: in place, velocity in the body frame and yaw rate, shape (3,).
        drift: in place, how fast u changes, the guess from which Newton's method starts, shape (3,).
        k1, k2: out, rates of the state at the stages, shape (STATES,).
        after: out, state at the end, shape (STATES,).
        body: work array, shape (ROWS, N).

    Returns:
        Whether both stages were solved.
    """
    a, wait = GAMMA * h, (1 - GAMMA) * h
    known, begun = after, state[HEADING]
    c, s = math.cos(begun), math.sin(begun)
    # Velocities drawn on in a straight line from stage to stage save every second of Newton's steps.
    x, y, z = u[0], u[1], u[2]
    for j in range(3):
        u[j] += drift[j] * a
    first = _stage(state, a, bends[0], rates[0], (c, s, 0.0), model, u, k1, body)
    for j in range(STATES):
        known[j] = state[j] + wait * k1[j]
    drift[0], drift[1], drift[2] = (u[0] - x) / a, (u[1] - y) / a, (u[2] - z) / a
    x, y, z = u[0], u[1], u[2]
    for j in range(3):
        u[j] += drift[j] * wait
    second = _stage(known, a, bends[1], rates[1], (c, s, wait * k1[HEADING]), model, u, k2, body)
    for j in range(STATES):
        after[j] = known[j] + a * k2[j]
    drift[0], drift[1], drift[2] = (u[0] - x) / wait, (u[1] - y) / wait, (u[2] - z) / wait
    return first and second


@allocating
def observe(motion, solid, floor, position, theta, force, energy):  # type: ignore[no-untyped-def]
    """Fill what follows from the states, in the world frame.

    Args:
        motion: a `Motion`.
        solid: the body.
        floor: the floor.
        position: out, connectors, shape (samples, N, 2), m.
        theta: out, their headings, shape (samples, N), rad.
        force: out, the floor's force on them, shape (samples, N, 2), N.
        energy: out, kinetic, shape (samples,), J.
    """
    states, velocities, bends, rates, _ = motion
    n = solid.mass.shape[0]
    body, pushed = np.empty((ROWS, n)), np.empty((n, 3))
    for k in range(states.shape[0]):
        u = velocities[k]
        pose_body(bends[k], rates[k], solid, body)
        fill_forces(body, solid.mass, u, floor, pushed)
        heading = states[k, HEADING]
        c, s = math.cos(heading), math.sin(heading)
        angle = heading
        for j in range(n - 1):
            angle += (n - 1 - j) / n * bends[k, j]
        energy[k] = 0.0
        for i in range(n):
            angle -= bends[k, i - 1] if i > 0 else 0.0
            theta[k, i] = angle
            x, y = body[X, i], body[Y, i]
            position[k, i, 0] = states[k, STATE_X] + c * x - s * y
            position[k, i, 1] = states[k, STATE_Y] + s * x + c * y
            along_c, along_s = math.cos(angle), math.sin(angle)
            force[k, i, 0] = pushed[i, 0] * along_c - pushed[i, 1] * along_s
            force[k, i, 1] = pushed[i, 0] * along_s + pushed[i, 1] * along_c
            vx, vy = u[0] - u[2] * y + body[VX, i], u[1] + u[2] * x + body[VY, i]
            spin = u[2] + body[SPIN, i]
            energy[k] += (solid.mass[i] * (vx * vx + vy * vy) + solid.inertia[i] * spin * spin) / 2
