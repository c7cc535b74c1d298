"""Follower: has a snake go along a plan by the offset of the gait underneath (Section 5.2.2).

Camera → mean over a gait period → prediction (`Predictor`) → steering law (`Steering`) → offset, which
arrives after the command delay → gait or ILC, which knows nothing of all this. It ends at the goal; where it
cannot get there it ends as well and says why (`ENDINGS`). A snake that strays from its path too far, or
whose body is about to come near to something, gets a new plan, if there is somebody to plan: with the margin
of the plan, or with a part of it where there is no such plan.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import KW_ONLY, asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.control.camera import Camera, CameraFrames, PeriodMean
from srs_twin.errors import InputError
from srs_twin.planning.collision import Checker
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.plan import Plan
from srs_twin.planning.route import PathPoint, Route
from srs_twin.planning.steering import Predictor, Steering, SteeringInput
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Goal, Pose, World
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState


ENDINGS = {
    "goal_reached": "the goal is reached",
    "goal_missed": "the path has ended beside the goal",
    "no_plan": "there is no plan",
    "strayed": "too far from the path, as often as new plans are allowed",
    "stuck": "no way made for several periods",
    "no_room": "no way with the margin that is needed",
    "gait_ended": "the gait underneath has ended",
}
"""Why a follower ends; the first is the one that is wanted."""

STUCK_SHARE = 0.1
"""Of the footprint's speed: whatever is slower for `STUCK_PERIODS` is stuck."""
STUCK_PERIODS = 6
PATIENCE_PERIODS = 2
"""After a new plan was asked for in vain, before the next one is."""
_SENT = 1e-3
"""Offsets that differ by less are not sent."""
_WINDOW = 0.3
"""How far along the path, m, the nearest point is looked for about the last one: paths may cross."""

_NOWHERE = Pose(math.nan, math.nan, math.nan), PathPoint(math.nan, math.nan, math.nan, math.nan)

Replan = Callable[[Pose, float], Plan]
"""Pose and share of the margin → plan."""

Renewal = tuple[Plan | None, str, float]
"""A plan, or None and why there is none with the whole margin; and the share of it."""

_HORIZON = 0.6
"""How far ahead the body is looked after, m."""
_PIECES = 8
_RESERVE = 0.3
"""Of the margin: nearer than that the body is not to come."""
_SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)
_GOING_ON = ("close", "run_up", "fault", "start")
"""Reasons for a new plan without which the snake goes on along the old one."""


_PLANNED_IN = ("obstacles", "bounds", "goal", "polygons")  # of a world: its floor is the plants'


@dataclass(frozen=True)
class Conditions:
    """What stands between follower and snake, and when it gives up.

    Attributes:
        camera: what it sees.
        delay: of commands, s.
        settle: ℓ, path over which a new offset takes hold, m.
        stray: distance from the path at which a new plan is made, m; None: never.
        replans: how often a new plan is asked for at most.
        run_up: of the first path, m: from its end the way is planned anew from where the snake is, if there
            are new plans.
        lag: how much later than after `delay` a command shows in the frames, s: what the way there and back
            takes of a robot whose frames come late.
    """

    camera: Camera
    delay: float = 0.0
    settle: float = 0.0
    stray: float | None = None
    replans: int = 3
    run_up: float = 0.0
    lag: float = 0.0


