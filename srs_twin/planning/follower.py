"""Controller that steers a snake along a plan by changing the gait offset.

As in Section 5.2.2, a camera measures the pose of the snake, which is averaged over a
gait period. A `Predictor` extrapolates the mean pose, and a `Steering` law computes the
offset. After a command delay, the gait or the iterative learning controller receives
the offset. The run ends at the goal, or for another reason listed in `ENDINGS`.

If the snake deviates too far from its path or approaches an obstacle, the follower
requests a new plan. The new plan has the margin of the first plan or, if necessary, a
fraction of this margin.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import KW_ONLY, asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.errors import InputError
from srs_twin.planning.camera import Camera, CameraFrames, PeriodMean
from srs_twin.planning.collision import Checker
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.path import PathPoint, ReferencePath
from srs_twin.planning.problem import Plan
from srs_twin.planning.steering import Predictor, Steering, SteeringInput
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Goal, Pose, World
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState


ENDINGS = {
    "goal_reached": "the goal is reached",
    "goal_missed": "the snake passed the end of the path outside the goal",
    "no_plan": "there is no plan",
    "strayed": "too far from the path, and no new plan is left",
    "stuck": "no progress for several periods",
    "no_room": "no path with the required margin",
    "gait_ended": "the gait has ended",
}
"""Reasons for which a run ends, of which only `goal_reached` means success."""

STUCK_FRACTION = 0.1
"""Fraction of the footprint's minimum speed below which a snake is considered slow."""
STUCK_PERIODS = 6
"""Number of gait periods with slow motion after which a snake is considered stuck."""
RETRY_PERIODS = 2
"""Number of gait periods after a request in which deviations cause no new request."""
_MIN_CHANGE = 1e-3
"""Minimum change of the offset for which a new offset is sent to the gait."""
_WINDOW_M = 0.3
"""Maximum distance along the path between two successive nearest points, m.

The search for the nearest point is local, because a path may cross itself.
"""

_UNKNOWN = (
    Pose(math.nan, math.nan, math.nan),
    PathPoint(math.nan, math.nan, math.nan, math.nan),
)
"""Pose and path coordinates before the first camera frame."""

Replan = Callable[[Pose, float], Plan]
"""Function that plans from a given pose with a given fraction of the margin."""


class ReplanResult(NamedTuple):
    """Result of a request for a new plan.

    Attributes:
        reason: reason why planning with the full margin failed, or an empty string if a
            plan was found.
        fraction: fraction of the margin that the new plan keeps.
    """

    plan: Plan | None
    reason: str
    fraction: float


