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

Newton's method. Its matrix has the pattern of M and is factored like M, because a wheel moves with the
ancestors of its connector alone: as in the composite-rigid-body algorithm, what wheels add is summed from the
ends of the chain to its root. Spatial vectors are rotation first, about the centre of mass, as in `cdof`.

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

from srs_twin import friction
from srs_twin.compiled import compiled, inside
from srs_twin.memory import Remembers, names
from srs_twin.mjcf import surroundings
from srs_twin.mjcf.numerics import LOADS, ON_LOADS, Numerics
from srs_twin.mjcf.wheels import rest_loads, softness, treads
from srs_twin.plants.warm_start import WarmStart, dot, point
from srs_twin.robot.spec import RobotSpec

_MOMENTARY, _ACROSS_ONLY = LOADS.index("momentary"), LOADS.index("across")
_WHEEL, _ELLIPSE = ON_LOADS.index("wheel"), ON_LOADS.index("ellipse")
_held, _rolling = inside(friction.held), inside(friction.rolling)
_VELOCITIES_KNOWN = int(mujoco.mjtStage.mjSTAGE_VEL)
_MOST_ITERATIONS, _SHORTEST = 30, 1e-3
_SMALL = 1e-9  # of the first residual's square: friction is then right to some hundred-thousandths
_ALONG, _ACROSS, _UP, _HUB = range(4)
_RUBS = surroundings.FRICTION
_SINKS_IN_S = 0.05
_SHORT = 24  # segments, up to which the engine solves normals alone as fast as begun by `WarmStart`
_SLOWEST = 1e-9  # of decays, over a step: they are 0 where nothing damps


def _engine(name: str, *more: Any) -> Any:
    """Return a C function of MuJoCo's that takes a model, data, and more; kernels call it by its name."""
    return types.ExternalFunction(name, types.void(types.intp, types.intp, *more))


mj_step1, mj_comVel = _engine("mj_step1"), _engine("mj_comVel")
mj_forwardSkip = _engine("mj_forwardSkip", types.int32, types.int32)
mj_rne = _engine("mj_rne", types.int32, types.intp)
mj_factorM, mj_solveM = _engine("mj_factorM"), _engine("mj_solveM", types.intp, types.intp, types.int32)
mj_integratePos = _engine("mj_integratePos", types.intp, types.float64)


class Engine(NamedTuple):
    """Addresses of a model and its data; what the loop reads and writes there, views named as in MjData."""

    model: int
    data: int
    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    qfrc_applied: np.ndarray
    qacc: np.ndarray
    qacc_warmstart: np.ndarray
    qfrc_bias: np.ndarray
    M: np.ndarray
    xpos: np.ndarray
    xmat: np.ndarray
    cdof: np.ndarray
    subtree_com: np.ndarray
    sensordata: np.ndarray


class Pattern(NamedTuple):
    """Lower triangle of M, row by row: the ancestors of a degree of freedom, itself last.

    Attributes:
        entries: of each row, their number.
        first: where a row begins.
        column: of each entry.
        parent: the ancestor before, −1 where there is none.
        damping: what A has besides M, entry by entry.
        less: by how much the engine's has more, entry by entry.
    """

    entries: np.ndarray
    first: np.ndarray
    column: np.ndarray
    parent: np.ndarray
    damping: np.ndarray
    less: np.ndarray


