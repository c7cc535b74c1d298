"""AnalyticalSnake: the dissertation's planar model, masses on constant-curvature segments."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from srs_twin.errors import DivergedError, InputError, one_of, whole_steps
from srs_twin.friction import AT_TRACK, LAWS
from srs_twin.plants import kernels, observation
from srs_twin.plants.base import BASES, Plant, Pose, SnakeState
from srs_twin.plants.clamped import ClampedBends
from srs_twin.plants.divergence import believed
from srs_twin.plants.floor import Floor
from srs_twin.plants.given import Body, GivenBends, Motion
from srs_twin.plants.kinematics import Solid
from srs_twin.plants.steps import Steps
from srs_twin.plausible import implausible
from srs_twin.pneumatics import Pneumatics, Schedule, Trace, make_pneumatics
from srs_twin.records import joined
from srs_twin.sensing import Sensor, make_sensor
from srs_twin.spec import RobotSpec

MODELS = ("complete", "simplified", "compliant")
INERTIAS = ("point", "connector", "lumped")
_MASSLESS_S = 0.0001  # at 0.25 ms pressures of point masses swing below ambient; half of this changes nothing


class AnalyticalSnake(Plant):
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
        for kind, given, known in (
            ("model", model, MODELS), ("friction law", friction, LAWS), ("inertia", inertia, INERTIAS),
            ("base", base, BASES),
        ):  # fmt: skip
            one_of(kind, given, known)
        if not friction_torque and model != "simplified":
            raise InputError(f"model '{model}' has a friction torque; only 'simplified' goes without")
        if base == "clamped" and model == "compliant":
            raise InputError("model 'compliant' is for a free snake; on a bench 'complete' and the twin run")
        for name, value, unit in (
            ("tick", tick, "s"), ("time step", timestep, "s"), ("tolerance", tolerance, "m/s"),
        ):  # fmt: skip
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"{name} {value!r} {unit} is not allowed; it must be finite and above 0")
        self.spec, self.tick, self.timestep, self.friction = spec, tick, timestep, friction
        self._model, self._inertia, self._turning = model, inertia, friction_torque
        self.base = base
        supply = spec.supply.nominal if supply_pa is None else supply_pa
        self.pneumatics = make_pneumatics(pneumatics, spec, supply_pa=supply, layout=layout)
        self.layout, self.sensor = self.pneumatics.layout, make_sensor(sensor, spec)
        self.metered = self.pneumatics.metered
        if track is None:
            track = spec.geometry.half_track if friction in AT_TRACK else 0.0
        mu = spec.friction
        self._tolerance = tolerance
        self._floor = Floor(LAWS.index(friction), track, mu.mu_t, mu.mu_n, slip_speed)
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

    def advance(self, valves: np.ndarray, samples: int) -> list[SnakeState]:
        """Advance one tick; see `Plant.advance`."""
        history = self._follow(self.pneumatics.schedule(valves, self.tick), 1, samples)
        return [history.at(k) for k in range(samples)]

    def play(self, schedule: Schedule, samples: int) -> SnakeState:
        """Follow a schedule; see `Plant.play`."""
        self.pneumatics.check(schedule.states)
        return self._follow(schedule, whole_steps("schedule", schedule.span, "tick", self.tick), samples)

    def _follow(self, schedule: Schedule, ticks: int, samples: int) -> SnakeState:
        """Follow a schedule of possible valve states over so many ticks."""
        wrong = implausible([*self._body.state, *self._body.velocity])
        if wrong is not None:
            what = f"its state held {wrong:g} before the step, which no snake reaches"
            raise DivergedError(self.name, self._ticks * self.tick + self.timestep, what)
        steps = self._steps(self.pneumatics.effective(schedule), samples)
        done, motion, trace = self._drive(schedule, steps)
        begun = self._ticks * self.tick
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
        return believed(self.name, history)

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

    def openings(self) -> np.ndarray:
        """Return how often each chamber's inlet has opened, shape (segments, 2)."""
        return self.pneumatics.openings

    def describe(self) -> dict[str, Any]:
        """Return the settings worth recording."""
        return super().describe() | {
            "model": self._model,
            "base": self.base,
            "friction": self.friction,
            "pneumatics": self.pneumatics.describe(),
            "layout": self.layout,
            "sensor": self.sensor.describe(),
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
        solid = Solid(
            self.spec.mass.array(), self._own_inertia(), g.segment_length, g.rigid_gap, frozen
        )  # fmt: skip
        if self.base == "clamped":
            return ClampedBends(solid, self._floor)
        if self._model != "compliant":
            return GivenBends(solid, self._floor, turning=self._turning, tolerance=self._tolerance)
        # Its kernels take a second to load: not before they are asked for.
        from srs_twin.plants.compliant import YieldingBends

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
        observation.observe(
            motion.states, motion.velocities, motion.bend, motion.bend_rate, self._body.solid, self._floor,
            position, theta, force, energy,
        )  # fmt: skip
        return SnakeState(
            time=time,
            com=motion.states[:, kernels.X : kernels.Y + 1],
            com_velocity=motion.states[:, kernels.VX : kernels.VY + 1],
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
