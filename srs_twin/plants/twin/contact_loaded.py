r"""Friction on the loads that MuJoCo finds: a compiled loop of steps around the engine's C functions.

MuJoCo keeps the wheels on the floor, without friction (condim 1). Friction is a law of `friction` on the
loads of the same step, implicit in the velocities: with the engine's solution v̂ under the friction f̂ of the
step before,

$$ \bigl(A + J_n^T R^{-1} J_n\bigr)(v - \hat v) = h \sum_w J_w^T (f_w - \hat f_w)
   + h\,\bigl(c(v_-) - c(\bar v)\bigr) + (h D - C)(\hat v - v_-), \qquad \bar v = (v_- + v)/2, $$

where A = M + C, C are the dampers (`_dampers`), h D the engine's, c the Coriolis forces (those of c(v̄) from
v̂), and J_n the rows of the normals that press, with the engine's softness R: what stands on the floor does
not yield to friction downward. Their forces follow, by −J_n (v − v̂)/(h R).

Obstacles press on the body without friction, too, and rub with `held` where their force acts; what they
press on yields to friction.

Friction is taken at mid-step where a wheel slides, towards the step's end where it sticks (`_theta`). It acts
on a connector where its wheel touches the floor, but for what spins the wheel, which acts at the hub.

Newton's method is that of `friction_solve`.

Positions are those of the middle of the step, so that springs, friction and Coriolis forces are of second
order in it. MuJoCo's contacts act with what they are at the step's end: they are stiff, 2 steps in time.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import mujoco
import numpy as np
import scipy.linalg
from numba import types

from srs_twin.compute.arrays import one_blas_thread
from srs_twin.compute.compiled import compiled, kernel_only
from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.plants.twin.friction_solve import (
    Contacts,
    Engine,
    Feet,
    Pattern,
    Work,
    approach,
    c_function,
    expect,
    note,
    settle,
)
from srs_twin.plants.twin.mjcf import surroundings
from srs_twin.plants.twin.mjcf.numerics import LAWS_ON_LOADS, LOADS, LoadedContact, ModelSettings
from srs_twin.plants.twin.mjcf.wheels import rest_loads, softness, treads
from srs_twin.robot.spec import RobotSpec

_VELOCITIES_KNOWN = int(mujoco.mjtStage.mjSTAGE_VEL)
_SINKS_IN_S = 0.05
_SLOWEST = 1e-9  # of decays, over a step: less is rounding where nothing damps


mj_step1, mj_comVel = c_function("mj_step1"), c_function("mj_comVel")
mj_forwardSkip = c_function("mj_forwardSkip", types.int32, types.int32)
mj_rne = c_function("mj_rne", types.int32, types.intp)
mj_integratePos = c_function("mj_integratePos", types.intp, types.float64)


class Given(NamedTuple):
    """What only the loop reads and writes of the engine's data, named as there."""

    ctrl: np.ndarray
    qacc_warmstart: np.ndarray


