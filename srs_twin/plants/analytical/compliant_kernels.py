r"""Compiled kernel of the `compliant` analytical model.

**Equations.** Kinematics and floor are the same as in the model `complete` (`kernels`),
but the bends q are unknown. The vector u contains the velocity v_c of the centre of
mass in the frame of the mean heading, the yaw rate θ̇ of this frame, and the bend rates
q̇. Connector i has the velocity R_{t,i} u along its heading and R_{n,i} u across its
heading. The matrix R_i(q) contains both rows and a third row for the yaw rate. With the
momenta p, Hamilton's equations are

$$ p = M(q)\,u, \quad M = \sum m_i \bigl(R_{t,i}^T R_{t,i} + R_{n,i}^T R_{n,i}\bigr), \qquad
   \dot p_q = \frac{\partial T}{\partial q} + \tau - k q - c \dot q + \sum R_i^T f_i. $$

Here m_i is the mass of a connector, T the kinetic energy, k the stiffness, c the
damping, and f_i the friction force and moment on a connector. The compressed air exerts
the moment τ = k G (p⁺ − p⁻), where G is the gain and p⁺, p⁻ are the chamber pressures.
The first three momenta are the linear momentum and the angular momentum L. Only
external forces change these momenta. Without external forces, the momenta are therefore
conserved exactly.

**Integration.** The equations are integrated by the SDIRK2 method of `kernels`, with a
Newton solve for u at each stage. The Newton matrix contains friction, stiffness,
damping and the antisymmetric matrix of the gyroscopic forces. The matrix neglects that
friction and M depend on q, because this effect is of order γ² h² for a step h. The
gyroscopic forces are necessary in the straight shape, in which alternating rotations of
the connectors move no point mass. M is then singular, and only damping resists such
rotations.

**Linear cost.** The cost of a solve is proportional to the number of segments. For each
connector, the vector z contains the velocity, the spin ω and the rate of change of the
velocity at constant u, all expressed in the mean-heading frame. From the front end to
the rear end of segment j, the vector z changes according to

$$ z_{j+1} = z_j + \tau_j\,\omega_j + t_j\,\dot q_j. $$

The coefficients τ_j and t_j depend on the shape and motion of the body. The Newton
matrix is the sum of Zᵀ B Z over the connectors, where Z maps u to z. The matrix B of a
connector contains the mass m and the derivatives of friction. The entries of B that
couple velocities and their rates are ± a m with a = γ h. The articulated-body algorithm
solves the linear system. A loop from tail to head eliminates each bend rate from the
Newton matrix of the body behind the segment. A loop from head to tail then computes the
bend rates by back substitution.

The vector z of the head is initially unknown. The velocity rates ż are relative to the
centre of mass and therefore satisfy the constraint Σ m ż = 0. The two Lagrange
multipliers of this constraint are equal to v_c, and the loops include them together
with z.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, inlined, kernel_only
from srs_twin.plants.analytical.floor import (
    FloorFriction,
    connector_friction,
    derivatives_of_force,
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
    is_slow,
    is_too_long,
    record,
    shorter_fraction,
)
from srs_twin.plants.analytical.kinematics import (
    COS,
    FORCE_X,
    FORCE_Y,
    FORCE_YAW,
    LOAD_COLUMNS,
    MASS_MM,
    MASS_MX,
    MASS_MY,
    MASS_XM,
    MASS_XX,
    MASS_XY,
    MASS_YM,
    MASS_YX,
    MASS_YY,
    MOMENTUM_X,
    MOMENTUM_Y,
    MOMENTUM_YAW,
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
"""Index of the first bend in the state, in which the momenta follow the bends."""

_NEWTON_STEPS = 1000
"""Maximum number of Newton iterations. A body at rest on a slope nearly reaches it."""
_NEWTON_TOLERANCE = 1e-9
"""Velocity tolerance of the Newton method at a time unit of 1, m/s."""
_NEWTON_ARM = 0.1
"""Lever arm that converts angular rates to velocities at a length unit of 1, m."""
_MOST_PASSES = 10
"""Maximum number of updates of the obstacles' normal forces per stage."""
_LOAD_TOLERANCE = 1e-4
"""Tolerance of the obstacles' normal forces, relative to the weight of the body."""
_MARGIN = SPEED_LIMIT / 10
"""Assumed maximum speed of the body in the search for nearby obstacles, m/s."""

