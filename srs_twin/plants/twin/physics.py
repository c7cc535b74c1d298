"""MuJoCo simulation of the snake's bodies, driven by the air chambers."""

from __future__ import annotations

import copy
import threading
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import rollout as mujoco_rollout

from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.plants.base import Pose
from srs_twin.plants.twin.contact_loaded import LoadedStepper
from srs_twin.plants.twin.internal_joints import InternalJoints
from srs_twin.plants.twin.mjcf.model import scene_mjcf
from srs_twin.plants.twin.mjcf.numerics import ModelSettings, PreloadedContact
from srs_twin.plants.twin.mjcf.surroundings import (
    collision_geoms as collision_geom_names,
    object_force_sensor,
    object_names,
    place_of,
)
from srs_twin.plants.twin.mjcf.wheels import preload_force, static_loads, treads
from srs_twin.pneumatics import Pneumatics, Schedule, Trace
from srs_twin.pneumatics.chambers import chamber_gains, free_extensions
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World


@dataclass(frozen=True)
class StepBatch:
    """Results of consecutive time steps.

    Attributes:
        states: time, qpos and qvel at the end of each step, shape (steps, 1 + nq + nv).
        floor_force: mean floor force on each wheel during each step in the world frame,
            shape (steps, axles, 2, 3), N.
        energy: kinetic energy at the beginning of each step, shape (steps,), J.
        obstacle_force: mean force of obstacles and objects on each connector and the
            adjoining half segments during each step in the world frame, shape (steps,
            N, 3), N.
        power: power dissipated by floor, obstacles and objects, shape (steps,), W.
        internal: power dissipated by the joints of the segments, shape (steps,), W.
    """

    states: np.ndarray
    floor_force: np.ndarray
    energy: np.ndarray
    obstacle_force: np.ndarray
    power: np.ndarray
    internal: np.ndarray


class SensorAddresses(NamedTuple):
    """Addresses in MuJoCo's arrays, for engines other than the CPU engine.

    Attributes:
        floor_force: address of the floor force on each wheel, shape (wheels,).
        foot_velocity: address of the velocity of each foot, shape (wheels,). With
            loaded contact, the array is empty.
        obstacle_force: address of the obstacle force on each collision geom, shape
            (collision geoms,).
        external_force, external_velocity: addresses of other dissipative force
            components and of the corresponding velocities, shape (components,).
        kinetic_energy: address of the kinetic energy.
        connectors: body ids of the connectors, shape (N,).
        hinges: indices in `qvel` of the bending hinges, shape (segments, hinges per
            segment).
        out_of_plane: indices in `qvel` of the pitch and roll joints of
            `InternalJoints`, shape (joints,).
    """

    floor_force: np.ndarray
    foot_velocity: np.ndarray
    obstacle_force: np.ndarray
    external_force: np.ndarray
    external_velocity: np.ndarray
    kinetic_energy: int
    connectors: np.ndarray
    hinges: np.ndarray
    out_of_plane: np.ndarray


class Sensors(NamedTuple):
    """Addresses of all sensor values, with x, y and z on the last axis of vectors.

    Attributes:
        floor_force: floor force on each wheel, shape (axles, 2, 3).
        foot_velocity: velocity of each foot, shape (axles, 2, 3). With loaded contact,
            the array is empty.
        collision_force: obstacle force on each collision geom, shape (collision geoms,
            3).
        collision_velocity: velocity of the centre of each collision geom, shape
            (collision geoms, 3).
        object_force: force of each object on each collision geom, shape (objects,
            collision geoms, 3).
        drag_force: axial drag on each connector, shape (N,). Without drag, the array is
            empty.
        drag_velocity: velocity of each connector along its heading, shape (N,).
        kinetic_energy: address of the kinetic energy.
    """

    floor_force: np.ndarray
    foot_velocity: np.ndarray
    collision_force: np.ndarray
    collision_velocity: np.ndarray
    object_force: np.ndarray
    drag_force: np.ndarray
    drag_velocity: np.ndarray
    kinetic_energy: int