class LoadedStepper(Stateful):
    """The contacts of one twin on the loads of its own data.

    Attributes:
        feet: what they keep from step to step.
    """

    state_attributes = ("feet",)

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        spec: RobotSpec,
        settings: ModelSettings,
        air: np.ndarray | None = None,
    ) -> None:
        """Look up what the loop needs.

        Args:
            model: compiled from `settings`.
            data: what it steps.
            spec: the robot.
            settings: time step, and a `LoadedContact`.
            air: most that the chambers stiffen the joints by, shape (nv, nv); None: not at all.
        """
        # The kernels call the engine by the names of its functions, which are looked up at their first call.
        llvm.load_library_permanently(str(next(Path(mujoco.__file__).parent.glob("libmujoco*"))))
        nv, self._h = model.nv, settings.timestep
        contact = settings.contact
        assert isinstance(contact, LoadedContact)
        feet, touching = treads(spec), surroundings.hulls(model)
        geoms = [model.geom(name) for name in feet + touching]
        body = np.array([geom.bodyid[0] for geom in geoms])
        mass, easy = _reference(model, feet, touching)
        with one_blas_thread():
            damping, less = _dampers(model, mass, self._h, np.zeros((nv, nv)) if air is None else air)
            ease = np.einsum("wi,ij,wj->w", easy, np.linalg.inv(mass + damping), easy)
        triangle = np.repeat(np.arange(nv), model.M_rownnz), model.M_colind
        spin = 0.0 if contact.law == "ellipse" else settings.numerics.wheel_spin * spec.mass.wheel / 2
        none = np.zeros(len(touching))
        sensors = [model.sensor(f"floor_force_{foot}").adr[0] + 2 for foot in feet]
        sensors += [model.sensor(f"obstacle_force_{hull}").adr[0] for hull in touching]
        self._contacts = Contacts(
            wheels=len(feet),
            body=body,
            place=np.stack([geom.pos for geom in geoms[: len(feet)]]),
            last=model.body_dofadr[body] + model.body_dofnum[body] - 1,
            softness=np.append(softness(model, spec), none + math.inf),
            ease=ease,
            rest=np.append(rest_loads(spec, -model.opt.gravity[2]), none),
            load=LOADS.index(contact.load),
            sensor=np.array(sensors),
            radius=spec.geometry.wheel_radius,
            kind=LAWS_ON_LOADS.index(contact.law),
            law=(spec.friction.mu_t, spec.friction.mu_n, contact.slip_speed, spin),
        )
        self._pattern = Pattern(
            entries=model.M_rownnz.astype(int),
            first=model.M_rowadr.astype(int),
            column=model.M_colind.astype(int),
            parent=model.dof_parentid.astype(int),
            damping=damping[triangle],
            less=less[triangle],
        )
        views = (getattr(data, name) for name in Engine._fields[2:])
        self._engine = Engine(model._address, data._address, *views)
        self._given = Given(data.ctrl, data.qacc_warmstart)
        self._kept = model, data  # addresses alone keep nothing alive
        count, entries = len(geoms), len(data.M)
        shapes = [(count, 4, 6), (count, 2), (count, 8), (count,), (count,), *[(nv, 6)] * 4, (nv, 6, 6)]
        shapes += [(entries,)] * 2 + [(nv,)] * 7
        self._work = Work(*map(np.zeros, shapes))._replace(matrix=data.M)
        self._stand()

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse: a copy would hold addresses in the original's data.

        Raises:
            InputError: always.
        """
        raise InputError(
            "contacts can be neither copied nor pickled alone; copy the TwinSnake, or use save()"
        )

    @property
    def settled(self) -> tuple[Contacts, Pattern]:
        """Numbers taken from the model when the contacts were made."""
        return self._contacts, self._pattern

    @settled.setter
    def settled(self, numbers: tuple[Contacts, Pattern]) -> None:
        self._contacts, self._pattern = numbers

    @property
    def records(self) -> dict[str, Any]:
        """What `friction_solve` takes, by its names, for who steps the bodies elsewhere."""
        named = {"engine": self._engine, "contacts": self._contacts, "pattern": self._pattern}
        return named | {"feet": self.feet, "work": self._work}

    def reset(self) -> None:
        """Let the wheels stand, each with its share of the weight.

        The snake sinks in by some micrometres, first, on a level floor and without friction: what it moves
        along the floor meanwhile would stay as friction that holds.
        """
        model, data = self._kept
        contacts, gravity = self._contacts, model.opt.gravity.copy()
        self._contacts = contacts._replace(law=(0.0, 0.0, *contacts.law[2:]))
        model.opt.gravity[:2] = 0.0
        self._stand()
        self.run(np.zeros((math.ceil(_SINKS_IN_S / self._h), model.nu)))
        self._contacts, model.opt.gravity[:] = contacts, gravity
        data.qvel[:], data.time = 0.0, 0.0
        self._stand()

    def _stand(self) -> None:
        rest = self._contacts.rest
        self.feet = Feet(np.zeros((len(rest), 3)), np.zeros(len(rest)), rest.copy(), np.zeros(len(rest)))

    def roll(self) -> None:
        """Let the wheels turn as fast as they move along their headings."""
        (model, data), contacts, moving = self._kept, self._contacts, np.empty(6)
        for w in range(contacts.wheels):
            body = int(contacts.body[w])
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, moving, 1)
            self.feet.rim[w] = (moving[3:] + np.cross(moving[:3], contacts.place[w]))[0]

    def run(self, controls: np.ndarray) -> tuple[np.ndarray, ...]:
        """Make a step for each row of controls.

        Args:
            controls: shape (steps, nu).

        Returns:
            Time, qpos and qvel at the steps' ends, NaN after one that diverged; sensors; the floor's force on
            each wheel, shape (steps, axles, 2, 3), N, world; the power that friction takes, (steps,), W; and
            the obstacles' friction on what may touch them, shape (steps, hulls, 3), N, world.
        """
        (model, data), steps, wheels = self._kept, len(controls), self._contacts.wheels
        states = np.full((steps, 1 + model.nq + model.nv), np.nan)
        sensed, force = np.zeros((steps, model.nsensordata)), np.zeros((steps, len(self._contacts.rest), 3))
        power = np.zeros(steps)
        out = states, sensed, force, power
        friction = self._contacts, self._pattern, self.feet, self._work, self._h
        _run(self._given, self._engine, *friction, controls, out)
        states[:, 0] = data.time + self._h * np.arange(1, steps + 1)
        data.time += self._h * steps
        return states, sensed, force[:, :wheels].reshape(steps, -1, 2, 3), power, force[:, wheels:]


def _reference(model: mujoco.MjModel, feet: list[str], touching: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return M (nv, nv) of the straight snake, and what gives the velocities of these geoms, (C, nv).

    Of feet, that across; of what may touch obstacles, that along the body.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    mass, jacobian = np.zeros((model.nv, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_fullM(model, data, mass)
    rows = []
    for k, name in enumerate(feet + touching):
        geom = data.geom(name)
        mujoco.mj_jac(model, data, jacobian, None, geom.xpos, model.geom_bodyid[geom.id])
        rows.append(jacobian[1 if k < len(feet) else 0].copy())
    return mass, np.array(rows)


def _dampers(
    model: mujoco.MjModel, mass: np.ndarray, h: float, air: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    r"""Return what the dampers add to A, and by how much the engine's h D + h² K is more, (nv, nv).

    The engine's dampers act with the velocity at the end of a step. Taken as

    $$ C = M\,\varphi(h M^{-1} D) - M, \qquad \varphi(x) = x/(1 - e^{-x}) = 1 + x/2 + \dots, $$

    a step with (M + C)(v − v₋) = h (f − D v₋) decays as an exponential does: of second order, and without
    ringing however fast. M is that of the straight snake; any other would do for the order.

    Air that the bends compress is a spring K_a of its own, whose force is that of the middle of the step.
    With h² K_a/4 in A besides, which changes results in the second order, no step is too long for the
    fastest of its oscillations, those of a connector between closed chambers.
    """
    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    rates = h * model.dof_damping
    rates[model.jnt_dofadr[hinges]] += h**2 * model.jnt_stiffness.reshape(model.njnt, -1)[hinges, 0]
    decays, modes = scipy.linalg.eigh(np.diag(rates), mass)
    shapes = mass @ modes
    # Motions of the whole snake are not damped: a rest of rounding would be mass that does not turn with it.
    damped = decays > _SLOWEST
    decays[~damped] = 1.0
    damping: np.ndarray = (shapes * np.where(damped, decays / -np.expm1(-decays) - 1, 0.0)) @ shapes.T
    damping += h**2 / 4 * air
    return damping, np.diag(rates) - damping


@compiled
def _run(given, engine, contacts, pattern, feet, work, h, controls, out):  # type: ignore[no-untyped-def]
    """Make steps; `out` is what `LoadedStepper.run` returns."""
    for step in range(controls.shape[0]):
        _begin(given, engine, contacts, pattern, feet, work, h, controls[step])
        mj_forwardSkip(engine.model, engine.data, _VELOCITIES_KNOWN, 0)
        if not _end(given, engine, contacts, pattern, feet, work, h, step, out):
            break
    for i in range(engine.qvel.shape[0]):
        engine.qfrc_applied[i] = 0.0


@compiled
def _begin(given, engine, contacts, pattern, feet, work, h, control):  # type: ignore[no-untyped-def]
    """Go to the middle of a step, with the friction of the step before."""
    _copy(control, given.ctrl)
    mj_integratePos(engine.model, engine.qpos.ctypes.data, engine.qvel.ctypes.data, h / 2)
    _copy(engine.qvel, work.before)
    mj_step1(engine.model, engine.data)
    approach(engine, contacts, pattern, feet, work)


@compiled
def _end(given, engine, contacts, pattern, feet, work, h, step, out):  # type: ignore[no-untyped-def]
    """Solve friction, go to the end of a step and note what happened; return whether it is finite."""
    states, sensed, force, power = out
    model, data, nq, nv = engine.model, engine.data, engine.qpos.shape[0], engine.qvel.shape[0]
    _copy(engine.qacc, given.qacc_warmstart)
    for i in range(nv):
        work.predicted[i] = work.before[i] + h * engine.qacc[i]
    expect(engine, work)
    mj_comVel(model, data)
    mj_rne(model, data, 0, work.residual.ctypes.data)
    settle(engine, contacts, pattern, feet, work, h)
    total = 0.0
    for i in range(nv):
        total += engine.qvel[i] * engine.qvel[i]
    if not np.isfinite(total):
        return False
    mj_integratePos(model, engine.qpos.ctypes.data, engine.qvel.ctypes.data, h / 2)
    _copy(engine.qpos, states[step, 1:])
    _copy(engine.qvel, states[step, 1 + nq :])
    _copy(engine.sensordata, sensed[step])
    power[step] = note(contacts, feet, work, force[step])
    return True


@kernel_only
def _copy(of, to):  # type: ignore[no-untyped-def]
    # Loops: a slice that is assigned to takes numba seconds to compile, for the words of an error.
    for k in range(of.shape[0]):
        to[k] = of[k]