# Columns of `WorkArrays.links`, the coefficients τ and t that propagate z over a
# segment. The coefficients τ multiply the spin, and the coefficients t the bend rate.
# The constant coefficients of the spin component of z, τ = 0 and t = −1, are not
# stored.
_SPIN_X = 0
_SPIN_Y = 1
_SPIN_X_RATE = 2
_SPIN_Y_RATE = 3
_BEND_X = 4
_BEND_Y = 5
_BEND_X_RATE = 6
_BEND_Y_RATE = 7
_LINK_COLUMNS = 8

# Rows and columns of the Newton matrix.
_X = 0  # Velocity, m/s.
_Y = 1
_M = 2  # Spin, rad/s.
_X_RATE = 3  # Rate of change of the velocity, m/s².
_Y_RATE = 4
_MULTIPLIER_X = 5
_MULTIPLIER_Y = 6
_UNKNOWNS = 7
_RIGHT = 7  # column of the right-hand side


class CompliantModel(NamedTuple):
    """Constants of the body, the floor and the obstacles.

    Attributes:
        stiffness, damping: stiffness k (N·m/rad) and damping c (N·m·s/rad) of each
            cell, shape (cells,).
        obstacles: obstacles that the body can touch, or None if there are none.
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
        """Return the model. Arrays have shape (segments, cells per segment)."""
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
    for j in range(q.shape[0]):
        spin = u[2] + 0.5 * (body[SPIN, j] + body[SPIN, j + 1])
        chord = chord_terms(q[j], solid, j)
        derivative = chord.derivative
        span = chord.span
        c = body[COS, j] * chord.cos_half + body[SIN, j] * chord.sin_half
        s = body[SIN, j] * chord.cos_half - body[COS, j] * chord.sin_half
        chord_rate = derivative * u[3 + j]
        # The chord has the direction (c, s). The coefficients t change at the rates
        # −forward along the chord and −lateral across the chord.
        forward = chord.curvature * u[3 + j] + 0.5 * span * spin
        lateral = derivative * spin - 0.5 * chord_rate
        link = links[j]
        link[_SPIN_X] = span * s
        link[_SPIN_Y] = -span * c
        link[_SPIN_X_RATE] = span * spin * c + chord_rate * s
        link[_SPIN_Y_RATE] = span * spin * s - chord_rate * c
        link[_BEND_X] = -derivative * c - 0.5 * span * s
        link[_BEND_Y] = 0.5 * span * c - derivative * s
        link[_BEND_X_RATE] = lateral * s - forward * c
        link[_BEND_Y_RATE] = -forward * s - lateral * c


@compiled
def _fill_loads(body, u, a, solid, floor, loads):  # type: ignore[no-untyped-def]
    # The function returns the floor force (x, y; N), the moment about the centre of
    # mass (N·m), and the dissipated power (W).
    fx = fy = moment = power = 0.0
    for i in range(solid.mass.shape[0]):
        mass = solid.mass[i]
        load = loads[i]
        c = body[COS, i]
        s = body[SIN, i]
        x = body[X, i]
        y = body[Y, i]
        # (vx, vy) is the velocity relative to the centre of mass.
        vx = body[VX, i] - u[2] * y
        vy = body[VY, i] + u[2] * x
        spin = u[2] + body[SPIN, i]
        load[MOMENTUM_X] = mass * vx
        load[MOMENTUM_Y] = mass * vy
        load[MOMENTUM_YAW] = solid.inertia[i] * spin
        along = (vx + u[0]) * c + (vy + u[1]) * s
        across = (vy + u[1]) * c - (vx + u[0]) * s
        f = connector_friction(along, across, spin, mass * floor.gravity, floor)
        load[FORCE_X] = f.t * c - f.n * s
        load[FORCE_Y] = f.t * s + f.n * c
        load[FORCE_YAW] = f.m
        power -= f.t * along + f.n * across + f.m * spin
        fx = fx + load[FORCE_X]
        fy = fy + load[FORCE_Y]
        moment = moment + x * load[FORCE_Y] - y * load[FORCE_X] + f.m
        xx, xy, yx, yy = derivatives_of_force(f, c, s)
        load[MASS_XX] = mass - a * xx
        load[MASS_XY] = -a * xy
        load[MASS_YX] = -a * yx
        load[MASS_YY] = mass - a * yy
        load[MASS_XM] = -a * (f.tm * c - f.nm * s)
        load[MASS_YM] = -a * (f.tm * s + f.nm * c)
        load[MASS_MM] = solid.inertia[i] - a * f.mm
        load[MASS_MX] = -a * (f.tm * c - f.mn * s)
        load[MASS_MY] = -a * (f.tm * s + f.mn * c)
    return fx, fy, moment, power


@kernel_only
def _damper_power(model, rates, free_rates):  # type: ignore[no-untyped-def]
    power = 0.0
    for c in range(rates.shape[0]):
        deviation = rates[c] - free_rates[c]
        power += model.damping[c] * deviation * deviation
    return power


@compiled
def balance(q, u, moment, a, model, floor, workspace):  # type: ignore[no-untyped-def]
    """Compute momenta, forces and Newton matrices of the equations of motion.

    All quantities are expressed in the frame of the mean heading.

    Args:
        q: bends, shape (segments,), rad.
        u: velocity of the centre of mass (m/s), yaw rate and bend rates (rad/s), shape
            (3 + segments,).
        moment: moment k q_f + c q̇_f on each segment due to its free bend q_f, shape
            (segments,), N·m.
        a: implicit step γ h, s.
        model: constants, a `CompliantModel`. The obstacles contain the body's pose.
        floor: friction parameters of the floor.
        workspace: work arrays, a `WorkArrays`, which receive the results.

    Returns:
        Power dissipated by the floor and the obstacles, W.
    """
    solid = model.solid
    body = workspace.body
    loads = workspace.loads
    momentum = workspace.momentum
    force = workspace.force
    inertia, h = pose_body(q, u[3:], solid, body)
    _fill_propagation(body, q, u, solid, workspace.links)
    fx, fy, floor_moment, power = _fill_loads(body, u, a, solid, floor, loads)
    x, y, m, loss = add_contacts(model.obstacles, body, u, a, loads)
    fx = fx + x
    fy = fy + y
    floor_moment = floor_moment + m
    power = power + loss
    momentum[0] = solid.weight * u[0]
    momentum[1] = solid.weight * u[1]
    momentum[2] = inertia * u[2] + h
    force[0] = fx
    force[1] = fy
    force[2] = floor_moment
    _sum_behind(q, u, moment, model, workspace)
    return power


@kernel_only
def _sum_behind(q, u, moment, model, workspace):  # type: ignore[no-untyped-def]
    mass = model.solid.mass
    n = mass.shape[0]
    momentum = workspace.momentum
    force = workspace.force
    fx = force[0]
    fy = force[1]
    floor_moment = force[2]
    # Sum the momenta (px, py, pm), forces (x, y) and moment (m) of all connectors
    # behind a segment. Moments are about the connector at the rear end of the segment.
    px = py = pm = x = y = m = 0.0
    for j in range(n - 2, -1, -1):
        load = workspace.loads[j + 1]
        link = workspace.links[j]
        # At a constant mean heading, a bend rotates the head by `fraction` times the
        # bend angle.
        fraction = (n - 1 - j) / n
        mass_fraction = mass[j + 1] / model.solid.weight
        px = px + load[MOMENTUM_X]
        py = py + load[MOMENTUM_Y]
        pm = pm + load[MOMENTUM_YAW]
        x = x + load[FORCE_X] - mass_fraction * fx
        y = y + load[FORCE_Y] - mass_fraction * fy
        m = m + load[FORCE_YAW]
        momentum[3 + j] = (
            link[_BEND_X] * px + link[_BEND_Y] * py - pm + fraction * momentum[2]
        )
        force[3 + j] = (
            link[_BEND_X] * x
            + link[_BEND_Y] * y
            - m
            + link[_BEND_X_RATE] * px
            + link[_BEND_Y_RATE] * py
            + fraction * floor_moment
        )
        force[3 + j] += (
            moment[j] - model.stiffness[j] * q[j] - model.damping[j] * u[3 + j]
        )
        pm += link[_SPIN_X] * px + link[_SPIN_Y] * py
        m += (
            link[_SPIN_X] * x
            + link[_SPIN_Y] * y
            + link[_SPIN_X_RATE] * px
            + link[_SPIN_Y_RATE] * py
        )


@kernel_only
def _add_connector(matrix, load, mass, weight, fraction, a, residual):  # type: ignore[no-untyped-def]
    matrix[_X, _X] += load[MASS_XX]
    matrix[_X, _Y] += load[MASS_XY]
    matrix[_Y, _X] += load[MASS_YX]
    matrix[_X, _M] += load[MASS_XM]
    matrix[_M, _X] += load[MASS_MX]
    matrix[_Y, _Y] += load[MASS_YY]
    matrix[_Y, _M] += load[MASS_YM]
    matrix[_M, _Y] += load[MASS_MY]
    matrix[_M, _M] += load[MASS_MM]
    matrix[_M, _RIGHT] += residual[2] * fraction
    for i in range(2):
        matrix[_X + i, _X_RATE + i] += a * mass
        matrix[_X_RATE + i, _X + i] -= a * mass
        matrix[_X_RATE + i, _MULTIPLIER_X + i] += a * mass
        matrix[_MULTIPLIER_X + i, _X_RATE + i] -= a * mass
        matrix[_X + i, _RIGHT] += mass / weight * residual[i]


@kernel_only
def _by_bend(link, row):  # type: ignore[no-untyped-def]
    return (
        link[_BEND_X] * row[_X]
        + link[_BEND_Y] * row[_Y]
        - row[_M]
        + link[_BEND_X_RATE] * row[_X_RATE]
        + link[_BEND_Y_RATE] * row[_Y_RATE]
    )


@kernel_only
def _by_spin(link, row):  # type: ignore[no-untyped-def]
    return (
        link[_SPIN_X] * row[_X]
        + link[_SPIN_Y] * row[_Y]
        + link[_SPIN_X_RATE] * row[_X_RATE]
        + link[_SPIN_Y_RATE] * row[_Y_RATE]
    )


@compiled
def solve(a, model, workspace):  # type: ignore[no-untyped-def]
    """Solve the linear system of the Newton method after a call of `balance`.

    Args:
        a: implicit step γ h, positive, s.
        model: constants, a `CompliantModel`.
        workspace: work arrays filled by `balance`, with the residual of the stage. The
            field `step` receives the solution.
    """
    mass = model.solid.mass
    loads = workspace.loads
    matrix = workspace.matrix
    residual = workspace.residual
    n = mass.shape[0]
    weight = model.solid.weight
    for i in range(_UNKNOWNS):
        for k in range(_UNKNOWNS + 1):
            matrix[i, k] = 0.0
    for j in range(n - 2, -1, -1):
        _add_connector(matrix, loads[j + 1], mass[j + 1], weight, 1 / n, a, residual)
        _eliminate_bend(j, a, model, workspace)
    _add_connector(matrix, loads[0], mass[0], weight, 1 / n, a, residual)
    _substitute_bends(_eliminate(matrix), workspace)


@kernel_only
def _eliminate_bend(j, a, model, workspace):  # type: ignore[no-untyped-def]
    link = workspace.links[j]
    pivot = workspace.pivots[j]
    matrix = workspace.matrix
    for k in range(_UNKNOWNS + 1):
        pivot[k] = (
            link[_BEND_X] * matrix[_X, k]
            + link[_BEND_Y] * matrix[_Y, k]
            - matrix[_M, k]
        )
        pivot[k] += (
            link[_BEND_X_RATE] * matrix[_X_RATE, k]
            + link[_BEND_Y_RATE] * matrix[_Y_RATE, k]
        )
    pivot[_RIGHT] += workspace.residual[3 + j]
    # The momentum equation of an implicit step multiplies damping by a and stiffness by
    # a².
    bend_stiffness = a * model.damping[j] + a * a * model.stiffness[j]
    stiff = bend_stiffness + _by_bend(link, pivot)
    for k in range(_UNKNOWNS + 1):
        pivot[k] /= stiff
    for i in range(_UNKNOWNS):
        row = matrix[i]
        factor = _by_bend(link, row)
        for k in range(_UNKNOWNS + 1):
            row[k] -= factor * pivot[k]
        row[_M] += _by_spin(link, row)
    for k in range(_UNKNOWNS + 1):
        matrix[_M, k] += link[_SPIN_X] * matrix[_X, k] + link[_SPIN_Y] * matrix[_Y, k]
        matrix[_M, k] += (
            link[_SPIN_X_RATE] * matrix[_X_RATE, k]
            + link[_SPIN_Y_RATE] * matrix[_Y_RATE, k]
        )
    pivot[_M] += _by_spin(link, pivot)


class _HeadSolution(NamedTuple):
    x: float
    y: float
    m: float
    x_rate: float
    y_rate: float
    multiplier_x: float
    multiplier_y: float


@kernel_only
def _substitute_bends(head, workspace):  # type: ignore[no-untyped-def]
    # A loop from head to tail computes the Newton step. The multipliers are the step of
    # v_c.
    step = workspace.step
    n = workspace.loads.shape[0]
    step[0] = head.multiplier_x
    step[1] = head.multiplier_y
    step[2] = head.m
    x = head.x
    y = head.y
    m = head.m
    x_rate = head.x_rate
    y_rate = head.y_rate
    for j in range(n - 1):
        link = workspace.links[j]
        pivot = workspace.pivots[j]
        bend = (
            pivot[_RIGHT]
            - pivot[_X] * x
            - pivot[_Y] * y
            - pivot[_M] * m
            - pivot[_X_RATE] * x_rate
            - pivot[_Y_RATE] * y_rate
        )
        bend -= (
            pivot[_MULTIPLIER_X] * head.multiplier_x
            + pivot[_MULTIPLIER_Y] * head.multiplier_y
        )
        step[3 + j] = bend
        step[2] -= (n - 1 - j) / n * bend
        x = x + link[_SPIN_X] * m + link[_BEND_X] * bend
        y = y + link[_SPIN_Y] * m + link[_BEND_Y] * bend
        x_rate = x_rate + link[_SPIN_X_RATE] * m + link[_BEND_X_RATE] * bend
        y_rate = y_rate + link[_SPIN_Y_RATE] * m + link[_BEND_Y_RATE] * bend
        m = m - bend


@kernel_only
def _eliminate(matrix):  # type: ignore[no-untyped-def]
    for j in range(_UNKNOWNS):
        for i in range(j + 1, _UNKNOWNS):
            factor = matrix[i, j] / matrix[j, j]
            for k in range(j + 1, _UNKNOWNS + 1):
                matrix[i, k] -= factor * matrix[j, k]
    for j in range(_UNKNOWNS - 1, -1, -1):
        for k in range(j + 1, _UNKNOWNS):
            matrix[j, _RIGHT] -= matrix[j, k] * matrix[k, _RIGHT]
        matrix[j, _RIGHT] /= matrix[j, j]
    return _HeadSolution(
        matrix[_X, _RIGHT],
        matrix[_Y, _RIGHT],
        matrix[_M, _RIGHT],
        matrix[_X_RATE, _RIGHT],
        matrix[_Y_RATE, _RIGHT],
        matrix[_MULTIPLIER_X, _RIGHT],
        matrix[_MULTIPLIER_Y, _RIGHT],
    )


class WorkArrays(NamedTuple):
    """Work arrays for N connectors.

    Attributes:
        body: poses and velocities of the connectors, with the rows of `kinematics`,
            shape (ROWS, N).
        links: coefficients that propagate z over a segment, shape (segments,
            _LINK_COLUMNS).
        loads: momentum, force and Newton matrix of each connector, shape (N,
            LOAD_COLUMNS).
        pivots: rows of the Newton matrix that eliminate the bends, with the right-hand
            side in the last column, shape (segments, _UNKNOWNS + 1).
        matrix: Newton matrix of the body behind a connector, with the right-hand side
            in the last column, shape (_UNKNOWNS, _UNKNOWNS + 1).
        bend, moment: bends (rad) and moments due to the free bends (N·m) at a stage,
            shape (segments,).
        momentum, force: momenta p and time derivatives dp/dt, shape (3 + segments,).
        residual, step: residual of a stage, and Newton step, shape (3 + segments,).
        last, drift: velocities before a stage, and time derivatives of the velocities
            between stages, shape (3 + segments,).
        rate, known: time derivative f(Y) of the state Y at a stage, and known part of
            Y, shape (state,).
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
        """Allocate arrays for n connectors and a state with `states` entries."""
        shapes = [
            (ROWS, n),
            (n - 1, _LINK_COLUMNS),
            (n, LOAD_COLUMNS),
            (n - 1, _UNKNOWNS + 1),
            (_UNKNOWNS, _UNKNOWNS + 1),
            *[(n - 1,)] * 2,
            *[(n + 2,)] * 6,
            *[(states,)] * 2,
        ]
        return cls(*map(np.zeros, shapes))


