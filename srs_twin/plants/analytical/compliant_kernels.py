r"""Compiled kernel of the `compliant` analytical model.

**Equations.** Kinematics and floor are those of `complete` (`kernels`), but the bends q are unknown. The
velocities are u = (v_c in the frame of the mean heading, θ̇, q̇). The velocity along and across and the yaw
rate of each connector are linear in u, with three rows R_i(q). Lagrange's equations in Hamilton's variables
are

$$ p = M(q)\,u, \quad M = \sum m_i \bigl(R_{t,i}^T R_{t,i} + R_{n,i}^T R_{n,i}\bigr), \qquad
   \dot p_q = \frac{\partial T}{\partial q} + \tau - k q - c \dot q + \sum R_i^T f_i, $$

with the kinetic energy T, the moment of the air τ = k G (p⁺ − p⁻), and the friction force and moment f_i of a
connector. The first three momenta are M v_c and L, as in `complete`. Only the floor changes them, so that the
scheme conserves them exactly without friction, and no acceleration appears.

**Integration.** SDIRK2 as in `kernels`. A stage is solved for u by Newton's method. Its matrix contains
friction, stiffness, damping and, as an antisymmetric part, the gyroscopic forces. It neglects the changes of
friction and M with q, which are of order γ² h². The antisymmetric part is necessary: at the straight shape,
alternating rotations of connectors move no point mass, so that M is singular and only damping resists that
motion. Friction has a convex potential, whose slope along a Newton step shows whether the step was too long.

**Linear cost.** z denotes the velocity of a connector, its spin, and the rate of its velocity at constant u,
all relative to the mean-heading frame. A segment propagates

$$ z_{j+1} = z_j + \tau_j\,\omega_j + t_j\,\dot q_j, $$

and Newton's matrix is the sum of Zᵀ B Z over the connectors, where B contains mass, friction slopes and,
between velocities and rates, ± a m. It is solved like an articulated body: from tail to head each bend is
eliminated from the matrix of the body part behind it, and from head to tail the bends are substituted. The z
of the head is then unknown. Rates must be relative to the centre of mass, Σ m ż = 0; the two Lagrange
multipliers of this constraint are propagated with z and turn out to be v_c.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import overload

from srs_twin.compute.compiled import allocating, compiled, kernel_only
from srs_twin.plants.analytical.floor import (
    connector_friction,
    has_no_potential,
    slopes_of_force,
    with_reduced_slip_speed,
)
from srs_twin.plants.analytical.kernels import (
    ENERGY_LOSS,
    GAMMA,
    HEADING,
    MOMENT,
    SPEED_LIMIT,
    STATE_VX,
    STATE_VY,
    STATE_X,
    STATE_Y,
    STATES,
    copy,
)
from srs_twin.plants.analytical.kinematics import (
    COS,
    ROWS,
    SIN,
    SPIN,
    VX,
    VY,
    X,
    Y,
    chord_terms,
    entry,
    mean_pitch,
    pose_body,
)
from srs_twin.plants.analytical.obstacles import (
    OBSTACLES,
    add_contacts,
    begin_evaluation,
    begin_step,
    end_stage,
    touches,
    update_loads,
    with_floor,
)
from srs_twin.robot.spec import GRAVITY

BENDS = STATES
"""Index of the first bend in the state: those of `kernels`, then the bends, then their momenta."""

_NEWTON_STEPS = 1000  # largest number of iterations; many are needed at rest on a slope, at a kink of the law
_NEWTON_TOLERANCE = 1e-9  # tolerance of the velocities at a time unit of 1, m/s
_NEWTON_ARM = 0.1  # lever arm that turns rates into velocities, at a length unit of 1, m
_MOST_PASSES = 10  # largest number of updates of the normal forces that friction of obstacles depends on
_LOAD_TOLERANCE = 1e-4  # tolerance of these normal forces over the weight, 1
_MARGIN = SPEED_LIMIT / 10  # speed at which the search for near obstacles leaves room, m/s
_OVERSHOOT = 0.1  # ratio of the slopes after and before a Newton step above which the step was too long, 1


@kernel_only
def _fill_propagation(body, q, u, solid, links):  # type: ignore[no-untyped-def]
    """Fill the coefficients τ and t that propagate z from each connector to the next.

    Args:
        body: posed body, shape (ROWS, N).
        q: bends, shape (segments,), rad.
        u: velocities, shape (3 + segments,).
        solid: the body.
        links: out, shape (segments, 8): τ for the velocity (2) and its rate (2), then t for both. The spin
            has the coefficients 0 and −1.
    """
    for j in range(q.shape[0]):
        spin = u[2] + 0.5 * (body[SPIN, j] + body[SPIN, j + 1])
        # The direction of a chord is half a bend behind the heading of its front end.
        half_c, half_s, span, slope, curvature = chord_terms(q[j], solid, j)
        c = body[COS, j] * half_c + body[SIN, j] * half_s
        s = body[SIN, j] * half_c - body[COS, j] * half_s
        chord_rate = slope * u[3 + j]
        forth, aside = curvature * u[3 + j] + 0.5 * span * spin, slope * spin - 0.5 * chord_rate
        link = links[j]
        link[0], link[1] = span * s, -span * c
        link[2], link[3] = span * spin * c + chord_rate * s, span * spin * s - chord_rate * c
        link[4], link[5] = -slope * c - 0.5 * span * s, 0.5 * span * c - slope * s
        link[6], link[7] = aside * s - forth * c, -forth * s - aside * c


@compiled
def _fill_loads(body, u, a, solid, floor, loads):  # type: ignore[no-untyped-def]
    """Fill momentum and friction of each connector, and the symmetric part of Newton's matrix.

    Args:
        body: posed body, shape (ROWS, N).
        u: velocities, shape (3 + segments,).
        a: γ h, s.
        solid: the body.
        floor: the floor.
        loads: out, shape (N, 15): momentum relative to the centre of mass x, y and of the spin; friction x, y
            and moment; mass minus a times the slope of friction, xx, xy, xm, yy, ym, mm, yx, mx, my.

    Returns:
        Force of the floor (x, y), its moment about the centre of mass, and the dissipated power, W.
    """
    fx = fy = moment = power = 0.0
    for i in range(solid.mass.shape[0]):
        mass, load = solid.mass[i], loads[i]
        c, s, x, y = body[COS, i], body[SIN, i], body[X, i], body[Y, i]
        vx, vy, spin = body[VX, i] - u[2] * y, body[VY, i] + u[2] * x, u[2] + body[SPIN, i]
        load[0], load[1], load[2] = mass * vx, mass * vy, solid.inertia[i] * spin
        along, across = (vx + u[0]) * c + (vy + u[1]) * s, (vy + u[1]) * c - (vx + u[0]) * s
        t, n, m, tt, tn, tm, nn, nm, mm, nt, mn = connector_friction(
            along, across, spin, mass * floor.gravity, floor
        )
        load[3], load[4], load[5] = t * c - n * s, t * s + n * c, m
        power -= t * along + n * across + m * spin
        fx, fy, moment = fx + load[3], fy + load[4], moment + x * load[4] - y * load[3] + m
        on_x_t, on_x_n, on_y_t, on_y_n = tt * c - tn * s, tn * c - nn * s, tt * s + tn * c, tn * s + nn * c
        load[6], load[7] = mass - a * (on_x_t * c - on_x_n * s), -a * (on_x_t * s + on_x_n * c)
        load[8], load[9] = -a * (tm * c - nm * s), mass - a * (on_y_t * s + on_y_n * c)
        load[10], load[11] = -a * (tm * s + nm * c), solid.inertia[i] - a * mm
        load[12], load[13], load[14] = load[7], load[8], load[10]
        if has_no_potential(floor):
            xx, xy, yx, yy = slopes_of_force(tt, tn, nt, nn, c, s)
            load[6], load[7], load[12], load[9] = mass - a * xx, -a * xy, -a * yx, mass - a * yy
            load[13], load[14] = -a * (tm * c - mn * s), -a * (tm * s + mn * c)
    return fx, fy, moment, power


def relative_power(damping, rates):  # type: ignore[no-untyped-def]
    r"""Return the power that the cells of all segments dissipate in their relative motion, W.

    Cells in series have the damping d_c, their segment 1/Σ 1/d_c. Of the power Σ d_c q̇_c² of the dampers, the
    net moment of the segment contains the part (Σ q̇_c)² / Σ 1/d_c (`plants.twin.internal_joints`).

    Args:
        damping: d_c, shape (segments, cells per segment), N·m·s/rad; for undivided segments a number, or one
            for each.
        rates: bend rates of the cells, shape (cells,), rad/s.
    """
    if np.ndim(damping) < 2:
        return 0.0
    rate = np.reshape(rates, damping.shape)
    return float((damping * rate**2).sum() - (rate.sum(axis=1) ** 2 / (1 / damping).sum(axis=1)).sum())


@overload(relative_power)
def _compile_relative_power(damping, rates):  # type: ignore[no-untyped-def]
    """Compile `relative_power` with loops; undivided segments have no relative motion."""
    if not isinstance(damping, types.Array) or damping.ndim == 1:
        return lambda damping, rates: 0.0

    def sum_over_segments(damping, rates):  # type: ignore[no-untyped-def]
        power = 0.0
        segments, cells = damping.shape
        for j in range(segments):
            rate = inverse = 0.0
            for c in range(cells):
                cell_rate = rates[j * cells + c]
                power += damping[j, c] * cell_rate * cell_rate
                rate += cell_rate
                inverse += 1 / damping[j, c]
            power -= rate * rate / inverse
        return power

    return sum_over_segments


def energy_rate(model, moment, q, rates, loss):  # type: ignore[no-untyped-def]
    r"""Return the rate of the energy column: the given loss, or among obstacles the power of the torques, W.

    The work of the torques is the energy of the body plus the integral of the losses. During impacts, this
    integral misses what the implicit method dissipates: it evaluates the stiff normal forces at the end of a
    stage, when the body has almost stopped. The torques are smooth, so their power, Σ T_j q̇_j with
    T = τ − k q − c q̇ of a whole segment, is integrated instead.

    Args:
        model: see `balance`.
        moment: moment of the air on each cell, shape (cells,), N·m.
        q: bends of the cells, shape (cells,), rad.
        rates: their rates, shape (cells,), rad/s.
        loss: power that friction dissipates, and cells in their relative motion, W.
    """
    return _torque_power(model[1], moment, q, rates) if len(model) > OBSTACLES else loss


@overload(energy_rate, jit_options={"forceinline": True})
def _compile_energy_rate(model, moment, q, rates, loss):  # type: ignore[no-untyped-def]
    if touches(model):
        return lambda model, moment, q, rates, loss: _torque_power(model[1], moment, q, rates)
    return lambda model, moment, q, rates, loss: loss


@compiled
def _torque_power(springs, moment, q, rates):  # type: ignore[no-untyped-def]
    """Return the power of the torques of all segments, W; arguments as in `energy_rate`."""
    stiffness, damping = springs
    segments, cells = stiffness.shape
    power = 0.0
    for j in range(segments):
        bend = rate = flexibility = fluidity = 0.0
        for c in range(cells):
            bend += q[j * cells + c]
            rate += rates[j * cells + c]
            flexibility += 1 / stiffness[j, c]
            fluidity += 1 / damping[j, c]
        power += (moment[j * cells] - bend / flexibility - rate / fluidity) * rate
    return power


def fill_loads(body, u, a, model, loads):  # type: ignore[no-untyped-def]
    """Evaluate `_fill_loads`, with the obstacles of a model that has them."""
    if len(model) > OBSTACLES:
        return _fill_all_loads(body, u, a, model[0], model[2], model[OBSTACLES], loads)
    return _fill_loads(body, u, a, model[0], model[2], loads)


@overload(fill_loads, jit_options={"forceinline": True})
def _compile_fill_loads(body, u, a, model, loads):  # type: ignore[no-untyped-def]
    if touches(model):
        return lambda body, u, a, model, loads: _fill_all_loads(
            body, u, a, model[0], model[2], model[OBSTACLES], loads
        )
    return lambda body, u, a, model, loads: _fill_loads(body, u, a, model[0], model[2], loads)


@compiled
def _fill_all_loads(body, u, a, solid, floor, obstacles, loads):  # type: ignore[no-untyped-def]
    """Evaluate `_fill_loads` with the forces of obstacles."""
    fx, fy, moment, power = _fill_loads(body, u, a, solid, floor, loads)
    x, y, m, loss = add_contacts(body, u, a, obstacles, loads)
    return fx + x, fy + y, moment + m, power + loss


@compiled
def balance(q, u, moment, a, model, momentum, force, work):  # type: ignore[no-untyped-def]
    """Evaluate momenta and forces of Lagrange's equations in the frame of the mean heading.

    Args:
        q: bends, shape (segments,), rad.
        u: velocity of the centre of mass in that frame (m/s), yaw rate and bend rates (rad/s), shape
            (3 + segments,).
        moment: moment of the air on each segment, shape (segments,), N·m.
        a: γ h for `solve`, s.
        model: body; stiffness k (N·m/rad) and damping c (N·m·s/rad), numbers, one for each segment, or,
            for cells, shape (segments, cells per segment); floor; in a world with obstacles also an
            `Obstacles` with the pose of the body.
        momentum: out, p, shape (3 + segments,).
        force: out, dp/dt, shape (3 + segments,).
        work: from `work_arrays`; on return the input of `solve`.

    Returns:
        Power that friction dissipates, and cells in their relative motion, W.
    """
    solid, (stiffness, damping) = model[0], model[1]
    body, links, loads, _, _ = work
    n, weight = solid.mass.shape[0], solid.mass.sum()
    inertia, h = pose_body(q, u[3:], solid, body)
    _fill_propagation(body, q, u, solid, links)
    fx, fy, floor_moment, power = fill_loads(body, u, a, model, loads)
    momentum[0], momentum[1], momentum[2] = weight * u[0], weight * u[1], inertia * u[2] + h
    force[0], force[1], force[2] = fx, fy, floor_moment
    # Sums over all connectors behind a segment, about the connector at its front end.
    px = py = pm = x = y = m = 0.0
    for j in range(n - 2, -1, -1):
        load, link, share = loads[j + 1], links[j], (n - 1 - j) / n
        mass_share = solid.mass[j + 1] / weight
        px, py, pm = px + load[0], py + load[1], pm + load[2]
        x, y, m = x + load[3] - mass_share * fx, y + load[4] - mass_share * fy, m + load[5]
        momentum[3 + j] = link[4] * px + link[5] * py - pm + share * momentum[2]
        force[3 + j] = link[4] * x + link[5] * y - m + link[6] * px + link[7] * py + share * floor_moment
        force[3 + j] += moment[j] - entry(stiffness, j) * q[j] - entry(damping, j) * u[3 + j]
        pm += link[0] * px + link[1] * py
        m += link[0] * x + link[1] * y + link[2] * px + link[3] * py
    return power + relative_power(damping, u[3:])


@kernel_only
def _add_connector(matrix, load, mass, weight, share, a, residual):  # type: ignore[no-untyped-def]
    """Add B of a connector, the multipliers, and its contribution to the momentum residual of the body."""
    matrix[0, 0] += load[6]
    matrix[0, 1] += load[7]
    matrix[1, 0] += load[12]
    matrix[0, 2] += load[8]
    matrix[2, 0] += load[13]
    matrix[1, 1] += load[9]
    matrix[1, 2] += load[10]
    matrix[2, 1] += load[14]
    matrix[2, 2] += load[11]
    matrix[2, 7] += residual[2] * share
    for i in range(2):
        matrix[i, 3 + i] += a * mass
        matrix[3 + i, i] -= a * mass
        matrix[3 + i, 5 + i] += a * mass
        matrix[5 + i, 3 + i] -= a * mass
        matrix[i, 7] += mass / weight * residual[i]


@compiled
def solve(a, model, residual, step, work):  # type: ignore[no-untyped-def]
    """Solve Newton's linear system at the point of the preceding `balance`.

    Args:
        a: γ h, positive, s.
        model: as in `balance`.
        residual: shape (3 + segments,).
        step: out, solution, shape (3 + segments,).
        work: as filled by `balance`.
    """
    solid, (stiffness, damping) = model[0], model[1]
    _, links, loads, pivots, matrix = work
    n, weight = solid.mass.shape[0], solid.mass.sum()
    for i in range(7):
        for k in range(8):
            matrix[i, k] = 0.0
    for j in range(n - 2, -1, -1):
        link, pivot = links[j], pivots[j]
        _add_connector(matrix, loads[j + 1], solid.mass[j + 1], weight, 1 / n, a, residual)
        # Eliminate the bend from the matrix of the body part behind it, then transform this matrix to the
        # connector in front.
        for k in range(8):
            pivot[k] = link[4] * matrix[0, k] + link[5] * matrix[1, k] - matrix[2, k]
            pivot[k] += link[6] * matrix[3, k] + link[7] * matrix[4, k]
        pivot[7] += residual[3 + j]
        bend_stiffness = a * entry(damping, j) + a * a * entry(stiffness, j)
        stiff = (
            bend_stiffness
            + link[4] * pivot[0]
            + link[5] * pivot[1]
            - pivot[2]
            + link[6] * pivot[3]
            + link[7] * pivot[4]
        )
        for k in range(8):
            pivot[k] /= stiff
        for i in range(7):
            row = matrix[i]
            factor = link[4] * row[0] + link[5] * row[1] - row[2] + link[6] * row[3] + link[7] * row[4]
            for k in range(8):
                row[k] -= factor * pivot[k]
            row[2] += link[0] * row[0] + link[1] * row[1] + link[2] * row[3] + link[3] * row[4]
        for k in range(8):
            matrix[2, k] += link[0] * matrix[0, k] + link[1] * matrix[1, k]
            matrix[2, k] += link[2] * matrix[3, k] + link[3] * matrix[4, k]
        pivot[2] += link[0] * pivot[0] + link[1] * pivot[1] + link[2] * pivot[3] + link[3] * pivot[4]
    _add_connector(matrix, loads[0], solid.mass[0], weight, 1 / n, a, residual)
    x, y, m, ax, ay, vx, vy = _eliminate(matrix)
    step[0], step[1], step[2] = vx, vy, m
    for j in range(n - 1):
        link, pivot = links[j], pivots[j]
        bend = pivot[7] - pivot[0] * x - pivot[1] * y - pivot[2] * m - pivot[3] * ax - pivot[4] * ay
        bend -= pivot[5] * vx + pivot[6] * vy
        step[3 + j] = bend
        step[2] -= (n - 1 - j) / n * bend
        x, y = x + link[0] * m + link[4] * bend, y + link[1] * m + link[5] * bend
        ax, ay, m = ax + link[2] * m + link[6] * bend, ay + link[3] * m + link[7] * bend, m - bend


@kernel_only
def _eliminate(matrix):  # type: ignore[no-untyped-def]
    """Solve for the last column in place; no pivoting: the symmetric part is positive semidefinite."""
    for j in range(7):
        for i in range(j + 1, 7):
            factor = matrix[i, j] / matrix[j, j]
            for k in range(j + 1, 8):
                matrix[i, k] -= factor * matrix[j, k]
    for j in range(6, -1, -1):
        for k in range(j + 1, 7):
            matrix[j, 7] -= matrix[j, k] * matrix[k, 7]
        matrix[j, 7] /= matrix[j, j]
    return matrix[0, 7], matrix[1, 7], matrix[2, 7], matrix[3, 7], matrix[4, 7], matrix[5, 7], matrix[6, 7]


class WorkArrays(NamedTuple):
    """Work arrays of `balance` and `solve`.

    Attributes:
        body: posed body, shape (ROWS, N).
        links: coefficients of the propagation (`_fill_propagation`), shape (segments, 8).
        loads: momenta, friction and mass matrices of the connectors (`_fill_loads`), shape (N, 15).
        pivots: eliminated rows of the bends, with the right side last, shape (segments, 8).
        matrix: Newton's matrix of the body part behind a connector, for velocity (2), spin, rate of the
            velocity (2) and the multipliers (2), with the right side last, shape (7, 8).
    """

    body: np.ndarray
    links: np.ndarray
    loads: np.ndarray
    pivots: np.ndarray
    matrix: np.ndarray


@allocating
def work_arrays(n):  # type: ignore[no-untyped-def]
    """Return the work arrays of `balance` and `solve` for n connectors."""
    return WorkArrays(
        np.empty((ROWS, n)),
        np.empty((n - 1, 8)),
        np.empty((n, 15)),
        np.empty((n - 1, 8)),
        np.empty((7, 8)),
    )


@kernel_only
def _residual(known, a, u, weight, floor, momentum, force, out):  # type: ignore[no-untyped-def]  # noqa: D417
    """Fill the residual p(u) − p_known − a dp/dt in the frame of the mean heading.

    Args:
        known: known part of the stage equation, shape (STATES + 2 segments,).
        a: γ h, s.
        u: velocities, shape (3 + segments,).
        weight: total mass, kg.
        floor: the floor.
        momentum, force: as filled by `balance`.
        out: out, shape (3 + segments,).
    """
    heading = known[HEADING] + a * u[2]
    c, s = math.cos(heading), math.sin(heading)
    size = u.shape[0]
    for j in range(size):
        out[j] = momentum[j] - a * force[j]
    v_x, v_y = known[STATE_VX] + a * floor.pull_x, known[STATE_VY] + a * floor.pull_y
    out[0] -= weight * (v_x * c + v_y * s)
    out[1] -= weight * (v_y * c - v_x * s)
    out[2] -= known[MOMENT]
    for j in range(3, size):
        out[j] -= known[BENDS + size - 6 + j]


@kernel_only
def _stage(known, a, moment, model, u, k, work):  # type: ignore[no-untyped-def]
    """Solve one implicit stage Y = known + a f(Y) from the guess `u`; fill k = f(Y); return the success."""
    momentum, force, posed, q, residual, step = work
    segments, size = moment.shape[0], u.shape[0]
    floor, weight = model[2], model[0].mass.sum()
    step_share = 0.0  # fraction of the latest Newton step that has been made
    slope_before = 0.0  # slope of the potential along that step at its start
    converged = False
    passes, power = 0, 0.0
    tolerance, arm = _NEWTON_TOLERANCE * floor.unit, _NEWTON_ARM * floor.unit * floor.unit
    for _ in range(_NEWTON_STEPS):
        for j in range(segments):
            q[j] = known[BENDS + j] + a * u[3 + j]
        begin_evaluation(model, known, a, u)
        power = balance(q, u, moment, a, model, momentum, force, posed)
        _residual(known, a, u, weight, floor, momentum, force, residual)
        slope_after = 0.0
        for j in range(size):
            slope_after += residual[j] * step[j]
        if slope_after < -_OVERSHOOT * slope_before:
            # The step overshot the minimum, across a kink of the friction law: shorten it.
            back = step_share * min(max(slope_before / (slope_before - slope_after), 0.1), 0.7)
            for j in range(size):
                u[j] += (step_share - back) * step[j]
            step_share = back
            continue
        solve(a, model, residual, step, posed)
        slope_before, step_share, longest = 0.0, 1.0, 0.0
        for j in range(size):
            u[j] -= step[j]
            slope_before += residual[j] * step[j]
            longest = max(longest, abs(step[j]) * (1.0 if j < 2 else arm))
        if longest < tolerance:
            if passes < _MOST_PASSES and update_loads(model, _LOAD_TOLERANCE * weight * GRAVITY):
                passes += 1
                for j in range(size):
                    step[j] = 0.0
                slope_before = 0.0
                continue
            converged = True
            break
    for j in range(size):
        step[j] = 0.0
    heading = known[HEADING] + a * u[2]
    c, s = math.cos(heading), math.sin(heading)
    k[STATE_X] = u[0] * c - u[1] * s
    k[STATE_Y] = u[0] * s + u[1] * c
    k[STATE_VX] = (force[0] * c - force[1] * s) / weight + floor.pull_x
    k[STATE_VY] = (force[0] * s + force[1] * c) / weight + floor.pull_y
    power -= weight * (floor.pull_x * k[STATE_X] + floor.pull_y * k[STATE_Y])
    k[HEADING], k[MOMENT], k[ENERGY_LOSS] = u[2], force[2], energy_rate(model, moment, q, u[3:], power)
    for j in range(segments):
        k[BENDS + j], k[BENDS + segments + j] = u[3 + j], force[3 + j]
    end_stage(model, k)
    return converged


@kernel_only
def _extrapolate(u, rate, time, last):  # type: ignore[no-untyped-def]
    """Copy u to `last`, and add rate · time to u."""
    for j in range(u.shape[0]):
        last[j] = u[j]
        u[j] += rate[j] * time


@allocating
def advance(now, steps, moments, marks, model, samples):  # type: ignore[no-untyped-def]  # noqa: D417
    """Advance a body in place over given steps; return the number of completed steps.

    Args:
        now: state, that of `kernels` followed by bends (rad), their momenta (kg·m²/s) and, with obstacles,
            the impulses of the obstacles on each point (N·s) and the time (s); and velocities as in
            `balance`, kept between calls as first guesses.
        steps: lengths of the steps, shape (steps,), s.
        moments: moments of the air at the two stages of each step, shape (steps, 2, segments), N·m.
        marks: number of steps before each sample, ascending, shape (samples,).
        model: as in `balance`.
        seen: out, states and velocities at the samples, shapes (samples, …).
    """
    (state, u), (states, velocities) = now, samples
    solid, floor = model[0], model[2]
    reach = mean_pitch(solid) / 2
    n, size = solid.mass.shape[0], u.shape[0]
    work = np.empty(size), np.empty(size), work_arrays(n), np.empty(n - 1), np.empty(size), np.zeros(size)
    k1, k2, known = np.empty_like(state), np.empty_like(state), np.empty_like(state)
    last, drift = u.copy(), np.zeros(size)
    mark = 0
    for i in range(steps.shape[0]):
        h = steps[i]
        a = GAMMA * h
        fastest = abs(u[0]) + abs(u[1])
        for j in range(2, size):
            fastest = max(fastest, reach * abs(u[j]))
        model = with_floor(model, with_reduced_slip_speed(floor, fastest))
        begin_step(model, state, 2 * reach * n + _MARGIN * h)
        # Linear extrapolation of the velocities between stages saves half of the Newton iterations.
        _extrapolate(u, drift, a, last)
        fine = _stage(state, a, moments[i, 0], model, u, k1, work)
        for j in range(state.shape[0]):
            known[j] = state[j] + (1 - GAMMA) * h * k1[j]
        for j in range(size):
            drift[j] = (u[j] - last[j]) / a
        _extrapolate(u, drift, h - a, last)
        fine &= _stage(known, a, moments[i, 1], model, u, k2, work)
        for j in range(state.shape[0]):
            state[j] = known[j] + a * k2[j]
        for j in range(size):
            drift[j] = (u[j] - last[j]) / (h - a)
        # A NaN fails every comparison.
        if not (fine and abs(state[STATE_VX]) < SPEED_LIMIT and abs(state[STATE_VY]) < SPEED_LIMIT):
            return i
        while mark < marks.shape[0] and marks[mark] == i + 1:
            copy(state, states[mark])
            copy(u, velocities[mark])
            mark += 1
    return steps.shape[0]
