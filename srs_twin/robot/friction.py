r"""Friction of a wheeled connector on the floor: one law a function, force and slopes together.

Each law takes the contact's velocity along (t) and across (n) its heading, its normal load and the two
coefficients, and returns ``(f_t, f_n, df_t/dv_t, df_t/dv_n, df_n/dv_t, df_n/dv_n)``; the slopes serve the
implicit integrator. sgn v is regularised to v/√(v² + ε²) with a slip speed ε. Elementwise, so arrays of
any shape will do, and compiled by the kernels.

- `axis`: drag along and Coulomb friction across, independent of each other (the text's law, one point):
  f = −N (μ_t sgn v_t, μ_n sgn v_n).
- `wheel`: a contact of friction coefficient μ_n that rolls: its axial force is what the axle's drag μ_t
  lets through and never more than the sliding cone gives,
  f_t = −N min(μ_t, μ_n |v_t|/|v|) sgn v_t; the rest of the cone acts across.
- `ellipse`: maximum dissipation, a skid that slides: of all forces in the ellipse
  (f_t/μ_t)² + (f_n/μ_n)² ≤ N² the one that takes most power out of the slip,
  f = −N (μ_t² v_t, μ_n² v_n)/√(μ_t² v_t² + μ_n² v_n²). One root for both directions, so one slip speed: ε
  for the direction of the greater coefficient μ, by adding μ² ε² under the root.
- `viscous`: linear drag, f = −N (μ_t v_t, μ_n v_n)/v₁ with v₁ = 1 m/s; a law to test with.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

Law = Literal["axis", "wheel", "viscous", "ellipse"]
LAWS: tuple[Law, ...] = get_args(Law)
"""A law is its function below and its name here; kernels and files take it from there."""

AT_TRACK = ("wheel", "ellipse")
"""Laws that act in two points a connector, at ± half the track; the others act in one, on its centre line."""

_LEAST_MU = 1e-12


def axis(v_t, v_n, load, mu_t, mu_n, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force (N) and slopes (N·s/m) of the `axis` law.

    Args:
        v_t, v_n: contact velocity along and across, m/s.
        load: normal load, N.
        mu_t, mu_n: coefficients.
        slip: regularisation speed ε, m/s.
    """
    # Reciprocal roots: one division a root, where the slopes would take another each.
    r_t = 1 / np.sqrt(v_t * v_t + slip * slip)
    r_n = 1 / np.sqrt(v_n * v_n + slip * slip)
    k_t, k_n = load * mu_t * r_t, load * mu_n * r_n
    none = 0.0 * v_t
    return (
        -k_t * v_t,
        -k_n * v_n,
        -k_t * (slip * r_t) ** 2,
        none,
        none,
        -k_n * (slip * r_n) ** 2,
    )


def wheel(v_t, v_n, load, mu_t, mu_n, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force (N) and slopes (N·s/m) of the `wheel` law. Arguments as in `axis`."""
    r = 1 / np.sqrt(v_t * v_t + v_n * v_n + slip * slip)
    r_n = 1 / np.sqrt(v_n * v_n + slip * slip)
    a_t, a_n = v_t * r, v_n * r
    slide_t = mu_n * a_t  # what a locked wheel would feel along
    rest = np.sqrt(np.maximum(mu_n * mu_n - mu_t * mu_t, 0.0))
    # Rolling: the drag saturates along, the rest of the cone acts across; else the isotropic cone.
    # Blended by arithmetic, not np.where, so that the compiled scalar form is the same code.
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
    """Return force (N) and slopes (N·s/m) of the `viscous` law. Arguments as in `axis`; no `slip`."""
    none = 0.0 * v_t
    k_t, k_n = load * mu_t, load * mu_n
    return -k_t * v_t, -k_n * v_n, none - k_t, none, none, none - k_n


def ellipse(v_t, v_n, load, mu_t, mu_n, slip):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return force (N) and slopes (N·s/m) of the `ellipse` law. Arguments as in `axis`."""
    w_t, w_n = mu_t * mu_t, mu_n * mu_n
    # Without a least coefficient a frictionless contact would divide 0 by 0.
    smooth = slip * np.maximum(np.maximum(mu_t, mu_n), _LEAST_MU)
    r = 1 / np.sqrt(w_t * v_t * v_t + w_n * v_n * v_n + smooth * smooth)
    a_t, a_n = v_t * r, v_n * r
    both = load * r * w_t * w_n * a_t * a_n
    return (
        -load * w_t * a_t,
        -load * w_n * a_n,
        -load * r * w_t * (1 - w_t * a_t * a_t),
        both,
        both,
        -load * r * w_n * (1 - w_n * a_n * a_n),
    )