@kernel_only
def _residual(known, a, u, weight, floor, workspace):  # type: ignore[no-untyped-def]
    # The residual is p(u) − p_known − a dp/dt in the mean-heading frame.
    momentum = workspace.momentum
    force = workspace.force
    out = workspace.residual
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
def _dot(a, b):  # type: ignore[no-untyped-def]
    total = 0.0
    for j in range(a.shape[0]):
        total += a[j] * b[j]
    return total


@kernel_only
def _begin_stage(bend, rate, model, workspace):  # type: ignore[no-untyped-def]
    for j in range(bend.shape[0]):
        workspace.moment[j] = model.stiffness[j] * bend[j] + model.damping[j] * rate[j]
    for j in range(workspace.step.shape[0]):
        workspace.step[j] = 0.0


@kernel_only
def _stage(a, free, row, model, floor, u, workspace):  # type: ignore[no-untyped-def]
    # Solves Y = known + a f(Y) and returns whether the Newton method converged. The
    # free bends are known exactly, so Y contains the deviations of the bends from them.
    # The solution replaces the first guess of the velocities in `u`.
    known = workspace.known
    q = workspace.bend
    residual = workspace.residual
    step = workspace.step
    bend = free.bend[row]
    bend_rate = free.rate[row]
    segments = bend.shape[0]
    size = u.shape[0]
    weight = model.solid.weight
    _begin_stage(bend, bend_rate, model, workspace)
    step_fraction = 0.0  # Executed fraction of the latest Newton step.
    derivative_before = 0.0  # Derivative of the potential at the start of that step.
    converged = False
    passes = 0
    power = 0.0
    tolerance = _NEWTON_TOLERANCE * floor.unit
    arm = _NEWTON_ARM * floor.unit * floor.unit
    for _ in range(_NEWTON_STEPS):
        for j in range(segments):
            q[j] = bend[j] + known[BENDS + j] + a * (u[3 + j] - bend_rate[j])
        set_pose(model.obstacles, known, a, u)
        power = balance(q, u, workspace.moment, a, model, floor, workspace)
        _residual(known, a, u, weight, floor, workspace)
        derivative_after = _dot(residual, step)
        if is_too_long(derivative_before, derivative_after):
            fraction = step_fraction * shorter_fraction(
                derivative_before, derivative_after
            )
            for j in range(size):
                u[j] += (step_fraction - fraction) * step[j]
            step_fraction = fraction
            continue
        solve(a, model, workspace)
        derivative_before = 0.0
        step_fraction = 1.0
        longest = 0.0
        for j in range(size):
            u[j] -= step[j]
            derivative_before += residual[j] * step[j]
            longest = max(longest, abs(step[j]) * (1.0 if j < 2 else arm))
        if longest < tolerance:
            largest_change = _LOAD_TOLERANCE * weight * GRAVITY
            if passes < _MOST_PASSES and update_loads(model.obstacles, largest_change):
                passes += 1
                _begin_stage(bend, bend_rate, model, workspace)
                derivative_before = 0.0
                continue
            converged = True
            break
    _fill_rates(a, power, free, row, model, floor, u, workspace)
    return converged


