r"""Stick-slip friction of contacts, and friction of wheels with rotational inertia.

The friction laws map the velocity of a contact to the friction force and its
derivatives.

The friction force behaves like that of an elastic-plastic material. Let N be the normal
force, ε the slip speed, and v_t and v_lat the contact velocities along and across the
heading. The friction limits along and across the heading are μ_t N and μ_lat N. The
vector q̂ contains the friction forces of the previous step, divided by their limits. An
elastic trial value y determines the friction force f:

$$ y = \hat q - \frac{1}{\varepsilon \mu}\,(\mu_t v_t, \mu_\mathrm{lat} v_\mathrm{lat}), \qquad
   f = N\,(\mu_t y_t, \mu_\mathrm{lat} y_\mathrm{lat})\,/\,\max(1, |y|), \qquad
   \mu = \min(\mu_t, \mu_\mathrm{lat}) . $$

For |y| ≤ 1, the contact sticks. The friction force then changes in proportion to the
velocity and is constant at rest. For |y| > 1, the contact slides with the friction
force of `robot.friction.ellipse`. If the trial value is y = q̂ − v/ε, the sliding force
is that of `robot.friction.cosine`, which lies on the same friction ellipse.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled

_MIN_LIMIT = 1e-12
"""Lower bound on a friction limit that is used as a divisor, N."""

_MIN_RATIO = 0.01
"""Lower bound on μ/max(μ_t, μ_lat) in the stiffness 1/(ε μ), dimensionless.

The bound keeps the stiffness finite if one of the friction coefficients is zero.
"""

_RIM_TOLERANCE = 1e-12
"""Relative tolerance of the computed rim speed, dimensionless.

Warp computes in single precision and uses a larger tolerance (`warp.translation`).
"""

_MAX_RIM_ITERATIONS = 60


class FloorLaw(NamedTuple):
    """Parameters of the friction of wheels or skin on the floor.

    Attributes:
        friction_law_index: index of the friction law in `numerics.LAWS_ON_LOADS`.
        forward, backward: friction coefficients μ_t for slip towards the head and the
            tail, dimensionless.
        across: friction coefficient μ_lat across the heading, dimensionless.
        slip_speed: slip speed ε, m/s.
        spin_mass: moment of inertia of a wheel about its axle, divided by the square of
            its radius, kg.
    """

    friction_law_index: int
    forward: float
    across: float
    slip_speed: float
    spin_mass: float
    backward: float


class Traction(NamedTuple):
    """Friction force of a contact and its derivatives with respect to velocity.

    Attributes:
        along, across: forces f_t and f_lat along and across the heading, N.
        derivative_along: derivative ∂f_t/∂v_t, N·s/m.
        off_diagonal: derivative ∂f_t/∂v_lat = ∂f_lat/∂v_t, N·s/m.
        derivative_across: derivative ∂f_lat/∂v_lat, N·s/m.
    """

    along: float
    across: float
    derivative_along: float
    off_diagonal: float
    derivative_across: float


@compiled
def stick_slip_friction(v_t, v_lat, load, mu_t, mu_lat, slip, p_t, p_lat):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the `Traction` of a contact that can stick.

    Args:
        v_t, v_lat: contact velocity along and across the heading, m/s.
        load: normal force, N.
        mu_t, mu_lat: friction coefficients along and across the heading, dimensionless.
        slip: slip speed ε, m/s.
        p_t, p_lat: friction force along and across the heading in the previous step, N.
    """
    limit_t = mu_t * load
    limit_lat = mu_lat * load
    greatest = max(mu_t, mu_lat)
    if not greatest * load > 0.0:
        return Traction(0.0, 0.0, 0.0, 0.0, 0.0)
    # In the direction with the smaller coefficient, the contact starts to slide at the
    # slip speed ε. In the perpendicular direction, the contact starts to slide at a
    # lower speed.
    stiffness = 1.0 / (slip * max(min(mu_t, mu_lat), _MIN_RATIO * greatest))
    # The vector q is the previous force divided by the friction limits. If q is outside
    # the friction ellipse because the load has decreased, q is scaled back onto the
    # ellipse.
    q_t = p_t / max(limit_t, _MIN_LIMIT)
    q_lat = p_lat / max(limit_lat, _MIN_LIMIT)
    shrink = 1.0 / max(1.0, np.sqrt(q_t * q_t + q_lat * q_lat))
    # The vector y is the elastic trial force, and the vector a is the trial force
    # limited to the friction ellipse. Both vectors are divided by the friction limits.
    y_t = shrink * q_t - mu_t * stiffness * v_t
    y_lat = shrink * q_lat - mu_lat * stiffness * v_lat
    size = np.sqrt(y_t * y_t + y_lat * y_lat)
    sliding = 1.0 if size > 1.0 else 0.0
    r = 1.0 / max(1.0, size)
    a_t = y_t * r
    a_lat = y_lat * r
    k_t = limit_t * r * stiffness
    k_lat = limit_lat * r * stiffness
    return Traction(
        limit_t * a_t,
        limit_lat * a_lat,
        -k_t * mu_t * (1.0 - sliding * a_t * a_t),
        sliding * k_t * mu_lat * a_t * a_lat,
        -k_lat * mu_lat * (1.0 - sliding * a_lat * a_lat),
    )


