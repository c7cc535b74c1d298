"""Steering of a robot based on the state estimate of its live twin."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.live.commands import DELAY_S
from srs_twin.live.estimate import Estimate
from srs_twin.live.fault_hypotheses import CHAMBERS, ChamberBehaviour
from srs_twin.live.messages import GO, PAUSE, VENT
from srs_twin.live.shadow import Shadow
from srs_twin.planning.camera import Camera
from srs_twin.planning.follower import Follower
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Pose
from srs_twin.scenario.scenario import Scenario

PATIENCE_S = 3.0
"""Time without an estimate or without supply pressure after which the steering ends, s.
"""
PAUSE_LIMIT_S = 30.0
"""Maximum duration of a pause, s.

After this time the chambers are vented, so that a forgotten robot does not remain
pressurised.
"""
# Reasons for the end of the steering, in addition to the follower's reasons.
LOST = "estimate_lost"
EMPTY = "supply_empty"
STOPPED = "stopped"  # The session ended before the end of the path.
TOO_SLOW = "estimate_too_old"
LEAST_MARGIN = 0.25
"""Minimum margin of a new plan, as a fraction of the scenario's margin.

If there is no plan with this margin, the robot is stopped. The value is based on 100
simulated runs of 3.5 m for each shipped footprint. Without a margin, 98 to 100 % of the
runs leave the planned footprint, so contact is almost certain. With a quarter of an 80
mm margin, 52 to 93 % leave it, and with half of that margin, 1 to 19 %.
"""
_LARGEST_SD_M = 0.0125
"""Maximum standard deviation of the position for steering, m.

The value is half the usual margin to obstacles.
"""
_UNCERTAIN_S = 0.2
"""Time with too large a standard deviation after which the robot is vented, s.

A late frame of motion capture increases the standard deviation for some ticks.
Generation 2 crawls 45 mm during this time.
"""
_SETTLING_S = 1.0
"""Initial time in which the robot rests and its pose is estimated, s."""
_NEAR_M = 0.03
"""Distance from the scenario's initial position above which a new path is planned, m.
"""
_NEAR_RAD = 0.05
"""Deviation from the scenario's initial heading above which a new path is planned, rad.
"""
_EMPTY_BELOW = 0.3
"""Fraction of the nominal supply pressure below which the robot cannot be steered.

Half of the nominal pressure is sufficient.
"""
_MODEL_FIELDS = {("actuator", "bend_limit"), ("supply", "limit_source")}
"""Model settings and texts that may differ between the robot of the scenario and the
real robot.
"""


def differences(one: RobotSpec, other: RobotSpec) -> list[str]:
    """Return the fields in which two robots differ, with the values of each robot.

    Names, titles and model settings such as the bend limit are not compared. Properties
    of individual modules are not compared either, because the live twin estimates them.
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
        # The parameters are compared individually, so that the message can name them.
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

    If a valve is stuck, the segment is kept straight by filling or venting both
    chambers, and a new path is planned. All chambers are vented while the position is
    unknown. After a loss of supply pressure, the steering ends and all chambers are
    vented.
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
            allow_zero_margin: whether the robot continues without any margin to
                obstacles. Otherwise the robot stops if the margin is below
                `LEAST_MARGIN`.

        Raises:
            InputError: the scenario has no planned path, or is intended for another
                robot.
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

        `PAUSE` keeps the valve states unchanged, `VENT` vents all chambers, and `GO`
        continues the steering.
        """
        if word != self._control:
            self._control = word
            self._paused_s = 0.0
            self._log(f"control: {word}")

    def step(self, estimate: Estimate | None, shadow: Shadow) -> np.ndarray:
        """Return the command of one tick, shape (segments, 2).

        The command contains valve states or duties.
        """
        self._last = self._command(estimate, shadow)
        return self._last

    def give_up(self, ending: str) -> None:
        """End the steering for the given reason."""
        if not self._given_up:
            self._given_up = ending
            self._log(ending)

    def summary(self) -> dict[str, object]:
        """Return the reason for the end, the duration and the events as JSON values."""
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
        stuck = np.where(
            (chambers == ChamberBehaviour.FILLS).any(axis=1), ChamberBehaviour.FILLS, 0
        )
        stuck = np.where(
            (chambers == ChamberBehaviour.VENTS).any(axis=1),
            ChamberBehaviour.VENTS,
            stuck,
        )
        if (stuck != self._stuck).any():
            self._stuck = stuck
            self.follower.request_replan("fault")
        state = estimate.state(self._steps * self._tick, self._pressure)
        valves = self.follower.step(state)
        self._steps += 1
        for event in self.follower.events():
            self._events.append((event.time, f"{event.kind}: {event.text}"))
        # The robot itself modulates the valves, so the command contains duties instead
        # of valve states within a tick.
        if valves.ndim == 3:
            valves = valves.mean(axis=0)
        duty = valves / 2 + 0.5
        # Equal pressures in the + and − chambers keep a segment with a stuck valve
        # straight.
        duty[stuck == ChamberBehaviour.FILLS] = 1.0
        duty[stuck == ChamberBehaviour.VENTS] = 0.0
        if np.isin(duty, (0.0, 1.0)).all():
            return 2 * duty - 1
        return duty

    def _begin(self, estimate: Estimate, shadow: Shadow) -> None:
        # The follower must not simulate noise and delays, because the noise and delays
        # of the real robot already affect the estimate. Commands take effect one tick
        # after the estimate.
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