@inlined
def _fill_rates(a, power, free, row, model, floor, u, workspace):  # type: ignore[no-untyped-def]
    known = workspace.known
    force = workspace.force
    k = workspace.rate
    bend_rate = free.rate[row]
    segments = bend_rate.shape[0]
    weight = model.solid.weight
    heading = known[HEADING] + a * u[2]
    c = math.cos(heading)
    s = math.sin(heading)
    k[STATE_X] = u[0] * c - u[1] * s
    k[STATE_Y] = u[0] * s + u[1] * c
    k[STATE_VX] = (force[0] * c - force[1] * s) / weight + floor.pull_x
    k[STATE_VY] = (force[0] * s + force[1] * c) / weight + floor.pull_y
    power -= weight * (floor.pull_x * k[STATE_X] + floor.pull_y * k[STATE_Y])
    power += _damper_power(model, u[3:], bend_rate)
    k[HEADING] = u[2]
    k[MOMENT] = force[2]
    k[ENERGY_LOSS] = power
    for j in range(segments):
        k[BENDS + j] = u[3 + j] - bend_rate[j]
        k[BENDS + segments + j] = force[3 + j]
    fill_rates(model.obstacles, model, free.bend[row], bend_rate, u[3:], workspace)


class CompliantState(NamedTuple):
    """State of a body with compliant bends.

    Attributes:
        state: state in the layout of `kernels`, followed by the bends (rad) and the
            momenta of the bends (kg·m²/s). With obstacles, the state also contains the
            impulse on each point (N·s) and the time (s).
        velocity: velocities u of `balance`, from which the next Newton solve starts.
    """

    state: np.ndarray
    velocity: np.ndarray


