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

_NEAR = 0.1  # rad: below it series, whose next terms are below 1e-16


def chords(bend, length, gap):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return L (m), dL/dq (m/rad) and d²L/dq² (m/rad²), smooth through q = 0.

    Args:
        bend: q, rad, any shape; a number when compiled.
        length: l, m.
        gap: L_o, m.
    """
    # Blended by arithmetic, not np.where, so that the compiled scalar form is the same code.
    near = 1.0 * (np.abs(bend) < _NEAR)
    far = 1.0 - near
    q = bend + near
    sine, cosine = np.sin(bend / 2), np.cos(bend / 2)
    p = bend * bend
    arc = far * 2 * sine / q + near * (1 - p / 24 * (1 - p / 80 * (1 - p / 168)))
    slope = far * (cosine - arc) / q - near * bend / 12 * (1 - p / 40 * (1 - p / 112 * (1 - p / 216)))
    curvature = -far * (arc / 4 + 2 * slope / q) - near / 12 * (
        1 - 3 * p / 40 * (1 - 5 * p / 336 * (1 - 7 * p / 1080))
    )
    return (
        length * arc + gap * cosine,
        length * slope - gap / 2 * sine,
        length * curvature - gap / 4 * cosine,
    )


def chord(bend: np.ndarray, length: float, gap: float) -> np.ndarray:
    """Return the distance between the connectors of a bent segment, m. Arguments as in `chords`."""
    distance: np.ndarray = chords(bend, length, gap)[0]
    return distance


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
