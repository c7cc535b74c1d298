"""Compiled friction on the connectors of a moving body, with its slopes."""

from __future__ import annotations

from typing import NamedTuple

from srs_twin import friction
from srs_twin.compiled import compiled
from srs_twin.plants.kinematics import COS, SIN, SPIN, VX, VY, X, Y
from srs_twin.spec import GRAVITY


class Floor(NamedTuple):
    """What the kernels know of the floor.

    Attributes:
        law: number of the friction law in `friction.LAWS`.
        track: distance of each of two contacts from the centre line, m; 0: one contact a connector.
        mu_t: coefficient along.
        mu_n: coefficient across.
        slip: regularisation speed ε, m/s.
    """

    law: int
    track: float
    mu_t: float
    mu_n: float
    slip: float


_axis = compiled(friction.axis)
_wheel = compiled(friction.wheel)
_viscous = compiled(friction.viscous)
_ellipse = compiled(friction.ellipse)


@compiled
def friction_law(v_t, v_n, load, floor):  # type: ignore[no-untyped-def]
    """Return force (N) and slopes (N·s/m) of one contact by the law's number in `friction.LAWS`."""
    if floor.law == 0:
        return _axis(v_t, v_n, load, floor.mu_t, floor.mu_n, floor.slip)
    if floor.law == 1:
        return _wheel(v_t, v_n, load, floor.mu_t, floor.mu_n, floor.slip)
    if floor.law == 2:
        return _viscous(v_t, v_n, load, floor.mu_t, floor.mu_n, floor.slip)
    return _ellipse(v_t, v_n, load, floor.mu_t, floor.mu_n, floor.slip)


@compiled
def connector_friction(along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Return force and moment of a connector's contacts, and their slopes.

    Friction is steepest descent of a potential, so the slopes are symmetric.

    Args:
        along: velocity of the connector along its heading, m/s.
        across: across it, m/s.
        spin: its yaw rate, rad/s.
        weight: normal load, shared by the contacts, N.
        floor: the floor.

    Returns:
        Force along (t) and across (n), moment (m); slopes tt, tn, tm, nn, nm, mm.
    """
    if floor.track == 0.0:
        t, n, tt, tn, _, nn = friction_law(along, across, weight, floor)
        return t, n, 0.0, tt, tn, 0.0, nn, 0.0, 0.0
    arm = floor.track
    a_t, a_n, a_tt, a_tn, _, a_nn = friction_law(along - spin * arm, across, weight / 2, floor)
    b_t, b_n, b_tt, b_tn, _, b_nn = friction_law(along + spin * arm, across, weight / 2, floor)
    return (
        a_t + b_t, a_n + b_n, arm * (b_t - a_t),
        a_tt + b_tt, a_tn + b_tn, arm * (b_tt - a_tt),
        a_nn + b_nn, arm * (b_tn - a_tn), arm * arm * (a_tt + b_tt),
    )  # fmt: skip


@compiled
def floor_forces(body, mass, u, floor, total, slope):  # type: ignore[no-untyped-def]
    """Sum the friction on a body whose shape changes as given; return the power that it takes, W.

    Args:
        body: what `kinematics.pose_body` filled, shape (N, COLUMNS).
        mass: shape (N,), kg; connector i carries the load m_i g.
        u: velocity of the centre of mass in the body frame (m/s) and yaw rate (rad/s), shape (3,).
        floor: the floor.
        total: out, net force and moment about the centre of mass in the body frame, shape (3,).
        slope: out, d total/d u, shape (3, 3), symmetric.
    """
    fx = fy = moment = power = 0.0
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(mass.shape[0]):
        c, s, px, py = body[i, COS], body[i, SIN], body[i, X], body[i, Y]
        spin = u[2] + body[i, SPIN]
        vx, vy = u[0] - u[2] * py + body[i, VX], u[1] + u[2] * px + body[i, VY]
        along, across = vx * c + vy * s, vy * c - vx * s
        t, n, m, tt, tn, tm, nn, nm, mm = connector_friction(along, across, spin, mass[i] * GRAVITY, floor)
        # How velocity along and across depend on the yaw rate; by d'Alembert the arms of the forces.
        t_arm, n_arm = px * s - py * c, px * c + py * s
        fx += t * c - n * s
        fy += t * s + n * c
        moment += t * t_arm + n * n_arm + m
        power -= t * along + n * across + m * spin
        on_x_t, on_x_n = tt * c - tn * s, tn * c - nn * s
        on_y_t, on_y_n = tt * s + tn * c, tn * s + nn * c
        on_z_t, on_z_n = tt * t_arm + tn * n_arm + tm, tn * t_arm + nn * n_arm + nm
        on_z_m = tm * t_arm + nm * n_arm + mm
        xx += on_x_t * c - on_x_n * s
        xy += on_x_t * s + on_x_n * c
        yy += on_y_t * s + on_y_n * c
        xz += on_z_t * c - on_z_n * s
        yz += on_z_t * s + on_z_n * c
        zz += on_z_t * t_arm + on_z_n * n_arm + on_z_m
    total[0], total[1], total[2] = fx, fy, moment
    slope[0, 0], slope[0, 1], slope[0, 2] = xx, xy, xz
    slope[1, 0], slope[1, 1], slope[1, 2] = xy, yy, yz
    slope[2, 0], slope[2, 1], slope[2, 2] = xz, yz, zz
    return power


@compiled
def fill_forces(body, mass, u, floor, force):  # type: ignore[no-untyped-def]
    """Fill `force` (N, 3): what the floor exerts on each connector, along, across (N) and moment (N·m).

    Other arguments as in `floor_forces`.
    """
    for i in range(mass.shape[0]):
        c, s = body[i, COS], body[i, SIN]
        vx, vy = u[0] - u[2] * body[i, Y] + body[i, VX], u[1] + u[2] * body[i, X] + body[i, VY]
        found = connector_friction(
            vx * c + vy * s, vy * c - vx * s, u[2] + body[i, SPIN], mass[i] * GRAVITY, floor
        )
        force[i, 0], force[i, 1], force[i, 2] = found[0], found[1], found[2]
