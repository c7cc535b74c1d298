"""Plant `AnalyticalSnake`, which implements the analytical models of the snake."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Unpack

import numpy as np

from srs_twin.compute.arrays import check_positive, concatenate_records
from srs_twin.errors import DivergedError
from srs_twin.io.arguments import checked
from srs_twin.io.provenance import short_digest
from srs_twin.plants.analytical import kernels
from srs_twin.plants.analytical.bodies import (
    Body,
    ClampedBends,
    CompliantBends,
    Motion,
    PrescribedBends,
)
from srs_twin.plants.analytical.cells import (
    Cells,
    LumpedSegments,
    cells_of_skin,
    cells_of_wheels,
)
from srs_twin.plants.analytical.floor import FloorFriction, floor_friction
from srs_twin.plants.analytical.kernels import PrescribedModel
from srs_twin.plants.analytical.kinematics import BodyParameters
from srs_twin.plants.analytical.obstacles import make_obstacles
from srs_twin.plants.analytical.options import (
    SLIP_SPEED_M_S,
    TOLERANCE_M_S,
    AnalyticalOptions,
    OptionKeywords,
    default_timestep,
)
from srs_twin.plants.analytical.quasistatic import QuasistaticArcs
from srs_twin.plants.analytical.steps import TimeSteps
from srs_twin.plants.base import (
    TICK_S,
    PneumaticPlant,
    Pose,
    SnakeState,
    check_before_step,
    check_initial_state,
    check_plausible,
)
from srs_twin.pneumatics import Pneumatics, Schedule, Trace
from srs_twin.robot.spec import GRAVITY, RobotSpec
from srs_twin.robot.world import World
from srs_twin.sensing import Sensor

# Maximum interval between two exchanges of bends and pressures for a body with point
# masses and a time unit of 1, s. With 0.25 ms instead, the pressures oscillate and fall
# below ambient pressure.
_POINT_MASS_COUPLING_STEP = 0.0001


class AnalyticalSnake(PneumaticPlant):
    """Snake with the planar model of the dissertation (Section 3.1) or a variant of it.

    The snake is a chain of masses that are connected by arcs of constant curvature. The
    equation of motion is Eq. 11, summed over the body (E22), and Eq. 14 determines the
    bends. The class `AnalyticalOptions` describes the variants.

    Attributes:
        timestep: maximum time step of the integrator, s.
    """

    name = "analytical"
    state_attributes = ("body",)
    max_chunk_s = 10.0

    @checked
    def __init__(
        self,
        spec: RobotSpec,
        *,
        supply_pa: float | None = None,
        tick: float | None = None,
        layout: str = "3/2",
        pneumatics: str | Pneumatics = "lag",
        sensor: str | Sensor = "ideal",
        world: World | None = None,
        **options: Unpack[OptionKeywords],
    ) -> None:
        """Build the model.

        Args:
            spec: robot to simulate.
            supply_pa: supply pressure, by default the robot's nominal pressure, Pa.
            tick: duration of a control tick, by default `TICK_S` times the time unit of
                the robot (`robot.scale`), s.
            layout: valve layout, "3/2" or "in_out".
            pneumatics: model of valves and chambers, "lag", "orifice" or a `Pneumatics`
                object.
            sensor: curvature sensor, "ideal", "hall" or a `Sensor` object.
            world: slope of the floor and obstacles, by default a level floor without
                obstacles.
            **options: fields of `AnalyticalOptions`, such as model="compliant" or
                friction="wheel".

        Raises:
            InputError: the tick or an option is invalid, or the model does not support
                the robot or the world.
        """
        self.spec = spec
        self.world: World = world or World()
        self.options = AnalyticalOptions(**options)
        self.options.check(spec, self.world)
        unit = spec.scale.time
        self.tick = TICK_S * unit if tick is None else tick
        check_positive("tick", self.tick, "s")
        self.timestep = self.options.timestep or default_timestep(self.tick, spec.scale)
        self._tolerance = self.options.tolerance or TOLERANCE_M_S * unit
        self._make_pneumatics_and_sensor(pneumatics, supply_pa, layout, sensor)
        self.has_contact = self.options.contact and self.world.has_obstacles
        self._floor = self._make_floor()
        self.body = self._make_body()
        self.reset()

    @property
    def friction(self) -> str:
        """Friction law of the floor, one of `robot.friction.FRICTION_LAWS`."""
        return self.options.friction_law_on(self.spec)

    def _make_floor(self) -> FloorFriction:
        spec = self.spec
        mu = spec.friction
        unit = spec.scale.time
        slip_speed = self.options.slip_speed
        if slip_speed is None:
            slip_speed = SLIP_SPEED_M_S * unit
        track = self.options.track_of(spec)
        load_transfer = 0.0
        if self.options.load == "instantaneous":
            load_transfer = spec.geometry.com_height / (2 * track)
        floor = floor_friction(
            self.friction,
            track,
            mu.mu_t,
            mu.mu_n,
            slip_speed,
            load_transfer=load_transfer,
            mu_back=None if spec.skin is None else mu.backward,
        )
        pull_x, pull_y, pull_z = (GRAVITY * part for part in self.world.floor.down)
        return floor._replace(
            drag=mu.drag / spec.geometry.connectors,
            gravity=-pull_z,
            pull_x=pull_x,
            pull_y=pull_y,
            unit=unit,
        )

    def reset(self, *, pose: Pose = (0.0, 0.0, 0.0), seed: int = 0) -> SnakeState:
        """See `Plant.reset`."""
        self.pneumatics.reset()
        self._ticks = 0
        self.seed = seed
        self.body.reset(pose)
        return self._observe_start(self.pneumatics.rest_trace())

    def set_state(
        self, snake: SnakeState, *, yaw_rate: float = 0.0, seed: int = 0
    ) -> SnakeState:
        """See `Plant.set_state`."""
        check_initial_state(snake, yaw_rate, self.spec.segments)
        x, y = map(float, snake.com)
        self.reset(pose=(x, y, float(snake.heading)), seed=seed)
        self.pneumatics.set_state(snake.pressure, snake.bend)
        trace = self.pneumatics.current_trace()
        bend = trace.bend[0]
        rate = trace.bend_rate[0]
        if self.body.compliant:
            bend = np.array(snake.bend, dtype=float)
            rate = np.array(snake.bend_rate, dtype=float)
        velocity = np.array([*snake.com_velocity, yaw_rate])
        self.body.set_state(velocity, bend, rate)
        return self._observe_start(trace)

    def _observe_start(self, trace: Trace) -> SnakeState:
        body = self.body
        now = body.motion(body.state[None].copy(), body.velocity[None].copy(), trace)
        self.state = self._observe(np.zeros(1), now, trace).at(0)
        return self.state

    def _simulate(self, schedule: Schedule, ticks: int, samples: int) -> SnakeState:
        begun = self._ticks * self.tick
        check_before_step(
            self.name, begun + self.timestep, self.body.state, self.body.velocity
        )
        steps = self.steps(self.pneumatics.effective_schedule(schedule), samples)
        done, motion, trace = self._advance(schedule, steps)
        times = begun + schedule.span * np.arange(1, samples + 1) / samples
        history = self._observe(times[: len(motion.states)], motion, trace)
        if done < len(steps.ends):
            state = ", ".join(f"{value:.4g}" for value in self.body.state)
            text = (
                f"step {done + 1} of {len(steps.ends)} has no plausible solution; last"
                f" state: {state}"
            )
            raise DivergedError(
                self.name, begun + steps.ends[done], text, history=history
            )
        self._ticks += ticks
        return check_plausible(self.name, history)

    def _advance(
        self, schedule: Schedule, steps: TimeSteps
    ) -> tuple[int, Motion, Trace]:
        # If the pressures depend on compliant bends, chambers and body are advanced
        # alternately, in chunks of about one coupling interval.
        motions = []
        traces = []
        done = 0
        for chunk_schedule, chunk in self._chunks(schedule, steps):
            bend, rate = self.body.bends()
            trace = self.pneumatics.advance(
                chunk_schedule, chunk.stage_times, bend=bend, bend_rate=rate
            )
            completed, states, velocities = self.body.move(
                chunk.lengths, trace, chunk.sample_steps
            )
            reached = int(np.searchsorted(chunk.sample_steps, completed, side="right"))
            traces.append(trace.at(2 * chunk.sample_steps[:reached]))
            motions.append(
                self.body.motion(states[:reached], velocities[:reached], traces[-1])
            )
            done += completed
            if completed < len(chunk.lengths):
                break
        return done, concatenate_records(motions), concatenate_records(traces)

    def _chunks(
        self, schedule: Schedule, steps: TimeSteps
    ) -> Iterator[tuple[Schedule, TimeSteps]]:
        if not self.has_coupled_air:
            yield schedule, steps
            return
        for begin, end, piece in steps.chunks(self._coupling_step):
            yield schedule.slice(begin, end), piece

    @property
    def jumps(self) -> int:
        """Number of jumps between resting poses, always 0 in planar models."""
        return self.body.jumps

    def describe(self) -> dict[str, object]:
        """See `Plant.describe`."""
        options = self.options
        about = super().describe() | {
            "model": options.model,
            "base": options.base,
            "friction": self.friction,
            "friction_torque": options.friction_torque,
            "inertia": options.inertia,
            "track_m": self._floor.track,
            "timestep_s": self.timestep,
            "slip_speed_m_s": self._floor.slip,
            "tolerance_m_s": self._tolerance,
        }
        if options.contact:
            about |= {"contact": True, "cells": options.cells}
        if options.load != "static":
            about["load"] = options.load
        return about

    def identity(self) -> dict[str, object]:
        """See `Plant.identity`."""
        identity = super().identity() | {"floor": short_digest(self.world.floor)}
        if self.has_contact:
            identity["world"] = short_digest(self.world)
        return identity

    def _make_body(self) -> Body:
        options = self.options
        floor = self._floor
        if self.spec.is_spatial:
            return QuasistaticArcs(self.spec, floor.slip, options.base)
        cells = self._divide()
        frozen = 1.0 if options.model == "simplified" else 0.0
        inertia = self._connector_inertia(cells.mass)
        solid = BodyParameters.of(cells.mass, inertia, cells.length, cells.gap, frozen)
        if isinstance(cells, Cells):
            # All points of a divided body share the drag on the connectors equally.
            drag = floor.drag * self.spec.geometry.connectors / len(cells.mass)
            floor = floor._replace(drag=drag)
        if options.base == "clamped":
            return ClampedBends(solid, floor, cells)
        if options.model != "compliant":
            model = PrescribedModel(solid, floor, options.friction_torque)
            return PrescribedBends(model, cells, self._tolerance)
        obstacles = None
        if self.has_contact:
            obstacles = make_obstacles(self.world, self.spec, cells, floor.slip)
        return CompliantBends(self.spec, solid, floor, cells, obstacles)

    def _divide(self) -> LumpedSegments:
        if self.spec.skin is not None:
            return cells_of_skin(self.spec)
        if self.has_contact:
            return cells_of_wheels(self.spec, self.options.cells)
        return LumpedSegments(self.spec)

    @property
    def has_coupled_air(self) -> bool:
        """See `PneumaticPlant.has_coupled_air`."""
        return super().has_coupled_air and self.body.compliant

    @property
    def _coupling_step(self) -> float:
        step = self.pneumatics.coupling_step_s
        if not self.body.solid.inertia.all():
            step = min(step, _POINT_MASS_COUPLING_STEP * self.spec.scale.time)
        return step

    def _connector_inertia(self, mass: np.ndarray) -> np.ndarray:
        inertia = np.zeros_like(mass)
        geometry = self.spec.geometry
        if self.options.inertia == "lumped":
            segments = np.full(len(mass), 2.0)  # number of adjoining segments
            segments[[0, -1]] = 1.0
            inertia = segments * mass * geometry.pitch**2 / 3
        elif self.options.inertia == "connector" and self.spec.skin is not None:
            inertia = mass * geometry.width**2 / 12
        elif self.options.inertia == "connector":
            inertia[:: (len(mass) - 1) // self.spec.segments] = self.spec.yaw_inertia()
        return inertia

    def steps(self, schedule: Schedule, samples: int) -> TimeSteps:
        """Return the time steps of the integrator for a schedule.

        Args:
            schedule: valve commands.
            samples: number of equally spaced samples, each at the end of a step.
        """
        longest = self.timestep
        if self.has_coupled_air:
            longest = min(longest, self._coupling_step)
        return TimeSteps.between(
            schedule.span,
            schedule.events,
            samples,
            longest=longest,
            same=1e-9 * self.tick,
        )

    def _observe(self, time: np.ndarray, motion: Motion, trace: Trace) -> SnakeState:
        body = self.body
        if isinstance(body, QuasistaticArcs):
            measured_bend = self.sensor.read(motion.bend, time, self.seed)
            return body.observe(time, motion, trace, measured_bend)
        cells = body.cells
        states = motion.states
        wheels = self._floor._replace(drag=0.0)
        bends = kernels.Bends(motion.bend, motion.bend_rate)
        seen = kernels.observe(states, motion.velocities, bends, body.solid, wheels)
        connector_heading = cells.at_connectors(seen.connector_heading)
        heading = states[:, kernels.HEADING]
        if isinstance(cells, Cells):
            heading = connector_heading.mean(axis=1)
        obstacles = np.zeros((len(time), self.spec.geometry.connectors, 2))
        work = states[:, kernels.ENERGY_LOSS]
        if self.has_contact:
            assert isinstance(cells, Cells), "a body among obstacles is divided"
            forces = states[:, kernels.STATES : -1].reshape(len(time), -1, 2)
            obstacles = cells.obstacle_force(forces)
        else:
            work = work + (seen.energy + body.stored(motion.bend, trace.bend))
        bend = cells.total(motion.bend)
        return SnakeState(
            time=time,
            com=states[:, kernels.STATE_X : kernels.STATE_Y + 1],
            com_velocity=states[:, kernels.STATE_VX : kernels.STATE_VY + 1],
            heading=heading,
            position=cells.at_connectors(seen.position),
            connector_heading=connector_heading,
            bend=bend,
            bend_rate=cells.total(motion.bend_rate),
            pressure=trace.pressure,
            valves=trace.valves,
            measured_bend=self.sensor.read(bend, time, self.seed),
            contact_force=cells.on_connectors(seen.force),
            obstacle_force=obstacles,
            torque=motion.torque,
            work=work,
            internal_loss=np.zeros(len(time)),
            pneumatic_energy=trace.pneumatic_energy,
            qpos=np.empty((len(time), 0)),
        )
