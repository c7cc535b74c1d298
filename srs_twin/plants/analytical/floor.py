r"""Compiled friction on the connectors of a moving body, with its slopes.

**Coasting.** A straight body that slides without rotation (`slide`) moves like a point
with the same laws. All connectors move equally, so the mass cancels:

$$ \dot v = f(v; \mu_t/(1 + s), \mu_n), \qquad s = \sum_w \frac{I_w}{M R^2}, $$

with the law f for a load of g per unit mass. s is the inertia of the spinning wheels; 0
without it. The spin of the wheels adds inertia along the heading, which lengthens the
stopping distance by the factor 1 + s. No other force acts, so neither velocity
component changes its sign: each is integrated by the midpoint rule until it is 0, and
stays 0. Positions are smooth in the velocities and coefficients, as a fit requires.

**Momentary loads.** A connector has two wheels at ± a, and its centre of mass is at the
height h. A lateral force increases the load of the outer wheel. The connector does not
tip over, so that with the law's force φ per unit load, left and right,

$$ N_{L,R} = \tfrac W2 \mp k F_n, \qquad F_n = N_L φ_L + N_R φ_R
   = \frac W2\,\frac{φ_L + φ_R}{1 - k (φ_R - φ_L)}, \qquad k = \frac h{2a}. $$

Loads are not negative. Slopes are computed at constant loads, which keeps them
symmetric. The solution is the same; Newton's method needs a few more iterations.

**Skin** has another coefficient for slip towards the tail than towards the head. The
law `cosine` has no potential, so that its slopes are not symmetric. Both are cases of
their own, and the kernels of other floors do not depend on them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, kernel_only, overload_part
from srs_twin.plants.analytical.kinematics import COS, SIN, SPIN, VX, VY, X, Y
from srs_twin.robot import friction
from srs_twin.robot.friction import LAWS
from srs_twin.robot.spec import GRAVITY, RobotSpec


class FloorFriction(NamedTuple):
    """Friction parameters and slope of the floor, for the kernels.

    Attributes:
        case: tuple of None whose length is the index into `_CASES`. The length is part
            of the type in numba, so that a kernel is compiled for the contacts and the
            law of its floor only.
        track: distance of the two contacts of a connector from the centre line, m; 0
            for one contact.
        mu_t: friction coefficient along the heading, 1.
        mu_n: friction coefficient across the heading, 1.
        slip: slip speed ε, m/s.
        drag: axial drag on each connector, N.
        load_transfer: k, load transferred between the wheels per lateral force, 1; 0
            for static loads.
        mu_back: friction coefficient along the heading for slip towards the tail, 1.
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
    mu_back: float
    gravity: float
    pull_x: float
    pull_y: float
    unit: float