class Contacts(NamedTuple):
    """What may touch something: wheels first, then what of the body may touch an obstacle; C in all.

    Attributes:
        wheels: how many of them are wheels.
        body: of each, shape (C,).
        place: of a wheel's centre in the body's frame, shape (wheels, 3), m.
        last: last of the degrees of freedom that move it, shape (C,).
        softness: R of a wheel's normal, shape (C,), 1/kg; infinite elsewhere.
        ease: how fast an impulse across a wheel, or along the body, makes it, shape (C,), 1/kg.
        rest: its share of the weight, shape (C,), N.
        load: which one friction takes, a place in `numerics.LOADS`.
        sensor: where a wheel's load stands in `sensordata`, or force and place of an obstacle's, shape (C,).
        radius: of a wheel, m.
        kind: of the law.
        law: μ_t, μ_n, slip speed ε (m/s), mass that the spin adds (kg).
    """

    wheels: int
    body: np.ndarray
    place: np.ndarray
    last: np.ndarray
    softness: np.ndarray
    ease: np.ndarray
    rest: np.ndarray
    load: int
    sensor: np.ndarray
    radius: float
    kind: int
    law: tuple[float, float, float, float]


class Feet(NamedTuple):
    """What each contact keeps from step to step.

    Attributes:
        push: friction along and across the heading, and what of it spins the wheel, shape (C, 3), N.
        rim: speed of the rim, shape (C,), m/s.
        load: that friction takes, shape (C,), N.
        slip: speed at which it slides, shape (C,), m/s.
    """

    push: np.ndarray
    rim: np.ndarray
    load: np.ndarray
    slip: np.ndarray


class Work(NamedTuple):
    """Memory of the loop.

    Attributes:
        rows: what gives a contact's velocity along, across, up, and its hub's along, shape (C, 4, 6).
            Along an obstacle's face is along; across is up.
        heading: cosine and sine, shape (C, 2).
        found: friction, slopes (along by along, along by across, across by across), rim's speed where
            friction is taken, by how much less the floor presses, what spins the wheel, shape (C, 8).
        press: loads under v̂, shape (C,), N.
        theta: where in the step friction is taken, 1/2 to 1, same shape.
        gain: what v̂ − v₋ adds to the spatial velocity beyond each degree of freedom, shape (nv, 6).
        start: that velocity at mid-step, without the change, same shape.
        motion: what the change adds, or the forces on it, same shape.
        yielding: spatial slopes of the forces beyond each degree of freedom, shape (nv, 6, 6).
        metric: A, as M.
        before: v₋, shape (nv,).
        predicted: v̂, same shape.
        bias: momentum that the last two terms of the equation give, same shape.
        change: v − v̂, same shape.
        residual: same shape.
        other: same shape.
        direction: same shape.
    """

    rows: np.ndarray
    heading: np.ndarray
    found: np.ndarray
    press: np.ndarray
    theta: np.ndarray
    gain: np.ndarray
    start: np.ndarray
    motion: np.ndarray
    yielding: np.ndarray
    metric: np.ndarray
    before: np.ndarray
    predicted: np.ndarray
    bias: np.ndarray
    change: np.ndarray
    residual: np.ndarray
    other: np.ndarray
    direction: np.ndarray


