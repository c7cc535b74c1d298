r"""Compiled friction on the connectors of a moving body, with its slopes.

**Coasting.** A straight body that slides without rotation (`slide`) moves like a point with the same laws.
All connectors move equally, so the mass cancels:

$$ \dot v = f(v; \mu_t/(1 + s), \mu_n), \qquad s = \sum_w \frac{I_w}{M R^2}, $$

with the law f for a load of g per unit mass. s is the inertia of the spinning wheels; 0 without it. The spin
of the wheels adds inertia along the heading, which lengthens the stopping distance by the factor 1 + s. No
other force acts, so neither velocity component changes its sign: each is integrated by the midpoint rule
until it is 0, and stays 0. Positions are smooth in the velocities and coefficients, as a fit requires.

**Momentary loads.** A connector has two wheels at ± a, and its centre of mass is at the height h. A lateral
force increases the load of the outer wheel. The connector does not tip over, so that with the law's force φ
per unit load, left and right,

$$ N_{L,R} = \tfrac W2 \mp k F_n, \qquad F_n = N_L φ_L + N_R φ_R
   = \frac W2\,\frac{φ_L + φ_R}{1 - k (φ_R - φ_L)}, \qquad k = \frac h{2a}. $$

Loads are not negative. Slopes are computed at constant loads, which keeps them symmetric. The solution is the
same; Newton's method needs a few more iterations.
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
    """Friction parameters and slope of the floor, for the kernels.

    Attributes:
        case: tuple of None whose length is the index into `_CASES`. The length is part of the type in numba,
            so that a kernel is compiled for the contacts and the law of its floor only.
        track: distance of the two contacts of a connector from the centre line, m; 0 for one contact.
        mu_t: friction coefficient along the heading, 1.
        mu_n: friction coefficient across the heading, 1.
        slip: slip speed ε, m/s.
        drag: axial drag on each connector, N.
        load_transfer: k, load transferred between the wheels per lateral force, 1; 0 for static loads.
        gravity: component of gravity normal to the floor, m/s².
        pull_x: component of gravity along the floor in world x, m/s².
        pull_y: component of gravity along the floor in world y, m/s².
        unit: time unit u of the robot (`robot.scale`), for tolerances, 1.
    """

    case: tuple[None, ...]
    track: float
    mu_t: float
    mu_n: float
    slip: float
    drag: float
    load_transfer: float
    gravity: float
    pull_x: float
    pull_y: float
    unit: float


@compiled
def _one_contact(law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Evaluate `connector_friction` for one contact; `law` is a compiled law of `robot.friction`."""
    t, n, tt, tn, _, nn = law(along, across, weight, floor.mu_t, floor.mu_n, floor.slip)
    return t, n, 0.0, tt, tn, 0.0, nn, 0.0, 0.0


