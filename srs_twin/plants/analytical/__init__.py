r"""AnalyticalSnake: the dissertation's planar model, masses on constant-curvature segments.

What moves is a `Body`: bends as given (`GivenBends`), a chain held at its head (`ClampedBends`), or bends
that yield, as springs with dampers that the chambers pull (`YieldingBends`, model `compliant`).

Steps end on valve events (`Steps`). Those of `complete` and `simplified` are short where the friction turns
and long elsewhere. Where the slip of a connector changes its sign, its friction turns from one side to the
other within a few times ε, mostly far less than a step. A step that takes such a turn at the wrong moment
errs by an impulse. The three rates of momentum that a step knows anyhow, k₀ at its start (the last stage of
the step before), k₁ and k₂, tell: as long as they change evenly, k₁ lies on the line between the other two.
What it lies off, over the step, as a velocity,

$$ \eta = \frac{h}{M}\,\bigl|\,k_1 - (1-\gamma)\,k_0 - \gamma\,k_2\,\bigr|, $$

is at least 0.7 of the error of a turn wherever in the step it falls, and of third order in h where friction
is smooth. The moment of momentum counts by the radius of gyration of a straight body. A step with η above the
tolerance is made anew in halves, each of which may be halved again; parts that fall well below it are doubled
again. Bends between the stages, where the chambers have told them, are cubics through bends and rates.

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
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from srs_twin.arrays import check_positive, joined
from srs_twin.compiled import compiled
from srs_twin.errors import DivergedError, InputError, one_of
from srs_twin.friction import AT_TRACK, LAWS
from srs_twin.plants.analytical import compliant_kernels, kernels
from srs_twin.plants.analytical.floor import FloorFriction, floor_friction
from srs_twin.plants.analytical.kernels import (
    GAMMA,
    MOMENT,
    SPEED_LIMIT,
    STATE_VX,
    STATE_VY,
    STATES,
    copy,
    inverse_dynamics,
    step,
)
from srs_twin.plants.analytical.kinematics import ROWS, Solid, chord_terms
from srs_twin.plants.base import BASES, PneumaticPlant, Pose, SnakeState, check_before, check_plausible
from srs_twin.pneumatics import Pneumatics, Schedule, Trace
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.robot.spec import RobotSpec
from srs_twin.sensing import Sensor


@dataclass(frozen=True)
class Steps:
    """The steps of a stretch; equal stretches without valve events share one, so nothing may be written to.

    Attributes:
        ends: ascending, from the stretch's start, shape (steps,), s.
        marks: numbers of steps after which a sample is due, ascending, shape (samples,).
    """

    ends: np.ndarray
    marks: np.ndarray

    @classmethod
    def between(cls, span: float, events: np.ndarray, samples: int, *, longest: float, same: float) -> Steps:
        """Return steps on an even grid, in step with the samples, and on every valve event in between.

        Args:
            span: length of the stretch, s.
            events: when valves change, ascending, s from its start.
            samples: how many, equally spaced, the last at the end.
            longest: no step is longer, s.
            same: events that are closer to the end of another step, or to each other, end none of their own,
                s.
        """
        per_sample = math.ceil(span / samples / longest * (1 - 1e-12))
        even = _even(span, samples, per_sample)
        if not len(events):
            return even
        grid = span / (samples * per_sample)
        steps = events / grid
        # Whichever of them rounding puts first.
        events = events[np.abs(steps - np.round(steps)) * grid > same]
        events = events[np.diff(events, prepend=-1.0) > same]
        marks = even.marks + np.searchsorted(events, even.ends[even.marks - 1])
        return cls(np.sort(np.concatenate([even.ends, events])), marks)

    @cached_property
    def lengths(self) -> np.ndarray:
        """Return the steps' lengths, shape (steps,), s."""
        return self.ends - self._starts

    @cached_property
    def moments(self) -> np.ndarray:
        """Return the start and each step's two stages, shape (1 + 2 · steps,), s."""
        found = np.zeros(1 + 2 * len(self.ends))
        found[1::2], found[2::2] = self._starts + GAMMA * self.lengths, self._starts + self.lengths
        return found

    def pieces(self, turn: float) -> Iterator[tuple[float, float, Steps]]:
        """Yield begin and end (s) and steps of pieces about as long as `turn` (s), of a step at least."""
        firsts = np.unique(np.floor(self.ends / turn * (1 - 1e-9)), return_index=True)[1]
        for first, last in zip(firsts, [*firsts[1:], len(self.ends)], strict=True):
            begun = float(self.ends[first - 1]) if first else 0.0
            inside = self.marks[(self.marks > first) & (self.marks <= last)] - first
            yield begun, float(self.ends[last - 1]), Steps(self.ends[first:last] - begun, inside)

    @property
    def _starts(self) -> np.ndarray:
        return np.append(0.0, self.ends[:-1])


