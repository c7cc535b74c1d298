"""Steering of a robot with the state estimate of its live twin."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.live.commands import DELAY_S
from srs_twin.live.estimate import Estimate
from srs_twin.live.fault_hypotheses import CHAMBERS, ChamberBehaviour, valve_duty
from srs_twin.live.messages import GO, PAUSE, VENT
from srs_twin.live.shadow import Shadow
from srs_twin.planning.camera import Camera
from srs_twin.planning.follower import Follower
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Pose
from srs_twin.scenario.scenario import Scenario

PATIENCE_S = 3.0
"""Time without a valid estimate or supply pressure after which the steering ends, s."""
PAUSE_LIMIT_S = 30.0
"""Maximum duration of a pause, s.

After a longer pause, the chambers are vented, so that a forgotten robot does not remain
pressurised.
"""
# Reasons for ending the steering. The path follower has further reasons of its own.
LOST = "estimate_lost"
EMPTY = "supply_empty"
STOPPED = "stopped"  # The session ended before the end of the path.
TOO_SLOW = "estimate_too_old"
LEAST_MARGIN = 0.25
"""Minimum margin of a new plan, as a fraction of the scenario's margin.

The robot is stopped if no plan has this margin. The value is based on 100 simulated
runs of 3.5 m for each shipped footprint. Without a margin, 98 to 100 % of the runs
leave the planned footprint, so contact is almost certain. With a
quarter of an 80 mm margin, 52 to 93 % of the runs leave the footprint. With half of an
80 mm margin, 1 to 19 % of the runs leave the footprint.
"""
_LARGEST_SD_M = 0.0125
"""Standard deviation of the position above which the robot is not steered, m."""
_UNCERTAIN_S = 0.2
"""Time with a position uncertainty above `_LARGEST_SD_M` before the robot vents, s.

The robot does not vent immediately, because a late motion capture frame increases the
standard deviation for some ticks. Generation 2 crawls 45 mm during this time.
"""
_SETTLING_S = 1.0
"""Time for which the robot rests at the start while its pose is estimated, s."""
_NEAR_M = 0.03
"""Distance from the scenario's initial position above which a new path is planned, m.
"""
_NEAR_RAD = 0.05
"""Deviation from the scenario's initial heading above which a new path is planned, rad.
"""
_EMPTY_BELOW = 0.3
"""Fraction of the nominal supply pressure below which the robot is not steered.

Steering is still possible at half of the nominal pressure.
"""
_MODEL_FIELDS = {("actuator", "bend_limit"), ("supply", "limit_source")}
"""Fields that may differ between the scenario's robot and the real robot."""


def differences(one: RobotSpec, other: RobotSpec) -> list[str]:
    """Describe the fields in which two robot specifications differ.

    Names, titles and model settings such as the bend limit are not compared. The
    properties of individual modules are ignored as well, because the live twin
    estimates them.
    """
    texts = []
    for field in fields(RobotSpec):
        first = getattr(one, field.name)
        second = getattr(other, field.name)
        if field.name in ("name", "title", "variation") or first == second:
            continue
        if not (is_dataclass(first) and type(first) is type(second)):
            texts.append(f"{field.name} ({_short(first)} and {_short(second)})")
            continue
        for inner in fields(first):
            name = inner.name
            a = getattr(first, name)
            b = getattr(second, name)
            if a != b and (field.name, name) not in _MODEL_FIELDS:
                texts.append(f"{field.name}.{name} ({_short(a)} and {_short(b)})")
    return texts


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)


