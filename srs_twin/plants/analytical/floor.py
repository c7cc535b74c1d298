r"""Compiled friction on the connectors of a moving body, with its slopes.

A straight body that slides without turning (`slide`) is a point under the same laws: thrown across the floor,
all its connectors move alike, so its mass cancels:

$$ \dot v = f(v; \mu_t/(1 + s), \mu_n), \qquad s = \sum_w \frac{I_w}{M R^2}, $$

with f the law for a load of g a unit mass. s is 0 where wheels have no inertia; wheels that have to stop
spinning as well lengthen the way along by 1 + s, because the floor brakes them with that much less than
their axles do. Nothing pushes such a body, so neither velocity ever changes its sign: each is followed by
the midpoint rule until it is 0, and stays so. Places are smooth in the velocities and coefficients, as a
fit needs them.

Momentary loads: a connector whose centre of mass lies at the height h stands on two wheels at ± a, and what
pushes it aside presses the outer one. It does not roll over, so that with the law's forces φ a unit load,
left and right,

$$ N_{L,R} = \tfrac W2 \mp k F_n, \qquad F_n = N_L φ_L + N_R φ_R
   = \frac W2\,\frac{φ_L + φ_R}{1 - k (φ_R - φ_L)}, \qquad k = \frac h{2a}; $$

a wheel that would pull carries nothing. Their slopes are taken with these loads held, which keeps them
symmetric: Newton's method then takes a few more steps to the same solution.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import overload

from srs_twin.compute.compiled import compiled
from srs_twin.plants.analytical.kinematics import COS, SIN, SPIN, VX, VY, X, Y
from srs_twin.robot import friction
from srs_twin.robot.friction import LAWS
from srs_twin.robot.spec import GRAVITY, RobotSpec


class FloorFriction(NamedTuple):
    """What the kernels know of the floor.

    Attributes:
        case: as many None as the number of contacts and law in `_CASES`: numba tells tuples by their length,
            so a kernel is compiled for the case of its floor alone.
        track: distance of each of two contacts from the centre line, m; 0: one contact a connector.
        mu_t: coefficient along.
        mu_n: coefficient across.
        slip: regularisation speed ε, m/s.
        drag: against the motion of each connector along its heading, N.
        lean: k, by how much of the force across the loads of the wheels shift; 0: they do not.
        down: gravity across the floor, m/s².
        pull_x: gravity along it, world frame, m/s².
        pull_y: the same.
    """

    case: tuple[None, ...]
    track: float
    mu_t: float
    mu_n: float
    slip: float
    drag: float
    lean: float
    down: float
    pull_x: float
    pull_y: float


@compiled
def _one_contact(law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Return what `connector_friction` does, of one contact under a law given as a function."""
    t, n, tt, tn, _, nn = law(along, across, weight, floor.mu_t, floor.mu_n, floor.slip)
    return t, n, 0.0, tt, tn, 0.0, nn, 0.0, 0.0


