r"""Compiled kernels of the models with prescribed bends (`complete`, `simplified`).

**Forward dynamics.** Point masses m_i are at the connectors, and the chambers prescribe
the bends q(t); the unknown is the pose of the body. Let ρ_i(q) and φ_i(q) be position
and heading of connector i relative to the centre of mass r_c, in the frame of the mean
heading θ. Then

$$ M \dot v = \sum f_i, \qquad \dot L = \sum \bigl(r_i - r_c\bigr) \times f_i + n_i, \qquad
   L = I(q)\,\dot\theta + h(q, \dot q), $$

with I = Σ m_i |ρ_i|² + J_i, h = Σ m_i ρ_i × ρ̇_i + J_i φ̇_i, the moment of inertia J_i
of a connector (0 for point masses), the friction force f_i, and the yaw moment n_i of
its wheels. This is Eq. 11 multiplied by eᵀ, which cancels the segment torques. With the
angular momentum L as a state, the scheme does not need q̈. Jumps of q̈ at valve events
therefore do not reduce its order.

Friction is stiff. The three velocities are therefore solved implicitly by the
two-stage, second-order, L-stable SDIRK method of Alexander (1977), with Newton's method
in each stage. Friction has a convex potential, whose slope along a Newton step shows
whether the step was too long. `steps` chooses the lengths of the time steps.

**Inverse dynamics.** The moments of the segments for given bends (`inverse_dynamics`)
follow from the recursive Newton–Euler algorithm. From head to tail, it computes the
accelerations a_i, ε_i of the connectors with a fixed head and a constant rate of the
mean heading. The balance of forces and moments gives the acceleration a, α of the whole
body,

$$ M a = \sum f_i - m_i a_i, \qquad
   I \alpha = \sum n_i - J_i \varepsilon_i + \rho_i \times (f_i - m_i a_i). $$

From tail to head, it sums the force F_j and the moment N_j about the rear end of
segment j that act on all connectors behind it. A massless segment with the chord L e,
along the mean heading of its ends, does only the work T_j δq_j:

$$ T_j = -L'\, F_j \cdot e + \tfrac12 L\, e \times F_j - N_j. $$

This is Eq. 11 solved for T with a cost linear in the number of segments.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, kernel_only
from srs_twin.plants.analytical.floor import (
    FloorFriction,
    fill_forces,
    forces_and_slopes,
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

# Columns of the array of chords.
_SLOPE = 0  # L' e, two columns, m/rad
_SPAN = 2  # L e, two columns, m
_CHORD_COLUMNS = 4


def inverse_dynamics(
    velocities: np.ndarray,
    trace: Trace,
    model: tuple[BodyParameters, FloorFriction, bool],
    torque: np.ndarray,
) -> None:
    """Fill the net moments of the segments for prescribed bends.

    Args:
        velocities: velocity of the centre of mass in the mean-heading frame (m/s) and
            yaw rate (rad/s), shape (samples, 3).
        trace: trace of the chambers, whose free bends are the bends.
        model: body, floor, and whether the friction moment acts.
        torque: out, shape (samples, segments), N·m.
    """
    n = len(model[0].mass)
    work = (
        np.zeros((ROWS, n)),
        np.zeros((n, 3)),
        np.zeros((n - 1, _CHORD_COLUMNS)),
        np.zeros((n, 3)),
    )
    bends = trace.bend, trace.bend_rate, trace.bend_acceleration
    _inverse_dynamics(velocities, bends, model, torque, work)


@compiled
def _inverse_dynamics(velocities, bends, model, torque, work):  # type: ignore[no-untyped-def]
    """Fill the moments, see `inverse_dynamics`."""
    (q, rates, accelerations), (body, friction, chords, load) = bends, work
    solid, floor, friction_moment = model
    for k in range(q.shape[0]):
        inertia, _ = pose_body(q[k], rates[k], solid, body)
        fill_forces(body, solid.mass, velocities[k], floor, friction)
        _fill_accelerations(
            body,
            q[k],
            rates[k],
            accelerations[k],
            velocities[k, 2],
            solid,
            chords,
            load,
        )
        remainder = _balance_loads(
            body, inertia, solid, friction_moment, friction, load
        )
        _sum_moments(chords, load, remainder, torque[k])


@kernel_only
def _fill_accelerations(body, q, rate, acceleration, yaw, solid, chords, motion):  # type: ignore[no-untyped-def]  # noqa: D417
    """Fill the accelerations of the connectors, and the chords, from head to tail.

    Args:
        body: posed body, shape (ROWS, N).
        q, rate, acceleration: bends and their derivatives, shape (segments,), rad,
            rad/s, rad/s².
        yaw: rate of the mean heading, rad/s.
        solid: the body.
        chords: out, L' e (m/rad) and L e (m), shape (segments, _CHORD_COLUMNS).
        motion: out, shape (N, 3): accelerations of the positions (m/s²), relative to
            the head, and of the headings (rad/s²), with a constant rate of their mean.
    """
    n = solid.mass.shape[0]
    alpha = 0.0
    for j in range(n - 1):
        alpha += (n - 1 - j) / n * acceleration[j]
    x = y = 0.0
    motion[0, 0] = x
    motion[0, 1] = y
    motion[0, 2] = alpha
    for j in range(n - 1):
        # The direction of a chord is half a bend from the heading of either end.
        half_c, half_s, span, slope, curvature = chord_terms(q[j], solid, j)
        c = body[COS, j] * half_c + body[SIN, j] * half_s
        s = body[SIN, j] * half_c - body[COS, j] * half_s
        chord_spin = yaw + body[SPIN, j] - rate[j] / 2
        along = (
            slope * acceleration[j]
            + curvature * rate[j] * rate[j]
            - span * chord_spin * chord_spin
        )
        across = span * (alpha - acceleration[j] / 2) + 2 * slope * rate[j] * chord_spin
        x = x - along * c + across * s
        y = y - along * s - across * c
        alpha = alpha - acceleration[j]
        motion[j + 1, 0] = x
        motion[j + 1, 1] = y
        motion[j + 1, 2] = alpha
        chords[j, _SLOPE] = slope * c
        chords[j, _SLOPE + 1] = slope * s
        chords[j, _SPAN] = span * c
        chords[j, _SPAN + 1] = span * s


@kernel_only
def _balance_loads(body, inertia, solid, friction_moment, friction, load):  # type: ignore[no-untyped-def]
    """Convert accelerations of the connectors to the loads on them, with those of the whole body.

    Args:
        body: posed body, shape (ROWS, N).
        inertia: I, kg·m².
        solid: the body.
        friction_moment: whether the moment of friction about the centre of mass acts.
        friction: friction on the connectors (`fill_forces`), shape (N, 3).
        load: in place; on entry the accelerations, on return forces (N) and moments
            (N·m), shape (N, 3).

    Returns:
        Moment of the loads about the centre of mass, N·m; 0 if the friction moment
        acts.
    """
    mass = solid.mass
    n = solid.mass.shape[0]
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
    remainder = 0.0 if friction_moment else -total_friction_moment
    ax = -fx / weight
    ay = -fy / weight
    alpha = (remainder - moment) / inertia
    for i in range(n):
        load[i, 0] += mass[i] * (ax - alpha * body[Y, i])
        load[i, 1] += mass[i] * (ay + alpha * body[X, i])
        load[i, 2] += solid.inertia[i] * alpha
    return remainder


@kernel_only
def _sum_moments(chords, load, remainder, torque):  # type: ignore[no-untyped-def]
    """Fill the moments of the segments from tail to head.

    Args:
        chords: as filled by `_fill_accelerations`.
        load: load on each connector, as filled by `_balance_loads`.
        remainder: moment of the loads about the centre of mass, N·m. A bend rotates the
            head, and with it the whole body, so that the mean heading stays constant.
        torque: out, shape (segments,), N·m.
    """
    n = load.shape[0]
    fx = fy = moment = 0.0
    for j in range(n - 2, -1, -1):
        fx = fx + load[j + 1, 0]
        fy = fy + load[j + 1, 1]
        moment = moment + load[j + 1, 2]
        arm = chords[j, _SPAN] * fy - chords[j, _SPAN + 1] * fx
        lengthening = chords[j, _SLOPE] * fx + chords[j, _SLOPE + 1] * fy
        torque[j] = arm / 2 - lengthening - moment + (n - 1 - j) / n * remainder
        moment -= arm


GAMMA = 1 - math.sqrt(0.5)
"""Diagonal γ of the SDIRK2 method, 1; its stages are at γ h and h."""

# Indices into the state.
STATE_X = 0  # centre of mass, m
STATE_Y = 1
HEADING = 2  # mean heading, rad
STATE_VX = 3  # velocity of the centre of mass, world frame, m/s
STATE_VY = 4
MOMENT = 5  # angular momentum L, kg·m²/s
ENERGY_LOSS = 6  # energy lost to friction, and potential energy gained, J
STATES = 7

SPEED_LIMIT = 100.0
"""Speed above which a state is not plausible, m/s."""

_NEWTON_STEPS = 100  # largest number of iterations of a stage
_NEWTON_TOLERANCE = 1e-8  # tolerance of the velocities at a time unit of 1, m/s
_NEWTON_ARM = (
    0.1  # lever arm that turns the yaw rate into a velocity, at a length unit of 1, m
)
_OVERSHOOT = 0.1  # ratio of the slopes after and before a Newton step above which the step was too long, 1


@kernel_only
def _solve3(a, b, c, p, q, r):  # type: ignore[no-untyped-def]
    """Solve the system with the rows a, b, c and the right side p, q, r by Cramer's rule."""
    c0 = b[1] * c[2] - b[2] * c[1]
    c1 = b[2] * c[0] - b[0] * c[2]
    c2 = b[0] * c[1] - b[1] * c[0]
    scale = 1 / (a[0] * c0 + a[1] * c1 + a[2] * c2)
    return (
        scale
        * (p * c0 + q * (a[2] * c[1] - a[1] * c[2]) + r * (a[1] * b[2] - a[2] * b[1])),
        scale
        * (p * c1 + q * (a[0] * c[2] - a[2] * c[0]) + r * (a[2] * b[0] - a[0] * b[2])),
        scale
        * (p * c2 + q * (a[1] * c[0] - a[0] * c[1]) + r * (a[0] * b[1] - a[1] * b[0])),
    )


