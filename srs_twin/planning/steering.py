r"""Steering laws for path following, and a Smith predictor of the pose.

The mean pose over a gait period T lags by T/2, and a command takes effect after a
delay. The predictor therefore extrapolates the mean pose with a unicycle model. The
model's curvature κ approaches the footprint's curvature at the commanded offset φ with
a first-order response over the path length ℓ (`Footprint.response_length`):

$$ \frac{dκ}{ds} = \frac{κ_{footprint}(φ) - κ}{ℓ}, \qquad \dot θ = v (g κ + d) . $$

Here, θ is the heading and v is the measured speed. A snake with unequal modules does
not turn exactly as its footprint predicts. A Kalman filter estimates this deviation as
a gain g and a disturbance d (1/m).

`WaypointSteering` is the steering law of Section 5.2.2, which steers from node to node
along the path. Up to a limit, the offset is proportional to the bearing of the next
node minus the heading. When the distance from this node falls below a threshold, the
snake steers towards the following node.

`PathTracking` is a steering law that is not in the dissertation. Let n be the
cross-track error and e the heading error, both predicted for the time at which the
command takes effect. The curvature

$$ κ = \frac{κ_{plan}(s + ℓ)}{1 - κ_{plan} n}
   - \frac{2ζ}{L}\,\bigl(1 + ℓ\tfrac{d}{ds}\bigr)(e - e_n) - d,
   \qquad e_n = -\operatorname{clip}\Bigl(\frac{n}{2ζL}\Bigr) $$

reduces n over the path length L like a second-order system with a damping ratio ζ. To
compensate for the response length ℓ, the planned curvature is evaluated at s + ℓ, and
the derivative of the heading error is added. This derivative is computed with the
model, so it contains no measurement noise. The offset is interpolated from the
footprint at the curvature κ/g.
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
from srs_twin.planning.path import PathPoint, ReferencePath
from srs_twin.robot.world import Pose

_SPEED_LIMITS = (0.2, 5.0)
"""Limits of the measured speed, relative to the footprint's speed."""

_MAX_DISTURBANCE_FRACTION = 0.5
"""Limit of the estimated disturbance, relative to the tightest curvature."""
_GAIN_LIMITS = (0.4, 2.5)
"""Limits of the estimated gain."""

_PRIOR_STD = np.array([0.2, 0.3])
"""Initial standard deviations of d (relative to the tightest curvature) and of g."""
_WALK_STD = np.array([0.1, 0.1])
"""Standard deviations of the random walks of d (relative to the tightest curvature)
and of g, per √(gait period).
"""
_CURVATURE_STD = 0.02
"""Standard deviation of the curvature that is measured over a gait period, relative to
the tightest curvature.
"""

_HISTORY_PERIODS = 2.5
"""Duration of the stored model history, in gait periods."""

_Sample = tuple[float, ...]
"""Sample with time (s), x, y (m) and heading (rad).

Samples of the model also contain the total heading change that the footprint predicts
(rad).
"""
_time = itemgetter(0)


