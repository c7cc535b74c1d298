r"""AnalyticalSnake: the dissertation's planar model, with connectors on segments of constant curvature.

The mechanics are those of a `Body`: `PrescribedBends` follow the chambers regardless of load (models
`complete` and `simplified`), `ClampedBends` are a chain that is held at its head, and `CompliantBends` have
stiffness and damping (model `compliant`). Bodies with skin are divided into `cells`.

The bends of a clamped chain are the free bends of Eq. 14, as on a test bench. Only the clamp touches the
chain, so its motion follows from the bends alone. The moments of its segments follow from the recursive
Newton–Euler
algorithm: accelerations from the head to the tail,

$$ a_{j+1} = a_j - (\ddot L - L\dot\psi^2)\,e(\psi) - (L\ddot\psi + 2\dot L\dot\psi)\,e_\perp(\psi), $$

with the direction ψ and the length L of chord j, and moments from the tail to the head: T_j is the
generalised force of the bend q_j.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import numpy as np

from srs_twin.compute.arrays import check_positive, concatenate_records
from srs_twin.compute.compiled import allocating
from srs_twin.errors import DivergedError, InputError, check_choice
from srs_twin.io.saved_state import Stateful, short_digest
from srs_twin.plants.analytical import compliant_kernels, kernels
from srs_twin.plants.analytical.cells import Cells, Undivided, cells_of_skin, cells_of_wheels
from srs_twin.plants.analytical.floor import FloorFriction, floor_friction
from srs_twin.plants.analytical.kernels import inverse_dynamics
from srs_twin.plants.analytical.kinematics import ROWS, BodyParameters, chord_terms, pose_body
from srs_twin.plants.analytical.obstacles import Obstacles, make_obstacles
from srs_twin.plants.analytical.steps import Steps, advance
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
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.robot.friction import LAWS, TWO_POINT_LAWS
from srs_twin.robot.scale import SHIPPED, Scale, divide
from srs_twin.robot.spec import GRAVITY, RobotSpec
from srs_twin.robot.world import World
from srs_twin.sensing import Sensor


class Motion(NamedTuple):
    """Motion of a body at several times.

    Attributes:
        states: indices as in `kernels`, shape (samples, STATES or more); in a world with obstacles followed
            by their mean forces on each point since the previous sample.
        velocities: velocity of the centre of mass in the mean-heading frame (m/s), yaw rate (rad/s) and, for
            compliant bends, bend rates (rad/s), shape (samples, 3 or more).
        bend: bends of the segments, or of the cells of a body with skin, shape (samples, cells), rad.
        bend_rate: their rates, shape (samples, cells), rad/s.
        torque: net moment of each segment, shape (samples, segments), N·m.
    """

    states: np.ndarray
    velocities: np.ndarray
    bend: np.ndarray
    bend_rate: np.ndarray
    torque: np.ndarray


class Body(Stateful, ABC):
    """Abstract mechanics of an analytical model, driven by the chambers.

    Attributes:
        state: current state. `kernels` names its indices; compliant bends append further entries.
        velocity: current velocities, in the format of `Motion.velocities`.
        solid: constants of the body for the kernels.
        floor: floor for the kernels.
        cells: division of the segments.
        obstacles: obstacles that the body can touch, or None.
    """

    state_attributes: ClassVar[tuple[str, ...]] = ("state", "velocity")

    state: np.ndarray
    velocity: np.ndarray
    obstacles: Obstacles | None = None

    compliant = False
    """Whether the bends are degrees of freedom, instead of the free bends of the chambers."""

    def __init__(self, solid: BodyParameters, floor: FloorFriction, cells: Undivided, bends: int = 0) -> None:
        """Set the constants; `bends` is the number of bends that are degrees of freedom."""
        self.solid, self.floor, self.cells = solid, floor, cells
        self._shapes = kernels.STATES + 2 * bends, 3 + bends

    def bends(self) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
        """Return the current bends (rad) and bend rates (rad/s) if they are degrees of freedom, else None."""
        return None, None

    def reset(self, pose: Pose) -> None:
        """Lay the body straight and at rest.

        Args:
            pose: centre of mass x, y (m) and mean heading (rad).
        """
        self.state, self.velocity = map(np.zeros, self._shapes)
        self.state[:3] = pose

    def place(self, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray) -> None:
        """Set velocities, bends and bend rates after `reset`.

        Args:
            velocity: velocity of the centre of mass in the world frame (m/s) and yaw rate (rad/s), shape
                (3,).
            bend: shape (segments,), rad.
            rate: bend rates, shape (segments,), rad/s.
        """
        bend, rate = self.cells.split(bend), self.cells.split(rate)
        self.state[kernels.HEADING] += self.cells.lead(bend)
        (x, y, yaw), heading = velocity, float(self.state[kernels.HEADING])
        yaw += self.cells.lead(rate)
        c, s = math.cos(heading), math.sin(heading)
        self.state[kernels.STATE_VX], self.state[kernels.STATE_VY] = x, y
        self.velocity[:3] = c * x + s * y, c * y - s * x, yaw
        inertia, moment = pose_body(bend, rate, self.solid, np.empty((ROWS, len(self.solid.mass))))
        self.state[kernels.MOMENT] = inertia * yaw + moment

    def _allocate(self, samples: int) -> tuple[np.ndarray, np.ndarray]:
        """Return arrays for states and velocities of samples."""
        states, velocities = (np.zeros((samples, count)) for count in self._shapes)
        return states, velocities

    def _split(self, trace: Trace) -> Trace:
        """Return a trace with the free bends of the cells."""
        split = self.cells.split
        return trace._replace(
            bend=split(trace.bend),
            bend_rate=split(trace.bend_rate),
            bend_acceleration=split(trace.bend_acceleration),
        )

    @abstractmethod
    def move(
        self, steps: np.ndarray, trace: Trace, sample_steps: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray]:
        """Advance by several steps.

        Args:
            steps: lengths of the steps, shape (steps,), s.
            trace: pressures and free bends of the chambers at the start and the two stages of each step, 1 +
                2 steps rows.
            sample_steps: number of steps before each sample, ascending, shape (samples,).

        Returns:
            The number of completed steps, smaller than requested after a failure; states and velocities as in
            `Motion` at the samples, filled as far as they were reached.
        """

    def stored(self, bend: np.ndarray) -> float | np.ndarray:
        """Return the elastic energy of cells that bend unlike their segment, shape (samples,), J.

        Args:
            bend: bends of the cells, shape (samples, cells), rad.
        """
        return 0.0

    @abstractmethod
    def motion(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """Return the motion at times for which the trace has one row each."""


class PrescribedBends(Body):
    """Body of `complete` and `simplified`: the bends are the free bends of Eq. 14, regardless of load."""

    state_attributes = ("_state_rate",)

    def __init__(
        self,
        solid: BodyParameters,
        floor: FloorFriction,
        cells: Undivided,
        *,
        friction_torque: bool,
        tolerance: float,
    ) -> None:
        super().__init__(solid, floor, cells)
        self._model, self._tolerance = (solid, floor, friction_torque), tolerance

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`."""
        super().reset(pose)
        self._state_rate = np.zeros(kernels.STATES)

    def move(
        self, steps: np.ndarray, trace: Trace, sample_steps: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`."""
        now = self.state, self._state_rate, self.velocity
        samples, trace = self._allocate(len(sample_steps)), self._split(trace)
        done, _ = advance(now, steps, trace, sample_steps, self._model, self._tolerance, samples)
        return done, *samples

    def motion(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """See `Body.motion`."""
        trace = self._split(trace)
        torque = np.empty_like(trace.bend)
        inverse_dynamics(velocities, trace, self._model, torque)
        return Motion(states, velocities, trace.bend, trace.bend_rate, self.cells.moments(torque))


class ClampedBends(Body):
    """Chain that is held at its head in the air (module docstring)."""

    state_attributes = ("_head_pose",)

    def __init__(self, solid: BodyParameters, floor: FloorFriction, cells: Undivided) -> None:
        # In the air: no friction.
        super().__init__(solid, floor._replace(mu_t=0.0, mu_back=0.0, mu_n=0.0, drag=0.0), cells)

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`; the head stays at its initial pose."""
        super().reset(pose)
        (x, y, heading), ahead = pose, self.cells.com_behind_head
        self._head_pose = np.array([x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading])

    def place(self, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray) -> None:
        """See `Body.place`; a clamped chain can only start at rest."""
        raise InputError("a snake that is clamped at its head can only start at rest")

    def move(
        self, steps: np.ndarray, trace: Trace, sample_steps: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`; `motion` computes the states."""
        return len(steps), *self._allocate(len(sample_steps))

    def motion(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """See `Body.motion`; the bends determine the motion."""
        trace = self._split(trace)
        torque = np.empty_like(trace.bend)
        simulate_clamped(trace, self.solid, self._head_pose, states, velocities, torque)
        return Motion(states, velocities, trace.bend, trace.bend_rate, self.cells.moments(torque))


@allocating
def simulate_clamped(trace, solid, head, states, velocities, torque):  # type: ignore[no-untyped-def]
    """Fill states, velocities and moments of a chain that is held at its head.

    Args:
        trace: trace of the chambers; their free bends are the bends of the chain.
        solid: the chain.
        head: pose of the head: x, y (m), heading (rad).
        states: out, pose and velocity of the centre of mass in the world frame, indices as in `kernels`.
        velocities: out, velocity in the mean-heading frame and mean spin, shape (samples, 3).
        torque: out, net moments of the segments, shape (samples, segments), N·m.
    """
    n, total = solid.mass.shape[0], solid.mass.sum()
    position, acceleration, alpha = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)
    lever = np.empty((n - 1, 2))
    for k in range(trace.bend.shape[0]):
        angle, spin, mean, mean_spin = head[2], 0.0, head[2], 0.0
        alpha[0] = 0.0
        position[0], acceleration[0] = 0.0, 0.0
        v_x = v_y = com_x = com_y = com_vx = com_vy = 0.0
        for j in range(n - 1):
            q, dq, ddq = trace.bend[k, j], trace.bend_rate[k, j], trace.bend_acceleration[k, j]
            psi, chord_spin, chord_alpha = (
                angle - q / 2,
                spin - dq / 2,
                alpha[j] - ddq / 2,
            )
            angle, spin, alpha[j + 1] = angle - q, spin - dq, alpha[j] - ddq
            _, _, span, slope, curvature = chord_terms(q, solid, j)
            chord_rate, chord_acceleration = slope * dq, curvature * dq * dq + slope * ddq
            inward, aside = (
                chord_acceleration - span * chord_spin * chord_spin,
                span * chord_alpha + 2 * chord_rate * chord_spin,
            )
            c, s = math.cos(psi), math.sin(psi)
            position[j + 1, 0], position[j + 1, 1] = position[j, 0] - span * c, position[j, 1] - span * s
            v_x, v_y = (
                v_x - chord_rate * c + span * chord_spin * s,
                v_y - chord_rate * s - span * chord_spin * c,
            )
            acceleration[j + 1, 0] = acceleration[j, 0] - inward * c + aside * s
            acceleration[j + 1, 1] = acceleration[j, 1] - inward * s - aside * c
            # Velocity of all connectors behind segment j per bend rate: the chord shortens, and rotates by
            # half of the bend.
            lever[j, 0], lever[j, 1] = -slope * c - span / 2 * s, -slope * s + span / 2 * c
            share = solid.mass[j + 1] / total
            com_x, com_y = com_x + share * position[j + 1, 0], com_y + share * position[j + 1, 1]
            com_vx, com_vy = com_vx + share * v_x, com_vy + share * v_y
            mean, mean_spin = mean + (angle - head[2]) / n, mean_spin + spin / n
        states[k, kernels.STATE_X], states[k, kernels.STATE_Y] = head[0] + com_x, head[1] + com_y
        states[k, kernels.HEADING] = mean
        states[k, kernels.STATE_VX], states[k, kernels.STATE_VY] = com_vx, com_vy
        c, s = math.cos(mean), math.sin(mean)
        velocities[k, 0], velocities[k, 1] = com_vx * c + com_vy * s, com_vy * c - com_vx * s
        velocities[k, 2] = mean_spin
        force_x = force_y = moment = 0.0
        for j in range(n - 2, -1, -1):
            # Net force on all connectors behind segment j, and its moment about the connector at the rear
            # end.
            if j < n - 2:
                arm_x, arm_y = (
                    position[j + 2, 0] - position[j + 1, 0],
                    position[j + 2, 1] - position[j + 1, 1],
                )
                moment += arm_x * force_y - arm_y * force_x
            force_x += solid.mass[j + 1] * acceleration[j + 1, 0]
            force_y += solid.mass[j + 1] * acceleration[j + 1, 1]
            moment += solid.inertia[j + 1] * alpha[j + 1]
            torque[k, j] = lever[j, 0] * force_x + lever[j, 1] * force_y - moment


class CompliantBends(Body):
    """Body of `compliant`: masses on springs with dampers.

    The air exerts the moment k φ(x) + k b on a segment (`pneumatics.chambers`); for a nominal linear segment
    this is k G (p⁺ − p⁻). The stiffness k and the damping c = k · damping_time act against it. A massless
    segment without load obeys Eq. 14; inertia and friction deflect it.
    """

    state_attributes = ("_sampled",)
    compliant = True

    def __init__(
        self,
        spec: RobotSpec,
        solid: BodyParameters,
        floor: FloorFriction,
        cells: Undivided,
        obstacles: Obstacles | None = None,
    ) -> None:
        self._bends = len(solid.mass) - 1
        super().__init__(solid, floor, cells, self._bends)
        bending = spec.bending
        spring = bending.stiffness * cells.inverse_share, bending.damping * cells.inverse_share
        self.obstacles = obstacles
        self._model = (solid, spring, floor) if obstacles is None else (solid, spring, floor, obstacles)
        self._momenta = slice(
            compliant_kernels.BENDS + self._bends, compliant_kernels.BENDS + 2 * self._bends
        )
        # Impulses of the obstacles on each point, and the time, follow the momenta.
        self._impulses = slice(self._momenta.stop, None)
        count = 0 if obstacles is None else obstacles.force.size + 1
        self._shapes = self._momenta.stop + count, self._shapes[1]
        self._spec, self._bias = spec, spec.modules.array("bias")

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`."""
        super().reset(pose)
        self._sampled = self.state[self._impulses].copy()
        bias = self.cells.split(self._bias)
        self.state[compliant_kernels.BENDS :][: self._bends] = bias
        self.state[kernels.HEADING] += self.cells.lead(bias)

    def place(self, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray) -> None:
        """See `Body.place`."""
        self.state[kernels.HEADING] -= self.cells.lead(self.cells.split(self._bias))
        super().place(velocity, bend, rate)
        bend, rate = self.cells.split(bend), self.cells.split(rate)
        self.state[compliant_kernels.BENDS :][: self._bends], self.velocity[3:] = bend, rate
        momentum, force = np.empty((2, len(self.velocity)))
        model, work = self._model[:3], compliant_kernels.work_arrays(len(self.solid.mass))
        compliant_kernels.balance(
            bend, self.velocity, np.zeros(self._bends), 0.0, model, momentum, force, work
        )
        self.state[self._momenta] = momentum[3:]

    def move(
        self, steps: np.ndarray, trace: Trace, sample_steps: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`."""
        now, samples = (self.state, self.velocity), self._allocate(len(sample_steps))
        # The moment of the air is the same in all cells of a segment.
        each = self._bends // trace.bend.shape[-1]
        moments = np.repeat(self._air_moments(trace)[1:], each, axis=-1).reshape(len(steps), 2, -1)
        done: int = compliant_kernels.advance(now, steps, moments, sample_steps, self._model, samples)
        if self.obstacles is not None:
            self._average_forces(samples[0][:, self._impulses], sample_steps <= done)
        return done, *samples

    def _average_forces(self, impulses: np.ndarray, reached: np.ndarray) -> None:
        """Convert impulses and times of samples, in place, to the mean forces since the previous sample."""
        if not reached.any():
            return
        last = impulses[reached][-1].copy()
        changes = np.diff(impulses[reached], axis=0, prepend=self._sampled[None])
        impulses[reached] = changes / changes[:, -1:]
        self._sampled = last

    def bends(self) -> tuple[np.ndarray, np.ndarray]:
        """See `Body.bends`."""
        bend = self.state[compliant_kernels.BENDS :][: self._bends]
        return self.cells.total(bend), self.cells.total(self.velocity[3:])

    def stored(self, bend: np.ndarray) -> float | np.ndarray:
        """See `Body.stored`."""
        relative = bend - self.cells.split(self.cells.total(bend))
        energy: np.ndarray = (np.ravel(self._model[1][0]) * relative**2).sum(axis=-1) / 2
        return energy

    def motion(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """See `Body.motion`."""
        bend, rate = states[:, compliant_kernels.BENDS :][:, : self._bends], velocities[:, 3:]
        total, bending = self.cells.total, self._spec.bending
        torque = self._air_moments(trace) - bending.stiffness * total(bend) - bending.damping * total(rate)
        columns = np.hstack([states[:, : kernels.STATES], states[:, self._impulses]])
        return Motion(columns, velocities, bend, rate, torque)

    def _air_moments(self, trace: Trace) -> np.ndarray:
        """Return the moments of air and rest bend on each segment, N·m."""
        free_bend = self._bias + air_bend(self._spec, trace.pressure)
        moments: np.ndarray = self._spec.bending.stiffness * free_bend
        return moments


MODELS = ("complete", "simplified", "compliant")
LOADS = ("static", "momentary")
INERTIAS = ("point", "connector", "lumped")


def default_timestep(tick: float, scale: Scale) -> float:
    """Return the default longest time step, s.

    Args:
        tick: control tick, s.
        scale: units of the robot. For those of the shipped robots the step does not depend on the tick.
    """
    return TIMESTEP_S if scale == SHIPPED else divide(tick, TIMESTEP_S * scale.time)


TIMESTEP_S = 0.002
"""Default longest time step at a time unit of 1 (`robot.scale`), s."""
CELLS = 8
"""Default number of cells per segment of a body on wheels among obstacles."""
TOLERANCE_M_S = 0.0002
"""Default tolerance of a step at a time unit of 1, m/s."""
SLIP_SPEED_M_S = 0.00025
"""Default slip speed at a time unit of 1, m/s."""

# Largest interval between exchanges of bends and pressures for point masses at a time unit of 1, s. With
# 0.25 ms their pressures oscillate below ambient; half of this interval does not change the results.
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
    spec.require_planar(f"the analytical model {model!r}")
    check_choice("friction law", friction, LAWS)
    check_choice("load", load, LOADS)
    check_choice("inertia", inertia, INERTIAS)
    if spec.skin is not None and (model == "simplified" or inertia == "lumped"):
        raise InputError("a body with skin has neither model 'simplified' nor inertia 'lumped'")
    if load == "momentary" and friction not in TWO_POINT_LAWS:
        raise InputError(
            f"friction '{friction}' has one contact per connector; momentary loads need two: use 'wheel' "
            "or 'ellipse'"
        )
    if world.steps:
        raise InputError("the floor of the analytical model is a plane; use the twin for steps")
    if world.objects:
        raise InputError("the analytical model has no movable objects; use the twin")
    if spec.tail is not None:
        raise InputError(
            "the analytical model has one axle per connector; use the twin for a tail on two axles"
        )
    check_choice("base", base, BASES)
    if not friction_torque and model != "simplified":
        raise InputError(f"model '{model}' has a friction torque; use 'simplified' to leave it out")
    if base == "clamped" and model == "compliant":
        raise InputError("model 'compliant' needs base 'free'; use 'complete' or the twin when clamped")


class AnalyticalSnake(PneumaticPlant):
    """Planar model of the dissertation (Section 3.1), whose bends follow Eq. 14, and its variants.

    Masses on arcs of constant curvature move under the friction of the floor, by Eq. 11 summed over the body
    (E22). `simplified` keeps the chords at their straight length; in `compliant`, load and inertia deflect
    the bends.

    Attributes:
        timestep: longest step of the integrator, s; steps also end on valve events.
        friction: friction law of the floor, one of `robot.friction.LAWS`.
    """

    name = "analytical"
    state_attributes = ("_body",)
    max_chunk_s = 10.0

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
            model: "complete" (prescribed bends), "simplified" (prescribed bends, chords frozen at l + L_o) or
                "compliant" (bends deflected by load and inertia). A body with skin is not "simplified".
            friction: law of a robot on wheels, "axis" (one contact per connector, the law of the
                dissertation), "wheel" (two wheels at the track), "ellipse" or "cosine" (two skids at the
                track) or "viscous" (for tests); a skin has its own law, along the whole body.
            load: load of a wheel or skid, "static" (half of its connector's weight) or "momentary" (with the
                load transfer by the lateral force, see `floor`).
            friction_torque: whether the moment of friction about the centre of mass acts; False gives the
                first model of the dissertation, with `simplified` only.
            inertia: moment of inertia of each connector: "point" for none, "connector" for a compact body
                with two wheels as in the twin, "lumped" for the dissertation's j(i) = Σ m L²/3, which counts
                the masses of the segments twice (E19).
            supply_pa: supply pressure, Pa; default the robot's nominal pressure.
            tick: control tick, s; default `TICK_S` times the time unit of the robot (`robot.scale`).
            timestep: longest time step, s; default `TIMESTEP_S` times the time unit, or a near part of the
                tick (`robot.scale.divide`).
            tolerance: largest error of a step where friction reverses, as a velocity, m/s; with prescribed
                bends, steps are divided until they meet it, see `steps`; default `TOLERANCE_M_S` times the
                time unit.
            slip_speed: slip speed ε of the friction law, m/s; default `SLIP_SPEED_M_S` times the time unit.
            layout: valve layout, "3/2" or "in_out".
            pneumatics: "lag", "orifice", or a `Pneumatics` object.
            track: distance of the two contacts of a connector from the centre line, m; default the robot's
                half track for a law at the wheels, and 0, one contact, for other laws.
            base: "free", or "clamped": held at the head, in the air (not with "compliant").
            sensor: curvature sensor: "ideal", "hall" with its defaults, or a `Sensor` object.
            world: slope of the floor, and obstacles. None for a level floor without obstacles.
            touch: whether the body touches obstacles (`obstacles`), with "compliant" only; otherwise it
                passes through them.
            cells: approximate number of cells per segment of a robot on wheels that can touch obstacles.

        Raises:
            InputError: unknown model, law, load, inertia or layout; a tick, time step or tolerance that is
                not positive; no friction torque with another model; momentary loads with a law that does not
                act at the wheels; a floor with steps; a tail on two axles; or touch with another model.
        """
        world, unit = world or World(), spec.scale.time
        tick = TICK_S * unit if tick is None else tick
        timestep = default_timestep(tick, spec.scale) if timestep is None else timestep
        tolerance = TOLERANCE_M_S * unit if tolerance is None else tolerance
        slip_speed = SLIP_SPEED_M_S * unit if slip_speed is None else slip_speed
        friction = spec.skin.law if spec.skin else friction
        _check_options(spec, world, model, friction, load, friction_torque, inertia, base)
        if touch and model != "compliant":
            raise InputError(
                f"model '{model}' has prescribed bends and touches no obstacles; use 'compliant'"
            )
        if cells < 1:
            raise InputError(f"cells {cells} is not allowed; a segment has 1 or more")
        check_positive("tick", tick, "s")
        check_positive("time step", timestep, "s")
        check_positive("tolerance", tolerance, "m/s")
        self.spec, self.tick, self.timestep, self.friction = spec, tick, timestep, friction
        self._make_pneumatics_and_sensor(pneumatics, supply_pa, layout, sensor)
        self.touches = touch and world.has_obstacles
        self._world, self._touch, self._cells = world, touch, cells
        self._model, self._inertia, self._friction_torque = model, inertia, friction_torque
        self.base = base
        if track is None:
            track = spec.geometry.half_track if friction in TWO_POINT_LAWS else 0.0
        mu = spec.friction
        self._tolerance = tolerance
        self.load = load
        if load == "momentary" and track == 0.0:
            raise InputError("momentary loads need two contacts side by side; track must be above 0")
        load_transfer = spec.geometry.com_height / (2 * track) if load == "momentary" else 0.0
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
        self._ticks, self.seed = 0, seed
        self._body.reset(pose)
        body, trace = self._body, self.pneumatics.rest_trace()
        now = body.motion(body.state[None].copy(), body.velocity[None].copy(), trace)
        self.state = self._observe(np.zeros(1), now, trace).at(0)
        return self.state

    def place(self, snake: SnakeState, *, yaw_rate: float = 0.0, seed: int = 0) -> SnakeState:
        """See `Plant.place`."""
        check_initial_state(snake, yaw_rate, self.spec.segments)
        x, y = map(float, snake.com)
        self.reset(pose=(x, y, float(snake.heading)), seed=seed)
        self.pneumatics.place(snake.pressure, snake.bend)
        body, trace = self._body, self.pneumatics.current_trace()
        bends = (snake.bend, snake.bend_rate) if body.compliant else (trace.bend[0], trace.bend_rate[0])
        body.place(
            np.array([*snake.com_velocity, yaw_rate]), *(np.array(values, dtype=float) for values in bends)
        )
        now = body.motion(body.state[None].copy(), body.velocity[None].copy(), trace)
        self.state = self._observe(np.zeros(1), now, trace).at(0)
        return self.state

    def _simulate(self, schedule: Schedule, ticks: int, samples: int) -> SnakeState:
        """See `PneumaticPlant._simulate`."""
        begun = self._ticks * self.tick
        check_before_step(self.name, begun + self.timestep, self._body.state, self._body.velocity)
        steps = self._steps(self.pneumatics.effective_schedule(schedule), samples)
        done, motion, trace = self._advance(schedule, steps)
        times = begun + schedule.span * np.arange(1, samples + 1) / samples
        history = self._observe(times[: len(motion.states)], motion, trace)
        if done < len(steps.ends):
            state = ", ".join(f"{value:.4g}" for value in self._body.state)
            text = f"step {done + 1} of {len(steps.ends)} has no plausible solution, state {state}"
            raise DivergedError(self.name, begun + steps.ends[done], text, history=history)
        self._ticks += ticks
        return check_plausible(self.name, history)

    def _advance(self, schedule: Schedule, steps: Steps) -> tuple[int, Motion, Trace]:
        """Advance chambers and body; return the number of completed steps, and the samples they reached.

        Chambers whose pressures depend on compliant bends alternate with the body, every step or two.
        """
        motions, traces, done = [], [], 0
        for chunk_schedule, chunk in self._chunks(schedule, steps):
            bend, rate = self._body.bends()
            trace = self.pneumatics.advance(chunk_schedule, chunk.stage_times, bend=bend, bend_rate=rate)
            completed, states, velocities = self._body.move(chunk.lengths, trace, chunk.sample_steps)
            reached = int(np.searchsorted(chunk.sample_steps, completed, side="right"))
            traces.append(trace.at(2 * chunk.sample_steps[:reached]))
            motions.append(self._body.motion(states[:reached], velocities[:reached], traces[-1]))
            done += completed
            if completed < len(chunk.lengths):
                break
        return done, concatenate_records(motions), concatenate_records(traces)

    def _chunks(self, schedule: Schedule, steps: Steps) -> Iterator[tuple[Schedule, Steps]]:
        if not self._coupled:
            yield schedule, steps
            return
        for begin, end, piece in steps.chunks(self._coupling_step):
            yield schedule.slice(begin, end), piece

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
        world = {"world": short_digest(self._world)} if self.touches else {}
        return super().identity() | {"floor": short_digest(self._floor_plane)} | world

    def _make_body(self) -> Body:
        cells = self._divide()
        frozen = 1.0 if self._model == "simplified" else 0.0
        inertia = self._connector_inertia(cells.mass)
        solid, floor = BodyParameters(cells.mass, inertia, cells.length, cells.gap, frozen), self._floor
        if isinstance(cells, Cells):
            # The floor has the drag on one connector; along a divided body it acts in smaller parts.
            drag = self._floor.drag * self.spec.geometry.connectors / len(cells.mass)
            floor = floor._replace(drag=drag)
        if self.base == "clamped":
            return ClampedBends(solid, floor, cells)
        if self._model != "compliant":
            return PrescribedBends(
                solid, floor, cells, friction_torque=self._friction_torque, tolerance=self._tolerance
            )
        obstacles = make_obstacles(self._world, self.spec, cells, self._floor.slip) if self.touches else None
        return CompliantBends(self.spec, solid, floor, cells, obstacles)

    def _divide(self) -> Undivided:
        """Return the division of the segments."""
        if self.spec.skin is not None:
            return cells_of_skin(self.spec)
        return cells_of_wheels(self.spec, self._cells) if self.touches else Undivided(self.spec)

    @property
    def _coupled(self) -> bool:
        return self.pneumatics.depends_on_bend and self._body.compliant

    @property
    def _coupling_step(self) -> float:
        """Largest interval between exchanges of bends and pressures, s; point masses need a shorter one."""
        massless = not self._body.solid.inertia.all()
        return (
            min(self.pneumatics.coupling_step_s, _POINT_MASS_COUPLING_STEP * self.spec.scale.time)
            if massless
            else self.pneumatics.coupling_step_s
        )

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
        longest = min(self.timestep, self._coupling_step) if self._coupled else self.timestep
        return Steps.between(schedule.span, schedule.events, samples, longest=longest, same=1e-9 * self.tick)

    def _observe(self, time: np.ndarray, motion: Motion, trace: Trace) -> SnakeState:
        """Return the history of a motion."""
        cells, solid = self._body.cells, self._body.solid
        count, n = len(time), len(solid.mass)
        position, theta, force = np.empty((count, n, 2)), np.empty((count, n)), np.empty((count, n, 2))
        energy = np.empty(count)
        wheels = self._floor._replace(drag=0.0)
        kernels.observe(motion, solid, wheels, position, theta, force, energy)
        divided, bend = isinstance(cells, Cells), cells.total(motion.bend)
        obstacles = np.zeros((count, self.spec.geometry.connectors, 2))
        if isinstance(cells, Cells) and self.touches:
            obstacles = cells.obstacle_force(motion.states[:, kernels.STATES : -1].reshape(count, n, 2))
        position, theta, force = (
            cells.at_connectors(position),
            cells.at_connectors(theta),
            cells.on_connectors(force),
        )
        return SnakeState(
            time=time,
            com=motion.states[:, kernels.STATE_X : kernels.STATE_Y + 1],
            com_velocity=motion.states[:, kernels.STATE_VX : kernels.STATE_VY + 1],
            heading=theta.mean(axis=1) if divided else motion.states[:, kernels.HEADING],
            position=position,
            theta=theta,
            bend=bend,
            bend_rate=cells.total(motion.bend_rate),
            pressure=trace.pressure,
            valves=trace.valves,
            sensed=self.sensor.read(bend, time, self.seed),
            contact_force=force,
            obstacle_force=obstacles,
            torque=motion.torque,
            work=energy + motion.states[:, kernels.ENERGY_LOSS] + self._body.stored(motion.bend),
            internal_loss=np.zeros(count),
            air=trace.air,
            qpos=np.empty((count, 0)),
        )
