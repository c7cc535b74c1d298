"""Compiled: what can be seen of an analytical snake at given moments."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.plants.floor import fill_forces
from srs_twin.plants.kernels import HEADING
from srs_twin.plants.kernels import X as STATE_X
from srs_twin.plants.kernels import Y as STATE_Y
from srs_twin.plants.kinematics import ROWS, SPIN, VX, VY, X, Y, pose_body


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
