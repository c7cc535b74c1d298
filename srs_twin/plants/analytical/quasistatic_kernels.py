"""Compiled kinematics and time steps of the spatial body without inertia (`quasistatic` has the equations).

Velocities are ordered as the position and the rotation of the head connector in the world frame, then the
rates of the bends to the left and upwards and of the twist of each segment, head first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.plants.analytical.kernels import copy
from srs_twin.robot import friction
from srs_twin.robot.spec import GRAVITY

# Layout of a state: position and rotation matrix (by rows) of the head connector, accumulated quantities,
# then the bends. The impulses of the floor on all points, shape (points, 3), and their loads follow.
ROTATION = 3
WORK = 12  # work of the torques, J
FRICTION_LOSS = 13  # energy that the floor dissipates, J
INTERNAL_LOSS = 14  # energy that twisting dissipates, J
DRAG_LOSS = 15  # energy that the drag of vertical and rolling motion dissipates, J
CLOCK = 16  # time, s
JUMPS = 17  # number of jumps between resting poses, 1
IS_JUMPING = 18  # whether a jump is under way, 1
BENDS = 19

ROWS = 4  # of `Work.rows`: velocity of a contact along and across the body, and upwards, and rolling velocity
_ALONG, _ACROSS, _UP, _ROLL = range(ROWS)

_MAX_SWEEPS = 4
"""Solves of a step, each with the loads of the one before in the friction law."""
_MAX_ITERATIONS = 30
_SOFTER = (1e3, 1e2, 10.0, 1.0)
"""Factors on the slip speed, each solved from the solution of the one before, if Newton's method fails, 1."""
_MAX_TRIALS = 14
_MAX_SLOPE_RATIO = 0.5
"""A line search ends where the slope is below this fraction of the first one, 1."""
_MAX_HALVINGS = 14
_ellipse = compiled(friction.ellipse)


class QuasistaticBody(NamedTuple):
    """Constants of the body and of the floor. P points per segment, S segments.

    Attributes:
        share: fraction of the arc ahead of a point, shape (P,), 1.
        front: straight length between the connector and the arc, shape (P,), m.
        rear: straight length between the arc and the point, shape (P,), m.
        mass: masses of the points, shape (S P,), kg.
        length: length of an arc, m.
        gap: straight length at each end of an arc, m.
        stiffness: against bends and twist, shape (3,), N·m/rad.
        damping: same order, shape (3,), N·m·s/rad.
        radius: m.
        depth: depth of the resting points in the floor, m.
        friction: coefficients forwards, backwards and across, 1, and the slip speed, m/s.
        drag_time: mass over the drag of vertical and rolling motion, s.
        longest_move: longest motion of a point in a substep, m.
        jump_speed: speed of a point in a jump, m/s.
        free: 1 for a body on the floor, 0 for one that is held at its head in the air.
    """

    share: np.ndarray
    front: np.ndarray
    rear: np.ndarray
    mass: np.ndarray
    length: float
    gap: float
    stiffness: np.ndarray
    damping: np.ndarray
    radius: float
    depth: float
    friction: tuple[float, float, float, float]
    drag_time: float
    longest_move: float
    jump_speed: float
    free: float


class Work(NamedTuple):
    """Arrays of a step.

    Attributes:
        position: of the connectors, shape (S + 1, 3), m.
        frame: rotation matrices of the connectors, shape (S + 1, 3, 3).
        point: shape (S P, 3), m.
        heading: cosine and sine of the horizontal direction of the body at each point, shape (S P, 2).
        motion: velocity of each point and its angular velocity per velocity, shape (S P, 6, velocities).
        rows: see `ROWS`, shape (S P, ROWS, velocities).
        load: normal force on each point, shape (S P,), N.
        law_load: normal force in the friction law, shape (S P,), N.
        force: friction along and across, shape (S P, 2), N.
        linear: slope of the residual without contacts, shape (velocities, velocities).
        at_rest: residual without contacts and velocities, shape (velocities,).
        matrix: Newton's matrix, lower triangle, shape (velocities, velocities).
        residual: shape (velocities,).
        direction: shape (velocities,).
        trial: shape (velocities,).
        bend: free bends and twist (0), shape (S, 3), rad.
        base: spatial velocity of the rear connector of each segment per rate of bends, shape (S, 6, 3).
    """

    position: np.ndarray
    frame: np.ndarray
    point: np.ndarray
    heading: np.ndarray
    motion: np.ndarray
    rows: np.ndarray
    load: np.ndarray
    law_load: np.ndarray
    force: np.ndarray
    linear: np.ndarray
    at_rest: np.ndarray
    matrix: np.ndarray
    residual: np.ndarray
    direction: np.ndarray
    trial: np.ndarray
    bend: np.ndarray
    base: np.ndarray


