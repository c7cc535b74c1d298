r"""Steering of a snake along a path: where it is when a command arrives, and the laws that choose the offset.

A mean over a gait period is T/2 old, and a command takes a delay to arrive. Over that time a model moves the
snake on (a Smith predictor): a unicycle whose curvature follows the footprint's for the commanded offset
with a first-order lag over a length ℓ of path, the measured transient,

$$ \frac{dκ}{ds} = \frac{κ_{footprint}(φ) - κ}{ℓ}, \qquad \dot θ = v (g κ + d) . $$

The speed is the measured one. What a snake with modules of its own turns otherwise than its footprint, the
gain g and the disturbance d per metre of path, a Kalman filter finds on the way.

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
rate of the error, which the model knows without noise, undoes the lag in the feedback. d and g are the
predictor's, and the footprint gives the offset for κ/g.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from bisect import bisect_right
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from srs_twin.io.saved_state import Stateful
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.route import PathPoint, Route
from srs_twin.robot.world import Pose

_SPEED_SHARE = (0.2, 5.0)
"""Of the footprint's speed, within which a measured speed is believed."""

_DISTURBANCE_SHARE = 0.5
"""Of the tightest curvature: a larger disturbance is not taken up."""
_GAINS = (0.4, 2.5)

_DOUBT = np.array([0.2, 0.3])
"""Standard deviations of d, in tightest curvatures, and of g at the start: docs/following.md."""
_WANDER = np.array([0.1, 0.1])
"""Their random walk, a square root of a gait period."""
_SEEN = 0.02
"""Error of a measured curvature, in tightest ones, over a gait period."""

_KEPT_PERIODS = 2.5

_Moment = tuple[float, ...]  # time, x, y, heading; of the model also what it turned without disturbance
_time = itemgetter(0)


class Predictor(Stateful):
    """Model and measurement of one run.

    Attributes:
        speed: measured, m/s; the footprint's until a period has been seen twice.
        disturbance: d, what the snake turns beside what it is commanded, 1/m.
        gain: g, of what it is commanded.
        curvature: of the footprint now, lagged, 1/m.
        moved: way of the means over the last period, m; None until a period has been seen twice.
    """

    state_attributes = (
        "speed",
        "disturbance",
        "gain",
        "curvature",
        "moved",
        "_doubt",
        "_learnt",
        "_model",
        "_means",
    )

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
        self.curvature = 0.0
        self._scale = np.array([self._tightest, 1.0])
        self.forget()
        self.moved: float | None = None
        self._learnt = 0.0
        self._model: list[_Moment] = [(0.0, 0.0, 0.0, 0.0, 0.0)]
        self._means: list[_Moment] = []

    def forget(self) -> None:
        """Hold nothing for true of what the snake turned so far: its gait was still learning."""
        self.disturbance, self.gain = 0.0, 1.0
        self._doubt = np.diag((_DOUBT * self._scale) ** 2)

    @property
    def turning(self) -> float:
        """Curvature of the snake's path when a command of now arrives, 1/m."""
        return self.gain * self.curvature + self.disturbance

    def command(self, time: float, offset: float) -> None:
        """Move the model on to a time under the offset commanded from now on; it runs ahead by the delay."""
        before, x, y, heading, turned = self._model[-1]
        step = time - before
        if step <= 0:
            return
        wanted = float(np.interp(offset, self._offsets, self._curvatures))
        way = self.speed * step
        kept = math.exp(-way / self._settle) if self._settle > 0 else 0.0
        mean = wanted + (self.curvature - wanted) * (kept if self._settle > 0 else 1.0)
        self.curvature = wanted + (self.curvature - wanted) * kept
        wished = way * (mean + self.curvature) / 2
        turn = self.gain * wished + way * self.disturbance
        middle = heading + turn / 2
        x, y = x + way * math.cos(middle), y + way * math.sin(middle)
        self._model.append((time, x, y, heading + turn, turned + wished))
        _forget(self._model, time - _KEPT_PERIODS * self._period - self._delay)

    def measure(self, time: float, middle: float, mean: Pose, *, whole: bool) -> None:
        """Take the mean pose that belongs to `middle` (s); with whole periods learn speed and turning."""
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
        # What the footprint turned over the same time; the model runs ahead by the delay.
        wished, way = self._at(middle)[4] - self._at(begin)[4], max(self.moved, 1e-6 + low * span)
        self._learn((mean.heading - heading) / way, wished / way, (time - self._learnt) / self._period)
        self._learnt = time

    def _learn(self, seen: float, wished: float, periods: float) -> None:
        """Take a curvature that was seen where the footprint has another, both 1/m, after so many periods."""
        if periods <= 0:
            return
        self._doubt += np.diag((_WANDER * self._scale) ** 2 * periods)
        parts = np.array([1.0, wished])
        # Frames of one period overlap: together they weigh as one measurement.
        spread = self._doubt @ parts
        weights = spread / (parts @ spread + (_SEEN * self._tightest) ** 2 / periods)
        off, most = seen - self.disturbance - self.gain * wished, _DISTURBANCE_SHARE * self._tightest
        self.disturbance = min(max(self.disturbance + float(weights[0]) * off, -most), most)
        self.gain = min(max(self.gain + float(weights[1]) * off, _GAINS[0]), _GAINS[1])
        self._doubt -= np.outer(weights, spread)

    def predict(self, middle: float, mean: Pose, time: float) -> Pose:
        """Return where a snake with this mean pose at `middle` (s) is at a time, a delay from now at most."""
        _, x0, y0, heading0, _ = self._at(middle)
        _, x, y, heading, _ = self._at(time)
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
        before, after = np.array(model[k - 1]), np.array(model[k])
        part = (time - before[0]) / (after[0] - before[0])
        return tuple(before + part * (after - before))


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
        gain: see there.
    """

    pose: Pose
    place: PathPoint
    curvature: float
    disturbance: float
    gain: float = 1.0


class Steering(Stateful, ABC):
    """A steering law; frozen settings make one for every run.

    Attributes:
        predicts: whether it wants the pose predicted.
        node: number of the node that the snake heads for, or of the nodes that it has passed.
    """

    state_attributes = ("node",)

    predicts: bool
    node: int = 0

    @abstractmethod
    def begin(self, route: Route) -> None:
        """Take a new path."""

    @abstractmethod
    def offset(self, seen: SteeringInput) -> float:
        """Return the offset, as yet unlimited."""

    def beside(self, n: float, slope: float, ahead: float) -> float:
        """Return the distance to the left of the path that is to be expected farther on, m.

        Args:
            n: of now, m.
            slope: of the heading against the path, rad.
            ahead: how far on, m.
        """
        return n + slope * ahead


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
        return float(np.interp(curvature / seen.gain, self._curvatures, self._offsets))

    def beside(self, n: float, slope: float, ahead: float) -> float:
        """See `Steering.beside`; with ζ = 1 the law's n'' = −2 n'/L − n/L²."""
        return (n + (n / self._length + slope) * ahead) * math.exp(-ahead / self._length)
