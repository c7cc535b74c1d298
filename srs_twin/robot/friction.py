r"""Friction laws of a connector on the floor, with forces and their derivatives.

Each law takes the velocity of a contact along (t) and across (n) its heading, the wheel
load N and the two friction coefficients. It returns ``(f_t, f_n, df_t/dv_t, df_t/dv_n,
df_n/dv_t, df_n/dv_n)``; the implicit integrator needs the derivatives. sgn v is
regularised to v/√(v² + ε²) with a slip speed ε. The functions are elementwise, for
arrays of any shape, and the kernels compile them.

- `axis`: independent Coulomb friction along and across the heading, the law of the
  dissertation for one contact point: f = −N (μ_t sgn v_t, μ_n sgn v_n).
- `wheel`: rolling wheel on a floor with the friction coefficient μ_n. The axial force
  is limited by the drag of the axle, μ_t, and by the friction cone of sliding: f_t = −N
  min(μ_t, μ_n |v_t|/|v|) sgn v_t. The remainder of the cone acts across.
- `ellipse`: sliding skid with maximum dissipation. Of all forces in the ellipse
  (f_t/μ_t)² + (f_n/μ_n)² ≤ N², it is the one with the largest dissipated power: f = −N
  (μ_t² v_t, μ_n² v_n)/√(μ_t² v_t² + μ_n² v_n²). Both directions share one root, and
  thus one slip speed; with μ² ε² under the root, it is ε for the direction of the
  larger coefficient μ.
- `cosine`: sliding skin after Hu and Shelley (2012): each component of the force is
  proportional to the direction cosine of the slip, f = −N (μ_t v_t, μ_n v_n)/√(v_t² +
  v_n²). It has no potential, so that df_t/dv_n ≠ df_n/dv_t. The force lies on the same
  ellipse as that of `ellipse`, in another direction.
- `viscous`: linear drag f = −N (μ_t v_t, μ_n v_n)/v₁ with v₁ = 1 m/s, a law for tests.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

Law = Literal["axis", "wheel", "viscous", "ellipse", "cosine"]
LAWS: tuple[Law, ...] = get_args(Law)
"""Names of the laws, which are the functions below; kernels and files use this list."""

TWO_POINT_LAWS = ("wheel", "ellipse", "cosine")
"""Laws with two contact points per connector, at ± half the track; the other laws have one at the centre."""

SkinLaw = Literal["ellipse", "cosine"]
SKIN_LAWS: tuple[SkinLaw, ...] = get_args(SkinLaw)
"""Laws of a skin, which slides in every direction; its μ_t differs between forward and backward slip."""

_MIN_COEFFICIENT = 1e-12
"""Lower bound in the root of `ellipse`, which avoids 0/0 for a contact without friction."""


def axis(v_t, v_n, load, mu_t, mu_n, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force (N) and its derivatives (N·s/m) under the `axis` law.

    Args:
        v_t, v_n: contact velocity along and across the heading, m/s.
        load: wheel load, N.
        mu_t, mu_n: friction coefficients along and across the heading.
        slip: slip speed ε, m/s.
    """
    # Reciprocal roots need one division each; the derivatives reuse them.
    r_t = 1 / np.sqrt(v_t * v_t + slip * slip)
    r_n = 1 / np.sqrt(v_n * v_n + slip * slip)
    k_t = load * mu_t * r_t
    k_n = load * mu_n * r_n
    zero = 0.0 * v_t
    return (
        -k_t * v_t,
        -k_n * v_n,
        -k_t * (slip * r_t) ** 2,
        zero,
        zero,
        -k_n * (slip * r_n) ** 2,
    )


def wheel(v_t, v_n, load, mu_t, mu_n, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force (N) and its derivatives (N·s/m) under the `wheel` law.

    Arguments as in `axis`.
    """
    r = 1 / np.sqrt(v_t * v_t + v_n * v_n + slip * slip)
    r_n = 1 / np.sqrt(v_n * v_n + slip * slip)
    a_t = v_t * r
    a_n = v_n * r
    slide_t = mu_n * a_t  # axial friction coefficient of a locked wheel
    rest = np.sqrt(np.maximum(mu_n * mu_n - mu_t * mu_t, 0.0))
    # A rolling wheel has the full axle drag along and the remainder of the cone across;
    # a skidding wheel has the isotropic cone. Arithmetic instead of np.where compiles
    # for scalars as well.
    roll = 1.0 * (np.abs(slide_t) > mu_t)
    skid = 1.0 - roll
    iso = skid * load * mu_n * r
    mixed = iso * a_t * a_n
    return (
        -load * (roll * mu_t * np.sign(v_t) + skid * slide_t),
        -load * (roll * rest * v_n * r_n + skid * mu_n * a_n),
        -iso * (1 - a_t * a_t),
        mixed,
        mixed,
        -roll * load * rest * r_n * (slip * r_n) ** 2 - iso * (1 - a_n * a_n),
    )


def viscous(v_t, v_n, load, mu_t, mu_n, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force (N) and its derivatives (N·s/m) under the `viscous` law; `slip` is not used."""
    zero = 0.0 * v_t
    k_t = load * mu_t
    k_n = load * mu_n
    return -k_t * v_t, -k_n * v_n, zero - k_t, zero, zero, zero - k_n


def ellipse(v_t, v_n, load, mu_t, mu_n, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force (N) and its derivatives (N·s/m) under the `ellipse` law.

    Arguments as in `axis`.
    """
    w_t = mu_t * mu_t
    w_n = mu_n * mu_n
    smooth = slip * np.maximum(np.maximum(mu_t, mu_n), _MIN_COEFFICIENT)
    r = 1 / np.sqrt(w_t * v_t * v_t + w_n * v_n * v_n + smooth * smooth)
    a_t = v_t * r
    a_n = v_n * r
    mixed = load * r * w_t * w_n * a_t * a_n
    return (
        -load * w_t * a_t,
        -load * w_n * a_n,
        -load * r * w_t * (1 - w_t * a_t * a_t),
        mixed,
        mixed,
        -load * r * w_n * (1 - w_n * a_n * a_n),
    )


def cosine(v_t, v_n, load, mu_t, mu_n, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force (N) and its derivatives (N·s/m) under the `cosine` law.

    Arguments as in `axis`.
    """
    r = 1 / np.sqrt(v_t * v_t + v_n * v_n + slip * slip)
    a_t = v_t * r
    a_n = v_n * r
    k_t = load * mu_t * r
    k_n = load * mu_n * r
    return (
        -k_t * v_t,
        -k_n * v_n,
        -k_t * (1 - a_t * a_t),
        k_t * a_t * a_n,
        k_n * a_t * a_n,
        -k_n * (1 - a_n * a_n),
    )
