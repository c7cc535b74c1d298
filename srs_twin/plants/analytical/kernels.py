r"""Compiled kernels of the models with prescribed bends (`complete`, `simplified`).

**Forward dynamics.** The connectors have masses m_i, with sum M, and moments of inertia
J_i, which are 0 for point masses. The chambers prescribe the bends q(t), so only the
pose of the body is unknown. Connector i has position r_i and heading θ + φ_i(q), where
θ is the mean heading. The vector ρ_i(q) is the position r_i − r_c relative to the
centre of mass r_c, expressed in the frame of the mean heading. The velocity v of the
centre of mass and the angular momentum L obey

$$ M \dot v = \sum f_i, \qquad \dot L = \sum \bigl(r_i - r_c\bigr) \times f_i + n_i, \qquad
   L = I(q)\,\dot\theta + h(q, \dot q). $$

Here f_i is the friction force on connector i, and n_i is the yaw moment exerted by the
wheels of the connector. The body has the moment of inertia I = Σ m_i |ρ_i|² + J_i. The
bend rates contribute h = Σ m_i ρ_i × ρ̇_i + J_i φ̇_i to L. The equations are the sum of
Eq. 11 over all connectors, in which the moments of the segments cancel. L is integrated
instead of the yaw rate, so the equations do not contain q̈. Jumps of q̈ at valve events
therefore do not reduce the order of the integrator.

Friction is stiff, so the integrator is the two-stage, second-order, L-stable SDIRK
method of Alexander (1977). At each stage, the Newton method solves for the three
velocities. Friction has a convex potential, whose derivative along a Newton step shows
whether the step was too long.

**Inverse dynamics.** The function `inverse_dynamics` computes the moments of the
segments from given bends by the recursive Newton–Euler algorithm. A loop from head to
tail computes the linear accelerations a_i and the angular accelerations ε_i of the
connectors, for a fixed head and a constant rate of the mean heading. The balance of
forces and moments determines the linear acceleration a and the angular acceleration α
of the whole body,

$$ M a = \sum f_i - m_i a_i, \qquad
   I \alpha = \sum n_i - J_i \varepsilon_i + \rho_i \times (f_i - m_i a_i). $$

A loop from tail to head sums the loads on all connectors behind segment j to a force
F_j and a moment N_j about the rear end of the segment. The segment is massless, and its
chord has the length L(q), with the derivative L'. The unit vector e along the chord has
the mean heading of both ends of the segment. The virtual work of the segment is T_j
δq_j, which gives

$$ T_j = -L'\, F_j \cdot e + \tfrac12 L\, e \times F_j - N_j. $$

The algorithm solves Eq. 11 at a cost that is proportional to the number of segments.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, inlined, kernel_only
from srs_twin.plants.analytical.floor import (
    FloorFriction,
    Twist,
    fill_forces,
    forces_and_derivatives,
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
from srs_twin.pneumatics import Trace


class PrescribedModel(NamedTuple):
    """Constants of the body and the floor.

    Attributes:
        friction_moment: whether the moment of friction about the centre of mass acts.
    """

    solid: BodyParameters
    floor: FloorFriction
    friction_moment: bool


class Bends(NamedTuple):
    """Bends (rad) and bend rates (rad/s), shape (…, segments) each."""

    bend: np.ndarray
    rate: np.ndarray


class Samples(NamedTuple):
    """States and velocities recorded by a kernel, shape (samples, …) each."""

    states: np.ndarray
    velocities: np.ndarray


# Columns of `_InverseArrays.chords`.
_DERIVATIVE_X = 0  # L' e, m/rad.
_DERIVATIVE_Y = 1
_SPAN_X = 2  # L e, m
_SPAN_Y = 3
_CHORD_COLUMNS = 4


class _InverseArrays(NamedTuple):
    # `load` contains the accelerations of the connectors, which are then replaced by
    # the loads on the connectors.

    body: np.ndarray
    friction: np.ndarray
    chords: np.ndarray
    load: np.ndarray


def inverse_dynamics(
    velocities: np.ndarray, trace: Trace, model: PrescribedModel, torque: np.ndarray
) -> None:
    """Compute the net moments of the segments for prescribed bends.

    Args:
        velocities: velocity of the centre of mass in the mean-heading frame (m/s) and
            yaw rate (rad/s), shape (samples, 3).
        trace: chamber states, whose free bends are the bends of the segments.
        model: constants of body and floor.
        torque: output for the moments, shape (samples, segments), N·m.
    """
    n = len(model.solid.mass)
    shapes = [(ROWS, n), (n, 3), (n - 1, _CHORD_COLUMNS), (n, 3)]
    workspace = _InverseArrays(*map(np.zeros, shapes))
    _inverse_dynamics(velocities, trace, model, torque, workspace)


@compiled
def _inverse_dynamics(velocities, trace, model, torque, workspace):  # type: ignore[no-untyped-def]
    solid = model.solid
    for k in range(trace.bend.shape[0]):
        inertia, _ = pose_body(trace.bend[k], trace.bend_rate[k], solid, workspace.body)
        fill_forces(
            workspace.body, solid.mass, velocities[k], model.floor, workspace.friction
        )
        _fill_accelerations(trace, k, velocities[k, 2], solid, workspace)
        remainder = _balance_loads(inertia, model, workspace)
        _sum_moments(workspace, remainder, torque[k])


@kernel_only
def _fill_accelerations(trace, k, yaw, solid, workspace):  # type: ignore[no-untyped-def]
    # Fills `workspace.load` with the linear accelerations of the connectors relative to
    # the head (m/s²) and the angular accelerations (rad/s²), for a constant rate `yaw`
    # of the mean heading (rad/s).
    q = trace.bend[k]
    rate = trace.bend_rate[k]
    acceleration = trace.bend_acceleration[k]
    body = workspace.body
    chords = workspace.chords
    motion = workspace.load
    n = solid.mass.shape[0]
    # `alpha` is the angular acceleration of the head relative to the mean heading.
    alpha = 0.0
    for j in range(n - 1):
        alpha += (n - 1 - j) / n * acceleration[j]
    x = y = 0.0
    motion[0, 0] = x
    motion[0, 1] = y
    motion[0, 2] = alpha
    for j in range(n - 1):
        chord = chord_terms(q[j], solid, j)
        derivative = chord.derivative
        span = chord.span
        c = body[COS, j] * chord.cos_half + body[SIN, j] * chord.sin_half
        s = body[SIN, j] * chord.cos_half - body[COS, j] * chord.sin_half
        # The chord has the direction (c, s) and turns at the rate `chord_spin`. The
        # second time derivative of the chord vector has the components `along` and
        # `across`.
        chord_spin = yaw + body[SPIN, j] - rate[j] / 2
        along = (
            derivative * acceleration[j]
            + chord.curvature * rate[j] * rate[j]
            - span * chord_spin * chord_spin
        )
        across = (
            span * (alpha - acceleration[j] / 2) + 2 * derivative * rate[j] * chord_spin
        )
        x = x - along * c + across * s
        y = y - along * s - across * c
        alpha = alpha - acceleration[j]
        motion[j + 1, 0] = x
        motion[j + 1, 1] = y
        motion[j + 1, 2] = alpha
        chords[j, _DERIVATIVE_X] = derivative * c
        chords[j, _DERIVATIVE_Y] = derivative * s
        chords[j, _SPAN_X] = span * c
        chords[j, _SPAN_Y] = span * s


@kernel_only
def _balance_loads(inertia, model, workspace):  # type: ignore[no-untyped-def]
    # Replaces the accelerations in `workspace.load` by forces (N) and moments (N·m),
    # including those due to the acceleration of the whole body. The function returns
    # the moment of all loads about the centre of mass (N·m), which is 0 if the friction
    # moment acts.
    solid = model.solid
    body = workspace.body
    friction = workspace.friction
    load = workspace.load
    mass = solid.mass
    n = mass.shape[0]
    weight = 0.0
    fx = 0.0
    fy = 0.0
    moment = 0.0
    total_friction_moment = 0.0
    for i in range(n):
        c = body[COS, i]
        s = body[SIN, i]
        x = body[X, i]
        y = body[Y, i]
        floor_x = friction[i, 0] * c - friction[i, 1] * s
        floor_y = friction[i, 0] * s + friction[i, 1] * c
        load[i, 0] = mass[i] * load[i, 0] - floor_x
        load[i, 1] = mass[i] * load[i, 1] - floor_y
        load[i, 2] = solid.inertia[i] * load[i, 2] - friction[i, 2]
        weight = weight + mass[i]
        fx = fx + load[i, 0]
        fy = fy + load[i, 1]
        moment += x * load[i, 1] - y * load[i, 0] + load[i, 2]
        total_friction_moment += x * floor_y - y * floor_x + friction[i, 2]
    remainder = 0.0 if model.friction_moment else -total_friction_moment
    ax = -fx / weight
    ay = -fy / weight
    alpha = (remainder - moment) / inertia
    for i in range(n):
        load[i, 0] += mass[i] * (ax - alpha * body[Y, i])
        load[i, 1] += mass[i] * (ay + alpha * body[X, i])
        load[i, 2] += solid.inertia[i] * alpha
    return remainder


@kernel_only
def _sum_moments(workspace, remainder, torque):  # type: ignore[no-untyped-def]
    # The moment `remainder` of all loads about the centre of mass (N·m) does work,
    # because a virtual bend at constant mean heading rotates the head.
    chords = workspace.chords
    load = workspace.load
    n = load.shape[0]
    fx = fy = moment = 0.0
    for j in range(n - 2, -1, -1):
        fx = fx + load[j + 1, 0]
        fy = fy + load[j + 1, 1]
        moment = moment + load[j + 1, 2]
        # With the symbols of the module docstring, `arm` is L e × F, and `lengthening`
        # is L' F · e.
        arm = chords[j, _SPAN_X] * fy - chords[j, _SPAN_Y] * fx
        lengthening = chords[j, _DERIVATIVE_X] * fx + chords[j, _DERIVATIVE_Y] * fy
        torque[j] = arm / 2 - lengthening - moment + (n - 1 - j) / n * remainder
        moment -= arm


GAMMA = 1 - math.sqrt(0.5)
"""Diagonal coefficient γ of SDIRK2, which has stages at γ h and h, dimensionless."""

# Indices into the state.
STATE_X = 0  # Centre of mass, m.
STATE_Y = 1
HEADING = 2  # Mean heading, rad.
STATE_VX = 3  # Velocity of the centre of mass, world frame, m/s.
STATE_VY = 4
MOMENT = 5  # Angular momentum L, kg·m²/s.
ENERGY_LOSS = 6  # Dissipated energy plus the increase of potential energy, J.
STATES = 7

SPEED_LIMIT = 100.0
"""Speed of the centre of mass at which a solution counts as diverged, m/s."""

_NEWTON_STEPS = 100  # Maximum number of Newton iterations per stage.
_NEWTON_TOLERANCE = 1e-8  # Velocity tolerance at a time unit of 1, m/s.
_NEWTON_ARM = 0.1
"""Lever arm that converts a yaw rate to a velocity, at a length unit of 1, m."""
_OVERSHOOT = 0.1
"""Maximum derivative beyond the minimum, relative to that before the Newton step."""


@inlined
def is_too_long(derivative_before, derivative_after):  # type: ignore[no-untyped-def]
    """Return whether a Newton step went too far beyond the minimum of the potential."""
    return derivative_after < -_OVERSHOOT * derivative_before


@inlined
def shorter_fraction(derivative_before, derivative_after):  # type: ignore[no-untyped-def]
    """Estimate the Newton step fraction, 0.1 to 0.7, at which the derivative is 0."""
    return min(
        max(derivative_before / (derivative_before - derivative_after), 0.1), 0.7
    )


@kernel_only
def _solve3(a, b, c, right):  # type: ignore[no-untyped-def]
    p = right.x
    q = right.y
    r = right.yaw
    c0 = b.y * c.yaw - b.yaw * c.y
    c1 = b.yaw * c.x - b.x * c.yaw
    c2 = b.x * c.y - b.y * c.x
    scale = 1 / (a.x * c0 + a.y * c1 + a.yaw * c2)
    return Twist(
        scale
        * (p * c0 + q * (a.yaw * c.y - a.y * c.yaw) + r * (a.y * b.yaw - a.yaw * b.y)),
        scale
        * (p * c1 + q * (a.x * c.yaw - a.yaw * c.x) + r * (a.yaw * b.x - a.x * b.yaw)),
        scale * (p * c2 + q * (a.y * c.x - a.x * c.y) + r * (a.x * b.y - a.y * b.x)),
    )


@kernel_only
def _rotate(c, s, angle):  # type: ignore[no-untyped-def]
    if abs(angle) > 0.1:  # For smaller angles (rad), the series is exact to 1e-17.
        dc = math.cos(angle)
        ds = math.sin(angle)
    else:
        p = angle * angle
        dc = 1 - p / 2 * (1 - p / 12 * (1 - p / 30 * (1 - p / 56)))
        ds = angle * (1 - p / 6 * (1 - p / 20 * (1 - p / 42 * (1 - p / 72))))
    return c * dc - s * ds, s * dc + c * ds


@kernel_only
def copy(values, out):  # type: ignore[no-untyped-def]
    """Copy an array without the overlap check of slice assignments in numba."""
    for j in range(out.shape[0]):
        out[j] = values[j]


@inlined
def is_slow(state):  # type: ignore[no-untyped-def]
    """Return whether both velocity components are below `SPEED_LIMIT` and not NaN."""
    return abs(state[STATE_VX]) < SPEED_LIMIT and abs(state[STATE_VY]) < SPEED_LIMIT


@inlined
def record(state, velocity, marks, done, mark, samples):  # type: ignore[no-untyped-def]
    """Copy state and velocity to all samples that are due after `done` steps.

    Args:
        state: state after the step.
        velocity: velocities after the step.
        marks: number of steps before each sample, ascending.
        done: number of completed steps.
        mark: index of the first sample that has not been recorded.
        samples: output for states and velocities.

    Returns:
        Index of the first sample that has not been recorded after the copy.
    """
    while mark < marks.shape[0] and marks[mark] == done:
        copy(state, samples.states[mark])
        copy(velocity, samples.velocities[mark])
        mark += 1
    return mark


class _StageEquation(NamedTuple):
    # Equation of an integrator stage, momentum = known momentum + a · force, with the
    # implicit step a = γ h (s). `weight`, `inertia` and `moment` are the terms M (kg),
    # I (kg·m²) and h (kg·m²/s) of the module docstring. The known velocity in the world
    # frame (m/s) and the known angular momentum (kg·m²/s) exclude the effect of
    # friction. `acts` is 1 if the friction moment acts, and 0 otherwise.

    a: float
    weight: float
    inertia: float
    moment: float
    known_x: float
    known_y: float
    known_moment: float
    acts: float


@inlined
def _residual(equation, u, c, s, force):  # type: ignore[no-untyped-def]
    a = equation.a
    weight = equation.weight
    # (bx, by) is the known velocity in the frame of the mean heading.
    bx = equation.known_x * c + equation.known_y * s
    by = equation.known_y * c - equation.known_x * s
    turning = equation.inertia * u.yaw + equation.moment
    return Twist(
        weight * (u.x - bx) - a * force.x,
        weight * (u.y - by) - a * force.y,
        turning - equation.known_moment - a * equation.acts * force.moment,
    )


@inlined
def _newton_step(equation, residual, c, s, force):  # type: ignore[no-untyped-def]
    a = equation.a
    acts = equation.acts
    weight = equation.weight
    bx = equation.known_x * c + equation.known_y * s
    by = equation.known_y * c - equation.known_x * s
    return _solve3(
        Twist(weight - a * force.xx, -a * force.xy, -a * (force.xz + weight * by)),
        Twist(-a * force.yx, weight - a * force.yy, -a * (force.yz - weight * bx)),
        Twist(
            -a * acts * force.zx,
            -a * acts * force.zy,
            equation.inertia - a * acts * force.zz,
        ),
        residual,
    )


@inlined
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a.x * b.x + a.y * b.y + a.yaw * b.yaw


@inlined
def _moved(u, fraction, step):  # type: ignore[no-untyped-def]
    return Twist(
        u.x + fraction * step.x, u.y + fraction * step.y, u.yaw + fraction * step.yaw
    )


class _Heading(NamedTuple):
    cos: float
    sin: float
    ahead: float


@kernel_only
def _stage(stage, a, bends, heading, model, workspace):  # type: ignore[no-untyped-def]
    # Solves Y = known + a f(Y) and returns whether the Newton method converged. The
    # known part is in `workspace.after`. The solution replaces the first guess of the
    # velocities in `workspace.guess`.
    solid = model.solid
    floor = model.floor
    known = workspace.after
    guess = workspace.guess
    acts = 1.0 if model.friction_moment else 0.0
    inertia, moment = pose_body(
        bends.bend[stage], bends.rate[stage], solid, workspace.body
    )
    known_x = known[STATE_VX] + a * floor.pull_x
    known_y = known[STATE_VY] + a * floor.pull_y
    equation = _StageEquation(
        a, solid.weight, inertia, moment, known_x, known_y, known[MOMENT], acts
    )
    u = Twist(guess[0], guess[1], guess[2])
    step = Twist(0.0, 0.0, 0.0)
    step_fraction = 0.0  # Executed fraction of the latest Newton step.
    derivative_before = 0.0  # Derivative of the potential at the start of that step.
    converged = False
    power = 0.0
    # The mean heading at the end of the stage depends on the unknown yaw rate.
    c, s = _rotate(heading.cos, heading.sin, heading.ahead + a * u.yaw)
    tolerance = _NEWTON_TOLERANCE * floor.unit
    arm = _NEWTON_ARM * floor.unit * floor.unit
    for _ in range(_NEWTON_STEPS):
        force = forces_and_derivatives(workspace.body, solid.mass, u, floor)
        power = force.power + (1 - acts) * force.moment * u.yaw
        residual = _residual(equation, u, c, s, force)
        derivative_after = _dot(residual, step)
        if is_too_long(derivative_before, derivative_after):
            fraction = step_fraction * shorter_fraction(
                derivative_before, derivative_after
            )
            undone = step_fraction - fraction
            u = _moved(u, undone, step)
            c, s = _rotate(c, s, a * undone * step.yaw)
            step_fraction = fraction
            continue
        step = _newton_step(equation, residual, c, s, force)
        step_fraction = 1.0
        derivative_before = _dot(residual, step)
        u = _moved(u, -1.0, step)
        c, s = _rotate(c, s, -a * step.yaw)
        if abs(step.x) + abs(step.y) + arm * abs(step.yaw) < tolerance:
            converged = True
            break
    guess[0] = u.x
    guess[1] = u.y
    guess[2] = u.yaw
    _fill_rates(equation, known, c, s, u, power, floor, workspace.rates[stage])
    return converged


@inlined
def _fill_rates(equation, known, c, s, u, power, floor, k):  # type: ignore[no-untyped-def]
    # The stage equation Y = known + a k gives the rates k = f(Y).
    a = equation.a
    k[STATE_X] = u.x * c - u.y * s
    k[STATE_Y] = u.x * s + u.y * c
    k[HEADING] = u.yaw
    k[STATE_VX] = (k[STATE_X] - known[STATE_VX]) / a
    k[STATE_VY] = (k[STATE_Y] - known[STATE_VY]) / a
    turning = equation.inertia * u.yaw + equation.moment
    k[MOMENT] = (turning - equation.known_moment) / a
    pull = floor.pull_x * k[STATE_X] + floor.pull_y * k[STATE_Y]
    k[ENERGY_LOSS] = power - equation.weight * pull


class StepArrays(NamedTuple):
    """Work arrays of `step` for N connectors.

    Attributes:
        body: poses and velocities of the connectors, shape (ROWS, N).
        rates: time derivatives of the state at the stages, shape (2, STATES).
        after: state at the end of a step, shape (STATES,).
        guess: velocity in the body frame (m/s) and yaw rate (rad/s), shape (3,).
        pace: time derivative of `guess`, used to extrapolate the first guess of the
            Newton method, shape (3,).
    """

    body: np.ndarray
    rates: np.ndarray
    after: np.ndarray
    guess: np.ndarray
    pace: np.ndarray

    @classmethod
    def of(cls, n: int) -> StepArrays:
        """Allocate the arrays for n connectors."""
        return cls(*map(np.zeros, [(ROWS, n), (2, STATES), (STATES,), (3,), (3,)]))


@kernel_only
def step(state, h, bends, model, workspace):  # type: ignore[no-untyped-def]
    """Compute an SDIRK2 step and return whether both stages converged.

    Args:
        state: state at the start, shape (STATES,).
        h: length of the step, s.
        bends: bends and rates at the two stages, shape (2, segments).
        model: constants of body and floor.
        workspace: work arrays. The step writes its final state to `after` and the
            derivatives at the stages to `rates`. It also replaces the initial values
            of `guess` and `pace` by the final values.
    """
    u = workspace.guess
    pace = workspace.pace
    after = workspace.after
    a = GAMMA * h
    between = (1 - GAMMA) * h
    solved = True
    turned = 0.0
    c = math.cos(state[HEADING])
    s = math.sin(state[HEADING])
    copy(state, after)
    for stage in range(2):
        # The Newton method starts from linearly extrapolated velocities and therefore
        # needs only half as many iterations.
        lead, rest = (a, between) if stage == 0 else (between, a)
        x = u[0]
        y = u[1]
        z = u[2]
        for j in range(3):
            u[j] += pace[j] * lead
        solved &= _stage(stage, a, bends, _Heading(c, s, turned), model, workspace)
        rate = workspace.rates[stage]
        for j in range(STATES):
            after[j] += rest * rate[j]
        pace[0] = (u[0] - x) / lead
        pace[1] = (u[1] - y) / lead
        pace[2] = (u[2] - z) / lead
        turned = between * rate[HEADING]
    return solved


class Observation(NamedTuple):
    """Observable quantities of several states in the world frame.

    Attributes:
        position: positions of the connectors, shape (samples, N, 2), m.
        connector_heading: headings of the connectors, shape (samples, N), rad.
        force: force exerted by the floor on the connectors, shape (samples, N, 2), N.
        energy: kinetic energy, shape (samples,), J.
    """

    position: np.ndarray
    connector_heading: np.ndarray
    force: np.ndarray
    energy: np.ndarray


def observe(
    states: np.ndarray,
    velocities: np.ndarray,
    bends: Bends,
    solid: BodyParameters,
    floor: FloorFriction,
) -> Observation:
    """Compute the observable quantities of several states.

    Args:
        states: states with the entries `STATE_X` to `ENERGY_LOSS`, shape (samples,
            STATES or more).
        velocities: velocity of the centre of mass in the mean-heading frame (m/s) and
            yaw rate (rad/s), shape (samples, 3 or more).
        bends: bends and rates, shape (samples, segments).
        solid: constants of the body.
        floor: friction parameters of the floor.
    """
    count = len(states)
    n = len(solid.mass)
    shapes = [(count, n, 2), (count, n), (count, n, 2), (count,)]
    out = Observation(*map(np.zeros, shapes))
    # All models pass contiguous arrays, so numba compiles the kernel only once.
    bends = Bends(*map(np.ascontiguousarray, bends))
    body = np.zeros((ROWS, n))
    _observe(states, velocities, bends, solid, floor, out, body, np.zeros((n, 3)))
    return out


@compiled
def _observe(states, velocities, bends, solid, floor, out, body, friction):  # type: ignore[no-untyped-def]
    angles = bends.bend
    rates = bends.rate
    n = solid.mass.shape[0]
    position = out.position
    connector_heading = out.connector_heading
    force = out.force
    energy = out.energy
    for k in range(states.shape[0]):
        u = velocities[k]
        pose_body(angles[k], rates[k], solid, body)
        fill_forces(body, solid.mass, u, floor, friction)
        heading = states[k, HEADING]
        c = math.cos(heading)
        s = math.sin(heading)
        angle = heading
        for j in range(n - 1):
            angle += (n - 1 - j) / n * angles[k, j]
        energy[k] = 0.0
        for i in range(n):
            angle -= angles[k, i - 1] if i > 0 else 0.0
            connector_heading[k, i] = angle
            x = body[X, i]
            y = body[Y, i]
            position[k, i, 0] = states[k, STATE_X] + c * x - s * y
            position[k, i, 1] = states[k, STATE_Y] + s * x + c * y
            along_c = math.cos(angle)
            along_s = math.sin(angle)
            force[k, i, 0] = friction[i, 0] * along_c - friction[i, 1] * along_s
            force[k, i, 1] = friction[i, 0] * along_s + friction[i, 1] * along_c
            vx = u[0] - u[2] * y + body[VX, i]
            vy = u[1] + u[2] * x + body[VY, i]
            spin = u[2] + body[SPIN, i]
            energy[k] += (
                solid.mass[i] * (vx * vx + vy * vy) + solid.inertia[i] * spin * spin
            ) / 2
