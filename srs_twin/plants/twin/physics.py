"""SnakePhysics: the twin's bodies in MuJoCo, driven by its chambers, and what can be read off them."""

from __future__ import annotations

import copy
import os
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.plants.base import Pose
from srs_twin.plants.twin.contact_loaded import LoadedStepper
from srs_twin.plants.twin.internal_joints import InternalJoints
from srs_twin.pneumatics import Pneumatics, Schedule, Trace
from srs_twin.pneumatics.chambers import as_felt
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World

# Physics needs no screen. dm_control would look for one and warn; whoever renders sets it beforehand.
os.environ.setdefault("MUJOCO_GL", "disabled")

import mujoco  # noqa: E402
from dm_control import mujoco as dm  # noqa: E402
from mujoco import rollout as mujoco_rollout  # noqa: E402

from srs_twin.plants.twin.mjcf.model import scene_mjcf  # noqa: E402
from srs_twin.plants.twin.mjcf.numerics import ModelSettings, PreloadedContact  # noqa: E402
from srs_twin.plants.twin.mjcf.surroundings import hulls as hull_names  # noqa: E402
from srs_twin.plants.twin.mjcf.wheels import preload_force, rest_loads, treads  # noqa: E402


@dataclass(frozen=True)
class StepBatch:
    """What the engine did over some steps.

    Attributes:
        states: at the end of each step: time, qpos, qvel; shape (steps, 1 + nq + nv).
        floor_force: of the floor on each wheel during each step, shape (steps, axles, 2, 3), N, world.
        energy: kinetic energy at each step's beginning, shape (steps,), J.
        obstacle_force: of all obstacles on each connector with the halves of its segments during each step,
            shape (steps, N, 3), N, world.
        power: that the snake spends on floor and obstacles in each step, shape (steps,), W.
        internal: power that joints dissipate inside segments in each step (`internal_joints`), shape
            (steps,), W.
    """

    states: np.ndarray
    floor_force: np.ndarray
    energy: np.ndarray
    obstacle_force: np.ndarray
    power: np.ndarray
    internal: np.ndarray


class Columns(NamedTuple):
    """Where the numbers of sensors stand in `sensordata`, for who steps the bodies elsewhere.

    Attributes:
        load: the first of the force on each wheel.
        foot: the first of its foot's velocity, where friction is the engine's.
        bump: the first of what obstacles press on each hull with.
        pushed: forces but the wheels' that spend energy.
        moving: the velocities that go with them.
        energy: kinetic.
        connectors: the bodies.
        hinges: velocity indices of the hinges, shape (segments, hinges per segment).
        others: velocity indices of the pitch and roll joints whose losses count as work.
    """

    load: np.ndarray
    foot: np.ndarray
    bump: np.ndarray
    pushed: np.ndarray
    moving: np.ndarray
    energy: int
    connectors: np.ndarray
    hinges: np.ndarray
    others: np.ndarray


@dataclass(frozen=True)
class View:
    """What can be seen of the bodies at some moments, the samples first, connectors head first, world frame.

    Attributes:
        qpos: generalised positions, shape (samples, nq).
        com: centre of mass, shape (samples, 3), m.
        com_velocity: same shape, m/s.
        positions: connectors, shape (samples, N, 3), m.
        headings: theirs, shape (samples, N), wrapped to (−π, π], rad.
        bends: shape (samples, segments), rad.
        bend_rates: same shape, rad/s.
    """

    qpos: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    positions: np.ndarray
    headings: np.ndarray
    bends: np.ndarray
    bend_rates: np.ndarray


class EngineWarnings(threading.local):
    """MuJoCo's last warnings on this thread, on which the twin that caused them runs."""

    def __init__(self) -> None:
        self.last: deque[str] = deque(maxlen=4)


ENGINE_WARNINGS = EngineWarnings()
"""Part of a DivergedError's message; without a handler, warnings go to a log file or to stderr."""

mujoco.set_mju_user_warning(lambda text: ENGINE_WARNINGS.last.append(text))
_ENGINE = mujoco_rollout.Rollout(nthread=0)  # steps on the calling thread
_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_MEMORY = mujoco.mjtState.mjSTATE_INTEGRATION