class LoadedContact(Remembers):
    """The contacts of one twin on the loads of its own data.

    Attributes:
        feet: what they keep from step to step.
    """

    memory = names("feet")

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        spec: RobotSpec,
        numerics: Numerics,
        air: np.ndarray | None = None,
    ) -> None:
        """Look up what the loop needs.

        Args:
            model: compiled from `numerics`, contact "loaded".
            data: what it steps.
            spec: the robot.
            numerics: its law and time step.
            air: most that the chambers stiffen the joints by, shape (nv, nv); None: not at all.
        """
        # The kernels call the engine by the names of its functions, which are looked up at their first call.
        llvm.load_library_permanently(str(next(Path(mujoco.__file__).parent.glob("libmujoco*"))))
        nv, self._h = model.nv, numerics.timestep
        feet, touching = treads(spec), surroundings.hulls(model)
        geoms = [model.geom(name) for name in feet + touching]
        body = np.array([geom.bodyid[0] for geom in geoms])
        mass, easy = _reference(model, feet, touching)
        damping, less = _dampers(model, mass, self._h, np.zeros((nv, nv)) if air is None else air)
        triangle = np.repeat(np.arange(nv), model.M_rownnz), model.M_colind
        spin = 0.0 if numerics.friction == "ellipse" else numerics.wheel_spin * spec.mass.wheel / 2
        none = np.zeros(len(touching))
        sensors = [model.sensor(f"floor_force_{foot}").adr[0] + 2 for foot in feet]
        sensors += [model.sensor(f"obstacle_force_{hull}").adr[0] for hull in touching]
        self._contacts = Contacts(
            wheels=len(feet),
            body=body,
            place=np.stack([geom.pos for geom in geoms[: len(feet)]]),
            last=model.body_dofadr[body] + model.body_dofnum[body] - 1,
            softness=np.append(softness(model, spec), none + math.inf),
            ease=np.einsum("wi,ij,wj->w", easy, np.linalg.inv(mass + damping), easy),
            rest=np.append(rest_loads(spec, -model.opt.gravity[2]), none),
            load=LOADS.index(numerics.load),
            sensor=np.array(sensors),
            radius=spec.geometry.wheel_radius,
            kind=ON_LOADS.index(numerics.friction),
            law=(spec.friction.mu_t, spec.friction.mu_n, numerics.slip_speed, spin),
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
        self._kept = model, data  # addresses alone keep nothing alive
        self._work = Work(
            np.zeros((len(geoms), 4, 6)),
            np.zeros((len(geoms), 2)),
            np.zeros((len(geoms), 8)),
            np.zeros(len(geoms)),
            np.zeros(len(geoms)),
            np.zeros((nv, 6)),
            np.zeros((nv, 6)),
            np.zeros((nv, 6)),
            np.zeros((nv, 6, 6)),
            np.zeros(len(data.M)),
            *np.zeros((7, nv)),
        )
        self._long = WarmStart(model) if spec.segments > _SHORT else None
        self._stand()

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
        given = self._engine, self._contacts, self._pattern, self.feet, self._work, self._h
        if self._long is None:
            _run(*given, controls, out)
        else:
            self._run_long(self._long, given, controls, out)
        states[:, 0] = data.time + self._h * np.arange(1, steps + 1)
        data.time += self._h * steps
        return states, sensed, force[:, :wheels].reshape(steps, -1, 2, 3), power, force[:, wheels:]

    def _run_long(
        self, long: WarmStart, given: tuple[Any, ...], controls: np.ndarray, out: tuple[np.ndarray, ...]
    ) -> None:
        """Do what `_run` does, with the engine's solver begun by `WarmStart`."""
        model, data = self._kept
        for step, control in enumerate(controls):
            _begin(*given, control)
            long.begin(data)
            mujoco.mj_forwardSkip(model, data, _VELOCITIES_KNOWN, False)
            if not _end(*given, step, out):
                break
        data.qfrc_applied[:] = 0.0


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
    decays = np.maximum(decays, _SLOWEST)
    shapes = mass @ modes
    damping: np.ndarray = (shapes * (decays / -np.expm1(-decays) - 1)) @ shapes.T
    damping += h**2 / 4 * air
    return damping, np.diag(rates) - damping


@compiled
def _run(engine, contacts, pattern, feet, work, h, controls, out):  # type: ignore[no-untyped-def]
    """Make steps; `out` is what `LoadedContact.run` returns."""
    for step in range(controls.shape[0]):
        _begin(engine, contacts, pattern, feet, work, h, controls[step])
        mj_forwardSkip(engine.model, engine.data, _VELOCITIES_KNOWN, 0)
        if not _end(engine, contacts, pattern, feet, work, h, step, out):
            break
    _clear(engine.qfrc_applied)


@compiled
def _begin(engine, contacts, pattern, feet, work, h, control):  # type: ignore[no-untyped-def]
    """Go to the middle of a step, with the friction of the step before."""
    _copy(control, engine.ctrl)
    mj_integratePos(engine.model, engine.qpos.ctypes.data, engine.qvel.ctypes.data, h / 2)
    _copy(engine.qvel, work.before)
    mj_step1(engine.model, engine.data)
    _look(engine, contacts, work)
    _forces(engine.cdof, contacts, pattern, feet.push, work, engine.qfrc_applied)


@compiled
def _end(engine, contacts, pattern, feet, work, h, step, out):  # type: ignore[no-untyped-def]
    """Solve friction, go to the end of a step and note what happened; return whether it is finite."""
    states, sensed, force, power = out
    model, data, nq, nv = engine.model, engine.data, engine.qpos.shape[0], engine.qvel.shape[0]
    _copy(engine.qacc, engine.qacc_warmstart)
    for i in range(nv):
        work.predicted[i] = work.before[i] + h * engine.qacc[i]
        engine.qvel[i] = 0.5 * (work.before[i] + work.predicted[i])
    mj_comVel(model, data)
    mj_rne(model, data, 0, work.residual.ctypes.data)
    for i in range(nv):
        work.bias[i] = engine.qfrc_bias[i] - work.residual[i]
        work.bias[i] *= h
        work.other[i] = work.predicted[i] - work.before[i]
    _multiply(pattern, pattern.less, work.other, work.bias)
    for k in range(work.metric.shape[0]):
        work.metric[k] = engine.M[k] + pattern.damping[k]
    _carry(engine.cdof, pattern, engine.qvel, work.start)
    _carry(engine.cdof, pattern, work.other, work.gain)
    _feel(engine, contacts, work)
    for w in range(contacts.body.shape[0]):
        mu = contacts.law[1] if w < contacts.wheels else _RUBS
        grip = mu * work.press[w] / max(feet.slip[w], contacts.law[2])
        work.theta[w] = _theta(h * grip * contacts.ease[w])
    _solve(engine, contacts, pattern, feet, work, h)
    total = 0.0
    for i in range(nv):
        engine.qvel[i] = work.predicted[i] + work.change[i]
        total += engine.qvel[i] * engine.qvel[i]
    if not np.isfinite(total):
        return False
    mj_integratePos(model, engine.qpos.ctypes.data, engine.qvel.ctypes.data, h / 2)
    _copy(engine.qpos, states[step, 1:])
    _copy(engine.qvel, states[step, 1 + nq :])
    _copy(engine.sensordata, sensed[step])
    for w in range(contacts.body.shape[0]):
        f_t, f_n, rim = work.found[w, 0], work.found[w, 1], work.found[w, 5]
        along, across = _slip(contacts, work, w, 0.5)
        power[step] -= f_t * along + f_n * across
        gap = along - rim if contacts.kind == _WHEEL else along
        feet.slip[w] = np.sqrt(gap * gap + across * across)
        feet.push[w, 0], feet.push[w, 1], feet.push[w, 2] = f_t, f_n, work.found[w, 7]
        feet.rim[w] += (rim - feet.rim[w]) / work.theta[w]
        c, s = work.heading[w, 0], work.heading[w, 1]
        if w < contacts.wheels:
            force[step, w, 0], force[step, w, 1] = c * f_t - s * f_n, s * f_t + c * f_n
            force[step, w, 2] = max(work.press[w] - work.found[w, 6], 0.0)
        else:
            force[step, w, 0], force[step, w, 1], force[step, w, 2] = c * f_t, s * f_t, f_n
    return True


@inside
def _copy(of, to):  # type: ignore[no-untyped-def]
    # Loops: a slice that is assigned to takes numba seconds to compile, for the words of an error.
    for k in range(of.shape[0]):
        to[k] = of[k]


@inside
def _clear(array):  # type: ignore[no-untyped-def]
    for k in range(array.size):
        array.flat[k] = 0.0


@inside
def _multiply(pattern, matrix, x, out):  # type: ignore[no-untyped-def]
    """Add the product of a symmetric matrix of a pattern."""
    for i in range(x.shape[0]):
        row, last = pattern.first[i], pattern.first[i] + pattern.entries[i] - 1
        for k in range(row, last):
            out[i] += matrix[k] * x[pattern.column[k]]
            out[pattern.column[k]] += matrix[k] * x[i]
        out[i] += matrix[last] * x[i]


@inside
def _look(engine, contacts, work):  # type: ignore[no-untyped-def]
    """Fill the rows of each wheel's contact, which lies below its centre, and the headings."""
    com = engine.subtree_com[1]
    for w in range(contacts.wheels):
        body, place = contacts.body[w], contacts.place[w]
        m = engine.xmat[body]
        norm = 1 / np.sqrt(m[0] * m[0] + m[3] * m[3])
        c, s = m[0] * norm, m[3] * norm
        work.heading[w, 0], work.heading[w, 1] = c, s
        x = engine.xpos[body, 0] + m[0] * place[0] + m[1] * place[1] + m[2] * place[2] - com[0]
        y = engine.xpos[body, 1] + m[3] * place[0] + m[4] * place[1] + m[5] * place[2] - com[1]
        z = engine.xpos[body, 2] + m[6] * place[0] + m[7] * place[1] + m[8] * place[2] - com[2]
        z -= contacts.radius
        for k, axis in enumerate(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0))):
            point(work.rows[w, k], x, y, z, axis)
        row, ahead = work.rows[w, _HUB], work.rows[w, _ALONG]
        _copy(ahead, row)
        row[0], row[1] = row[0] - contacts.radius * s, row[1] + contacts.radius * c


