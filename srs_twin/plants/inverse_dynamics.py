r"""Compiled: what the segments must exert for the bends to move as given, Newton and Euler's way.

First from head to tail, how the connectors accelerate while the head does not and the mean heading turns at
its rate; then what the whole body adds, a and α, from the balance of forces and of moments,

$$ M a = \sum f_i - m_i a_i, \qquad
   I \alpha = \sum n_i - J_i \varepsilon_i + \rho_i \times (f_i - m_i a_i); $$

last, from tail to head, what each segment hands on. A massless segment j with its chord L e along the mean of
its ends' headings gives what is behind it the force F_j and the moment N_j about its rear end, and does no
work but

$$ T_j\,\delta q_j, \qquad T_j = -L'\, F_j \cdot e + \tfrac12 L\, e \times F_j - N_j. $$

This is Eq. 11 solved for T at a cost that grows with the number of segments, not with its square.
"""

from __future__ import annotations

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.plants.floor import fill_forces
from srs_twin.plants.kinematics import COS, ROWS, SIN, SPIN, X, Y, chord_terms, pose_body

_SLOPE, _SPAN = 0, 2  # columns of L' e and of L e among the chords
_CHORD = 4


@compiled
def inverse_dynamics(velocities, bends, rates, accelerations, solid, floor, turning, torque):  # type: ignore[no-untyped-def]
    """Fill the segments' net moments that the given bends need.

    Args:
        velocities: of the centre of mass in the mean-heading frame (m/s), yaw rate, shape (samples, 3).
        bends: shape (samples, segments), rad.
        rates: rad/s.
        accelerations: rad/s².
        solid: the body.
        floor: the floor.
        turning: whether the friction's moment about the centre of mass acts.
        torque: out, shape (samples, segments), N·m.
    """
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
