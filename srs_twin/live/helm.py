"""Helm: a follower that steers a robot on the air by its shadow's estimate."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from srs_twin.control.camera import Camera
from srs_twin.control.following import Follower
from srs_twin.errors import InputError
from srs_twin.live.faults import FILLS, HYPOTHESES, VENTS
from srs_twin.live.shadow import DELAY_S, Estimate, Shadow
from srs_twin.scenario import Scenario
from srs_twin.world import Pose

PATIENCE_S = 3.0
"""For so long a lost robot lies vented before it is given up, and one without air is steered."""
LOST, EMPTY = "estimate_lost", "supply_empty"
_LARGEST_SD_M = 0.0125
"""Whoever steers must know this well where the robot is: half of the usual margin to obstacles."""
_SETTLES_S = 1.0
"""A robot stands so long, so that its shadow knows where."""
_NEAR_M, _NEAR_RAD = 0.03, 0.05
_STUCK = {FILLS, VENTS}
_FAINT = 0.3
"""Share of the supply's pressure below which nobody can steer; half of it is enough."""


class Helm:
    """Steers by estimates: the scenario's follower, told what the shadow knows.

    A segment whose valve is stuck is kept straight, both chambers filled or both vented, and the way is
    planned anew. A robot whose estimate is lost is vented at once, one whose supply is all but empty soon.

    Attributes:
        follower: the scenario's.
    """

    def __init__(self, scenario: Scenario, shadow: Shadow, tick: float) -> None:
        """Prepare to follow.

        Args:
            scenario: with a controller that follows a plan.
            shadow: of the robot to steer.
            tick: s.

        Raises:
            InputError: a scenario that does not follow, or one of another robot.
        """
        controller = scenario.build_controller()
        if not isinstance(controller, Follower):
            raise InputError(
                f"{scenario.name}: it follows no plan; --follow takes a scenario with controller.kind: follow"
            )
        if scenario.robot.segments != shadow.spec.segments:
            raise InputError(
                f"{scenario.name} has {scenario.robot.segments} segments, the robot {shadow.spec.segments}"
            )
        self.follower, self._start, self._tick = controller, Pose(*scenario.pose), tick
        self._seed = scenario.seed
        self._stuck: tuple[set[int], ...] = (set(),) * shadow.spec.segments
        self._steps = self._waited = 0
        self._lost_for, self._faint_for, self._given_up = 0.0, 0.0, ""
        self._events: list[tuple[float, str]] = []
        self._pressure = np.zeros((shadow.spec.segments, 2))

    @property
    def finished(self) -> bool:
        """Whether the way has ended."""
        return bool(self._given_up) or self.follower.finished

    def vented(self) -> np.ndarray:
        """Return the command that vents everything."""
        return np.full(self._pressure.shape, -1.0)

    def step(self, found: Estimate | None, shadow: Shadow) -> np.ndarray:
        """Return the command of a tick: states of valves, or duties, shape (segments, 2)."""
        if found is None or found.lost or np.hypot(*found.pose_sd[:2]) > _LARGEST_SD_M:
            self._lost_for += self._tick
            if self._steps and self._lost_for > PATIENCE_S:
                self._give_up(LOST)
            return self.vented()
        self._lost_for = 0.0
        self._waited += 1
        if self._waited * self._tick < _SETTLES_S:
            return self.vented()
        if not self._steps:
            self._begin(found, shadow)
        likely = [HYPOTHESES[m] for m in shadow.bank.likely()]
        faint = shadow.bank.supply.share < _FAINT
        self._faint_for = self._faint_for + self._tick if faint else 0.0
        if self._faint_for > PATIENCE_S:
            self._give_up(EMPTY)
            return self.vented()
        state = found.state(self._steps * self._tick, self._pressure)
        # A chamber that leaks still bends its segment.
        stuck = tuple(_STUCK & {each.plus, each.minus} for each in likely)
        if stuck != self._stuck:
            self._stuck = stuck
            self.follower.renew("fault")
        valves = self.follower.step(state)
        self._steps += 1
        self._events += [(event.time, f"{event.kind}: {event.text}") for event in self.follower.events()]
        opens = (valves.mean(axis=0) if valves.ndim == 3 else valves + 0.0) / 2 + 0.5
        for j, does in enumerate(stuck):
            if does:
                opens[j] = 1.0 if FILLS in does else 0.0
        return 2 * opens - 1 if np.isin(opens, (0.0, 1.0)).all() else opens

    def told(self) -> dict[str, Any]:
        """Return how it went, JSON values."""
        return {
            "ending": self._given_up or self.follower.ending, "seconds": self._steps * self._tick,
            "events": [{"time_s": time, "event": text} for time, text in self._events],
        }  # fmt: skip

    def _give_up(self, why: str) -> None:
        if not self._given_up:
            self._given_up = why
            self._events.append((self._steps * self._tick, why))

    def _begin(self, found: Estimate, shadow: Shadow) -> None:
        """Prepare the follower; plan anew where the robot does not lie where the scenario begins."""
        # Noise and delays are the robot's own here: estimates are of now, a robot waits for its next tick.
        follower, lag = self.follower, DELAY_S + self._tick
        seen = Camera(follower.conditions.camera.rate_hz)
        follower.conditions = replace(follower.conditions, camera=seen, delay=0.0, lag=lag)
        follower.reset(shadow.spec, self._tick, seed=self._seed)
        x, y, heading = found.pose
        off = np.hypot(x - self._start.x, y - self._start.y), abs(heading - self._start.heading)
        if off[0] > _NEAR_M or off[1] > _NEAR_RAD:
            self.follower.renew("start")