@compiled
def _two_contacts(law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Return what `connector_friction` does, of two contacts at the track."""
    mu_t, mu_n, slip, arm = floor.mu_t, floor.mu_n, floor.slip, floor.track
    a_t, a_n, a_tt, a_tn, _, a_nn = law(along - spin * arm, across, weight / 2, mu_t, mu_n, slip)
    b_t, b_n, b_tt, b_tn, _, b_nn = law(along + spin * arm, across, weight / 2, mu_t, mu_n, slip)
    return (
        *(a_t + b_t, a_n + b_n, arm * (b_t - a_t)),
        *(a_tt + b_tt, a_tn + b_tn, arm * (b_tt - a_tt)),
        *(a_nn + b_nn, arm * (b_tn - a_tn), arm * arm * (a_tt + b_tt)),
    )


@compiled
def _two_on_loads(law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Return what `connector_friction` does, of two contacts at the track, each with its momentary load."""
    mu_t, mu_n, slip, arm = floor.mu_t, floor.mu_n, floor.slip, floor.track
    a_t, a_n, a_tt, a_tn, _, a_nn = law(along - spin * arm, across, 1.0, mu_t, mu_n, slip)
    b_t, b_n, b_tt, b_tn, _, b_nn = law(along + spin * arm, across, 1.0, mu_t, mu_n, slip)
    push = weight / 2 * (a_n + b_n) / (1 - floor.lean * (b_n - a_n))
    a = min(max(weight / 2 - floor.lean * push, 0.0), weight)
    b = weight - a
    return (
        *(a * a_t + b * b_t, a * a_n + b * b_n, arm * (b * b_t - a * a_t)),
        *(a * a_tt + b * b_tt, a * a_tn + b * b_tn, arm * (b * b_tt - a * a_tt)),
        *(a * a_nn + b * b_nn, arm * (b * b_tn - a * a_tn), arm * arm * (a * a_tt + b * b_tt)),
    )


_LAWS = tuple(compiled(getattr(friction, name)) for name in LAWS)
_CASES = tuple((contacts, law) for contacts in (_one_contact, _two_contacts, _two_on_loads) for law in _LAWS)


_LEVEL = (0.0, 0.0, -GRAVITY)


def floor_friction(
    law: str,
    track: float,
    mu_t: float,
    mu_n: float,
    slip: float,
    lean: float = 0.0,
    gravity: tuple[float, float, float] = _LEVEL,
    drag: float = 0.0,
) -> FloorFriction:
    """Return a floor with one of `friction.LAWS` and a gravity (m/s², z off it), else as its attributes."""
    contacts = 0 if track == 0.0 else 1 if lean == 0.0 else 2
    case = LAWS.index(law) + len(LAWS) * contacts
    pull_x, pull_y, up = gravity
    return FloorFriction((None,) * case, track, mu_t, mu_n, slip, drag, lean, -up, pull_x, pull_y)


@compiled
def smoothed(floor, speed):  # type: ignore[no-untyped-def]
    """Return a floor that sloping lets nothing creep: the closer to rest, the less its law is smoothed.

    Args:
        floor: a level one is returned as it is.
        speed: about that of what moves fastest, m/s.
    """
    slip = floor.slip
    if floor.pull_x != 0.0 or floor.pull_y != 0.0:
        slip = min(slip, max(speed / _REST, _FINEST))
    return FloorFriction(
        floor.case,
        floor.track,
        floor.mu_t,
        floor.mu_n,
        slip,
        floor.drag,
        floor.lean,
        floor.down,
        floor.pull_x,
        floor.pull_y,
    )


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
    contacts, law = _CASES[len(floor.case)]
    return _dragged(contacts(law, along, across, spin, weight, floor), along, floor)


@compiled
def _dragged(found, along, floor):  # type: ignore[no-untyped-def]
    """Add the drag of tubes and belly to what `connector_friction` returns."""
    t, n, m, tt, tn, tm, nn, nm, mm = found
    if floor.drag > 0.0:
        r = 1 / np.sqrt(along * along + floor.slip * floor.slip)
        t -= floor.drag * along * r
        tt -= floor.drag * r * (floor.slip * r) ** 2
    return t, n, m, tt, tn, tm, nn, nm, mm


@overload(connector_friction, jit_options={"forceinline": True})
def _in_kernels(along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Compile for the case of a floor's type: without a branch."""
    contacts, law = _CASES[floor.types[floor.fields.index("case")].count]
    return lambda along, across, spin, weight, floor: _dragged(
        contacts(law, along, across, spin, weight, floor), along, floor
    )


@compiled
def floor_forces(body, mass, forth, aside, yaw, floor):  # type: ignore[no-untyped-def]  # noqa: D417
    """Sum the friction on a body whose shape changes as given.

    Args:
        body: what `kinematics.pose_body` filled, shape (ROWS, N).
        mass: shape (N,), kg; connector i carries the load m_i g, of the gravity across the floor.
        forth, aside: velocity of the centre of mass in the body frame, m/s.
        yaw: yaw rate, rad/s.
        floor: the floor.

    Returns:
        Net force (x, y) and moment about the centre of mass (z) in the body frame; their slopes by the three
        velocities, which are symmetric: xx, xy, xz, yy, yz, zz; the power that the floor takes, W.
    """
    cosine, sine, turning = body[COS], body[SIN], body[SPIN]
    place_x, place_y, rate_x, rate_y = body[X], body[Y], body[VX], body[VY]
    fx = fy = moment = power = 0.0
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(mass.shape[0]):
        c, s, px, py = cosine[i], sine[i], place_x[i], place_y[i]
        spin = yaw + turning[i]
        vx, vy = forth - yaw * py + rate_x[i], aside + yaw * px + rate_y[i]
        along, across = vx * c + vy * s, vy * c - vx * s
        t, n, m, tt, tn, tm, nn, nm, mm = connector_friction(along, across, spin, mass[i] * floor.down, floor)
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
    return (fx, fy, moment), (xx, xy, xz, yy, yz, zz), power


@compiled
def fill_forces(body, mass, u, floor, force):  # type: ignore[no-untyped-def]
    """Fill `force` (N, 3): what the floor exerts on each connector, along, across (N) and moment (N·m).

    Other arguments as in `floor_forces`, with the three velocities as `u`, shape (3 or more,).
    """
    for i in range(mass.shape[0]):
        c, s = body[COS, i], body[SIN, i]
        vx, vy = u[0] - u[2] * body[Y, i] + body[VX, i], u[1] + u[2] * body[X, i] + body[VY, i]
        along, across, spin = vx * c + vy * s, vy * c - vx * s, u[2] + body[SPIN, i]
        found = connector_friction(along, across, spin, mass[i] * floor.down, floor)
        force[i, 0], force[i, 1], force[i, 2] = found[0], found[1], found[2]


_REST = 1000.0  # times the slip speed a smoothed law has all but 1e-4 of its force, an ellipse of 1:14 too
_FINEST = 1e-7  # m/s
_STEP = 5e-4  # s
_SLIP = 1e-9  # m/s: nothing but 0/0 is to be avoided


def spin_share(spec: RobotSpec) -> float:
    """Return s, the inertia of solid wheels over the mass of the whole robot."""
    return 2 * spec.geometry.connectors * (spec.mass.wheel / 2) / spec.mass.total


def slide(
    velocity: tuple[float, float],
    times: np.ndarray,
    *,
    law: str,
    mu_t: float,
    mu_n: float,
    share: float = 0.0,
) -> np.ndarray:
    """Return where a thrown body is, in the frame of its heading, from where it was thrown.

    Args:
        velocity: along and across at time 0, m/s.
        times: ascending from 0 on, shape (times,), s.
        law: one of `friction.LAWS`.
        mu_t: coefficient along.
        mu_n: coefficient across.
        share: s, see above.

    Returns:
        Shape (times, 2), along and across, m.
    """
    floor = floor_friction(law, 0.0, mu_t / (1 + share), mu_n, _SLIP)
    place = np.empty((len(times), 2))
    _slide(float(velocity[0]), float(velocity[1]), np.ascontiguousarray(times, dtype=float), floor, place)
    return place


@compiled
def _slide(along, across, times, floor, place):  # type: ignore[no-untyped-def]
    """Fill the places at `times`."""
    x, y, now = 0.0, 0.0, 0.0
    for k in range(times.shape[0]):
        steps = int(np.ceil((times[k] - now) / _STEP))
        for _ in range(steps):
            h = (times[k] - now) / steps
            a_t, a_n = _slowing(along, across, floor)
            a_t, a_n = _slowing(_midway(along, h * a_t), _midway(across, h * a_n), floor)
            x += _way(along, a_t, h)
            y += _way(across, a_n, h)
            along, across = _still(along, h * a_t), _still(across, h * a_n)
        now = times[k]
        place[k, 0], place[k, 1] = x, y


@compiled
def _slowing(along, across, floor):  # type: ignore[no-untyped-def]
    """Return the accelerations along and across, m/s²."""
    forces = connector_friction(along, across, 0.0, GRAVITY, floor)
    return forces[0], forces[1]


@compiled
def _still(speed, change):  # type: ignore[no-untyped-def]
    """Return a velocity after a change, 0 where that would turn its sign."""
    after = speed + change
    return after if after * speed > 0.0 else 0.0


@compiled
def _midway(speed, change):  # type: ignore[no-untyped-def]
    """Return the mean velocity of a step, or of its part before it stops."""
    return speed + change / 2 if (speed + change) * speed > 0.0 else speed / 2


@compiled
def _way(speed, slowing, h):  # type: ignore[no-untyped-def]
    """Return how far a step takes it, or how far it gets before it stops within."""
    if speed == 0.0:
        return 0.0
    if (speed + h * slowing) * speed > 0.0:
        return h * (speed + h * slowing / 2)
    return -speed * speed / (2.0 * slowing)
