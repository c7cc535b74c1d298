r"""Compiled kernel of the `compliant` analytical model.

**Equations.** Kinematics and floor are those of `complete` (`kernels`), but the bends q
are unknown. The velocities are u = (v_c in the frame of the mean heading, θ̇, q̇). The
velocity along and across and the yaw rate of each connector are linear in u, with three
rows R_i(q). Lagrange's equations in Hamilton's variables are

$$ p = M(q)\,u, \quad M = \sum m_i \bigl(R_{t,i}^T R_{t,i} + R_{n,i}^T R_{n,i}\bigr), \qquad
   \dot p_q = \frac{\partial T}{\partial q} + \tau - k q - c \dot q + \sum R_i^T f_i, $$

with the kinetic energy T, the moment of the air τ = k G (p⁺ − p⁻), and the friction
force and moment f_i of a connector. The first three momenta are M v_c and L, as in
`complete`. Only the floor changes them, so that the scheme conserves them exactly
without friction, and no acceleration appears.

**Integration.** SDIRK2 as in `kernels`. A stage is solved for u by Newton's method. Its
matrix contains friction, stiffness, damping and, as an antisymmetric part, the
gyroscopic forces. It neglects the changes of friction and M with q, which are of order
γ² h². The antisymmetric part is necessary: at the straight shape, alternating rotations
of connectors move no point mass, so that M is singular and only damping resists that
motion. Friction has a convex potential, whose slope along a Newton step shows whether
the step was too long.

**Linear cost.** z denotes the velocity of a connector, its spin, and the rate of its
velocity at constant u, all relative to the mean-heading frame. A segment propagates

$$ z_{j+1} = z_j + \tau_j\,\omega_j + t_j\,\dot q_j, $$

and Newton's matrix is the sum of Zᵀ B Z over the connectors, where B contains mass,
friction slopes and, between velocities and rates, ± a m. It is solved like an
articulated body: from tail to head each bend is eliminated from the matrix of the body
part behind it, and from head to tail the bends are substituted. The z of the head is
then unknown. Rates must be relative to the centre of mass, Σ m ż = 0; the two Lagrange
multipliers of this constraint are propagated with z and turn out to be v_c.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, kernel_only
from srs_twin.plants.analytical.floor import (
    FloorFriction,
    connector_friction,
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
    BodyParameters,
    X,
    Y,
    chord_terms,
    pose_body,
)
from srs_twin.plants.analytical.obstacles import (
    Obstacles,
    add_contacts,
    fill_rates,
    find_near,
    set_pose,
    update_loads,
)
from srs_twin.robot.spec import GRAVITY

BENDS = STATES
"""Index of the first bend in the state: those of `kernels`, then the bends, then their momenta."""

_NEWTON_STEPS = 1000  # largest number of iterations; many are needed at rest on a slope, at a kink of the law
_NEWTON_TOLERANCE = 1e-9  # tolerance of the velocities at a time unit of 1, m/s
_NEWTON_ARM = (
    0.1  # lever arm that turns rates into velocities, at a length unit of 1, m
)
_MOST_PASSES = 10  # largest number of updates of the normal forces that friction of obstacles depends on
_LOAD_TOLERANCE = 1e-4  # tolerance of these normal forces over the weight, 1
_MARGIN = (
    SPEED_LIMIT / 10
)  # speed at which the search for near obstacles leaves room, m/s
_OVERSHOOT = 0.1  # ratio of the slopes after and before a Newton step above which the step was too long, 1


class CompliantModel(NamedTuple):
    """Constants of the kernels.

    Attributes:
        solid: body.
        segments: number of segments.
        stiffness: k of each cell, shape (cells,), N·m/rad; an undivided segment is one
            cell.
        damping: c of each cell, shape (cells,), N·m·s/rad.
        floor: floor.
        obstacles: obstacles that the body can touch, or None.
    """

    solid: BodyParameters
    segments: int
    stiffness: np.ndarray
    damping: np.ndarray
    floor: FloorFriction
    obstacles: Obstacles | None

    @classmethod
    def of(
        cls,
        solid: BodyParameters,
        stiffness: float | np.ndarray,
        damping: float | np.ndarray,
        floor: FloorFriction,
        obstacles: Obstacles | None = None,
    ) -> CompliantModel:
        """Return the model; springs are numbers or have the shape (segments, cells per segment)."""
        cells = len(solid.mass) - 1
        if np.ndim(stiffness) == 0:
            segments = cells
        else:
            segments = np.shape(stiffness)[0]
        k, c = (
            np.full(cells, np.ravel(value), dtype=float)
            for value in (stiffness, damping)
        )
        return cls(solid, segments, k, c, floor, obstacles)


@kernel_only
def _fill_propagation(body, q, u, solid, links):  # type: ignore[no-untyped-def]
    """Fill the coefficients τ and t that propagate z from each connector to the next.

    Args:
        body: posed body, shape (ROWS, N).
        q: bends, shape (segments,), rad.
        u: velocities, shape (3 + segments,).
        solid: the body.
        links: out, shape (segments, 8): τ for the velocity (2) and its rate (2), then t
            for both. The spin has the coefficients 0 and −1.
    """
    for j in range(q.shape[0]):
        spin = u[2] + 0.5 * (body[SPIN, j] + body[SPIN, j + 1])
        # The direction of a chord is half a bend behind the heading of its front end.
        half_c, half_s, span, slope, curvature = chord_terms(q[j], solid, j)
        c = body[COS, j] * half_c + body[SIN, j] * half_s
        s = body[SIN, j] * half_c - body[COS, j] * half_s
        chord_rate = slope * u[3 + j]
        forth = curvature * u[3 + j] + 0.5 * span * spin
        aside = slope * spin - 0.5 * chord_rate
        link = links[j]
        link[0] = span * s
        link[1] = -span * c
        link[2] = span * spin * c + chord_rate * s
        link[3] = span * spin * s - chord_rate * c
        link[4] = -slope * c - 0.5 * span * s
        link[5] = 0.5 * span * c - slope * s
        link[6] = aside * s - forth * c
        link[7] = -forth * s - aside * c


@compiled
def _fill_loads(body, u, a, solid, floor, loads):  # type: ignore[no-untyped-def]
    """Fill momentum and friction of each connector, and the symmetric part of Newton's matrix.

    Args:
        body: posed body, shape (ROWS, N).
        u: velocities, shape (3 + segments,).
        a: γ h, s.
        solid: the body.
        floor: the floor.
        loads: out, shape (N, 15): momentum relative to the centre of mass x, y and of
            the spin; friction x, y and moment; mass minus a times the slope of
            friction, xx, xy, xm, yy, ym, mm, yx, mx, my.

    Returns:
        Force of the floor (x, y), its moment about the centre of mass, and the
        dissipated power, W.
    """
    fx = fy = moment = power = 0.0
    for i in range(solid.mass.shape[0]):
        mass = solid.mass[i]
        load = loads[i]
        c = body[COS, i]
        s = body[SIN, i]
        x = body[X, i]
        y = body[Y, i]
        vx = body[VX, i] - u[2] * y
        vy = body[VY, i] + u[2] * x
        spin = u[2] + body[SPIN, i]
        load[0] = mass * vx
        load[1] = mass * vy
        load[2] = solid.inertia[i] * spin
        along = (vx + u[0]) * c + (vy + u[1]) * s
        across = (vy + u[1]) * c - (vx + u[0]) * s
        t, n, m, tt, tn, tm, nn, nm, mm, nt, mn = connector_friction(
            along, across, spin, mass * floor.gravity, floor
        )
        load[3] = t * c - n * s
        load[4] = t * s + n * c
        load[5] = m
        power -= t * along + n * across + m * spin
        fx = fx + load[3]
        fy = fy + load[4]
        moment = moment + x * load[4] - y * load[3] + m
        xx, xy, yx, yy = slopes_of_force(tt, tn, nt, nn, c, s)
        load[6] = mass - a * xx
        load[7] = -a * xy
        load[12] = -a * yx
        load[9] = mass - a * yy
        load[8] = -a * (tm * c - nm * s)
        load[10] = -a * (tm * s + nm * c)
        load[11] = solid.inertia[i] - a * mm
        load[13] = -a * (tm * c - mn * s)
        load[14] = -a * (tm * s + mn * c)
    return fx, fy, moment, power


@kernel_only
def _damper_power(model, rates, free_rates):  # type: ignore[no-untyped-def]
    """Return the power that the dampers of all cells dissipate, Σ c (q̇ − q̇_f)², W.

    Args:
        model: see `CompliantModel`.
        rates: bend rates of the cells, shape (cells,), rad/s.
        free_rates: rates of their free bends, same shape, rad/s.
    """
    power = 0.0
    for c in range(rates.shape[0]):
        deviation = rates[c] - free_rates[c]
        power += model.damping[c] * deviation * deviation
    return power


@compiled
def balance(q, u, moment, a, model, floor, work):  # type: ignore[no-untyped-def]
    """Evaluate momenta and forces of Lagrange's equations in the frame of the mean heading.

    Args:
        q: bends, shape (segments,), rad.
        u: velocity of the centre of mass in that frame (m/s), yaw rate and bend rates
            (rad/s), shape (3 + segments,).
        moment: moment k q_f + c q̇_f of the free bend on each segment, shape
            (segments,), N·m.
        a: γ h for `solve`, s.
        model: a `CompliantModel`, its obstacles with the pose of the body.
        floor: the floor.
        work: out, momenta and forces, and the input of `solve`.

    Returns:
        Power that the floor and obstacles take, W.
    """
    solid = model.solid
    body = work.body
    links = work.links
    loads = work.loads
    momentum = work.momentum
    force = work.force
    n = solid.mass.shape[0]
    weight = solid.weight
    inertia, h = pose_body(q, u[3:], solid, body)
    _fill_propagation(body, q, u, solid, links)
    fx, fy, floor_moment, power = _fill_loads(body, u, a, solid, floor, loads)
    x, y, m, loss = add_contacts(model.obstacles, body, u, a, loads)
    fx = fx + x
    fy = fy + y
    floor_moment = floor_moment + m
    power = power + loss
    momentum[0] = weight * u[0]
    momentum[1] = weight * u[1]
    momentum[2] = inertia * u[2] + h
    force[0] = fx
    force[1] = fy
    force[2] = floor_moment
    # Sums over all connectors behind a segment, about the connector at its front end.
    px = py = pm = x = y = m = 0.0
    for j in range(n - 2, -1, -1):
        load = loads[j + 1]
        link = links[j]
        share = (n - 1 - j) / n
        mass_share = solid.mass[j + 1] / weight
        px = px + load[0]
        py = py + load[1]
        pm = pm + load[2]
        x = x + load[3] - mass_share * fx
        y = y + load[4] - mass_share * fy
        m = m + load[5]
        momentum[3 + j] = link[4] * px + link[5] * py - pm + share * momentum[2]
        force[3 + j] = (
            link[4] * x
            + link[5] * y
            - m
            + link[6] * px
            + link[7] * py
            + share * floor_moment
        )
        force[3 + j] += (
            moment[j] - model.stiffness[j] * q[j] - model.damping[j] * u[3 + j]
        )
        pm += link[0] * px + link[1] * py
        m += link[0] * x + link[1] * y + link[2] * px + link[3] * py
    return power


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
def solve(a, model, work):  # type: ignore[no-untyped-def]
    """Solve Newton's linear system at the point of the preceding `balance`.

    Args:
        a: γ h, positive, s.
        model: as in `balance`.
        work: as filled by `balance`, with the residual; its `step` is the solution.
    """
    solid = model.solid
    links = work.links
    loads = work.loads
    pivots = work.pivots
    matrix = work.matrix
    residual = work.residual
    step = work.step
    n = solid.mass.shape[0]
    weight = solid.weight
    for i in range(7):
        for k in range(8):
            matrix[i, k] = 0.0
    for j in range(n - 2, -1, -1):
        link = links[j]
        pivot = pivots[j]
        _add_connector(
            matrix, loads[j + 1], solid.mass[j + 1], weight, 1 / n, a, residual
        )
        # Eliminate the bend from the matrix of the body part behind it, then transform
        # this matrix to the connector in front.
        for k in range(8):
            pivot[k] = link[4] * matrix[0, k] + link[5] * matrix[1, k] - matrix[2, k]
            pivot[k] += link[6] * matrix[3, k] + link[7] * matrix[4, k]
        pivot[7] += residual[3 + j]
        bend_stiffness = a * model.damping[j] + a * a * model.stiffness[j]
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
            factor = (
                link[4] * row[0]
                + link[5] * row[1]
                - row[2]
                + link[6] * row[3]
                + link[7] * row[4]
            )
            for k in range(8):
                row[k] -= factor * pivot[k]
            row[2] += (
                link[0] * row[0]
                + link[1] * row[1]
                + link[2] * row[3]
                + link[3] * row[4]
            )
        for k in range(8):
            matrix[2, k] += link[0] * matrix[0, k] + link[1] * matrix[1, k]
            matrix[2, k] += link[2] * matrix[3, k] + link[3] * matrix[4, k]
        pivot[2] += (
            link[0] * pivot[0]
            + link[1] * pivot[1]
            + link[2] * pivot[3]
            + link[3] * pivot[4]
        )
    _add_connector(matrix, loads[0], solid.mass[0], weight, 1 / n, a, residual)
    x, y, m, ax, ay, vx, vy = _eliminate(matrix)
    step[0] = vx
    step[1] = vy
    step[2] = m
    for j in range(n - 1):
        link = links[j]
        pivot = pivots[j]
        bend = (
            pivot[7]
            - pivot[0] * x
            - pivot[1] * y
            - pivot[2] * m
            - pivot[3] * ax
            - pivot[4] * ay
        )
        bend -= pivot[5] * vx + pivot[6] * vy
        step[3 + j] = bend
        step[2] -= (n - 1 - j) / n * bend
        x = x + link[0] * m + link[4] * bend
        y = y + link[1] * m + link[5] * bend
        ax = ax + link[2] * m + link[6] * bend
        ay = ay + link[3] * m + link[7] * bend
        m = m - bend


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
    return (
        matrix[0, 7],
        matrix[1, 7],
        matrix[2, 7],
        matrix[3, 7],
        matrix[4, 7],
        matrix[5, 7],
        matrix[6, 7],
    )


class WorkArrays(NamedTuple):
    """Work arrays for N connectors.

    Attributes:
        body: posed body, shape (ROWS, N).
        links: coefficients of the propagation (`_fill_propagation`), shape (segments,
            8).
        loads: momenta, friction and mass matrices of the connectors (`_fill_loads`),
            shape (N, 15).
        pivots: eliminated rows of the bends, with the right side last, shape (segments,
            8).
        matrix: Newton's matrix of the body part behind a connector, for velocity (2),
            spin, rate of the velocity (2) and the multipliers (2), with the right side
            last, shape (7, 8).
        bend: bends at a stage, shape (segments,).
        moment: moments of the free bends at a stage, shape (segments,).
        momentum: p, shape (3 + segments,).
        force: dp/dt, same shape.
        residual: residual of a stage, same shape.
        step: Newton's step, same shape.
        last: velocities before a stage, same shape.
        drift: rates of change of the velocities between stages, same shape.
        rate: rates of the state at a stage, shape (state,).
        known: known part of a stage, shape (state,).
    """

    body: np.ndarray
    links: np.ndarray
    loads: np.ndarray
    pivots: np.ndarray
    matrix: np.ndarray
    bend: np.ndarray
    moment: np.ndarray
    momentum: np.ndarray
    force: np.ndarray
    residual: np.ndarray
    step: np.ndarray
    last: np.ndarray
    drift: np.ndarray
    rate: np.ndarray
    known: np.ndarray

    @classmethod
    def of(cls, n: int, states: int = 0) -> WorkArrays:
        """Return arrays for n connectors and a number of states (0 for `balance`)."""
        shapes: list[tuple[int, ...]] = [
            (ROWS, n),
            (n - 1, 8),
            (n, 15),
            (n - 1, 8),
            (7, 8),
        ]
        shapes += [(n - 1,)] * 2
        return cls(*map(np.zeros, [*shapes, *[(n + 2,)] * 6, (states,), (states,)]))


@kernel_only
def _residual(known, a, u, weight, floor, work):  # type: ignore[no-untyped-def]
    """Fill the residual p(u) − p_known − a dp/dt in the frame of the mean heading.

    Args:
        known: known part of the stage equation, shape (STATES + 2 segments,).
        a: γ h, s.
        u: velocities, shape (3 + segments,).
        weight: total mass, kg.
        floor: the floor.
        work: as filled by `balance`.
    """
    momentum = work.momentum
    force = work.force
    out = work.residual
    heading = known[HEADING] + a * u[2]
    c = math.cos(heading)
    s = math.sin(heading)
    size = u.shape[0]
    for j in range(size):
        out[j] = momentum[j] - a * force[j]
    v_x = known[STATE_VX] + a * floor.pull_x
    v_y = known[STATE_VY] + a * floor.pull_y
    out[0] -= weight * (v_x * c + v_y * s)
    out[1] -= weight * (v_y * c - v_x * s)
    out[2] -= known[MOMENT]
    for j in range(3, size):
        out[j] -= known[BENDS + size - 6 + j]


@kernel_only
def _stage(known, a, free, free_rate, model, floor, u, k, work):  # type: ignore[no-untyped-def]
    """Solve one implicit stage Y = known + a f(Y) from the guess `u`; fill k = f(Y); return the success.

    In place of the bends, Y contains their deviations from the free bends, which are
    known exactly.
    """
    force = work.force
    q = work.bend
    moment = work.moment
    residual = work.residual
    step = work.step
    segments = free.shape[0]
    size = u.shape[0]
    weight = model.solid.weight
    obstacles = model.obstacles
    for j in range(segments):
        moment[j] = model.stiffness[j] * free[j] + model.damping[j] * free_rate[j]
    for j in range(size):
        step[j] = 0.0
    step_share = 0.0  # fraction of the latest Newton step that has been made
    slope_before = 0.0  # slope of the potential along that step at its start
    converged = False
    passes = 0
    power = 0.0
    tolerance = _NEWTON_TOLERANCE * floor.unit
    arm = _NEWTON_ARM * floor.unit * floor.unit
    for _ in range(_NEWTON_STEPS):
        for j in range(segments):
            q[j] = free[j] + known[BENDS + j] + a * (u[3 + j] - free_rate[j])
        set_pose(obstacles, known, a, u)
        power = balance(q, u, moment, a, model, floor, work)
        _residual(known, a, u, weight, floor, work)
        slope_after = 0.0
        for j in range(size):
            slope_after += residual[j] * step[j]
        if slope_after < -_OVERSHOOT * slope_before:
            # The step overshot the minimum, across a kink of the friction law: shorten
            # it.
            back = step_share * min(
                max(slope_before / (slope_before - slope_after), 0.1), 0.7
            )
            for j in range(size):
                u[j] += (step_share - back) * step[j]
            step_share = back
            continue
        solve(a, model, work)
        slope_before = 0.0
        step_share = 1.0
        longest = 0.0
        for j in range(size):
            u[j] -= step[j]
            slope_before += residual[j] * step[j]
            longest = max(longest, abs(step[j]) * (1.0 if j < 2 else arm))
        if longest < tolerance:
            if passes < _MOST_PASSES and update_loads(
                obstacles, _LOAD_TOLERANCE * weight * GRAVITY
            ):
                passes += 1
                for j in range(size):
                    step[j] = 0.0
                slope_before = 0.0
                continue
            converged = True
            break
    heading = known[HEADING] + a * u[2]
    c = math.cos(heading)
    s = math.sin(heading)
    k[STATE_X] = u[0] * c - u[1] * s
    k[STATE_Y] = u[0] * s + u[1] * c
    k[STATE_VX] = (force[0] * c - force[1] * s) / weight + floor.pull_x
    k[STATE_VY] = (force[0] * s + force[1] * c) / weight + floor.pull_y
    power -= weight * (floor.pull_x * k[STATE_X] + floor.pull_y * k[STATE_Y])
    power += _damper_power(model, u[3:], free_rate)
    k[HEADING] = u[2]
    k[MOMENT] = force[2]
    k[ENERGY_LOSS] = power
    for j in range(segments):
        k[BENDS + j] = u[3 + j] - free_rate[j]
        k[BENDS + segments + j] = force[3 + j]
    fill_rates(obstacles, model, (free, free_rate), q, u[3:], k)
    return converged


@compiled
def advance(now, steps, free, marks, model, samples, work):  # type: ignore[no-untyped-def]
    """Advance a body in place over given steps; return the number of completed steps.

    Args:
        now: state, that of `kernels` followed by bends (rad), their momenta (kg·m²/s)
            and, with obstacles, the impulses of the obstacles on each point (N·s) and
            the time (s); and velocities as in `balance`, kept between calls as first
            guesses.
        steps: lengths of the steps, shape (steps,), s.
        free: free bends (rad) and their rates (rad/s) at the start and at the two
            stages of each step, shapes (1 + 2 steps, segments).
        marks: number of steps before each sample, ascending, shape (samples,).
        model: a `CompliantModel`.
        samples: out, states and velocities at the samples, shapes (samples, …).
        work: a `WorkArrays`.
    """
    (state, u), (states, velocities), (bends, rates) = now, samples, free
    solid = model.solid
    rate = work.rate
    known = work.known
    last = work.last
    drift = work.drift
    reach = solid.pitch / 2
    n = solid.mass.shape[0]
    size = u.shape[0]
    for j in range(size):
        drift[j] = 0.0
    mark = 0
    for i in range(steps.shape[0]):
        h = steps[i]
        a = GAMMA * h
        fastest = abs(u[0]) + abs(u[1])
        fine = True
        for j in range(2, size):
            fastest = max(fastest, reach * abs(u[j]))
        floor = with_reduced_slip_speed(model.floor, fastest)
        find_near(model.obstacles, state, 2 * reach * n + _MARGIN * h)
        copy(state, known)
        for j in range(size - 3):
            known[BENDS + j] -= bends[2 * i, j]
        for stage in range(2):
            row = 2 * i + 1 + stage
            # Linear extrapolation of the velocities between stages saves half of the
            # Newton iterations.
            lead, rest = (a, h - a) if stage == 0 else (h - a, a)
            for j in range(size):
                last[j] = u[j]
                u[j] += drift[j] * lead
            fine &= _stage(
                known, a, bends[row], rates[row], model, floor, u, rate, work
            )
            for j in range(state.shape[0]):
                known[j] += rest * rate[j]
            for j in range(size):
                drift[j] = (u[j] - last[j]) / lead
        copy(known, state)
        for j in range(size - 3):
            state[BENDS + j] += bends[2 * i + 2, j]
        # A NaN fails every comparison.
        if not (
            fine
            and abs(state[STATE_VX]) < SPEED_LIMIT
            and abs(state[STATE_VY]) < SPEED_LIMIT
        ):
            return i
        while mark < marks.shape[0] and marks[mark] == i + 1:
            copy(state, states[mark])
            copy(u, velocities[mark])
            mark += 1
    return steps.shape[0]
