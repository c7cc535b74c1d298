r"""Steering of a snake along a path: where it is when a command arrives, and the laws that choose the offset.

A mean over a gait period is T/2 old, and a command takes a delay to arrive. Over that time a model moves the
snake on (a Smith predictor): a unicycle whose curvature follows the footprint's for the commanded offset
with a first-order lag over a length ℓ of path, the measured transient,

$$ \frac{dκ}{ds} = \frac{κ_{footprint}(φ) - κ}{ℓ}, \qquad \dot θ = v κ . $$

The speed is the measured one. What the snake turns besides, per metre of path, is measured as well and
counted as a disturbance, which takes up what the footprint has wrong.

`BearingLaw`, Section 5.2.2: the nodes of the plan are gone to one after the other. The offset is
proportional to the bearing of the next node less the heading, saturated; when the snake is within a
threshold of a node, the next one is next.

`PathLaw`, ours: with the distance n to the left of the path and the heading error e, both predicted for the
moment at which the command takes effect, the curvature

$$ κ = \frac{κ_{plan}(s + ℓ)}{1 - κ_{plan} n}
   - \frac{2ζ}{L}\,\bigl(1 + ℓ\tfrac{d}{ds}\bigr)(e - e_n) - d,
   \qquad e_n = -\operatorname{clip}\Bigl(\frac{n}{2ζL}\Bigr) $$

makes n die out over the length L like a second-order system with damping ζ. A new offset takes hold over a
length ℓ like a first-order lag, the measured transient: the plan's curvature is looked up ahead by ℓ, and the
rate of the error, which the model knows without noise, undoes the lag in the feedback. d is the predictor's
disturbance, and the footprint gives the offset for κ.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from bisect import bisect_right
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from srs_twin.planning.footprint import Footprint
from srs_twin.planning.route import PathPoint, Route
from srs_twin.world import Pose

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

    def __init__(self, gain: float = 0.6, node: float = 0.2, near: float = 0.2) -> None:
        """Make it; docs/following.md says how the defaults were found.

        Args:
            gain: offset for an error of bearing, 1/rad.
            node: distance of the nodes along the path, m; the last one is the path's end.
            near: how close is close enough, m.
        """
        self._gain, self._spacing, self._near = gain, node, near

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

    def __init__(self, footprint: Footprint, lookahead: float = 0.15, settle: float = 0.05) -> None:
        """Make it; docs/following.md says how the defaults were found.

        Args:
            footprint: curvature → offset.
            lookahead: L, m.
            settle: ℓ, m.
        """
        self._offsets, self._curvatures = np.array(footprint.offsets), np.array(footprint.curvatures)
        self._length, self._settle = lookahead, settle

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
