"""Floor friction laws of a connector: forces and force derivatives.

The arguments of a friction law are the contact velocity along (t) and across (n) the
heading, the wheel load N and two friction coefficients. Each law returns ``(f_t, f_n,
df_t/dv_t, df_t/dv_n, df_n/dv_t, df_n/dv_n)``, because the implicit integrator needs the
derivatives. The sign function sgn v is regularised to v/√(v² + ε²) with a slip speed ε.
All functions are elementwise, accept arrays of any shape and compile in numba kernels.

- `axis`: independent Coulomb friction along and across the heading, f = −N (μ_t sgn
  v_t, μ_n sgn v_n). The dissertation uses this law with one contact point.
- `wheel`: rolling wheel on a floor with friction coefficient μ_n. The axial force
  f_t = −N min(μ_t, μ_n |v_t|/|v|) sgn v_t is limited by the axle drag μ_t and by the
  friction cone. The rest of the friction cone acts across the heading.
- `ellipse`: sliding skid with maximum dissipation. The force lies in the ellipse
  (f_t/μ_t)² + (f_n/μ_n)² ≤ N² and maximises the dissipated power: f = −N
  (μ_t² v_t, μ_n² v_n)/√(μ_t² v_t² + μ_n² v_n²). To regularise the force, μ² ε² with the
  larger of the two coefficients is added under the root.
- `cosine`: sliding skin after Hu and Shelley (2012). Each component of the force is
  proportional to the direction cosine of the slip, f = −N (μ_t v_t, μ_n v_n)/√(v_t² +
  v_n²). The force has no potential, because df_t/dv_n ≠ df_n/dv_t. The force lies on the
  ellipse of the law `ellipse`, but has a different direction.
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
"""Laws with two contact points per connector, at ± half the track. The other laws have
one contact point at the centre."""

SkinLaw = Literal["ellipse", "cosine"]
SKIN_LAWS: tuple[SkinLaw, ...] = get_args(SkinLaw)
"""Friction laws of a skin, for which μ_t differs between forward and backward slip."""

_MIN_COEFFICIENT = 1e-12
"""Lower bound on μ under the root of `ellipse`, which avoids 0/0 without friction."""


def axis(v_t, v_lat, load, mu_t, mu_lat, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force (N) and derivatives (N·s/m) of the `axis` law.

    Args:
        v_t, v_lat: contact velocity along and across the heading, m/s.
        load: wheel load, N.
        mu_t, mu_lat: friction coefficients along and across the heading.
        slip: slip speed ε, m/s.
    """
    r_t = 1 / np.sqrt(v_t * v_t + slip * slip)
    r_lat = 1 / np.sqrt(v_lat * v_lat + slip * slip)
    # The drag coefficients k_t and k_lat are the forces divided by the velocities, N·s/m.
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
    """Return force (N) and derivatives (N·s/m) of the `wheel` law."""
    # a_t and a_lat are the direction cosines of the slip. The speed in their
    # denominator is regularised and equals 1/r.
    r = 1 / np.sqrt(v_t * v_t + v_lat * v_lat + slip * slip)
    r_lat = 1 / np.sqrt(v_lat * v_lat + slip * slip)
    a_t = v_t * r
    a_lat = v_lat * r
    slide_t = mu_lat * a_t  # Axial friction coefficient of a locked wheel.
    # A rolling wheel uses the part μ_t of the friction cone along the heading, so that
    # √(μ_n² − μ_t²) remains across the heading.
    rest = np.sqrt(np.maximum(mu_lat * mu_lat - mu_t * mu_t, 0.0))
    # A rolling wheel has the full axle drag along the heading, whereas a skidding wheel
    # has an isotropic friction cone. Unlike np.where, arithmetic also compiles for
    # scalars.
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
    """Return force (N) and derivatives (N·s/m) of the `viscous` law."""
    zero = 0.0 * v_t
    k_t = load * mu_t
    k_lat = load * mu_lat
    return -k_t * v_t, -k_lat * v_lat, zero - k_t, zero, zero, zero - k_lat


def ellipse(v_t, v_lat, load, mu_t, mu_lat, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force (N) and derivatives (N·s/m) of the `ellipse` law."""
    # The weights μ² and the common root 1/r define the direction of the force.
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
    """Return force (N) and derivatives (N·s/m) of the `cosine` law."""
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