class Predictor(Stateful):
    """Smith predictor of the pose, with estimates of speed, gain and disturbance.

    Attributes:
        speed: measured speed, which is initially the speed of the footprint, m/s.
        disturbance: estimated disturbance d, 1/m.
        gain: estimated gain g.
        curvature: current curvature of the model, 1/m.
        moved: displacement of the mean position over the last gait period, m, or None
            during the first period.
    """

    state_attributes = (
        "speed",
        "disturbance",
        "gain",
        "curvature",
        "moved",
        "_covariance",
        "_updated",
        "_model",
        "_means",
    )

    def __init__(
        self, footprint: Footprint, period: float, delay: float, response_length: float
    ) -> None:
        """Initialise with the period (s), command delay (s) and response length (m)."""
        self._offsets = np.array(footprint.offsets)
        self._curvatures = np.array(footprint.curvatures)
        self._period = period
        self._delay = delay
        self._response_length = response_length
        self._tightest = min(footprint.tightest)
        self._nominal = self.speed = float(
            np.interp(0.0, footprint.offsets, footprint.speeds)
        )
        self.curvature = 0.0
        self._scale = np.array([self._tightest, 1.0])
        self.reset_turning()
        self.moved: float | None = None
        self._updated = 0.0
        self._model: list[_Sample] = [(0.0, 0.0, 0.0, 0.0, 0.0)]
        self._means: list[_Sample] = []

    def reset_turning(self) -> None:
        """Discard the estimates of gain and disturbance."""
        self.disturbance = 0.0
        self.gain = 1.0
        self._covariance = np.diag((_PRIOR_STD * self._scale) ** 2)

    @property
    def turning(self) -> float:
        """Predicted path curvature when a command sent now takes effect, 1/m."""
        return self.gain * self.curvature + self.disturbance

    def command(self, time: float, offset: float) -> None:
        """Advance the model to a time (s) at a constant commanded offset."""
        before, x, y, heading, total_turn = self._model[-1]
        step = time - before
        if step <= 0:
            return
        final = float(np.interp(offset, self._offsets, self._curvatures))
        length = self.speed * step
        # The equation dκ/ds = (κ_final - κ)/ℓ has an exponential solution.
        if self._response_length > 0:
            decay = math.exp(-length / self._response_length)
        else:
            decay = 0.0
        mean = final + (self.curvature - final) * (
            decay if self._response_length > 0 else 1.0
        )
        self.curvature = final + (self.curvature - final) * decay
        nominal_turn = length * (mean + self.curvature) / 2
        turn = self.gain * nominal_turn + length * self.disturbance
        # The position of the unicycle is integrated with the midpoint rule.
        middle = heading + turn / 2
        x = x + length * math.cos(middle)
        y = y + length * math.sin(middle)
        self._model.append((time, x, y, heading + turn, total_turn + nominal_turn))
        _drop_before(self._model, time - _HISTORY_PERIODS * self._period - self._delay)

    def measure(self, time: float, middle: float, mean: Pose, *, whole: bool) -> None:
        """Update the estimates of speed, gain and disturbance with a mean pose.

        Args:
            time: current time, s.
            middle: midpoint of the averaging interval, s.
            mean: mean pose.
            whole: whether the averaging interval covers a whole gait period. If not,
                the estimates are not updated.
        """
        means = self._means
        means.append((middle, mean.x, mean.y, mean.heading))
        if not whole:
            self._updated = time
            return
        since = middle - self._period
        k = bisect_right(means, since, key=_time) - 1
        if k < 0:
            return
        begin, x, y, heading = means[k]
        _drop_before(means, since)
        self.moved = math.hypot(mean.x - x, mean.y - y)
        duration = middle - begin
        low, high = (fraction * self._nominal for fraction in _SPEED_LIMITS)
        self.speed = min(max(self.moved / duration, low), high)
        # The nominal turn is the heading change that the footprint predicts for the
        # interval between the two mean poses.
        nominal = self._at(middle)[4] - self._at(begin)[4]
        length = max(self.moved, 1e-6 + low * duration)
        periods = (time - self._updated) / self._period
        self._update_turning(
            (mean.heading - heading) / length, nominal / length, periods
        )
        self._updated = time

    def _update_turning(self, measured: float, nominal: float, periods: float) -> None:
        """Update gain and disturbance by a Kalman filter with measured = d + g nominal.

        `measured` and `nominal` are the measured curvature and the footprint's
        curvature (1/m). `periods` is the number of gait periods since the last update.
        """
        if periods <= 0:
            return
        self._covariance += np.diag((_WALK_STD * self._scale) ** 2 * periods)
        # The observation matrix contains the derivatives of the measured curvature with
        # respect to d and g.
        row = np.array([1.0, nominal])
        # The averaging intervals of successive frames overlap, so all frames of one
        # period together count as one measurement.
        cross = self._covariance @ row
        weights = cross / (
            row @ cross + (_CURVATURE_STD * self._tightest) ** 2 / periods
        )
        innovation = measured - self.disturbance - self.gain * nominal
        limit = _MAX_DISTURBANCE_FRACTION * self._tightest
        self.disturbance = min(
            max(self.disturbance + float(weights[0]) * innovation, -limit), limit
        )
        self.gain = min(
            max(self.gain + float(weights[1]) * innovation, _GAIN_LIMITS[0]),
            _GAIN_LIMITS[1],
        )
        self._covariance -= np.outer(weights, cross)

    def predict(self, middle: float, mean: Pose, time: float) -> Pose:
        """Predict the pose at a time from the mean pose at an earlier time.

        Args:
            middle: time of the mean pose, s.
            mean: mean pose.
            time: time of the prediction, at most the command delay after the current
                time, s.
        """
        # The motion of the model since that earlier time is rotated into the frame of
        # the mean pose.
        _, x0, y0, heading0, _ = self._at(middle)
        _, x, y, heading, _ = self._at(time)
        turn = mean.heading - heading0
        c = math.cos(turn)
        s = math.sin(turn)
        dx = x - x0
        dy = y - y0
        return Pose(mean.x + c * dx - s * dy, mean.y + s * dx + c * dy, heading + turn)

    def _at(self, time: float) -> _Sample:
        """Return the model sample that the snake reaches at a time (s)."""
        # The model leads the snake by the command delay.
        time -= self._delay
        model = self._model
        k = bisect_right(model, time, key=_time)
        if k in (0, len(model)):
            return model[0 if k == 0 else -1]
        before = np.array(model[k - 1])
        after = np.array(model[k])
        fraction = (time - before[0]) / (after[0] - before[0])
        return tuple(before + fraction * (after - before))


def _drop_before(samples: list[_Sample], before: float) -> None:
    """Delete samples before a time (s) once they make up more than half of the list.

    The last sample before this time is kept.
    """
    old = bisect_right(samples, before, key=_time) - 1
    if 2 * old > len(samples):
        del samples[:old]


DAMPING = 1.0
"""Damping ratio ζ of the cross-track error, set to critical damping."""
_MAX_APPROACH = 0.7
"""Maximum angle at which the snake returns to the path, rad."""


