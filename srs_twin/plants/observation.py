"""Compiled: what can be seen of an analytical snake at given moments, and what its segments must exert."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.plants.floor import fill_forces
from srs_twin.plants.kernels import HEADING
from srs_twin.plants.kernels import X as STATE_X
from srs_twin.plants.kernels import Y as STATE_Y
from srs_twin.plants.kinematics import ROWS, SPIN, VX, VY, X, Y, fill_rows, pose_body


@compiled
def observe(states, velocities, bends, rates, solid, floor, position, theta, force, energy):  # type: ignore[no-untyped-def]
    """Fill what follows from the states, in the world frame.

    Args:
        states: by the indices in `kernels`, shape (samples, STATES or more).
        velocities: as in `Motion`, shape (samples, 3 or more).
        bends: shape (samples, segments), rad.
        rates: same shape, rad/s.
        solid: the body.
        floor: the floor.
        position: out, connectors, shape (samples, N, 2), m.
        theta: out, their headings, shape (samples, N), rad.
        force: out, the floor's force on them, shape (samples, N, 2), N.
        energy: out, kinetic, shape (samples,), J.
    """
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


@compiled
def inverse_dynamics(velocities, bends, rates, accelerations, solid, floor, turning, torque):  # type: ignore[no-untyped-def]
    r"""Fill the segments' net moments that the given bends need, Eq. 11 solved for T.

    By d'Alembert, $T_j = \sum_i R_{ij} \cdot (m_i a_i - f_i)$ with the rows R of `kinematics.fill_rows`; the
    same sum over the three velocities of the whole body vanishes and gives their rates.

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
    size = n + 2
    body, pushed, load = np.empty((ROWS, n)), np.empty((n, 3)), np.empty((n, 3))
    rows, row_rates = np.empty((n, 3, size)), np.empty((n, 2, size))
    u = np.empty(size)
    weight = np.empty(3)
    for k in range(bends.shape[0]):
        u[:3], u[3:] = velocities[k, :3], rates[k]
        inertia, _ = pose_body(bends[k], rates[k], solid, body)
        weight[:2], weight[2] = solid.mass.sum(), inertia
        fill_forces(body, solid.mass, u, floor, pushed)
        fill_rows(body, bends[k], u, solid, rows, row_rates)
        for i in range(n):
            along = across = spin = 0.0
            for j in range(size):
                along += row_rates[i, 0, j] * u[j]
                across += row_rates[i, 1, j] * u[j]
            for j in range(n - 1):
                along += rows[i, 0, 3 + j] * accelerations[k, j]
                across += rows[i, 1, 3 + j] * accelerations[k, j]
                spin += rows[i, 2, 3 + j] * accelerations[k, j]
            load[i, 0] = solid.mass[i] * along - pushed[i, 0]
            load[i, 1] = solid.mass[i] * across - pushed[i, 1]
            load[i, 2] = solid.inertia[i] * spin - pushed[i, 2]
        for axis in range(3):
            # Acceleration of the whole body along one of its three velocities.
            missing = 0.0
            for i in range(n):
                for part in range(3):
                    missing += rows[i, part, axis] * load[i, part]
                if axis == 2 and not turning:
                    for part in range(3):
                        missing += rows[i, part, 2] * pushed[i, part]
            for i in range(n):
                load[i, 0] -= solid.mass[i] * rows[i, 0, axis] * missing / weight[axis]
                load[i, 1] -= solid.mass[i] * rows[i, 1, axis] * missing / weight[axis]
                load[i, 2] -= solid.inertia[i] * rows[i, 2, axis] * missing / weight[axis]
        for j in range(n - 1):
            torque[k, j] = 0.0
            for i in range(n):
                for part in range(3):
                    torque[k, j] += rows[i, part, 3 + j] * load[i, part]
