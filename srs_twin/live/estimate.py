"""Estimates and predictions of a live twin, with calibrated uncertainty intervals."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from srs_twin.live.commands import SLOT_S, CommandPeriod
from srs_twin.live.contact_observer import ContactEstimate, ContactObserver
from srs_twin.live.messages import BENDS, PRESSURES, VALVES, Message
from srs_twin.live.uncertain import Estimates
from srs_twin.plants.base import SnakeState
from srs_twin.robot.spec import RobotSpec


class DetectedFault(NamedTuple):
    """Detected fault of one part of the robot.

    Attributes:
        part: faulty part of the robot, for example "segment 2", "connector 1" or
            "supply".
        probability: probability that the part has a fault.
    """

    part: str
    name: str
    probability: float


@dataclass(frozen=True)
class Estimate:
    """Estimated state of a robot, with standard deviations.

    Attributes:
        time: time on the local clock to which the state is predicted, s.
        bend: bend of each segment, rad.
        bend_sd: standard deviation of each bend, rad.
        pose: position x, y (m) of the centre of mass, and mean heading (rad).
        pose_sd: standard deviation of the pose (m, m, rad).
        velocity: velocity of the centre of mass in the world frame (m/s), and yaw rate
            (rad/s).
        connectors: position x, y (m) and heading (rad) of each connector, shape
            (connectors, 3).
        parameters: estimated module parameters, keyed by name. The parameter "gain" is
            the gain of each chamber relative to the robot file, and "bias_rad" is the
            bend (rad) of each module without pressure.
        off: RMS innovation of the last message of each kind, in standard deviations.
        lost: reason why the position is unknown, or an empty string if the position is
            known.
    """

    time: float
    bend: np.ndarray
    bend_sd: np.ndarray
    pose: np.ndarray
    pose_sd: np.ndarray
    velocity: np.ndarray
    connectors: np.ndarray
    parameters: Mapping[str, Estimates]
    faults: tuple[DetectedFault, ...]
    off: Mapping[str, float]
    lost: str

    def state(self, time: float, pressure: np.ndarray) -> SnakeState:
        """Return the state for a controller at a time (s) on the controller's clock.

        The state contains the given gauge pressures (Pa). Quantities that are not
        estimated are 0.
        """
        n = len(self.connectors)
        still = np.zeros_like(self.bend)
        return SnakeState(
            time=np.float64(time),
            com=self.pose[:2],
            com_velocity=self.velocity[:2],
            heading=self.pose[2],
            position=self.connectors[:, :2],
            connector_heading=self.connectors[:, 2],
            bend=self.bend,
            bend_rate=still,
            pressure=pressure,
            valves=np.zeros_like(pressure, dtype=np.int8),
            measured_bend=self.bend,
            contact_force=np.zeros((n, 2)),
            obstacle_force=np.zeros((n, 2)),
            torque=still,
            work=np.float64(0.0),
            internal_loss=np.float64(0.0),
            pneumatic_energy=np.float64(0.0),
            qpos=np.empty(0),
        )


_MEMORY = 8
"""Number of predictions over which the squared error is averaged."""
_ADAPTATION_RATE = 5.0
"""Adaptation rate r of the interval scales, 1/s."""
_LONGEST_COMPARED_S = 0.2
"""Maximum time step with which one comparison adapts an interval scale, s."""
_LEAST_SQUARE = 0.1
"""Lower limit of the squared interval scales."""
_LARGEST_SQUARE = 10.0
"""Upper limit of the squared interval scales."""
_T95 = 2.1
"""Half-width of a 95 % prediction interval, in standard deviations.