@inside
def _feel(engine, contacts, work):  # type: ignore[no-untyped-def]
    """Fill what presses on each contact, and the rows of those with obstacles, whose faces are upright."""
    com, sensed = engine.subtree_com[1], engine.sensordata
    for w in range(contacts.body.shape[0]):
        k = contacts.sensor[w]
        if w < contacts.wheels:
            work.press[w] = max(sensed[k], 0.0)
            continue
        fx, fy = sensed[k], sensed[k + 1]
        pressed = np.sqrt(fx * fx + fy * fy)
        work.press[w] = pressed
        if pressed > 0.0:
            c, s = -fy / pressed, fx / pressed
            x, y, z = sensed[k + 3] - com[0], sensed[k + 4] - com[1], sensed[k + 5] - com[2]
            work.heading[w, 0], work.heading[w, 1] = c, s
            point(work.rows[w, _ALONG], x, y, z, (c, s, 0.0))
            point(work.rows[w, _ACROSS], x, y, z, (0.0, 0.0, 1.0))


@inside
def _carry(cdof, pattern, velocity, motion):  # type: ignore[no-untyped-def]
    """Fill the spatial velocity beyond each degree of freedom."""
    for i in range(velocity.shape[0]):
        p = pattern.parent[i]
        for k in range(6):
            motion[i, k] = cdof[i, k] * velocity[i] + (motion[p, k] if p >= 0 else 0.0)