@dataclass(eq=False)
class Follower(Controller):
    """Follows a plan (module docstring).

    Attributes:
        gait: what goes by an `offset`: a `Gait` or an `ILC`.
        law: decides the offset.
        plan: what to follow; one that is not found ends the run at once.
        goal: where to end.
        footprint: what the snake can do; bounds of the offset.
        conditions: delay, camera, when to plan anew.
        body: the footprint that the plan was made with, recorded with the run; None: the same.
        world: recorded with the run.
        replan: makes a new plan from a pose; None: nobody does.
        submit: has another thread make them, while the snake goes on; None: it waits for them.
        least_margin: share of the margin that a new plan needs. Above 0, a snake that finds no such plan, or
            comes too near to something when no new plan is left, stops (`no_room`) instead of going on.
        finished: at its end.
        ending: why, of `ENDINGS`; None while it goes on.
        plans: (time, plan) of each, the first at 0.

    Raises:
        InputError: a gait without an offset or a frequency.
    """

    kind = "follow"
    state_attributes = (
        *("gait", "_frames", "_mean", "_predictor", "law", "plans", "ending", "_s", "_here", "_moving_at"),
        *("_pending", "_commanded", "_tries", "_not_before", "_running_up", "_renewal", "_events"),
    )

    gait: Controller
    law: Steering
    plan: Plan
    goal: Goal
    footprint: Footprint
    conditions: Conditions
    _: KW_ONLY
    body: Footprint | None = None
    world: World = World()
    replan: Replan | None = None
    submit: Callable[[Callable[[], Renewal]], Future[Renewal]] | None = None
    least_margin: float = 0.0

    def __post_init__(self) -> None:
        if not hasattr(self.gait, "offset") or not self.gait.frequency:
            raise InputError(f"controller '{self.gait.kind}' has no offset to steer by; gait and ilc have")
        self.frequency, self.layouts = self.gait.frequency, self.gait.layouts
        self._low, self._high = self.footprint.offsets[0], self.footprint.offsets[-1]
        self._tightest = self.footprint.curvatures[0], self.footprint.curvatures[-1]
        self.plans: list[tuple[float, Plan]] = [(0.0, self.plan)]
        self.ending: str | None = None

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""
        assert self.frequency is not None
        self._steer(0.0)
        self.gait.reset(spec, tick, seed=seed)
        self._period = period = 1 / self.frequency
        conditions = self.conditions
        self._frames, self._mean = CameraFrames(conditions.camera, seed), PeriodMean(period)
        shows = conditions.delay + conditions.lag
        self._predictor = Predictor(self.footprint, period, shows, conditions.settle)
        self._slow = STUCK_SHARE * min(self.footprint.speeds) * period
        self._moving_at = 0.0
        self._pending: deque[tuple[float, float]] = deque()
        self._commanded = 0.0
        self._here = _NOWHERE
        self._tries, self._not_before = 0, 0.0
        self._renewal = ""
        self._coming: tuple[str, Future[Renewal]] | None = None
        self._running_up = self.conditions.run_up > 0 and self.conditions.stray is not None
        self._events: list[Event] = []
        self.finished, self.ending, self.plans = False, None, []
        body, own = (self.body or self.footprint).at(0.0), self.footprint.at(0.0)
        self._reserve = _RESERVE * max(body.left - own.left, 0.0)
        self._checker = Checker(self.world, self.footprint)
        self._s = 0.0
        self._take(0.0, self.plan)

    def step(self, state: SnakeState) -> np.ndarray:
        """See `Controller.step`."""
        time = float(state.time)
        if self._coming and self._coming[1].done() and not self.finished:
            why, coming = self._coming
            self._coming = None
            self._renewed(time, why, coming.result())
        frame = self._frames.capture(state) if not self.finished else None
        if frame is not None:
            self._mean.add(time, frame)
            self._decide(time)
        while self._pending and self._pending[0][0] <= time + 1e-9:
            self._steer(self._pending.popleft()[1])
        valves = self.gait.step(state)
        if self.gait.finished and self.ending is None:
            self._end(time, "gait_ended")
        return valves

    def renew(self, why: str) -> None:
        """Plan anew at the next frame, as something has changed; else the old plan is followed on."""
        self._renewal = why

    def load_state_dict(self, memory: Mapping[str, Any]) -> None:
        """See `Remembers`; the law begins the last plan's path before it is told where it is on it."""
        segments = memory["plans"][-1][1].segments
        if segments:
            self._route = Route(segments)
            self.law.begin(self._route)
        super().load_state_dict(memory)

    def signals(self) -> dict[str, Any]:
        """Return those of the gait, and what the follower sees and commands; NaN before the first frame."""
        pose, place = self._here
        return self.gait.signals() | {
            "offset_commanded": self._commanded,
            "cross_track": place.n,
            "heading_error": math.remainder(pose.heading - place.heading, 2 * math.pi),
            "node": float(self.law.node),
            "estimate_x": pose.x,
            "estimate_y": pose.y,
            "estimate_heading": pose.heading,
        }

    def events(self) -> list[Event]:
        """Return the events since the last call: of the gait, new plans, the end."""
        events, self._events = self.gait.events() + self._events, []
        return events

    def describe(self) -> dict[str, Any]:
        """Return what the gait says of itself, and plans, footprint, world and ending."""
        goal, conditions = asdict(self.goal), asdict(self.conditions)
        return self.gait.describe() | {
            "gait": self.gait.kind,
            "following": {
                "law": type(self.law).__name__,
                "plans": [_recorded(time, plan) for time, plan in self.plans],
                "footprint": asdict(self.body or self.footprint),
                "world": {name: part for name, part in asdict(self.world).items() if name in _PLANNED_IN},
                "goal": goal,
                "conditions": conditions,
                "ending": self.ending,
            },
        }

    def _decide(self, time: float) -> None:
        """Look where the snake is, and send a new offset."""
        mean, predictor = self._mean, self._predictor
        assert mean.pose is not None
        predictor.command(time, self._commanded)
        predictor.measure(time, mean.time, mean.pose, whole=mean.complete)
        here = predictor.predict(mean.time, mean.pose, time)
        self._look(time, here)
        if self.finished:
            return
        law, later = self.law, time + self.conditions.delay
        shows = later + self.conditions.lag
        pose = predictor.predict(mean.time, mean.pose, shows) if law.predicts else mean.pose
        turning = predictor.turning, predictor.disturbance, predictor.gain
        wanted = law.offset(SteeringInput(pose, self._near(pose), *turning))
        wanted = min(max(wanted, self._low), self._high)
        # At its bounds an offset is sent however little it changes.
        if abs(wanted - self._commanded) >= _SENT or wanted in (self._low, self._high):
            if wanted != self._commanded:
                self._pending.append((later, wanted))
            self._commanded = wanted

    def _look(self, time: float, here: Pose) -> None:
        """Look whether the snake has arrived, strayed or is stuck."""
        place = self._near(here)
        self._s, self._here = max(place.s, 0.0), (here, place)
        moved, goal, stray = self._predictor.moved, self.goal, self.conditions.stray
        if moved is None or moved > self._slow:
            self._moving_at = time
        if time - self._moving_at > STUCK_PERIODS * self._period:
            self._end(time, "stuck")
        elif place.s >= self._route.length:
            if math.hypot(goal.x - here.x, goal.y - here.y) <= goal.radius:
                self._end(time, "goal_reached")
            else:
                self._again(time, here, "goal_missed")
        elif self._renewal:
            why, self._renewal = self._renewal, ""
            self._again(time, here, why)
        elif self._running_up and place.s >= self.conditions.run_up:
            self._running_up = False
            self._predictor.forget()
            self._again(time, here, "run_up")
        elif stray is not None and time >= self._not_before:
            if abs(place.n) > stray:
                self._again(time, here, "strayed")
            elif self._endangered(here, place):
                self._again(time, here, "close")

    def _endangered(self, here: Pose, place: PathPoint) -> bool:
        """Say whether the body comes too near to something on its way back to the path."""
        if not self.world.has_obstacles or self._reserve == 0:
            return False
        slope = math.remainder(here.heading - place.heading, 2 * math.pi)
        piece = min(_HORIZON, max(self._route.length - place.s, 1e-3)) / _PIECES
        for k in range(_PIECES):
            on = self._route.pose(place.s + k * piece)
            beside, then = (self.law.beside(place.n, slope, (k + i) * piece) for i in (0, 1))
            heading = on.heading + math.atan2(then - beside, piece)
            x, y = on.x - beside * math.sin(on.heading), on.y + beside * math.cos(on.heading)
            curvature = min(
                max(self._route.curvature(place.s + k * piece), self._tightest[0]), self._tightest[1]
            )
            if not self._checker.free(Pose(x, y, heading), curvature, piece, (self._reserve, self._reserve)):
                return True
        return False

    def _again(self, time: float, pose: Pose, why: str) -> None:
        """Plan anew from a pose, unless that is being done."""
        if self._coming:
            return
        if self.replan is None or self._tries >= self.conditions.replans:
            if why not in _GOING_ON:
                self._end(time, why)
            elif why == "close" and self.least_margin:
                self._end(time, "no_room", f"{ENDINGS['no_room']}: {why}, and no new plan is left")
            elif self._tries == self.conditions.replans:
                self._tries += 1  # said once
                text = f"{why}: going on along the old one, all {self.conditions.replans} new plans are used"
                self._events.append(Event(time, "no_new_plan", text))
            return
        self._tries += why not in ("run_up", "fault", "start")
        self._not_before = time + PATIENCE_PERIODS * self._period
        job = partial(_new_plan, self.replan, pose, self.least_margin)
        if self.submit is None:
            self._renewed(time, why, job())
        else:
            self._coming = why, self.submit(job)

    def _renewed(self, time: float, why: str, found: Renewal) -> None:
        """Take a new plan; without one, a snake that still has an old one goes on along it."""
        plan, reason, share = found
        if plan is not None:
            margin = "" if share == 1 else f", {share:.0%} of the margin"
            text = f"new plan {len(self.plans)}, {plan.length:.3g} m ({why}{margin})"
            self._events.append(Event(time, "replanned", text))
            self._take(time, plan)
        elif self.least_margin:
            self._end(time, "no_room", f"{ENDINGS['no_room']}: {why}; {reason}")
        elif why in ("strayed", *_GOING_ON):
            self._events.append(Event(time, "no_new_plan", f"{why}: going on along the old one, {reason}"))
        else:
            self._end(time, why, f"{ENDINGS[why]}; no new plan: {reason}")

    def _take(self, time: float, plan: Plan) -> None:
        self.plans.append((time, plan))
        if not plan.segments:
            self._end(time, "no_plan" if not plan.found else "goal_reached", plan.reason)
            return
        self._route = Route(plan.segments)
        self.law.begin(self._route)
        self._s = 0.0

    def _near(self, pose: Pose) -> PathPoint:
        """Return the place on the route, not far from the last one."""
        return self._route.nearest(pose.x, pose.y, self._s - _WINDOW, self._s + _WINDOW)

    def _end(self, time: float, why: str, text: str = "") -> None:
        self.finished, self.ending = True, why
        self._events.append(Event(time, why, text or ENDINGS[why]))

    def _steer(self, offset: float) -> None:
        self.gait.offset = offset  # type: ignore[attr-defined]  # checked when made


def _new_plan(replan: Replan, pose: Pose, least: float) -> Renewal:
    """Return a plan from a pose, with as much of the margin as there is room for, at least a share of it."""
    reasons = []
    for share in [each for each in _SHARES if each >= least]:
        try:
            plan = replan(pose, share)
        except InputError as error:
            reasons.append(str(error))
            continue
        if plan.segments:
            return plan, "", share
        reasons.append(plan.reason)
    return None, reasons[0], 0.0


def _recorded(time: float, plan: Plan) -> dict[str, Any]:
    """Return a plan as JSON values; `comparison.following` reads them."""
    return {
        "time": time,
        "outcome": plan.outcome.value,
        "reason": plan.reason,
        "nodes": plan.expanded,
        "segments": [[*s.start, s.curvature, s.length, s.offset, s.speed] for s in plan.segments],
    }
