"""Dense Jacobians of the connector velocities, a reference for the recursive kernels."""

from __future__ import annotations

import numpy as np

from srs_twin.compute.compiled import compiled
from srs_twin.plants.analytical.compliant_kernels import CompliantModel
from srs_twin.plants.analytical.floor import FloorFriction, connector_friction
from srs_twin.plants.analytical.kinematics import (
    COS,
    ROWS,
    SIN,
    SPIN,
    VX,
    VY,
    X,
    Y,
    chord_terms,
    pose_body,
)


@compiled
def fill_rows(body, q, u, solid, rows, rates):  # type: ignore[no-untyped-def]
    """Fill how each connector's motion depends on the velocities u, and how fast that changes.

    Args:
        body: what `pose_body` filled, shape (ROWS, N).
        q: bends, shape (segments,), rad.
        u: velocity of the centre of mass in the frame of the mean heading (m/s), yaw
            rate and bend rates (rad/s), shape (3 + segments,).
        solid: the body.
        rows: out, shape (N, 3, 3 + segments): velocity along, across, and yaw rate by
            u.
        rates: out, shape (N, 2, 3 + segments): their inertial rates, along and across.
    """
    mass = solid.mass
    n = mass.shape[0]
    rows[0, :2, 3:] = 0.0
    rates[0, :2, 3:] = 0.0
    for i in range(1, n):
        j = i - 1
        spin = u[2] + 0.5 * (body[SPIN, j] + body[SPIN, i])
        # Direction of the chord: half a bend behind the heading of its front end.
        chord = chord_terms(q[j], solid, j)
        span = chord.span
        derivative = chord.derivative
        c = body[COS, j] * chord.cos_half + body[SIN, j] * chord.sin_half
        s = body[SIN, j] * chord.cos_half - body[COS, j] * chord.sin_half
        length_rate = derivative * u[3 + j]
        bulge = chord.curvature * u[3 + j]
        for k in range(n - 1):
            # Bend k turns all behind it by −1, and everything by this much, so that the
            # mean stays.
            turn = (n - 1 - k) / n - (1.0 if k < j else 0.5 if k == j else 0.0)
            own = 1.0 if k == j else 0.0
            forth = own * derivative
            lateral = span * turn
            forth_rate = own * bulge - lateral * spin
            aside_rate = length_rate * turn + own * derivative * spin
            rows[i, 0, 3 + k] = rows[j, 0, 3 + k] - forth * c + lateral * s
            rows[i, 1, 3 + k] = rows[j, 1, 3 + k] - forth * s - lateral * c
            rates[i, 0, 3 + k] = rates[j, 0, 3 + k] - forth_rate * c + aside_rate * s
            rates[i, 1, 3 + k] = rates[j, 1, 3 + k] - forth_rate * s - aside_rate * c
    _centre(mass, rows, rates)
    for i in range(n):
        row = rows[i]
        rate = rates[i]
        row[0, 0] = 1.0
        row[0, 1] = 0.0
        row[0, 2] = -body[Y, i]
        row[1, 0] = 0.0
        row[1, 1] = 1.0
        row[1, 2] = body[X, i]
        rate[0, 0] = rate[0, 1] = rate[1, 0] = rate[1, 1] = 0.0
        rate[0, 2] = -body[VY, i] - u[2] * body[X, i]
        rate[1, 2] = body[VX, i] - u[2] * body[Y, i]
        c = body[COS, i]
        s = body[SIN, i]
        for k in range(n + 2):
            row[0, k], row[1, k] = (
                row[0, k] * c + row[1, k] * s,
                row[1, k] * c - row[0, k] * s,
            )
            rate[0, k], rate[1, k] = (
                rate[0, k] * c + rate[1, k] * s,
                rate[1, k] * c - rate[0, k] * s,
            )
            if k >= 3:
                row[2, k] = (n + 2 - k) / n - (1.0 if k - 3 < i else 0.0)
        row[2, 0] = 0.0
        row[2, 1] = 0.0
        row[2, 2] = 1.0


@compiled
def _centre(mass, rows, rates):  # type: ignore[no-untyped-def]
    """Refer the places by the bends, and their rates, to the centre of mass."""
    n = mass.shape[0]
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


def newtons_matrix(
    q: np.ndarray, u: np.ndarray, a: float, model: CompliantModel
) -> np.ndarray:
    """Return Newton's matrix of a stage of `compliant_kernels` as a sum over the rows of all connectors."""
    solid = model.solid
    floor = model.floor
    springs = a * model.damping + a * a * model.stiffness
    n = len(solid.mass)
    size = len(u)
    body = np.empty((ROWS, n))
    rows = np.empty((n, 3, size))
    rates = np.empty((n, 2, size))
    pose_body(q, u[3:], solid, body)
    fill_rows(body, q, u, solid, rows, rates)
    matrix = np.diag(np.append(np.zeros(3), springs))
    for row, rate, mass, inertia in zip(
        rows, rates, solid.mass, solid.inertia, strict=True
    ):
        own = np.diag([mass, mass, inertia]) - a * derivatives(row @ u, mass, floor)
        odd = a * mass * row[:2].T @ rate
        matrix += row.T @ own @ row + odd - odd.T
    return matrix


def derivatives(velocity: np.ndarray, mass: float, floor: FloorFriction) -> np.ndarray:
    """Return the slopes of a connector's friction by its velocities along, across, and about itself."""
    f = connector_friction(*velocity, mass * floor.gravity, floor)
    return np.array([[f.tt, f.tn, f.tm], [f.nt, f.nn, f.nm], [f.tm, f.mn, f.mm]])