@inside
def _project(cdof, pattern, motion, out):  # type: ignore[no-untyped-def]
    """Sum spatial forces toward the root and fill what they do on each degree of freedom."""
    for i in range(out.shape[0] - 1, -1, -1):
        out[i] = dot(cdof[i], motion[i])
        p = pattern.parent[i]
        if p >= 0:
            for k in range(6):
                motion[p, k] += motion[i, k]


@inside
def _forces(cdof, contacts, pattern, push, work, out):  # type: ignore[no-untyped-def]
    """Fill the generalised forces of friction."""
    _clear(work.motion)
    for w in range(contacts.body.shape[0]):
        for k in range(6):
            part = push[w, 0] * work.rows[w, _ALONG, k] + push[w, 1] * work.rows[w, _ACROSS, k]
            part += push[w, 2] * (work.rows[w, _HUB, k] - work.rows[w, _ALONG, k])
            work.motion[contacts.last[w], k] += part
    _project(cdof, pattern, work.motion, out)


@inside
def _slip(contacts, work, w, theta):  # type: ignore[no-untyped-def]
    """Return a contact's velocity along and across at mid-step, m/s; the change's `motion` is known."""
    last = contacts.last[w]
    start, gain, change = work.start[last], work.gain[last], work.motion[last]
    ahead, aside, more = work.rows[w, _ALONG], work.rows[w, _ACROSS], theta - 0.5
    return (
        dot(ahead, start) + more * dot(ahead, gain) + theta * dot(ahead, change),
        dot(aside, start) + more * dot(aside, gain) + theta * dot(aside, change),
    )


