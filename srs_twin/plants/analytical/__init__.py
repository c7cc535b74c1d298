r"""AnalyticalSnake: the dissertation's planar model, masses on constant-curvature segments.

What moves is a `Body`: bends as given (`GivenBends`), a chain held at its head (`ClampedBends`), or bends
that yield, as springs with dampers that the chambers pull (`YieldingBends`, model `compliant`).

The bends of a clamped chain are the free ones of Eq. 14, as on a bench.
Nothing but the clamp touches it, so that its motion is geometry. What its segments must exert follows from
the head to the tail and back: accelerations of the connectors outwards,

$$ a_{j+1} = a_j - (\ddot L - L\dot\psi^2)\,e(\psi) - (L\ddot\psi + 2\dot L\dot\psi)\,e_\perp(\psi), $$

with ψ the direction of chord j, and moments inwards: T_j is the force conjugate to the bend q_j.
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
from srs_twin.plants.analytical.floor import FloorFriction, floor_friction
from srs_twin.plants.analytical.kernels import inverse_dynamics
from srs_twin.plants.analytical.kinematics import ROWS, Solid, chord_terms, pose_body
from srs_twin.plants.analytical.steps import Steps, advance
from srs_twin.plants.base import (
    BASES,
    PneumaticPlant,
    Pose,
    SnakeState,
    check_before,
    check_moment,
    check_plausible,
)
from srs_twin.pneumatics import Pneumatics, Schedule, Trace
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.robot.friction import LAWS, TWO_POINT_LAWS
from srs_twin.robot.spec import GRAVITY, RobotSpec
from srs_twin.robot.world import World
from srs_twin.sensing import Sensor


class Motion(NamedTuple):
    """What a body did at some moments.

    Attributes:
        states: by the indices in `kernels`, shape (samples, STATES or more).
        velocities: of the centre of mass in the mean-heading frame (m/s), yaw rate (rad/s) and, where they
            are not given, bend rates, shape (samples, 3 or more).
        bend: shape (samples, segments), rad.
        bend_rate: same shape, rad/s.
        torque: net moment of each segment, same shape, N·m.
    """

    states: np.ndarray
    velocities: np.ndarray
    bend: np.ndarray
    bend_rate: np.ndarray
    torque: np.ndarray


class Body(Stateful, ABC):
    """The mechanics of an analytical model, driven by what the chambers do.

    Attributes:
        state: pose, velocity, moment of momentum and more by the indices in `kernels`.
        velocity: what `Motion.velocities` holds, now.
        solid: for the kernels.
        floor: for the kernels.
    """

    state_attributes: ClassVar[tuple[str, ...]] = ("state", "velocity")

    state: np.ndarray
    velocity: np.ndarray

    yields = False
    """Whether the bends are the body's own, not the free ones that the chambers would give."""

    def __init__(self, solid: Solid, floor: FloorFriction, own: int = 0) -> None:
        """Take solid and floor for the kernels, and how many bends of its own the body has."""
        self.solid, self.floor = solid, floor
        self._shapes = kernels.STATES + 2 * own, 3 + own

    def bends(self) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
        """Return the bends (rad) and their rates (rad/s) now; None from a body that has none of its own."""
        return None, None

    def reset(self, pose: Pose) -> None:
        """Lie straight, at rest, with the centre of mass at x, y (m) and that heading (rad)."""
        self.state, self.velocity = map(np.zeros, self._shapes)
        self.state[:3] = pose

    def place(self, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray) -> None:
        """Move from where `reset` has laid it.

        Args:
            velocity: of the centre of mass, world frame (m/s), and yaw rate (rad/s), shape (3,).
            bend: shape (segments,), rad.
            rate: same shape, rad/s.
        """
        (x, y, yaw), heading = velocity, float(self.state[kernels.HEADING])
        c, s = math.cos(heading), math.sin(heading)
        self.state[kernels.STATE_VX], self.state[kernels.STATE_VY] = x, y
        self.velocity[:3] = c * x + s * y, c * y - s * x, yaw
        inertia, moment = pose_body(bend, rate, self.solid, np.empty((ROWS, len(self.solid.mass))))
        self.state[kernels.MOMENT] = inertia * yaw + moment

    def _seen(self, marks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return room for states and velocities at some marks."""
        states, velocities = (np.zeros((len(marks), count)) for count in self._shapes)
        return states, velocities

    @abstractmethod
    def move(self, steps: np.ndarray, trace: Trace, marks: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """Advance by some steps.

        Args:
            steps: step lengths, shape (steps,), s.
            trace: what the chambers do at the start and at each step's two stages, 1 + 2 · steps rows.
            marks: numbers of steps after which to look, ascending, shape (samples,).

        Returns:
            How many steps were made, fewer than asked if one failed; the states and velocities of `Motion`
            at the marks, filled as far as they were reached.
        """

    @abstractmethod
    def look(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """Return the motion at moments for which the trace has one row each."""


class GivenBends(Body):
    """`complete` and `simplified`: the bends are the free ones of Eq. 14, whatever the load."""

    state_attributes = ("_slope",)

    def __init__(self, solid: Solid, floor: FloorFriction, *, turning: bool, tolerance: float) -> None:
        super().__init__(solid, floor)
        self._model, self._tolerance = (solid, floor, turning), tolerance

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`."""
        super().reset(pose)
        self._slope = np.zeros(kernels.STATES)

    def move(self, steps: np.ndarray, trace: Trace, marks: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`."""
        now, seen = (self.state, self._slope, self.velocity), self._seen(marks)
        done, _ = advance(now, steps, trace, marks, self._model, self._tolerance, seen)
        return done, *seen

    def look(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """See `Body.look`."""
        torque = np.empty_like(trace.bend)
        inverse_dynamics(velocities, trace, self._model, torque)
        return Motion(states, velocities, trace.bend, trace.bend_rate, torque)


class ClampedBends(Body):
    """A chain held at its head (module docstring)."""

    state_attributes = ("_head",)

    def __init__(self, solid: Solid, floor: FloorFriction) -> None:
        # In the air: the floor of the others takes no part.
        super().__init__(solid, floor._replace(mu_t=0.0, mu_n=0.0, drag=0.0))

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`; the head stays where it is then."""
        super().reset(pose)
        mass = self.solid.mass
        pitch = self.solid.length + self.solid.gap
        ahead = pitch * float(np.arange(len(mass)) @ mass) / float(mass.sum())
        x, y, heading = pose
        self._head = np.array([x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading])

    def place(self, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray) -> None:
        """See `Body.place`: its head is held."""
        raise InputError("a snake that is held at its head begins at rest only")

    def move(self, steps: np.ndarray, trace: Trace, marks: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`; `look` finds out where the chain is."""
        return len(steps), *self._seen(marks)

    def look(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """See `Body.look`; where the chain is follows from its bends alone."""
        torque = np.empty_like(trace.bend)
        hang(trace, self.solid, self._head, states, velocities, torque)
        return Motion(states, velocities, trace.bend, trace.bend_rate, torque)


@allocating
def hang(trace, solid, head, states, velocities, torque):  # type: ignore[no-untyped-def]
    """Fill what follows from the bends of a chain that is held at its head.

    Args:
        trace: of the chambers, whose free bends they are.
        solid: the chain.
        head: where it is held: x, y (m), heading (rad).
        states: out, pose and velocity of the centre of mass by the indices in `kernels`, world frame.
        velocities: out, the same velocity in the mean-heading frame and the mean spin, shape (samples, 3).
        torque: out, net moments that the bends need, shape (samples, segments), N·m.
    """
    n, total = solid.mass.shape[0], solid.mass.sum()
    place, pull, gain = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)
    lever = np.empty((n - 1, 2))
    for k in range(trace.bend.shape[0]):
        angle, spin, mean, mean_spin = head[2], 0.0, head[2], 0.0
        gain[0] = 0.0
        place[0], pull[0] = 0.0, 0.0
        v_x = v_y = com_x = com_y = com_vx = com_vy = 0.0
        for j in range(n - 1):
            q, dq, ddq = trace.bend[k, j], trace.bend_rate[k, j], trace.bend_acceleration[k, j]
            psi, turn, twist = angle - q / 2, spin - dq / 2, gain[j] - ddq / 2
            angle, spin, gain[j + 1] = angle - q, spin - dq, gain[j] - ddq
            _, _, span, slope, curvature = chord_terms(q, solid)
            stretch, swell = slope * dq, curvature * dq * dq + slope * ddq
            inward, aside = swell - span * turn * turn, span * twist + 2 * stretch * turn
            c, s = math.cos(psi), math.sin(psi)
            place[j + 1, 0], place[j + 1, 1] = place[j, 0] - span * c, place[j, 1] - span * s
            v_x, v_y = v_x - stretch * c + span * turn * s, v_y - stretch * s - span * turn * c
            pull[j + 1, 0] = pull[j, 0] - inward * c + aside * s
            pull[j + 1, 1] = pull[j, 1] - inward * s - aside * c
            # The bend's lever on what is behind: the chord shortens, and turns by half of the bend.
            lever[j, 0], lever[j, 1] = -slope * c - span / 2 * s, -slope * s + span / 2 * c
            share = solid.mass[j + 1] / total
            com_x, com_y = com_x + share * place[j + 1, 0], com_y + share * place[j + 1, 1]
            com_vx, com_vy = com_vx + share * v_x, com_vy + share * v_y
            mean, mean_spin = mean + (angle - head[2]) / n, mean_spin + spin / n
        states[k, kernels.STATE_X], states[k, kernels.STATE_Y] = head[0] + com_x, head[1] + com_y
        states[k, kernels.HEADING] = mean
        states[k, kernels.STATE_VX], states[k, kernels.STATE_VY] = com_vx, com_vy
        c, s = math.cos(mean), math.sin(mean)
        velocities[k, 0], velocities[k, 1] = com_vx * c + com_vy * s, com_vy * c - com_vx * s
        velocities[k, 2] = mean_spin
        push_x = push_y = moment = 0.0
        for j in range(n - 2, -1, -1):
            # Of all behind segment j: net force, and its moment about the connector at its rear end.
            if j < n - 2:
                arm_x, arm_y = place[j + 2, 0] - place[j + 1, 0], place[j + 2, 1] - place[j + 1, 1]
                moment += arm_x * push_y - arm_y * push_x
            push_x += solid.mass[j + 1] * pull[j + 1, 0]
            push_y += solid.mass[j + 1] * pull[j + 1, 1]
            moment += solid.inertia[j + 1] * gain[j + 1]
            torque[k, j] = lever[j, 0] * push_x + lever[j, 1] * push_y - moment


class YieldingBends(Body):
    """Point masses on springs with dampers.

    A segment feels the moment that `bending` tells, k G (p⁺ − p⁻) where all is nominal and linear, against
    its stiffness k and damping c = k · damping_time, so that a massless free one obeys Eq. 14; masses and
    floor bend it further.
    """

    yields = True

    def __init__(self, spec: RobotSpec, solid: Solid, floor: FloorFriction) -> None:
        super().__init__(solid, floor, spec.segments)
        bending = spec.bending
        self._spring = bending.stiffness, bending.damping
        self._spec, self._bias = spec, spec.modules.array("bias")
        self._segments = spec.segments

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`."""
        super().reset(pose)
        self.bends()[0][:] = self._bias

    def place(self, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray) -> None:
        """See `Body.place`."""
        super().place(velocity, bend, rate)
        self.bends()[0][:], self.velocity[3:] = bend, rate
        momentum, force = np.empty((2, len(self.velocity)))
        model, work = (self.solid, self._spring, self.floor), compliant_kernels.room(len(self.solid.mass))
        compliant_kernels.balance(
            bend, self.velocity, np.zeros(self._segments), 0.0, model, momentum, force, work
        )
        self.state[compliant_kernels.BENDS + self._segments :] = momentum[3:]

    def move(self, steps: np.ndarray, trace: Trace, marks: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`."""
        now, model = (self.state, self.velocity), (self.solid, self._spring, self.floor)
        seen = self._seen(marks)
        moments = self._moments(trace)[1:].reshape(len(steps), 2, -1)
        done: int = compliant_kernels.advance(now, steps, moments, marks, model, seen)
        return done, *seen

    def bends(self) -> tuple[np.ndarray, np.ndarray]:
        """See `Body.bends`."""
        return self.state[compliant_kernels.BENDS :][: self._segments], self.velocity[3:]

    def look(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """See `Body.look`."""
        bend, rate = states[:, compliant_kernels.BENDS :][:, : self._segments], velocities[:, 3:]
        stiffness, damping = self._spring
        torque = self._moments(trace) - stiffness * bend - damping * rate
        return Motion(states[:, : kernels.STATES], velocities, bend, rate, torque)

    def _moments(self, trace: Trace) -> np.ndarray:
        """Return what chambers and bias exert on each segment, N·m."""
        moments: np.ndarray = self._spring[0] * (self._bias + air_bend(self._spec, trace.pressure))
        return moments


MODELS = ("complete", "simplified", "compliant")
LOADS = ("static", "momentary")
INERTIAS = ("point", "connector", "lumped")
_MASSLESS_S = 0.0001  # at 0.25 ms pressures of point masses swing below ambient; half of this changes nothing


class AnalyticalSnake(PneumaticPlant):
    """The planar model (Section 3.1): `complete`, whose bends follow Eq. 14, or one of its neighbours.

    Point masses on arcs of constant curvature under the floor's friction; Eq. 11 summed over the body (E22).
    `simplified` freezes every chord at its straight length; `compliant` lets the bends yield to load and
    inertia.

    Attributes:
        timestep: longest step of the integrator, s; steps also end on valve events.
        friction: law of the floor, one of `friction.LAWS`.
    """

    name = "analytical"
    state_attributes = ("_body",)
    stretch = 10.0

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
        tick: float = 0.02,
        timestep: float = 0.002,
        tolerance: float = 0.0002,
        slip_speed: float = 0.00025,
        layout: str = "3/2",
        pneumatics: str | Pneumatics = "lag",
        track: float | None = None,
        base: str = "free",
        sensor: str | Sensor = "ideal",
        world: World | None = None,
    ) -> None:
        """Build the model.

        Args:
            spec: the robot.
            model: "complete" (bends as given), "simplified" (chords frozen at l + L_o besides) or
                "compliant" (bends that load and inertia deflect).
            friction: "axis" (one point a connector, the text's law), "wheel" (two wheels at the track),
                "ellipse" (two skids there) or "viscous" (a law to test with).
            load: of a wheel or skid, "static" (half its connector's weight) or "momentary" (what the force
                across shifts between the two, `floor`).
            friction_torque: whether friction's moment about the centre of mass acts; False is the text's
                first model, `simplified` only.
            inertia: of each connector about itself: "point" none, "connector" that of a compact body with
                two wheels, as the twin has it, "lumped" the text's j(i) = Σ m L²/3, which counts the
                segments' masses twice (E19).
            supply_pa: supply pressure, Pa; default the robot's nominal one.
            tick: control tick, s.
            timestep: longest step, s.
            tolerance: of what a step may misjudge while friction turns, as a velocity, m/s; where bends are
                given, steps are cut until they keep it, see `steps`.
            slip_speed: ε of the friction law, m/s.
            layout: valve layout, "3/2" or "in_out".
            pneumatics: "lag", "orifice", or chambers of one's own.
            track: where the two contacts of a connector stand, m; default the robot's half track for a law
                that acts at the wheels and 0, one contact, for the others.
            base: "free", or "clamped": held at the head, in the air (not with "compliant").
            sensor: of the bends, "ideal", "hall" with its defaults, or one of one's own.
            world: whose floor it lies on; None: a level one. Nothing else of it is felt.

        Raises:
            InputError: an unknown model, law, load, inertia or layout, a tick, time step or tolerance that is
                not above 0, no friction torque with another model, momentary loads of a law that does not act
                at the wheels, a floor with steps, or a tail on two axles.
        """
        check_choice("model", model, MODELS)
        check_choice("friction law", friction, LAWS)
        check_choice("load", load, LOADS)
        check_choice("inertia", inertia, INERTIAS)
        if load == "momentary" and friction not in TWO_POINT_LAWS:
            raise InputError(f"friction '{friction}' acts in one point a connector; momentary loads need two")
        world = world or World()
        if world.steps:
            raise InputError("the analytical model's floor is a plane; only the twin climbs steps")
        if spec.tail is not None:
            raise InputError("the analytical model has an axle a connector; a tail on two is the twin's")
        check_choice("base", base, BASES)
        if not friction_torque and model != "simplified":
            raise InputError(f"model '{model}' has a friction torque; only 'simplified' goes without")
        if base == "clamped" and model == "compliant":
            raise InputError("model 'compliant' is for a free snake; on a bench 'complete' and the twin run")
        check_positive("tick", tick, "s")
        check_positive("time step", timestep, "s")
        check_positive("tolerance", tolerance, "m/s")
        self.spec, self.tick, self.timestep, self.friction = spec, tick, timestep, friction
        self._equip(pneumatics, supply_pa, layout, sensor)
        self._model, self._inertia, self._turning = model, inertia, friction_torque
        self.base = base
        if track is None:
            track = spec.geometry.half_track if friction in TWO_POINT_LAWS else 0.0
        mu = spec.friction
        self._tolerance = tolerance
        self.load = load
        lean = spec.geometry.com_height / (2 * track) if load == "momentary" else 0.0
        x, y, z = world.floor.down
        gravity = GRAVITY * x, GRAVITY * y, GRAVITY * z
        drag = mu.drag / spec.geometry.connectors
        self._ground = world.floor
        self._floor = floor_friction(friction, track, mu.mu_t, mu.mu_n, slip_speed, lean, gravity, drag)
        self._body = self._make_body()
        self.reset()

    def reset(self, *, pose: Pose = (0.0, 0.0, 0.0), seed: int = 0) -> SnakeState:
        """Lay the snake straight, at rest, chambers empty. `seed` is the sensors' noise's."""
        self.pneumatics.reset()
        self._ticks, self.seed = 0, seed
        self._body.reset(pose)
        body, trace = self._body, self.pneumatics.resting()
        now = body.look(body.state[None].copy(), body.velocity[None].copy(), trace)
        self.state = self._observe(np.zeros(1), now, trace).at(0)
        return self.state

    def place(self, snake: SnakeState, *, yaw_rate: float = 0.0, seed: int = 0) -> SnakeState:
        """See `Plant.place`."""
        check_moment(snake, yaw_rate, self.spec.segments)
        x, y = map(float, snake.com)
        self.reset(pose=(x, y, float(snake.heading)), seed=seed)
        self.pneumatics.place(snake.pressure, snake.bend)
        body, trace = self._body, self.pneumatics.now()
        own = (snake.bend, snake.bend_rate) if body.yields else (trace.bend[0], trace.bend_rate[0])
        body.place(np.array([*snake.com_velocity, yaw_rate]), *(np.array(each, dtype=float) for each in own))
        now = body.look(body.state[None].copy(), body.velocity[None].copy(), trace)
        self.state = self._observe(np.zeros(1), now, trace).at(0)
        return self.state

    def _follow(self, schedule: Schedule, ticks: int, samples: int) -> SnakeState:
        """Follow a schedule of possible valve states over so many ticks."""
        begun = self._ticks * self.tick
        check_before(self.name, begun + self.timestep, self._body.state, self._body.velocity)
        steps = self._steps(self.pneumatics.effective(schedule), samples)
        done, motion, trace = self._drive(schedule, steps)
        times = begun + schedule.span * np.arange(1, samples + 1) / samples
        history = self._observe(times[: len(motion.states)], motion, trace)
        if done < len(steps.ends):
            state = ", ".join(f"{value:.4g}" for value in self._body.state)
            text = f"step {done + 1} of {len(steps.ends)} found no plausible solution, state {state}"
            raise DivergedError(self.name, begun + steps.ends[done], text, history=history)
        self._ticks += ticks
        return check_plausible(self.name, history)

    def _drive(self, schedule: Schedule, steps: Steps) -> tuple[int, Motion, Trace]:
        """Advance chambers and body; return the steps made, and what was at the marks that were reached.

        Chambers that feel how a yielding body bends take turns with it, a step or two each.
        """
        motions, traces, done = [], [], 0
        for part, piece in self._turns(schedule, steps):
            bend, rate = self._body.bends()
            trace = self.pneumatics.advance(part, piece.moments, bend=bend, bend_rate=rate)
            made, states, velocities = self._body.move(piece.lengths, trace, piece.marks)
            reached = int(np.searchsorted(piece.marks, made, side="right"))
            traces.append(trace.at(2 * piece.marks[:reached]))
            motions.append(self._body.look(states[:reached], velocities[:reached], traces[-1]))
            done += made
            if made < len(piece.lengths):
                break
        return done, concatenate_records(motions), concatenate_records(traces)

    def _turns(self, schedule: Schedule, steps: Steps) -> Iterator[tuple[Schedule, Steps]]:
        if not self._chambers_feel:
            yield schedule, steps
            return
        for begin, end, piece in steps.pieces(self._turn):
            yield schedule.part(begin, end), piece

    def describe(self) -> dict[str, Any]:
        """Return the settings worth recording."""
        return (
            super().describe()
            | {
                "model": self._model,
                "base": self.base,
                "friction": self.friction,
                "friction_torque": self._turning,
                "inertia": self._inertia,
                "track_m": self._floor.track,
                "timestep_s": self.timestep,
                "slip_speed_m_s": self._floor.slip,
                "tolerance_m_s": self._tolerance,
            }
            | ({} if self.load == "static" else {"load": self.load})
        )

    def identity(self) -> dict[str, Any]:
        """See `Plant.identity`."""
        return super().identity() | {"floor": short_digest(self._ground)}

    def _make_body(self) -> Body:
        g = self.spec.geometry
        frozen = 1.0 if self._model == "simplified" else 0.0
        lengths = g.segment_length, g.rigid_gap
        solid = Solid(self.spec.mass.array(), self._own_inertia(), *lengths, frozen)
        if self.base == "clamped":
            return ClampedBends(solid, self._floor)
        if self._model != "compliant":
            return GivenBends(solid, self._floor, turning=self._turning, tolerance=self._tolerance)
        return YieldingBends(self.spec, solid, self._floor)

    @property
    def _chambers_feel(self) -> bool:
        return self.pneumatics.feels_bend and self._body.yields

    @property
    def _turn(self) -> float:
        """How often bodies and chambers take turns at least, s: what has no inertia follows air at once."""
        massless = not self._body.solid.inertia.all()
        return min(self.pneumatics.felt_s, _MASSLESS_S) if massless else self.pneumatics.felt_s

    def _own_inertia(self) -> np.ndarray:
        """Return the connectors' moments of inertia about themselves, shape (N,), kg·m²."""
        if self._inertia == "connector":
            return self.spec.yaw_inertia()
        mass = self.spec.mass.array()
        if self._inertia == "point":
            return np.zeros_like(mass)
        segments = np.full(len(mass), 2.0)
        segments[[0, -1]] = 1.0
        lumped: np.ndarray = segments * mass * self.spec.geometry.pitch**2 / 3
        return lumped

    def _steps(self, schedule: Schedule, samples: int) -> Steps:
        """Return the integrator's steps, as fine as the time step asks."""
        longest = min(self.timestep, self._turn) if self._chambers_feel else self.timestep
        return Steps.between(schedule.span, schedule.events, samples, longest=longest, same=1e-9 * self.tick)

    def _observe(self, time: np.ndarray, motion: Motion, trace: Trace) -> SnakeState:
        """Return the history of these moments."""
        count, n = len(time), self.spec.geometry.connectors
        position, theta, force = np.empty((count, n, 2)), np.empty((count, n)), np.empty((count, n, 2))
        energy = np.empty(count)
        wheels = self._floor._replace(drag=0.0)
        kernels.observe(motion, self._body.solid, wheels, position, theta, force, energy)
        return SnakeState(
            time=time,
            com=motion.states[:, kernels.STATE_X : kernels.STATE_Y + 1],
            com_velocity=motion.states[:, kernels.STATE_VX : kernels.STATE_VY + 1],
            heading=motion.states[:, kernels.HEADING],
            position=position,
            theta=theta,
            bend=motion.bend,
            bend_rate=motion.bend_rate,
            pressure=trace.pressure,
            valves=trace.valves,
            sensed=self.sensor.read(motion.bend, time, self.seed),
            contact_force=force,
            obstacle_force=np.zeros_like(force),
            torque=motion.torque,
            work=energy + motion.states[:, kernels.SPENT],
            internal_loss=np.zeros(count),
            air=trace.air,
            qpos=np.empty((count, 0)),
        )