def work_arrays(segments: int, points: int) -> Work:
    """Return arrays for a body with a number of segments and points per segment."""
    n, count, velocities = segments + 1, segments * points, 6 + 3 * segments
    shapes = [(n, 3), (n, 3, 3), (count, 3), (count, 2), (count, 6, velocities), (count, ROWS, velocities)]
    square, vector = (velocities, velocities), (velocities,)
    shapes += [(count,), (count,), (count, 2), square, vector, square, vector, vector, vector]
    shapes += [(segments, 3), (segments, 6, 3)]
    return Work(*map(np.zeros, shapes))


@compiled
def _rotate(turn, out):  # type: ignore[no-untyped-def]
    """Fill the rotation matrix exp([turn]) of a rotation vector, rad."""
    x, y, z = turn
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle > 1e-4:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    else:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    out[1, 0], out[1, 1], out[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    out[2, 0], out[2, 1], out[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)


@compiled
def _spin(turn, axis):  # type: ignore[no-untyped-def]
    """Return the angular velocity of exp([turn]) per rate of one component of `turn` (left Jacobian)."""
    x, y, z = turn
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle > 1e-3:
        b, c = (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
    else:
        b, c = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    part = (x, y, z)[axis]
    e_x, e_y, e_z = 1.0 * (axis == 0), 1.0 * (axis == 1), 1.0 * (axis == 2)
    # e + b t × e + c t × (t × e), with t × (t × e) = t (t · e) − e t²
    return (
        e_x + b * (y * e_z - z * e_y) + c * (x * part - e_x * square),
        e_y + b * (z * e_x - x * e_z) + c * (y * part - e_y * square),
        e_z + b * (x * e_y - y * e_x) + c * (z * part - e_z * square),
    )


@compiled
def _arc(w, u, lengths, offset, turn, slopes):  # type: ignore[no-untyped-def]
    """Fill the place behind a connector, in its frame, and its derivatives by the components of w.

    Args:
        w: rotation vector of the front connector relative to the rear one, rad.
        u: fraction of the arc, 1.
        lengths: straight length ahead of the arc, length of the arc, and straight length behind, m.
        offset: out, shape (3,), m.
        turn: out, rotation matrix, shape (3, 3).
        slopes: out, velocity and angular velocity per rate of each component of w, shape (6, 3).
    """
    front, length, rear = lengths
    x, y, z = w
    half = (-u / 2 * x, -u / 2 * y, -u / 2 * z)
    _rotate(half, turn)
    m_x, m_y, m_z = turn[0, 0], turn[1, 0], turn[2, 0]
    # The chord of an arc with the bend b is sin(b/2)/(b/2) of its length, along the middle of the arc.
    bend = math.sqrt(y * y + z * z)
    a = u * bend / 2
    if a > 1e-3:
        ratio, slope = math.sin(a) / a, (math.cos(a) - math.sin(a) / a) / a
    else:
        ratio, slope = 1.0 - a * a / 6, -a / 3
    chord = length * u
    _rotate((2 * half[0], 2 * half[1], 2 * half[2]), turn)
    t_x, t_y, t_z = turn[0, 0], turn[1, 0], turn[2, 0]
    offset[0] = -front - chord * ratio * m_x - rear * t_x
    offset[1] = -chord * ratio * m_y - rear * t_y
    offset[2] = -chord * ratio * m_z - rear * t_z
    for i in range(3):
        s_x, s_y, s_z = _spin(half, i)
        h_x, h_y, h_z = -u / 2 * s_x, -u / 2 * s_y, -u / 2 * s_z
        s_x, s_y, s_z = _spin((2 * half[0], 2 * half[1], 2 * half[2]), i)
        e_x, e_y, e_z = -u * s_x, -u * s_y, -u * s_z
        stretch = 0.0
        if bend > 0.0 and i > 0:
            stretch = slope * u / 2 * w[i] / bend
        slopes[0, i] = -chord * (stretch * m_x + ratio * (h_y * m_z - h_z * m_y))
        slopes[1, i] = -chord * (stretch * m_y + ratio * (h_z * m_x - h_x * m_z))
        slopes[2, i] = -chord * (stretch * m_z + ratio * (h_x * m_y - h_y * m_x))
        slopes[0, i] -= rear * (e_y * t_z - e_z * t_y)
        slopes[1, i] -= rear * (e_z * t_x - e_x * t_z)
        slopes[2, i] -= rear * (e_x * t_y - e_y * t_x)
        slopes[3, i], slopes[4, i], slopes[5, i] = e_x, e_y, e_z


@compiled
def _turned(frame, x, y, z):  # type: ignore[no-untyped-def]
    """Return a vector in the world frame."""
    return (
        frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z,
        frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z,
        frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z,
    )


@compiled
def _fill_motion(motion, place, j, work, slopes):  # type: ignore[no-untyped-def]
    """Fill velocity and angular velocity of a place on segment j per velocity of the body.

    Args:
        motion: out, shape (6, velocities).
        place: shape (3,), m.
        j: segment.
        work: posed body ahead of the place.
        slopes: as in `_arc`.
    """
    x, y, z = place[0], place[1], place[2]
    r_x, r_y, r_z = x - work.position[0, 0], y - work.position[0, 1], z - work.position[0, 2]
    for i in range(3):
        for row in range(6):
            motion[row, i] = motion[row, 3 + i] = 0.0
        motion[i, i] = motion[3 + i, 3 + i] = 1.0
    motion[0, 4], motion[0, 5] = r_z, -r_y
    motion[1, 3], motion[1, 5] = -r_z, r_x
    motion[2, 3], motion[2, 4] = r_y, -r_x
    for k in range(j):
        base, rear = work.base[k], work.position[k + 1]
        r_x, r_y, r_z = x - rear[0], y - rear[1], z - rear[2]
        for i in range(3):
            column = 6 + 3 * k + i
            s_x, s_y, s_z = base[3, i], base[4, i], base[5, i]
            motion[0, column] = base[0, i] + s_y * r_z - s_z * r_y
            motion[1, column] = base[1, i] + s_z * r_x - s_x * r_z
            motion[2, column] = base[2, i] + s_x * r_y - s_y * r_x
            motion[3, column], motion[4, column], motion[5, column] = s_x, s_y, s_z
    _turn_slopes(slopes, work.frame[j], motion, 6 + 3 * j)


@compiled
def _turn_slopes(slopes, frame, out, column):  # type: ignore[no-untyped-def]
    """Write the derivatives by w in the world frame, by bend to the left, bend upwards and twist.

    These are the components z, −y and x of w.
    """
    for i in range(3):
        source, sign = 2 - i, -1.0 if i == 1 else 1.0
        v = _turned(frame, slopes[0, source], slopes[1, source], slopes[2, source])
        s = _turned(frame, slopes[3, source], slopes[4, source], slopes[5, source])
        for row in range(3):
            out[row, column + i] = sign * v[row]
            out[3 + row, column + i] = sign * s[row]


@allocating
def pose(state, body, work):  # type: ignore[no-untyped-def]
    """Fill positions, frames, points and their motions in the workspace for a state."""
    segments, count = work.bend.shape[0], body.share.shape[0]
    offset, turn, slopes = np.empty(3), np.empty((3, 3)), np.empty((6, 3))
    for i in range(3):
        work.position[0, i] = state[i]
        for k in range(3):
            work.frame[0, i, k] = state[ROTATION + 3 * i + k]
    for j in range(segments):
        frame, here = work.frame[j], work.position[j]
        w = (state[BENDS + 3 * j + 2], -state[BENDS + 3 * j + 1], state[BENDS + 3 * j])
        for m in range(count):
            p = j * count + m
            _arc(w, body.share[m], (body.front[m], body.length, body.rear[m]), offset, turn, slopes)
            x, y, z = _turned(frame, offset[0], offset[1], offset[2])
            work.point[p, 0], work.point[p, 1], work.point[p, 2] = here[0] + x, here[1] + y, here[2] + z
            t_x, t_y, t_z = _turned(frame, turn[0, 0], turn[1, 0], turn[2, 0])
            flat = max(math.sqrt(t_x * t_x + t_y * t_y), 1e-12)
            c, s = t_x / flat, t_y / flat
            work.heading[p, 0], work.heading[p, 1] = c, s
            motion, rows = work.motion[p], work.rows[p]
            _fill_motion(motion, work.point[p], j, work, slopes)
            for i in range(9 + 3 * j):
                # Velocity of the material vertically below the axis, and rolling velocity of the surface.
                v_x = motion[0, i] - body.radius * motion[4, i]
                v_y = motion[1, i] + body.radius * motion[3, i]
                rows[_ALONG, i], rows[_ACROSS, i] = c * v_x + s * v_y, c * v_y - s * v_x
                rows[_UP, i] = motion[2, i]
                rows[_ROLL, i] = body.radius * (t_x * motion[3, i] + t_y * motion[4, i] + t_z * motion[5, i])
        _arc(w, 1.0, (body.gap, body.length, body.gap), offset, turn, slopes)
        x, y, z = _turned(frame, offset[0], offset[1], offset[2])
        there, base = work.position[j + 1], work.base[j]
        there[0], there[1], there[2] = here[0] + x, here[1] + y, here[2] + z
        _turn_slopes(slopes, frame, base, 0)
        for i in range(3):
            for row in range(3):
                work.frame[j + 1, row, i] = (
                    frame[row, 0] * turn[0, i] + frame[row, 1] * turn[1, i] + frame[row, 2] * turn[2, i]
                )


@compiled
def _begin_step(state, body, work, h):  # type: ignore[no-untyped-def]
    """Fill the part of the residual that is linear in the velocities: springs, dampers, weight and drag."""
    segments, count = work.bend.shape[0], body.share.shape[0]
    linear, at_rest = work.linear, work.at_rest
    for i in range(at_rest.shape[0]):
        at_rest[i] = 0.0
        for k in range(at_rest.shape[0]):
            linear[i, k] = 0.0
    for p in range(work.point.shape[0]):
        rows, mass, used = work.rows[p], body.mass[p], 9 + 3 * (p // count)
        drag = mass / body.drag_time
        for i in range(used):
            z, q = drag * rows[_UP, i], drag * rows[_ROLL, i]
            at_rest[i] += mass * GRAVITY * rows[_UP, i]
            for k in range(used):
                linear[i, k] += z * rows[_UP, k] + q * rows[_ROLL, k]
    for j in range(segments):
        for i in range(3):
            row, stiffness = 6 + 3 * j + i, body.stiffness[i]
            at_rest[row] += stiffness * (state[BENDS + 3 * j + i] - work.bend[j, i])
            linear[row, row] += h * stiffness + body.damping[i]


@compiled
def _residual(velocity, body, work, h, slip, out, with_matrix):  # type: ignore[no-untyped-def]
    """Fill the residual of a step of length h (s) and, if asked, Newton's matrix; `slip` in m/s."""
    count, size = body.share.shape[0], velocity.shape[0]
    mu_ahead, mu_back, mu_n, _ = body.friction
    matrix, linear = work.matrix, work.linear
    for i in range(size):
        total = work.at_rest[i]
        for k in range(size):
            total += linear[i, k] * velocity[k]
        out[i] = total
        if with_matrix:
            for k in range(i + 1):
                matrix[i, k] = linear[i, k]
    for p in range(work.point.shape[0]):
        used, rows = 9 + 3 * (p // count), work.rows[p]
        up = 0.0
        for i in range(used):
            up += rows[_UP, i] * velocity[i]
        spring = body.free * body.mass[p] * GRAVITY / body.depth
        load = spring * max(0.0, body.radius - work.point[p, 2] - h * up)
        work.load[p], work.force[p, 0], work.force[p, 1] = load, 0.0, 0.0
        if load <= 0.0 and work.law_load[p] <= 0.0:
            continue
        along = across = 0.0
        for i in range(used):
            along += rows[_ALONG, i] * velocity[i]
            across += rows[_ACROSS, i] * velocity[i]
        mu = mu_ahead if along >= 0.0 else mu_back
        f_t, f_n, tt, tn, _, nn = _ellipse(along, across, work.law_load[p], mu, mu_n, slip)
        work.force[p, 0], work.force[p, 1] = f_t, f_n
        slope = h * spring if load > 0.0 else 0.0
        for i in range(used):
            a, b, z = rows[_ALONG, i], rows[_ACROSS, i], rows[_UP, i]
            out[i] -= load * z + f_t * a + f_n * b
            if with_matrix:
                g_t, g_n, g_z = tt * a + tn * b, tn * a + nn * b, slope * z
                for k in range(i + 1):
                    matrix[i, k] += g_z * rows[_UP, k] - g_t * rows[_ALONG, k] - g_n * rows[_ACROSS, k]
    if body.free == 0.0:
        _hold_head(out, matrix, with_matrix)


@compiled
def _hold_head(residual, matrix, with_matrix):  # type: ignore[no-untyped-def]
    """Fix the head: the first six velocities are 0."""
    for i in range(6):
        residual[i] = 0.0
    if with_matrix:
        for i in range(matrix.shape[0]):
            for k in range(min(i + 1, 6)):
                matrix[i, k] = 1.0 * (i == k)


@compiled
def _solve(matrix, vector):  # type: ignore[no-untyped-def]
    """Replace a vector by the solution of a symmetric positive definite system (Cholesky, in place)."""
    size = vector.shape[0]
    for i in range(size):
        for k in range(i + 1):
            total = matrix[i, k]
            for m in range(k):
                total -= matrix[i, m] * matrix[k, m]
            matrix[i, k] = math.sqrt(max(total, 1e-300)) if i == k else total / matrix[k, k]
    for i in range(size):
        total = vector[i]
        for k in range(i):
            total -= matrix[i, k] * vector[k]
        vector[i] = total / matrix[i, i]
    for i in range(size - 1, -1, -1):
        total = vector[i]
        for k in range(i + 1, size):
            total -= matrix[k, i] * vector[k]
        vector[i] = total / matrix[i, i]


@compiled
def _product(a, b):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@compiled
def _minimise(velocity, body, work, h, slip, tolerance):  # type: ignore[no-untyped-def]
    """Solve for the velocities of a step under the loads `law_load`; return whether it converged."""
    size, g, d = velocity.shape[0], work.residual, work.direction
    for _ in range(_MAX_ITERATIONS):
        _residual(velocity, body, work, h, slip, g, True)
        for i in range(size):
            d[i] = -g[i]
        _solve(work.matrix, d)
        first = _product(g, d)
        if not first < -tolerance:
            return first == first
        # The slope along the direction rises; find where it is nearly 0.
        low, high, t = 0.0, 0.0, 1.0
        slope_low, slope_high = first, 0.0
        for _ in range(_MAX_TRIALS):
            for i in range(size):
                work.trial[i] = velocity[i] + t * d[i]
            _residual(work.trial, body, work, h, slip, g, False)
            slope = _product(g, d)
            if abs(slope) <= -_MAX_SLOPE_RATIO * first:
                break
            if slope < 0.0:
                low, slope_low = t, slope
                if high == 0.0:
                    break  # accept a full step
            else:
                high, slope_high = t, slope
            t = low + (high - low) * min(max(slope_low / (slope_low - slope_high), 0.1), 0.9)
        for i in range(size):
            velocity[i] += t * d[i]
    return False


@compiled
def _solve_step(velocity, state, body, work, h, weight):  # type: ignore[no-untyped-def]
    """Solve for velocities and loads of a step of length h; return whether it converged."""
    slip = body.friction[3]
    _begin_step(state, body, work, h)
    converged = True
    for _ in range(_MAX_SWEEPS):
        tolerance = 1e-6 * weight * slip
        if not _minimise(velocity, body, work, h, slip, tolerance):
            # Newton's method overshoots where sticking points are far from it: begin with smoother friction.
            for i in range(velocity.shape[0]):
                velocity[i] = 0.0
            for factor in _SOFTER:
                converged = _minimise(velocity, body, work, h, factor * slip, factor * tolerance)
        _residual(velocity, body, work, h, slip, work.residual, False)
        largest = 0.0
        for p in range(work.load.shape[0]):
            largest = max(largest, abs(work.load[p] - work.law_load[p]))
            work.law_load[p] = work.load[p]
        if largest < 1e-4 * weight:
            break
    return converged


@compiled
def _move_state(velocity, state, body, work, h, turn, old):  # type: ignore[no-untyped-def]
    """Advance a state by a solved step of length h."""
    segments = work.bend.shape[0]
    for j in range(segments):
        for i in range(3):
            row, rate = BENDS + 3 * j + i, velocity[6 + 3 * j + i]
            state[row] += h * rate
            k, c = body.stiffness[i], body.damping[i]
            if i < 2:
                # Free bends are those of the end of the step; a mean over the step is of second order.
                state[WORK] += h * (k * (work.bend[j, i] - state[row]) - c * rate) * rate
            else:
                state[INTERNAL_LOSS] += h * c * rate * rate
    tail, count = BENDS + 3 * segments, body.share.shape[0]
    for p in range(work.point.shape[0]):
        used, rows, mass = 9 + 3 * (p // count), work.rows[p], body.mass[p]
        along = across = up = roll = 0.0
        for i in range(used):
            along += rows[_ALONG, i] * velocity[i]
            across += rows[_ACROSS, i] * velocity[i]
            up += rows[_UP, i] * velocity[i]
            roll += rows[_ROLL, i] * velocity[i]
        f_t, f_n = work.force[p, 0], work.force[p, 1]
        c, s = work.heading[p, 0], work.heading[p, 1]
        state[FRICTION_LOSS] -= h * (f_t * along + f_n * across)
        state[DRAG_LOSS] += h * mass / body.drag_time * (up * up + roll * roll)
        state[tail + 3 * p] += h * (c * f_t - s * f_n)
        state[tail + 3 * p + 1] += h * (s * f_t + c * f_n)
        state[tail + 3 * p + 2] += h * work.load[p]
        state[tail + 3 * work.point.shape[0] + p] = work.load[p]
    for i in range(3):
        state[i] += h * velocity[i]
    for i in range(9):
        old[i] = state[ROTATION + i]
    _rotate((h * velocity[3], h * velocity[4], h * velocity[5]), turn)
    for i in range(3):
        for k in range(3):
            total = turn[i, 0] * old[k] + turn[i, 1] * old[3 + k] + turn[i, 2] * old[6 + k]
            state[ROTATION + 3 * i + k] = total
    state[CLOCK] += h


@compiled
def _fastest_point(velocity, work, count):  # type: ignore[no-untyped-def]
    """Return the largest speed of a point, m/s."""
    largest = 0.0
    for p in range(work.point.shape[0]):
        total = 0.0
        for row in range(3):
            v = 0.0
            for i in range(9 + 3 * (p // count)):
                v += work.motion[p, row, i] * velocity[i]
            total += v * v
        largest = max(largest, total)
    return math.sqrt(largest)


@allocating
def advance(now, steps, free, sample_steps, body, work, samples):  # type: ignore[no-untyped-def]
    """Advance by several steps; return the number of completed steps.

    Args:
        now: state and velocity, in place.
        steps: lengths of the steps, shape (steps,), s.
        free: free bends at the start and after each step, shape (steps + 1, S, 2), rad.
        sample_steps: number of steps before each sample.
        body: constants.
        work: workspace.
        samples: out, states and velocities at the samples.
    """
    state, velocity = now
    segments, count = work.bend.shape[0], body.share.shape[0]
    turn, old, start = np.empty((3, 3)), np.empty(9), np.empty_like(velocity)
    weight, loads = body.mass.sum() * GRAVITY, BENDS + 3 * segments + 3 * body.mass.shape[0]
    for p in range(body.mass.shape[0]):
        work.law_load[p] = state[loads + p]
    sample = 0
    while sample < sample_steps.shape[0] and sample_steps[sample] == 0:
        copy(state, samples[0][sample])
        copy(velocity, samples[1][sample])
        sample += 1
    for step in range(steps.shape[0]):
        done, h = 0.0, steps[step]
        while done < steps[step] * (1.0 - 1e-9):
            pose(state, body, work)
            copy(velocity, start)
            fastest = 0.0
            for _ in range(_MAX_HALVINGS):
                share = min(1.0, (done + h) / steps[step])
                for j in range(segments):
                    for i in range(2):
                        a, b = free[step, j, i], free[step + 1, j, i]
                        work.bend[j, i] = a + share * (b - a)
                if not _solve_step(velocity, state, body, work, h, weight):
                    fastest = np.inf
                else:
                    fastest = _fastest_point(velocity, work, count)
                if h * fastest <= body.longest_move:
                    break
                h /= 2
                copy(start, velocity)
            if not np.isfinite(fastest):
                return step
            _move_state(velocity, state, body, work, h, turn, old)
            jumping = 1.0 if fastest > body.jump_speed else 0.0
            if jumping > state[IS_JUMPING]:
                state[JUMPS] += 1.0
            state[IS_JUMPING] = jumping
            done += h
            h = min(2 * h, steps[step] - done)
        while sample < sample_steps.shape[0] and sample_steps[sample] == step + 1:
            copy(state, samples[0][sample])
            copy(velocity, samples[1][sample])
            sample += 1
    return steps.shape[0]