_HORIZON_M = 0.6
"""Path length ahead of the snake that is checked for obstacles, m."""
_CHECKED_PIECES = 8
_RESERVE_FRACTION = 0.3
"""Clearance below which a new plan is requested, as a fraction of the margin."""
_MARGIN_FRACTIONS = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Fractions of the margin for a new plan, tried in this order."""
_OPTIONAL = ("close", "run_up", "fault", "start")
"""Reasons for requesting a new plan even though the old plan is still usable."""
_UNCOUNTED = ("run_up", "fault", "start")
"""Reasons whose requests do not count towards `Conditions.max_replans`."""

_PLANNED_IN = ("obstacles", "bounds", "goal", "polygons")
"""Fields of `World` that affect plans."""


@dataclass(frozen=True)
class Conditions:
    """Sensing, delays and replanning limits of a follower.

    Attributes:
        delay: command delay, s.
        response_length: path length over which the curvature responds to a change of
            offset, m.
        max_cross_track_error: cross-track error at which a new plan is requested, m, or
            None if deviations cause no new plan.
        lead_in: length of the straight lead-in of the first path, m. At the end of the
            lead-in, a new plan is requested if `max_cross_track_error` is set.
        lag: additional delay until camera frames show the effect of a command, s.
    """

    camera: Camera
    delay: float = 0.0
    response_length: float = 0.0
    max_cross_track_error: float | None = None
    max_replans: int = 3
    lead_in: float = 0.0
    lag: float = 0.0


@dataclass(eq=False)
class Follower(Controller):
    """Controller that follows a plan by changing the gait offset.

    Attributes:
        gait: controller with an attribute `offset`, such as a `Gait` or an `ILC`.
        plan: first plan. If the plan has no path, the run ends immediately.
        footprint: footprint of the snake, which limits the offset.
        body: footprint with which the plan was computed, by default `footprint`.
        world: world whose obstacles and bounds are checked during the run.
        replan: function that computes new plans, or None if no new plans are allowed.
        submit: function that runs the planner in another thread, or None if the snake
            waits for the planner.
        min_margin_fraction: minimum fraction of the margin that a new plan must keep.
            If this fraction is above 0, the run ends with `no_room` when no such plan
            is found. The run also ends when the body approaches an obstacle and no
            further plan is allowed.
        allows_contact: whether the body may lean on obstacles.
        ending: key of `ENDINGS`, or None if the run has not ended.
        plans: plans followed so far, as pairs of start time (s) and plan.
    """

    kind = "follow"
    state_attributes = (
        "gait",
        "_frames",
        "_mean",
        "_predictor",
        "steering",
        "plans",
        "ending",
        "_s",
        "_position",
        "_moved_at",
        "_pending",
        "_commanded",
        "_tries",
        "_not_before",
        "_leading_in",
        "_requested",
        "_events",
    )

    gait: Controller
    steering: Steering
    plan: Plan
    goal: Goal
    footprint: Footprint
    conditions: Conditions
    _: KW_ONLY
    body: Footprint | None = None
    world: World = World()
    replan: Replan | None = None
    submit: Callable[[Callable[[], ReplanResult]], Future[ReplanResult]] | None = None
    min_margin_fraction: float = 0.0
    allows_contact: bool = False

    def __post_init__(self) -> None:
        if not hasattr(self.gait, "offset") or not self.gait.frequency:
            raise InputError(
                f"controller '{self.gait.kind}' has no steering offset; use gait or ilc"
            )
        self.frequency = self.gait.frequency
        self.layouts = self.gait.layouts
        self._low = self.footprint.offsets[0]
        self._high = self.footprint.offsets[-1]
        self._tightest = self.footprint.curvatures[0], self.footprint.curvatures[-1]
        self.plans: list[tuple[float, Plan]] = [(0.0, self.plan)]
        self.ending: str | None = None

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""
        assert self.frequency is not None
        self._set_offset(0.0)
        self.gait.reset(spec, tick, seed=seed)
        self._period = period = 1 / self.frequency
        conditions = self.conditions
        self._frames = CameraFrames(conditions.camera, seed)
        self._mean = PeriodMean(period)
        shows = conditions.delay + conditions.lag
        self._predictor = Predictor(
            self.footprint, period, shows, conditions.response_length
        )
        self._stuck_distance = STUCK_FRACTION * min(self.footprint.speeds) * period
        self._moved_at = 0.0
        self._pending: deque[tuple[float, float]] = deque()
        self._commanded = 0.0
        self._position = _UNKNOWN
        self._tries = 0
        self._not_before = 0.0
        self._requested = ""
        self._coming: tuple[str, Future[ReplanResult]] | None = None
        self._leading_in = (
            conditions.lead_in > 0 and conditions.max_cross_track_error is not None
        )
        self._events: list[Event] = []
        self.finished = False
        self.ending = None
        self.plans = []
        body = (self.body or self.footprint).at(0.0)
        own = self.footprint.at(0.0)
        self._reserve = _RESERVE_FRACTION * max(body.left - own.left, 0.0)
        self._checker = Checker(self.world, self.footprint)
        self._s = 0.0
        self._start_plan(0.0, self.plan)

    def step(self, state: SnakeState) -> np.ndarray:
        """See `Controller.step`."""
        time = float(state.time)
        if self._coming and self._coming[1].done() and not self.finished:
            reason, coming = self._coming
            self._coming = None
            self._receive_plan(time, reason, coming.result())
        if not self.finished:
            frame = self._frames.capture(state)
            if frame is not None:
                self._mean.add(time, frame)
                self._update_offset(time)
        while self._pending and self._pending[0][0] <= time + 1e-9:
            self._set_offset(self._pending.popleft()[1])
        valves = self.gait.step(state)
        if self.gait.finished and self.ending is None:
            self._finish(time, "gait_ended")
        return valves

    def request_replan(self, reason: str) -> None:
        """Request a new plan at the next camera frame.

        If no new plan is found, the snake keeps the old plan, unless
        `min_margin_fraction` is above 0.
        """
        self._requested = reason

    def load_state_dict(self, memory: Mapping[str, Any]) -> None:
        """See `Stateful.load_state_dict`.

        Before the state is loaded, the steering law is initialised with the path of the
        last plan.
        """
        segments = memory["plans"][-1][1].segments
        if segments:
            self._path = ReferencePath(segments)
            self.steering.begin(self._path)
        super().load_state_dict(memory)

    def signals(self) -> dict[str, float | np.ndarray]:
        """Return the signals of the gait and of the follower.

        Pose signals are NaN before the first camera frame.
        """
        pose, point = self._position
        return {
            **self.gait.signals(),
            "offset_commanded": self._commanded,
            "cross_track": point.n,
            "heading_error": math.remainder(pose.heading - point.heading, 2 * math.pi),
            "node": float(self.steering.node),
            "estimate_x": pose.x,
            "estimate_y": pose.y,
            "estimate_heading": pose.heading,
        }

    def events(self) -> list[Event]:
        """Return the events of the gait and the follower since the last call."""
        events = self.gait.events() + self._events
        self._events = []
        return events

    def describe(self) -> dict[str, object]:
        """Return the gait's description, extended by plans, world, goal and ending."""
        return self.gait.describe() | {
            "gait": self.gait.kind,
            "following": {
                "steering": type(self.steering).__name__,
                "plans": [_recorded(time, plan) for time, plan in self.plans],
                "footprint": asdict(self.body or self.footprint),
                "world": {
                    key: value
                    for key, value in asdict(self.world).items()
                    if key in _PLANNED_IN
                },
                "goal": asdict(self.goal),
                "conditions": asdict(self.conditions),
                "ending": self.ending,
            },
        }

    def _update_offset(self, time: float) -> None:
        mean = self._mean
        predictor = self._predictor
        assert mean.pose is not None
        predictor.command(time, self._commanded)
        predictor.measure(time, mean.time, mean.pose, whole=mean.complete)
        here = predictor.predict(mean.time, mean.pose, time)
        self._check_progress(time, here)
        if self.finished:
            return
        steering = self.steering
        later = time + self.conditions.delay
        # The steering law needs the pose at the time when camera frames show the effect
        # of the command.
        shows = later + self.conditions.lag
        if steering.predicts:
            pose = predictor.predict(mean.time, mean.pose, shows)
        else:
            pose = mean.pose
        turning = predictor.turning, predictor.disturbance, predictor.gain
        offset = steering.offset(SteeringInput(pose, self._locate(pose), *turning))
        offset = min(max(offset, self._low), self._high)
        # Small changes are sent only if they bring the offset to a limit.
        if abs(offset - self._commanded) >= _MIN_CHANGE or offset in (
            self._low,
            self._high,
        ):
            if offset != self._commanded:
                self._pending.append((later, offset))
            self._commanded = offset

    def _check_progress(self, time: float, here: Pose) -> None:
        point = self._locate(here)
        self._s = max(point.s, 0.0)
        self._position = (here, point)
        moved = self._predictor.moved
        goal = self.goal
        max_cross_track_error = self.conditions.max_cross_track_error
        # The snake moves back and forth within each gait period, so progress is
        # measured over whole periods.
        if moved is None or moved > self._stuck_distance:
            self._moved_at = time
        if time - self._moved_at > STUCK_PERIODS * self._period:
            self._finish(time, "stuck")
        elif point.s >= self._path.length:
            if math.hypot(goal.x - here.x, goal.y - here.y) <= goal.radius:
                self._finish(time, "goal_reached")
            else:
                self._request_plan(time, here, "goal_missed")
        elif self._requested:
            reason = self._requested
            self._requested = ""
            self._request_plan(time, here, reason)
        elif self._leading_in and point.s >= self.conditions.lead_in:
            self._leading_in = False
            # The estimates of gain and disturbance are discarded, because the gait was
            # still learning.
            self._predictor.reset_turning()
            self._request_plan(time, here, "run_up")
        elif max_cross_track_error is not None and time >= self._not_before:
            if abs(point.n) > max_cross_track_error:
                self._request_plan(time, here, "strayed")
            elif self._approaches_obstacle(here, point):
                self._request_plan(time, here, "close")

    def _approaches_obstacle(self, here: Pose, point: PathPoint) -> bool:
        if not self.world.has_obstacles or self._reserve == 0 or self.allows_contact:
            return False
        heading_error = math.remainder(here.heading - point.heading, 2 * math.pi)
        piece = (
            min(_HORIZON_M, max(self._path.length - point.s, 1e-3)) / _CHECKED_PIECES
        )
        for k in range(_CHECKED_PIECES):
            on = self._path.pose(point.s + k * piece)
            # The expected motion back to the path is divided into pieces, which are
            # approximated by arcs with the curvature of the path.
            first, last = (
                self.steering.predict_cross_track(
                    point.n, heading_error, (k + i) * piece
                )
                for i in (0, 1)
            )
            heading = on.heading + math.atan2(last - first, piece)
            x = on.x - first * math.sin(on.heading)
            y = on.y + first * math.cos(on.heading)
            curvature = min(
                max(self._path.curvature(point.s + k * piece), self._tightest[0]),
                self._tightest[1],
            )
            if not self._checker.is_arc_free(
                Pose(x, y, heading), curvature, piece, (self._reserve, self._reserve)
            ):
                return True
        return False

    def _request_plan(self, time: float, pose: Pose, reason: str) -> None:
        """Request a new plan from a pose, unless the planner is already running.

        `reason` is a key of `ENDINGS` or one of `_OPTIONAL`.
        """
        if self._coming:
            return
        if self.replan is None or self._tries >= self.conditions.max_replans:
            if reason not in _OPTIONAL:
                self._finish(time, reason)
            elif reason == "close" and self.min_margin_fraction:
                self._finish(
                    time,
                    "no_room",
                    f"{ENDINGS['no_room']}: {reason}, and no new plan is left",
                )
            elif self._tries == self.conditions.max_replans:
                # The increment ensures that the event is reported only once.
                self._tries += 1
                text = (
                    f"{reason}: the old plan is kept, because all"
                    f" {self.conditions.max_replans} new plans have been used"
                )
                self._events.append(Event(time, "no_new_plan", text))
            return
        self._tries += reason not in _UNCOUNTED
        # A new plan affects the motion only after several gait periods, so an earlier
        # request would be useless.
        self._not_before = time + RETRY_PERIODS * self._period
        job = partial(_new_plan, self.replan, pose, self.min_margin_fraction)
        if self.submit is None:
            self._receive_plan(time, reason, job())
        else:
            self._coming = reason, self.submit(job)

    def _receive_plan(self, time: float, reason: str, result: ReplanResult) -> None:
        plan = result.plan
        if plan is not None:
            if result.fraction == 1:
                margin = ""
            else:
                margin = f", {result.fraction:.0%} of the margin"
            text = f"new plan {len(self.plans)}, {plan.length:.3g} m ({reason}{margin})"
            self._events.append(Event(time, "replanned", text))
            self._start_plan(time, plan)
        elif self.min_margin_fraction:
            self._finish(
                time, "no_room", f"{ENDINGS['no_room']}: {reason}; {result.reason}"
            )
        elif reason in ("strayed", *_OPTIONAL):
            text = f"{reason}: the old plan is kept, because {result.reason}"
            self._events.append(Event(time, "no_new_plan", text))
        else:
            self._finish(
                time, reason, f"{ENDINGS[reason]}; no new plan: {result.reason}"
            )

    def _start_plan(self, time: float, plan: Plan) -> None:
        self.plans.append((time, plan))
        if not plan.segments:
            self._finish(
                time, "no_plan" if not plan.found else "goal_reached", plan.reason
            )
            return
        self._path = ReferencePath(plan.segments)
        self.steering.begin(self._path)
        self._s = 0.0

    def _locate(self, pose: Pose) -> PathPoint:
        return self._path.nearest(
            pose.x, pose.y, self._s - _WINDOW_M, self._s + _WINDOW_M
        )

    def _finish(self, time: float, reason: str, text: str = "") -> None:
        self.finished = True
        self.ending = reason
        self._events.append(Event(time, reason, text or ENDINGS[reason]))

    def _set_offset(self, offset: float) -> None:
        self.gait.offset = offset  # type: ignore[attr-defined]  # checked in __post_init__


def _new_plan(replan: Replan, pose: Pose, least: float) -> ReplanResult:
    reasons = []
    for fraction in [fraction for fraction in _MARGIN_FRACTIONS if fraction >= least]:
        try:
            plan = replan(pose, fraction)
        except InputError as error:
            reasons.append(str(error))
            continue
        if plan.segments:
            return ReplanResult(plan, "", fraction)
        reasons.append(plan.reason)
    return ReplanResult(None, reasons[0], 0.0)


def _recorded(time: float, plan: Plan) -> dict[str, object]:
    return {
        "time": time,
        "outcome": plan.outcome.value,
        "reason": plan.reason,
        "nodes": plan.expanded,
        "segments": [
            [*s.start, s.curvature, s.length, s.offset, s.speed] for s in plan.segments
        ],
    }
