r"""Follower: has a snake go along a plan by the offset of the gait underneath (Section 5.2.2).

Camera → mean over a gait period → prediction (`Predictor`) → steering law (`Steering`) → offset, which
arrives after the command delay → gait or ILC, which knows nothing of all this. It ends at the goal; where it
cannot get there it ends as well and says why (`ENDINGS`). A snake that strays from its path too far gets a
new plan, if there is somebody to plan.

A mean over a gait period is T/2 old, and a command takes a delay to arrive. Over that time a model moves the
snake on (a Smith predictor): a unicycle whose curvature follows the footprint's for the commanded offset
with a first-order lag over a length ℓ of path, the measured transient,

.. math:: \frac{dκ}{ds} = \frac{κ_{footprint}(φ) - κ}{ℓ}, \qquad \dot θ = v κ .

The speed is the measured one. What the snake turns besides, per metre of path, is measured as well and
counted as a disturbance, which takes up what the footprint has wrong.

`BearingLaw`, Section 5.2.2: the nodes of the plan are gone to one after the other. The offset is
proportional to the bearing of the next node less the heading, saturated; when the snake is within a
threshold of a node, the next one is next.

`PathLaw`, ours: with the distance n to the left of the path and the heading error e, both predicted for the
moment at which the command takes effect, the curvature

.. math:: κ = \frac{κ_{plan}(s + ℓ)}{1 - κ_{plan} n}
    - \frac{2ζ}{L}\,\bigl(1 + ℓ\tfrac{d}{ds}\bigr)(e - e_n) - d,
    \qquad e_n = -\operatorname{clip}\Bigl(\frac{n}{2ζL}\Bigr)

makes n die out over the length L like a second-order system with damping ζ. A new offset takes hold over a
length ℓ like a first-order lag, the measured transient: the plan's curvature is looked up ahead by ℓ, and the
rate of the error, which the model knows without noise, undoes the lag in the feedback. d is the predictor's
disturbance, and the footprint gives the offset for κ.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.control.camera import Camera, CameraFrames, PeriodMean
from srs_twin.errors import InputError
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.problem import Plan
from srs_twin.planning.route import PathPoint, Route
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event
from srs_twin.world import Goal, Pose, World

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState


_SPEED_SHARE = (0.2, 5.0)
"""Of the footprint's speed, within which a measured speed is believed."""

_DISTURBANCE_SHARE = 0.5
"""Of the tightest curvature: a larger disturbance is not taken up."""

_LEARNING_PERIODS = 2.0
"""Over which the disturbance follows what is measured."""

_KEPT_PERIODS = 2.5

_Moment = tuple[float, float, float, float]  # time, x, y, heading
_time = itemgetter(0)


