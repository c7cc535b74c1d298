r"""Compiled functions for the friction forces on connectors and their derivatives.

**Coasting.** The function `slide` simulates a straight body that slides without
rotation. All connectors have the same velocity v, and the mass of the robot cancels
from the equation of motion

$$ \dot v = f(v; \mu_t/(1 + s), \mu_n), \qquad s = \sum_w \frac{I_w}{M R^2}. $$

Here f is the friction law with the coefficients μ_t along and μ_n across the heading,
for a normal load of g per unit mass. Wheel w has radius R and moment of inertia
I_w about its axle, and M is the mass of the robot. The rotation of the wheels adds the
relative inertia s along the heading, which increases the stopping distance by a factor
of 1 + s. No other force acts, so neither component of v changes sign. Each component is
integrated by the midpoint rule until it is 0. The positions depend smoothly on the
initial velocities and the coefficients, as parameter fits require.

**Instantaneous loads.** A connector of weight W has one wheel on either side, at a
distance a from its centre line, and a centre of mass at height h. A lateral force F_n
increases the load on the outer wheel. The connector is assumed not to tip over. The
friction law gives the lateral forces φ_L and φ_R per unit load on the left and right
wheel, so the loads N_L and N_R are

$$ N_{L,R} = \tfrac W2 \mp k F_n, \qquad F_n = N_L φ_L + N_R φ_R
   = \frac W2\,\frac{φ_L + φ_R}{1 - k (φ_R - φ_L)}, \qquad k = \frac h{2a}. $$

Negative loads are replaced by 0. The derivatives are computed at constant loads and are
therefore symmetric. This simplification requires a few more Newton iterations, but does
not change the solution.

**Skin** has different friction coefficients for slip towards the tail and towards the
head. The law `cosine` has no potential, so its derivatives are not symmetric and
require separate kernels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from srs_twin.compute.compiled import (
    Function,
    compiled,
    inlined,
    kernel_only,
    overload_part,
)
from srs_twin.plants.analytical.kinematics import COS, SIN, SPIN, VX, VY, X, Y
from srs_twin.robot import friction
from srs_twin.robot.friction import FRICTION_LAWS
from srs_twin.robot.spec import GRAVITY, RobotSpec


class FloorFriction(NamedTuple):
    """Friction parameters and slope of the floor, for the kernels.

    Attributes:
        case: tuple of None whose length is an index into `_CASES`. Numba compiles a
            kernel separately for each length, and thus for each kind of contact and
            each friction law.
        track: distance from a connector's centre line to each of its two contacts, m,
            or 0 for one contact per connector.
        mu_t, mu_n: friction coefficients along and across the heading, dimensionless.
        slip: slip speed ε, m/s.
        drag: axial drag on each connector, N.
        load_transfer: load k transferred between the wheels per unit lateral force, or
            0 for static loads, dimensionless.
        mu_back: friction coefficient along the heading for slip towards the tail,
            dimensionless.
        gravity: component of gravity normal to the floor, m/s².
        pull_x, pull_y: components of gravity along the floor in the world frame, m/s².
        unit: time unit of the robot (`robot.scale`), which scales the tolerances.
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


class ContactTerms(NamedTuple):
    """Contact force and moment on a connector, with their derivatives.

    In the name of a derivative, the first letter denotes the force or moment, and the
    second letter the velocity. The letters t and n denote the directions along and
    across the heading, and m denotes rotation about the vertical. The derivatives are
    symmetric except under the law `cosine`, which has no potential. The derivative `mt`
    always equals `tm` and is not stored.

    Attributes:
        t, n: forces along and across the heading, N.
        m: moment about the vertical, N·m.
        tt, tn, nt, nn: derivatives of the forces with respect to the velocities, N·s/m.
        tm, nm, mn: derivatives of the forces with respect to the spin, and of the
            moment with respect to the lateral velocity, N·s.
        mm: derivative of the moment with respect to the spin, N·m·s.
    """

    t: float
    n: float
    m: float
    tt: float
    tn: float
    tm: float
    nt: float
    nn: float
    nm: float
    mn: float
    mm: float


