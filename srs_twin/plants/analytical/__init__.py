r"""AnalyticalSnake: the dissertation's planar model, and its variants, as a plant.

The mechanics are those of a `Body`: `bodies` has those of planar snakes, `quasistatic`
that of a snake whose segments bend in two directions. Planar bodies with skin are
divided into `cells`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from srs_twin.compute.arrays import check_positive, concatenate_records
from srs_twin.errors import DivergedError, InputError, check_choice
from srs_twin.io.arguments import checked
from srs_twin.io.saved_state import short_digest
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
    Undivided,
    cells_of_skin,
    cells_of_wheels,
)
from srs_twin.plants.analytical.floor import floor_friction
from srs_twin.plants.analytical.kinematics import BodyParameters
from srs_twin.plants.analytical.obstacles import make_obstacles
from srs_twin.plants.analytical.quasistatic import QuasistaticArcs
from srs_twin.plants.analytical.steps import Steps
from srs_twin.plants.base import (
    BASES,
    TICK_S,
    PneumaticPlant,
    Pose,
    SnakeState,
    check_before_step,
    check_initial_state,
    check_plausible,
)
from srs_twin.pneumatics import Pneumatics, Schedule, Trace
from srs_twin.robot.friction import LAWS, TWO_POINT_LAWS
from srs_twin.robot.scale import SHIPPED, Scale, divide
from srs_twin.robot.spec import GRAVITY, RobotSpec
from srs_twin.robot.world import World
from srs_twin.sensing import Sensor

MODELS = ("complete", "simplified", "compliant", "quasistatic")
LOADS = ("static", "momentary")
INERTIAS = ("point", "connector", "lumped")


def default_timestep(tick: float, scale: Scale) -> float:
    """Return the default longest time step, s.

    Args:
        tick: control tick, s.
        scale: units of the robot. For those of the shipped robots the step does not
            depend on the tick.
    """
    if scale == SHIPPED:
        return TIMESTEP_S
    return divide(tick, TIMESTEP_S * scale.time)


TIMESTEP_S = 0.002
"""Default longest time step at a time unit of 1 (`robot.scale`), s."""
CELLS = 8
"""Default number of cells per segment of a body on wheels among obstacles."""
TOLERANCE_M_S = 0.0002
"""Default tolerance of a step at a time unit of 1, m/s."""
SLIP_SPEED_M_S = 0.00025
"""Default slip speed at a time unit of 1, m/s."""

# Largest interval between exchanges of bends and pressures for point masses at a time
# unit of 1, s. With 0.25 ms their pressures oscillate below ambient; half of this
# interval does not change the results.
_POINT_MASS_COUPLING_STEP = 0.0001


def _check_options(
    spec: RobotSpec,
    world: World,
    model: str,
    friction: str,
    load: str,
    friction_torque: bool,
    inertia: str,
    base: str,
) -> None:
    """Check names and combinations of the options of `AnalyticalSnake`."""
    check_choice("model", model, MODELS)
    if model != "quasistatic":
        spec.require_planar(f"the analytical model {model!r}")
    elif not spec.is_spatial:
        raise InputError(
            f"model 'quasistatic' needs a spatial robot; {spec.name} bends in one plane"
        )
    if spec.is_spatial and (world.uneven or world.is_solid):
        raise InputError(
            "model 'quasistatic' needs a level floor without obstacles; use the twin"
        )
    check_choice("friction law", friction, LAWS)
    check_choice("load", load, LOADS)
    check_choice("inertia", inertia, INERTIAS)
    if spec.skin is not None and (model == "simplified" or inertia == "lumped"):
        raise InputError(
            "a body with skin has neither model 'simplified' nor inertia 'lumped'"
        )
    if load == "momentary" and friction not in TWO_POINT_LAWS:
        raise InputError(
            f"friction '{friction}' has one contact per connector; momentary loads need"
            " two: use 'wheel' or 'ellipse'"
        )
    if world.steps:
        raise InputError(
            "the floor of the analytical model is a plane; use the twin for steps"
        )
    if world.objects:
        raise InputError("the analytical model has no movable objects; use the twin")
    if spec.tail is not None:
        raise InputError(
            "the analytical model has one axle per connector; use the twin for a tail"
            " on two axles"
        )
    check_choice("base", base, BASES)
    if not friction_torque and model != "simplified":
        raise InputError(
            f"model '{model}' has a friction torque; use 'simplified' to leave it out"
        )
    if base == "clamped" and model == "compliant":
        raise InputError(
            "model 'compliant' needs base 'free'; use 'complete' or the twin when"
            " clamped"
        )


class AnalyticalSnake(PneumaticPlant):
    """Planar model of the dissertation (Section 3.1), whose bends follow Eq. 14, and its variants.

    Masses on arcs of constant curvature move under the friction of the floor, by Eq. 11
    summed over the body (E22). `simplified` keeps the chords at their straight length;
    in `compliant`, load and inertia deflect the bends.

    Attributes:
        timestep: longest step of the integrator, s; steps also end on valve events.
        friction: friction law of the floor, one of `robot.friction.LAWS`.
    """

    name = "analytical"
    state_attributes = ("_body",)
    max_chunk_s = 10.0

    @checked
    def __init__(
        self,
        spec: RobotSpec,
        *,
        model: str = "complete",
        friction: str = "axis",
        load: str = "static",
        friction_torque: bool = True,
        inertia: str = "point",
        supply_pa: float | None = None,
        tick: float | None = None,
        timestep: float | None = None,
        tolerance: float | None = None,
        slip_speed: float | None = None,
        layout: str = "3/2",
        pneumatics: str | Pneumatics = "lag",
        track: float | None = None,
        base: str = "free",
        sensor: str | Sensor = "ideal",
        world: World | None = None,
        touch: bool = False,
        cells: int = CELLS,
    ) -> None:
        """Build the model.

        Args:
            spec: the robot.
            model: "complete" (prescribed bends), "simplified" (prescribed bends, chords
                frozen at l + L_o) or "compliant" (bends deflected by load and inertia);
                "quasistatic" (`quasistatic`) for a robot whose segments bend in two
                directions, and only for it. A body with skin is not "simplified".
            friction: law of a robot on wheels, "axis" (one contact per connector, the
                law of the dissertation), "wheel" (two wheels at the track), "ellipse"
                or "cosine" (two skids at the track) or "viscous" (for tests); a skin
                has its own law, along the whole body.
            load: load of a wheel or skid, "static" (half of its connector's weight) or
                "momentary" (with the load transfer by the lateral force, see `floor`).
            friction_torque: whether the moment of friction about the centre of mass
                acts; False gives the first model of the dissertation, with `simplified`
                only.
            inertia: moment of inertia of each connector: "point" for none, "connector"
                for a compact body with two wheels as in the twin, "lumped" for the
                dissertation's j(i) = Σ m L²/3, which counts the masses of the segments
                twice (E19).
            supply_pa: supply pressure, Pa; default the robot's nominal pressure.
            tick: control tick, s; default `TICK_S` times the time unit of the robot
                (`robot.scale`).
            timestep: longest time step, s; default `TIMESTEP_S` times the time unit, or
                a near part of the tick (`robot.scale.divide`).
            tolerance: largest error of a step where friction reverses, as a velocity,
                m/s; with prescribed bends, steps are divided until they meet it, see
                `steps`; default `TOLERANCE_M_S` times the time unit.
            slip_speed: slip speed ε of the friction law, m/s; default `SLIP_SPEED_M_S`
                times the time unit.
            layout: valve layout, "3/2" or "in_out".
            pneumatics: "lag", "orifice", or a `Pneumatics` object.
            track: distance of the two contacts of a connector from the centre line, m;
                default the robot's half track for a law at the wheels, and 0, one
                contact, for other laws.
            base: "free", or "clamped": held at the head, in the air (not with
                "compliant").
            sensor: curvature sensor: "ideal", "hall" with its defaults, or a `Sensor`
                object.
            world: slope of the floor, and obstacles. None for a level floor without
                obstacles.
            touch: whether the body touches obstacles (`obstacles`), with "compliant"
                only; otherwise it passes through them.
            cells: approximate number of cells per segment of a robot on wheels that can
                touch obstacles.

        Raises:
            InputError: unknown model, law, load, inertia or layout; a tick, time step
                or tolerance that is not positive; no friction torque with another
                model; momentary loads with a law that does not act at the wheels; a
                floor with steps; a tail on two axles; touch with another model; or a
                model that does not fit the segments of the robot.
        """
        world = world or World()
        unit = spec.scale.time
        tick = TICK_S * unit if tick is None else tick
        if timestep is None:
            timestep = default_timestep(tick, spec.scale)
        if tolerance is None:
            tolerance = TOLERANCE_M_S * unit
        if slip_speed is None:
            slip_speed = SLIP_SPEED_M_S * unit
        friction = spec.skin.law if spec.skin else friction
        _check_options(
            spec, world, model, friction, load, friction_torque, inertia, base
        )
        if touch and model != "compliant":
            raise InputError(
                f"model '{model}' has prescribed bends and touches no obstacles; use"
                " 'compliant'"
            )
        if cells < 1:
            raise InputError(f"cells {cells} is not allowed; a segment has 1 or more")
        check_positive("tick", tick, "s")
        check_positive("time step", timestep, "s")
        check_positive("tolerance", tolerance, "m/s")
        self.spec = spec
        self.tick = tick
        self.timestep = timestep
        self.friction = friction
        self._make_pneumatics_and_sensor(pneumatics, supply_pa, layout, sensor)
        self.touches = touch and world.has_obstacles
        self.world: World = world
        self._touch = touch
        self._cells = cells
        self._model = model
        self._inertia = inertia
        self._friction_torque = friction_torque
        self.base = base
        if track is None:
            if friction in TWO_POINT_LAWS:
                track = spec.geometry.half_track
            else:
                track = 0.0
        mu = spec.friction
        self._tolerance = tolerance
        self.load = load
        if load == "momentary" and track == 0.0:
            raise InputError(
                "momentary loads need two contacts side by side; track must be above 0"
            )
        if load == "momentary":
            load_transfer = spec.geometry.com_height / (2 * track)
        else:
            load_transfer = 0.0
        x, y, z = world.floor.down
        gravity = GRAVITY * x, GRAVITY * y, GRAVITY * z
        drag = mu.drag / spec.geometry.connectors
        self._floor_plane = world.floor
        self._floor = floor_friction(
            friction,
            track,
            mu.mu_t,
            mu.mu_n,
            slip_speed,
            load_transfer,
            gravity,
            drag,
            None if spec.skin is None else mu.backward,
            unit,
        )
        self._body = self._make_body()
        self.reset()

    def reset(self, *, pose: Pose = (0.0, 0.0, 0.0), seed: int = 0) -> SnakeState:
        """Lay the snake straight and at rest with empty chambers.

        Args:
            pose: centre of mass x, y (m) and mean heading (rad).
            seed: random seed of the sensor noise.
        """
        self.pneumatics.reset()
        self._ticks = 0
        self.seed = seed
        self._body.reset(pose)
        body = self._body
        trace = self.pneumatics.rest_trace()
        now = body.motion(body.state[None].copy(), body.velocity[None].copy(), trace)
        self.state = self._observe(np.zeros(1), now, trace).at(0)
        return self.state

    def place(
        self, snake: SnakeState, *, yaw_rate: float = 0.0, seed: int = 0
    ) -> SnakeState:
        """See `Plant.place`."""
        check_initial_state(snake, yaw_rate, self.spec.segments)
        x, y = map(float, snake.com)
        self.reset(pose=(x, y, float(snake.heading)), seed=seed)
        self.pneumatics.place(snake.pressure, snake.bend)
        body = self._body
        trace = self.pneumatics.current_trace()
        if body.compliant:
            bends = (snake.bend, snake.bend_rate)
        else:
            bends = (trace.bend[0], trace.bend_rate[0])
        body.place(
            np.array([*snake.com_velocity, yaw_rate]),
            *(np.array(values, dtype=float) for values in bends),
        )
        now = body.motion(body.state[None].copy(), body.velocity[None].copy(), trace)
        self.state = self._observe(np.zeros(1), now, trace).at(0)
        return self.state

    def _simulate(self, schedule: Schedule, ticks: int, samples: int) -> SnakeState:
        """See `PneumaticPlant._simulate`."""
        begun = self._ticks * self.tick
        check_before_step(
            self.name, begun + self.timestep, self._body.state, self._body.velocity
        )
        steps = self._steps(self.pneumatics.effective_schedule(schedule), samples)
        done, motion, trace = self._advance(schedule, steps)
        times = begun + schedule.span * np.arange(1, samples + 1) / samples
        history = self._observe(times[: len(motion.states)], motion, trace)
        if done < len(steps.ends):
            state = ", ".join(f"{value:.4g}" for value in self._body.state)
            text = (
                f"step {done + 1} of {len(steps.ends)} has no plausible solution, state"
                f" {state}"
            )
            raise DivergedError(
                self.name, begun + steps.ends[done], text, history=history
            )
        self._ticks += ticks
        return check_plausible(self.name, history)

    def _advance(self, schedule: Schedule, steps: Steps) -> tuple[int, Motion, Trace]:
        """Advance chambers and body; return the number of completed steps, and the samples they reached.

        Chambers whose pressures depend on compliant bends alternate with the body,
        every step or two.
        """
        motions = []
        traces = []
        done = 0
        for chunk_schedule, chunk in self._chunks(schedule, steps):
            bend, rate = self._body.bends()
            trace = self.pneumatics.advance(
                chunk_schedule, chunk.stage_times, bend=bend, bend_rate=rate
            )
            completed, states, velocities = self._body.move(
                chunk.lengths, trace, chunk.sample_steps
            )
            reached = int(np.searchsorted(chunk.sample_steps, completed, side="right"))
            traces.append(trace.at(2 * chunk.sample_steps[:reached]))
            motions.append(
                self._body.motion(states[:reached], velocities[:reached], traces[-1])
            )
            done += completed
            if completed < len(chunk.lengths):
                break
        return done, concatenate_records(motions), concatenate_records(traces)

    def _chunks(
        self, schedule: Schedule, steps: Steps
    ) -> Iterator[tuple[Schedule, Steps]]:
        if not self._coupled:
            yield schedule, steps
            return
        for begin, end, piece in steps.chunks(self._coupling_step):
            yield schedule.slice(begin, end), piece

    @property
    def jumps(self) -> int:
        """Number of jumps between resting poses since `reset`; 0 unless the model is "quasistatic"."""
        return self._body.jumps

    def describe(self) -> dict[str, Any]:
        """Return the settings for the provenance of a run."""
        return (
            super().describe()
            | {
                "model": self._model,
                "base": self.base,
                "friction": self.friction,
                "friction_torque": self._friction_torque,
                "inertia": self._inertia,
                "track_m": self._floor.track,
                "timestep_s": self.timestep,
                "slip_speed_m_s": self._floor.slip,
                "tolerance_m_s": self._tolerance,
            }
            | ({"touch": True, "cells": self._cells} if self._touch else {})
            | ({} if self.load == "static" else {"load": self.load})
        )

    def identity(self) -> dict[str, Any]:
        """See `Plant.identity`."""
        if self.touches:
            world = {"world": short_digest(self.world)}
        else:
            world = {}
        return super().identity() | {"floor": short_digest(self._floor_plane)} | world

    def _make_body(self) -> Body:
        if self.spec.is_spatial:
            return QuasistaticArcs(self.spec, self._floor.slip, self.base)
        cells = self._divide()
        frozen = 1.0 if self._model == "simplified" else 0.0
        inertia = self._connector_inertia(cells.mass)
        solid = BodyParameters.of(cells.mass, inertia, cells.length, cells.gap, frozen)
        floor = self._floor
        if isinstance(cells, Cells):
            # The floor has the drag on one connector; along a divided body it acts in
            # smaller parts.
            drag = self._floor.drag * self.spec.geometry.connectors / len(cells.mass)
            floor = floor._replace(drag=drag)
        if self.base == "clamped":
            return ClampedBends(solid, floor, cells)
        if self._model != "compliant":
            return PrescribedBends(
                solid,
                floor,
                cells,
                friction_torque=self._friction_torque,
                tolerance=self._tolerance,
            )
        if self.touches:
            obstacles = make_obstacles(self.world, self.spec, cells, self._floor.slip)
        else:
            obstacles = None
        return CompliantBends(self.spec, solid, floor, cells, obstacles)

    def _divide(self) -> Undivided:
        """Return the division of the segments."""
        if self.spec.skin is not None:
            return cells_of_skin(self.spec)
        if self.touches:
            return cells_of_wheels(self.spec, self._cells)
        return Undivided(self.spec)

    @property
    def _coupled(self) -> bool:
        return self.pneumatics.depends_on_bend and self._body.compliant

    @property
    def _coupling_step(self) -> float:
        """Largest interval between exchanges of bends and pressures, s; point masses need a shorter one."""
        massless = not self._body.solid.inertia.all()
        if massless:
            return min(
                self.pneumatics.coupling_step_s,
                _POINT_MASS_COUPLING_STEP * self.spec.scale.time,
            )
        return self.pneumatics.coupling_step_s

    def _connector_inertia(self, mass: np.ndarray) -> np.ndarray:
        """Return the moments of inertia of the points with masses about their centres, (points,), kg·m².

        A cell of a body with skin is a strip as wide as the body.
        """
        if self._inertia == "connector":
            if self.spec.skin is not None:
                strips: np.ndarray = mass * self.spec.geometry.width**2 / 12
                return strips
            inertia = np.zeros_like(mass)
            inertia[:: (len(mass) - 1) // self.spec.segments] = self.spec.yaw_inertia()
            return inertia
        if self._inertia == "point":
            return np.zeros_like(mass)
        segments = np.full(len(mass), 2.0)  # a massless point has no inertia
        segments[[0, -1]] = 1.0
        lumped: np.ndarray = segments * mass * self.spec.geometry.pitch**2 / 3
        return lumped

    def _steps(self, schedule: Schedule, samples: int) -> Steps:
        """Return the integrator's steps for a schedule."""
        if self._coupled:
            longest = min(self.timestep, self._coupling_step)
        else:
            longest = self.timestep
        return Steps.between(
            schedule.span,
            schedule.events,
            samples,
            longest=longest,
            same=1e-9 * self.tick,
        )

    def _observe(self, time: np.ndarray, motion: Motion, trace: Trace) -> SnakeState:
        """Return the history of a motion."""
        if isinstance(self._body, QuasistaticArcs):
            sensed = self.sensor.read(motion.bend, time, self.seed)
            return self._body.observe(time, motion, trace, sensed)
        cells = self._body.cells
        solid = self._body.solid
        count = len(time)
        n = len(solid.mass)
        wheels = self._floor._replace(drag=0.0)
        bends = (motion.bend, motion.bend_rate)
        seen = kernels.observe(motion.states, motion.velocities, bends, solid, wheels)
        divided = isinstance(cells, Cells)
        bend = cells.total(motion.bend)
        obstacles = np.zeros((count, self.spec.geometry.connectors, 2))
        if isinstance(cells, Cells) and self.touches:
            obstacles = cells.obstacle_force(
                motion.states[:, kernels.STATES : -1].reshape(count, n, 2)
            )
        theta = cells.at_connectors(seen.theta)
        return SnakeState(
            time=time,
            com=motion.states[:, kernels.STATE_X : kernels.STATE_Y + 1],
            com_velocity=motion.states[:, kernels.STATE_VX : kernels.STATE_VY + 1],
            heading=(
                theta.mean(axis=1) if divided else motion.states[:, kernels.HEADING]
            ),
            position=cells.at_connectors(seen.position),
            theta=theta,
            bend=bend,
            bend_rate=cells.total(motion.bend_rate),
            pressure=trace.pressure,
            valves=trace.valves,
            sensed=self.sensor.read(bend, time, self.seed),
            contact_force=cells.on_connectors(seen.force),
            obstacle_force=obstacles,
            torque=motion.torque,
            work=motion.states[:, kernels.ENERGY_LOSS]
            + (
                0.0
                if self.touches
                else seen.energy + self._body.stored(motion.bend, trace.bend)
            ),
            internal_loss=np.zeros(count),
            air=trace.air,
            qpos=np.empty((count, 0)),
        )