def find_sensors(
    model: mujoco.MjModel, spec: RobotSpec, settings: ModelSettings
) -> Sensors:
    """Return the sensor addresses of a compiled scene."""

    def addresses(prefix: str, names: Iterable[object]) -> np.ndarray:
        sensors = [model.sensor(f"{prefix}{name}").adr[0] for name in names]
        return np.array(sensors, dtype=int)[:, None] + np.arange(3)

    treads_on_floor = treads(spec, settings) if settings.base == "free" else []
    feet = []
    if not settings.loaded:
        feet = [tread.replace("tread", "foot") for tread in treads_on_floor]
    collision_geoms = collision_geom_names(model)
    objects = object_names(model)
    on_collision_geoms = [
        object_force_sensor(name, collision_geom)
        for name in objects
        for collision_geom in collision_geoms
    ]
    has_drag = settings.base == "free" and spec.friction.drag > 0.0
    dragged = range(1, spec.geometry.connectors + 1) if has_drag else ()
    return Sensors(
        floor_force=addresses("floor_force_", treads_on_floor).reshape(-1, 2, 3),
        foot_velocity=addresses("velocity_", feet).reshape(-1, 2, 3),
        collision_force=addresses("obstacle_force_", collision_geoms),
        collision_velocity=addresses("velocity_", collision_geoms),
        object_force=addresses("", on_collision_geoms).reshape(
            len(objects), len(collision_geoms), 3
        ),
        drag_force=addresses("drag_frc_", dragged)[:, 0],
        drag_velocity=addresses("drag_vel_", dragged)[:, 0],
        kinetic_energy=int(model.sensor("kinetic_energy").adr[0]),
    )


@dataclass(frozen=True)
class Kinematics:
    """Positions and velocities of a snake in several states, in the world frame.

    Attributes:
        qpos: generalised positions, shape (samples, nq).
        com, com_velocity: position (m) and velocity (m/s) of the centre of mass, shape
            (samples, 3).
        positions: positions of the connectors, head first, shape (samples, N, 3), m.
        headings: headings of the connectors, wrapped to (−π, π], shape (samples, N),
            rad.
        bends, bend_rates: bends (rad) and bend rates (rad/s) of the segments, shape
            (samples, segments). For a spatial robot, the shape is (samples, segments,
            2).
        orientations: unit quaternions of the connectors, real part first, shape
            (samples, N, 4).
    """

    qpos: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    positions: np.ndarray
    headings: np.ndarray
    bends: np.ndarray
    bend_rates: np.ndarray
    orientations: np.ndarray


class EngineWarnings(threading.local):
    """Latest MuJoCo warnings on the current thread."""

    def __init__(self) -> None:
        self.last: deque[str] = deque(maxlen=4)


ENGINE_WARNINGS = EngineWarnings()
"""MuJoCo warnings that a `DivergedError` quotes.

A handler collects the warnings, because MuJoCo would otherwise write them to a log
file.
"""


def _keep_warning(text: str) -> None:
    ENGINE_WARNINGS.last.append(text)


