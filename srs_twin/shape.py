r"""Constant-curvature geometry of a segment and of the whole body.

A segment of length l bent by q is an arc whose chord lies along the mean heading of its two ends. With a
rigid gap L_o, half of it straight at each end, the distance between its connectors stays along that
direction and is

$$ L(q) = l\,\frac{\sin(q/2)}{q/2} + L_o \cos(q/2). $$

Signs: connectors head first, q_j = θ_j − θ_{j+1} > 0 bends the head end to the left (Eq. 2 and 3 with
the signs of E9, E20; Eq. 7 for the chord). The functions are elementwise, so they serve arrays with any
leading axes and, compiled, the kernels.
"""

from __future__ import annotations

import numpy as np


def chord(bend: np.ndarray, length: float, gap: float) -> np.ndarray:
    """Return the distance between the connectors of a bent segment, m.

    Args:
        bend: q, rad, any shape.
        length: l, m.
        gap: L_o, m.
    """
    return length * np.sinc(bend / (2 * np.pi)) + gap * np.cos(bend / 2)


def chord_slope(bend: np.ndarray, length: float, gap: float) -> np.ndarray:
    """Return dL/dq, m/rad; smooth through q = 0. Arguments as in `chord`."""
    # Blended by arithmetic, not np.where, so that the compiled scalar form is the same code.
    near = 1.0 * (np.abs(bend) < 1e-2)
    q = bend + near
    far_slope = (np.cos(q / 2) - np.sinc(q / (2 * np.pi))) / q
    # Next term of the series: q^7/11612160, below 1e-21 at |q| = 1e-2.
    near_slope = -bend / 12 * (1 - bend**2 / 40 * (1 - bend**2 / 112))
    return length * (near * near_slope + (1 - near) * far_slope) - gap / 2 * np.sin(bend / 2)


def chord_curvature(bend: np.ndarray, length: float, gap: float) -> np.ndarray:
    """Return d²L/dq², m/rad²; smooth through q = 0. Arguments as in `chord`."""
    near = 1.0 * (np.abs(bend) < 0.1)
    q = bend + near
    arc = np.sinc(q / (2 * np.pi))
    far_curvature = -arc / 4 - 2 * (np.cos(q / 2) - arc) / q**2
    # Next term of the series: -q^8/454164480, below 1e-16 at |q| = 0.1.
    near_curvature = -1 / 12 + bend**2 / 160 - bend**4 / 10752 + bend**6 / 1658880
    return length * (near * near_curvature + (1 - near) * far_curvature) - gap / 4 * np.cos(bend / 2)


def relative_headings(bend: np.ndarray) -> np.ndarray:
    """Return the connector headings about their mean, shape (…, N), rad, from bends (…, N − 1)."""
    behind = np.concatenate([np.zeros_like(bend[..., :1]), -np.cumsum(bend, axis=-1)], axis=-1)
    return behind - behind.mean(axis=-1, keepdims=True)


def body_shape(bend: np.ndarray, mass: np.ndarray, length: float, gap: float) -> np.ndarray:
    """Return connector positions about the centre of mass at zero mean heading, shape (…, N, 2), m.

    Args:
        bend: q, shape (…, N − 1), rad.
        mass: connector masses, shape (N,), kg.
        length: l, m.
        gap: L_o, m.
    """
    headings = relative_headings(bend)
    direction = (headings[..., 1:] + headings[..., :-1]) / 2
    links = chord(bend, length, gap)[..., None] * np.stack([np.cos(direction), np.sin(direction)], -1)
    position = np.concatenate([np.zeros_like(links[..., :1, :]), -np.cumsum(links, axis=-2)], axis=-2)
    centre = np.einsum("i,...ij->...j", mass / mass.sum(), position)
    return position - centre[..., None, :]