The half-width exceeds 1.96, because the standard deviation is estimated from few
predictions."""


@dataclass(frozen=True)
class Prediction:
    """Predicted path of a robot whose commands are periodic or constant.

    Attributes:
        begun: start of the prediction on the local clock, s.
        heading: mean heading at the start, rad.
        time: times of the poses on the local clock, shape (times,), s.
        pose: position x, y (m) and mean heading (rad), shape (times, 3).
        pose_sd: standard deviations along the initial heading (m), across the initial
            heading (m) and in heading (rad), shape (times, 3).
    """

    begun: float
    heading: float
    time: np.ndarray
    pose: np.ndarray
    pose_sd: np.ndarray

    def error(self, poses: np.ndarray) -> np.ndarray:
        """Return the measured minus the predicted poses, with columns as in `pose_sd`.

        The measured poses have shape (times, 3), with x, y (m) and heading (rad).
        """
        c = math.cos(self.heading)
        s = math.sin(self.heading)
        x, y, turn = (poses - self.pose).T
        return np.column_stack([c * x + s * y, c * y - s * x, turn])

    def contains(self, poses: np.ndarray) -> np.ndarray:
        """Return whether poses lie in the 95 % intervals, shape (times, 3)."""
        return np.asarray(np.abs(self.error(poses)) <= _T95 * self.pose_sd)


class PredictionCalibration:
    """Calibration of prediction intervals from the errors of earlier predictions."""

    def __init__(self) -> None:
        self._error = self._stated = np.zeros(3)
        self._count = 0
        self._open: deque[Prediction] = deque(maxlen=20)
        self._path: deque[np.ndarray] = deque(maxlen=200)

    def observe(self, time: float, pose: np.ndarray) -> None:
        """Compare earlier predictions with the pose (m, m, rad) at a given time (s)."""
        self._path.append(np.append(time, pose))
        while self._open and self._open[0].time[-1] <= time:
            past = self._open.popleft()
            times, *columns = np.array(self._path).T
            if times[0] <= past.begun:
                poses = [np.interp(past.time, times, column) for column in columns]
                self._learn(past, past.error(np.column_stack(poses)))

    def _learn(self, past: Prediction, error: np.ndarray) -> None:
        self._count += 1
        weight = max(1 / _MEMORY, 1 / self._count)
        self._error = self._error + weight * (error**2 - self._error)
        self._stated = self._stated + weight * (past.pose_sd**2 - self._stated)

    def inflate(self, raw: Prediction) -> Prediction:
        """Widen the intervals of a prediction according to earlier errors.

        The method also stores the original prediction for `observe`.
        """
        self._open.append(raw)
        if not self._count:
            return raw
        # The intervals are further widened if the mean squared error is computed from
        # few predictions.
        count = min(self._count, _MEMORY)
        factor = (count + 1) / max(count - 1, 1)
        excess = np.maximum(factor * self._error - self._stated, 0.0)
        return replace(raw, pose_sd=np.sqrt(raw.pose_sd**2 + excess))


class _PredictedState(NamedTuple):
    time: float
    value: np.ndarray
    sd: np.ndarray


class IntervalCalibration:
    r"""Calibration of the standard deviations of predicted states.

    Each prediction is compared with a later estimate that includes measurements from
    the predicted time. Each group of values has a scale s, which is adapted until 95 %
    of the later estimates lie within the predicted intervals:

    $$ \frac{d \ln s^2}{dt} = r \left(\mathrm{fraction}\left[
    (\hat x - x)^2 + \sigma_x^2 > 1.96^2 s^2 \hat\sigma^2\right] - 0.05\right) . $$

    Here r is the adaptation rate. The prediction x̂ has the standard deviation σ̂, and
    the later estimate x has the standard deviation σ_x. The mean squared error is not
    used, because a few very large errors due to lost commands would dominate it.

    While a group of values is not measured, its standard deviation grows. Predictions
    cannot be checked then, so the variance that is added since the last comparison is
    never reduced, and s σ̂ is replaced with the result of `calibrated`.
    """

    def __init__(self, groups: Sequence[int]) -> None:
        """Initialise a scale of 1 for each group with the given numbers of values."""
        self._starts = np.cumsum([0, *groups[:-1]])
        self._counts = np.array(groups)
        self._square = np.ones(len(groups))
        self._compared = np.full(len(groups), -np.inf)
        self._compared_variance = np.full(sum(groups), np.inf)
        self._open: deque[_PredictedState] = deque(maxlen=200)

    @property
    def scale(self) -> np.ndarray:
        """Scale s of each value."""
        return np.repeat(np.sqrt(self._square), self._counts)

    def calibrated(self, sd: np.ndarray) -> np.ndarray:
        """Return calibrated standard deviations for those of a prediction."""
        square = np.repeat(self._square, self._counts)
        compared = np.minimum(sd**2, self._compared_variance)
        added = sd**2 - compared
        return np.asarray(np.sqrt(square * compared + np.maximum(square, 1.0) * added))

    def predict(self, time: float, state: Estimates) -> None:
        """Store the unscaled prediction of the state at a time (s)."""
        self._open.append(_PredictedState(time, *state))

    def update(
        self, time: float, estimate: Estimates, measured: Sequence[bool]
    ) -> None:
        """Compare the stored prediction for a time (s) with a later estimate.

        Only groups of values for which `measured` is true are compared.
        """
        while len(self._open) > 1 and self._open[1].time < time:
            self._open.popleft()
        if len(self._open) < 2 or not self._open[0].time <= time:
            return
        before = self._open[0]
        after = self._open[1]
        weight = (time - before.time) / (after.time - before.time)
        predicted = before.value + weight * (after.value - before.value)
        sd = before.sd + weight * (after.sd - before.sd)
        limit = 1.96 * self.calibrated(sd)
        outside = (predicted - estimate.value) ** 2 + estimate.sd**2 > limit**2
        fraction = np.add.reduceat(outside.astype(float), self._starts) / self._counts
        dt = np.where(
            measured, np.minimum(time - self._compared, _LONGEST_COMPARED_S), 0.0
        )
        self._compared = np.where(measured, time, self._compared)
        self._compared_variance = np.where(
            np.repeat(measured, self._counts), sd**2, self._compared_variance
        )
        square = self._square * np.exp(_ADAPTATION_RATE * dt * (fraction - 0.05))
        self._square = np.clip(square, _LEAST_SQUARE, _LARGEST_SQUARE)


_NEEDED = {BENDS, PRESSURES, VALVES}
"""Kinds of messages that are needed for one sample of the contact observer.