@compiled
def _two_contacts(law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Evaluate `connector_friction` for two contacts at the track with static loads."""
    mu_t, mu_n, slip, arm = floor.mu_t, floor.mu_n, floor.slip, floor.track
    a_t, a_n, a_tt, a_tn, _, a_nn = law(along - spin * arm, across, weight / 2, mu_t, mu_n, slip)
    b_t, b_n, b_tt, b_tn, _, b_nn = law(along + spin * arm, across, weight / 2, mu_t, mu_n, slip)
    return (
        *(a_t + b_t, a_n + b_n, arm * (b_t - a_t)),
        *(a_tt + b_tt, a_tn + b_tn, arm * (b_tt - a_tt)),
        *(a_nn + b_nn, arm * (b_tn - a_tn), arm * arm * (a_tt + b_tt)),
    )


@compiled
def _two_loaded_contacts(law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Evaluate `connector_friction` for two contacts at the track with momentary loads."""
    mu_t, mu_n, slip, arm = floor.mu_t, floor.mu_n, floor.slip, floor.track
    a_t, a_n, a_tt, a_tn, _, a_nn = law(along - spin * arm, across, 1.0, mu_t, mu_n, slip)
    b_t, b_n, b_tt, b_tn, _, b_nn = law(along + spin * arm, across, 1.0, mu_t, mu_n, slip)
    lateral_force = weight / 2 * (a_n + b_n) / (1 - floor.load_transfer * (b_n - a_n))
    # Loads of the left and the right wheel.
    a = min(max(weight / 2 - floor.load_transfer * lateral_force, 0.0), weight)
    b = weight - a
    return (
        *(a * a_t + b * b_t, a * a_n + b * b_n, arm * (b * b_t - a * a_t)),
        *(a * a_tt + b * b_tt, a * a_tn + b * b_tn, arm * (b * b_tt - a * a_tt)),
        *(a * a_nn + b * b_nn, arm * (b * b_tn - a * a_tn), arm * arm * (a * a_tt + b * b_tt)),
    )


_LAWS = tuple(compiled(getattr(friction, name)) for name in LAWS)
_CASES = tuple(
    (contacts, law) for contacts in (_one_contact, _two_contacts, _two_loaded_contacts) for law in _LAWS
)


_LEVEL = (0.0, 0.0, -GRAVITY)  # gravity on a level floor, m/s²


def floor_friction(
    law: str,
    track: float,
    mu_t: float,
    mu_n: float,
    slip: float,
    load_transfer: float = 0.0,
    gravity: tuple[float, float, float] = _LEVEL,
    drag: float = 0.0,
    unit: float = 1.0,
) -> FloorFriction:
    """Return a floor.

    Args:
        law: one of `robot.friction.LAWS`.
        track: see `FloorFriction`.
        mu_t: see `FloorFriction`.
        mu_n: see `FloorFriction`.
        slip: see `FloorFriction`.
        load_transfer: see `FloorFriction`.
        gravity: gravity in a frame with z normal to the floor, m/s².
        drag: see `FloorFriction`.
        unit: see `FloorFriction`.
    """
    contacts = 0 if track == 0.0 else 1 if load_transfer == 0.0 else 2
    case = LAWS.index(law) + len(LAWS) * contacts
    pull_x, pull_y, pull_z = gravity
    return FloorFriction(
        (None,) * case, track, mu_t, mu_n, slip, drag, load_transfer, -pull_z, pull_x, pull_y, unit
    )


@compiled
def with_reduced_slip_speed(floor, speed):  # type: ignore[no-untyped-def]
    """Return a floor on which a body at rest does not creep down a slope.

    A regularised law yields at any force. On a slope the slip speed therefore decreases with the speed of the
    body.

    Args:
        floor: a level floor is returned unchanged.
        speed: approximate largest speed of the body, m/s.
    """
    slip = floor.slip
    if floor.pull_x != 0.0 or floor.pull_y != 0.0:
        slip = min(slip, max(speed / _SLIDING_RATIO, _MIN_SLIP_SPEED * floor.unit))
    return FloorFriction(
        floor.case,
        floor.track,
        floor.mu_t,
        floor.mu_n,
        slip,
        floor.drag,
        floor.load_transfer,
        floor.gravity,
        floor.pull_x,
        floor.pull_y,
        floor.unit,
    )


def connector_friction(along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Return force and moment of a connector's contacts, and their slopes.

    Friction is the gradient of a potential, so that the slopes are symmetric.

    Args:
        along: velocity of the connector along its heading, m/s.
        across: velocity across its heading, m/s.
        spin: yaw rate, rad/s.
        weight: normal load of all contacts together, N.
        floor: the floor.

    Returns:
        Force along t and across n (N), moment m (N·m), and the slopes tt, tn, tm, nn, nm, mm.
    """
    contacts, law = _CASES[len(floor.case)]
    return _add_drag(contacts(law, along, across, spin, weight, floor), along, floor)


@compiled
def _add_drag(friction_terms, along, floor):  # type: ignore[no-untyped-def]
    """Add the axial drag to the results of `connector_friction`."""
    t, n, m, tt, tn, tm, nn, nm, mm = friction_terms
    if floor.drag > 0.0:
        r = 1 / np.sqrt(along * along + floor.slip * floor.slip)
        t -= floor.drag * along * r
        tt -= floor.drag * r * (floor.slip * r) ** 2
    return t, n, m, tt, tn, tm, nn, nm, mm


@overload(connector_friction, jit_options={"forceinline": True})
def _compile_connector_friction(along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Compile `connector_friction` for the case of a floor's type, without a branch."""
    contacts, law = _CASES[floor.types[floor.fields.index("case")].count]
    return lambda along, across, spin, weight, floor: _add_drag(
        contacts(law, along, across, spin, weight, floor), along, floor
    )


@compiled
def floor_forces(body, mass, forth, aside, yaw, floor):  # type: ignore[no-untyped-def]  # noqa: D417
    """Sum the friction on a body with prescribed bends.

    Args:
        body: posed body, shape (ROWS, N).
        mass: shape (N,), kg; connector i carries the load m_i g, with gravity normal to the floor.
        forth, aside: velocity of the centre of mass in the body frame, m/s.
        yaw: yaw rate, rad/s.
        floor: the floor.

    Returns:
        Net force (x, y) and moment about the centre of mass (z) in the body frame; their symmetric slopes
        with respect to the three velocities: xx, xy, xz, yy, yz, zz; the dissipated power, W.
    """
    cosine, sine, spins = body[COS], body[SIN], body[SPIN]
    place_x, place_y, rate_x, rate_y = body[X], body[Y], body[VX], body[VY]
    fx = fy = moment = power = 0.0
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(mass.shape[0]):
        c, s, px, py = cosine[i], sine[i], place_x[i], place_y[i]
        spin = yaw + spins[i]
        vx, vy = forth - yaw * py + rate_x[i], aside + yaw * px + rate_y[i]
        along, across = vx * c + vy * s, vy * c - vx * s
        t, n, m, tt, tn, tm, nn, nm, mm = connector_friction(
            along, across, spin, mass[i] * floor.gravity, floor
        )
        # Derivatives of the velocities along and across by the yaw rate: the lever arms of the forces.
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
    """Fill the floor's force on each connector, along, across (N) and moment (N·m), shape (N, 3).

    Args:
        body: posed body, shape (ROWS, N).
        mass: shape (N,), kg.
        u: velocity of the centre of mass in the body frame (m/s) and yaw rate (rad/s), shape (3 or more,).
        floor: the floor.
        force: out.
    """
    for i in range(mass.shape[0]):
        c, s = body[COS, i], body[SIN, i]
        vx, vy = u[0] - u[2] * body[Y, i] + body[VX, i], u[1] + u[2] * body[X, i] + body[VY, i]
        along, across, spin = vx * c + vy * s, vy * c - vx * s, u[2] + body[SPIN, i]
        terms = connector_friction(along, across, spin, mass[i] * floor.gravity, floor)
        force[i, 0], force[i, 1], force[i, 2] = terms[0], terms[1], terms[2]


# Ratio of speed to slip speed at which a law has reached its full force within 1e-4, also for an ellipse of
# 1:14, 1.
_SLIDING_RATIO = 1000.0

_MIN_SLIP_SPEED = 1e-7  # on a slope at a time unit of 1, m/s
_COASTING_STEP = 5e-4  # longest time step of `slide`, s
_COASTING_SLIP_SPEED = 1e-9  # slip speed of `slide`, m/s; small, because it only avoids 0/0


def spin_share(spec: RobotSpec) -> float:
    """Return s: inertia of the wheels, as solid discs, divided by the mass of the robot, 1."""
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
    """Return the positions of a coasting body in the frame of its heading, relative to the start.

    Args:
        velocity: initial velocity along and across the heading, m/s.
        times: ascending from 0, shape (times,), s.
        law: one of `robot.friction.LAWS`.
        mu_t: friction coefficient along the heading, 1.
        mu_n: friction coefficient across the heading, 1.
        share: s of the module docstring, 1.

    Returns:
        Positions along and across, shape (times, 2), m.
    """
    floor = floor_friction(law, 0.0, mu_t / (1 + share), mu_n, _COASTING_SLIP_SPEED)
    position = np.empty((len(times), 2))
    _fill_positions(
        float(velocity[0]), float(velocity[1]), np.ascontiguousarray(times, dtype=float), floor, position
    )
    return position


@compiled
def _fill_positions(along, across, times, floor, position):  # type: ignore[no-untyped-def]
    """Integrate the coasting motion and fill its positions at `times`, shape (times, 2), m."""
    x, y, now = 0.0, 0.0, 0.0
    for k in range(times.shape[0]):
        steps = int(np.ceil((times[k] - now) / _COASTING_STEP))
        for _ in range(steps):
            h = (times[k] - now) / steps
            a_t, a_n = _deceleration(along, across, floor)
            a_t, a_n = _deceleration(_mean_velocity(along, h * a_t), _mean_velocity(across, h * a_n), floor)
            x += _distance(along, a_t, h)
            y += _distance(across, a_n, h)
            along, across = _stop_at_zero(along, h * a_t), _stop_at_zero(across, h * a_n)
        now = times[k]
        position[k, 0], position[k, 1] = x, y


@compiled
def _deceleration(along, across, floor):  # type: ignore[no-untyped-def]
    """Return the accelerations along and across, m/s²."""
    forces = connector_friction(along, across, 0.0, GRAVITY, floor)
    return forces[0], forces[1]


@compiled
def _stop_at_zero(speed, change):  # type: ignore[no-untyped-def]
    """Return a velocity after a change, or 0 if the change would reverse it."""
    after = speed + change
    return after if after * speed > 0.0 else 0.0


@compiled
def _mean_velocity(speed, change):  # type: ignore[no-untyped-def]
    """Return the mean velocity during a step, or during the part of it before the body stops."""
    return speed + change / 2 if (speed + change) * speed > 0.0 else speed / 2


@compiled
def _distance(speed, acceleration, h):  # type: ignore[no-untyped-def]
    """Return the distance in a step with constant acceleration, or the distance until the body stops."""
    if speed == 0.0:
        return 0.0
    if (speed + h * acceleration) * speed > 0.0:
        return h * (speed + h * acceleration / 2)
    return -speed * speed / (2.0 * acceleration)
