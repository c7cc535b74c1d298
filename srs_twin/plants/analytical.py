"""AnalyticalSnake: the dissertation's planar model, point masses on constant-curvature segments."""

from __future__ import annotations

from typing import Any

import numpy as np

from srs_twin.errors import DivergedError, InputError, whole_steps
from srs_twin.friction import LAWS
from srs_twin.plants import kernels
from srs_twin.plants.base import Plant, Pose, SnakeState
from srs_twin.plants.given import Body, GivenBends
from srs_twin.pneumatics import LagPneumatics, Trace, valve_runs
from srs_twin.spec import RobotSpec

MODELS = ("complete", "compliant")
_SPEED_LIMIT = 100.0  # m/s: beyond it the state is not plausible


class AnalyticalSnake(Plant):
    """The planar model: `complete`, whose bends follow Eq. 14, or `compliant`, whose bends yield.

    Attributes:
        timestep: longest step of the integrator, s; steps also end on valve events.
        friction: law of the floor, one of `friction.LAWS`.
    """

    name = "analytical"

    def __init__(
        self,
        spec: RobotSpec,
        *,
        model: str = "complete",
        friction: str = "axis",
        supply_pa: float | None = None,
        tick: float = 0.02,
        timestep: float = 0.001,
        slip_speed: float = 0.0005,
        layout: str = "3/2",
    ) -> None:
        """Build the model.

        Args:
            spec: the robot.
            model: "complete" (bends as given) or "compliant" (bends that load and inertia deflect).
            friction: "axis" (one point a connector, the text's law), "wheel" (two wheels at the track)
                or "viscous" (a law to test with).
            supply_pa: supply pressure, Pa; default the robot's nominal one.
            tick: control tick, s.
            timestep: s; the tick is a multiple of it.
            slip_speed: ε of the friction law, m/s.
            layout: valve layout, "3/2" or "in_out".

        Raises:
            InputError: an unknown model, law or layout, or a tick that is no multiple of the time step.
        """
        for kind, given, known in (("model", model, MODELS), ("friction law", friction, LAWS)):
            if given not in known:
                raise InputError(f"{kind} '{given}' is unknown; allowed: {', '.join(known)}")
        self.spec, self.tick, self.timestep, self.friction = spec, tick, timestep, friction
        self._model, self._slip = model, slip_speed
        whole_steps("tick", tick, "time step", timestep)
        supply = spec.supply.nominal if supply_pa is None else supply_pa
        self.pneumatics = LagPneumatics(spec, supply_pa=supply, layout=layout)
        self._mass = spec.mass.array()
        self._body = self._make_body()
        self.reset()

    def reset(self, *, pose: Pose = (0.0, 0.0, 0.0), seed: int = 0) -> SnakeState:
        """Lay the snake straight, at rest, chambers empty. Nothing is random here: `seed` is unused."""
        self.pneumatics.reset()
        self._ticks = 0
        self._body.reset(pose)
        return self._observe(0.0, self._resting_trace(), -1)

    def advance(self, valves: np.ndarray, samples: int) -> list[SnakeState]:
        """Advance one tick; see `Plant.advance`."""
        commands = self.pneumatics.slots(valves)
        per_sample = whole_steps("sample interval", self.tick / samples, "time step", self.timestep)
        ends = self._step_ends(commands, samples * per_sample)
        starts = np.append(0.0, ends[:-1])
        steps = ends - starts
        stages = np.stack([starts + kernels.GAMMA * steps, ends], axis=1)
        trace = self.pneumatics.advance(commands, self.tick, stages.ravel())
        begun = self._ticks * self.tick
        states, first = [], 0
        for k in range(1, samples + 1):
            at = self.tick * k / samples
            last = int(np.searchsorted(ends, at * (1 + 1e-12), side="right"))
            failed = self._body.move(steps[first:last], trace, slice(2 * first, 2 * last))
            self._check(begun + at, failed)
            states.append(self._observe(begun + at, trace, 2 * last - 1))
            first = last
        self._ticks += 1
        return states

    def openings(self) -> np.ndarray:
        """Return how often each chamber's inlet has opened, shape (segments, 2)."""
        return self.pneumatics.openings

    def describe(self) -> dict[str, Any]:
        """Return the settings worth recording."""
        return super().describe() | {
            "model": self._model,
            "friction": self.friction,
            "timestep_s": self.timestep,
            "slip_speed_m_s": self._slip,
        }

    def _make_body(self) -> Body:
        if self._model == "complete":
            return GivenBends(self._constants())
        # Its kernels take a second to load: not before they are asked for.
        from srs_twin.plants.compliant import YieldingBends

        return YieldingBends(self.spec, self._constants())

    @property
    def _state(self) -> np.ndarray:
        return self._body.state

    @property
    def _velocity(self) -> np.ndarray:
        return self._body.velocity

    def _constants(self) -> tuple[Any, ...]:
        """Return the kernels' arguments that describe body and floor."""
        g, mu = self.spec.geometry, self.spec.friction
        track = g.half_track if self.friction == "wheel" else 0.0
        law = LAWS.index(self.friction)
        return self._mass, g.segment_length, g.rigid_gap, law, track, mu.mu_t, mu.mu_n, self._slip

    def _step_ends(self, commands: np.ndarray, steps: int) -> np.ndarray:
        """Return where the integrator's steps end: an even grid and every valve event in between."""
        ends = self.tick * np.arange(1, steps + 1) / steps
        events = [start for start, _, _ in valve_runs(commands, self.tick)][1:]
        if not events:
            return ends
        ends = np.sort(np.concatenate([ends, events]))
        return ends[np.append(np.diff(ends) > 1e-9 * self.tick, True)]

    def _resting_trace(self) -> Trace:
        bend = self.pneumatics.bend[None]
        return Trace(self.pneumatics.pressure[None], bend, np.zeros_like(bend), self.pneumatics.valves[None])

    def _check(self, time: float, failed: int) -> None:
        speed = float(np.abs(self._state[kernels.VX : kernels.VY + 1]).max())
        if failed or not speed < _SPEED_LIMIT or not np.isfinite(self._state).all():
            raise DivergedError(
                self.name,
                time,
                f"speed {speed:.3g} m/s, {failed} steps without solution, state {self._state}",
            )

    def _observe(self, time: float, trace: Trace, row: int) -> SnakeState:
        bend, rate, g = trace.bend[row], trace.bend_rate[row], self.spec.geometry
        x, y, heading, vx, vy, _ = self._state
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, s], [-s, c]])  # row vectors: body → world
        body = np.empty((g.connectors, 6))
        kernels.pose_body(bend, rate, self._mass, g.segment_length, g.rigid_gap, body)
        force, total, slope = np.empty((g.connectors, 2)), np.empty(3), np.empty((3, 3))
        floor = self._constants()[3:]
        kernels.floor_forces(  # type: ignore[call-arg]  # numba's stub knows no signatures
            body, self._mass, self._velocity, *floor, force, total, slope
        )
        com = np.array([x, y])
        return SnakeState(
            time=time,
            com=com,
            com_velocity=np.array([vx, vy]),
            heading=float(heading),
            position=com + body[:, 2:4] @ turn,
            theta=heading + body[:, 0],
            bend=bend,
            bend_rate=rate,
            pressure=trace.pressure[row],
            valves=trace.valves[row],
            sensed=bend.copy(),
            contact_force=force @ turn,
            qpos=np.empty(0),
        )