@inlined
def _fastest_point(u, reach):  # type: ignore[no-untyped-def]
    fastest = abs(u[0]) + abs(u[1])
    for j in range(2, u.shape[0]):
        fastest = max(fastest, reach * abs(u[j]))
    return fastest


@compiled
def advance(now, steps, free, marks, model, samples, workspace):  # type: ignore[no-untyped-def]
    """Advance a body by several time steps and return the number of completed steps.

    Args:
        now: state of the body, a `CompliantState`, changed in place.
        steps: lengths of the steps, shape (steps,), s.
        free: free bends and their rates at the start and at the two stages of each
            step, a `Bends` of shape (1 + 2 · steps, segments).
        marks: number of steps before each sample, ascending, shape (samples,).
        model: constants, a `CompliantModel`.
        samples: output for states and velocities, a `Samples`.
        workspace: work arrays, a `WorkArrays`.
    """
    state = now.state
    u = now.velocity
    rate = workspace.rate
    known = workspace.known
    last = workspace.last
    drift = workspace.drift
    reach = model.solid.pitch / 2
    n = model.solid.mass.shape[0]
    size = u.shape[0]
    for j in range(size):
        drift[j] = 0.0
    mark = 0
    for i in range(steps.shape[0]):
        h = steps[i]
        a = GAMMA * h
        solved = True
        floor = with_reduced_slip_speed(model.floor, _fastest_point(u, reach))
        find_near(model.obstacles, state, 2 * reach * n + _MARGIN * h)
        copy(state, known)
        for j in range(size - 3):
            known[BENDS + j] -= free.bend[2 * i, j]
        for stage in range(2):
            # The Newton method starts from linearly extrapolated velocities and
            # therefore needs only half as many iterations.
            lead, rest = (a, h - a) if stage == 0 else (h - a, a)
            for j in range(size):
                last[j] = u[j]
                u[j] += drift[j] * lead
            solved &= _stage(a, free, 2 * i + 1 + stage, model, floor, u, workspace)
            for j in range(state.shape[0]):
                known[j] += rest * rate[j]
            for j in range(size):
                drift[j] = (u[j] - last[j]) / lead
        copy(known, state)
        for j in range(size - 3):
            state[BENDS + j] += free.bend[2 * i + 2, j]
        if not (solved and is_slow(state)):
            return i
        mark = record(state, u, marks, i + 1, mark, samples)
    return steps.shape[0]
