r"""Loaded contact, with implicit friction that depends on MuJoCo's normal forces.

The contacts between wheels and floor are frictionless in MuJoCo (condim 1). A law of
`robot.friction` determines the friction from the normal forces of the current time
step. This module advances the simulation in a compiled loop that calls the engine's C
functions. The module `friction_solve` computes the friction of one step.

**Equation of a step.** A time step of length h starts with velocity v₋ and ends with
velocity v. MuJoCo first computes the step with the friction forces f̂ of the previous
step, which gives the velocity v̂:

$$ (M + h D)(\hat v - v_-) = h\,\bigl(Q - c(v_-)\bigr) + h J_n^T \hat N + h \sum_w J_w^T \hat f_w . $$

The vector Q contains the applied forces, and N̂ contains the normal forces on the
wheels. The module `friction_solve` lists the other symbols. The term h D arises because
MuJoCo integrates dampers and springs implicitly. The matrix D therefore contains the
damping and, multiplied by h, the stiffness of the joints (`_damping_matrices`).

The desired step has a second-order damping matrix C instead of h D, Coriolis forces at
mid-step, and the friction forces of the current step:

$$ (M + C)(v - v_-) = h\,\bigl(Q - c(\bar v)\bigr) + h J_n^T N + h \sum_w J_w^T f_w , \qquad
   \bar v = (v_- + v)/2 . $$

N and f_w are the normal forces and friction forces of the current step. With A = M + C
and δ = v − v̂, the difference of the two equations is

$$ \bigl(A + J_n^T R^{-1} J_n\bigr)\,\delta = h \sum_w J_w^T (f_w - \hat f_w)
   + h\,\bigl(c(v_-) - c(\bar v)\bigr) + (h D - C)(\hat v - v_-) . $$

The matrix J_n has one row for each wheel that presses on the floor, and R is MuJoCo's
regularisation of the normal forces. The term with J_n on the left-hand side is due to
the change of the normal forces, N − N̂ = −J_n δ/(h R). In c(v̄), the velocity v is
approximated by v̂.

**Obstacles** exert normal forces on the collision geoms of the body. The friction of an
obstacle (`stick_slip`) acts at the same point as its normal force. The normal forces of
obstacles are constant during the friction solve, because J_n has no rows for collision
geoms.

**Time levels.** Positions are evaluated at mid-step. Springs, friction and Coriolis
forces are therefore second-order accurate. MuJoCo evaluates the normal forces at the
end of the step, because the time constant of the normal contacts is only two time
steps.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, SupportsIndex

import llvmlite.binding as llvm
import mujoco
import numpy as np
import scipy.linalg

from srs_twin.compute.arrays import one_blas_thread
from srs_twin.compute.compiled import compiled, kernel_only
from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.plants.twin.engine import (
    EngineData,
    StepInputs,
    mj_comVel,
    mj_forwardSkip,
    mj_integratePos,
    mj_rne,
    mj_step1,
)
from srs_twin.plants.twin.friction_solve import (
    Contacts,
    ContactState,
    Workspace,
    apply_stored_friction,
    set_mid_velocity,
    solve_friction,
    store_friction,
    workspace,
)
from srs_twin.plants.twin.mjcf import surroundings
from srs_twin.plants.twin.mjcf.numerics import (
    LAWS_ON_LOADS,
    LOADS,
    LoadedContact,
    ModelSettings,
    stated,
)
from srs_twin.plants.twin.mjcf.wheels import (
    contact_regularisation,
    static_loads,
    treads,
)
from srs_twin.plants.twin.object_contacts import (
    ObjectState,
    object_contacts,
    store_object_friction,
)
from srs_twin.plants.twin.spatial_algebra import Sparsity, inner
from srs_twin.plants.twin.stick_slip import FloorLaw
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import MovableObject

_SKIP_TO_FORCES = int(mujoco.mjtStage.mjSTAGE_VEL)
"""Stage of the MuJoCo pipeline up to which all results are already computed."""

_SINKING_TIME = 0.05
"""Time in which a snake settles on the floor, for a robot with a time unit of 1, s."""

_MIN_DECAY = 1e-9
"""Minimum decay exponent of a damped mode in one time step, dimensionless."""


class StepRecords(NamedTuple):
    """Arguments of the functions in `friction_solve`, and the time step h (s)."""

    contacts: Contacts
    sparsity: Sparsity
    state: ContactState
    workspace: Workspace
    h: float


class StepOutputs(NamedTuple):
    """Arrays that `LoadedStepper.run` fills, with one row per time step.

    Attributes:
        force: force on each contact in the world frame, shape (steps, C, 3), N. For a
            collision geom, the force excludes the normal force.
        pair_force: friction between the object and the collision geom of each pair,
            shape (steps, pairs, 3), N.
    """

    states: np.ndarray
    sensors: np.ndarray
    force: np.ndarray
    power: np.ndarray
    pair_force: np.ndarray


class LoadedStepper(Stateful):
    """Time integrator of one twin with loaded contact.

    Attributes:
        contact_state: friction, rim speeds and normal forces in the previous time step.
        object_state: friction and slip speeds of the contacts with objects.
        collision_jacobian: contact Jacobians of the collision geoms in the previous
            time step, shape (collision geoms, 4, 6).
    """

    state_attributes = ("contact_state", "object_state", "collision_jacobian")

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        spec: RobotSpec,
        settings: ModelSettings,
        air: np.ndarray,
        objects: tuple[MovableObject, ...],
    ) -> None:
        """Compute the constants of the contacts and allocate the work arrays.

        The matrix `air` is the maximum joint stiffness due to compressed air, shape
        (nv, nv), N·m/rad.
        """
        # The kernels call C functions of the engine by name, so LLVM must load the
        # engine's library.
        llvm.load_library_permanently(
            str(next(Path(mujoco.__file__).parent.glob("libmujoco*")))
        )
        self._contacts, self._sparsity = _constants(model, spec, settings, air)
        wheels = self._contacts.wheels
        self._objects = object_contacts(
            model,
            objects,
            slip=self._contacts.floor.slip_speed,
            collision_inverse_effective_mass=self._contacts.inverse_effective_mass[
                wheels:
            ],
        )
        views = (getattr(data, name) for name in EngineData._fields[3:])
        pairs = self._objects if objects else None
        # Only these private attributes contain the addresses of MuJoCo's C structures.
        model_address = model._address  # noqa: SLF001
        data_address = data._address  # noqa: SLF001
        self._engine = EngineData(model_address, data_address, pairs, *views)
        self._inputs = StepInputs(data.ctrl, data.qacc_warmstart)
        # The kernels store only addresses, so these references keep the model and the
        # data alive.
        self._model = model
        self._data = data
        self._h = settings.timestep
        self._sinking_time = _SINKING_TIME * spec.scale.time
        self._workspace = workspace(len(self._contacts.body), model.nv, data.M)
        self._reset_contact_state()

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        """Reject copying, because a copy would contain the addresses of the original.

        Raises:
            InputError: always.
        """
        raise InputError(
            "a contact can be neither copied nor pickled on its own; copy the `TwinSnake`,"
            " or use `save()`"
        )

    @property
    def constants(self) -> tuple[Contacts, Sparsity]:
        """Constants of the contacts, and sparsity pattern with damping matrices."""
        return self._contacts, self._sparsity

    @constants.setter
    def constants(self, constants: tuple[Contacts, Sparsity]) -> None:
        self._contacts, self._sparsity = constants

    @property
    def object_state(self) -> ObjectState:
        """State of the contacts with objects, as views of the work arrays."""
        return ObjectState(
            *(getattr(self._objects, name) for name in ObjectState._fields)
        )

    @object_state.setter
    def object_state(self, state: ObjectState) -> None:
        for mine, given in zip(self.object_state, state, strict=True):
            mine[:] = given

    @property
    def collision_jacobian(self) -> np.ndarray:
        """Contact Jacobians of the collision geoms, as a view of the work array."""
        return self._workspace.jacobian[self._contacts.wheels :]

    @collision_jacobian.setter
    def collision_jacobian(self, given: np.ndarray) -> None:
        self.collision_jacobian[:] = given

    @property
    def records(self) -> dict[str, Any]:
        """Named arguments of the functions in `friction_solve`, for other engines."""
        return {
            "engine": self._engine,
            "contacts": self._contacts,
            "sparsity": self._sparsity,
            "contact_state": self.contact_state,
            "workspace": self._workspace,
        }

    def reset(self) -> None:
        """Let the snake settle on the floor, and set the wheel loads to static values.

        The snake sinks into the floor by a few micrometres. In the meantime, the floor
        is level and frictionless, because friction would preserve small horizontal
        displacements. Contacts with obstacles are disabled, so that they do not remove
        an overlap before it is detected.
        """
        model = self._model
        data = self._data
        contacts = self._contacts
        gravity = model.opt.gravity.copy()
        solid = model.geom_contype.copy()
        no_friction = contacts.floor._replace(forward=0.0, backward=0.0, across=0.0)
        self._contacts = contacts._replace(floor=no_friction)
        model.opt.gravity[:2] = 0.0
        model.geom_contype[:] = 0
        self._reset_contact_state()
        self.run(np.zeros((math.ceil(self._sinking_time / self._h), model.nu)))
        self._contacts = contacts
        model.opt.gravity[:] = gravity
        model.geom_contype[:] = solid
        data.qvel[:] = 0.0
        data.time = 0.0
        self._reset_contact_state()

    def _reset_contact_state(self) -> None:
        load = self._contacts.static_load
        zeros = np.zeros(len(load))
        self.contact_state = ContactState(
            np.zeros((len(load), 3)), zeros, load.copy(), zeros.copy()
        )
        self.collision_jacobian[:] = 0.0
        for array in self.object_state:
            array[:] = 0.0

    def roll(self) -> None:
        """Set the rim speeds so that the wheels roll without slip."""
        contacts = self._contacts
        velocity = np.empty(6)
        for w in range(contacts.wheels):
            body = int(contacts.body[w])
            mujoco.mj_objectVelocity(
                self._model, self._data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 1
            )
            self.contact_state.rim_speed[w] = (
                velocity[3:] + np.cross(velocity[:3], contacts.centre[w])
            )[0]

    def run(self, controls: np.ndarray) -> tuple[np.ndarray, ...]:
        """Advance the simulation by one time step for each row of `controls`.

        Args:
            controls: controls of the actuators, shape (steps, nu).

        Returns:
            states: time, qpos and qvel at the end of each step, shape (steps, 1 + nq +
                nv). After a divergence, qpos and qvel are NaN, and all other returned
                arrays are 0.
            sensors: sensor values in each step, shape (steps, nsensordata).
            floor_force: floor force on each wheel in the world frame, shape (steps,
                axles, 2, 3), N.
            power: power dissipated by friction and by the normal forces on collision
                geoms, shape (steps,), W.
            obstacle_friction: friction on each collision geom in the world frame, shape
                (steps, 1 + objects, collision geoms, 3), N. The first entry of the
                second axis is due to obstacles, and the others are due to the objects.
        """
        model = self._model
        data = self._data
        steps = len(controls)
        wheels = self._contacts.wheels
        count = len(self._contacts.body)
        out = StepOutputs(
            states=np.full((steps, 1 + model.nq + model.nv), np.nan),
            sensors=np.zeros((steps, model.nsensordata)),
            force=np.zeros((steps, count, 3)),
            power=np.zeros(steps),
            pair_force=np.zeros((steps, self._objects.pairs, 3)),
        )
        records = StepRecords(
            self._contacts, self._sparsity, self.contact_state, self._workspace, self._h
        )
        _run(self._inputs, self._engine, records, controls, out)
        out.states[:, 0] = data.time + self._h * np.arange(1, steps + 1)
        data.time += self._h * steps
        floor = out.force[:, :wheels].reshape(steps, -1, 2, 3)
        collision_geoms = out.force[:, None, wheels:]
        if out.pair_force.size:
            on_collision_geoms = out.pair_force.reshape(
                steps, -1, *collision_geoms.shape[2:]
            )
            collision_geoms = np.concatenate(
                [collision_geoms, on_collision_geoms], axis=1
            )
        return out.states, out.sensors, floor, out.power, collision_geoms


def _constants(
    model: mujoco.MjModel,
    spec: RobotSpec,
    settings: ModelSettings,
    air: np.ndarray,
) -> tuple[Contacts, Sparsity]:
    nv = model.nv
    wheels = treads(spec, settings)
    collision_geoms = surroundings.collision_geoms(model)
    mass, jacobian = _reference_dynamics(model, wheels, collision_geoms)
    with one_blas_thread():
        damping, excess = _damping_matrices(model, mass, settings.timestep, air)
        inverse = np.linalg.inv(mass + damping)
        inverse_effective_mass = np.einsum("wi,ij,wj->w", jacobian, inverse, jacobian)
    # Elements of C outside the sparsity pattern of M couple the front half of the chain
    # to the rear half. They are of the order h² and are omitted.
    triangle = np.repeat(np.arange(nv), model.M_rownnz), model.M_colind
    sparsity = Sparsity(
        row_length=model.M_rownnz.astype(int),
        row_start=model.M_rowadr.astype(int),
        column=model.M_colind.astype(int),
        parent=model.dof_parentid.astype(int),
        damping=damping[triangle],
        damping_excess=excess[triangle],
    )
    return _contacts(model, spec, settings, inverse_effective_mass), sparsity


def _contacts(
    model: mujoco.MjModel,
    spec: RobotSpec,
    settings: ModelSettings,
    inverse_effective_mass: np.ndarray,
) -> Contacts:
    contact = settings.contact
    assert isinstance(contact, LoadedContact)
    wheels = treads(spec, settings)
    collision_geoms = surroundings.collision_geoms(model)
    geoms = [model.geom(name) for name in wheels + collision_geoms]
    body = np.array([geom.bodyid[0] for geom in geoms])
    sensors = [model.sensor(f"floor_force_{wheel}").adr[0] + 2 for wheel in wheels]
    sensors += [
        model.sensor(f"obstacle_force_{collision_geom}").adr[0]
        for collision_geom in collision_geoms
    ]
    loads = static_loads(spec, settings, -model.opt.gravity[2])
    regularisation = contact_regularisation(model, spec, settings)
    no_load = np.zeros(len(collision_geoms))
    return Contacts(
        wheels=len(wheels),
        body=body,
        centre=np.stack([geom.pos for geom in geoms[: len(wheels)]]),
        last_dof=model.body_dofadr[body] + model.body_dofnum[body] - 1,
        regularisation=np.append(regularisation, no_load + math.inf),
        inverse_effective_mass=inverse_effective_mass,
        static_load=np.append(loads, no_load),
        load_kind=LOADS.index(contact.load),
        sensor=np.array(sensors),
        wheel_radius=spec.geometry.wheel_radius,
        floor=_floor_law(spec, contact, settings.numerics.wheel_spin),
        obstacle_friction=surroundings.friction_of(model),
    )


def _floor_law(spec: RobotSpec, contact: LoadedContact, wheel_spin: float) -> FloorLaw:
    slides = contact.law in ("ellipse", "cosine")
    # The spin of a solid disc increases its inertia along the heading by half of its
    # mass.
    spin_mass = 0.0 if slides else wheel_spin * spec.mass.wheel / 2
    return FloorLaw(
        friction_law_index=LAWS_ON_LOADS.index(contact.law),
        forward=spec.friction.mu_t,
        backward=spec.friction.backward,
        across=spec.friction.mu_n,
        slip_speed=stated(contact.slip_speed),
        spin_mass=spin_mass,
    )


def _reference_dynamics(
    model: mujoco.MjModel, wheels: list[str], collision_geoms: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    # The function returns the inertia matrix M and the contact Jacobian of the straight
    # snake. The rows of the Jacobian give the velocities of the wheels across the
    # heading and of the collision geoms along the heading.
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_fullM(model, data, mass)
    rows = []
    for k, name in enumerate(wheels + collision_geoms):
        geom = data.geom(name)
        mujoco.mj_jac(
            model, data, jacobian, None, geom.xpos, model.geom_bodyid[geom.id]
        )
        rows.append(jacobian[1 if k < len(wheels) else 0].copy())
    return mass, np.array(rows)


def _damping_matrices(
    model: mujoco.MjModel, mass: np.ndarray, h: float, air: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    r"""Return the damping matrices C and h D − C, each of shape (nv, nv).

    MuJoCo evaluates dampers and springs at the end of a step, which is only first-order
    accurate. The matrix D is the sum of the damping matrix and h times the stiffness
    matrix of the joints. The damping due to this scheme is replaced by the second-order
    damping matrix C:

    $$ C = M\,\varphi(h M^{-1} D) - M, \qquad \varphi(x) = x/(1 - e^{-x}) = 1 + x/2 + \dots $$

    With this matrix, the step (M + C)(v − v₋) = h (f − D v₋) under a force f has the
    exact exponential decay. The step is second-order accurate, and fast modes do not
    oscillate. The inertia matrix M is that of the straight snake, but the order of
    accuracy is equal for all shapes.

    The compressed air in the chambers acts as an additional spring with stiffness
    matrix K_a, whose force is evaluated at mid-step. The additional term h² K_a/4 in C
    keeps the fastest oscillation of this spring stable and affects the results only to
    second order in h.
    """
    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    rates = h * model.dof_damping
    rates[model.jnt_dofadr[hinges]] += (
        h**2 * model.jnt_stiffness.reshape(model.njnt, -1)[hinges, 0]
    )
    decays, modes = scipy.linalg.eigh(np.diag(rates), mass)
    shapes = mass @ modes
    # Rounding errors in the decay rates of undamped rigid-body motions would act as an
    # inertia that does not rotate with the snake.
    damped = decays > _MIN_DECAY
    decays[~damped] = 1.0
    damping: np.ndarray = (
        shapes * np.where(damped, decays / -np.expm1(-decays) - 1, 0.0)
    ) @ shapes.T
    damping += h**2 / 4 * air
    return damping, np.diag(rates) - damping


@compiled
def _run(inputs, engine, records, controls, out):  # type: ignore[no-untyped-def]
    for step in range(controls.shape[0]):
        _begin_step(inputs, engine, records, controls[step])
        mj_forwardSkip(engine.model, engine.data, _SKIP_TO_FORCES, 0)
        if not _end_step(inputs, engine, records, step, out):
            break
    for i in range(engine.qvel.shape[0]):
        engine.qfrc_applied[i] = 0.0


@kernel_only
def _begin_step(inputs, engine, records, control):  # type: ignore[no-untyped-def]
    contacts, sparsity, state, workspace, h = records
    _copy(control, inputs.ctrl)
    mj_integratePos(
        engine.model, engine.qpos.ctypes.data, engine.qvel.ctypes.data, h / 2
    )
    _copy(engine.qvel, workspace.v_start)
    mj_step1(engine.model, engine.data)
    apply_stored_friction(engine, contacts, sparsity, state, workspace, h)


@kernel_only
def _end_step(inputs, engine, records, step, out):  # type: ignore[no-untyped-def]
    contacts, sparsity, state, workspace, h = records
    model = engine.model
    nq = engine.qpos.shape[0]
    _copy(engine.qacc, inputs.qacc_warmstart)
    for i in range(engine.qvel.shape[0]):
        workspace.v_predicted[i] = workspace.v_start[i] + h * engine.qacc[i]
    set_mid_velocity(engine, workspace)
    mj_comVel(model, engine.data)
    mj_rne(model, engine.data, 0, workspace.residual.ctypes.data)
    solve_friction(engine, contacts, sparsity, state, workspace, h)
    if not np.isfinite(inner(engine.qvel, engine.qvel)):
        return False
    mj_integratePos(model, engine.qpos.ctypes.data, engine.qvel.ctypes.data, h / 2)
    _copy(engine.qpos, out.states[step, 1:])
    _copy(engine.qvel, out.states[step, 1 + nq :])
    _copy(engine.sensordata, out.sensors[step])
    friction_power = store_friction(contacts, state, workspace, out.force[step])
    object_power = store_object_friction(
        engine, sparsity, workspace, out.pair_force[step]
    )
    out.power[step] = friction_power + object_power
    return True


@kernel_only
def _copy(source, target):  # type: ignore[no-untyped-def]
    # The copy is a loop, because numba takes seconds to compile an assignment to a
    # slice.
    for k in range(source.shape[0]):
        target[k] = source[k]
