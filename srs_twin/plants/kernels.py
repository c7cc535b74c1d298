r"""Compiled kernel of the analytical models whose bends are given, `complete` and `simplified`.

Point masses m_i sit at the connectors; the bends q(t) are given by the actuators; the pose of the body is
what moves. With ρ_i(q) the connectors about the centre of mass in the frame of the mean heading θ and
φ_i(q) their headings in it,

$$ M \dot v = \sum f_i, \qquad \dot L = \sum \bigl(r_i - r_c\bigr) \times f_i + n_i, \qquad
   L = I(q)\,\dot\theta + h(q, \dot q), $$

with I = Σ m_i |ρ_i|² + J_i, h = Σ m_i ρ_i × ρ̇_i + J_i φ̇_i, J_i = 0 for point masses, and n_i the yaw moment
of connector i's wheels. Using the moment of momentum L as the state needs no q̈, so its jumps at valve events
cost no accuracy. This is Eq. 11 contracted with eᵀ (segment torques cancel).
The friction is stiff, so the three velocities are solved implicitly with the two-stage, second-order,
L-stable SDIRK method of Alexander (1977), Newton's method in each stage. Friction has a convex potential; its
slope along a step tells whether the step was too long. How long steps are says `step_control`.
"""

from __future__ import annotations

import math

from srs_twin.compiled import compiled
from srs_twin.plants.floor import floor_forces
from srs_twin.plants.kinematics import pose_body

GAMMA = 1 - math.sqrt(0.5)
"""Diagonal of the SDIRK2 method: stages at GAMMA·h and h."""

X, Y, HEADING, VX, VY, MOMENT, SPENT = range(7)
"""Indices into the state: centre of mass (m), mean heading (rad), its velocity (m/s), L (kg·m²/s), and the
energy that the floor has taken (J)."""

STATES = 7
SPEED_LIMIT = 100.0
"""m/s: beyond it a state is not plausible."""

_NEWTON_STEPS = 100
_NEWTON_TOLERANCE = 1e-8
_OVERSHOT = 0.1  # rise after a Newton step, over the fall before it, from which it was too long


@compiled
def _solve3(a, b, c, p, q, r):  # type: ignore[no-untyped-def]
    """Solve the system with the rows a, b, c and the right side p, q, r by Cramer's rule."""
    c0 = b[1] * c[2] - b[2] * c[1]
    c1 = b[2] * c[0] - b[0] * c[2]
    c2 = b[0] * c[1] - b[1] * c[0]
    scale = 1 / (a[0] * c0 + a[1] * c1 + a[2] * c2)
    return (
        scale * (p * c0 + q * (a[2] * c[1] - a[1] * c[2]) + r * (a[1] * b[2] - a[2] * b[1])),
        scale * (p * c1 + q * (a[0] * c[2] - a[2] * c[0]) + r * (a[2] * b[0] - a[0] * b[2])),
        scale * (p * c2 + q * (a[1] * c[0] - a[0] * c[1]) + r * (a[0] * b[1] - a[1] * b[0])),
    )


@compiled
def _turned(c, s, angle):  # type: ignore[no-untyped-def]
    """Return cosine and sine of an angle that grows by a little, by their series: sines are dear."""
    if abs(angle) > 0.1:  # rad: there the next terms are 1e-17
        dc, ds = math.cos(angle), math.sin(angle)
    else:
        p = angle * angle
        dc = 1 - p / 2 * (1 - p / 12 * (1 - p / 30 * (1 - p / 56)))
        ds = angle * (1 - p / 6 * (1 - p / 20 * (1 - p / 42 * (1 - p / 72))))
    return c * dc - s * ds, s * dc + c * ds