class Predictor:
    """Model and measurement of one run.

    Attributes:
        speed: measured, m/s; the footprint's until a period has been seen twice.
        disturbance: what the snake turns beside what the model does, 1/m.
        curvature: of the model now, 1/m.
        moved: way of the means over the last period, m; None until a period has been seen twice.
    """

    def __init__(self, footprint: Footprint, period: float, delay: float, settle: float) -> None:
        """Make it.

        Args:
            footprint: offset → curvature and speed.
            period: of the gait, s.
            delay: of commands, s.
            settle: ℓ, m.
        """
        self._offsets, self._curvatures = np.array(footprint.offsets), np.array(footprint.curvatures)
        self._period, self._delay, self._settle = period, delay, settle
        self._tightest = min(footprint.tightest)
        self._nominal = self.speed = float(np.interp(0.0, footprint.offsets, footprint.speeds))
        self.disturbance = self.curvature = 0.0
        self.moved: float | None = None
        self._learnt = 0.0
        self._model: list[_Moment] = [(0.0, 0.0, 0.0, 0.0)]
        self._means: list[_Moment] = []

    @property
    def turning(self) -> float:
        """Curvature of the snake's path when a command of now arrives: the model's and the disturbance."""
        return self.curvature + self.disturbance

    def command(self, time: float, offset: float) -> None:
        """Move the model on to a time under the offset commanded from now on; it runs ahead by the delay."""
        before, x, y, heading = self._model[-1]
        step = time - before
        if step <= 0:
            return
        wanted = float(np.interp(offset, self._offsets, self._curvatures))
        way = self.speed * step
        kept = math.exp(-way / self._settle) if self._settle > 0 else 0.0
        mean = wanted + (self.curvature - wanted) * (kept if self._settle > 0 else 1.0)
        self.curvature = wanted + (self.curvature - wanted) * kept
        turn = way * ((mean + self.curvature) / 2 + self.disturbance)
        middle = heading + turn / 2
        self._model.append((time, x + way * math.cos(middle), y + way * math.sin(middle), heading + turn))
        _forget(self._model, time - _KEPT_PERIODS * self._period - self._delay)

    def measure(self, time: float, middle: float, mean: Pose, *, whole: bool) -> None:
        """Take the mean pose that belongs to `middle` (s); with whole periods learn speed and disturbance."""
        means = self._means
        means.append((middle, mean.x, mean.y, mean.heading))
        if not whole:
            self._learnt = time
            return
        since = middle - self._period
        k = bisect_right(means, since, key=_time) - 1
        if k < 0:
            return
        begin, x, y, heading = means[k]
        _forget(means, since)
        self.moved = math.hypot(mean.x - x, mean.y - y)
        span = middle - begin
        low, high = (share * self._nominal for share in _SPEED_SHARE)
        self.speed = min(max(self.moved / span, low), high)
        share = min(1.0, (time - self._learnt) / (_LEARNING_PERIODS * self._period))
        self._learnt = time
        # What the model turned over the same time; it runs ahead by the delay.
        modelled = self._at(middle)[3] - self._at(begin)[3]
        missed = (mean.heading - heading - modelled) / max(self.moved, 1e-6 + low * span)
        most = _DISTURBANCE_SHARE * self._tightest
        self.disturbance = min(max(self.disturbance + share * missed, -most), most)

    def predict(self, middle: float, mean: Pose, time: float) -> Pose:
        """Return where a snake with this mean pose at `middle` (s) is at a time, a delay from now at most."""
        _, x0, y0, heading0 = self._at(middle)
        _, x, y, heading = self._at(time)
        turn = mean.heading - heading0
        c, s = math.cos(turn), math.sin(turn)
        dx, dy = x - x0, y - y0
        return Pose(mean.x + c * dx - s * dy, mean.y + s * dx + c * dy, heading + turn)

    def _at(self, time: float) -> _Moment:
        """Return the model at a time of the snake: its command came a delay earlier."""
        time -= self._delay
        model = self._model
        k = bisect_right(model, time, key=_time)
        if k in (0, len(model)):
            return model[0 if k == 0 else -1]
        begin, x0, y0, heading0 = model[k - 1]
        end, x, y, heading = model[k]
        part = (time - begin) / (end - begin)
        return time, x0 + part * (x - x0), y0 + part * (y - y0), heading0 + part * (heading - heading0)


def _forget(moments: list[_Moment], before: float) -> None:
    """Drop what is older than a time (s), but for the last such moment, now and then."""
    old = bisect_right(moments, before, key=_time) - 1
    if 2 * old > len(moments):
        del moments[:old]


DAMPING = 1.0
_STEEPEST = 0.7
"""Largest heading towards the path, rad."""


@dataclass(frozen=True)
class SteeringInput:
    """What a law may look at.

    Attributes:
        pose: of the snake: the mean over a period for laws that do not predict.
        place: of that pose on the route.
        curvature: of its path then, as the model has it, 1/m.
        disturbance: see `Predictor`, 1/m.
    """

    pose: Pose
    place: PathPoint
    curvature: float
    disturbance: float