@lru_cache(maxsize=64)
def _even(span: float, samples: int, per_sample: int) -> Steps:
    """Return steps on the even grid alone; a controller's ticks ask for the same ones again and again."""
    count = samples * per_sample
    ends = span / count * np.arange(1, count + 1)
    return Steps(ends, np.arange(per_sample, count + 1, per_sample))


PARTS = 64
"""Into how many parts a step may be cut at most, a power of 2."""

_FAR = 4.0  # times the tolerance: beyond it, halves would be cut again
_NEAR = 0.5  # times the tolerance: below it, parts twice as long are tried


@compiled
def _cubic(at, span, q0, q1, r0, r1, q, r):  # type: ignore[no-untyped-def]
    """Fill bends and rates at the share `at` of an interval (s) from those at its ends."""
    rest = 1 - at
    rise, begins, ends = at * at * (3 - 2 * at), at * rest * rest * span, at * at * rest * span
    rising, beginning, ending = 6 * at * rest / span, rest * (1 - 3 * at), at * (3 * at - 2)
    for j in range(q.shape[0]):
        way = q1[j] - q0[j]
        q[j] = q0[j] + rise * way + begins * r0[j] - ends * r1[j]
        r[j] = rising * way + beginning * r0[j] + ending * r1[j]


@compiled
def bend_within(at, h, bends, rates, q, r):  # type: ignore[no-untyped-def]
    """Fill bends and rates at the share `at` of a step from those at its start, first stage and end."""
    if at < GAMMA:
        _cubic(at / GAMMA, GAMMA * h, bends[0], bends[1], rates[0], rates[1], q, r)
    else:
        _cubic((at - GAMMA) / (1 - GAMMA), (1 - GAMMA) * h, bends[1], bends[2], rates[1], rates[2], q, r)


@compiled
def _unevenness(h, k0, k1, k2, weight, arm):  # type: ignore[no-untyped-def]
    """Return η (m/s) of a step, see above."""
    x = k1[STATE_VX] - (1 - GAMMA) * k0[STATE_VX] - GAMMA * k2[STATE_VX]
    y = k1[STATE_VY] - (1 - GAMMA) * k0[STATE_VY] - GAMMA * k2[STATE_VY]
    turning = (k1[MOMENT] - (1 - GAMMA) * k0[MOMENT] - GAMMA * k2[MOMENT]) / (weight * arm)
    return h * math.sqrt(x * x + y * y + turning * turning)


