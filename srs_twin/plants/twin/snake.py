"""Three-dimensional MuJoCo twin of the snake (`TwinSnake`)."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple, TypedDict

import numpy as np

from srs_twin.compute.arrays import concatenate_records
from srs_twin.errors import DivergedError, InputError, check_choice, count_steps
from srs_twin.io.arguments import checked
from srs_twin.io.provenance import short_digest
from srs_twin.plants.base import (
    BASES,
    TICK_S,
    PneumaticPlant,
    Pose,
    SnakeState,
    SpatialState,
    check_before_step,
    check_initial_state,
    check_plausible,
)
from srs_twin.plants.twin.mjcf.belly import patches
from srs_twin.plants.twin.mjcf.numerics import (
    TIMESTEP_S,
    Contact,
    ContactName,
    LoadedContact,
    ModelSettings,
    Numerics,
    PreloadedContact,
    as_contact,
    preset_of,
)
from srs_twin.plants.twin.mjcf.rules import ROUNDING, check, coupling_violations
from srs_twin.plants.twin.physics import ENGINE_WARNINGS, SnakePhysics, StepBatch
from srs_twin.pneumatics import Pneumatics, Schedule, Trace
from srs_twin.robot.rules import raise_violations
from srs_twin.robot.scale import divide
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World
from srs_twin.sensing import Sensor

_MAX_SPEED = 1e4
"""Joint speed at which a simulation counts as diverged, rad/s or m/s."""

# Contact options that recordings store under a different name.
_CONTACT_KEYS = {
    "law": "friction",
    "slip_speed": "slip_speed_m_s",
    "slip_time": "slip_time_s",
    "axle_time": "axle_time_s",
}


class Loads(NamedTuple):
    """Forces and energies at the samples of a history.

    Attributes:
        floor_force: floor force on each wheel in the world frame, averaged since the
            previous sample, shape (samples, axles, 2, 3), N.
        obstacle_force: horizontal force of obstacles and objects on each connector,
            averaged since the previous sample, shape (samples, N, 2), N.
        body_work: sum of the kinetic energy and the energy dissipated by floor and
            obstacles, shape (samples,), J.
        internal_loss: energy dissipated by the joints of the segments, shape
            (samples,), J.
    """

    floor_force: np.ndarray
    obstacle_force: np.ndarray
    body_work: np.ndarray
    internal_loss: np.ndarray


class TwinSettings(TypedDict, total=False):
    """Keyword arguments of `TwinSnake` that do not depend on its surroundings."""

    contact: Contact | ContactName
    timestep: float | None
    hinges_per_segment: int
    layout: str
    pneumatics: str | Pneumatics
    sensor: str | Sensor
    numerics: Numerics


class TwinKeywords(TwinSettings, total=False):
    """Keyword arguments of `TwinSnake` that all runs of a batch share."""

    tick: float | None
    world: World | None
    base: str


class TwinSnake(PneumaticPlant):
    """Three-dimensional MuJoCo simulation of a snake on wheels, skids or skin.

    A segment exerts the moment k (q_f − q) + c (q̇_f − q̇), with bend q, free bend q_f,
    stiffness k and damping c. The bend of a massless segment without load therefore
    obeys Eq. 14 of the dissertation.

    Attributes:
        max_chunk_s: maximum duration that is simulated at once, s. This duration limits
            the memory for the results of the time steps.
        physics: `SnakePhysics` with the MuJoCo model and data, for quantities that
            `Plant` does not provide.
        timestep: time step, s.
        contact: floor contact. For a robot with skin and loaded contact, it has the
            friction law of the skin.
    """

    name = "twin"
    state_attributes = (
        "physics",
        "_energy_loss",
        "_internal_loss",
        "_connector_heading",
        "_start_height_energy",
    )
    max_chunk_s = 1.0
    has_internal_loss = True

    @checked
    def __init__(
        self,
        spec: RobotSpec,
        *,
        contact: Contact | ContactName = ModelSettings.contact,
        timestep: float | None = None,
        hinges_per_segment: int = ModelSettings.hinges_per_segment,
        supply_pa: float | None = None,
        tick: float | None = None,
        layout: str = "3/2",
        pneumatics: str | Pneumatics = "lag",
        sensor: str | Sensor = "ideal",
        world: World | None = None,
        base: str = ModelSettings.base,
        numerics: Numerics = ModelSettings.numerics,
    ) -> None:
        """Build and compile the model of the twin.

        Args:
            spec: robot to simulate.
            contact: floor contact. The name "loaded" stands for `LoadedContact()`, and
                "preloaded" stands for `PreloadedContact()`.
            timestep: time step, s, which must divide the tick. The default is
                `TIMESTEP_S` times the time unit of the robot (`robot.scale`), adjusted
                so that it divides the tick.
            hinges_per_segment: number of bending hinges per segment.
            supply_pa: supply pressure, Pa. The default is the robot's nominal pressure.
            tick: control tick, s. The default is `TICK_S` times the time unit of the
                robot.
            layout: valve layout, "3/2" or "in_out".
            pneumatics: pneumatic model, which is "lag", "orifice" or a `Pneumatics`
                object.
            sensor: curvature sensor, which is "ideal", "hall" (with default settings)
                or a `Sensor` object.
            world: floor, obstacles and objects. The default is a level floor without
                obstacles.
            base: support of the snake, either "free" on the floor or "clamped" in the
                air at its head.
            numerics: settings that are changed in studies of the twin itself.

        Raises:
            InputError: a name is unknown, the tick is not a multiple of the time step,
                or the twin does not support the combination of arguments
                (`mjcf.rules`).
        """
        contact = as_contact(contact)
        if spec.skin is not None and isinstance(contact, LoadedContact):
            contact = replace(contact, law=spec.skin.friction_law)
        unit = spec.scale.time
        if tick is None:
            tick = TICK_S * unit
        if timestep is None:
            timestep = divide(tick, TIMESTEP_S * unit)
        check_choice("base", base, BASES)
        count_steps("tick", tick, "time step", timestep)
        settings = ModelSettings(timestep, hinges_per_segment, contact, base, numerics)
        self.spec = spec
        self.tick = tick
        self.timestep = timestep
        self.contact = contact
        self._settings = settings.for_robot(spec)
        check(spec, self._settings, world or World())
        self._make_pneumatics_and_sensor(pneumatics, supply_pa, layout, sensor)
        raise_violations(coupling_violations(timestep, self.pneumatics))
        self._set_world(world)
        if spec.is_spatial:
            stiffness = [spec.bending.stiffness, spec.bending.pitch_stiffness]
            self._stiffness: float | np.ndarray = np.array(stiffness)
        else:
            self._stiffness = spec.bending.stiffness
        largest = self.supply_pa * self.pneumatics.max_pressure_ratio
        self.physics = SnakePhysics.build(
            spec, self._settings, self.pneumatics, largest, world
        )
        self.reset()

    def _set_world(self, world: World | None) -> None:
        self.world = world
        self._world = short_digest(world)
        given = world or World()
        self.has_contact = given.is_solid
        self.uneven = given.uneven
        self.objects = len(given.objects)
        self._first_step_x = min((step.x for step in given.steps), default=math.inf)

    def reset(self, *, pose: Pose = (0.0, 0.0, 0.0), seed: int = 0) -> SnakeState:
        """See `Plant.reset`."""
        physics = self.physics
        physics.reset_pose(pose)
        foremost = (
            float(physics.connector_positions()[:, 0].max())
            + self.spec.geometry.wheel_radius
        )
        if foremost >= self._first_step_x:
            raise InputError(
                "a snake must start before the first step of the floor at x ="
                f" {self._first_step_x:g} m, but its front is at x = {foremost:.3g} m;"
                " start further back"
            )
        self._connector_heading = np.full(self.spec.geometry.connectors, float(pose[2]))
        return self._begin(seed, self.pneumatics.rest_trace())

    def set_state(
        self, snake: SnakeState, *, yaw_rate: float = 0.0, seed: int = 0
    ) -> SnakeState:
        """See `Plant.set_state`."""
        self.spec.require_planar("a start with given bends or velocities")
        check_initial_state(snake, yaw_rate, self.spec.segments)
        x, y = map(float, snake.com)
        pose = x, y, float(snake.heading)
        self.reset(pose=pose, seed=seed)
        bend = np.array(snake.bend, dtype=float)
        self.pneumatics.set_state(snake.pressure, bend)
        self.physics.set_state(
            pose,
            np.array([*snake.com_velocity, yaw_rate]),
            bend,
            np.array(snake.bend_rate),
        )
        return self._begin(seed, self.pneumatics.current_trace())

    def _begin(self, seed: int, trace: Trace) -> SnakeState:
        physics = self.physics
        self._start_height_energy = self._potential_energy(physics.center_of_mass())
        self._ticks = 0
        self.seed = seed
        self._energy_loss = self._internal_loss = 0.0
        state = np.concatenate([[0.0], physics.data.qpos, physics.data.qvel])[None]
        loads = Loads(
            floor_force=np.zeros((1, len(physics.wheel_loads()), 2, 3)),
            obstacle_force=np.zeros((1, len(self._connector_heading), 2)),
            body_work=np.array([physics.kinetic_energy()]),
            internal_loss=np.zeros(1),
        )
        self.state = self._observe(np.zeros(1), state, trace, loads).at(0)
        return self.state

    @property
    def sample_step(self) -> float:
        """See `Plant.sample_step`."""
        return self.timestep

    def identity(self) -> dict[str, object]:
        """See `Plant.identity`."""
        return super().identity() | {"world": self._world}

    def _simulate(self, schedule: Schedule, ticks: int, samples: int) -> SnakeState:
        """Simulate a schedule in chunks, which limits the required memory."""
        interval = schedule.span / samples
        steps = count_steps("sample interval", interval, "time step", self.timestep)
        chunk_samples = max(1, math.floor(self.max_chunk_s / interval))
        begun = self._ticks * self.tick
        histories = []
        for first in range(0, samples, chunk_samples):
            count = min(chunk_samples, samples - first)
            chunk = schedule.slice(first * interval, (first + count) * interval)
            try:
                histories.append(
                    self._simulate_chunk(chunk, begun + first * interval, count, steps)
                )
            except DivergedError as error:
                if error.history is not None:
                    histories.append(error.history)
                error.history = SnakeState.history(histories) if histories else None
                raise
        self._ticks += ticks
        return check_plausible(self.name, SnakeState.history(histories))

    def describe(self) -> dict[str, object]:
        """See `Plant.describe`."""
        settings = self._settings
        contact = settings.contact
        options = {
            _CONTACT_KEYS.get(name, name): value
            for name, value in vars(contact).items()
        }
        if isinstance(contact, PreloadedContact):
            options["preload"] = contact.preload_ratio
        return {
            **super().describe(),
            "contact": contact.name,
            **options,
            "hinges_per_segment": settings.hinges_per_segment,
            "base": settings.base,
            "timestep_s": self.timestep,
            "preset": preset_of(settings),
            **vars(settings.numerics),
        }

    def _simulate_chunk(
        self, schedule: Schedule, begun: float, samples: int, steps: int
    ) -> SnakeState:
        ENGINE_WARNINGS.last.clear()
        before = np.concatenate([[0.0], self.physics.data.qpos, self.physics.data.qvel])
        # The state is checked before the step, because MuJoCo would normalise a
        # quaternion with an implausible norm.
        check_before_step(
            self.name,
            begun + self.timestep,
            before,
            self._connector_heading,
            self._energy_loss,
            self._internal_loss,
        )
        trace, batch = self._advance(schedule, samples * steps)
        interval = schedule.span / samples
        times = begun + interval * np.arange(1, samples + 1)
        plausible = self._count_plausible_steps(batch.states)
        complete_samples = plausible // steps
        history = self._chunk_history(times[:complete_samples], trace, batch, steps)
        if plausible < len(batch.states):
            last = batch.states[plausible - 1] if plausible else before
            time = begun + (plausible + 1) * self.timestep
            raise self._divergence_error(
                time, last, history if complete_samples else None
            )
        return history

    def _advance(self, schedule: Schedule, steps: int) -> tuple[Trace, StepBatch]:
        if not self.has_coupled_air:
            interval = steps
        elif self.physics.stepper is not None:
            # Closed chambers act as stiff springs. The simulation is unstable unless
            # bends and pressures are exchanged in every time step.
            interval = 1
        else:
            coupled = self.pneumatics.coupling_step_s / self.timestep
            interval = max(1, math.floor(coupled * ROUNDING))
        traces = []
        results = []
        for first in range(0, steps, interval):
            last = min(first + interval, steps)
            piece = schedule.slice(first * self.timestep, last * self.timestep)
            trace = self.physics.advance_chambers(piece, last - first)
            results.append(self.physics.advance_bodies(trace))
            traces.append(trace.at(np.arange(1, last - first + 1)))
        ends = concatenate_records(traces)
        joined = map(np.concatenate, zip(*results, strict=True))
        return ends, self.physics.evaluate(ends.bend_rate, *joined)

    def _chunk_history(
        self, times: np.ndarray, trace: Trace, batch: StepBatch, steps: int
    ) -> SnakeState:
        count = len(times)
        used = count * steps
        ends = np.arange(1, count + 1) * steps - 1
        loss = self._energy_loss + self.timestep * np.cumsum(batch.power[:used])
        internal = self._internal_loss + self.timestep * np.cumsum(
            batch.internal[:used]
        )
        if used:
            self._energy_loss = float(loss[-1])
            self._internal_loss = float(internal[-1])

        def mean_per_sample(force: np.ndarray) -> np.ndarray:
            by_sample = force[:used].reshape(count, steps, *force.shape[1:])
            mean: np.ndarray = by_sample.mean(axis=1)
            return mean

        loads = Loads(
            floor_force=mean_per_sample(batch.floor_force),
            obstacle_force=mean_per_sample(batch.obstacle_force[:, :, :2]),
            # By conservation of energy, the work of the torques equals the kinetic
            # energy plus the dissipated energy.
            body_work=batch.energy[ends] + loss[ends],
            internal_loss=internal[ends],
        )
        return self._observe(times, batch.states[ends], trace.at(ends), loads)

    def _observe(
        self, times: np.ndarray, states: np.ndarray, trace: Trace, loads: Loads
    ) -> SnakeState:
        kinematics = self.physics.kinematics(states)
        connector_heading = self._unwrap(kinematics.headings)
        body_work = loads.body_work
        if self.uneven or self.spec.is_spatial:
            height_energy = self._potential_energy(kinematics.com)
            body_work = body_work + height_energy - self._start_height_energy
        stored = self.physics.internal_joints.stored(kinematics.qpos, trace.bend)
        deviation = trace.bend - kinematics.bends
        deviation += self.spec.bending.damping_time * (
            trace.bend_rate - kinematics.bend_rates
        )
        floor_force = loads.floor_force.sum(axis=2)
        state = SnakeState(
            time=times,
            com=kinematics.com[:, :2],
            com_velocity=kinematics.com_velocity[:, :2],
            heading=connector_heading.mean(axis=1),
            position=kinematics.positions[..., :2],
            connector_heading=connector_heading,
            bend=kinematics.bends,
            bend_rate=kinematics.bend_rates,
            pressure=trace.pressure,
            valves=trace.valves,
            measured_bend=self.sensor.read(kinematics.bends, times, self.seed),
            contact_force=self._force_on_connectors(floor_force[..., :2]),
            obstacle_force=loads.obstacle_force,
            torque=self._stiffness * deviation,
            # The module `internal_joints` derives this sum from the work ∫ Σ T q̇_f dt.
            work=body_work + loads.internal_loss + stored,
            internal_loss=loads.internal_loss,
            pneumatic_energy=trace.pneumatic_energy,
            qpos=kinematics.qpos,
        )
        if not self.spec.is_spatial:
            return state
        return SpatialState(
            **vars(state),
            height=kinematics.positions[..., 2],
            orientation=kinematics.orientations,
            load=self._force_on_connectors(floor_force[..., 2:])[..., 0],
        )

    def _unwrap(self, headings: np.ndarray) -> np.ndarray:
        """Return headings without jumps of 2π relative to the previous sample.

        The method assumes that a connector rotates by less than π between two samples.
        """
        connector_heading = np.concatenate([self._connector_heading[None], headings])
        if (np.abs(connector_heading[1:] - connector_heading[:-1]) >= math.pi).any():
            connector_heading = np.unwrap(connector_heading, axis=0)
        self._connector_heading = connector_heading[
            -1
        ].copy()  # a copy, because callers may change the returned arrays
        return connector_heading[1:]

    def _force_on_connectors(self, force: np.ndarray) -> np.ndarray:
        if self.spec.skin is not None:
            places = np.array(
                [patch.place for patch in patches(self.spec, self._settings)]
            )
            shared: np.ndarray = np.einsum(
                "ik,skc->sic", self.spec.connector_weights(places), force
            )
            return shared
        # If the robot has a tail, the last connector has two axles, whose forces are
        # added.
        connectors = np.arange(self.spec.geometry.connectors)
        total: np.ndarray = np.add.reduceat(force, connectors, axis=1)
        return total

    def _potential_energy(self, com: np.ndarray) -> np.ndarray:
        energy: np.ndarray = -self.spec.mass.total * (
            com @ self.physics.model.opt.gravity
        )
        return energy

    def _count_plausible_steps(self, states: np.ndarray) -> int:
        clock = states[:, 0]
        # The clock of the engine stops when the simulation diverges.
        moved = np.append(True, clock[1:] > clock[:-1])
        speeds = states[:, 1 + self.physics.model.nq :]
        finite = np.isfinite(states).all(axis=1)
        fine = moved & finite & (np.abs(speeds) < _MAX_SPEED).all(axis=1)
        return int(np.argmin(np.append(fine, False)))

    def _divergence_error(
        self, time: float, before: np.ndarray, history: SnakeState | None
    ) -> DivergedError:
        warned = " ".join(" ".join(dict.fromkeys(ENGINE_WARNINGS.last)).split())
        physics = self.physics
        count = physics.model.nq
        physics.data.qpos[:] = before[1 : 1 + count]
        physics.data.qvel[:] = before[1 + count :]
        physics.refresh()
        x, y, z = physics.center_of_mass()
        bends = ", ".join(f"{bend:.3g}" for bend in physics.bend_angles())
        pose = (
            f"centre of mass ({x:.3g}, {y:.3g}, {z:.3g}) m, heading"
            f" {float(self._connector_heading.mean()):.3g} rad"
        )
        fastest = f"largest speed {np.abs(before[1 + count :]).max():.3g} m/s or rad/s"
        reason = warned or "implausible speeds"
        text = f"{reason}; last plausible state: {pose}, bends {bends} rad, {fastest}"
        return DivergedError(self.name, time, text, history=history)