class Steering(ABC):
    """A steering law; frozen settings make one for every run.

    Attributes:
        predicts: whether it wants the pose predicted.
        node: number of the node that the snake heads for, or of the nodes that it has passed.
    """

    predicts: bool
    node: int = 0

    @abstractmethod
    def begin(self, route: Route) -> None:
        """Take a new path."""

    @abstractmethod
    def offset(self, seen: SteeringInput) -> float:
        """Return the offset, as yet unlimited."""


class BearingLaw(Steering):
    """The text's (module docstring)."""

    predicts = False

    def __init__(self, gain: float, spacing: float, near: float) -> None:
        """Make it.

        Args:
            gain: offset for an error of bearing, 1/rad.
            spacing: of the nodes along the path, m; the last one is the path's end.
            near: how close is close enough, m.
        """
        self._gain, self._spacing, self._near = gain, spacing, near

    def begin(self, route: Route) -> None:
        """See `Steering.begin`."""
        count = max(1, math.ceil(route.length / self._spacing - 1e-9))
        self._nodes = [route.pose(min(k * self._spacing, route.length)) for k in range(1, count + 1)]
        self.node = 0

    def offset(self, seen: SteeringInput) -> float:
        """See `Steering.offset`."""
        x, y, heading = seen.pose.x, seen.pose.y, seen.pose.heading
        last = len(self._nodes) - 1
        while self.node < last and self._away(x, y) <= self._near:
            self.node += 1
        node = self._nodes[self.node]
        bearing = math.atan2(node.y - y, node.x - x)
        return self._gain * math.remainder(bearing - heading, 2 * math.pi)

    def _away(self, x: float, y: float) -> float:
        node = self._nodes[self.node]
        return math.hypot(node.x - x, node.y - y)


class PathLaw(Steering):
    """Ours (module docstring)."""

    predicts = True

    def __init__(self, footprint: Footprint, length: float, settle: float) -> None:
        """Make it.

        Args:
            footprint: curvature → offset.
            length: L, m.
            settle: ℓ, m.
        """
        self._offsets, self._curvatures = np.array(footprint.offsets), np.array(footprint.curvatures)
        self._length, self._settle = length, settle

    def begin(self, route: Route) -> None:
        """See `Steering.begin`."""
        self._route = route
        self.node = 0

    def offset(self, seen: SteeringInput) -> float:
        """See `Steering.offset`."""
        s, n, heading, _ = seen.place
        while self.node < len(self._route.arcs) - 2 and s > self._route.arcs[self.node + 1, 4]:
            self.node += 1
        ahead = self._route.curvature(s + self._settle)
        error = math.remainder(seen.pose.heading - heading, 2 * math.pi)
        towards = -min(max(n / (2 * DAMPING * self._length), -_STEEPEST), _STEEPEST)
        rate = seen.curvature - seen.place.curvature + math.sin(error) / (2 * DAMPING * self._length)
        back = 2 * DAMPING / self._length * (error - towards + self._settle * rate)
        curvature = ahead / max(1 - ahead * n, 0.5) - back - seen.disturbance
        return float(np.interp(curvature, self._curvatures, self._offsets))