@kernel_only
def _rotate(c, s, angle):  # type: ignore[no-untyped-def]
    """Return cosine and sine of an angle plus an increment; small increments use a series."""
    if abs(angle) > 0.1:  # rad; up to it the neglected terms are below 1e-17
        dc = math.cos(angle)
        ds = math.sin(angle)
    else:
        p = angle * angle
        dc = 1 - p / 2 * (1 - p / 12 * (1 - p / 30 * (1 - p / 56)))
        ds = angle * (1 - p / 6 * (1 - p / 20 * (1 - p / 42 * (1 - p / 72))))
    return c * dc - s * ds, s * dc + c * ds


@kernel_only
def copy(values, out):  # type: ignore[no-untyped-def]
    """Copy one array into another.

    A loop: numba would check an assignment to a slice for overlap.
    """
    for j in range(out.shape[0]):
        out[j] = values[j]


@kernel_only
def _stage(known, a, q, rate, heading, model, u, k, body):  # type: ignore[no-untyped-def]  # noqa: D417
    """Solve one implicit stage Y = known + a f(Y) from the guess `u`; fill k = f(Y).

    Args:
        known: shape (STATES,).
        a: γ h, s.
        q, rate: bends (rad) and bend rates (rad/s) at the stage, shape (segments,).
        heading: cosine and sine of a reference heading, and the heading of `known`
            relative to it, rad.
        model: body, floor, and whether the friction moment acts.
        u: velocity in the body frame and yaw rate, in place, shape (3,).
        k: out, shape (STATES,).
        body: work array, shape (ROWS, N).

    Returns:
        Whether Newton's method converged.
    """
    solid, floor, friction_moment = model
    weight = solid.weight
    acts = 1.0 if friction_moment else 0.0
    inertia, moment = pose_body(q, rate, solid, body)
    known_x = known[STATE_VX] + a * floor.pull_x
    known_y = known[STATE_VY] + a * floor.pull_y
    known_moment = known[MOMENT]
    x = u[0]
    y = u[1]
    z = u[2]
    step_x = step_y = step_z = 0.0
    step_share = 0.0  # fraction of the latest Newton step that has been made
    slope_before = 0.0  # slope of the potential along that step at its start
    converged = False
    power = 0.0
    c, s = _rotate(heading[0], heading[1], heading[2] + a * z)
    tolerance = _NEWTON_TOLERANCE * floor.unit
    arm = _NEWTON_ARM * floor.unit * floor.unit
    for _ in range(_NEWTON_STEPS):
        bx = known_x * c + known_y * s
        by = known_y * c - known_x * s
        force, slope, power = forces_and_slopes(body, solid.mass, x, y, z, floor)
        power += (1 - acts) * force[2] * z
        residual_x = weight * (x - bx) - a * force[0]
        residual_y = weight * (y - by) - a * force[1]
        residual_z = inertia * z + moment - known_moment - a * acts * force[2]
        slope_after = residual_x * step_x + residual_y * step_y + residual_z * step_z
        if slope_after < -_OVERSHOOT * slope_before:
            # The step overshot the minimum, across a kink of the friction law: shorten
            # it.
            back = step_share * min(
                max(slope_before / (slope_before - slope_after), 0.1), 0.7
            )
            x = x + (step_share - back) * step_x
            y = y + (step_share - back) * step_y
            z = z + (step_share - back) * step_z
            c, s = _rotate(c, s, a * (step_share - back) * step_z)
            step_share = back
            continue
        xx, xy, xz, yy, yz, zz, yx, zx, zy = slope
        step_x, step_y, step_z = _solve3(
            (weight - a * xx, -a * xy, -a * (xz + weight * by)),
            (-a * yx, weight - a * yy, -a * (yz - weight * bx)),
            (-a * acts * zx, -a * acts * zy, inertia - a * acts * zz),
            residual_x,
            residual_y,
            residual_z,
        )
        step_share = 1.0
        slope_before = residual_x * step_x + residual_y * step_y + residual_z * step_z
        x = x - step_x
        y = y - step_y
        z = z - step_z
        c, s = _rotate(c, s, -a * step_z)
        if abs(step_x) + abs(step_y) + arm * abs(step_z) < tolerance:
            converged = True
            break
    u[0] = x
    u[1] = y
    u[2] = z
    # The equation of the stage gives f(Y) without a further evaluation.
    k[STATE_X] = x * c - y * s
    k[STATE_Y] = x * s + y * c
    k[HEADING] = z
    k[STATE_VX], k[STATE_VY] = (
        (k[STATE_X] - known[STATE_VX]) / a,
        (k[STATE_Y] - known[STATE_VY]) / a,
    )
    k[MOMENT] = (inertia * z + moment - known_moment) / a
    k[ENERGY_LOSS] = power - weight * (
        floor.pull_x * k[STATE_X] + floor.pull_y * k[STATE_Y]
    )
    return converged