@compiled
def advance(now, steps, trace, marks, model, tolerance, seen):  # type: ignore[no-untyped-def]
    """Advance a body in place over the given steps.

    Args:
        now: state by the indices in `kernels` and its rates, shape (STATES,) each, velocity in the body frame
            and yaw rate, shape (3,); the latter two are kept from call to call, as first guess.
        steps: step lengths, shape (steps,), s.
        trace: what the chambers do at the start and at each step's two stages, 1 + 2 steps rows.
        marks: numbers of steps after which to look, ascending, shape (samples,).
        model: a `kinematics.Solid`, a `floor.FloorFriction`, and whether the friction's moment about the
            centre of mass acts.
        tolerance: of η, m/s.
        seen: out, states and velocities at the marks, shapes (samples, STATES) and (samples, 3).

    Returns:
        How many steps were made, fewer if one failed, and in how many parts, those made anew included.
    """
    (state, slope, u), (states, velocities) = now, seen
    solid, bends, rates = model[0], trace.bend, trace.bend_rate
    n = solid.mass.shape[0]
    body = np.empty((ROWS, n))
    weight = solid.mass.sum()
    arm = (solid.length + solid.gap) * math.sqrt((n * n - 1) / 12)
    k1, k2, after = np.empty(STATES), np.empty(STATES), np.empty(STATES)
    drift, guess, pace = np.zeros(3), np.empty(3), np.empty(3)
    own_bends, own_rates = np.empty((2, n - 1)), np.empty((2, n - 1))
    mark = parts = 0
    for i in range(steps.shape[0]):
        given_bends, given_rates = bends[2 * i : 2 * i + 3], rates[2 * i : 2 * i + 3]
        done, size = 0, PARTS
        while done < PARTS:
            h = steps[i] * size / PARTS
            copy(u, guess)
            copy(drift, pace)
            if size == PARTS:
                stage_bends, stage_rates = given_bends[1:], given_rates[1:]
            else:
                for k, share in ((0, GAMMA), (1, 1.0)):
                    at = (done + share * size) / PARTS
                    bend_within(at, steps[i], given_bends, given_rates, own_bends[k], own_rates[k])
                stage_bends, stage_rates = own_bends, own_rates
            solved = step(state, h, stage_bends, stage_rates, model, guess, pace, k1, k2, after, body)
            parts += 1
            eta = _unevenness(h, slope, k1, k2, weight, arm)
            if size > 1 and not (solved and eta < tolerance):
                size = max(size // (2 if eta < _FAR * tolerance else 4), 1)
                continue
            # Not a number fails every comparison.
            if not (solved and abs(after[STATE_VX]) < SPEED_LIMIT and abs(after[STATE_VY]) < SPEED_LIMIT):
                return i, parts
            copy(after, state)
            copy(k2, slope)
            copy(guess, u)
            copy(pace, drift)
            done += size
            if size < PARTS and eta < _NEAR * tolerance and done % (2 * size) == 0:
                size *= 2
        while mark < marks.shape[0] and marks[mark] == i + 1:
            copy(state, states[mark])
            copy(u, velocities[mark])
            mark += 1
    return steps.shape[0], parts


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


class Body(ABC):
    """The mechanics of an analytical model, driven by what the chambers do.

    Attributes:
        state: pose, velocity, moment of momentum and more by the indices in `kernels`.
        velocity: what `Motion.velocities` holds, now.
        solid: for the kernels.
        floor: for the kernels.
    """

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

    def __init__(self, solid: Solid, floor: FloorFriction) -> None:
        # In the air: the floor of the others takes no part.
        super().__init__(solid, floor._replace(mu_t=0.0, mu_n=0.0))

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`; the head stays where it is then."""
        super().reset(pose)
        mass = self.solid.mass
        pitch = self.solid.length + self.solid.gap
        ahead = pitch * float(np.arange(len(mass)) @ mass) / float(mass.sum())
        x, y, heading = pose
        self._head = np.array([x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading])

    def move(self, steps: np.ndarray, trace: Trace, marks: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`; `look` finds out where the chain is."""
        return len(steps), *self._seen(marks)

    def look(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """See `Body.look`; where the chain is follows from its bends alone."""
        torque = np.empty_like(trace.bend)
        hang(trace, self.solid, self._head, states, velocities, torque)
        return Motion(states, velocities, trace.bend, trace.bend_rate, torque)


@compiled
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
    stretch = 10.0

    def __init__(
        self,
        spec: RobotSpec,
        *,
        model: str = "complete",
        friction: str = "axis",
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
    ) -> None:
        """Build the model.

        Args:
            spec: the robot.
            model: "complete" (bends as given), "simplified" (chords frozen at l + L_o besides) or
                "compliant" (bends that load and inertia deflect).
            friction: "axis" (one point a connector, the text's law), "wheel" (two wheels at the track),
                "ellipse" (two skids there) or "viscous" (a law to test with).
            friction_torque: whether friction's moment about the centre of mass acts; False is the text's
                first model, `simplified` only.
            inertia: of each connector about itself: "point" none, "connector" that of a compact body with
                two wheels, as the twin has it, "lumped" the text's j(i) = Σ m L²/3, which counts the
                segments' masses twice (E19).
            supply_pa: supply pressure, Pa; default the robot's nominal one.
            tick: control tick, s.
            timestep: longest step, s.
            tolerance: of what a step may misjudge while friction turns, as a velocity, m/s; where bends are
                given, steps are cut until they keep it, see `step_control`.
            slip_speed: ε of the friction law, m/s.
            layout: valve layout, "3/2" or "in_out".
            pneumatics: "lag", "orifice", or chambers of one's own.
            track: where the two contacts of a connector stand, m; default the robot's half track for a law
                that acts at the wheels and 0, one contact, for the others.
            base: "free", or "clamped": held at the head, in the air (not with "compliant").
            sensor: of the bends, "ideal", "hall" with its defaults, or one of one's own.

        Raises:
            InputError: an unknown model, law, inertia or layout, a tick, time step or tolerance that is not
                above 0, or no friction torque with another model.
        """
        one_of("model", model, MODELS)
        one_of("friction law", friction, LAWS)
        one_of("inertia", inertia, INERTIAS)
        one_of("base", base, BASES)
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
            track = spec.geometry.half_track if friction in AT_TRACK else 0.0
        mu = spec.friction
        self._tolerance = tolerance
        self._floor = floor_friction(friction, track, mu.mu_t, mu.mu_n, slip_speed)
        self._body = self._make_body()
        self.reset()

    def reset(self, *, pose: Pose = (0.0, 0.0, 0.0), seed: int = 0) -> SnakeState:
        """Lay the snake straight, at rest, chambers empty. `seed` is the sensors' noise's."""
        self.pneumatics.reset()
        self._ticks, self._seed = 0, seed
        self._body.reset(pose)
        body, trace = self._body, self.pneumatics.resting()
        now = body.look(body.state[None].copy(), body.velocity[None].copy(), trace)
        resting = self._observe(np.zeros(1), now, trace)
        return resting.at(0)

    def _follow(self, schedule: Schedule, ticks: int, samples: int) -> SnakeState:
        """Follow a schedule of possible valve states over so many ticks."""
        begun = self._ticks * self.tick
        check_before(self.name, begun + self.timestep, self._body.state, self._body.velocity)
        steps = self._steps(self.pneumatics.effective(schedule), samples)
        done, motion, trace = self._drive(schedule, steps)
        times = begun + schedule.span * np.arange(1, samples + 1) / samples
        history = self._observe(times[: len(motion.states)], motion, trace)
        if done < len(steps.ends):
            raise DivergedError(
                self.name,
                begun + steps.ends[done],
                f"step {done + 1} of {len(steps.ends)} found no plausible solution, state "
                f"{', '.join(f'{value:.4g}' for value in self._body.state)}",
                history=history,
            )
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
        return done, joined(motions), joined(traces)

    def _turns(self, schedule: Schedule, steps: Steps) -> Iterator[tuple[Schedule, Steps]]:
        if not self._chambers_feel:
            yield schedule, steps
            return
        for begin, end, piece in steps.pieces(self._turn):
            yield schedule.part(begin, end), piece

    def describe(self) -> dict[str, Any]:
        """Return the settings worth recording."""
        return super().describe() | {
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
        kernels.observe(motion, self._body.solid, self._floor, position, theta, force, energy)
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
            sensed=self.sensor.read(motion.bend, time, self._seed),
            contact_force=force,
            obstacle_force=np.zeros_like(force),
            torque=motion.torque,
            work=energy + motion.states[:, kernels.SPENT],
            air=trace.air,
            qpos=np.empty((count, 0)),
        )