ENDINGS = {
    "goal_reached": "the goal is reached",
    "goal_missed": "the path has ended beside the goal",
    "no_plan": "there is no plan",
    "strayed": "too far from the path, as often as new plans are allowed",
    "stuck": "no way made for several periods",
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

Replan = Callable[[Pose], Plan]


@dataclass(frozen=True)
class Conditions:
    """What stands between follower and snake, and when it gives up.

    Attributes:
        camera: what it sees.
        delay: of commands, s.
        settle: ℓ, path over which a new offset takes hold, m.
        stray: distance from the path at which a new plan is made, m; None: never.
        replans: how often a new plan is asked for at most.
    """

    camera: Camera
    delay: float = 0.0
    settle: float = 0.0
    stray: float | None = None
    replans: int = 3


class Follower(Controller):
    """Follows a plan (module docstring).

    Attributes:
        finished: at its end.
        ending: why, of `ENDINGS`; None while it goes on.
        plans: (time, plan) of each, the first at 0.
    """

    kind = "follow"

    def __init__(
        self,
        gait: Controller,
        law: Steering,
        plan: Plan,
        goal: Goal,
        footprint: Footprint,
        conditions: Conditions,
        *,
        body: Footprint | None = None,
        world: World | None = None,
        replan: Replan | None = None,
    ) -> None:
        """Make it.

        Args:
            gait: what goes by an `offset`: a `Gait` or an `ILC`.
            law: decides the offset.
            plan: what to follow; one that is not found ends the run at once.
            goal: where to end.
            footprint: what the snake can do; bounds of the offset.
            conditions: delay, camera, when to plan anew.
            body: the footprint that the plan was made with, recorded with the run; None: the same.
            world: recorded with the run.
            replan: makes a new plan from a pose; None: nobody does.

        Raises:
            InputError: a gait without an offset or a frequency.
        """
        if not hasattr(gait, "offset") or not gait.frequency:
            raise InputError(f"controller '{gait.kind}' has no offset to steer by; gait and ilc have")
        self.frequency, self.layouts = gait.frequency, gait.layouts
        self._gait, self._law, self._first, self._goal = gait, law, plan, goal
        self._footprint, self._conditions = footprint, conditions
        self._body = body or footprint
        self._world, self._replan = world or World(), replan
        self._low, self._high = footprint.offsets[0], footprint.offsets[-1]
        self.plans: list[tuple[float, Plan]] = [(0.0, plan)]
        self.ending: str | None = None

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""
        assert self.frequency is not None
        self._steer(0.0)
        self._gait.reset(spec, tick, seed=seed)
        self._period = period = 1 / self.frequency
        conditions = self._conditions
        self._frames, self._mean = CameraFrames(conditions.camera, seed), PeriodMean(period)
        self._predictor = Predictor(self._footprint, period, conditions.delay, conditions.settle)
        self._slow = STUCK_SHARE * min(self._footprint.speeds) * period
        self._moving_at = 0.0
        self._orders: deque[tuple[float, float]] = deque()
        self._commanded = 0.0
        self._here = _NOWHERE
        self._tries, self._not_before = 0, 0.0
        self._events: list[Event] = []
        self.finished, self.ending, self.plans = False, None, []
        self._take(0.0, self._first)

    def step(self, state: SnakeState) -> np.ndarray:
        """See `Controller.step`."""
        time = float(state.time)
        frame = self._frames.take(state) if not self.finished else None
        if frame is not None:
            self._mean.add(time, frame)
            self._decide(time)
        while self._orders and self._orders[0][0] <= time + 1e-9:
            self._steer(self._orders.popleft()[1])
        valves = self._gait.step(state)
        if self._gait.finished and self.ending is None:
            self._end(time, "gait_ended")
        return valves

    def signals(self) -> dict[str, Any]:
        """Return those of the gait, and what the follower sees and commands; NaN before the first frame."""
        pose, place = self._here
        return self._gait.signals() | {
            "offset_commanded": self._commanded,
            "cross_track": place.n,
            "heading_error": math.remainder(pose.heading - place.heading, 2 * math.pi),
            "node": float(self._law.node),
            "estimate_x": pose.x,
            "estimate_y": pose.y,
            "estimate_heading": pose.heading,
        }

    def events(self) -> list[Event]:
        """Return the events since the last call: of the gait, new plans, the end."""
        events, self._events = self._gait.events() + self._events, []
        return events

    def describe(self) -> dict[str, Any]:
        """Return what the gait says of itself, and plans, footprint, world and ending."""
        goal, conditions = asdict(self._goal), asdict(self._conditions)
        return self._gait.describe() | {
            "gait": self._gait.kind,
            "following": {
                "law": type(self._law).__name__,
                "plans": [_recorded(time, plan) for time, plan in self.plans],
                "footprint": asdict(self._body),
                "world": asdict(self._world),
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
        predictor.measure(time, mean.middle, mean.pose, whole=mean.whole)
        here = predictor.predict(mean.middle, mean.pose, time)
        self._look(time, here)
        if self.finished:
            return
        law, later = self._law, time + self._conditions.delay
        pose = predictor.predict(mean.middle, mean.pose, later) if law.predicts else mean.pose
        wanted = law.offset(SteeringInput(pose, self._near(pose), predictor.turning, predictor.disturbance))
        wanted = min(max(wanted, self._low), self._high)
        # At its bounds an offset is sent however little it changes.
        if abs(wanted - self._commanded) >= _SENT or wanted in (self._low, self._high):
            if wanted != self._commanded:
                self._orders.append((later, wanted))
            self._commanded = wanted

    def _look(self, time: float, here: Pose) -> None:
        """Look whether the snake has arrived, strayed or is stuck."""
        place = self._near(here)
        self._s, self._here = max(place.s, 0.0), (here, place)
        moved, goal, stray = self._predictor.moved, self._goal, self._conditions.stray
        if moved is None or moved > self._slow:
            self._moving_at = time
        if time - self._moving_at > STUCK_PERIODS * self._period:
            self._end(time, "stuck")
        elif place.s >= self._route.length:
            if math.hypot(goal.x - here.x, goal.y - here.y) <= goal.radius:
                self._end(time, "goal_reached")
            else:
                self._again(time, here, "goal_missed")
        elif stray is not None and abs(place.n) > stray:
            self._again(time, here, "strayed")

    def _again(self, time: float, pose: Pose, why: str) -> None:
        """Plan anew from a pose; without a new plan, a snake that strayed goes on along the old one."""
        if time < self._not_before and why == "strayed":
            return
        if self._replan is None or self._tries >= self._conditions.replans:
            self._end(time, why)
            return
        self._tries += 1
        plan, reason = _asked(self._replan, pose)
        if plan is not None:
            text = f"new plan {len(self.plans)}, {plan.length:.3g} m ({why})"
            self._events.append(Event(time, "replanned", text))
            self._take(time, plan)
        elif why == "strayed":
            self._not_before = time + PATIENCE_PERIODS * self._period
            self._events.append(Event(time, "no_new_plan", f"going on along the old one: {reason}"))
        else:
            self._end(time, why, f"{ENDINGS[why]}; no new plan: {reason}")

    def _take(self, time: float, plan: Plan) -> None:
        self.plans.append((time, plan))
        if not plan.segments:
            self._end(time, "no_plan" if not plan.found else "goal_reached", plan.reason)
            return
        self._route = Route(plan.segments)
        self._law.begin(self._route)
        self._s = 0.0

    def _near(self, pose: Pose) -> PathPoint:
        """Return the place on the route, not far from the last one."""
        return self._route.nearest(pose.x, pose.y, self._s - _WINDOW, self._s + _WINDOW)

    def _end(self, time: float, why: str, text: str = "") -> None:
        self.finished, self.ending = True, why
        self._events.append(Event(time, why, text or ENDINGS[why]))

    def _steer(self, offset: float) -> None:
        self._gait.offset = offset


def _asked(replan: Replan, pose: Pose) -> tuple[Plan | None, str]:
    """Return a plan from a pose, or None and why there is none."""
    try:
        plan = replan(pose)
    except InputError as error:
        return None, str(error)
    return (plan, "") if plan.segments else (None, plan.reason)


def _recorded(time: float, plan: Plan) -> dict[str, Any]:
    """Return a plan as JSON values; `comparison.following` reads them."""
    return {
        "time": time,
        "outcome": plan.outcome.value,
        "reason": plan.reason,
        "nodes": plan.expanded,
        "segments": [[*s.start, s.curvature, s.length, s.offset, s.speed] for s in plan.segments],
    }