@compiled
def _one_contact(law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Evaluate `connector_friction` for one contact; `law` is a compiled law of `robot.friction`."""
    t, n, tt, tn, _, nn = law(along, across, weight, floor.mu_t, floor.mu_n, floor.slip)
    return t, n, 0.0, tt, tn, 0.0, nn, 0.0, 0.0, tn, 0.0


@compiled
def _two_contacts(law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Evaluate `connector_friction` for two contacts at the track with static loads."""
    mu_t = floor.mu_t
    mu_n = floor.mu_n
    slip = floor.slip
    arm = floor.track
    a_t, a_n, a_tt, a_tn, _, a_nn = law(
        along - spin * arm, across, weight / 2, mu_t, mu_n, slip
    )
    b_t, b_n, b_tt, b_tn, _, b_nn = law(
        along + spin * arm, across, weight / 2, mu_t, mu_n, slip
    )
    return (
        *(a_t + b_t, a_n + b_n, arm * (b_t - a_t)),
        *(a_tt + b_tt, a_tn + b_tn, arm * (b_tt - a_tt)),
        *(a_nn + b_nn, arm * (b_tn - a_tn), arm * arm * (a_tt + b_tt)),
        *(a_tn + b_tn, arm * (b_tn - a_tn)),
    )


@compiled
def _two_loaded_contacts(law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Evaluate `connector_friction` for two contacts at the track with momentary loads."""
    mu_t = floor.mu_t
    mu_n = floor.mu_n
    slip = floor.slip
    arm = floor.track
    a_t, a_n, a_tt, a_tn, _, a_nn = law(
        along - spin * arm, across, 1.0, mu_t, mu_n, slip
    )
    b_t, b_n, b_tt, b_tn, _, b_nn = law(
        along + spin * arm, across, 1.0, mu_t, mu_n, slip
    )
    lateral_force = weight / 2 * (a_n + b_n) / (1 - floor.load_transfer * (b_n - a_n))
    # Loads of the left and the right wheel.
    a = min(max(weight / 2 - floor.load_transfer * lateral_force, 0.0), weight)
    b = weight - a
    return (
        *(a * a_t + b * b_t, a * a_n + b * b_n, arm * (b * b_t - a * a_t)),
        *(a * a_tt + b * b_tt, a * a_tn + b * b_tn, arm * (b * b_tt - a * a_tt)),
        *(
            a * a_nn + b * b_nn,
            arm * (b * b_tn - a * a_tn),
            arm * arm * (a * a_tt + b * b_tt),
        ),
        *(a * a_tn + b * b_tn, arm * (b * b_tn - a * a_tn)),
    )


@compiled
def _skin(law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Evaluate `connector_friction` for two contact points of a skin; the track may be 0."""
    mu_n = floor.mu_n
    slip = floor.slip
    arm = floor.track
    v_a = along - spin * arm
    v_b = along + spin * arm
    mu_a = floor.mu_t if v_a >= 0.0 else floor.mu_back
    mu_b = floor.mu_t if v_b >= 0.0 else floor.mu_back
    a_t, a_n, a_tt, a_tn, a_nt, a_nn = law(v_a, across, 1.0, mu_a, mu_n, slip)
    b_t, b_n, b_tt, b_tn, b_nt, b_nn = law(v_b, across, 1.0, mu_b, mu_n, slip)
    lateral_force = weight / 2 * (a_n + b_n) / (1 - floor.load_transfer * (b_n - a_n))
    # Loads of the left and the right point.
    a = min(max(weight / 2 - floor.load_transfer * lateral_force, 0.0), weight)
    b = weight - a
    return (
        *(a * a_t + b * b_t, a * a_n + b * b_n, arm * (b * b_t - a * a_t)),
        *(a * a_tt + b * b_tt, a * a_tn + b * b_tn, arm * (b * b_tt - a * a_tt)),
        *(
            a * a_nn + b * b_nn,
            arm * (b * b_nt - a * a_nt),
            arm * arm * (a * a_tt + b * b_tt),
        ),
        *(a * a_nt + b * b_nt, arm * (b * b_tn - a * a_tn)),
    )


_LAWS = tuple(compiled(getattr(friction, name)) for name in LAWS)
_CASES = tuple(
    (contacts, law)
    for contacts in (_one_contact, _two_contacts, _two_loaded_contacts, _skin)
    for law in _LAWS
)
_COUNT = len(LAWS)
_COSINE = LAWS.index("cosine")
_SKIN = 3  # index of `_skin` in the above


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
    mu_back: float | None = None,
    unit: float = 1.0,
) -> FloorFriction:
    """Return a floor; that of a skin with `mu_back`.

    Args:
        law: one of `robot.friction.LAWS`.
        track: see `FloorFriction`.
        mu_t: see `FloorFriction`.
        mu_n: see `FloorFriction`.
        slip: see `FloorFriction`.
        load_transfer: see `FloorFriction`.
        gravity: gravity in a frame with z normal to the floor, m/s².
        drag: see `FloorFriction`.
        mu_back: see `FloorFriction`; None for wheels.
        unit: see `FloorFriction`.
    """
    if track == 0.0:
        contacts = 0
    elif load_transfer == 0.0:
        contacts = 1
    else:
        contacts = 2
    if mu_back is not None or law == "cosine":
        contacts = _SKIN
        mu_back = mu_t if mu_back is None else mu_back
    case = LAWS.index(law) + len(LAWS) * contacts
    pull_x, pull_y, pull_z = gravity
    back = mu_t if mu_back is None else mu_back
    return FloorFriction(
        (None,) * case,
        track,
        mu_t,
        mu_n,
        slip,
        drag,
        load_transfer,
        back,
        -pull_z,
        pull_x,
        pull_y,
        unit,
    )


@kernel_only
def with_reduced_slip_speed(floor, speed):  # type: ignore[no-untyped-def]
    """Return a floor on which a body at rest does not creep down a slope.

    A regularised law yields at any force. On a slope the slip speed therefore decreases
    with the speed of the body.

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
        floor.mu_back,
        floor.gravity,
        floor.pull_x,
        floor.pull_y,
        floor.unit,
    )


def connector_friction(along, across, spin, weight, floor) -> Any:  # type: ignore[no-untyped-def]
    """Return force and moment of a connector's contacts, and their slopes.

    Friction is the gradient of a potential, so that the slopes are symmetric, except
    under the law `cosine`.

    Args:
        along: velocity of the connector along its heading, m/s.
        across: velocity across its heading, m/s.
        spin: yaw rate, rad/s.
        weight: normal load of all contacts together, N.
        floor: the floor.

    Returns:
        Force along t and across n (N), moment m (N·m), and the slopes tt, tn, tm, nn,
        nm, mm, nt, mn: tn is the derivative of t by the velocity across. mt is always
        tm.
    """
    contacts, law = _CASES[len(floor.case)]
    return _add_drag(contacts(law, along, across, spin, weight, floor), along, floor)


@compiled
def _add_drag(friction_terms, along, floor):  # type: ignore[no-untyped-def]
    """Add the axial drag to the results of `connector_friction`."""
    t, n, m, tt, tn, tm, nn, nm, mm, nt, mn = friction_terms
    if floor.drag > 0.0:
        r = 1 / np.sqrt(along * along + floor.slip * floor.slip)
        t -= floor.drag * along * r
        tt -= floor.drag * r * (floor.slip * r) ** 2
    return t, n, m, tt, tn, tm, nn, nm, mm, nt, mn


@compiled
def has_no_potential(floor):  # type: ignore[no-untyped-def]
    """Return whether the slopes of friction are not symmetric; known when a kernel is compiled."""
    return len(floor.case) % _COUNT == _COSINE


@kernel_only
def slopes_of_force(tt, tn, nt, nn, c, s):  # type: ignore[no-untyped-def]
    """Return the slopes xx, xy, yx, yy of the force at a heading with the cosine c and the sine s."""
    t_x = tt * c - tn * s
    n_x = nt * c - nn * s
    t_y = tt * s + tn * c
    n_y = nt * s + nn * c
    return t_x * c - n_x * s, t_y * c - n_y * s, t_x * s + n_x * c, t_y * s + n_y * c


@overload_part(connector_friction)
def _compile_connector_friction(along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    """Compile `connector_friction` for the case of a floor's type, without a branch."""
    contacts, law = _CASES[floor.types[floor.fields.index("case")].count]
    return lambda along, across, spin, weight, floor: _add_drag(
        contacts(law, along, across, spin, weight, floor), along, floor
    )


@kernel_only
def floor_forces(body, mass, forth, aside, yaw, floor):  # type: ignore[no-untyped-def]  # noqa: D417
    """Sum the friction on a body with prescribed bends, under a law with a potential.

    Args:
        body: posed body, shape (ROWS, N).
        mass: shape (N,), kg; connector i carries the load m_i g, with gravity normal to
            the floor.
        forth, aside: velocity of the centre of mass in the body frame, m/s.
        yaw: yaw rate, rad/s.
        floor: the floor.

    Returns:
        Net force (x, y) and moment about the centre of mass (z) in the body frame;
        their symmetric slopes
        with respect to the three velocities: xx, xy, xz, yy, yz, zz; the dissipated
            power, W.
    """
    cosine = body[COS]
    sine = body[SIN]
    spins = body[SPIN]
    place_x = body[X]
    place_y = body[Y]
    rate_x = body[VX]
    rate_y = body[VY]
    fx = fy = moment = power = 0.0
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(mass.shape[0]):
        c = cosine[i]
        s = sine[i]
        px = place_x[i]
        py = place_y[i]
        spin = yaw + spins[i]
        vx = forth - yaw * py + rate_x[i]
        vy = aside + yaw * px + rate_y[i]
        along = vx * c + vy * s
        across = vy * c - vx * s
        t, n, m, tt, tn, tm, nn, nm, mm, _, _ = connector_friction(
            along, across, spin, mass[i] * floor.gravity, floor
        )
        # Derivatives of the velocities along and across by the yaw rate: the lever arms
        # of the forces.
        t_arm = px * s - py * c
        n_arm = px * c + py * s
        fx += t * c - n * s
        fy += t * s + n * c
        moment += t * t_arm + n * n_arm + m
        power -= t * along + n * across + m * spin
        on_x_t = tt * c - tn * s
        on_x_n = tn * c - nn * s
        on_y_t = tt * s + tn * c
        on_y_n = tn * s + nn * c
        on_z_t = tt * t_arm + tn * n_arm + tm
        on_z_n = tn * t_arm + nn * n_arm + nm
        on_z_m = tm * t_arm + nm * n_arm + mm
        xx += on_x_t * c - on_x_n * s
        xy += on_x_t * s + on_x_n * c
        yy += on_y_t * s + on_y_n * c
        xz += on_z_t * c - on_z_n * s
        yz += on_z_t * s + on_z_n * c
        zz += on_z_t * t_arm + on_z_n * n_arm + on_z_m
    return (fx, fy, moment), (xx, xy, xz, yy, yz, zz), power


@compiled
def _unsymmetric_forces(body, mass, forth, aside, yaw, floor):  # type: ignore[no-untyped-def]
    """Evaluate `forces_and_slopes` under a law without a potential."""
    fx = fy = moment = power = 0.0
    xx = xy = xz = yx = yy = yz = zx = zy = zz = 0.0
    for i in range(mass.shape[0]):
        c = body[COS, i]
        s = body[SIN, i]
        px = body[X, i]
        py = body[Y, i]
        spin = yaw + body[SPIN, i]
        vx = forth - yaw * py + body[VX, i]
        vy = aside + yaw * px + body[VY, i]
        along = vx * c + vy * s
        across = vy * c - vx * s
        t, n, m, tt, tn, tm, nn, nm, mm, nt, mn = connector_friction(
            along, across, spin, mass[i] * floor.gravity, floor
        )
        d_xx, d_xy, d_yx, d_yy = slopes_of_force(tt, tn, nt, nn, c, s)
        # Derivatives by the spin alone, and of the moment by the velocity alone.
        spin_x = tm * c - nm * s
        spin_y = tm * s + nm * c
        moment_x = tm * c - mn * s
        moment_y = tm * s + mn * c
        force_x = t * c - n * s
        force_y = t * s + n * c
        fx = fx + force_x
        fy = fy + force_y
        moment = moment + px * force_y - py * force_x + m
        power -= t * along + n * across + m * spin
        xx = xx + d_xx
        xy = xy + d_xy
        yx = yx + d_yx
        yy = yy + d_yy
        by_yaw_x = px * d_xy - py * d_xx + spin_x
        by_yaw_y = px * d_yy - py * d_yx + spin_y
        xz = xz + by_yaw_x
        yz = yz + by_yaw_y
        zx += px * d_yx - py * d_xx + moment_x
        zy += px * d_yy - py * d_xy + moment_y
        zz += px * by_yaw_y - py * by_yaw_x + px * moment_y - py * moment_x + mm
    return (fx, fy, moment), (xx, xy, xz, yy, yz, zz, yx, zx, zy), power


@compiled
def _symmetric_forces(body, mass, forth, aside, yaw, floor):  # type: ignore[no-untyped-def]
    """Evaluate `forces_and_slopes` under a law with a potential."""
    force, (xx, xy, xz, yy, yz, zz), power = floor_forces(
        body, mass, forth, aside, yaw, floor
    )
    return force, (xx, xy, xz, yy, yz, zz, xy, xz, yz), power


def forces_and_slopes(body, mass, forth, aside, yaw, floor) -> Any:  # type: ignore[no-untyped-def]
    """Return the results of `floor_forces`, with the slopes yx, zx, zy of any law after the others."""
    if has_no_potential(floor):
        function = _unsymmetric_forces
    else:
        function = _symmetric_forces
    return function(body, mass, forth, aside, yaw, floor)


@overload_part(forces_and_slopes)
def _compile_forces_and_slopes(body, mass, forth, aside, yaw, floor):  # type: ignore[no-untyped-def]
    """Compile `forces_and_slopes` for the case of a floor's type, without a branch."""
    case = floor.types[floor.fields.index("case")].count
    if case % _COUNT == _COSINE:
        function = _unsymmetric_forces
    else:
        function = _symmetric_forces
    return lambda body, mass, forth, aside, yaw, floor: function(
        body, mass, forth, aside, yaw, floor
    )


@compiled
def fill_forces(body, mass, u, floor, force):  # type: ignore[no-untyped-def]
    """Fill the floor's force on each connector, along, across (N) and moment (N·m), shape (N, 3).

    Args:
        body: posed body, shape (ROWS, N).
        mass: shape (N,), kg.
        u: velocity of the centre of mass in the body frame (m/s) and yaw rate (rad/s),
            shape (3 or more,).
        floor: the floor.
        force: out.
    """
    for i in range(mass.shape[0]):
        c = body[COS, i]
        s = body[SIN, i]
        vx = u[0] - u[2] * body[Y, i] + body[VX, i]
        vy = u[1] + u[2] * body[X, i] + body[VY, i]
        along = vx * c + vy * s
        across = vy * c - vx * s
        spin = u[2] + body[SPIN, i]
        terms = connector_friction(along, across, spin, mass[i] * floor.gravity, floor)
        force[i, 0] = terms[0]
        force[i, 1] = terms[1]
        force[i, 2] = terms[2]


# Ratio of speed to slip speed at which a law has reached its full force within 1e-4,
# also for an ellipse of 1:14, 1.
_SLIDING_RATIO = 1000.0

_MIN_SLIP_SPEED = 1e-7  # on a slope at a time unit of 1, m/s
_COASTING_STEP = 5e-4  # longest time step of `slide`, s
_COASTING_SLIP_SPEED = (
    1e-9  # slip speed of `slide`, m/s; small, because it only avoids 0/0
)


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
        float(velocity[0]),
        float(velocity[1]),
        np.ascontiguousarray(times, dtype=float),
        floor,
        position,
    )
    return position


