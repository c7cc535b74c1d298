r"""Newton's method for the implicit friction forces of one time step.

The module `contact_loaded` derives the equation of a time step. The engine first
predicts the velocity v̂ at the end of the step from the friction forces f̂_w of the
previous step. The unknown is the velocity correction δ = v − v̂, which depends on the
friction forces f_w of the current step:

$$ r(\delta) = (A + J_n^T R^{-1} J_n)\,\delta - h \sum_w J_w^T \bigl(f_w(u_w) - \hat f_w\bigr) - b = 0, \qquad
   b = h\,\bigl(c(v_-) - c(\bar v)\bigr) + (h D - C)(\hat v - v_-) . $$

**Symbols**

- v₋: generalised velocity at the beginning of the step.
- v̂: generalised velocity at the end of the step, as predicted by the engine.
- v: generalised velocity at the end of the step, v = v̂ + δ.
- v̄: mean velocity of the predicted step, v̄ = (v₋ + v̂)/2.
- h: time step, s.
- A = M + C: joint-space inertia M plus the damping matrix C (`contact_loaded`).
- D: damping matrix of the joints plus h times their stiffness matrix.
- c(v): Coriolis and centrifugal forces.
- w: index of a contact. The wheels precede the collision geoms that may touch an
  obstacle.
- f_w: friction force at contact w, with components along and across the heading, N.
- J_w: Jacobian that maps generalised velocities to the velocity of contact w along and
  across the heading.
- J_n: Jacobian that maps generalised velocities to the normal velocities of the wheels
  that press on the floor.
- R: MuJoCo's regularisation of the normal forces on wheels, 1/kg.
- r: residual of the equation, kg·m/s or kg·m²/s.
- u_w: velocity J_w (v₋ + θ (v − v₋)) of contact w, at which the friction law is
  evaluated.
- θ: time at which friction is evaluated, as a fraction of the time step
  (`_evaluation_fraction`). A sliding contact has θ near 1/2, which gives second-order
  accuracy. A sticking contact has θ near 1. For a wheel, θ is determined by the
  friction across the heading, by the slip speed of the previous step, and by the
  lateral effective mass in a straight snake.

A part of the friction on a wheel accelerates the spin of the wheel (`_SPIN_FORCE`).
This part acts on the connector at the hub, and the rest of the friction acts at the
contact point.

**The Newton matrix** is A + J_nᵀ R⁻¹ J_n − h Σ θ J_wᵀ (∂f_w/∂u_w) J_w. The matrix is
approximate if a wheel spins, because the whole force along the heading is then taken to
act at the hub. This affects only the convergence, not the solution. A contact is
moved only by the joints between the root and its connector. The matrix therefore has
the sparsity pattern of M, and its factorisation produces no fill-in. The derivatives of
the contact forces are 6 × 6 spatial matrices. They are summed from the ends of the
chain to its root and then projected onto the joint axes. The composite-rigid-body
algorithm treats inertias in the same way (Featherstone 2008, Section 6.2).

**Loads.** Friction depends on the normal forces, which in turn depend on δ. The first
Newton step uses the normal forces at v̂. All further Newton steps use the normal forces
that result from the first step.

**Obstacles.** The prediction applies the stored friction f̂_w of a collision geom at
the contact of the previous step, and the residual subtracts it at the current contact.
The two contacts differ only by the motion in one step.

**Convergence.** If the residual is still above the tolerance after the maximum number
of iterations, the last velocity is used without a warning.

The module `object_contacts` adds the contacts of movable objects to the equation.

Because both numba and Warp compile this module, its functions contain only loops and
operations on numbers and named tuples of arrays. For Warp, a floating-point literal
needs a decimal point, and a variable that changes in a loop must be initialised with
`float(...)`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import kernel_only
from srs_twin.plants.twin.engine import mj_factorM, mj_solveM
from srs_twin.plants.twin.mjcf.numerics import LAWS_ON_LOADS, LOADS
from srs_twin.plants.twin.object_contacts import (
    add_object_impulses,
    add_object_jacobian,
    apply_object_friction,
    couple_objects,
    locate_objects,
)
from srs_twin.plants.twin.spatial_algebra import (
    add_product,
    clear,
    dot,
    factor,
    inner,
    point_jacobian,
    project,
    project_jacobian,
    spatial_velocities,
    substitute,
)
from srs_twin.plants.twin.stick_slip import (
    FloorLaw,
    Traction,
    axis_friction,
    rolling_friction,
    skin_friction,
    stick_slip_friction,
)

_MOMENTARY = LOADS.index("instantaneous")
_ACROSS_ONLY = LOADS.index("across")
_WHEEL = LAWS_ON_LOADS.index("wheel")
_ELLIPSE = LAWS_ON_LOADS.index("ellipse")
_COSINE = LAWS_ON_LOADS.index("cosine")

_MAX_ITERATIONS = 30  # Maximum number of Newton steps after the first.
_MAX_TRIALS = 12  # Maximum number of evaluations in a line search.

# The tolerance of the squared residual is the sum of three terms. The first term is
# relative to the squared friction impulse, so that friction is accurate to 1e-7. The
# second term is relative to the largest initial squared residual and allows for
# rounding errors. The third term is absolute, in (kg·m/s)², and has another value in
# Warp (`warp.translation`).
_RELATIVE_TOLERANCE = 1e-14
_ROUNDING_TOLERANCE = 1e-24
_ABSOLUTE_TOLERANCE = 0.0

# A line search ends when the directional derivative has decreased to this fraction of
# its initial value.
_MAX_DERIVATIVE_RATIO = 0.5

# Rows of `Workspace.jacobian`.
_ALONG = 0
_ACROSS = 1
_UP = 2
_NORMAL = 2  # for a collision geom, the direction away from the obstacle
_HUB = 3

# Columns of `Workspace.response`.
_FORCE_ALONG = 0  # N.
_FORCE_ACROSS = 1  # N.
_DERIVATIVE_ALONG = 2  # ∂f_t/∂v_t of force and velocity along the heading, N·s/m.
_OFF_DIAGONAL = 3  # ∂f_t/∂v_lat = ∂f_lat/∂v_t, N·s/m.
_DERIVATIVE_ACROSS = 4  # ∂f_lat/∂v_lat of force and velocity across the heading, N·s/m.
_RIM_SPEED = 5  # Rim speed of a wheel at the time when friction is evaluated, m/s.
_UNLOADING = 6  # Decrease of the normal force due to δ, N.
_SPIN_FORCE = 7  # Part of the force along the heading that spins the wheel, N.

# Third column of `ContactState.force`, after `_FORCE_ALONG` and `_FORCE_ACROSS`.
_STORED_SPIN = 2


class Contacts(NamedTuple):
    """Constants of the C possible contacts of wheels and collision geoms.

    The wheels precede the collision geoms that may touch an obstacle.

    Attributes:
        body: MuJoCo body id of each contact, shape (C,).
        last_dof: index of the last degree of freedom that moves each contact, shape
            (C,).
        centre: centre of each wheel in the frame of its body, shape (wheels, 3), m.
        regularisation: MuJoCo's regularisation R of the normal force, shape (C,), 1/kg.
            R is infinite for collision geoms.
        inverse_effective_mass: inverse effective mass of each contact, shape (C,),
            1/kg. The value for a wheel refers to motion across the heading, and the
            value for a collision geom to motion along the body.
        static_load: normal force at rest, shape (C,), N.
        load_kind: kind of wheel load that the friction law uses, as an index into
            `numerics.LOADS`.
        sensor: index in `sensordata` of the normal force on each wheel or of the
            contact force on each collision geom, shape (C,). The contact force is
            followed by its point of application.
        wheel_radius: radius of the wheels, m.
        obstacle_friction: friction coefficient between collision geoms and obstacles,
            dimensionless.
    """

    wheels: int
    body: np.ndarray
    centre: np.ndarray
    last_dof: np.ndarray
    regularisation: np.ndarray
    inverse_effective_mass: np.ndarray
    static_load: np.ndarray
    load_kind: int
    sensor: np.ndarray
    wheel_radius: float
    floor: FloorLaw
    obstacle_friction: float


class ContactState(NamedTuple):
    """Contact state that one time step passes to the next.

    Attributes:
        force: friction along the heading, friction across the heading, and the part of
            the friction that spins the wheel, shape (C, 3), N.
        rim_speed, slip_speed: circumferential speed of each wheel and slip speed of
            each contact, shape (C,), m/s.
        load: normal force that the friction law uses, shape (C,), N.
    """

    force: np.ndarray
    rim_speed: np.ndarray
    load: np.ndarray
    slip_speed: np.ndarray


class Workspace(NamedTuple):
    """Work arrays of one time step.

    C is the number of contacts, nv the number of degrees of freedom, and nM the number
    of stored entries of M. The module docstring explains the other symbols. In an array
    of shape (nv, 6), each row belongs to the body that a degree of freedom moves.

    Attributes:
        jacobian: spatial vectors of the contact velocity along the heading, across it
            and upwards, and of the hub velocity along the heading, shape (C, 4, 6). At
            a collision geom, the first three directions are horizontal along the
            obstacle's surface, upwards, and away from the obstacle.
        heading: cosine and sine of the heading of each contact, shape (C, 2).
        response: forces and derivatives of the friction law, with the columns
            `_FORCE_ALONG` to `_SPIN_FORCE`, shape (C, 8).
        normal_force: normal force that the engine computed together with v̂, shape
            (C,), N.
        theta: fraction θ of the step at which friction is evaluated, shape (C,).
        step_motion, mid_motion: spatial velocities that correspond to v̂ − v₋ and to
            (v₋ + v̂)/2, shape (nv, 6).
        motion: work array for the spatial velocities due to δ, and for the spatial
            forces exerted by friction, shape (nv, 6).
        impulse: spatial impulses due to the changes of the contact forces, shape (nv,
            6).
        derivative: spatial derivatives of the contact forces, shape (nv, 6, 6).
        inertia, newton_matrix: matrix A and the Newton matrix, shape (nM,). With numba,
            the Newton matrix is stored in the engine's array M and overwrites it.
        v_start, v_predicted, v_change: velocities v₋, v̂ and δ, shape (nv,).
        bias: vector b, shape (nv,), kg·m/s or kg·m²/s.
        residual, trial_residual: residual r, and its value at a trial point of the line
            search, shape (nv,). Before the solve, `residual` holds c(v̄).
        direction: Newton step, shape (nv,).
    """

    jacobian: np.ndarray
    heading: np.ndarray
    response: np.ndarray
    normal_force: np.ndarray
    theta: np.ndarray
    step_motion: np.ndarray
    mid_motion: np.ndarray
    motion: np.ndarray
    impulse: np.ndarray
    derivative: np.ndarray
    inertia: np.ndarray
    newton_matrix: np.ndarray
    v_start: np.ndarray
    v_predicted: np.ndarray
    bias: np.ndarray
    v_change: np.ndarray
    residual: np.ndarray
    trial_residual: np.ndarray
    direction: np.ndarray


def workspace(contacts: int, nv: int, newton_matrix: np.ndarray) -> Workspace:
    """Allocate the work arrays of a time step.

    The argument `newton_matrix` is the array for the Newton matrix, shape (nM,).
    """
    spatial = {
        name: np.zeros((nv, 6))
        for name in ("step_motion", "mid_motion", "motion", "impulse")
    }
    vectors = ("v_start", "v_predicted", "bias", "v_change", "residual")
    return Workspace(
        jacobian=np.zeros((contacts, 4, 6)),
        heading=np.zeros((contacts, 2)),
        response=np.zeros((contacts, 8)),
        normal_force=np.zeros(contacts),
        theta=np.zeros(contacts),
        derivative=np.zeros((nv, 6, 6)),
        inertia=np.zeros_like(newton_matrix),
        newton_matrix=newton_matrix,
        **spatial,
        **{name: np.zeros(nv) for name in (*vectors, "trial_residual", "direction")},
    )


@kernel_only
def apply_stored_friction(engine, contacts, sparsity, state, workspace, h):  # type: ignore[no-untyped-def]
    """Compute the wheel Jacobians and apply the friction of the previous step.

    The function writes the generalised friction forces to `qfrc_applied`.
    """
    _locate_wheels(engine, contacts, workspace)
    _generalised_forces(
        engine.cdof, contacts, sparsity, state.force, workspace, engine.qfrc_applied
    )
    apply_object_friction(engine, sparsity, workspace, h)


@kernel_only
def set_mid_velocity(engine, workspace):  # type: ignore[no-untyped-def]
    """Set `qvel` to the mean velocity (v₋ + v̂)/2 of the predicted step."""
    for i in range(workspace.v_start.shape[0]):
        engine.qvel[i] = 0.5 * (workspace.v_start[i] + workspace.v_predicted[i])


@kernel_only
def solve_friction(engine, contacts, sparsity, state, workspace, h):  # type: ignore[no-untyped-def]
    """Solve for the friction of a step, and set `qvel` to the velocity at its end.

    The workspace must already contain v₋ and v̂, and its array `residual` must contain
    c(v̄). The engine's array `qfrc_bias` must contain c(v₋).
    """
    for i in range(workspace.v_start.shape[0]):
        workspace.bias[i] = h * (engine.qfrc_bias[i] - workspace.residual[i])
        workspace.trial_residual[i] = workspace.v_predicted[i] - workspace.v_start[i]
    add_product(
        sparsity, sparsity.damping_excess, workspace.trial_residual, workspace.bias
    )
    for k in range(workspace.inertia.shape[0]):
        workspace.inertia[k] = engine.M[k] + sparsity.damping[k]
    spatial_velocities(engine.cdof, sparsity, engine.qvel, workspace.mid_motion)
    spatial_velocities(
        engine.cdof, sparsity, workspace.trial_residual, workspace.step_motion
    )
    _read_normal_forces(engine, contacts, workspace)
    locate_objects(engine, sparsity, workspace, h)
    for w in range(contacts.body.shape[0]):
        if w < contacts.wheels:
            mu = contacts.floor.across
        else:
            mu = contacts.obstacle_friction
        # The grip is the friction limit divided by the slip speed of the previous step,
        # N·s/m. A contact with a small grip slides (θ near 1/2), and a contact with a
        # large grip sticks (θ near 1).
        grip = (
            mu
            * workspace.normal_force[w]
            / max(state.slip_speed[w], contacts.floor.slip_speed)
        )
        workspace.theta[w] = _evaluation_fraction(
            h * grip * contacts.inverse_effective_mass[w]
        )
    _newton(engine, contacts, sparsity, state, workspace, h)
    for i in range(workspace.v_start.shape[0]):
        engine.qvel[i] = workspace.v_predicted[i] + workspace.v_change[i]


@kernel_only
def store_friction(contacts, state, workspace, force):  # type: ignore[no-untyped-def]
    """Store the friction for the next step, and return the dissipated power.

    The power of a normal force is computed from the mean velocity of the step. An
    impact stops the body within two steps. The velocity before the impact would
    therefore give up to twice the energy that is dissipated.

    The function writes the force on each contact in the world frame to `force`, shape
    (C, 3), N. For a collision geom, this force excludes the normal force.

    Returns:
        Power that the robot transfers to the floor, to obstacles and to the spin of
        the wheels, W. The part for the spin becomes negative when wheels slow down.
    """
    power = float(0.0)
    for w in range(contacts.body.shape[0]):
        f_t = workspace.response[w, _FORCE_ALONG]
        f_lat = workspace.response[w, _FORCE_ACROSS]
        rim = workspace.response[w, _RIM_SPEED]
        along, across = _contact_velocity(contacts, workspace, w, 0.5)
        power -= f_t * along + f_lat * across
        slip_along = (
            along - rim if contacts.floor.friction_law_index == _WHEEL else along
        )
        state.slip_speed[w] = np.sqrt(slip_along * slip_along + across * across)
        state.force[w, _FORCE_ALONG] = f_t
        state.force[w, _FORCE_ACROSS] = f_lat
        state.force[w, _STORED_SPIN] = workspace.response[w, _SPIN_FORCE]
        # The rim speed at the end of the step is extrapolated from the rim speed at the
        # fraction θ of the step.
        state.rim_speed[w] += (rim - state.rim_speed[w]) / workspace.theta[w]
        c = workspace.heading[w, 0]
        s = workspace.heading[w, 1]
        if w < contacts.wheels:
            force[w, 0] = c * f_t - s * f_lat
            force[w, 1] = s * f_t + c * f_lat
            force[w, 2] = max(
                workspace.normal_force[w] - workspace.response[w, _UNLOADING], 0.0
            )
        else:
            force[w, 0] = c * f_t
            force[w, 1] = s * f_t
            force[w, 2] = f_lat
            if workspace.normal_force[w] > 0.0:
                last = contacts.last_dof[w]
                away = workspace.jacobian[w, _NORMAL]
                velocity = dot(away, workspace.mid_motion[last]) + 0.5 * dot(
                    away, workspace.motion[last]
                )
                power -= workspace.normal_force[w] * velocity
    return power


@kernel_only
def _locate_wheels(engine, contacts, workspace):  # type: ignore[no-untyped-def]
    com = engine.subtree_com[1]
    for w in range(contacts.wheels):
        body = contacts.body[w]
        centre = contacts.centre[w]
        m = engine.xmat[body]
        norm = 1.0 / np.sqrt(m[0] * m[0] + m[3] * m[3])
        c = m[0] * norm
        s = m[3] * norm
        workspace.heading[w, 0] = c
        workspace.heading[w, 1] = s
        x = (
            engine.xpos[body, 0]
            + m[0] * centre[0]
            + m[1] * centre[1]
            + m[2] * centre[2]
            - com[0]
        )
        y = (
            engine.xpos[body, 1]
            + m[3] * centre[0]
            + m[4] * centre[1]
            + m[5] * centre[2]
            - com[1]
        )
        z = (
            engine.xpos[body, 2]
            + m[6] * centre[0]
            + m[7] * centre[1]
            + m[8] * centre[2]
            - com[2]
        )
        z -= contacts.wheel_radius
        point_jacobian(workspace.jacobian[w, _ALONG], x, y, z, c, s, 0.0)
        point_jacobian(workspace.jacobian[w, _ACROSS], x, y, z, -s, c, 0.0)
        point_jacobian(workspace.jacobian[w, _UP], x, y, z, 0.0, 0.0, 1.0)
        # The hub is one wheel radius above the contact, so their Jacobian rows differ
        # only in the rotational components.
        hub = workspace.jacobian[w, _HUB]
        along = workspace.jacobian[w, _ALONG]
        for k in range(6):
            hub[k] = along[k]
        hub[0] = hub[0] - contacts.wheel_radius * s
        hub[1] = hub[1] + contacts.wheel_radius * c


@kernel_only
def _read_normal_forces(engine, contacts, workspace):  # type: ignore[no-untyped-def]
    com = engine.subtree_com[1]
    sensors = engine.sensordata
    for w in range(contacts.body.shape[0]):
        k = contacts.sensor[w]
        if w < contacts.wheels:
            workspace.normal_force[w] = max(sensors[k], 0.0)
            continue
        fx = sensors[k]
        fy = sensors[k + 1]
        normal = np.sqrt(fx * fx + fy * fy)
        workspace.normal_force[w] = normal
        if normal > 0.0:
            c = -fy / normal
            s = fx / normal
            x = sensors[k + 3] - com[0]
            y = sensors[k + 4] - com[1]
            z = sensors[k + 5] - com[2]
            workspace.heading[w, 0] = c
            workspace.heading[w, 1] = s
            point_jacobian(workspace.jacobian[w, _ALONG], x, y, z, c, s, 0.0)
            point_jacobian(workspace.jacobian[w, _ACROSS], x, y, z, 0.0, 0.0, 1.0)
            point_jacobian(workspace.jacobian[w, _NORMAL], x, y, z, s, -c, 0.0)


@kernel_only
def _generalised_forces(cdof, contacts, sparsity, force, workspace, out):  # type: ignore[no-untyped-def]
    clear(workspace.motion)
    for w in range(contacts.body.shape[0]):
        for k in range(6):
            component = (
                force[w, _FORCE_ALONG] * workspace.jacobian[w, _ALONG, k]
                + force[w, _FORCE_ACROSS] * workspace.jacobian[w, _ACROSS, k]
            )
            component += force[w, _STORED_SPIN] * (
                workspace.jacobian[w, _HUB, k] - workspace.jacobian[w, _ALONG, k]
            )
            workspace.motion[contacts.last_dof[w], k] += component
    project(cdof, sparsity, workspace.motion, out)


@kernel_only
def _contact_velocity(contacts, workspace, w, theta):  # type: ignore[no-untyped-def]
    last = contacts.last_dof[w]
    middle = workspace.mid_motion[last]
    step = workspace.step_motion[last]
    change = workspace.motion[last]
    # The velocity u is J_w (v₋ + θ (v − v₋)) = J_w ((v₋ + v̂)/2 + (θ − 1/2)(v̂ − v₋) +
    # θ δ). The array `motion` contains the spatial velocities due to δ.
    along = workspace.jacobian[w, _ALONG]
    across = workspace.jacobian[w, _ACROSS]
    shift = theta - 0.5
    return (
        dot(along, middle) + shift * dot(along, step) + theta * dot(along, change),
        dot(across, middle) + shift * dot(across, step) + theta * dot(across, change),
    )


@kernel_only
def _friction_load(contacts, workspace, w):  # type: ignore[no-untyped-def]
    normal = max(workspace.normal_force[w] - workspace.response[w, _UNLOADING], 0.0)
    static = contacts.static_load[w]
    if contacts.load_kind == _MOMENTARY or w >= contacts.wheels:
        return normal
    # Wheels 2k and 2k + 1 are on the same axle, so w ^ 1 is the index of the opposite
    # wheel.
    opposite = max(
        workspace.normal_force[w ^ 1] - workspace.response[w ^ 1, _UNLOADING], 0.0
    )
    if contacts.load_kind == _ACROSS_ONLY and normal + opposite > 0.0:
        return 2.0 * static * normal / (normal + opposite)
    return static


@kernel_only
def _evaluation_fraction(x):  # type: ignore[no-untyped-def]
    """Return the fraction θ of a step at which friction is evaluated.

    If the slip speed decays by a factor of e^(−x) per step, an implicit step with this
    θ reproduces the decay. The fraction tends to 1/2 for slow decay and to 1 for fast
    decay.
    """
    if x > 0.1:
        return 1.0 / (1.0 - np.exp(-x)) - 1.0 / x
    return 0.5 + x / 12.0 - x * x * x / 720.0


@kernel_only
def _friction_law(contacts, w, along, across, load, force, rim, h):  # type: ignore[no-untyped-def]  # noqa: D417
    # `force` is the friction of the previous step, and `rim` is the rim speed at the
    # beginning of the step. `h` is the time from the beginning of the step to the
    # evaluation of friction.
    floor = contacts.floor
    mu_t = floor.forward
    mu_lat = floor.across
    slip = floor.slip_speed
    if w >= contacts.wheels:
        mu = contacts.obstacle_friction
        grip = stick_slip_friction(
            along,
            across,
            load,
            mu,
            mu,
            slip,
            force[_FORCE_ALONG],
            force[_FORCE_ACROSS],
        )
        return grip, 0.0
    inertia = floor.spin_mass / h
    drag = force[_FORCE_ALONG] - force[_STORED_SPIN]
    if floor.friction_law_index == _WHEEL:
        return rolling_friction(
            along,
            across,
            load,
            floor,
            force[_FORCE_ALONG],
            force[_FORCE_ACROSS],
            rim,
            inertia,
        )
    is_cosine = floor.friction_law_index == _COSINE
    if is_cosine or floor.backward != mu_t:
        f_t, f_lat, tt, tn, nt, nn = skin_friction(
            along, across, load, floor, drag, force[_FORCE_ACROSS], is_cosine
        )
        # The Newton matrix must be symmetric. With the geometric mean of the two
        # off-diagonal derivatives, it is also positive definite.
        return Traction(f_t, f_lat, tt, np.sign(tn) * np.sqrt(tn * nt), nn), along
    if floor.friction_law_index == _ELLIPSE:
        grip = stick_slip_friction(
            along, across, load, mu_t, mu_lat, slip, drag, force[_FORCE_ACROSS]
        )
        return grip, along
    return (
        axis_friction(
            along, across, load, floor, drag, force[_FORCE_ACROSS], rim, inertia
        ),
        along,
    )


@kernel_only
def _newton(engine, contacts, sparsity, state, workspace, h):  # type: ignore[no-untyped-def]
    change = workspace.v_change
    direction = workspace.direction
    for i in range(change.shape[0]):
        change[i] = 0.0
    clear(workspace.response)
    first = float(0.0)
    # The first pass is a single Newton step with the normal forces at v̂.
    for iteration in range(2):
        max_iterations = 1 if iteration == 0 else _MAX_ITERATIONS
        friction_impulse = float(0.0)
        for w in range(contacts.body.shape[0]):
            state.load[w] = _friction_load(contacts, workspace, w)
            friction_impulse += h * contacts.floor.across * state.load[w]
        best = _evaluate_residual(
            engine, contacts, sparsity, state, workspace, h, workspace.residual
        )
        first = max(first, best)
        tolerance = (
            _RELATIVE_TOLERANCE * friction_impulse * friction_impulse
            + _ROUNDING_TOLERANCE * first
            + _ABSOLUTE_TOLERANCE
        )
        for _ in range(max_iterations):
            if not best > tolerance:
                break
            _assemble(engine, contacts, sparsity, state, workspace, h)
            _solve_direction(engine, sparsity, workspace)
            couple_objects(engine, sparsity, workspace, h)
            best = _line_search(engine, contacts, sparsity, state, workspace, h)
            for i in range(direction.shape[0]):
                workspace.residual[i] = workspace.trial_residual[i]


@kernel_only
def _line_search(engine, contacts, sparsity, state, workspace, h):  # type: ignore[no-untyped-def]
    # The search ends when the residual is nearly orthogonal to the Newton step. For
    # given normal forces, friction maximises dissipation, so the residual is the
    # gradient of a convex function. This function decreases along the Newton step,
    # whereas the squared residual may increase where a contact changes between sticking
    # and sliding. A search that requires a decrease of the squared residual would
    # therefore stall when the robot stops.
    change = workspace.v_change
    direction = workspace.direction
    derivative_start = inner(workspace.residual, direction)
    low = float(0.0)
    high = float(1.0)
    scale = float(1.0)
    applied = float(0.0)
    derivative_low = derivative_start
    derivative_high = float(0.0)
    square = float(0.0)
    for _ in range(_MAX_TRIALS):
        for i in range(direction.shape[0]):
            change[i] -= (scale - applied) * direction[i]
        applied = scale
        square = _evaluate_residual(
            engine, contacts, sparsity, state, workspace, h, workspace.trial_residual
        )
        derivative = inner(workspace.trial_residual, direction)
        limit = _MAX_DERIVATIVE_RATIO * derivative_start
        # A full step is accepted even if the convex function still decreases at its
        # end, because the next Newton step continues from there.
        if derivative >= -limit and (scale == 1.0 or derivative <= limit):
            break
        if derivative < 0.0:
            high = scale
            derivative_high = derivative
        else:
            low = scale
            derivative_low = derivative
        scale = low + min(
            max(derivative_low / (derivative_low - derivative_high), 0.1), 0.9
        ) * (high - low)
    return square


@kernel_only
def _evaluate_friction(contacts, state, workspace, h):  # type: ignore[no-untyped-def]
    response = workspace.response
    for w in range(contacts.body.shape[0]):
        if w >= contacts.wheels and state.load[w] == 0.0:
            continue  # the collision geom touches no obstacle
        along, across = _contact_velocity(contacts, workspace, w, workspace.theta[w])
        traction, rim = _friction_law(
            contacts,
            w,
            along,
            across,
            state.load[w],
            state.force[w],
            state.rim_speed[w],
            h * workspace.theta[w],
        )
        response[w, _FORCE_ALONG] = traction.along
        response[w, _FORCE_ACROSS] = traction.across
        response[w, _RIM_SPEED] = rim
        response[w, _DERIVATIVE_ALONG] = traction.derivative_along
        response[w, _OFF_DIAGONAL] = traction.off_diagonal
        response[w, _DERIVATIVE_ACROSS] = traction.derivative_across
        response[w, _SPIN_FORCE] = (
            -contacts.floor.spin_mass
            / (h * workspace.theta[w])
            * (rim - state.rim_speed[w])
        )
        upward = dot(workspace.jacobian[w, _UP], workspace.motion[contacts.last_dof[w]])
        if workspace.normal_force[w] > 0.0:
            response[w, _UNLOADING] = upward / (h * contacts.regularisation[w])
        else:
            response[w, _UNLOADING] = 0.0


@kernel_only
def _sum_impulses(contacts, state, workspace, h):  # type: ignore[no-untyped-def]
    impulse = workspace.impulse
    jacobian = workspace.jacobian
    response = workspace.response
    clear(impulse)
    for w in range(contacts.body.shape[0]):
        f_t = h * (response[w, _FORCE_ALONG] - state.force[w, _FORCE_ALONG])
        f_lat = h * (response[w, _FORCE_ACROSS] - state.force[w, _FORCE_ACROSS])
        spin = h * (response[w, _SPIN_FORCE] - state.force[w, _STORED_SPIN])
        for k in range(6):
            normal = h * response[w, _UNLOADING] * jacobian[w, _UP, k]
            tangential = (
                (f_t - spin) * jacobian[w, _ALONG, k]
                + spin * jacobian[w, _HUB, k]
                + f_lat * jacobian[w, _ACROSS, k]
            )
            impulse[contacts.last_dof[w], k] += normal - tangential


@kernel_only
def _evaluate_residual(engine, contacts, sparsity, state, workspace, h, out):  # type: ignore[no-untyped-def]
    """Compute r(δ) and the friction response, and return the squared residual."""
    change = workspace.v_change
    spatial_velocities(engine.cdof, sparsity, change, workspace.motion)
    _evaluate_friction(contacts, state, workspace, h)
    _sum_impulses(contacts, state, workspace, h)
    add_object_impulses(engine, sparsity, workspace, h)
    project(engine.cdof, sparsity, workspace.impulse, out)
    for i in range(change.shape[0]):
        out[i] -= workspace.bias[i]
    add_product(sparsity, workspace.inertia, change, out)
    return inner(out, out)


@kernel_only
def _assemble(engine, contacts, sparsity, state, workspace, h):  # type: ignore[no-untyped-def]
    matrix = workspace.newton_matrix
    jacobian = workspace.jacobian
    response = workspace.response
    derivative = workspace.derivative
    for i in range(derivative.shape[0]):
        clear(derivative[i])
    for w in range(contacts.body.shape[0]):
        # tt, tn and nn are derivatives of r with respect to δ, for the directions along
        # (t) and across (n) the heading. They have a factor of −θ h, because ∂u/∂δ is θ
        # J and friction enters r with a factor of −h.
        weight = -workspace.theta[w] * h
        tt = weight * response[w, _DERIVATIVE_ALONG]
        tn = weight * response[w, _OFF_DIAGONAL]
        nn = weight * response[w, _DERIVATIVE_ACROSS]
        if workspace.normal_force[w] > 0.0:
            up = 1.0 / contacts.regularisation[w]
        else:
            up = 0.0
        # The force that spins a rolling wheel acts on the connector at the hub.
        forward = jacobian[w, _HUB if response[w, _RIM_SPEED] != 0.0 else _ALONG]
        lateral = jacobian[w, _ACROSS]
        vertical = jacobian[w, _UP]
        composite = derivative[contacts.last_dof[w]]
        for a in range(6):
            t = tt * forward[a] + tn * lateral[a]
            n = tn * forward[a] + nn * lateral[a]
            z = up * vertical[a]
            for b in range(6):
                composite[a, b] += t * forward[b] + n * lateral[b] + z * vertical[b]
    add_object_jacobian(engine, sparsity, workspace, h)
    for k in range(matrix.shape[0]):
        matrix[k] = workspace.inertia[k]
    project_jacobian(engine.cdof, sparsity, derivative, workspace.impulse, matrix)


@kernel_only
def _solve_direction(engine, sparsity, workspace):  # type: ignore[no-untyped-def]
    # Only numba can call the engine's factorisation.
    mj_factorM(engine.model, engine.data)
    mj_solveM(
        engine.model,
        engine.data,
        workspace.direction.ctypes.data,
        workspace.residual.ctypes.data,
        np.int32(1),
    )


@kernel_only
def solve_direction_portably(engine, sparsity, workspace):  # type: ignore[no-untyped-def]
    """Solve for the Newton step in Warp, without the engine's factorisation."""
    for i in range(workspace.direction.shape[0]):
        workspace.direction[i] = workspace.residual[i]
    factor(workspace.newton_matrix, sparsity)
    substitute(workspace.newton_matrix, sparsity, workspace.direction)