class SnakePhysics(dm.Physics, Stateful):
    """dm_control physics of a snake; `step` advances the chambers, then the bodies.

    The control is a valve command, held in equal slots over the next `step`.
    """

    state_attributes = ("_floor_force", "_last_push", "_schedule", "loaded")

    @classmethod
    def build(
        cls,
        spec: RobotSpec,
        settings: ModelSettings,
        chambers: Pneumatics,
        supply_pa: float,
        world: World | None,
    ) -> SnakePhysics:
        """Compile the scene of a robot.

        Args:
            spec: the robot.
            settings: time step, discretisation, contact.
            chambers: its own.
            supply_pa: largest pressure that can occur, Pa.
            world: what it may run into; None: nothing.
        """
        # A copy: whoever changes a number in the model of one twin must not change the others'.
        felt = world if world and (world.has_obstacles or world.uneven) else None
        model = copy.copy(_compiled(spec, settings, supply_pa, felt))
        return cls._of(model, spec, settings, chambers)

    @classmethod
    def _of(
        cls, model: mujoco.MjModel, spec: RobotSpec, settings: ModelSettings, chambers: Pneumatics
    ) -> SnakePhysics:
        """Return the physics of a compiled scene, which becomes its own."""
        physics: SnakePhysics = cls.from_model(dm.wrapper.MjModel(model))
        physics._attach(spec, settings, chambers)
        return physics

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy the model and the memory; the engine's data are made again, because they hold addresses."""
        made_of = self.model.ptr, self._spec, self._settings, self._pneumatics
        # Numbers of a model may have been changed since these were taken from it.
        kinds = np.ndarray | InternalJoints
        settled = {name: value for name, value in vars(self).items() if isinstance(value, kinds)}
        contact = None if self.loaded is None else self.loaded.settled
        return type(self)._of, made_of, (self.state_dict(), settled, contact)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        memory, settled, contact = state
        self.__dict__.update(settled)
        if self.loaded is not None:
            self.loaded.settled = contact
        self.load_state_dict(memory)

    def copy(self, share_model: bool = False) -> SnakePhysics:
        """Return a copy that shares neither chambers nor model.

        Raises:
            InputError: the model is to be shared.
        """
        if share_model:
            raise InputError("copies of a snake's physics cannot share its model; leave out share_model")
        return copy.deepcopy(self)

    def _attach(self, spec: RobotSpec, settings: ModelSettings, pneumatics: Pneumatics) -> None:
        raw = self.model.ptr
        self._pneumatics, self._spec, self._settings = pneumatics, spec, settings
        self.free, contact = settings.base == "free", settings.contact
        self._rest_load = rest_loads(spec, -raw.opt.gravity[2])
        self._preload = np.zeros_like(self._rest_load)
        if isinstance(contact, PreloadedContact) and self.free:
            self._preload = preload_force(spec, contact)
        self._connectors = [raw.body(f"connector_{i}").id for i in range(1, spec.geometry.connectors + 1)]
        self._probe = mujoco.MjData(raw)
        self._start = np.empty((1, mujoco.mj_stateSize(raw, _STATE)))
        feet = treads(spec) if self.free else []
        # Of each axle's left and right foot, shape (axles, 2, 3).
        self._force_columns = self._columns([f"floor_force_{foot}" for foot in feet]).reshape(-1, 2, 3)
        velocities = [] if settings.loaded else [foot.replace("tread", "velocity_foot") for foot in feet]
        self._foot_columns = self._columns(velocities).reshape(-1, 2, 3)
        self._energy_column = raw.sensor("kinetic_energy").adr[0]
        count = spec.geometry.connectors if self.free and spec.friction.drag > 0.0 else 0
        drags = [[f"drag_{kind}_{i + 1}" for i in range(count)] for kind in ("frc", "vel")]
        self._drag_force, self._drag_velocity = (self._columns(names)[:, 0] for names in drags)
        self._attach_hulls(raw, spec)
        # Bends are sums of hinge angles.
        self._angles, self._rates = np.zeros((spec.segments, raw.nq)), np.zeros((spec.segments, raw.nv))
        for j in range(spec.segments):
            for k in range(settings.hinges_per_segment):
                hinge = raw.joint(f"hinge_{j + 1}_{k + 1}")
                self._angles[j, hinge.qposadr[0]] = self._rates[j, hinge.dofadr[0]] = 1.0
        self.internal = InternalJoints(raw, spec, settings)
        self._no_force = np.zeros((*self._preload.shape, 3))
        self._floor_force = self._last_push = self._no_force
        air = pneumatics.stiffness * self._rates.T @ self._rates
        self.loaded = LoadedStepper(raw, self.data.ptr, spec, settings, air) if settings.loaded else None

    def _attach_hulls(self, raw: mujoco.MjModel, spec: RobotSpec) -> None:
        hulls = hull_names(raw)
        self._hull_force = self._columns([f"obstacle_force_{hull}" for hull in hulls])
        self._hull_velocity = self._columns([f"velocity_{hull}" for hull in hulls])
        # Pieces 0…n of segment j count from the head: the first half goes to connector j.
        self._owners = np.zeros((spec.geometry.connectors, len(hulls)))
        for k, hull in enumerate(hulls):
            segment, piece = map(int, hull.split("_")[1:])
            pieces = sum(other.startswith(f"hull_{segment}_") for other in hulls)
            share = np.clip(pieces / 2 - piece, 0.0, 1.0)
            self._owners[segment - 1, k], self._owners[segment, k] = share, 1 - share

    @property
    def columns(self) -> Columns:
        """Where the numbers of sensors stand."""
        return Columns(
            load=self._force_columns[..., 0].ravel(),
            foot=self._foot_columns[..., 0].ravel(),
            bump=self._hull_force[:, 0],
            pushed=np.concatenate([self._hull_force.ravel(), self._drag_force]),
            moving=np.concatenate([self._hull_velocity.ravel(), self._drag_velocity]),
            energy=int(self._energy_column),
            connectors=np.array(self._connectors),
            hinges=self.internal.hinges,
            others=self.internal.others,
        )

    def seen(self, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return bends and their rates of states, shapes (…, nq) and (…, nv)."""
        return qpos @ self._angles.T, qvel @ self._rates.T

    def bumped(self, push: np.ndarray) -> np.ndarray:
        """Return the obstacles' forces on connectors from those on hulls, shape (…, hulls, 3)."""
        return np.einsum("ih,...hk->...ik", self._owners, push)

    def _columns(self, names: list[str]) -> np.ndarray:
        """Return where the three numbers of each sensor stand, shape (sensors, 3)."""
        first = np.array([self.model.ptr.sensor(name).adr[0] for name in names], dtype=int)
        return first[:, None] + np.arange(3)

    def lay_down(self, pose: Pose) -> None:
        """Reset to a snake at rest with its centre of mass at x, y (m) and mean heading (rad).

        It is straight but for what its modules bend by without pressure.
        """
        with self.reset_context():
            hinges = self._angles.sum(axis=1, keepdims=True)
            bent = (self._spec.modules.array("bias")[:, None] * self._angles / hinges).sum(axis=0)
            self.data.qpos[:] += bent
            if self.free:
                self._turn_to(pose)
        self.refresh()
        self._pneumatics.reset()
        self._schedule = self._pneumatics.schedule(self._pneumatics.valves, 1.0)
        self._floor_force, self._last_push = self._no_force.copy(), self._no_force
        if self.loaded is not None:
            self.loaded.reset()
            self._turn_to(pose)  # it moved by some nanometres as it sank in
            self.refresh()
        if self.free:
            # At rest every wheel carries its share of the weight, and its preload.
            self._floor_force[..., 2] = self._preload + self._rest_load

    def place(self, pose: Pose, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray) -> None:
        """Move a snake that has been laid down; its wheels roll.

        Args:
            pose: centre of mass x, y (m) and mean heading (rad).
            velocity: of the centre of mass, world frame (m/s), and of the mean heading (rad/s), shape (3,).
            bend: shape (segments,), rad.
            rate: same shape, rad/s.

        Raises:
            InputError: a snake that is held at its head.
        """
        if not self.free:
            raise InputError("a snake that is held at its head begins at rest only")
        raw, data = self.model.ptr, self.data.ptr
        hinges = self._angles.sum(axis=1)
        data.qpos[:] += ((bend - self.bend_angles()) / hinges) @ self._angles
        data.qpos[3:7] = 1.0, 0.0, 0.0, 0.0
        self._turn_to(pose)
        data.qvel[:] = (rate / hinges) @ self._rates
        self.refresh()
        # The chain turns and moves as one with its head, until the means are as asked.
        data.qvel[5] += velocity[2] - data.cvel[self._connectors, 2].mean()
        self.refresh()
        data.qvel[:2] += velocity[:2] - data.subtree_linvel[0][:2]
        self.refresh()
        self._roll_wheels(raw, data)
        self.refresh()

    def _roll_wheels(self, raw: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Let the wheels turn as fast as what they carry moves along its heading."""
        if self.loaded is not None:
            self.loaded.roll()
        for number in range(1, len(self._spec.axles) + 1):
            for side in ("left", "right"):
                joint = mujoco.mj_name2id(raw, mujoco.mjtObj.mjOBJ_JOINT, f"axle_{side}_{number}")
                if joint < 0:
                    continue
                wheel, axis, moving = raw.jnt_bodyid[joint], data.xaxis[joint], np.empty(6)
                mujoco.mj_objectVelocity(raw, data, mujoco.mjtObj.mjOBJ_BODY, wheel, moving, 0)
                ahead = np.cross(axis, [0.0, 0.0, 1.0])
                spin = moving[3:] @ ahead / (self._spec.geometry.wheel_radius * (ahead @ ahead))
                data.qvel[raw.jnt_dofadr[joint]] = spin

    def state_dict(self) -> dict[str, Any]:
        """See `Stateful`; the engine's own memory is what it calls the state of integration."""
        engine = np.empty(mujoco.mj_stateSize(self.model.ptr, _MEMORY))
        mujoco.mj_getState(self.model.ptr, self.data.ptr, engine, _MEMORY)
        return super().state_dict() | {"engine": engine}

    def load_state_dict(self, memory: Mapping[str, Any]) -> None:
        """See `Stateful`."""
        super().load_state_dict(memory)
        mujoco.mj_setState(self.model.ptr, self.data.ptr, memory["engine"], _MEMORY)
        self.refresh()

    def _turn_to(self, pose: Pose) -> None:
        """Put the centre of mass at x, y (m) and the mean heading (rad)."""
        raw = self.data.ptr
        self._place(raw)
        turn = pose[2] - float(np.unwrap(self.connector_headings()).mean())
        yaw = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
        mujoco.mju_mulQuat(raw.qpos[3:7], yaw, raw.qpos[3:7].copy())
        self._place(raw)
        self.data.qpos[:2] += pose[:2] - raw.subtree_com[0][:2]

    def set_control(self, control: np.ndarray) -> None:
        """Command the valves for the next `step`: (segments, 2) or (slots, segments, 2)."""
        self._schedule = self._pneumatics.schedule(control, 1.0)

    def step(self, nstep: int = 1) -> None:
        """Advance chambers and bodies by `nstep` time steps."""
        span = nstep * self.timestep()
        with self.check_invalid_state():
            self.run(self.fill(self._schedule.stretched(span), nstep).pressure)

    def fill(self, schedule: Schedule, steps: int) -> Trace:
        """Advance the chambers over a schedule; return them at each step's beginning and at the end."""
        times = schedule.span * np.arange(steps + 1) / steps
        return self._pneumatics.advance(schedule, times, bend=self.bend_angles(), bend_rate=self.bend_rates())

    def run(self, pressure: np.ndarray) -> StepBatch:
        """Advance the bodies under given pressures; `roll` and `recorded` in one."""
        return self.recorded(*self.roll(pressure))

    def roll(self, pressure: np.ndarray) -> tuple[np.ndarray, ...]:
        """Advance the bodies under given pressures; what `recorded` takes of any number of steps.

        Args:
            pressure: of each chamber at each step's beginning and at the end, shape (steps + 1, segments, 2),
                Pa.
        """
        # Those that drive a step are those of when its positions are: of its beginning, or its middle.
        pressure = pressure[:-1] if self.loaded is None else (pressure[:-1] + pressure[1:]) / 2
        # MuJoCo's muscles are linear in their control.
        felt = as_felt(self._spec, pressure).reshape(len(pressure), -1)
        return self._roll(felt) if self.loaded is None else self.loaded.run(felt)

    def recorded(
        self,
        states: np.ndarray,
        sensed: np.ndarray,
        force: np.ndarray | None = None,
        spent: np.ndarray | None = None,
        rubbed: np.ndarray | float = 0.0,
    ) -> StepBatch:
        """Return what the engine did over some steps, at whose end it stands.

        Args:
            states: as `StepBatch` has them.
            sensed: all sensors, shape (steps, nsensordata).
            force: the floor's, as `StepBatch` has it, and
            spent: what friction takes, shape (steps,), W; None: from the sensors.
            rubbed: the obstacles' friction where the sensors do not have it, shape (steps, hulls, 3), N.
        """
        self.refresh()
        if force is None or spent is None:
            force = self._at_feet(sensed, self._force_columns)
            # The floor's force acts with the velocity that it leads to, at the end of its step.
            earlier = np.concatenate([self._last_push[None], force[:-1]])[..., :2]
            spent = -(earlier * self._at_feet(sensed, self._foot_columns)[..., :2]).sum(axis=(1, 2, 3))
        push = sensed[:, self._hull_force]
        power = spent - (push * sensed[:, self._hull_velocity]).sum(axis=(1, 2))
        power -= (sensed[:, self._drag_force] * sensed[:, self._drag_velocity]).sum(axis=1)
        bumps = self.bumped(push + rubbed)
        self._floor_force, self._last_push = force.mean(axis=0), force[-1]
        # The engine's dampers act with the velocities at the end of a step.
        internal = self.internal.dissipated(states[:, 1 + self.model.nq :])
        return StepBatch(states, force, sensed[:, self._energy_column], bumps, power, internal)

    def _roll(self, felt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Let the engine make all steps in one; return states and sensors."""
        model, data, steps = self.model.ptr, self.data.ptr, len(felt)
        controls = np.zeros((1, steps, model.nu))
        controls[0, :, : felt.shape[1]] = felt
        states, sensed = np.empty((1, steps, self._start.shape[1])), np.empty((1, steps, model.nsensordata))
        mujoco.mj_getState(model, data, self._start[0], _STATE)
        _ENGINE.rollout(
            *([model], [data], self._start, controls),
            nstep=steps,
            skip_checks=True,
            initial_warmstart=data.qacc_warmstart[None].copy(),
            state=states,
            sensordata=sensed,
        )
        return states[0], sensed[0]

    def _at_feet(self, sensed: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return what is sensed at the feet, shape (steps, axles, 2, 3); 0 where there is no floor."""
        return sensed[:, columns] if self.free else np.zeros((len(sensed), *self._no_force.shape))

    def refresh(self) -> None:
        """Bring places and velocities to the state's; contacts stay those of the last step's beginning."""
        self._place(self.data.ptr)

    def look(self, states: np.ndarray) -> View:
        """Return what is to be seen in given states (`StepBatch.states`); the present one stays."""
        count, n, nq = len(states), len(self._connectors), self.model.nq
        qpos, qvel = states[:, 1 : 1 + nq], states[:, 1 + nq :]
        com, velocity = np.empty((count, 3)), np.empty((count, 3))
        places, frames = np.empty((count, n, 3)), np.empty((count, n, 9))
        probe = self._probe
        for k in range(count):
            probe.qpos[:], probe.qvel[:] = qpos[k], qvel[k]
            self._place(probe)
            com[k], velocity[k] = probe.subtree_com[0], probe.subtree_linvel[0]
            places[k], frames[k] = probe.xpos[self._connectors], probe.xmat[self._connectors]
        headings = np.arctan2(frames[..., 3], frames[..., 0])
        return View(qpos, com, velocity, places, headings, *self.seen(qpos, qvel))

    def _place(self, data: mujoco.MjData) -> None:
        model = self.model.ptr
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)

    def kinetic_energy(self) -> float:
        """Return the bodies' kinetic energy, J."""
        raw, data = self.model.ptr, self.data.ptr
        mujoco.mj_crb(raw, data)
        momentum = np.empty(raw.nv)
        mujoco.mj_mulM(raw, data, momentum, data.qvel)
        return float(momentum @ data.qvel) / 2

    def bend_angles(self) -> np.ndarray:
        """Return the bends q_j, shape (segments,), rad."""
        return self._angles @ self.data.qpos

    def bend_rates(self) -> np.ndarray:
        """Return the bend rates, shape (segments,), rad/s."""
        return self._rates @ self.data.qvel

    def connector_positions(self) -> np.ndarray:
        """Return the connectors, head first, shape (N, 3), m."""
        return self.data.xpos[self._connectors].copy()

    def connector_headings(self) -> np.ndarray:
        """Return the connectors' headings, shape (N,), wrapped to (−π, π], rad."""
        frame = self.data.xmat[self._connectors]
        return np.arctan2(frame[:, 3], frame[:, 0])

    def center_of_mass(self) -> np.ndarray:
        """Return the snake's centre of mass, shape (3,), m."""
        return self.data.subtree_com[0].copy()

    def floor_forces(self) -> np.ndarray:
        """Return the floor's force on each wheel less the preload, mean over the last `step`, world frame.

        Shape (axles, 2, 3): axle, left and right wheel, x y z, N.
        """
        force = self._floor_force.copy()
        force[..., 2] -= self._preload
        return force

    def wheel_loads(self) -> np.ndarray:
        """Return the normal load of each wheel, mean over the last `step`, shape (axles, 2), N.

        Below 0: without preload the wheel would lift.
        """
        return self.floor_forces()[..., 2]


@lru_cache(maxsize=8)
def _compiled(
    spec: RobotSpec, settings: ModelSettings, supply_pa: float, world: World | None
) -> mujoco.MjModel:
    """Return the compiled scene; the same once more costs a tenth of it."""
    return scene_mjcf(spec, settings, supply_pa=supply_pa, world=world).compile()