@compiled
def skin_friction(v_t, v_lat, load, friction_law, p_t, p_lat, is_cosine):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the stick-slip friction force of a skin and its derivatives.

    Args:
        v_t, v_lat, load, p_t, p_lat: arguments of `stick_slip_friction`.
        friction_law: floor friction, a `FloorLaw`.
        is_cosine: whether the friction law is `cosine` instead of `ellipse`.

    Returns:
        The forces f_t and f_lat (N), and the derivatives ∂f_t/∂v_t, ∂f_t/∂v_lat,
        ∂f_lat/∂v_t and ∂f_lat/∂v_lat (N·s/m).
    """
    mu_forward = friction_law.forward
    mu_backward = friction_law.backward
    mu_lat = friction_law.across
    slip = friction_law.slip_speed
    along = max(mu_forward, mu_backward)  # Warp's max accepts only two numbers
    greatest = max(along, mu_lat)
    if not greatest * load > 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    # Friction opposes the slip. A force towards the tail therefore has the friction
    # coefficient for slip towards the head.
    mu_p = mu_forward if p_t <= 0.0 else mu_backward
    mu_v = mu_forward if v_t >= 0.0 else mu_backward
    q_t = p_t / max(mu_p * load, _MIN_LIMIT)
    q_lat = p_lat / max(mu_lat * load, _MIN_LIMIT)
    shrink = 1.0 / max(1.0, np.sqrt(q_t * q_t + q_lat * q_lat))
    k_t = 1.0 / slip
    k_lat = 1.0 / slip
    if not is_cosine:
        stiffness = 1.0 / (slip * max(min(mu_v, mu_lat), _MIN_RATIO * greatest))
        k_t = mu_v * stiffness
        k_lat = mu_lat * stiffness
    y_t = shrink * q_t - k_t * v_t
    y_lat = shrink * q_lat - k_lat * v_lat
    size = np.sqrt(y_t * y_t + y_lat * y_lat)
    sliding = 1.0 if size > 1.0 else 0.0
    r = 1.0 / max(1.0, size)
    a_t = y_t * r
    a_lat = y_lat * r
    limit_t = (mu_forward if y_t <= 0.0 else mu_backward) * load
    limit_lat = mu_lat * load
    return (
        limit_t * a_t,
        limit_lat * a_lat,
        -limit_t * r * k_t * (1.0 - sliding * a_t * a_t),
        sliding * limit_t * r * k_lat * a_t * a_lat,
        sliding * limit_lat * r * k_t * a_t * a_lat,
        -limit_lat * r * k_lat * (1.0 - sliding * a_lat * a_lat),
    )


@compiled
def rolling_friction(v_t, v_lat, load, friction_law, p_t, p_lat, rim, inertia):  # type: ignore[no-untyped-def]  # noqa: D417
    r"""Return the `Traction` and rim speed (m/s) of a wheel with rotational inertia.

    The contact has a friction coefficient of μ_lat in all directions. At the rim of the
    wheel, the axle friction has a coefficient of μ_t. The contact force f_t and the
    axle friction determine the rim speed w at the time at which friction is evaluated:

    $$ k\,(w - w_0) = -f_t(v_t - w) - \mu_t N \operatorname{sgn} w . $$

    Here w₀ is the rim speed at the beginning of the step. The function sgn is
    set-valued at 0, so a wheel stays locked if the contact force is too small to turn
    it. A sliding wheel without inertia has the friction force of
    `robot.friction.wheel`.

    Args:
        v_t, v_lat, load, p_t, p_lat: arguments of `stick_slip_friction`.
        friction_law: floor friction, a `FloorLaw` with equal coefficients for forward
            and backward slip.
        rim: rim speed w₀ at the beginning of the step, m/s.
        inertia: coefficient k, the moment of inertia of the wheel divided by its
            squared radius and by the time since the beginning of the step, kg/s.
    """
    mu_lat = friction_law.across
    slip = friction_law.slip_speed
    drag = friction_law.forward * load
    grip = stick_slip_friction(v_t, v_lat, load, mu_lat, mu_lat, slip, p_t, p_lat)
    demand = inertia * rim - grip.along
    if abs(demand) <= drag:
        return grip, 0.0
    # At a rim speed of 0, the driving force exceeds the resistance. The excess
    # decreases with the rim speed, so a bracketed Newton iteration converges.
    side = 1.0 if demand > 0.0 else -1.0
    low = float(0.0)
    high = (abs(demand) - drag) / inertia
    w = min(max(side * v_t, low), high)
    for _ in range(_MAX_RIM_ITERATIONS):
        grip = stick_slip_friction(
            v_t - side * w, v_lat, load, mu_lat, mu_lat, slip, p_t, p_lat
        )
        excess = -side * grip.along - drag - inertia * (w - side * rim)
        if excess > 0.0:
            low = w
        else:
            high = w
        step = excess / (inertia - grip.derivative_along)
        if abs(step) <= _RIM_TOLERANCE * (abs(w) + slip):
            break
        w += step
        if not low < w < high:
            w = 0.5 * (low + high)
    # The rim speed depends on the velocity of the contact. By the implicit function
    # theorem, this dependence reduces the derivative along the heading.
    softness = inertia - grip.derivative_along
    fraction = inertia / softness
    mixed = grip.off_diagonal
    return (
        Traction(
            grip.along,
            grip.across,
            grip.derivative_along * fraction,
            mixed * fraction,
            grip.derivative_across + mixed * mixed / softness,
        ),
        side * w,
    )


@compiled
def axis_friction(v_t, v_lat, load, friction_law, p_t, p_lat, rim, inertia):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the `Traction` of a wheel with independent friction along and across.

    The rotational inertia of the wheel acts as additional mass along the heading.

    Args:
        v_t, v_lat, load, friction_law, p_t, p_lat, rim, inertia: arguments of
            `rolling_friction`, except that `p_t` excludes the part that spins the
            wheel.
    """
    mu_t = friction_law.forward
    mu_lat = friction_law.across
    slip = friction_law.slip_speed
    forward = stick_slip_friction(v_t, 0.0, load, mu_t, mu_t, slip, p_t, 0.0)
    lateral = stick_slip_friction(0.0, v_lat, load, mu_lat, mu_lat, slip, 0.0, p_lat)
    return Traction(
        forward.along - inertia * (v_t - rim),
        lateral.across,
        forward.derivative_along - inertia,
        0.0,
        lateral.derivative_across,
    )
