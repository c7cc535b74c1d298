"""Compiled kinematics of the analytical models: pose of a bent body, and how it depends on the velocities.

Both are in the frame of the mean heading, about the centre of mass; `complete`, `simplified` and
`compliant` share them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled
from srs_twin.robot import geometry

COS, SIN, SPIN, X, Y, VX, VY = range(7)
"""Rows of a posed body, which has one column a connector: heading (its cosine and sine) and its rate, place
(m), velocity (m/s)."""

ROWS = 7

_half_turn = compiled(geometry.half_angle_terms)
_spans = compiled(geometry.chord_from_half_angle)


class Solid(NamedTuple):
    """What the kernels know of a body.

    Attributes:
        mass: of the connectors, shape (N,), kg.
        inertia: moments of inertia of the connectors about themselves, shape (N,), kg·m²; 0: point masses.
        length: l, m.
        gap: L_o, m.
        frozen: 1 keeps every chord at l + L_o (the `simplified` model), 0 lets it shorten as it bends.
    """

    mass: np.ndarray
    inertia: np.ndarray
    length: float
    gap: float
    frozen: float


@compiled
def chord_terms(q, solid):  # type: ignore[no-untyped-def]
    """Return cos q/2 and sin q/2, L, dL/dq and d²L/dq² of a segment with bend q."""
    turn = _half_turn(q)
    span, slope, curvature = _spans(turn, solid.length, solid.gap)
    yields = 1.0 - solid.frozen
    return (
        turn[0],
        turn[1],
        yields * span + solid.frozen * (solid.length + solid.gap),
        yields * slope,
        yields * curvature,
    )


@compiled
def pose_body(q, rate, solid, out):  # type: ignore[no-untyped-def]
    """Fill `out`; return the moment of inertia I (kg·m²) and h (kg·m²/s), see `kernels`.

    Args:
        q: bends, shape (segments,), rad.
        rate: their rates, rad/s.
        solid: the body.
        out: the posed body, shape (ROWS, N).
    """
    mass = solid.mass
    n = mass.shape[0]
    cosine, sine, place, stretching = out[COS], out[SIN], out[X], out[VX]
    lead = lead_rate = 0.0  # of the head over the mean heading
    for j in range(n - 1):
        # What depends on one segment alone, kept in the body's own memory: several segments at a time.
        half_c, half_s, span, slope, _ = chord_terms(q[j], solid)
        cosine[j + 1], sine[j + 1], place[j + 1], stretching[j + 1] = half_c, half_s, span, slope * rate[j]
        share = (n - 1 - j) / n
        lead += share * q[j]
        lead_rate += share * rate[j]
    # From the head to the tail, in the frame of the head.
    c, s, spin = 1.0, 0.0, 0.0
    x = y = vx = vy = 0.0
    total = cx = cy = cvx = cvy = 0.0
    for i in range(n):
        if i > 0:
            # A chord lies half a bend from either end's heading.
            half_c, half_s, span, stretch = cosine[i], sine[i], place[i], stretching[i]
            turn = spin - rate[i - 1] / 2
            c, s = c * half_c + s * half_s, s * half_c - c * half_s
            x, y = x - span * c, y - span * s
            vx, vy = vx - stretch * c + span * turn * s, vy - stretch * s - span * turn * c
            c, s = c * half_c + s * half_s, s * half_c - c * half_s
            spin -= rate[i - 1]
        out[COS, i], out[SIN, i], out[SPIN, i] = c, s, spin
        out[X, i], out[Y, i], out[VX, i], out[VY, i] = x, y, vx, vy
        m = mass[i]
        total, cx, cy, cvx, cvy = total + m, cx + m * x, cy + m * y, cvx + m * vx, cvy + m * vy
    cx, cy, cvx, cvy = cx / total, cy / total, cvx / total, cvy / total
    return _turn_to_mean(out, solid, (cx, cy, cvx, cvy), lead, lead_rate)


@compiled
def _turn_to_mean(out, solid, centre, lead, lead_rate):  # type: ignore[no-untyped-def]
    """Refer a body posed in the frame of its head to the centre of mass and the mean heading.

    Args:
        out: the body, in place, shape (ROWS, N).
        solid: the body.
        centre: centre of mass (m) and its velocity (m/s) in the frame of the head.
        lead: heading of the head over the mean heading, rad.
        lead_rate: its rate, rad/s.

    Returns:
        I and h, see `pose_body`.
    """
    mass, own = solid.mass, solid.inertia
    cosine, sine, spinning = out[COS], out[SIN], out[SPIN]
    place_x, place_y, rate_x, rate_y = out[X], out[Y], out[VX], out[VY]
    cx, cy, cvx, cvy = centre
    a, b = math.cos(lead), math.sin(lead)  # of a long coil several turns: no series
    inertia = moment = 0.0
    for i in range(mass.shape[0]):
        c, s, spin = cosine[i], sine[i], spinning[i] + lead_rate
        x, y = place_x[i] - cx, place_y[i] - cy
        vx, vy = rate_x[i] - cvx - lead_rate * y, rate_y[i] - cvy + lead_rate * x
        cosine[i], sine[i], spinning[i] = a * c - b * s, b * c + a * s, spin
        place_x[i], place_y[i] = a * x - b * y, b * x + a * y
        rate_x[i], rate_y[i] = a * vx - b * vy, b * vx + a * vy
        inertia += mass[i] * (x * x + y * y) + own[i]
        moment += mass[i] * (x * vy - y * vx) + own[i] * spin
    return inertia, moment