@dataclass(frozen=True)
class SteeringInput:
    """Input of a steering law.

    Attributes:
        pose: predicted pose, or the mean pose over a gait period if the law uses no
            prediction.
        place: path coordinates of the pose.
        curvature: predicted path curvature (`Predictor.turning`), 1/m.
        disturbance, gain: disturbance d (1/m) and gain g, as estimated by the
            `Predictor`.
    """

    pose: Pose
    place: PathPoint
    curvature: float
    disturbance: float
    gain: float = 1.0


class Steering(Stateful, ABC):
    """Base class of steering laws.

    Attributes:
        predicts: whether the law needs the predicted pose instead of the mean pose.
        node: index of the next node (`WaypointSteering`) or number of passed segments
            of the plan (`PathTracking`).
    """

    state_attributes = ("node",)

    predicts: bool
    node: int = 0

    @abstractmethod
    def begin(self, path: ReferencePath) -> None:
        """Initialise the law for a new path."""

    @abstractmethod
    def offset(self, state: SteeringInput) -> float:
        """Return the desired offset, which may exceed the limits of the gait."""

    def predict_cross_track(
        self, n: float, heading_error: float, distance: float
    ) -> float:
        """Return the expected cross-track error farther along the path, m.

        Args:
            n: current cross-track error, m.
            heading_error: current heading relative to the path, rad.
            distance: distance ahead along the path, m.
        """
        return n + heading_error * distance


class WaypointSteering(Steering):
    """Steering law of the dissertation, which steers from node to node."""

    predicts = False

    def __init__(self, gain: float = 0.6, node: float = 0.2, near: float = 0.2) -> None:
        """Set the parameters, whose defaults are explained in docs/course.md.

        Args:
            gain: offset per bearing error, 1/rad.
            node: distance between nodes along the path, m. The last node is the end of
                the path.
            near: distance below which a node is considered reached, m.
        """
        self._gain = gain
        self._spacing = node
        self._near = near

    def begin(self, path: ReferencePath) -> None:
        """See `Steering.begin`."""
        count = max(1, math.ceil(path.length / self._spacing - 1e-9))
        self._nodes = [
            path.pose(min(k * self._spacing, path.length)) for k in range(1, count + 1)
        ]
        self.node = 0

    def offset(self, state: SteeringInput) -> float:
        """See `Steering.offset`."""
        x = state.pose.x
        y = state.pose.y
        heading = state.pose.heading
        node = self._nodes[self.node]
        while (
            node is not self._nodes[-1]
            and math.hypot(node.x - x, node.y - y) <= self._near
        ):
            self.node += 1
            node = self._nodes[self.node]
        bearing = math.atan2(node.y - y, node.x - x)
        return self._gain * math.remainder(bearing - heading, 2 * math.pi)


class PathTracking(Steering):
    """Steering law with cross-track and heading feedback and curvature feedforward."""

    predicts = True

    def __init__(
        self,
        footprint: Footprint,
        lookahead: float = 0.15,
        response_length: float = 0.05,
    ) -> None:
        """Set the parameters.

        Args:
            footprint: footprint from which the offset is interpolated.
            lookahead: path length L over which a cross-track error decays, m.
            response_length: response length ℓ, m.
        """
        self._offsets = np.array(footprint.offsets)
        self._curvatures = np.array(footprint.curvatures)
        self._length = lookahead
        self._response_length = response_length

    def begin(self, path: ReferencePath) -> None:
        """See `Steering.begin`."""
        self._path = path
        self.node = 0

    def offset(self, state: SteeringInput) -> float:
        """See `Steering.offset`."""
        s, n, heading, _ = state.place
        while (
            self.node < len(self._path.arcs) - 2
            and s > self._path.arcs[self.node + 1, 4]
        ):
            self.node += 1
        ahead = self._path.curvature(s + self._response_length)
        error = math.remainder(state.pose.heading - heading, 2 * math.pi)
        # The approach angle e_n is the desired heading relative to the path.
        approach = -min(
            max(n / (2 * DAMPING * self._length), -_MAX_APPROACH), _MAX_APPROACH
        )
        # The derivative of the heading error along the path is computed with the model,
        # because differences of measurements are noisy.
        rate = (
            state.curvature
            - state.place.curvature
            + math.sin(error) / (2 * DAMPING * self._length)
        )
        feedback = (
            2
            * DAMPING
            / self._length
            * (error - approach + self._response_length * rate)
        )
        # The minimum of the denominator avoids a division by 0 at the centre of
        # curvature.
        curvature = ahead / max(1 - ahead * n, 0.5) - feedback - state.disturbance
        return float(np.interp(curvature / state.gain, self._curvatures, self._offsets))

    def predict_cross_track(
        self, n: float, heading_error: float, distance: float
    ) -> float:
        """See `Steering.predict_cross_track`.

        The result is the solution of the closed-loop equation n'' = −2 n'/L − n/L² for
        ζ = 1.
        """
        return (n + (n / self._length + heading_error) * distance) * math.exp(
            -distance / self._length
        )