class EstimateSteering:
    """Path follower that uses the state estimate of a live twin.

    If a valve is stuck, its segment is kept straight by filling or venting both
    chambers, and a new path is planned. All chambers are vented while the position is
    unknown. The steering ends after a loss of supply pressure.
    """

    def __init__(
        self,
        scenario: Scenario,
        shadow: Shadow,
        tick: float,
        *,
        allow_zero_margin: bool = False,
    ) -> None:
        """Prepare the path follower.

        Args:
            scenario: scenario whose controller follows a planned path.
            shadow: live twin of the robot.
            tick: control period of the robot, s.
            allow_zero_margin: whether the robot may continue without a margin to
                obstacles. Otherwise, new plans need the margin given by `LEAST_MARGIN`.

        Raises:
            InputError: the scenario has no planned path or belongs to another robot.
        """
        controller = scenario.build_controller()
        if not isinstance(controller, Follower):
            raise InputError(
                f"{scenario.name}: the scenario follows no planned path; --follow"
                " needs a scenario with `controller.kind: follow`"
            )
        if differ := differences(scenario.robot, shadow.spec):
            listed = ", ".join(differ[:3])
            if len(differ) > 3:
                listed += f" and {len(differ) - 3} more"
            raise InputError(
                f"{scenario.name} is for robot '{scenario.robot.name}', not for"
                f" '{shadow.spec.name}'; the robots differ in {listed}"
            )
        controller.min_margin_fraction = 0.0 if allow_zero_margin else LEAST_MARGIN
        self.follower = controller
        self._start = Pose(*scenario.pose)
        self._tick = tick
        self._seed = scenario.seed
        self._stuck = np.zeros(shadow.spec.segments, dtype=int)
        self._steps = 0
        self._waited = 0
        self._lost_s = 0.0
        self._uncertain_s = 0.0
        self._empty_s = 0.0
        self._paused_s = 0.0
        self._given_up = ""
        self._control = GO
        self._events: list[tuple[float, str]] = []
        self._pressure = np.zeros((shadow.spec.segments, 2))
        self._last = self.vented()

    @property
    def finished(self) -> bool:
        """Whether the steering has ended."""
        return bool(self._given_up) or self.follower.finished

    @property
    def begun(self) -> bool:
        """Whether the steering has begun."""
        return self._steps > 0

    def vented(self) -> np.ndarray:
        """Return the command that vents all chambers."""
        return np.full(self._pressure.shape, -1.0)

    def control(self, word: str) -> None:
        """Obey a control word.

        `PAUSE` repeats the last command, `VENT` vents all chambers, and `GO` continues
        the steering.
        """
        if word != self._control:
            self._control = word
            self._paused_s = 0.0
            self._log(f"control: {word}")

    def step(self, estimate: Estimate | None, shadow: Shadow) -> np.ndarray:
        """Return the valve states or duties for one tick, shape (segments, 2)."""
        self._last = self._command(estimate, shadow)
        return self._last

    def give_up(self, ending: str) -> None:
        """End the steering for a given reason."""
        if not self._given_up:
            self._given_up = ending
            self._log(ending)

    def summary(self) -> dict[str, object]:
        """Return the ending, duration and events of the steering as JSON values."""
        return {
            "ending": self._given_up or self.follower.ending or STOPPED,
            "seconds": self._steps * self._tick,
            "events": [{"time_s": time, "event": text} for time, text in self._events],
        }

    def _log(self, text: str) -> None:
        self._events.append((self._steps * self._tick, text))

    def _command(self, estimate: Estimate | None, shadow: Shadow) -> np.ndarray:
        if estimate is None or estimate.lost or self._is_uncertain(estimate):
            self._lost_s += self._tick
            # Before the first step, the robot may wait indefinitely for motion capture.
            if self._steps and self._lost_s > PATIENCE_S:
                self.give_up(LOST)
            return self.vented()
        self._lost_s = 0.0
        if self._control == PAUSE:
            self._paused_s += self._tick
            if self._paused_s <= PAUSE_LIMIT_S:
                return self._last
            self.control(VENT)
        if self._control == VENT:
            return self.vented()
        return self._steer(estimate, shadow)

    def _is_uncertain(self, estimate: Estimate) -> bool:
        if np.hypot(*estimate.pose_sd[:2]) <= _LARGEST_SD_M:
            self._uncertain_s = 0.0
            return False
        self._uncertain_s += self._tick
        return not self._steps or self._uncertain_s > _UNCERTAIN_S

    def _steer(self, estimate: Estimate, shadow: Shadow) -> np.ndarray:
        self._waited += 1
        if self._waited * self._tick < _SETTLING_S:
            return self.vented()
        if not self._steps:
            self._begin(estimate, shadow)
        self._empty_s += self._tick
        if shadow.faults.supply.fraction >= _EMPTY_BELOW:
            self._empty_s = 0.0
        if self._empty_s > PATIENCE_S:
            self.give_up(EMPTY)
            return self.vented()
        # Only stuck valves change the gait, because segments with a leak still bend.
        chambers = CHAMBERS[shadow.faults.most_likely()]
        is_stuck = np.isin(chambers, (ChamberBehaviour.FILLS, ChamberBehaviour.VENTS))
        stuck = np.where(is_stuck, chambers, ChamberBehaviour.OBEYS).max(axis=1)
        if (stuck != self._stuck).any():
            self._stuck = stuck
            self.follower.request_replan("fault")
        state = estimate.state(self._steps * self._tick, self._pressure)
        valves = self.follower.step(state)
        self._steps += 1
        for event in self.follower.events():
            self._events.append((event.time, f"{event.kind}: {event.text}"))
        # The robot modulates its valves itself, so the command contains one duty per
        # valve instead of several valve states per tick.
        if valves.ndim == 3:
            valves = valves.mean(axis=0)
        duty = valve_duty(valves / 2 + 0.5, stuck[:, None])
        if np.isin(duty, (0.0, 1.0)).all():
            return 2 * duty - 1
        return duty

    def _begin(self, estimate: Estimate, shadow: Shadow) -> None:
        # The follower simulates no noise and no command delay, because the real noise
        # and delays already affect the estimate. A command takes effect one tick plus
        # `DELAY_S` after the estimate.
        follower = self.follower
        follower.conditions = replace(
            follower.conditions,
            camera=Camera(follower.conditions.camera.rate_hz),
            delay=0.0,
            lag=DELAY_S + self._tick,
        )
        follower.reset(shadow.spec, self._tick, seed=self._seed)
        x, y, heading = estimate.pose
        distance = math.hypot(x - self._start.x, y - self._start.y)
        turn = math.remainder(heading - self._start.heading, 2 * math.pi)
        if distance > _NEAR_M or abs(turn) > _NEAR_RAD:
            follower.request_replan("start")
