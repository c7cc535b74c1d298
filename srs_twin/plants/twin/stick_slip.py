r"""Friction of a contact that can stick, and of a wheel whose spin has inertia.

Both laws map the velocity of a contact to its friction force and the slopes of that
force. They are written in the subset of Python that numba and Warp compile: numbers in,
numbers out.

The contact is elastic-plastic in its force. With the force p̂ of the previous step,
scaled by the friction limits μ_t N and μ_n N along and across the heading,

$$ y = \hat q - \frac{1}{\varepsilon \mu}\,(\mu_t v_t, \mu_n v_n), \qquad
   f = N\,(\mu_t y_t, \mu_n y_n)\,/\,\max(1, |y|), \qquad \mu = \min(\mu_t, \mu_n) . $$

For |y| ≤ 1 the contact sticks: the force changes in proportion to the velocity and
keeps its value at rest. For |y| > 1 it slides with the force of
`robot.friction.ellipse`. With y = q̂ − v/ε it slides with that of
`robot.friction.cosine`: its forces lie on the same ellipse.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled

_MIN_LIMIT = 1e-12
"""Smallest friction limit as a divisor of a force, N; smaller limits cannot carry a force."""

_MIN_RATIO = 0.01
"""Smallest ratio of the two coefficients in the stiffness 1/(ε μ), 1.

It keeps the stiffness of a contact without friction along its heading finite.
"""

_RIM_TOLERANCE = 1e-12
"""Relative tolerance of the rim speed, 1; Warp, in single precision, replaces it (`warp.translation`)."""

_MAX_RIM_ITERATIONS = 60


class FloorLaw(NamedTuple):
    """Friction of wheels or skin on the floor.

    Attributes:
        kind: friction law, an index into `numerics.LAWS_ON_LOADS`.
        forward: friction coefficient μ_t for slip towards the head, 1.
        across: friction coefficient μ_n across the heading, 1.
        slip_speed: ε, m/s.
        spin_mass: moment of inertia of a wheel's spin over its squared radius, kg.
        backward: friction coefficient μ_t for slip towards the tail, 1.
    """

    kind: int
    forward: float
    across: float
    slip_speed: float
    spin_mass: float
    backward: float


class Traction(NamedTuple):
    """Friction force of a contact and its slopes.

    Attributes:
        along: f_t, force along the heading, N.
        across: f_n, force across the heading, N.
        slope_along: ∂f_t/∂v_t, N·s/m.
        slope_mixed: ∂f_t/∂v_n = ∂f_n/∂v_t, N·s/m.
        slope_across: ∂f_n/∂v_n, N·s/m.
    """

    along: float
    across: float
    slope_along: float
    slope_mixed: float
    slope_across: float


@compiled
def stick_slip_friction(v_t, v_n, load, mu_t, mu_n, slip, p_t, p_n):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the `Traction` of a contact that can stick (module docstring).

    Args:
        v_t, v_n: velocity along and across the heading, m/s.
        load: normal force N, N.
        mu_t, mu_n: friction coefficients along and across the heading, 1.
        slip: slip speed ε, m/s.
        p_t, p_n: friction force of the previous step, N.
    """
    limit_t = mu_t * load
    limit_n = mu_n * load
    greatest = max(mu_t, mu_n)
    if not greatest * load > 0.0:
        return Traction(0.0, 0.0, 0.0, 0.0, 0.0)
    # The contact yields over a slip of ε in the direction of the smaller coefficient,
    # over less in the other.
    stiffness = 1.0 / (slip * max(min(mu_t, mu_n), _MIN_RATIO * greatest))
    # Previous force in units of the friction limits. A smaller load shrinks it onto the
    # friction ellipse.
    q_t = p_t / max(limit_t, _MIN_LIMIT)
    q_n = p_n / max(limit_n, _MIN_LIMIT)
    shrink = 1.0 / max(1.0, np.sqrt(q_t * q_t + q_n * q_n))
    y_t = shrink * q_t - mu_t * stiffness * v_t
    y_n = shrink * q_n - mu_n * stiffness * v_n
    size = np.sqrt(y_t * y_t + y_n * y_n)
    sliding = 1.0 if size > 1.0 else 0.0
    r = 1.0 / max(1.0, size)
    a_t = y_t * r
    a_n = y_n * r
    k_t = limit_t * r * stiffness
    k_n = limit_n * r * stiffness
    return Traction(
        limit_t * a_t,
        limit_n * a_n,
        -k_t * mu_t * (1.0 - sliding * a_t * a_t),
        sliding * k_t * mu_n * a_t * a_n,
        -k_n * mu_n * (1.0 - sliding * a_n * a_n),
    )