@inside
def _load(contacts, work, w):  # type: ignore[no-untyped-def]
    """Return the load that friction takes, N."""
    pressed, rest = max(work.press[w] - work.found[w, 6], 0.0), contacts.rest[w]
    if contacts.load == _MOMENTARY or w >= contacts.wheels:
        return pressed
    other = max(work.press[w ^ 1] - work.found[w ^ 1, 6], 0.0)
    return 2 * rest * pressed / (pressed + other) if contacts.load == _ACROSS_ONLY and pressed > 0.0 else rest


@inside
def _theta(x):  # type: ignore[no-untyped-def]
    """Return where in a step friction is taken that lets slip decay by x: its middle, or its end if fast."""
    return -1 / np.expm1(-x) - 1 / x if x > 1e-3 else 0.5 + x / 12


@inside
def _law(contacts, w, along, across, load, push, rim, h):  # type: ignore[no-untyped-def]
    """Return force, slopes (along by along, along by across, across by across), rim's speed at mid-step."""
    mu_t, mu_n, slip, mass = contacts.law
    if w >= contacts.wheels:
        f_t, f_n, tt, tn, nn = _held(along, across, load, _RUBS, _RUBS, slip, push[0], push[1])
        return f_t, f_n, tt, tn, nn, 0.0
    lag, drag = mass / h, push[0] - push[2]
    if contacts.kind == _WHEEL:
        return _rolling(_held, along, across, load, mu_t, mu_n, slip, push[0], push[1], rim, lag)
    if contacts.kind == _ELLIPSE:
        f_t, f_n, tt, tn, nn = _held(along, across, load, mu_t, mu_n, slip, drag, push[1])
        return f_t, f_n, tt, tn, nn, along
    f_t, _, tt, _, _ = _held(along, 0.0, load, mu_t, mu_t, slip, drag, 0.0)
    _, f_n, _, _, nn = _held(0.0, across, load, mu_n, mu_n, slip, 0.0, push[1])
    return f_t - lag * (along - rim), f_n, tt - lag, 0.0, nn, along


@inside
def _solve(engine, contacts, pattern, feet, work, h):  # type: ignore[no-untyped-def]
    """Find friction and the change of velocity that it makes, by Newton's method with a line search."""
    change, direction = work.change, work.direction
    _clear(change)
    _clear(work.found)
    first = 0.0
    # The second time on the loads that friction leaves; the first need not be exact.
    for most in (1, _MOST_ITERATIONS):
        for w in range(contacts.body.shape[0]):
            feet.load[w] = _load(contacts, work, w)
        best = _residual(engine, contacts, pattern, feet, work, h, work.residual)
        first = max(first, best)
        for _ in range(most):
            if not best > _SMALL * first:
                break
            _assemble(engine, contacts, pattern, feet, work, h)
            mj_factorM(engine.model, engine.data)
            mj_solveM(
                engine.model, engine.data, direction.ctypes.data, work.residual.ctypes.data, np.int32(1)
            )
            for i in range(change.shape[0]):
                change[i] -= direction[i]
            scale = 1.0
            while True:
                merit = _residual(engine, contacts, pattern, feet, work, h, work.other)
                if merit < best or scale < _SHORTEST:
                    break
                scale *= 0.5
                for i in range(change.shape[0]):
                    change[i] += scale * direction[i]
            _copy(work.other, work.residual)
            best = merit


