r"""Constant-curvature geometry of a segment and of the whole body.

A segment of length l and bend q is a circular arc, whose chord is parallel to the mean
of the two end headings. The rigid gap L_o adds a straight piece of length L_o/2 at each
end and does not change the direction of the chord. The distance between the connectors
at both ends of a segment is

$$ L(q) = l\,\frac{\sin(q/2)}{q/2} + L_o \cos(q/2). $$

Connectors are numbered from the head. A positive bend q_j = θ_j − θ_{j+1} turns the
head end to the left. Eqs. 2 and 3 define the bend, with the corrections E9 and E20, and
Eq. 7 defines the chord. All functions accept arrays with any leading axes. The
functions `pair_heading`, `measured_bend` and `arc_between` implement Algorithms 1 and 2
of Section 3.4.1, which compute curvature and shape from marker positions.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from srs_twin.compute.arrays import Array

Number = TypeVar("Number", float, Array)


def half_angle_terms(bend: Number) -> tuple[Number, ...]:
    r"""Return cos x, sin x, A = sin x/x, dA/dq and d²A/dq² for x = q/2.

    The terms are computed from the even functions a = (1 − A)/x² and b = (1 − cos
    x)/x², which are smooth at x = 0 and satisfy

    $$ a(2x) = \tfrac14\,(a + A b), \qquad b(2x) = \tfrac12\,A^2, \qquad
       \tfrac{dA}{dx} = x\,(a - b), \qquad \tfrac{d^2A}{dx^2} = -A - 2\,(a - b). $$

    The power series of a and b are evaluated at x/4, and the argument is then doubled
    twice, which is faster than computing sine, cosine and quotients. The results are
    exact up to rounding for |q| ≤ 2π, and to 1e-11 for |q| ≤ 4π.

    Args:
        bend: bend q as an array of any shape, or as a scalar in compiled code, rad.
    """
    x = bend / 2
    # For |x/4| ≤ π/4, the truncated series in p = (x/4)² are exact up to rounding.
    p = x * x / 16
    a = (
        1
        - p
        / 20
        * (1 - p / 42 * (1 - p / 72 * (1 - p / 110 * (1 - p / 156 * (1 - p / 210)))))
    ) / 6
    b = (
        1
        - p
        / 12
        * (1 - p / 30 * (1 - p / 56 * (1 - p / 90 * (1 - p / 132 * (1 - p / 182)))))
    ) / 2
    # `arc` is A, first at x/4, then at x/2 and finally at x.
    arc = 1 - p * a
    a = (a + arc * b) / 4
    b = arc * arc / 2
    arc = 1 - 4 * p * a
    a = (a + arc * b) / 4
    b = arc * arc / 2
    p = x * x
    arc = 1 - p * a
    return 1 - p * b, x * arc, arc, x * (a - b) / 2, (b - a) / 2 - arc / 4


def chord_from_half_angle(
    terms: tuple[Number, ...], length: float, gap: float
) -> tuple[Number, Number, Number]:
    """Return L (m), dL/dq (m/rad) and d²L/dq² (m/rad²) from half-angle terms.

    Args:
        terms: result of `half_angle_terms`.
        length: segment length l, m.
        gap: rigid gap L_o, m.
    """
    cosine, sine, arc, derivative, curvature = terms
    return (
        length * arc + gap * cosine,
        length * derivative - gap / 2 * sine,
        length * curvature - gap / 4 * cosine,
    )


def chord_derivatives(
    bend: Number, length: float, gap: float
) -> tuple[Number, Number, Number]:
    """Return L (m), dL/dq (m/rad) and d²L/dq² (m/rad²) for a bend.

    Args:
        bend: bend q, rad.
        length: segment length l, m.
        gap: rigid gap L_o, m.
    """
    return chord_from_half_angle(half_angle_terms(bend), length, gap)


def chord(bend: Array, length: float, gap: float) -> Array:
    """Return the distance between the connectors at both ends of a segment, m."""
    return chord_derivatives(bend, length, gap)[0]


def relative_headings(bend: Array) -> Array:
    """Return the connector headings relative to the mean heading.

    Args:
        bend: bends q, shape (…, N − 1), rad.

    Returns:
        Relative headings, shape (…, N), rad.
    """
    from_head = np.concatenate(
        [np.zeros_like(bend[..., :1]), -np.cumsum(bend, axis=-1)], axis=-1
    )
    from_head -= from_head.mean(axis=-1, keepdims=True)
    return from_head


def body_shape(bend: Array, mass: Array, length: float, gap: float) -> Array:
    """Return connector positions relative to the centre of mass, for zero mean heading.

    Args:
        bend: bends q, shape (…, N − 1), rad.
        mass: connector masses, shape (N,), kg.
        length: segment length l, m.
        gap: rigid gap L_o, m.

    Returns:
        Positions, shape (…, N, 2), m.
    """
    headings = relative_headings(bend)
    direction = (headings[..., 1:] + headings[..., :-1]) / 2
    links = chord(bend, length, gap)[..., None] * np.stack(
        [np.cos(direction), np.sin(direction)], -1
    )
    position = np.concatenate(
        [np.zeros_like(links[..., :1, :]), -np.cumsum(links, axis=-2)], axis=-2
    )
    centre = np.einsum("i,...ij->...j", mass / mass.sum(), position)
    position -= centre[..., None, :]
    return position


def pair_heading(rear: Array, front: Array) -> Array:
    """Return the direction from a rear to a front marker, rad.

    The function implements Algorithm 1 with atan2 (E10).

    Args:
        rear: position of the rear marker, shape (…, 2), m.
        front: position of the front marker, shape (…, 2), m.
    """
    difference = front - rear
    return np.asarray(np.arctan2(difference[..., 1], difference[..., 0]))


def measured_bend(front: Array, rear: Array) -> Array:
    """Return the bends q = θ_A − θ_B, wrapped to [−π, π), rad (Algorithm 1, E9).

    Args:
        front: heading θ_A of the front end of the segment, rad.
        rear: heading θ_B of the rear end of the segment, rad.
    """
    return np.asarray((front - rear + np.pi) % (2 * np.pi) - np.pi)


def arc_between(front: Array, rear: Array, curvature: Array, points: int = 21) -> Array:
    r"""Return points on the arc of a segment (Algorithm 2 with E10 and E23).

    For a distance d between the ends and a direction α from the rear to the front end,
    the points on the arc with 0 ≤ s ≤ 1 are

    $$ \sin\beta = \kappa d / 2, \qquad
       P(s) = P_A - d\,s\,\frac{\operatorname{sinc} \beta s}{\operatorname{sinc}
       \beta}\, (\cos\gamma, \sin\gamma), \qquad \gamma = \alpha + \beta\,(1 - s). $$

    These equations need neither the centre of the arc nor a special case for κ = 0. If
    noise makes |κ d / 2| greater than 1, no such arc exists, and the function returns a
    half circle with β = ±π/2.

    Args:
        front: front end P_A, shape (…, 2), m.
        rear: rear end P_B, shape (…, 2), m.
        curvature: curvature κ, shape (…), 1/m, positive if the head end turns to the
            left.
        points: number of points, including both ends.

    Returns:
        Points from front to rear, shape (…, points, 2), m.
    """
    chord_vector = front - rear
    distance = np.hypot(chord_vector[..., 0], chord_vector[..., 1])
    half = np.arcsin(np.clip(curvature * distance / 2, -1.0, 1.0))[..., None]
    s = np.linspace(0.0, 1.0, points)
    angle = pair_heading(rear, front)[..., None] + half * (1 - s)
    along = distance[..., None] * s * np.sinc(half * s / np.pi) / np.sinc(half / np.pi)
    arc: Array = front[..., None, :] - along[..., None] * np.stack(
        [np.cos(angle), np.sin(angle)], axis=-1
    )
    return arc