@compiled
def skin_friction(v_t, v_n, load, law, p_t, p_n, is_cosine):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return friction force and slopes of a skin that can stick (module docstring).

    Args:
        v_t, v_n, load, p_t, p_n: as in `stick_slip_friction`.
        law: a `FloorLaw`.
        is_cosine: whether the law is `cosine` instead of `ellipse`.

    Returns:
        f_t, f_n (N), and the slopes ∂f_t/∂v_t, ∂f_t/∂v_n, ∂f_n/∂v_t, ∂f_n/∂v_n (N·s/m).
    """
    mu_ahead = law.forward
    mu_back = law.backward
    mu_n = law.across
    slip = law.slip_speed
    along = max(mu_ahead, mu_back)  # Warp's max takes two numbers
    greatest = max(along, mu_n)
    if not greatest * load > 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    # Friction opposes the slip: the force of slip towards the head points to the tail.
    mu_p = mu_ahead if p_t <= 0.0 else mu_back
    mu_v = mu_ahead if v_t >= 0.0 else mu_back
    q_t = p_t / max(mu_p * load, _MIN_LIMIT)
    q_n = p_n / max(mu_n * load, _MIN_LIMIT)
    shrink = 1.0 / max(1.0, np.sqrt(q_t * q_t + q_n * q_n))
    k_t = 1.0 / slip
    k_n = 1.0 / slip
    if not is_cosine:
        stiffness = 1.0 / (slip * max(min(mu_v, mu_n), _MIN_RATIO * greatest))
        k_t = mu_v * stiffness
        k_n = mu_n * stiffness
    y_t = shrink * q_t - k_t * v_t
    y_n = shrink * q_n - k_n * v_n
    size = np.sqrt(y_t * y_t + y_n * y_n)
    sliding = 1.0 if size > 1.0 else 0.0
    r = 1.0 / max(1.0, size)
    a_t = y_t * r
    a_n = y_n * r
    limit_t = (mu_ahead if y_t <= 0.0 else mu_back) * load
    limit_n = mu_n * load
    return (
        limit_t * a_t,
        limit_n * a_n,
        -limit_t * r * k_t * (1.0 - sliding * a_t * a_t),
        sliding * limit_t * r * k_n * a_t * a_n,
        sliding * limit_n * r * k_t * a_t * a_n,
        -limit_n * r * k_n * (1.0 - sliding * a_n * a_n),
    )


@compiled
def rolling_friction(v_t, v_n, load, law, p_t, p_n, rim, inertia):  # type: ignore[no-untyped-def]  # noqa: D417
    r"""Return the `Traction` of a wheel whose spin has inertia, and its rim speed, m/s.

    The contact has the coefficient μ_n in every direction; the axle brakes with μ_t.
    The rim speed w at the end of the step balances both:

    $$ k\,(w - w_0) = -f_t(v_t - w) - \mu_t N \operatorname{sgn} w . $$

    sgn is set-valued at 0, so a wheel that its contact cannot turn stays locked. A
    sliding wheel without inertia follows `robot.friction.wheel`.

    Args:
        v_t, v_n, load, p_t, p_n: as in `stick_slip_friction`.
        law: a `FloorLaw`; without a difference between forward and backward slip.
        rim: rim speed w₀ at the beginning of the step, m/s.
        inertia: k, moment of inertia of the wheel over its squared radius and the time
            step, kg/s.
    """
    mu_n = law.across
    slip = law.slip_speed
    drag = law.forward * load
    grip = stick_slip_friction(v_t, v_n, load, mu_n, mu_n, slip, p_t, p_n)
    demand = inertia * rim - grip.along
    if abs(demand) <= drag:
        return grip, 0.0
    # The excess of the driving force decreases in w and is positive at 0: a bracketed
    # Newton iteration.
    side = 1.0 if demand > 0.0 else -1.0
    low = float(0.0)
    high = (abs(demand) - drag) / inertia
    w = min(max(side * v_t, low), high)
    for _ in range(_MAX_RIM_ITERATIONS):
        grip = stick_slip_friction(
            v_t - side * w, v_n, load, mu_n, mu_n, slip, p_t, p_n
        )
        excess = -side * grip.along - drag - inertia * (w - side * rim)
        if excess > 0.0:
            low = w
        else:
            high = w
        step = excess / (inertia - grip.slope_along)
        if abs(step) <= _RIM_TOLERANCE * (abs(w) + slip):
            break
        w += step
        if not low < w < high:
            w = 0.5 * (low + high)
    # The rim follows the wheel's motion, which softens the slope along the heading
    # (implicit function theorem).
    softness = inertia - grip.slope_along
    share = inertia / softness
    mixed = grip.slope_mixed
    return (
        Traction(
            grip.along,
            grip.across,
            grip.slope_along * share,
            mixed * share,
            grip.slope_across + mixed * mixed / softness,
        ),
        side * w,
    )


@compiled
def axis_friction(v_t, v_n, load, law, p_t, p_n, rim, inertia):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the `Traction` of a rolling wheel whose two directions are independent.

    The spin of the wheel adds mass along the heading.

    Args:
        v_t, v_n, load, law, p_t, p_n, rim, inertia: as in `rolling_friction`; p_t
            without the part that spins the wheel.
    """
    mu_t = law.forward
    mu_n = law.across
    slip = law.slip_speed
    ahead = stick_slip_friction(v_t, 0.0, load, mu_t, mu_t, slip, p_t, 0.0)
    aside = stick_slip_friction(0.0, v_n, load, mu_n, mu_n, slip, 0.0, p_n)
    return Traction(
        ahead.along - inertia * (v_t - rim),
        aside.across,
        ahead.slope_along - inertia,
        0.0,
        aside.slope_across,
    )
