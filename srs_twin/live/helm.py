"""Helm: a follower that steers a robot on the air by its shadow's estimate."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from srs_twin.control.camera import Camera
from srs_twin.errors import InputError
from srs_twin.live.faults import FILLS, HYPOTHESES, VENTS
from srs_twin.live.messages import GO, VENT
from srs_twin.live.shadow import DELAY_S, Estimate, Shadow
from srs_twin.planning.follower import Follower
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Pose
from srs_twin.scenario.scenario import Scenario

PATIENCE_S = 3.0
"""For so long a lost robot lies vented before it is given up, and one without air is steered."""
LOST, EMPTY, STOPPED, TOO_SLOW = "estimate_lost", "supply_empty", "stopped", "estimate_too_old"
"""Endings in addition to those of the follower; `STOPPED`: the session ended first."""
_LARGEST_SD_M = 0.0125
"""Whoever steers must know this well where the robot is: half of the usual margin to obstacles."""
_SETTLES_S = 1.0
"""A robot stands so long, so that its shadow knows where."""
_NEAR_M, _NEAR_RAD = 0.03, 0.05
_STUCK = {FILLS, VENTS}
LEAST_MARGIN = 0.25
"""Share of the plan's margin that a new plan needs at least; without such a plan the robot is stopped.

Of the runs that the shipped footprints' margins were measured with (`planning/margins.py`; 100 of each kind,
3.5 m each), 98 to 100 % left a plan without any margin: where something is that near, touching is all but
certain. 1 to 19 % left half of a margin of 80 mm, 52 to 93 % a quarter of it at some time.
"""
_FAINT = 0.3
"""Share of the supply's pressure below which nobody can steer; half of it is enough."""


_OF_MODELS = {("actuator", "bend_limit"), ("supply", "limit_source")}
"""Fields that scenarios set for their models, and texts: robots may differ in them."""


def differences(one: RobotSpec, other: RobotSpec) -> list[str]:
    """Return the fields in which two robots differ, with both values.

    Names, titles and the modules' own values, which a shadow learns, do not count, nor does the limit of
    bends: scenarios set it for the models.
    """
    found = []
    for each in fields(RobotSpec):
        first, second = getattr(one, each.name), getattr(other, each.name)
        if each.name in ("name", "title", "variation") or first == second:
            continue
        if not (is_dataclass(first) and type(first) is type(second)):
            found.append(f"{each.name} ({_short(first)} and {_short(second)})")
            continue
        for part in (inner.name for inner in fields(first)):
            a, b = getattr(first, part), getattr(second, part)
            if a != b and (each.name, part) not in _OF_MODELS:
                found.append(f"{each.name}.{part} ({_short(a)} and {_short(b)})")
    return found


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class Helm:
    """Steers by estimates: the scenario's follower, told what the shadow knows.

    A segment whose valve is stuck is kept straight, both chambers filled or both vented, and the way is
    planned anew. A robot whose estimate is lost is vented at once, one whose supply is all but empty soon.

    Attributes:
        follower: the scenario's.
    """

    def __init__(self, scenario: Scenario, shadow: Shadow, tick: float, *, press_on: bool = False) -> None:
        """Prepare to follow.

        Args:
            scenario: with a controller that follows a plan.
            shadow: of the robot to steer.
            tick: s.
            press_on: go on without any margin as well, instead of stopping (`LEAST_MARGIN`).

        Raises:
            InputError: the scenario follows no plan, or is for another robot.
        """
        controller = scenario.build_controller()
        if not isinstance(controller, Follower):
            raise InputError(
                f"{scenario.name}: it follows no plan; --follow takes a scenario with controller.kind: follow"
            )
        if differ := differences(scenario.robot, shadow.spec):
            more = f" and {len(differ) - 3} more" if len(differ) > 3 else ""
            raise InputError(
                f"{scenario.name} is for robot '{scenario.robot.name}', not for '{shadow.spec.name}'; "
                f"they differ in {', '.join(differ[:3])}{more}"
            )
        controller.least_margin = 0.0 if press_on else LEAST_MARGIN
        self.follower, self._start, self._tick = controller, Pose(*scenario.pose), tick
        self._seed = scenario.seed
        self._stuck: tuple[set[int], ...] = (set(),) * shadow.spec.segments
        self._steps = self._waited = 0
        self._lost_for, self._faint_for, self._given_up = 0.0, 0.0, ""
        self._events: list[tuple[float, str]] = []
        self._pressure = np.zeros((shadow.spec.segments, 2))
        self._held, self._last = "", self.vented()

    @property
    def finished(self) -> bool:
        """Whether the way has ended."""
        return bool(self._given_up) or self.follower.finished

    @property
    def begun(self) -> bool:
        """Whether the robot has been steered."""
        return self._steps > 0

    def vented(self) -> np.ndarray:
        """Return the command that vents everything."""
        return np.full(self._pressure.shape, -1.0)

    def hold(self, word: str) -> None:
        """Obey a control word: `PAUSE` keeps the valves as they are, `VENT` vents all, `GO` goes on."""
        held = "" if word == GO else word
        if held == self._held:
            return
        self._held = held
        self._events.append((self._steps * self._tick, f"control: {word}"))

    def step(self, found: Estimate | None, shadow: Shadow) -> np.ndarray:
        """Return the command of a tick: states of valves, or duties, shape (segments, 2)."""
        self._last = self._step(found, shadow)
        return self._last

    def _step(self, found: Estimate | None, shadow: Shadow) -> np.ndarray:
        if found is None or found.lost or np.hypot(*found.pose_sd[:2]) > _LARGEST_SD_M:
            self._lost_for += self._tick
            if self._steps and self._lost_for > PATIENCE_S:
                self.give_up(LOST)
            return self.vented()
        self._lost_for = 0.0
        if self._held:
            return self.vented() if self._held == VENT else self._last
        return self._steer(found, shadow)

    def _steer(self, found: Estimate, shadow: Shadow) -> np.ndarray:
        self._waited += 1
        if self._waited * self._tick < _SETTLES_S:
            return self.vented()
        if not self._steps:
            self._begin(found, shadow)
        likely = [HYPOTHESES[m] for m in shadow.bank.likely()]
        faint = np.median([each.weak for each in likely]) < _FAINT
        self._faint_for = self._faint_for + self._tick if faint else 0.0
        if self._faint_for > PATIENCE_S:
            self.give_up(EMPTY)
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
            "ending": self._given_up or self.follower.ending or STOPPED, "seconds": self._steps * self._tick,
            "events": [{"time_s": time, "event": text} for time, text in self._events],
        }  # fmt: skip

    def give_up(self, why: str) -> None:
        """End the steering for a reason, which becomes its ending."""
        if not self._given_up:
            self._given_up = why
            self._events.append((self._steps * self._tick, why))

    def _begin(self, found: Estimate, shadow: Shadow) -> None:
        """Prepare the follower; plan anew where the robot does not lie where the scenario begins."""
        # Noise and delays are the robot's own here: estimates wait for messages, a robot for its next tick.
        follower, lag = self.follower, shadow.inbox.hold + DELAY_S + self._tick
        seen = Camera(follower.conditions.camera.rate_hz)
        follower.conditions = replace(follower.conditions, camera=seen, delay=0.0, lag=lag)
        follower.reset(shadow.spec, self._tick, seed=self._seed)
        x, y, heading = found.pose
        off = np.hypot(x - self._start.x, y - self._start.y), abs(heading - self._start.heading)
        if off[0] > _NEAR_M or off[1] > _NEAR_RAD:
            self.follower.renew("start")