@kernel_only
def step(state, h, bends, rates, model, u, drift, k, after, body):  # type: ignore[no-untyped-def]
    """Make one step of SDIRK2.

    Args:
        state: at the start, shape (STATES,).
        h: length of the step, s.
        bends: at the two stages, shape (2, segments), rad.
        rates: bend rates at the two stages, shape (2, segments), rad/s.
        model: body, floor, and whether the friction moment acts.
        u: in place, velocity in the body frame (m/s) and yaw rate (rad/s), shape (3,).
        drift: in place, rate of change of u for the first guesses of Newton's method,
            shape (3,).
        k: out, rates of the state at the stages, shape (2, STATES).
        after: out, state at the end, shape (STATES,).
        body: work array, shape (ROWS, N).

    Returns:
        Whether both stages converged.
    """
    a = GAMMA * h
    between = (1 - GAMMA) * h
    solved = True
    turned = 0.0
    c = math.cos(state[HEADING])
    s = math.sin(state[HEADING])
    copy(state, after)
    for stage in range(2):
        # Linear extrapolation of the velocities between stages saves half of the Newton
        # iterations.
        lead, rest = (a, between) if stage == 0 else (between, a)
        x = u[0]
        y = u[1]
        z = u[2]
        for j in range(3):
            u[j] += drift[j] * lead
        rate = k[stage]
        solved &= _stage(
            after, a, bends[stage], rates[stage], (c, s, turned), model, u, rate, body
        )
        for j in range(STATES):
            after[j] += rest * rate[j]
        drift[0] = (u[0] - x) / lead
        drift[1] = (u[1] - y) / lead
        drift[2] = (u[2] - z) / lead
        turned = between * rate[HEADING]
    return solved


