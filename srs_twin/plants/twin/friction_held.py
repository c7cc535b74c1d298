"""Friction of a contact that can stick, and of a wheel with inertia on it: numbers in, force and slopes out.

Written, as `plants.friction_solve`, in what numba and Warp both compile.
"""

from __future__ import annotations

import numpy as np

from srs_twin.compute.compiled import compiled

_LEAST_MU = 1e-12
_LEAST_SHARE = 0.01  # of a coefficient in the other: a contact without friction along it must not divide by 0
_CLOSE = 1e-12  # of the rim's speed


@compiled
def held(v_t, v_n, load, mu_t, mu_n, slip, p_t, p_n):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force and slopes of a contact that goes on from the force it had, as numbers.

    Where it can stick it yields by μ load/ε times the velocity, from that force on: what stands on a slope
    stays there. Else it slides with the force of `friction.ellipse`, or of the cone where μ_t = μ_n.

    Args:
        v_t, v_n, load, mu_t, mu_n, slip: as in `friction.axis`, numbers.
        p_t, p_n: the force that it had, N.

    Returns:
        f_t, f_n, df_t/dv_t, df_t/dv_n = df_n/dv_t, df_n/dv_n.
    """
    most_t, most_n, greatest = mu_t * load, mu_n * load, max(mu_t, mu_n)
    if not greatest * load > 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    # Yielding over a slip of ε in the direction of the smaller coefficient, over less in the other.
    over = 1.0 / (slip * max(min(mu_t, mu_n), _LEAST_SHARE * greatest))
    # In units of what it can exert, along and across.
    q_t, q_n = p_t / max(most_t, _LEAST_MU), p_n / max(most_n, _LEAST_MU)
    shrink = 1.0 / max(1.0, np.sqrt(q_t * q_t + q_n * q_n))
    y_t, y_n = shrink * q_t - mu_t * over * v_t, shrink * q_n - mu_n * over * v_n
    size = np.sqrt(y_t * y_t + y_n * y_n)
    sliding = 1.0 if size > 1.0 else 0.0
    r = 1.0 / max(1.0, size)
    a_t, a_n = y_t * r, y_n * r
    k_t, k_n = most_t * r * over, most_n * r * over
    return (
        most_t * a_t,
        most_n * a_n,
        -k_t * mu_t * (1.0 - sliding * a_t * a_t),
        sliding * k_t * mu_n * a_t * a_n,
        -k_n * mu_n * (1.0 - sliding * a_n * a_n),
    )


@compiled
def rolling(v_t, v_n, load, mu_t, mu_n, slip, p_t, p_n, rim, lag):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force (N), slopes (N·s/m) and rim speed (m/s) of a wheel whose spin has inertia.

    The contact has μ_n in any direction, the axle drags with μ_t. With the rim's speed w,

        lag (w − rim) = −f_t(v_t − w) − μ_t N sgn w,

    and sgn is set-valued: a wheel that its contact cannot turn stays locked. Sliding and without inertia this
    is `friction.wheel`.

    Args:
        v_t, v_n, load, mu_t, mu_n, slip, p_t, p_n: as in `held`.
        rim: speed of the rim at the step's beginning, m/s.
        lag: mass that the spin adds, moment of inertia over radius², over the step, kg/s.

    Returns:
        f_t, f_n, df_t/dv_t, df_t/dv_n = df_n/dv_t, df_n/dv_n, w.
    """
    drag, w = mu_t * load, float(0.0)
    f_t, f_n, tt, tn, nn = held(v_t, v_n, load, mu_n, mu_n, slip, p_t, p_n)
    demand = lag * rim - f_t
    if abs(demand) <= drag:
        return f_t, f_n, tt, tn, nn, w
    # The excess falls with w, from what is above the drag at 0.
    side = 1.0 if demand > 0.0 else -1.0
    low, high = float(0.0), (abs(demand) - drag) / lag
    w = min(max(side * v_t, low), high)
    for _ in range(60):
        f_t, f_n, tt, tn, nn = held(v_t - side * w, v_n, load, mu_n, mu_n, slip, p_t, p_n)
        excess = -side * f_t - drag - lag * (w - side * rim)
        if excess > 0.0:
            low = w
        else:
            high = w
        step = excess / (lag - tt)
        if abs(step) <= _CLOSE * (abs(w) + slip):
            break
        w += step
        if not low < w < high:
            w = 0.5 * (low + high)
    share = lag / (lag - tt)
    return f_t, f_n, tt * share, tn * share, nn + tn * tn / (lag - tt), side * w