@compiled
def _fill_positions(along, across, times, floor, position):  # type: ignore[no-untyped-def]
    """Integrate the coasting motion and fill its positions at `times`, shape (times, 2), m."""
    x = 0.0
    y = 0.0
    now = 0.0
    for k in range(times.shape[0]):
        steps = int(np.ceil((times[k] - now) / _COASTING_STEP))
        for _ in range(steps):
            h = (times[k] - now) / steps
            a_t, a_n = _deceleration(along, across, floor)
            a_t, a_n = _deceleration(
                _mean_velocity(along, h * a_t), _mean_velocity(across, h * a_n), floor
            )
            x += _distance(along, a_t, h)
            y += _distance(across, a_n, h)
            along = _stop_at_zero(along, h * a_t)
            across = _stop_at_zero(across, h * a_n)
        now = times[k]
        position[k, 0] = x
        position[k, 1] = y


@kernel_only
def _deceleration(along, across, floor):  # type: ignore[no-untyped-def]
    """Return the accelerations along and across, m/s²."""
    forces = connector_friction(along, across, 0.0, GRAVITY, floor)
    return forces[0], forces[1]


@kernel_only
def _stop_at_zero(speed, change):  # type: ignore[no-untyped-def]
    """Return a velocity after a change, or 0 if the change would reverse it."""
    after = speed + change
    if after * speed > 0.0:
        return after
    return 0.0


@kernel_only
def _mean_velocity(speed, change):  # type: ignore[no-untyped-def]
    """Return the mean velocity during a step, or during the part of it before the body stops."""
    if (speed + change) * speed > 0.0:
        return speed + change / 2
    return speed / 2


@kernel_only
def _distance(speed, acceleration, h):  # type: ignore[no-untyped-def]
    """Return the distance in a step with constant acceleration, or the distance until the body stops."""
    if speed == 0.0:
        return 0.0
    if (speed + h * acceleration) * speed > 0.0:
        return h * (speed + h * acceleration / 2)
    return -speed * speed / (2.0 * acceleration)