Reported valve states are used instead of commands, because the effect of a lost command
would resemble a contact.
"""

_STEADY_S = 0.5
"""Time for which the estimated command period must be constant before its use, s."""


class LiveContact:
    """Contact estimator for a robot with periodic commands.

    A robot with a single segment has no contact estimates.

    Attributes:
        estimate: contact estimate from the last sample, or None as in
            `ContactObserver.update`.
    """

    def __init__(self, spec: RobotSpec) -> None:
        self._observer = None
        if spec.segments > 1:
            self._observer = ContactObserver(spec, SLOT_S)
        self._sample: int | None = None
        self._period = 0
        self._repeated = 0
        self.estimate: ContactEstimate | None = None

    def update(self, messages: Iterable[Message], commands: CommandPeriod) -> None:
        """Update the contact estimate with messages that have equal sending times."""
        found = {
            message.kind: message for message in messages if message.kind in _NEEDED
        }
        observer = self._observer
        if observer is None or found.keys() != _NEEDED:
            return
        self._update_period(observer, commands.period())
        # The number of a sample is computed from the sending time, so that lost
        # messages do not shift the phase of the gait.
        sample = round(found[BENDS].sent / SLOT_S)
        if self._sample is not None and sample > self._sample:
            observer.skip(sample - self._sample - 1)
        self._sample = sample
        self.estimate = observer.update(
            found[VALVES].values, found[PRESSURES].values, found[BENDS].values
        )

    def _update_period(self, observer: ContactObserver, period: int) -> None:
        if not period:
            return
        self._repeated = self._repeated + 1 if period == self._period else 0
        self._period = period
        if self._repeated * SLOT_S >= _STEADY_S and period != observer.period:
            observer.set_period(period)
