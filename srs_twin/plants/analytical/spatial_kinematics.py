"""Compiled kinematics of the model `quasistatic`, a spatial chain of twisted arcs.

The first six velocities are the velocity and the angular velocity of the head connector
in the world frame. The other velocities are the rates of the bend to the left, the bend
upwards and the twist of each segment, from head to tail.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled, inlined

# Indices into the state, which starts with the position and the rotation matrix (by
# rows) of the head connector. After the bends and twists of the segments, the state
# contains the impulses of the floor on the points, shape (points, 3), and the normal
# loads on the points.
ROTATION = 3
WORK = 12  # Work of the compressed air, J.
FRICTION_LOSS = 13  # Energy dissipated by the floor, J.
INTERNAL_LOSS = 14  # Energy dissipated by bending and twisting, J.
DRAG_LOSS = 15  # Energy dissipated by the drag of vertical and rolling motion, J.
CLOCK = 16  # Time, s.
JUMPS = 17  # Number of jumps between resting poses.
IS_JUMPING = 18  # 1 during a jump, otherwise 0.
BENDS = 19

# Rows of the Jacobians in `Workspace.rows`, which yield the velocity of a contact along
# the body, across the body and upwards, and the rolling velocity.
ROWS = 4
ALONG, ACROSS, UP, ROLL = range(ROWS)


class SkinFriction(NamedTuple):
    """Friction coefficients of a skin, and the slip speed of the friction law.

    Attributes:
        forward, backward: coefficients for slip towards the head and towards the tail,
            dimensionless.
        across: coefficient across the heading, dimensionless.
        slip: slip speed ε, m/s.
    """

    forward: float
    backward: float
    across: float
    slip: float


class QuasistaticState(NamedTuple):
    """State and velocities of a spatial body, in the layout of this module."""

    state: np.ndarray
    velocity: np.ndarray


class QuasistaticBody(NamedTuple):
    """Constants of body and floor, for S segments with P points each.

    Attributes:
        fraction: fraction of the arc that is ahead of each point, shape (P,),
            dimensionless.
        front, rear: straight lengths ahead of each point, in front of the arc and
            behind the arc, shape (P,), m.
        mass: masses of the points, shape (S P,), kg.
        length, gap: length of an arc, and straight length at each end of the arc, m.
        stiffness, damping: stiffness (N·m/rad) and damping (N·m·s/rad) of the two bends
            and the twist, shape (3,).
        radius, depth: radius of the body, and depth by which resting points sink into
            the floor, m.
        drag_time: time constant τ of the drag on vertical motion and rolling, s.
        longest_move: maximum displacement of a point in a substep, m.
        jump_speed: speed of a point above which a jump is counted, m/s.
        free: 1 if the body is on the floor, or 0 if its head is clamped in the air.
    """

    fraction: np.ndarray
    front: np.ndarray
    rear: np.ndarray
    mass: np.ndarray
    length: float
    gap: float
    stiffness: np.ndarray
    damping: np.ndarray
    radius: float
    depth: float
    friction: SkinFriction
    drag_time: float
    longest_move: float
    jump_speed: float
    free: float


class Workspace(NamedTuple):
    """Work arrays of a step for S segments with P points each.

    Attributes:
        position, frame: positions (m) and rotation matrices of the connectors, shapes
            (S + 1, 3) and (S + 1, 3, 3).
        point: positions of the points, shape (S P, 3), m.
        heading: cosine and sine of the horizontal direction of the body at each point,
            shape (S P, 2).
        motion: Jacobian from the velocities of the body to the velocity and angular
            velocity of each point, shape (S P, 6, velocities).
        rows: Jacobian from the velocities of the body to the contact velocities of each
            point, shape (S P, ROWS, velocities).
        load, friction_load: normal force on each point, and normal force in the
            friction law, shape (S P,), N.
        force: friction along and across the body, shape (S P, 2), N.
        linear: derivative of the residual without contacts, shape (velocities,
            velocities).
        at_rest: residual without contacts at zero velocities, shape (velocities,).
        matrix: lower triangle of the Newton matrix, shape (velocities, velocities).
        residual, direction, trial: residual, Newton step and trial velocities, shape
            (velocities,).
        bend, bend_rate: free bends and a twist of 0 (rad), and their rates (rad/s),
            shape (S, 3).
        base: Jacobian from the rates of a segment's bends and twist to the spatial
            velocity of its rear connector, shape (S, 6, 3).
    """

    position: np.ndarray
    frame: np.ndarray
    point: np.ndarray
    heading: np.ndarray
    motion: np.ndarray
    rows: np.ndarray
    load: np.ndarray
    friction_load: np.ndarray
    force: np.ndarray
    linear: np.ndarray
    at_rest: np.ndarray
    matrix: np.ndarray
    residual: np.ndarray
    direction: np.ndarray
    trial: np.ndarray
    bend: np.ndarray
    bend_rate: np.ndarray
    base: np.ndarray


def work_arrays(segments: int, points: int) -> Workspace:
    """Allocate the work arrays for segments with `points` points each."""
    n = segments + 1
    count = segments * points
    velocities = 6 + 3 * segments
    square = (velocities, velocities)
    vector = (velocities,)
    shapes = [
        (n, 3),
        (n, 3, 3),
        (count, 3),
        (count, 2),
        (count, 6, velocities),
        (count, ROWS, velocities),
        (count,),
        (count,),
        (count, 2),
        square,
        vector,
        square,
        vector,
        vector,
        vector,
        (segments, 3),
        (segments, 3),
        (segments, 6, 3),
    ]
    return Workspace(*map(np.zeros, shapes))


@compiled
def rotate(turn, out):  # type: ignore[no-untyped-def]
    """Write the rotation matrix of the rotation vector `turn` (rad) to `out`."""
    x, y, z = turn
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle > 1e-4:
        a = math.sin(angle) / angle
        b = (1.0 - math.cos(angle)) / square
    else:
        a = 1.0 - square / 6.0
        b = 0.5 - square / 24.0
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[0, 1] = b * x * y - a * z
    out[0, 2] = b * x * z + a * y
    out[1, 0] = b * x * y + a * z
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[1, 2] = b * y * z - a * x
    out[2, 0] = b * x * z - a * y
    out[2, 1] = b * y * z + a * x
    out[2, 2] = 1.0 - b * (x * x + y * y)


@compiled
def _spin(turn, axis):  # type: ignore[no-untyped-def]
    # Returns a column of the left Jacobian of the rotation vector `turn`. The column is
    # the angular velocity per unit rate of the component `axis`.
    x, y, z = turn
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle > 1e-3:
        b = (1.0 - math.cos(angle)) / square
        c = (angle - math.sin(angle)) / (square * angle)
    else:
        b = 0.5 - square / 24.0
        c = 1.0 / 6.0 - square / 120.0
    part = (x, y, z)[axis]
    e_x = 1.0 * (axis == 0)
    e_y = 1.0 * (axis == 1)
    e_z = 1.0 * (axis == 2)
    # The column is e + b t × e + c t × (t × e), where e is the unit vector of the
    # component and t is the rotation vector.
    return (
        e_x + b * (y * e_z - z * e_y) + c * (x * part - e_x * square),
        e_y + b * (z * e_x - x * e_z) + c * (y * part - e_y * square),
        e_z + b * (x * e_y - y * e_x) + c * (z * part - e_z * square),
    )


@compiled
def _arc(w, u, lengths, offset, turn, derivatives):  # type: ignore[no-untyped-def]
    # Computes the pose of a point on a segment in the frame of the front connector.
    # `w` is the rotation vector of the front connector relative to the rear connector.
    # `u` is the fraction of the arc that is ahead of the point. `lengths` contains the
    # straight length in front of the arc, the length of the arc, and the straight
    # length behind the arc. `offset` and `turn` receive position and rotation, and
    # `derivatives` receives their derivatives with respect to w.
    front, length, rear = lengths
    x, y, z = w
    # The front part of the arc ends at the point. m is the tangent in the middle of
    # this part, and t is the tangent at its rear end.
    half = (-u / 2 * x, -u / 2 * y, -u / 2 * z)
    rotate(half, turn)
    m_x = turn[0, 0]
    m_y = turn[1, 0]
    m_z = turn[2, 0]
    # The chord of an arc with bend b is parallel to the tangent in the middle of
    # the arc. The ratio of the chord to the arc is sin(b/2)/(b/2).
    bend = math.sqrt(y * y + z * z)
    a = u * bend / 2
    if a > 1e-3:
        ratio = math.sin(a) / a
        derivative = (math.cos(a) - math.sin(a) / a) / a
    else:
        ratio = 1.0 - a * a / 6
        derivative = -a / 3
    chord = length * u
    rotate((2 * half[0], 2 * half[1], 2 * half[2]), turn)
    t_x = turn[0, 0]
    t_y = turn[1, 0]
    t_z = turn[2, 0]
    offset[0] = -front - chord * ratio * m_x - rear * t_x
    offset[1] = -chord * ratio * m_y - rear * t_y
    offset[2] = -chord * ratio * m_z - rear * t_z
    for i in range(3):
        # h and e are the angular velocities of the tangents m and t per unit rate of
        # component i of w.
        s_x, s_y, s_z = _spin(half, i)
        h_x = -u / 2 * s_x
        h_y = -u / 2 * s_y
        h_z = -u / 2 * s_z
        s_x, s_y, s_z = _spin((2 * half[0], 2 * half[1], 2 * half[2]), i)
        e_x = -u * s_x
        e_y = -u * s_y
        e_z = -u * s_z
        stretch = 0.0
        if bend > 0.0 and i > 0:
            stretch = derivative * u / 2 * w[i] / bend
        derivatives[0, i] = -chord * (stretch * m_x + ratio * (h_y * m_z - h_z * m_y))
        derivatives[1, i] = -chord * (stretch * m_y + ratio * (h_z * m_x - h_x * m_z))
        derivatives[2, i] = -chord * (stretch * m_z + ratio * (h_x * m_y - h_y * m_x))
        derivatives[0, i] -= rear * (e_y * t_z - e_z * t_y)
        derivatives[1, i] -= rear * (e_z * t_x - e_x * t_z)
        derivatives[2, i] -= rear * (e_x * t_y - e_y * t_x)
        derivatives[3, i] = e_x
        derivatives[4, i] = e_y
        derivatives[5, i] = e_z


@compiled
def _turned(frame, x, y, z):  # type: ignore[no-untyped-def]
    return (
        frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z,
        frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z,
        frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z,
    )


@compiled
def _fill_motion(motion, place, j, workspace, derivatives):  # type: ignore[no-untyped-def]
    # `motion` is the Jacobian from the velocities of the body to the velocity and
    # angular velocity at `place` on segment j, shape (6, velocities).
    x = place[0]
    y = place[1]
    z = place[2]
    r_x = x - workspace.position[0, 0]
    r_y = y - workspace.position[0, 1]
    r_z = z - workspace.position[0, 2]
    for i in range(3):
        for row in range(6):
            motion[row, i] = motion[row, 3 + i] = 0.0
        motion[i, i] = motion[3 + i, 3 + i] = 1.0
    motion[0, 4] = r_z
    motion[0, 5] = -r_y
    motion[1, 3] = -r_z
    motion[1, 5] = r_x
    motion[2, 3] = r_y
    motion[2, 4] = -r_x
    for k in range(j):
        base = workspace.base[k]
        rear = workspace.position[k + 1]
        r_x = x - rear[0]
        r_y = y - rear[1]
        r_z = z - rear[2]
        for i in range(3):
            column = 6 + 3 * k + i
            s_x = base[3, i]
            s_y = base[4, i]
            s_z = base[5, i]
            motion[0, column] = base[0, i] + s_y * r_z - s_z * r_y
            motion[1, column] = base[1, i] + s_z * r_x - s_x * r_z
            motion[2, column] = base[2, i] + s_x * r_y - s_y * r_x
            motion[3, column] = s_x
            motion[4, column] = s_y
            motion[5, column] = s_z
    _rotate_derivatives(derivatives, workspace.frame[j], motion, 6 + 3 * j)


@compiled
def _rotate_derivatives(derivatives, frame, out, column):  # type: ignore[no-untyped-def]
    # The bend to the left, the bend upwards and the twist are the components z, −y and
    # x of the rotation vector w.
    for i in range(3):
        source = 2 - i
        sign = -1.0 if i == 1 else 1.0
        v = _turned(
            frame,
            derivatives[0, source],
            derivatives[1, source],
            derivatives[2, source],
        )
        s = _turned(
            frame,
            derivatives[3, source],
            derivatives[4, source],
            derivatives[5, source],
        )
        for row in range(3):
            out[row, column + i] = sign * v[row]
            out[3 + row, column + i] = sign * s[row]


class _Place(NamedTuple):
    offset: np.ndarray
    turn: np.ndarray
    derivatives: np.ndarray


@allocating
def pose(state, body, workspace):  # type: ignore[no-untyped-def]
    """Compute the connector poses, the points and their Jacobians for a state."""
    place = _Place(np.empty(3), np.empty((3, 3)), np.empty((6, 3)))
    count = body.fraction.shape[0]
    for i in range(3):
        workspace.position[0, i] = state[i]
        for k in range(3):
            workspace.frame[0, i, k] = state[ROTATION + 3 * i + k]
    for j in range(workspace.bend.shape[0]):
        row = BENDS + 3 * j
        w = (state[row + 2], -state[row + 1], state[row])
        for m in range(count):
            lengths = (body.front[m], body.length, body.rear[m])
            _arc(
                w,
                body.fraction[m],
                lengths,
                place.offset,
                place.turn,
                place.derivatives,
            )
            _fill_point(j, j * count + m, body.radius, place, workspace)
        lengths = (body.gap, body.length, body.gap)
        _arc(w, 1.0, lengths, place.offset, place.turn, place.derivatives)
        _fill_connector(j, place, workspace)


@inlined
def _fill_point(j, p, radius, place, workspace):  # type: ignore[no-untyped-def]
    frame = workspace.frame[j]
    here = workspace.position[j]
    offset = place.offset
    turn = place.turn
    x, y, z = _turned(frame, offset[0], offset[1], offset[2])
    workspace.point[p, 0] = here[0] + x
    workspace.point[p, 1] = here[1] + y
    workspace.point[p, 2] = here[2] + z
    t_x, t_y, t_z = _turned(frame, turn[0, 0], turn[1, 0], turn[2, 0])
    flat = max(math.sqrt(t_x * t_x + t_y * t_y), 1e-12)
    c = t_x / flat
    s = t_y / flat
    workspace.heading[p, 0] = c
    workspace.heading[p, 1] = s
    motion = workspace.motion[p]
    rows = workspace.rows[p]
    _fill_motion(motion, workspace.point[p], j, workspace, place.derivatives)
    for i in range(9 + 3 * j):
        # The rows `ALONG` and `ACROSS` are the velocity of the material point
        # vertically below the axis. The row `ROLL` is the rolling velocity of the
        # surface.
        v_x = motion[0, i] - radius * motion[4, i]
        v_y = motion[1, i] + radius * motion[3, i]
        rows[ALONG, i] = c * v_x + s * v_y
        rows[ACROSS, i] = c * v_y - s * v_x
        rows[UP, i] = motion[2, i]
        rows[ROLL, i] = radius * (
            t_x * motion[3, i] + t_y * motion[4, i] + t_z * motion[5, i]
        )


@inlined
def _fill_connector(j, place, workspace):  # type: ignore[no-untyped-def]
    frame = workspace.frame[j]
    here = workspace.position[j]
    there = workspace.position[j + 1]
    offset = place.offset
    turn = place.turn
    x, y, z = _turned(frame, offset[0], offset[1], offset[2])
    there[0] = here[0] + x
    there[1] = here[1] + y
    there[2] = here[2] + z
    _rotate_derivatives(place.derivatives, frame, workspace.base[j], 0)
    for i in range(3):
        for row in range(3):
            workspace.frame[j + 1, row, i] = (
                frame[row, 0] * turn[0, i]
                + frame[row, 1] * turn[1, i]
                + frame[row, 2] * turn[2, i]
            )
