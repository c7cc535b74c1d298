"""Compiled time steps of the model `quasistatic`."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compute.compiled import allocating, compiled, inlined
from srs_twin.plants.analytical.kernels import copy, record
from srs_twin.plants.analytical.spatial_kinematics import (
    ACROSS,
    ALONG,
    BENDS,
    CLOCK,
    DRAG_LOSS,
    FRICTION_LOSS,
    INTERNAL_LOSS,
    IS_JUMPING,
    JUMPS,
    ROLL,
    ROTATION,
    UP,
    WORK,
    pose,
    rotate,
)
from srs_twin.robot import friction
from srs_twin.robot.spec import GRAVITY

_MAX_SWEEPS = 4
"""Maximum number of times that a step is solved with updated normal forces."""
_MAX_ITERATIONS = 30
_SOFTER = (1e3, 1e2, 10.0, 1.0)
"""Factors that multiply the slip speed, in this order, if the Newton method fails.

The solution for each factor is the initial value for the next factor.
"""
_MAX_TRIALS = 14
_MAX_DERIVATIVE_RATIO = 0.5
"""Magnitude of the derivative at which a line search ends, relative to the start."""
_MAX_HALVINGS = 14
_TOLERANCE = 1e-6
"""Tolerance of the residual power, relative to body weight times slip speed."""
_LOAD_TOLERANCE = 1e-4
"""Tolerance of the normal forces in a step, relative to the body weight."""
_ellipse = compiled(friction.ellipse)


@compiled
def _begin_step(state, body, workspace, h):  # type: ignore[no-untyped-def]
    # The linear part of the residual contains springs, dampers, weight and drag.
    segments = workspace.bend.shape[0]
    count = body.fraction.shape[0]
    linear = workspace.linear
    at_rest = workspace.at_rest
    for i in range(at_rest.shape[0]):
        at_rest[i] = 0.0
        for k in range(at_rest.shape[0]):
            linear[i, k] = 0.0
    for p in range(workspace.point.shape[0]):
        rows = workspace.rows[p]
        mass = body.mass[p]
        # The velocity of a point depends only on the first `used` velocities, which
        # belong to the head and to the segments up to the point.
        used = 9 + 3 * (p // count)
        drag = mass / body.drag_time
        for i in range(used):
            z = drag * rows[UP, i]
            q = drag * rows[ROLL, i]
            at_rest[i] += mass * GRAVITY * rows[UP, i]
            for k in range(used):
                linear[i, k] += z * rows[UP, k] + q * rows[ROLL, k]
    for j in range(segments):
        for i in range(3):
            row = 6 + 3 * j + i
            stiffness = body.stiffness[i]
            at_rest[row] += stiffness * (
                state[BENDS + 3 * j + i] - workspace.bend[j, i]
            )
            at_rest[row] -= body.damping[i] * workspace.bend_rate[j, i]
            linear[row, row] += h * stiffness + body.damping[i]


@inlined
def _fill_linear(velocity, workspace, out, with_matrix):  # type: ignore[no-untyped-def]
    size = velocity.shape[0]
    for i in range(size):
        total = workspace.at_rest[i]
        for k in range(size):
            total += workspace.linear[i, k] * velocity[k]
        out[i] = total
        if with_matrix:
            for k in range(i + 1):
                workspace.matrix[i, k] = workspace.linear[i, k]


@compiled
def _residual(velocity, body, workspace, h, slip, out, with_matrix):  # type: ignore[no-untyped-def]
    count = body.fraction.shape[0]
    mu = body.friction
    matrix = workspace.matrix
    _fill_linear(velocity, workspace, out, with_matrix)
    for p in range(workspace.point.shape[0]):
        used = 9 + 3 * (p // count)
        rows = workspace.rows[p]
        up = 0.0
        for i in range(used):
            up += rows[UP, i] * velocity[i]
        # The floor is a spring, whose force depends on the height of the point at the
        # end of the step.
        spring = body.free * body.mass[p] * GRAVITY / body.depth
        load = spring * max(0.0, body.radius - workspace.point[p, 2] - h * up)
        workspace.load[p] = load
        workspace.force[p, 0] = 0.0
        workspace.force[p, 1] = 0.0
        if load <= 0.0 and workspace.friction_load[p] <= 0.0:
            continue
        along = across = 0.0
        for i in range(used):
            along += rows[ALONG, i] * velocity[i]
            across += rows[ACROSS, i] * velocity[i]
        mu_t = mu.forward if along >= 0.0 else mu.backward
        # f_t and f_lat are the friction forces along and across the body. tt, tn and nn
        # are the derivatives of these forces with respect to `along` and `across`.
        f_t, f_lat, tt, tn, _, nn = _ellipse(
            along, across, workspace.friction_load[p], mu_t, mu.across, slip
        )
        workspace.force[p, 0] = f_t
        workspace.force[p, 1] = f_lat
        derivative = h * spring if load > 0.0 else 0.0
        for i in range(used):
            a = rows[ALONG, i]
            b = rows[ACROSS, i]
            z = rows[UP, i]
            out[i] -= load * z + f_t * a + f_lat * b
            if with_matrix:
                g_t = tt * a + tn * b
                g_n = tn * a + nn * b
                g_z = derivative * z
                for k in range(i + 1):
                    matrix[i, k] += (
                        g_z * rows[UP, k] - g_t * rows[ALONG, k] - g_n * rows[ACROSS, k]
                    )
    if body.free == 0.0:
        _hold_head(out, matrix, with_matrix)


@compiled
def _hold_head(residual, matrix, with_matrix):  # type: ignore[no-untyped-def]
    for i in range(6):
        residual[i] = 0.0
    if with_matrix:
        for i in range(matrix.shape[0]):
            for k in range(min(i + 1, 6)):
                matrix[i, k] = 1.0 * (i == k)


@compiled
def _solve(matrix, vector):  # type: ignore[no-untyped-def]
    size = vector.shape[0]
    for i in range(size):
        for k in range(i + 1):
            total = matrix[i, k]
            for m in range(k):
                total -= matrix[i, m] * matrix[k, m]
            if i == k:
                matrix[i, k] = math.sqrt(max(total, 1e-300))
            else:
                matrix[i, k] = total / matrix[k, k]
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
def _minimise(velocity, body, workspace, h, slip, tolerance):  # type: ignore[no-untyped-def]
    size = velocity.shape[0]
    # g is the gradient of the minimised function divided by h, and d is the Newton
    # step.
    g = workspace.residual
    d = workspace.direction
    for _ in range(_MAX_ITERATIONS):
        _residual(velocity, body, workspace, h, slip, g, True)
        for i in range(size):
            d[i] = -g[i]
        _solve(workspace.matrix, d)
        first = _product(g, d)
        if not first < -tolerance:
            return np.isfinite(first)
        # The derivative along d increases monotonically, so that `low` and `high` can
        # bracket the minimum.
        low = 0.0
        high = 0.0
        t = 1.0
        derivative_low = first
        derivative_high = 0.0
        for _ in range(_MAX_TRIALS):
            for i in range(size):
                workspace.trial[i] = velocity[i] + t * d[i]
            _residual(workspace.trial, body, workspace, h, slip, g, False)
            derivative = _product(g, d)
            if abs(derivative) <= -_MAX_DERIVATIVE_RATIO * first:
                break
            if derivative < 0.0:
                low = t
                derivative_low = derivative
                if high == 0.0:
                    break  # Accept a full Newton step.
            else:
                high = t
                derivative_high = derivative
            t = low + (high - low) * min(
                max(derivative_low / (derivative_low - derivative_high), 0.1), 0.9
            )
        for i in range(size):
            velocity[i] += t * d[i]
    return False


@compiled
def _solve_step(velocity, state, body, workspace, h, weight):  # type: ignore[no-untyped-def]
    slip = body.friction.slip
    _begin_step(state, body, workspace, h)
    converged = True
    for _ in range(_MAX_SWEEPS):
        tolerance = _TOLERANCE * weight * slip
        converged = _minimise(velocity, body, workspace, h, slip, tolerance)
        if not converged:
            # The Newton method overshoots if sticking points are far from the solution.
            # The step is then solved with larger slip speeds first.
            for i in range(velocity.shape[0]):
                velocity[i] = 0.0
            for factor in _SOFTER:
                converged = _minimise(
                    velocity, body, workspace, h, factor * slip, factor * tolerance
                )
        _residual(velocity, body, workspace, h, slip, workspace.residual, False)
        largest = 0.0
        for p in range(workspace.load.shape[0]):
            largest = max(largest, abs(workspace.load[p] - workspace.friction_load[p]))
            workspace.friction_load[p] = workspace.load[p]
        if largest < _LOAD_TOLERANCE * weight:
            break
    return converged


@compiled
def move_state(velocity, state, body, workspace, h, turn, old):  # type: ignore[no-untyped-def]
    """Advance a state in place by a time h (s) with constant velocities."""
    segments = workspace.bend.shape[0]
    for j in range(segments):
        for i in range(3):
            row = BENDS + 3 * j + i
            rate = velocity[6 + 3 * j + i]
            free_rate = workspace.bend_rate[j, i]
            state[row] += h * rate
            k = body.stiffness[i]
            c = body.damping[i]
            torque = k * (workspace.bend[j, i] - state[row]) + c * (free_rate - rate)
            state[WORK] += h * torque * free_rate
            state[INTERNAL_LOSS] += h * c * (rate - free_rate) ** 2
    tail = BENDS + 3 * segments
    count = body.fraction.shape[0]
    for p in range(workspace.point.shape[0]):
        used = 9 + 3 * (p // count)
        rows = workspace.rows[p]
        mass = body.mass[p]
        along = across = up = roll = 0.0
        for i in range(used):
            along += rows[ALONG, i] * velocity[i]
            across += rows[ACROSS, i] * velocity[i]
            up += rows[UP, i] * velocity[i]
            roll += rows[ROLL, i] * velocity[i]
        f_t = workspace.force[p, 0]
        f_lat = workspace.force[p, 1]
        c = workspace.heading[p, 0]
        s = workspace.heading[p, 1]
        state[FRICTION_LOSS] -= h * (f_t * along + f_lat * across)
        state[DRAG_LOSS] += h * mass / body.drag_time * (up * up + roll * roll)
        state[tail + 3 * p] += h * (c * f_t - s * f_lat)
        state[tail + 3 * p + 1] += h * (s * f_t + c * f_lat)
        state[tail + 3 * p + 2] += h * workspace.load[p]
        state[tail + 3 * workspace.point.shape[0] + p] = workspace.load[p]
    for i in range(3):
        state[i] += h * velocity[i]
    for i in range(9):
        old[i] = state[ROTATION + i]
    rotate((h * velocity[3], h * velocity[4], h * velocity[5]), turn)
    for i in range(3):
        for k in range(3):
            total = (
                turn[i, 0] * old[k] + turn[i, 1] * old[3 + k] + turn[i, 2] * old[6 + k]
            )
            state[ROTATION + 3 * i + k] = total
    state[CLOCK] += h


@compiled
def _fastest_point(velocity, workspace, count):  # type: ignore[no-untyped-def]
    largest = 0.0
    for p in range(workspace.point.shape[0]):
        total = 0.0
        for row in range(3):
            v = 0.0
            for i in range(9 + 3 * (p // count)):
                v += workspace.motion[p, row, i] * velocity[i]
            total += v * v
        largest = max(largest, total)
    return math.sqrt(largest)


@compiled
def _set_bends(free, step, fraction, duration, workspace):  # type: ignore[no-untyped-def]
    for j in range(workspace.bend.shape[0]):
        for i in range(2):
            before = free[step, j, i]
            after = free[step + 1, j, i]
            workspace.bend[j, i] = before + fraction * (after - before)
            workspace.bend_rate[j, i] = (after - before) / duration


@compiled
def _count_jump(state, fastest, body):  # type: ignore[no-untyped-def]
    jumping = 1.0 if fastest > body.jump_speed else 0.0
    if jumping > state[IS_JUMPING]:
        state[JUMPS] += 1.0
    state[IS_JUMPING] = jumping


@allocating
def advance(now, steps, free, sample_steps, body, workspace, samples):  # type: ignore[no-untyped-def]
    """Advance a body by several time steps and return the number of completed steps.

    Args:
        now: state of the body, a `QuasistaticState`, changed in place.
        steps: lengths of the steps, shape (steps,), s.
        free: free bends at the start and after each step, shape (steps + 1, S, 2), rad.
        sample_steps: number of steps before each sample, ascending, shape (samples,).
        body: constants of body and floor.
        workspace: work arrays.
        samples: output for states and velocities, a `Samples`.
    """
    state = now.state
    velocity = now.velocity
    turn = np.empty((3, 3))
    old = np.empty(9)
    start = np.empty_like(velocity)
    points = body.mass.shape[0]
    weight = body.mass.sum() * GRAVITY
    loads = BENDS + 3 * workspace.bend.shape[0] + 3 * points
    for p in range(points):
        workspace.friction_load[p] = state[loads + p]
    sample = record(state, velocity, sample_steps, 0, 0, samples)
    for step in range(steps.shape[0]):
        done = 0.0
        h = steps[step]
        while done < steps[step] * (1.0 - 1e-9):
            pose(state, body, workspace)
            copy(velocity, start)
            fastest = np.inf
            for _ in range(_MAX_HALVINGS):
                fraction = min(1.0, (done + h) / steps[step])
                _set_bends(free, step, fraction, steps[step], workspace)
                fastest = np.inf
                if _solve_step(velocity, state, body, workspace, h, weight):
                    fastest = _fastest_point(
                        velocity, workspace, body.fraction.shape[0]
                    )
                if h * fastest <= body.longest_move:
                    break
                # Repeat the step from the old velocity with half the length.
                h /= 2
                fastest = np.inf
                copy(start, velocity)
            if not np.isfinite(fastest):
                return step
            move_state(velocity, state, body, workspace, h, turn, old)
            _count_jump(state, fastest, body)
            done += h
            h = min(2 * h, steps[step] - done)
        sample = record(state, velocity, sample_steps, step + 1, sample, samples)
    return steps.shape[0]
