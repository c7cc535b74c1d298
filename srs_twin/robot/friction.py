"""Friction laws for the contact between a connector and the floor.

Each law takes the contact velocity along (t) and across (n) the heading, the wheel load
N, the friction coefficients μ_t and μ_n, and a slip speed ε. It returns ``(f_t, f_n,
df_t/dv_t, df_t/dv_n, df_n/dv_t, df_n/dv_n)``, because the implicit integrator needs the
force derivatives. With the slip speed ε, the laws replace sgn v by v/√(v² + ε²), and
|v| in a denominator by √(|v|² + ε²). All functions are elementwise, accept arrays of
any shape and compile in numba kernels.

- `axis`: independent Coulomb friction along and across the heading, f = −N (μ_t sgn
  v_t, μ_n sgn v_n). The dissertation uses this law with one contact point per
  connector.
- `wheel`: rolling wheel on a floor with a friction coefficient μ_n. The axial force f_t
  = −N min(μ_t, μ_n |v_t|/|v|) sgn v_t, with the exact sign of v_t, is limited by the
  axle drag μ_t and by the friction cone. The lateral force is limited by the rest of
  the friction cone.
- `ellipse`: sliding skid with maximum dissipation. The force lies in the ellipse
  (f_t/μ_t)² + (f_n/μ_n)² ≤ N² and maximises the dissipated power, so that f = −N (μ_t²
  v_t, μ_n² v_n)/√(μ_t² v_t² + μ_n² v_n²). For regularisation, the term max(μ_t, μ_n)²
  ε² is added under the root.
- `cosine`: sliding skin according to Hu and Shelley (2012). Each force component is
  proportional to the direction cosine of the slip velocity, f = −N (μ_t v_t, μ_n
  v_n)/√(v_t² + v_n²). The force has no potential, because df_t/dv_n ≠ df_n/dv_t. It
  lies on the same ellipse as the force of the law `ellipse`, but has a different
  direction.
- `viscous`: linear drag f = −N (μ_t v_t, μ_n v_n)/v₁ with v₁ = 1 m/s, intended for
  tests.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

FrictionLaw = Literal["axis", "wheel", "viscous", "ellipse", "cosine"]
FRICTION_LAWS: tuple[FrictionLaw, ...] = get_args(FrictionLaw)
"""Names of the friction laws and of the functions that implement them."""

TWO_POINT_LAWS = ("wheel", "ellipse", "cosine")
"""Friction laws with two contact points per connector, half the track width to the left
and right of the centre line. The other laws use one contact point on the centre line.
"""

SkinLaw = Literal["ellipse", "cosine"]
SKIN_LAWS: tuple[SkinLaw, ...] = get_args(SkinLaw)
"""Friction laws for skins, whose μ_t may differ between forward and backward slip."""

_MIN_COEFFICIENT = 1e-12
"""Lower bound on μ under the root of `ellipse`, which avoids 0/0 on a frictionless
floor."""


def axis(v_t, v_lat, load, mu_t, mu_lat, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the force (N) and its derivatives (N·s/m) under the `axis` law.

    Args:
        v_t, v_lat: contact velocity along and across the heading, m/s.
        load: wheel load, N.
        mu_t, mu_lat: friction coefficients along and across the heading.
        slip: slip speed ε, m/s.
    """
    r_t = 1 / np.sqrt(v_t * v_t + slip * slip)
    r_lat = 1 / np.sqrt(v_lat * v_lat + slip * slip)
    # The coefficients k_t and k_lat are ratios of force to velocity, N·s/m.
    k_t = load * mu_t * r_t
    k_lat = load * mu_lat * r_lat
    zero = 0.0 * v_t
    return (
        -k_t * v_t,
        -k_lat * v_lat,
        -k_t * (slip * r_t) ** 2,
        zero,
        zero,
        -k_lat * (slip * r_lat) ** 2,
    )


def wheel(v_t, v_lat, load, mu_t, mu_lat, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the force (N) and its derivatives (N·s/m) under the `wheel` law."""
    # a_t and a_lat are the direction cosines of the slip velocity. The regularised slip
    # speed is 1/r.
    r = 1 / np.sqrt(v_t * v_t + v_lat * v_lat + slip * slip)
    r_lat = 1 / np.sqrt(v_lat * v_lat + slip * slip)
    a_t = v_t * r
    a_lat = v_lat * r
    slide_t = mu_lat * a_t  # Axial friction coefficient of a locked wheel.
    # The axle drag of a rolling wheel uses the part μ_t of the friction cone, which
    # leaves √(μ_n² − μ_t²) across the heading.
    rest = np.sqrt(np.maximum(mu_lat * mu_lat - mu_t * mu_t, 0.0))
    # A skidding wheel has isotropic friction. Unlike np.where, the arithmetic selection
    # with `roll` and `skid` also compiles for scalars.
    roll = 1.0 * (np.abs(slide_t) > mu_t)
    skid = 1.0 - roll
    iso = skid * load * mu_lat * r
    mixed = iso * a_t * a_lat
    return (
        -load * (roll * mu_t * np.sign(v_t) + skid * slide_t),
        -load * (roll * rest * v_lat * r_lat + skid * mu_lat * a_lat),
        -iso * (1 - a_t * a_t),
        mixed,
        mixed,
        -roll * load * rest * r_lat * (slip * r_lat) ** 2 - iso * (1 - a_lat * a_lat),
    )


def viscous(v_t, v_lat, load, mu_t, mu_lat, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the force (N) and its derivatives (N·s/m) under the `viscous` law."""
    zero = 0.0 * v_t
    k_t = load * mu_t
    k_lat = load * mu_lat
    return -k_t * v_t, -k_lat * v_lat, zero - k_t, zero, zero, zero - k_lat


def ellipse(v_t, v_lat, load, mu_t, mu_lat, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the force (N) and its derivatives (N·s/m) under the `ellipse` law."""
    w_t = mu_t * mu_t
    w_lat = mu_lat * mu_lat
    smooth = slip * np.maximum(np.maximum(mu_t, mu_lat), _MIN_COEFFICIENT)
    r = 1 / np.sqrt(w_t * v_t * v_t + w_lat * v_lat * v_lat + smooth * smooth)
    a_t = v_t * r
    a_lat = v_lat * r
    mixed = load * r * w_t * w_lat * a_t * a_lat
    return (
        -load * w_t * a_t,
        -load * w_lat * a_lat,
        -load * r * w_t * (1 - w_t * a_t * a_t),
        mixed,
        mixed,
        -load * r * w_lat * (1 - w_lat * a_lat * a_lat),
    )


def cosine(v_t, v_lat, load, mu_t, mu_lat, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the force (N) and its derivatives (N·s/m) under the `cosine` law."""
    r = 1 / np.sqrt(v_t * v_t + v_lat * v_lat + slip * slip)
    a_t = v_t * r
    a_lat = v_lat * r
    k_t = load * mu_t * r
    k_lat = load * mu_lat * r
    return (
        -k_t * v_t,
        -k_lat * v_lat,
        -k_t * (1 - a_t * a_t),
        k_t * a_t * a_lat,
        k_lat * a_t * a_lat,
        -k_lat * (1 - a_lat * a_lat),
    )
