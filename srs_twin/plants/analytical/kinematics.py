"""Compiled kinematics of the planar analytical models.

Positions and velocities of the connectors are relative to the centre of mass, in the
frame of the mean heading.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, inlined, kernel_only
from srs_twin.robot import geometry

# Rows of a body array, shape (ROWS, N), whose columns contain the pose and velocity of
# each connector.
COS = 0  # Cosine of the connector's heading relative to the mean heading.
SIN = 1
SPIN = 2  # Rate of the connector's heading relative to the mean heading, rad/s.
X = 3  # Position, m.
Y = 4
VX = 5  # Velocity, m/s.
VY = 6
ROWS = 7

# Columns of the load array of the model `compliant`. A row contains the momentum of a
# connector relative to the centre of mass, force and moment on the connector, and a
# Newton matrix. The matrix is the mass minus γ h times the derivative of the force with
# respect to the velocity. In the names of the matrix entries, M denotes the yaw rate.
MOMENTUM_X = 0
MOMENTUM_Y = 1
MOMENTUM_YAW = 2
FORCE_X = 3
FORCE_Y = 4
FORCE_YAW = 5
MASS_XX = 6
MASS_XY = 7
MASS_XM = 8
MASS_YY = 9
MASS_YM = 10
MASS_MM = 11
MASS_YX = 12
MASS_MX = 13
MASS_MY = 14
LOAD_COLUMNS = 15

_half_turn = compiled(geometry.half_angle_terms)
_spans = compiled(geometry.chord_from_half_angle)


class BodyParameters(NamedTuple):
    """Constants of a body for the kernels.

    Attributes:
        mass: masses of the connectors, shape (N,), kg.
        inertia: moments of inertia of the connectors about their centres, 0 for point
            masses, shape (N,), kg·m².
        length: length l of each segment's arc, shape (segments,), m.
        gap: rigid gap L_o, m.
        frozen: 1 if all chords have the length l + L_o (model `simplified`), or 0 if a
            bend shortens the chord.
        weight: total mass M, kg.
        pitch: mean distance between the connectors of the straight body, m.
    """

    mass: np.ndarray
    inertia: np.ndarray
    length: np.ndarray
    gap: float
    frozen: float
    weight: float
    pitch: float

    @classmethod
    def of(
        cls,
        mass: np.ndarray,
        inertia: np.ndarray,
        length: float | np.ndarray,
        gap: float,
        frozen: float = 0.0,
    ) -> BodyParameters:
        """Return the constants. A scalar `length` applies to all segments."""
        lengths = np.full(len(mass) - 1, length)
        return cls(
            mass,
            inertia,
            lengths,
            gap,
            frozen,
            float(mass.sum()),
            float(lengths.mean()) + gap,
        )


class Chord(NamedTuple):
    """Chord between the ends of a segment with bend q.

    Attributes:
        cos_half, sin_half: cosine and sine of q/2, which is the angle between the chord
            and the heading at either end.
        span: length L of the chord, m.
        derivative, curvature: derivatives dL/dq (m/rad) and d²L/dq² (m/rad²).
    """

    cos_half: float
    sin_half: float
    span: float
    derivative: float
    curvature: float


@kernel_only
def chord_terms(q, solid, j):  # type: ignore[no-untyped-def]
    """Return the `Chord` of segment j, counted from 0 at the head, for bend q (rad)."""
    half_turn = _half_turn(q)
    length = solid.length[j]
    span, derivative, curvature = _spans(half_turn, length, solid.gap)
    varying = 1.0 - solid.frozen
    return Chord(
        half_turn[0],
        half_turn[1],
        varying * span + solid.frozen * (length + solid.gap),
        varying * derivative,
        varying * curvature,
    )


@inlined
def _fill_chords(q, rate, solid, out):  # type: ignore[no-untyped-def]
    # The loop is in a separate function so that the compiler can vectorise it. The
    # function returns the heading of the head relative to the mean heading (rad), and
    # the rate of this heading (rad/s).
    cosine = out[COS]
    sine = out[SIN]
    span = out[X]
    span_rate = out[VX]
    n = solid.mass.shape[0]
    lead = lead_rate = 0.0
    for j in range(n - 1):
        chord = chord_terms(q[j], solid, j)
        cosine[j + 1] = chord.cos_half
        sine[j + 1] = chord.sin_half
        span[j + 1] = chord.span
        span_rate[j + 1] = chord.derivative * rate[j]
        fraction = (n - 1 - j) / n
        lead += fraction * q[j]
        lead_rate += fraction * rate[j]
    return lead, lead_rate


class _Centre(NamedTuple):
    x: float
    y: float
    vx: float
    vy: float


@compiled
def pose_body(q, rate, solid, out):  # type: ignore[no-untyped-def]
    """Compute the poses and velocities of the connectors from the bends.

    Args:
        q: bends, shape (segments,), rad.
        rate: bend rates, shape (segments,), rad/s.
        solid: constants of the body.
        out: output for poses and velocities, shape (ROWS, N).

    Returns:
        Moment of inertia I (kg·m²), and angular momentum h due to the bend rates
        (kg·m²/s), as in `kernels`.
    """
    mass = solid.mass
    lead, lead_rate = _fill_chords(q, rate, solid, out)
    # The loop from head to tail computes positions in the frame of the head.
    c = 1.0
    s = 0.0
    spin = 0.0
    x = y = vx = vy = 0.0
    total = cx = cy = cvx = cvy = 0.0
    for i in range(mass.shape[0]):
        if i > 0:
            # The heading of the chord differs by half the bend from the heading at
            # either end of the segment.
            half_c = out[COS, i]
            half_s = out[SIN, i]
            span = out[X, i]
            span_rate = out[VX, i]
            chord_spin = spin - rate[i - 1] / 2
            c, s = c * half_c + s * half_s, s * half_c - c * half_s
            x = x - span * c
            y = y - span * s
            vx = vx - span_rate * c + span * chord_spin * s
            vy = vy - span_rate * s - span * chord_spin * c
            c, s = c * half_c + s * half_s, s * half_c - c * half_s
            spin -= rate[i - 1]
        out[COS, i] = c
        out[SIN, i] = s
        out[SPIN, i] = spin
        out[X, i] = x
        out[Y, i] = y
        out[VX, i] = vx
        out[VY, i] = vy
        m = mass[i]
        total = total + m
        cx = cx + m * x
        cy = cy + m * y
        cvx = cvx + m * vx
        cvy = cvy + m * vy
    centre = _Centre(cx / total, cy / total, cvx / total, cvy / total)
    return _transform_to_mean(out, solid, centre, lead, lead_rate)


@kernel_only
def _transform_to_mean(out, solid, centre, lead, lead_rate):  # type: ignore[no-untyped-def]
    # Moves the origin to the centre of mass and rotates the axes to the mean heading.
    # `lead` is the heading of the head relative to the mean heading (rad).
    mass = solid.mass
    connector_inertia = solid.inertia
    cosine = out[COS]
    sine = out[SIN]
    spinning = out[SPIN]
    place_x = out[X]
    place_y = out[Y]
    rate_x = out[VX]
    rate_y = out[VY]
    # In a long coil, `lead` may exceed a full turn, so a series expansion for small
    # angles is not applicable.
    a = math.cos(lead)
    b = math.sin(lead)
    inertia = moment = 0.0
    for i in range(mass.shape[0]):
        c = cosine[i]
        s = sine[i]
        spin = spinning[i] + lead_rate
        x = place_x[i] - centre.x
        y = place_y[i] - centre.y
        vx = rate_x[i] - centre.vx - lead_rate * y
        vy = rate_y[i] - centre.vy + lead_rate * x
        cosine[i] = a * c - b * s
        sine[i] = b * c + a * s
        spinning[i] = spin
        place_x[i] = a * x - b * y
        place_y[i] = b * x + a * y
        rate_x[i] = a * vx - b * vy
        rate_y[i] = b * vx + a * vy
        inertia += mass[i] * (x * x + y * y) + connector_inertia[i]
        moment += mass[i] * (x * vy - y * vx) + connector_inertia[i] * spin
    return inertia, moment