@compiled
def _stage(known, a, q, rate, turn, model, u, k, body):  # type: ignore[no-untyped-def]  # noqa: D417
    """Solve one implicit stage Y = known + a f(Y) from the guess `u`; fill k = f(Y).

    Args:
        known: shape (STATES,).
        a: s.
        q, rate: bends (rad) and their rates (rad/s) at the stage, shape (segments,).
        turn: cosine and sine of a heading, and how far `known` has turned from it, rad.
        model: solid, floor and whether the friction's moment acts.
        u: in place, shape (3,).
        k: out, shape (STATES,).
        body: work array, shape (ROWS, N).

    Returns:
        Whether it was solved.
    """
    solid, floor, turning = model
    weight, acts = solid.mass.sum(), 1.0 if turning else 0.0
    inertia, moment = pose_body(q, rate, solid, body)
    known_x, known_y, known_moment = known[VX], known[VY], known[MOMENT]
    x, y, z = u[0], u[1], u[2]
    step_x = step_y = step_z = 0.0
    share = 0.0  # of the last step that has been made
    fall = 0.0  # of the potential along that step, at its start
    converged = False
    power = 0.0
    c, s = _turned(turn[0], turn[1], turn[2] + a * z)
    for _ in range(_NEWTON_STEPS):
        bx, by = known_x * c + known_y * s, known_y * c - known_x * s
        force, slope, power = floor_forces(body, solid.mass, x, y, z, floor)
        power += (1 - acts) * force[2] * z
        miss_x, miss_y = weight * (x - bx) - a * force[0], weight * (y - by) - a * force[1]
        miss_z = inertia * z + moment - known_moment - a * acts * force[2]
        falls = miss_x * step_x + miss_y * step_y + miss_z * step_z
        if falls < -_OVERSHOT * fall:
            # Past the lowest point along the step, across a kink of the friction law: some way back.
            back = share * min(max(fall / (fall - falls), 0.1), 0.7)
            x, y, z = x + (share - back) * step_x, y + (share - back) * step_y, z + (share - back) * step_z
            c, s = _turned(c, s, a * (share - back) * step_z)
            share = back
            continue
        xx, xy, xz, yy, yz, zz = slope
        step_x, step_y, step_z = _solve3(
            (weight - a * xx, -a * xy, -a * (xz + weight * by)),
            (-a * xy, weight - a * yy, -a * (yz - weight * bx)),
            (-a * acts * xz, -a * acts * yz, inertia - a * acts * zz),
            miss_x, miss_y, miss_z,
        )  # fmt: skip
        share, fall = 1.0, miss_x * step_x + miss_y * step_y + miss_z * step_z
        x, y, z = x - step_x, y - step_y, z - step_z
        c, s = _turned(c, s, -a * step_z)
        if abs(step_x) + abs(step_y) + 0.1 * abs(step_z) < _NEWTON_TOLERANCE:
            converged = True
            break
    u[0], u[1], u[2] = x, y, z
    # What the stage's equation says of f(Y) costs no further evaluation.
    k[X], k[Y], k[HEADING] = x * c - y * s, x * s + y * c, z
    k[VX], k[VY] = (k[X] - known_x) / a, (k[Y] - known_y) / a
    k[MOMENT] = (inertia * z + moment - known_moment) / a
    k[SPENT] = power
    return converged


@compiled
def step(state, h, bends, rates, model, u, drift, k1, k2, after, body):  # type: ignore[no-untyped-def]  # noqa: D417
    """Make one step of SDIRK2.

    Args:
        state: at its start, shape (STATES,).
        h: its length, s.
        bends: at its two stages, shape (2, segments), rad.
        rates: their rates, rad/s.
        model: solid, floor and whether the friction's moment about the centre of mass acts.
        u: in place, velocity in the body frame and yaw rate, shape (3,).
        drift: in place, how fast u changes, the guess from which Newton's method starts, shape (3,).
        k1, k2: out, rates of the state at the stages, shape (STATES,).
        after: out, state at the end, shape (STATES,).
        body: work array, shape (ROWS, N).

    Returns:
        Whether both stages were solved.
    """
    a, wait = GAMMA * h, (1 - GAMMA) * h
    known, begun = after, state[HEADING]
    c, s = math.cos(begun), math.sin(begun)
    # Velocities drawn on in a straight line from stage to stage save every second of Newton's steps.
    x, y, z = u[0], u[1], u[2]
    for j in range(3):
        u[j] += drift[j] * a
    first = _stage(state, a, bends[0], rates[0], (c, s, 0.0), model, u, k1, body)
    for j in range(STATES):
        known[j] = state[j] + wait * k1[j]
    drift[0], drift[1], drift[2] = (u[0] - x) / a, (u[1] - y) / a, (u[2] - z) / a
    x, y, z = u[0], u[1], u[2]
    for j in range(3):
        u[j] += drift[j] * wait
    second = _stage(known, a, bends[1], rates[1], (c, s, wait * k1[HEADING]), model, u, k2, body)
    for j in range(STATES):
        after[j] = known[j] + a * k2[j]
    drift[0], drift[1], drift[2] = (u[0] - x) / wait, (u[1] - y) / wait, (u[2] - z) / wait
    return first and second