@compiled
def _one_contact(friction_law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    t, n, tt, tn, _, nn = friction_law(
        along, across, weight, floor.mu_t, floor.mu_n, floor.slip
    )
    return ContactTerms(t, n, 0.0, tt, tn, 0.0, tn, nn, 0.0, 0.0, 0.0)


@kernel_only
def _sum_pair(left, right, a, b, arm):  # type: ignore[no-untyped-def]
    # `left` and `right` are results of a friction law, which are multiplied by `a` and
    # `b`.
    a_t, a_n, a_tt, a_tn, a_nt, a_nn = left
    b_t, b_n, b_tt, b_tn, b_nt, b_nn = right
    return ContactTerms(
        t=a * a_t + b * b_t,
        n=a * a_n + b * b_n,
        m=arm * (b * b_t - a * a_t),
        tt=a * a_tt + b * b_tt,
        tn=a * a_tn + b * b_tn,
        tm=arm * (b * b_tt - a * a_tt),
        nt=a * a_nt + b * b_nt,
        nn=a * a_nn + b * b_nn,
        nm=arm * (b * b_nt - a * a_nt),
        mn=arm * (b * b_tn - a * a_tn),
        mm=arm * arm * (a * a_tt + b * b_tt),
    )


@compiled
def _two_contacts(friction_law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    arm = floor.track
    half = weight / 2
    left = friction_law(
        along - spin * arm, across, half, floor.mu_t, floor.mu_n, floor.slip
    )
    right = friction_law(
        along + spin * arm, across, half, floor.mu_t, floor.mu_n, floor.slip
    )
    return _sum_pair(left, right, 1.0, 1.0, arm)


@inlined
def _loaded_pair(friction_law, v_a, v_b, mu_a, mu_b, across, weight, floor):  # type: ignore[no-untyped-def]
    # `v_a` and `v_b` are the velocities of the left and right contact along the
    # heading.
    left = friction_law(v_a, across, 1.0, mu_a, floor.mu_n, floor.slip)
    right = friction_law(v_b, across, 1.0, mu_b, floor.mu_n, floor.slip)
    a_n = left[1]
    b_n = right[1]
    lateral_force = weight / 2 * (a_n + b_n) / (1 - floor.load_transfer * (b_n - a_n))
    # `a` is the load on the left wheel (N).
    a = min(max(weight / 2 - floor.load_transfer * lateral_force, 0.0), weight)
    return _sum_pair(left, right, a, weight - a, floor.track)


@compiled
def _two_loaded_contacts(friction_law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    v_a = along - spin * floor.track
    v_b = along + spin * floor.track
    mu = floor.mu_t
    return _loaded_pair(friction_law, v_a, v_b, mu, mu, across, weight, floor)


@compiled
def _skin(friction_law, along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    v_a = along - spin * floor.track
    v_b = along + spin * floor.track
    mu_a = floor.mu_t if v_a >= 0.0 else floor.mu_back
    mu_b = floor.mu_t if v_b >= 0.0 else floor.mu_back
    return _loaded_pair(friction_law, v_a, v_b, mu_a, mu_b, across, weight, floor)


_FRICTION_LAWS = tuple(compiled(getattr(friction, name)) for name in FRICTION_LAWS)
_CONTACTS = (_one_contact, _two_contacts, _two_loaded_contacts, _skin)
_CASES = tuple(
    (contacts, friction_law)
    for contacts in _CONTACTS
    for friction_law in _FRICTION_LAWS
)
_COSINE = FRICTION_LAWS.index("cosine")


def floor_friction(
    friction_law: str,
    track: float,
    mu_t: float,
    mu_n: float,
    slip: float,
    *,
    load_transfer: float = 0.0,
    mu_back: float | None = None,
) -> FloorFriction:
    """Return the friction of a level floor without drag, for a time unit of 1.

    Args:
        friction_law: friction law, one of `robot.friction.FRICTION_LAWS`.
        track: distance from a connector's centre line to each of its two contacts, m,
            or 0 for one contact per connector.
        mu_t: friction coefficient along the heading, dimensionless.
        mu_n: friction coefficient across the heading, dimensionless.
        slip: slip speed ε, m/s.
        load_transfer: load transferred between the wheels per unit lateral force,
            dimensionless.
        mu_back: friction coefficient along the heading for slip towards the tail, or
            None for wheels.
    """
    if mu_back is not None or friction_law == "cosine":
        contacts = _skin
    elif track != 0.0 and load_transfer != 0.0:
        contacts = _two_loaded_contacts
    elif track != 0.0:
        contacts = _two_contacts
    else:
        contacts = _one_contact
    case = FRICTION_LAWS.index(friction_law) + len(FRICTION_LAWS) * _CONTACTS.index(
        contacts
    )
    return FloorFriction(
        case=(None,) * case,
        track=track,
        mu_t=mu_t,
        mu_n=mu_n,
        slip=slip,
        drag=0.0,
        load_transfer=load_transfer,
        mu_back=mu_t if mu_back is None else mu_back,
        gravity=GRAVITY,
        pull_x=0.0,
        pull_y=0.0,
        unit=1.0,
    )


@kernel_only
def with_reduced_slip_speed(floor, speed):  # type: ignore[no-untyped-def]
    """Reduce the slip speed so that a body at rest does not creep down a slope.

    Under a regularised friction law, any force moves a contact. On a slope, the slip
    speed is therefore limited to a fixed fraction of `speed`, which is the approximate
    speed of the fastest point of the body in m/s.
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
    """Return the `ContactTerms` of a connector.

    Args:
        along: velocity of the connector along its heading, m/s.
        across: velocity of the connector across its heading, m/s.
        spin: yaw rate, rad/s.
        weight: total normal load of the contacts, N.
        floor: friction parameters of the floor.
    """
    contacts, friction_law = _CASES[len(floor.case)]
    return _add_drag(
        contacts(friction_law, along, across, spin, weight, floor), along, floor
    )


@compiled
def _add_drag(terms, along, floor):  # type: ignore[no-untyped-def]
    t = terms.t
    tt = terms.tt
    if floor.drag > 0.0:
        r = 1 / np.sqrt(along * along + floor.slip * floor.slip)
        t -= floor.drag * along * r
        tt -= floor.drag * r * (floor.slip * r) ** 2
    return ContactTerms(
        t,
        terms.n,
        terms.m,
        tt,
        terms.tn,
        terms.tm,
        terms.nt,
        terms.nn,
        terms.nm,
        terms.mn,
        terms.mm,
    )


@overload_part(connector_friction)
def _compile_connector_friction(along, across, spin, weight, floor):  # type: ignore[no-untyped-def]
    contacts, friction_law = _CASES[floor.types[floor.fields.index("case")].count]
    return lambda along, across, spin, weight, floor: _add_drag(
        contacts(friction_law, along, across, spin, weight, floor), along, floor
    )


@kernel_only
def derivatives_of_force(terms, c, s):  # type: ignore[no-untyped-def]
    """Return the force derivatives xx, xy, yx and yy in the body frame, N·s/m.

    `c` and `s` are the cosine and sine of the connector's heading.
    """
    t_x = terms.tt * c - terms.tn * s
    n_x = terms.nt * c - terms.nn * s
    t_y = terms.tt * s + terms.tn * c
    n_y = terms.nt * s + terms.nn * c
    return t_x * c - n_x * s, t_y * c - n_y * s, t_x * s + n_x * c, t_y * s + n_y * c


class Twist(NamedTuple):
    """Planar velocity (m/s, rad/s) or momentum (kg·m/s, kg·m²/s)."""

    x: float
    y: float
    yaw: float


class BodyForces(NamedTuple):
    """Net force and moment exerted by the floor, in the body frame, with derivatives.

    In the name of a derivative, the first letter denotes the force and the second
    letter the velocity. The letter z denotes the moment or the yaw rate.

    Attributes:
        x, y: components of the force, N.
        moment: moment about the centre of mass, N·m.
        power: dissipated power, W.
        xx, xy, yx, yy: derivatives of the force with respect to the velocity, N·s/m.
        xz, yz, zx, zy: derivatives of the force with respect to the yaw rate, and of
            the moment with respect to the velocity, N·s.
        zz: derivative of the moment with respect to the yaw rate, N·m·s.
    """

    x: float
    y: float
    moment: float
    power: float
    xx: float
    xy: float
    xz: float
    yx: float
    yy: float
    yz: float
    zx: float
    zy: float
    zz: float


@compiled
def _symmetric_forces(body, mass, u, floor):  # type: ignore[no-untyped-def]
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
        spin = u.yaw + spins[i]
        vx = u.x - u.yaw * py + rate_x[i]
        vy = u.y + u.yaw * px + rate_y[i]
        along = vx * c + vy * s
        across = vy * c - vx * s
        f = connector_friction(along, across, spin, mass[i] * floor.gravity, floor)
        # The lever arms of the axial and lateral forces are equal to the derivatives of
        # `along` and `across` with respect to the yaw rate.
        t_arm = px * s - py * c
        n_arm = px * c + py * s
        fx += f.t * c - f.n * s
        fy += f.t * s + f.n * c
        moment += f.t * t_arm + f.n * n_arm + f.m
        power -= f.t * along + f.n * across + f.m * spin
        on_x_t = f.tt * c - f.tn * s
        on_x_n = f.tn * c - f.nn * s
        on_y_t = f.tt * s + f.tn * c
        on_y_n = f.tn * s + f.nn * c
        on_z_t = f.tt * t_arm + f.tn * n_arm + f.tm
        on_z_n = f.tn * t_arm + f.nn * n_arm + f.nm
        on_z_m = f.tm * t_arm + f.nm * n_arm + f.mm
        xx += on_x_t * c - on_x_n * s
        xy += on_x_t * s + on_x_n * c
        yy += on_y_t * s + on_y_n * c
        xz += on_z_t * c - on_z_n * s
        yz += on_z_t * s + on_z_n * c
        zz += on_z_t * t_arm + on_z_n * n_arm + on_z_m
    return BodyForces(fx, fy, moment, power, xx, xy, xz, xy, yy, yz, xz, yz, zz)


@compiled
def _unsymmetric_forces(body, mass, u, floor):  # type: ignore[no-untyped-def]
    fx = fy = moment = power = 0.0
    xx = xy = xz = yx = yy = yz = zx = zy = zz = 0.0
    for i in range(mass.shape[0]):
        c = body[COS, i]
        s = body[SIN, i]
        px = body[X, i]
        py = body[Y, i]
        spin = u.yaw + body[SPIN, i]
        vx = u.x - u.yaw * py + body[VX, i]
        vy = u.y + u.yaw * px + body[VY, i]
        along = vx * c + vy * s
        across = vy * c - vx * s
        f = connector_friction(along, across, spin, mass[i] * floor.gravity, floor)
        d_xx, d_xy, d_yx, d_yy = derivatives_of_force(f, c, s)
        spin_x = f.tm * c - f.nm * s
        spin_y = f.tm * s + f.nm * c
        moment_x = f.tm * c - f.mn * s
        moment_y = f.tm * s + f.mn * c
        force_x = f.t * c - f.n * s
        force_y = f.t * s + f.n * c
        fx = fx + force_x
        fy = fy + force_y
        moment = moment + px * force_y - py * force_x + f.m
        power -= f.t * along + f.n * across + f.m * spin
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
        zz += px * by_yaw_y - py * by_yaw_x + px * moment_y - py * moment_x + f.mm
    return BodyForces(fx, fy, moment, power, xx, xy, xz, yx, yy, yz, zx, zy, zz)


def _forces_of_case(case: int) -> Function:
    if case % len(FRICTION_LAWS) == _COSINE:
        return _unsymmetric_forces
    return _symmetric_forces


def forces_and_derivatives(body, mass, u, floor) -> Any:  # type: ignore[no-untyped-def]
    """Return the `BodyForces` exerted on a body with prescribed bends.

    Args:
        body: poses and velocities of the connectors, shape (ROWS, N).
        mass: masses of the connectors, shape (N,), kg.
        u: velocity of the centre of mass in the body frame (m/s), and yaw rate (rad/s).
        floor: friction parameters of the floor.
    """
    return _forces_of_case(len(floor.case))(body, mass, u, floor)


@overload_part(forces_and_derivatives)
def _compile_forces_and_derivatives(body, mass, u, floor):  # type: ignore[no-untyped-def]
    function = _forces_of_case(floor.types[floor.fields.index("case")].count)
    return lambda body, mass, u, floor: function(body, mass, u, floor)  # noqa: PLW0108  # numba compiles the lambda


@compiled
def fill_forces(body, mass, u, floor, force):  # type: ignore[no-untyped-def]
    """Compute the forces and moments that the floor exerts on the connectors.

    Args:
        body: poses and velocities of the connectors, shape (ROWS, N).
        mass: masses of the connectors, shape (N,), kg.
        u: velocity of the centre of mass in the body frame (m/s) and yaw rate (rad/s),
            shape (3 or more,).
        floor: friction parameters of the floor.
        force: output for the forces along and across the heading (N) and the moment
            (N·m) on each connector, shape (N, 3).
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
        force[i, 0] = terms.t
        force[i, 1] = terms.n
        force[i, 2] = terms.m


# Ratio of sliding speed to slip speed at which the friction force is within 1e-4 of its
# limit, even for a friction ellipse with an axis ratio of 1:14.
_SLIDING_RATIO = 1000.0

_MIN_SLIP_SPEED = 1e-7  # Minimum slip speed on a slope at a time unit of 1, m/s.
_COASTING_STEP = 5e-4  # Maximum time step of `slide`, s.
# Slip speed of `slide`, m/s, which only prevents a division by 0.
_COASTING_SLIP_SPEED = 1e-9


def spin_fraction(spec: RobotSpec) -> float:
    """Return the relative inertia s of the wheels, modelled as solid discs."""
    return 2 * spec.geometry.connectors * (spec.mass.wheel / 2) / spec.mass.total


def slide(
    velocity: tuple[float, float],
    times: np.ndarray,
    *,
    friction_law: str,
    mu_t: float,
    mu_n: float,
    fraction: float = 0.0,
) -> np.ndarray:
    """Return the positions of a coasting body relative to the start.

    Args:
        velocity: initial velocities along and across the heading, m/s.
        times: times at which positions are computed, ascending from 0, shape (times,),
            s.
        friction_law: friction law, one of `robot.friction.FRICTION_LAWS`.
        mu_t: friction coefficient along the heading, dimensionless.
        mu_n: friction coefficient across the heading, dimensionless.
        fraction: relative inertia s of the wheels (`spin_fraction`), dimensionless.

    Returns:
        Positions along and across the heading, shape (times, 2), m.
    """
    floor = floor_friction(
        friction_law, 0.0, mu_t / (1 + fraction), mu_n, _COASTING_SLIP_SPEED
    )
    position = np.empty((len(times), 2))
    _fill_positions(
        *map(float, velocity),
        np.ascontiguousarray(times, dtype=float),
        floor,
        position,
    )
    return position


@compiled
def _fill_positions(along, across, times, floor, position):  # type: ignore[no-untyped-def]
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
    terms = connector_friction(along, across, 0.0, GRAVITY, floor)
    return terms.t, terms.n


@kernel_only
def _stop_at_zero(speed, change):  # type: ignore[no-untyped-def]
    after = speed + change
    if after * speed > 0.0:
        return after
    return 0.0


@kernel_only
def _mean_velocity(speed, change):  # type: ignore[no-untyped-def]
    if (speed + change) * speed > 0.0:
        return speed + change / 2
    return speed / 2


@kernel_only
def _distance(speed, acceleration, h):  # type: ignore[no-untyped-def]
    if speed == 0.0:
        return 0.0
    if (speed + h * acceleration) * speed > 0.0:
        return h * (speed + h * acceleration / 2)
    return -speed * speed / (2.0 * acceleration)
