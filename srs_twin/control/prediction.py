r"""Prediction: where a snake will be when a command of now takes effect.

A mean over a gait period is T/2 old, and a command takes a delay to arrive. Over that time a model moves the
snake on (a Smith predictor): a unicycle whose curvature follows the footprint's for the commanded offset
with a first-order lag over a length ℓ of path, the measured transient,

.. math:: \frac{dκ}{ds} = \frac{κ_{footprint}(φ) - κ}{ℓ}, \qquad \dot θ = v κ .

The speed is the measured one. What the snake turns besides, per metre of path, is measured as well and
counted as a disturbance, which takes up what the footprint has wrong.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from operator import itemgetter

import numpy as np

from srs_twin.planning.footprint import Footprint
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