mujoco.set_mju_user_warning(_keep_warning)
_ROLLOUT = mujoco_rollout.Rollout(nthread=0)  # simulates on the calling thread
_ROLLOUT_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_SNAKE = 1  # Id of the root body of the snake. Objects are not in its subtree.
# The saved state includes the solver's warm start, so that a resumed simulation is
# bit-identical.
_SAVED_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class SnakePhysics(Stateful):
    """MuJoCo simulation of a snake's bodies, driven by its air chambers.

    Attributes:
        model: compiled model, which is not shared with other objects.
        free: whether the snake moves on a floor instead of having a clamped head.
        stepper: integrator for loaded contact, or None if the snake has preloaded
            contact or a clamped head.
    """

    state_attributes = ("_floor_force", "_last_force", "stepper")

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

        The maximum chamber pressure is `supply_pa` (Pa). Without a world, the floor is
        level and has no obstacles.
        """
        world = world or World()
        # All worlds without obstacles, objects, steps or slope share one compiled
        # model.
        shared = world if world.is_solid or world.uneven else World()
        # The model is copied, so that changes to the model of one twin do not affect
        # other twins.
        model = copy.copy(_compile_scene(spec, settings, supply_pa, shared))
        return cls(model, spec, settings, chambers, world)

    def __init__(
        self,
        model: mujoco.MjModel,
        spec: RobotSpec,
        settings: ModelSettings,
        chambers: Pneumatics,
        world: World,
    ) -> None:
        """Create the simulation of a compiled scene."""
        self.model = model
        self.data = mujoco.MjData(model)
        mujoco.mj_forward(model, self.data)
        self._pneumatics = chambers
        self._spec = spec
        self._settings = settings
        self._world = world
        self.free = settings.base == "free"
        self._static_load = static_loads(spec, settings, -model.opt.gravity[2])
        self._preload = np.zeros_like(self._static_load)
        if isinstance(settings.contact, PreloadedContact) and self.free:
            self._preload = preload_force(spec, settings.contact)
        self._no_force = np.zeros((*self._preload.shape, 3))
        self._floor_force = self._last_force = self._no_force
        connectors = range(1, spec.geometry.connectors + 1)
        self._connectors = [model.body(f"connector_{i}").id for i in connectors]
        self._probe = mujoco.MjData(model)
        self._start = np.empty((1, mujoco.mj_stateSize(model, _ROLLOUT_STATE)))
        self._sensors = find_sensors(model, spec, settings)
        self._collision_fractions = _collision_fractions(
            collision_geom_names(model), len(connectors)
        )
        self.internal_joints = InternalJoints(model, spec, settings)
        # These matrices map qpos to bends and qvel to bend rates. For a spatial robot,
        # the lateral bends of all segments precede the upward bends.
        self._angles = _sum_matrix(self.internal_joints.hinge_positions, model.nq)
        self._rates = _sum_matrix(self.internal_joints.hinges, model.nv)
        self.stepper = None
        if settings.loaded:
            air = chambers.stiffness * self._rates.T @ self._rates
            self.stepper = LoadedStepper(
                model, self.data, spec, settings, air, world.objects
            )

    def __reduce__(self) -> tuple[object, ...]:
        """Return the model and state, from which a copy builds its own engine data."""
        arguments = (
            self.model,
            self._spec,
            self._settings,
            self._pneumatics,
            self._world,
        )
        # The constants are copied as well, because the model may have been changed
        # after they were computed.
        constants = {
            name: value
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray | InternalJoints)
        }
        contact = self.stepper.constants if self.stepper else None
        return type(self), arguments, (self.state_dict(), constants, contact)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        memory, constants, contact = state
        self.__dict__.update(constants)
        if self.stepper is not None:
            self.stepper.constants = contact
        self.load_state_dict(memory)

    @property
    def sensor_addresses(self) -> SensorAddresses:
        """Addresses in MuJoCo's arrays, for engines other than the CPU engine."""
        sensors = self._sensors
        return SensorAddresses(
            floor_force=sensors.floor_force[..., 0].ravel(),
            foot_velocity=sensors.foot_velocity[..., 0].ravel(),
            obstacle_force=sensors.collision_force[:, 0],
            external_force=sensors.drag_force,
            external_velocity=sensors.drag_velocity,
            kinetic_energy=sensors.kinetic_energy,
            connectors=np.array(self._connectors),
            hinges=self.internal_joints.hinges,
            out_of_plane=self.internal_joints.out_of_plane,
        )

    def bends_and_rates(
        self, qpos: np.ndarray, qvel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the bends (rad) and bend rates (rad/s) of one or more states."""
        bends = self._by_segment(qpos @ self._angles.T)
        return bends, self._by_segment(qvel @ self._rates.T)

    def connector_forces(self, collision_force: np.ndarray) -> np.ndarray:
        """Distribute forces on collision geoms to the connectors, shape (…, N, 3), N.

        The argument contains the force on each collision geom, shape (…, collision
        geoms, 3), N.
        """
        force: np.ndarray = np.einsum(
            "ih,...hk->...ik", self._collision_fractions, collision_force
        )
        return force

    def reset_pose(self, pose: Pose) -> None:
        """Reset the snake to rest, with rest bends and empty chambers.

        The pose consists of the x and y coordinates of the centre of mass (m) and the
        mean heading (rad).
        """
        mujoco.mj_resetData(self.model, self.data)
        hinges = self._angles.sum(axis=1, keepdims=True)
        bias = np.zeros(len(hinges))
        bias[: self._spec.segments] = self._spec.modules.array("bias")
        rest_angles = (bias[:, None] * self._angles / hinges).sum(axis=0)
        self.data.qpos[:] += rest_angles
        if self.free:
            self._move_to_pose(pose)
        mujoco.mj_forward(self.model, self.data)
        self.refresh()
        self._pneumatics.reset()
        self._floor_force = self._no_force.copy()
        self._last_force = self._no_force
        if self.stepper is not None:
            self.stepper.reset()
            # The snake has moved horizontally by a few nanometres while it settled.
            self._move_to_pose(pose)
            self.refresh()
        if self.free:
            self._floor_force[..., 2] = self._preload + self._static_load

    def set_state(
        self, pose: Pose, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray
    ) -> None:
        """Set the pose, velocities and bends after `reset_pose`.

        The wheels roll without slip.

        Args:
            pose: x and y coordinates of the centre of mass (m), and mean heading (rad).
            velocity: velocity of the centre of mass in the world frame (m/s) and rate
                of the mean heading (rad/s), shape (3,).
            bend: bends of the segments, shape (segments,), rad.
            rate: bend rates, shape (segments,), rad/s.

        Raises:
            InputError: the head of the snake is clamped.
        """
        if not self.free:
            raise InputError(
                "a snake that is clamped at its head can only start at rest"
            )
        data = self.data
        hinges = self._angles.sum(axis=1)
        data.qpos[:] += ((bend - self.bend_angles()) / hinges) @ self._angles
        data.qpos[3:7] = 1.0, 0.0, 0.0, 0.0
        self._move_to_pose(pose)
        data.qvel[:] = (rate / hinges) @ self._rates
        self.refresh()
        # A rigid-body rotation and translation are added to obtain the required mean
        # velocities.
        data.qvel[5] += velocity[2] - data.cvel[self._connectors, 2].mean()
        self.refresh()
        data.qvel[:2] += velocity[:2] - data.subtree_linvel[_SNAKE][:2]
        self.refresh()
        self._roll_wheels()
        self.refresh()

    def _roll_wheels(self) -> None:
        model = self.model
        data = self.data
        if self.stepper is not None:
            self.stepper.roll()
        for joint in range(model.njnt):
            if not model.joint(joint).name.startswith("axle_"):
                continue
            velocity = np.empty(6)
            mujoco.mj_objectVelocity(
                model,
                data,
                mujoco.mjtObj.mjOBJ_BODY,
                model.jnt_bodyid[joint],
                velocity,
                0,
            )
            forward = np.cross(data.xaxis[joint], [0.0, 0.0, 1.0])
            radius = self._spec.geometry.wheel_radius
            data.qvel[model.jnt_dofadr[joint]] = (
                velocity[3:] @ forward / (radius * (forward @ forward))
            )

    def state_dict(self) -> dict[str, object]:
        """Return the state to save, including MuJoCo's integration state."""
        engine = np.empty(mujoco.mj_stateSize(self.model, _SAVED_STATE))
        mujoco.mj_getState(self.model, self.data, engine, _SAVED_STATE)
        return super().state_dict() | {"engine": engine}

    def load_state_dict(self, state: Mapping[str, object]) -> None:
        """Restore a saved state.

        Raises:
            InputError: the state is incomplete or belongs to another model.
        """
        engine = np.asarray(state.get("engine"))
        if engine.shape != (mujoco.mj_stateSize(self.model, _SAVED_STATE),):
            raise InputError("the saved MuJoCo state is missing or from another model")
        super().load_state_dict(state)
        mujoco.mj_setState(self.model, self.data, engine, _SAVED_STATE)
        self.refresh()

    def _move_to_pose(self, pose: Pose) -> None:
        data = self.data
        self._update_kinematics(data)
        angle = pose[2] - float(np.unwrap(self.connector_headings()).mean())
        yaw = np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
        mujoco.mju_mulQuat(data.qpos[3:7], yaw, data.qpos[3:7].copy())
        self._update_kinematics(data)
        data.qpos[:2] += pose[:2] - data.subtree_com[_SNAKE][:2]

    def advance_chambers(self, schedule: Schedule, steps: int) -> Trace:
        """Advance the chambers and return a trace with steps + 1 rows."""
        times = schedule.span * np.arange(steps + 1) / steps
        return self._pneumatics.advance(
            schedule, times, bend=self.bend_angles(), bend_rate=self.bend_rates()
        )

    def run(self, trace: Trace) -> StepBatch:
        """Advance the bodies with given chamber states and evaluate the steps."""
        return self.evaluate(trace.bend_rate[1:], *self.advance_bodies(trace))

    def advance_bodies(self, trace: Trace) -> tuple[np.ndarray, ...]:
        """Advance the bodies with given chamber states.

        The function returns the arguments of `evaluate` that follow `free_rate`.
        Results of several calls may be concatenated before they are evaluated.

        Args:
            trace: state of the chambers at the beginning of each step and at the end of
                the last step, with steps + 1 rows.
        """
        controls = self.controls(trace)
        if self.stepper is None:
            # MuJoCo evaluates positions at the beginning of a step.
            return self._run_engine(controls[:-1])
        # `LoadedStepper` evaluates positions at mid-step.
        return self.stepper.run((controls[:-1] + controls[1:]) / 2)

    def controls(self, trace: Trace) -> np.ndarray:
        """Return the controls of the actuators for each row of a trace.

        A segment exerts the moment k (q_f − q) + c (q̇_f − q̇), with bend q, free bend
        q_f, stiffness k and damping c. The joints contain dampers, and springs that act
        relative to the rest bends. The actuators exert the rest of the moment.
        """
        spec = self._spec
        driven = (
            trace.bend
            - self._pneumatics.rest_bend
            + spec.bending.damping_time * trace.bend_rate
        )
        if not spec.is_spatial:  # each actuator is controlled by a chamber pressure
            moments = np.maximum(np.stack([driven, -driven], axis=-1), 0.0)
            driven = moments / chamber_gains(spec)
        elif spec.actuator.extension:  # the controls are free bends and extensions
            lengths = free_extensions(spec, trace.pressure)[..., None]
            driven = np.concatenate([driven, lengths], axis=-1)
        controls: np.ndarray = driven.reshape(len(driven), -1)
        return controls

    def evaluate(
        self,
        free_rate: np.ndarray,
        states: np.ndarray,
        sensors: np.ndarray,
        floor_force: np.ndarray | None = None,
        contact_power: np.ndarray | None = None,
        obstacle_friction: np.ndarray | float = 0.0,
    ) -> StepBatch:
        """Evaluate forces, energy and dissipated power in the latest time steps.

        Args:
            free_rate: rates of the free bends at the end of each step, rad/s, shape
                (steps, segments). For a spatial robot, the shape is (steps, segments,
                2).
            states: states as in `StepBatch`. The last row of the states is the current
                state.
            sensors: values of all sensors, shape (steps, nsensordata).
            floor_force: floor force on each wheel as in `StepBatch`. By default, the
                force is read from the sensors.
            contact_power: power dissipated by floor, obstacles and objects, shape
                (steps,), W. By default, the power is computed from the sensors.
            obstacle_friction: friction on each collision geom, shape (steps, 1 +
                objects, collision geoms, 3), N. The first entry of the second axis is
                due to obstacles, and the others are due to the objects. With loaded
                contact, the sensors do not measure obstacle friction.
        """
        self.refresh()
        at = self._sensors
        collision_force = sensors[:, at.collision_force]
        if floor_force is None or contact_power is None:
            floor_force = self._at_feet(sensors, at.floor_force)
            # In an implicit step, a force does work with the velocity at the end of the
            # step. The sensors report this velocity one step later.
            earlier = np.concatenate([self._last_force[None], floor_force[:-1]])
            velocity = self._at_feet(sensors, at.foot_velocity)
            on_feet = earlier[..., :2] * velocity[..., :2]
            contact_power = -on_feet.sum(axis=(1, 2, 3))
            on_collision_geoms = collision_force * sensors[:, at.collision_velocity]
            contact_power -= on_collision_geoms.sum(axis=(1, 2))
        drag = sensors[:, at.drag_force] * sensors[:, at.drag_velocity]
        power = contact_power - drag.sum(axis=1)
        object_force = sensors[:, at.object_force]
        normal = np.concatenate([collision_force[:, None], object_force], axis=1)
        obstacle_force = self.connector_forces((normal + obstacle_friction).sum(axis=1))
        self._floor_force = floor_force.mean(axis=0)
        self._last_force = floor_force[-1]
        # The dampers of the engine use the velocities at the end of a step.
        internal = self.internal_joints.dissipated(
            states[:, 1 + self.model.nq :], free_rate
        )
        energy = sensors[:, at.kinetic_energy]
        return StepBatch(states, floor_force, energy, obstacle_force, power, internal)

    def _run_engine(
        self, chamber_controls: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        model = self.model
        data = self.data
        steps = len(chamber_controls)
        controls = np.zeros((1, steps, model.nu))
        controls[0, :, : chamber_controls.shape[1]] = chamber_controls
        states = np.empty((1, steps, self._start.shape[1]))
        sensors = np.empty((1, steps, model.nsensordata))
        mujoco.mj_getState(model, data, self._start[0], _ROLLOUT_STATE)
        _ROLLOUT.rollout(
            *([model], [data], self._start, controls),
            nstep=steps,
            skip_checks=True,
            initial_warmstart=data.qacc_warmstart[None].copy(),
            state=states,
            sensordata=sensors,
        )
        return states[0], sensors[0]

    def _at_feet(self, sensors: np.ndarray, addresses: np.ndarray) -> np.ndarray:
        if self.free:
            return sensors[:, addresses]
        return np.zeros((len(sensors), *self._no_force.shape))

    def refresh(self) -> None:
        """Recompute positions and velocities, but not contacts, from the state."""
        self._update_kinematics(self.data)

    def kinematics(self, states: np.ndarray) -> Kinematics:
        """Compute positions and velocities from states as in `StepBatch`."""
        count = len(states)
        n = len(self._connectors)
        nq = self.model.nq
        qpos = states[:, 1 : 1 + nq]
        qvel = states[:, 1 + nq :]
        com = np.empty((count, 3))
        velocity = np.empty((count, 3))
        positions = np.empty((count, n, 3))
        frames = np.empty((count, n, 9))
        turns = np.empty((count, n, 4))
        probe = self._probe
        for k in range(count):
            probe.qpos[:] = qpos[k]
            probe.qvel[:] = qvel[k]
            self._update_kinematics(probe)
            com[k] = probe.subtree_com[_SNAKE]
            velocity[k] = probe.subtree_linvel[_SNAKE]
            positions[k] = probe.xpos[self._connectors]
            frames[k] = probe.xmat[self._connectors]
            turns[k] = probe.xquat[self._connectors]
        headings = np.arctan2(frames[..., 3], frames[..., 0])
        bends, rates = self.bends_and_rates(qpos, qvel)
        return Kinematics(qpos, com, velocity, positions, headings, bends, rates, turns)

    def _update_kinematics(self, data: mujoco.MjData) -> None:
        model = self.model
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)

    def kinetic_energy(self) -> float:
        """Return the kinetic energy of the bodies, J."""
        model = self.model
        data = self.data
        mujoco.mj_crb(model, data)
        momentum = np.empty(model.nv)
        mujoco.mj_mulM(model, data, momentum, data.qvel)
        return float(momentum @ data.qvel) / 2

    def bend_angles(self) -> np.ndarray:
        """Return the segment bends, with two columns for a spatial robot, rad."""
        return self._by_segment(self._angles @ self.data.qpos)

    def bend_rates(self) -> np.ndarray:
        """Return the bend rates, with the shape of `bend_angles`, rad/s."""
        return self._by_segment(self._rates @ self.data.qvel)

    def _by_segment(self, rows: np.ndarray) -> np.ndarray:
        if not self._spec.is_spatial:
            return rows
        pairs: np.ndarray = rows.reshape(*rows.shape[:-1], 2, self._spec.segments)
        return pairs.swapaxes(-1, -2)

    def connector_positions(self) -> np.ndarray:
        """Return the positions of the connectors, head first, shape (N, 3), m."""
        return np.array(self.data.xpos[self._connectors])

    def connector_headings(self) -> np.ndarray:
        """Return the connector headings, shape (N,), wrapped to (−π, π], rad."""
        frame = self.data.xmat[self._connectors]
        headings: np.ndarray = np.arctan2(frame[:, 3], frame[:, 0])
        return headings

    def center_of_mass(self) -> np.ndarray:
        """Return the snake's centre of mass, shape (3,), m."""
        return np.array(self.data.subtree_com[_SNAKE])

    def floor_forces(self) -> np.ndarray:
        """Return the mean floor forces on the wheels during the last `run`, N.

        The forces are in the world frame and exclude the preload. The shape is (axles,
        2, 3), with the left wheel before the right wheel.
        """
        force = self._floor_force.copy()
        force[..., 2] -= self._preload
        return force

    def wheel_loads(self) -> np.ndarray:
        """Return the mean wheel loads during the last `run`, shape (axles, 2), N.

        A negative load means that the wheel would lift off without the preload.
        """
        return self.floor_forces()[..., 2]


def _collision_fractions(collision_geoms: list[str], connectors: int) -> np.ndarray:
    fractions = np.zeros((connectors, len(collision_geoms)))
    for k, collision_geom in enumerate(collision_geoms):
        segment, number = place_of(collision_geom)
        count = sum(
            name.startswith(f"collision_{segment}_") for name in collision_geoms
        )
        fraction = np.clip(count / 2 - number, 0.0, 1.0)
        fractions[segment - 1, k] = fraction
        fractions[segment, k] = 1 - fraction
    return fractions


def _sum_matrix(indices: np.ndarray, size: int) -> np.ndarray:
    # Each row of the matrix sums the elements with the indices in one row.
    matrix = np.zeros((len(indices), size))
    np.put_along_axis(matrix, indices, 1.0, axis=1)
    return matrix


@lru_cache(maxsize=8)
def _compile_scene(
    spec: RobotSpec, settings: ModelSettings, supply_pa: float, world: World
) -> mujoco.MjModel:
    model = scene_mjcf(spec, settings, supply_pa=supply_pa, world=world).compile()
    # The controls contain the rates of the free bends and may therefore exceed the
    # limits of the chamber pressures.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    # The solver stops when the cost improves by less than the tolerance times the mean
    # diagonal element of M. The following factor compensates for the effect of the
    # length unit on the moments of inertia in M.
    if settings.base == "free":
        masses = 3 * model.body_subtreemass[_SNAKE]
    else:
        masses = 0.0
    masses += 2 * sum(item.mass for item in world.objects)
    inertias = model.nv * model.stat.meaninertia - masses
    model.opt.tolerance *= (masses + inertias / spec.scale.length**2) / (
        masses + inertias
    )
    return model