class Observation(NamedTuple):
    """Observable quantities of several states in the world frame.

    Attributes:
        position: positions of the connectors, shape (samples, N, 2), m.
        theta: headings of the connectors, shape (samples, N), rad.
        force: force of the floor on the connectors, shape (samples, N, 2), N.
        energy: kinetic energy, shape (samples,), J.
    """

    position: np.ndarray
    theta: np.ndarray
    force: np.ndarray
    energy: np.ndarray


def observe(
    states: np.ndarray,
    velocities: np.ndarray,
    bends: tuple[np.ndarray, np.ndarray],
    solid: BodyParameters,
    floor: FloorFriction,
) -> Observation:
    """Return the observable quantities.

    Args:
        states: shape (samples, STATES or more).
        velocities: velocity of the centre of mass in the mean-heading frame (m/s) and
            yaw rate (rad/s), shape (samples, 3 or more).
        bends: bends (rad) and bend rates (rad/s), shape (samples, segments).
        solid: the body.
        floor: the floor.
    """
    count = len(states)
    n = len(solid.mass)
    out = Observation(
        *map(np.zeros, [(count, n, 2), (count, n), (count, n, 2), (count,)])
    )
    # Contiguous arrays have one type, so that the kernel is compiled once for all
    # models.
    angles, rates = map(np.ascontiguousarray, bends)
    _observe(
        states,
        velocities,
        (angles, rates),
        solid,
        floor,
        out,
        (np.zeros((ROWS, n)), np.zeros((n, 3))),
    )
    return out


@compiled
def _observe(states, velocities, bends, solid, floor, out, work):  # type: ignore[no-untyped-def]
    """Fill the observable quantities, see `observe`."""
    (angles, rates), (body, friction), n = bends, work, solid.mass.shape[0]
    position = out.position
    theta = out.theta
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
            theta[k, i] = angle
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
