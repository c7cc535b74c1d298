r"""Bodies of the planar models, with connectors joined by arcs of constant curvature.

If the head of a chain is clamped in the air, the free bends of Eq. 14 alone determine
the motion. The recursive Newton–Euler algorithm computes the moments of the segments in
two loops. The loop from head to tail computes the acceleration a_j of each connector j,

$$ a_{j+1} = a_j - (\ddot L - L\dot\psi^2)\,e(\psi) - (L\ddot\psi + 2\dot L\dot\psi)\,e_\perp(\psi). $$

Here chord j has length L and direction ψ. The unit vectors e(ψ) and e_⊥(ψ) are parallel
and normal to the chord. The loop from tail to head sums forces and moments. It computes
the moment T_j of segment j as the generalised force of the bend q_j.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, inlined
from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.plants.analytical import compliant_kernels, kernels
from srs_twin.plants.analytical.cells import LumpedSegments
from srs_twin.plants.analytical.floor import FloorFriction
from srs_twin.plants.analytical.kernels import (
    Bends,
    PrescribedModel,
    Samples,
    inverse_dynamics,
)
from srs_twin.plants.analytical.kinematics import (
    ROWS,
    BodyParameters,
    chord_terms,
    pose_body,
)
from srs_twin.plants.analytical.obstacles import Obstacles
from srs_twin.plants.analytical.steps import PrescribedState, advance
from srs_twin.plants.base import Pose
from srs_twin.pneumatics import Trace
from srs_twin.robot.spec import RobotSpec


class Motion(NamedTuple):
    """Motion of a body at several times.

    `QuasistaticArcs` instead uses states as in `spatial_kinematics` and two bends per
    segment.

    Attributes:
        states: states in the layout of `kernels`, shape (samples, STATES or more). With
            obstacles, further columns contain the mean obstacle force on each point
            since the previous sample.
        velocities: velocity of the centre of mass in the mean-heading frame (m/s), yaw
            rate (rad/s) and, for compliant bends, bend rates (rad/s), shape (samples, 3
            or more).
        bend, bend_rate: bends (rad) and bend rates (rad/s), shape (samples, segments).
            If the segments are divided into cells, the shape is (samples, cells).
        torque: net moment of each segment, shape (samples, segments), N·m.
    """

    states: np.ndarray
    velocities: np.ndarray
    bend: np.ndarray
    bend_rate: np.ndarray
    torque: np.ndarray


class Body(Stateful, ABC):
    """Abstract base class for the mechanics of an analytical model.

    Attributes:
        state: current state. Planar bodies use the layout of `kernels`, to which
            `CompliantBends` appends entries.
        velocity: current velocities, as in `Motion.velocities`.
        obstacles: obstacles that the body can touch, or None if there are none.
    """

    state_attributes: ClassVar[tuple[str, ...]] = ("state", "velocity")

    state: np.ndarray
    velocity: np.ndarray
    obstacles: Obstacles | None = None

    compliant = False
    """Whether load and inertia deflect the segments from their free bends."""

    def __init__(
        self,
        solid: BodyParameters,
        floor: FloorFriction,
        cells: LumpedSegments,
        bends: int = 0,
    ) -> None:
        """Store the constants of a body with `bends` compliant bends."""
        self.solid = solid
        self.floor = floor
        self.cells = cells
        self._shapes = kernels.STATES + 2 * bends, 3 + bends

    @property
    def jumps(self) -> int:
        """Number of jumps between resting poses since `reset`."""
        return 0

    def bends(self) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
        """Return the bends (rad) and bend rates (rad/s) if the bends are compliant.

        For prescribed bends, the result is (None, None).
        """
        return None, None

    def reset(self, pose: Pose) -> None:
        """Place the body at rest with a given centre of mass and mean heading."""
        self.state, self.velocity = map(np.zeros, self._shapes)
        self.state[:3] = pose

    def set_state(
        self, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray
    ) -> None:
        """Set velocities, bends and bend rates after `reset`.

        Args:
            velocity: velocity of the centre of mass in the world frame (m/s) and yaw
                rate (rad/s), shape (3,).
            bend: bends of the segments, shape (segments,), rad.
            rate: bend rates, shape (segments,), rad/s.
        """
        bend = self.cells.split(bend)
        rate = self.cells.split(rate)
        self.state[kernels.HEADING] += self.cells.lead(bend)
        x, y, yaw = velocity
        yaw += self.cells.lead(rate)
        heading = float(self.state[kernels.HEADING])
        c = math.cos(heading)
        s = math.sin(heading)
        self.state[kernels.STATE_VX] = x
        self.state[kernels.STATE_VY] = y
        self.velocity[:3] = c * x + s * y, c * y - s * x, yaw
        inertia, moment = pose_body(
            bend, rate, self.solid, np.empty((ROWS, len(self.solid.mass)))
        )
        self.state[kernels.MOMENT] = inertia * yaw + moment

    def _allocate(self, samples: int) -> Samples:
        return Samples(*(np.zeros((samples, count)) for count in self._shapes))

    def _split(self, trace: Trace) -> Trace:
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
        """Advance the body by several time steps.

        Args:
            steps: lengths of the steps, shape (steps,), s.
            trace: chamber states at the start and at the two stages of each step,
                1 + 2 · steps rows.
            sample_steps: number of steps before each sample, ascending, shape
                (samples,).

        Returns:
            Number of completed steps, and the values of `state` and `velocity` at the
            samples. If a step fails, the later steps are not computed.
        """

    def stored(self, bend: np.ndarray, free: np.ndarray) -> float | np.ndarray:
        """Return the total elastic energy of the segments, shape (samples,), J.

        Args:
            bend: bends of the cells, shape (samples, cells), rad.
            free: free bends of the segments, shape (samples, segments), rad.
        """
        return 0.0

    @abstractmethod
    def motion(
        self, states: np.ndarray, velocities: np.ndarray, trace: Trace
    ) -> Motion:
        """Compute the motion at samples of states, velocities and chamber states."""


class PrescribedBends(Body):
    """Body of the models `complete` and `simplified`, whose bends obey Eq. 14."""

    state_attributes = ("_state_rate",)

    def __init__(
        self, model: PrescribedModel, cells: LumpedSegments, tolerance: float
    ) -> None:
        super().__init__(model.solid, model.floor, cells)
        self._model = model
        self._tolerance = tolerance

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`."""
        super().reset(pose)
        self._state_rate = np.zeros(kernels.STATES)

    def move(
        self, steps: np.ndarray, trace: Trace, sample_steps: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`."""
        now = PrescribedState(self.state, self._state_rate, self.velocity)
        samples = self._allocate(len(sample_steps))
        trace = self._split(trace)
        done, _ = advance(
            now, steps, trace, sample_steps, self._model, self._tolerance, samples
        )
        return done, *samples

    def motion(
        self, states: np.ndarray, velocities: np.ndarray, trace: Trace
    ) -> Motion:
        """See `Body.motion`."""
        trace = self._split(trace)
        torque = np.empty_like(trace.bend)
        inverse_dynamics(velocities, trace, self._model, torque)
        return Motion(
            states, velocities, trace.bend, trace.bend_rate, self.cells.moments(torque)
        )


class ClampedBends(Body):
    """Chain in the air whose head is clamped."""

    state_attributes = ("_head_pose",)

    def __init__(
        self, solid: BodyParameters, floor: FloorFriction, cells: LumpedSegments
    ) -> None:
        super().__init__(
            solid, floor._replace(mu_t=0.0, mu_back=0.0, mu_n=0.0, drag=0.0), cells
        )

    def reset(self, pose: Pose) -> None:
        """Clamp the head of a straight body with a given centre of mass and heading."""
        super().reset(pose)
        x, y, heading = pose
        ahead = self.cells.com_behind_head
        self._head_pose = np.array(
            [x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading]
        )

    def set_state(
        self, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray
    ) -> None:
        """Raise an `InputError`, because a clamped chain can only start at rest."""
        raise InputError("a snake that is clamped at its head can only start at rest")

    def move(
        self, steps: np.ndarray, trace: Trace, sample_steps: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`. The method `motion` computes the states instead."""
        return len(steps), *self._allocate(len(sample_steps))

    def motion(
        self, states: np.ndarray, velocities: np.ndarray, trace: Trace
    ) -> Motion:
        """Compute the motion from the bends, and overwrite states and velocities."""
        trace = self._split(trace)
        torque = np.empty_like(trace.bend)
        simulate_clamped(trace, self.solid, self._head_pose, states, velocities, torque)
        return Motion(
            states, velocities, trace.bend, trace.bend_rate, self.cells.moments(torque)
        )


class _Chain(NamedTuple):
    # Positions are in the world frame, relative to the head connector. `lever` is the
    # velocity of a segment's rear end per unit bend rate, for a fixed front end (m).

    position: np.ndarray
    acceleration: np.ndarray
    alpha: np.ndarray
    lever: np.ndarray


class _Centre(NamedTuple):
    x: float
    y: float
    vx: float
    vy: float
    heading: float
    spin: float


@allocating
def simulate_clamped(trace, solid, head, states, velocities, torque):  # type: ignore[no-untyped-def]
    """Compute states, velocities and moments of a chain with a clamped head.

    Args:
        trace: chamber states, whose free bends are the bends of the chain.
        solid: constants of the chain.
        head: position x, y (m) and heading (rad) of the head.
        states: output for pose and velocity of the body in the layout of `kernels`.
        velocities: output for the velocity of the centre of mass in the mean-heading
            frame (m/s) and the yaw rate (rad/s), shape (samples, 3).
        torque: output for net moments of the segments, shape (samples, segments), N·m.
    """
    n = solid.mass.shape[0]
    chain = _Chain(
        np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n), np.empty((n - 1, 2))
    )
    total = solid.mass.sum()
    for k in range(trace.bend.shape[0]):
        centre = _accelerate(trace, k, solid, total, head[2], chain)
        states[k, kernels.STATE_X] = head[0] + centre.x
        states[k, kernels.STATE_Y] = head[1] + centre.y
        states[k, kernels.HEADING] = centre.heading
        states[k, kernels.STATE_VX] = centre.vx
        states[k, kernels.STATE_VY] = centre.vy
        c = math.cos(centre.heading)
        s = math.sin(centre.heading)
        velocities[k, 0] = centre.vx * c + centre.vy * s
        velocities[k, 1] = centre.vy * c - centre.vx * s
        velocities[k, 2] = centre.spin
        _fill_moments(solid, chain, torque[k])


@inlined
def _accelerate(trace, k, solid, total, heading, chain):  # type: ignore[no-untyped-def]
    # `heading` is the heading of the head (rad), which is fixed at the origin. `total`
    # is the mass of the chain (kg).
    n = solid.mass.shape[0]
    position = chain.position
    acceleration = chain.acceleration
    alpha = chain.alpha
    angle = heading
    spin = 0.0
    mean = heading
    mean_spin = 0.0
    v_x = v_y = com_x = com_y = com_vx = com_vy = 0.0
    for j in range(n - 1):
        q = trace.bend[k, j]
        dq = trace.bend_rate[k, j]
        ddq = trace.bend_acceleration[k, j]
        psi = angle - q / 2
        chord_spin = spin - dq / 2
        chord_alpha = alpha[j] - ddq / 2
        angle = angle - q
        spin = spin - dq
        alpha[j + 1] = alpha[j] - ddq
        chord = chord_terms(q, solid, j)
        span = chord.span
        chord_rate = chord.derivative * dq
        chord_acceleration = chord.curvature * dq * dq + chord.derivative * ddq
        inward = chord_acceleration - span * chord_spin * chord_spin
        lateral = span * chord_alpha + 2 * chord_rate * chord_spin
        c = math.cos(psi)
        s = math.sin(psi)
        position[j + 1, 0] = position[j, 0] - span * c
        position[j + 1, 1] = position[j, 1] - span * s
        v_x = v_x - chord_rate * c + span * chord_spin * s
        v_y = v_y - chord_rate * s - span * chord_spin * c
        acceleration[j + 1, 0] = acceleration[j, 0] - inward * c + lateral * s
        acceleration[j + 1, 1] = acceleration[j, 1] - inward * s - lateral * c
        # A bend shortens the chord and rotates it by half the bend angle.
        chain.lever[j, 0] = -chord.derivative * c - span / 2 * s
        chain.lever[j, 1] = -chord.derivative * s + span / 2 * c
        fraction = solid.mass[j + 1] / total
        com_x = com_x + fraction * position[j + 1, 0]
        com_y = com_y + fraction * position[j + 1, 1]
        com_vx = com_vx + fraction * v_x
        com_vy = com_vy + fraction * v_y
        mean = mean + (angle - heading) / n
        mean_spin = mean_spin + spin / n
    return _Centre(com_x, com_y, com_vx, com_vy, mean, mean_spin)


@inlined
def _fill_moments(solid, chain, torque):  # type: ignore[no-untyped-def]
    n = solid.mass.shape[0]
    position = chain.position
    force_x = force_y = moment = 0.0
    for j in range(n - 2, -1, -1):
        # Moments are taken about the connector at the rear end of segment j.
        if j < n - 2:
            arm_x = position[j + 2, 0] - position[j + 1, 0]
            arm_y = position[j + 2, 1] - position[j + 1, 1]
            moment += arm_x * force_y - arm_y * force_x
        force_x += solid.mass[j + 1] * chain.acceleration[j + 1, 0]
        force_y += solid.mass[j + 1] * chain.acceleration[j + 1, 1]
        moment += solid.inertia[j + 1] * chain.alpha[j + 1]
        torque[j] = chain.lever[j, 0] * force_x + chain.lever[j, 1] * force_y - moment


class CompliantBends(Body):
    """Body of the model `compliant`, whose segments act as springs and dampers.

    A segment with bend q and free bend q_f exerts the moment k (q_f − q) + c
    (q̇_f − q̇), where k is the stiffness and c = k · damping_time the damping. Load and
    inertia deflect the segment from the free bend, which obeys Eq. 14.
    """

    state_attributes = ("_sampled", "_contact_loads")
    compliant = True

    def __init__(
        self,
        spec: RobotSpec,
        solid: BodyParameters,
        floor: FloorFriction,
        cells: LumpedSegments,
        obstacles: Obstacles | None = None,
    ) -> None:
        self._bends = len(solid.mass) - 1
        super().__init__(solid, floor, cells, self._bends)
        bending = spec.bending
        springs = (
            bending.stiffness * cells.inverse_fraction,
            bending.damping * cells.inverse_fraction,
        )
        self.obstacles = obstacles
        self._model = compliant_kernels.CompliantModel.of(
            solid, *springs, floor, obstacles
        )
        self._momenta = slice(
            compliant_kernels.BENDS + self._bends,
            compliant_kernels.BENDS + 2 * self._bends,
        )
        # With obstacles, the state ends with the impulses that the obstacles exert on
        # each point, and the time.
        self._impulses = slice(self._momenta.stop, None)
        count = 0 if obstacles is None else obstacles.force.size + 1
        self._shapes = self._momenta.stop + count, self._shapes[1]
        self._workspace = compliant_kernels.WorkArrays.of(
            self._bends + 1, self._shapes[0]
        )
        self._spec = spec
        self._bias = spec.modules.array("bias")

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`."""
        super().reset(pose)
        self._sampled = self.state[self._impulses].copy()
        self._contact_loads = np.zeros_like(self._contact_loads)
        bias = self.cells.split(self._bias)
        self.state[compliant_kernels.BENDS :][: self._bends] = bias
        self.state[kernels.HEADING] += self.cells.lead(bias)

    def set_state(
        self, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray
    ) -> None:
        """See `Body.set_state`."""
        self.state[kernels.HEADING] -= self.cells.lead(self.cells.split(self._bias))
        super().set_state(velocity, bend, rate)
        bend = self.cells.split(bend)
        rate = self.cells.split(rate)
        self.state[compliant_kernels.BENDS :][: self._bends] = bend
        self.velocity[3:] = rate
        model = self._model._replace(obstacles=None)
        workspace = self._workspace
        air = np.zeros(self._bends)
        compliant_kernels.balance(
            bend, self.velocity, air, 0.0, model, model.floor, workspace
        )
        self.state[self._momenta] = workspace.momentum[3:]

    @property
    def _contact_loads(self) -> np.ndarray:
        if self.obstacles is None:
            return np.empty(0)
        return np.stack([self.obstacles.normal, self.obstacles.load])

    @_contact_loads.setter
    def _contact_loads(self, loads: np.ndarray) -> None:
        if self.obstacles is not None:
            self.obstacles.normal[:], self.obstacles.load[:] = loads

    def move(
        self, steps: np.ndarray, trace: Trace, sample_steps: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`."""
        now = compliant_kernels.CompliantState(self.state, self.velocity)
        samples = self._allocate(len(sample_steps))
        split = self.cells.split
        free = Bends(split(trace.bend), split(trace.bend_rate))
        done: int = compliant_kernels.advance(
            now, steps, free, sample_steps, self._model, samples, self._workspace
        )
        if self.obstacles is not None:
            self._average_forces(
                samples.states[:, self._impulses], sample_steps <= done
            )
        return done, *samples

    def _average_forces(self, impulses: np.ndarray, reached: np.ndarray) -> None:
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

    def stored(self, bend: np.ndarray, free: np.ndarray) -> float | np.ndarray:
        """See `Body.stored`."""
        energy: np.ndarray = (
            self._model.stiffness * (bend - self.cells.split(free)) ** 2
        ).sum(axis=-1) / 2
        return energy

    def motion(
        self, states: np.ndarray, velocities: np.ndarray, trace: Trace
    ) -> Motion:
        """See `Body.motion`."""
        bend = states[:, compliant_kernels.BENDS :][:, : self._bends]
        rate = velocities[:, 3:]
        total = self.cells.total
        bending = self._spec.bending
        torque = bending.moment(trace.bend - total(bend), trace.bend_rate - total(rate))
        columns = np.hstack([states[:, : kernels.STATES], states[:, self._impulses]])
        return Motion(columns, velocities, bend, rate, torque)