@inside
def _residual(engine, contacts, pattern, feet, work, h, out):  # type: ignore[no-untyped-def]
    """Fill what the equation lacks, kg·m/s; return its square; note what the law says."""
    change, motion, rows, found = work.change, work.motion, work.rows, work.found
    _carry(engine.cdof, pattern, change, motion)
    for w in range(contacts.body.shape[0]):
        if w >= contacts.wheels and feet.load[w] == 0.0:
            continue  # touches nothing
        along, across = _slip(contacts, work, w, work.theta[w])
        said = _law(contacts, w, along, across, feet.load[w], feet.push[w], feet.rim[w], h * work.theta[w])
        for k in range(6):
            found[w, k] = said[k]
        found[w, 7] = -contacts.law[3] / (h * work.theta[w]) * (said[5] - feet.rim[w])
        rise = dot(rows[w, _UP], motion[contacts.last[w]])
        found[w, 6] = rise / (h * contacts.softness[w]) if work.press[w] > 0.0 else 0.0
    other = work.yielding[:, 0]
    for i in range(other.shape[0]):
        for k in range(6):
            other[i, k] = 0.0
    for w in range(contacts.body.shape[0]):
        f_t, f_n = h * (found[w, 0] - feet.push[w, 0]), h * (found[w, 1] - feet.push[w, 1])
        spun = h * (found[w, 7] - feet.push[w, 2])
        for k in range(6):
            less = h * found[w, 6] * rows[w, _UP, k]
            pushed = (f_t - spun) * rows[w, _ALONG, k] + spun * rows[w, _HUB, k] + f_n * rows[w, _ACROSS, k]
            other[contacts.last[w], k] += less - pushed
    _project(engine.cdof, pattern, other, out)
    for i in range(change.shape[0]):
        out[i] -= work.bias[i]
    _multiply(pattern, work.metric, change, out)
    total = 0.0
    for i in range(change.shape[0]):
        total += out[i] * out[i]
    return total


@inside
def _assemble(engine, contacts, pattern, feet, work, h):  # type: ignore[no-untyped-def]
    """Fill Newton's matrix, where the engine keeps M: A, the normals that press, friction's slopes."""
    matrix, rows, found, yielding = engine.M, work.rows, work.found, work.yielding
    _clear(yielding)
    for w in range(contacts.body.shape[0]):
        part = -work.theta[w] * h
        tt, tn, nn = part * found[w, 2], part * found[w, 3], part * found[w, 4]
        up = 1 / contacts.softness[w] if work.press[w] > 0.0 else 0.0
        ahead = rows[w, _HUB if found[w, 5] != 0.0 else _ALONG]
        aside, above, own = rows[w, _ACROSS], rows[w, _UP], yielding[contacts.last[w]]
        for a in range(6):
            t, n, z = tt * ahead[a] + tn * aside[a], tn * ahead[a] + nn * aside[a], up * above[a]
            for b in range(6):
                own[a, b] += t * ahead[b] + n * aside[b] + z * above[b]
    _copy(work.metric, matrix)
    for i in range(pattern.entries.shape[0] - 1, -1, -1):
        d, own, p, row = engine.cdof[i], yielding[i], pattern.parent[i], pattern.first[i]
        on = (
            dot(own[0], d),
            dot(own[1], d),
            dot(own[2], d),
            dot(own[3], d),
            dot(own[4], d),
            dot(own[5], d),
        )
        for k in range(row, row + pattern.entries[i]):
            matrix[k] += dot(on, engine.cdof[pattern.column[k]])
        if p >= 0:
            for a in range(6):
                for b in range(6):
                    yielding[p, a, b] += own[a, b]
