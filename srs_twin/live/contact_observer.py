r"""Disturbance observer that estimates a contact force from pressures and bends.

The external moment M_j deflects segment j with the bending stiffness k. The bend q_j
is the sum of the rest bend b_j, the free bend φ_j(p) due to the pressures p, and this
deflection:

$$ q_j = b_j + \varphi_j(p) + M_j/k . $$

In a steady gait, all terms are periodic, and the observer learns the means of q_j and
φ_j for each phase of the gait. Subtracting these means cancels sensor offsets,
differences between modules, and the moments exerted by the floor. The deviation

$$ e_j = (q_j - \bar q_j) - (\varphi_j - \bar\varphi_j) $$

is the moment due to the contact divided by k. The free bends are computed from measured
pressures, so supply pressure drift and air compression during a contact do not affect
the deviation.

**Detection.** At the beginning of a contact, the contact moments are proportional to
the contact force F. For each contact position on a grid, F is fitted to the deviations
in a time window by weighted least squares. The score of a position is the magnitude of
the fitted force divided by its standard deviation. A contact is detected if the maximum
score exceeds a threshold.

**Estimation.** A contact force comparable to the floor friction moves and turns the
snake, which changes the friction forces and causes inertial forces. `PushedBody`
predicts this motion for hypotheses about the position, the force and the start of the
contact. The estimated force is the posterior mean at the most probable position. To
account for model errors, the noise variance is multiplied by the mean squared residual
of the best hypothesis. While the score is high, the learnt means are not updated.

**Limits.** A force along the body is not observable. Two simultaneous contacts are
estimated as one contact. The force is assumed to be constant during a contact.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.live.pushed_body import PushedBody
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.robot.spec import GRAVITY, RobotSpec

# The times below are multiplied by the time unit of the robot (`robot.scale`).
WINDOW_S = 0.3
"""Duration of the time window from which the score is computed, s."""
SETTLING_S = 2.0
"""Duration of the initial transient of a gait, which is excluded from learning, s."""
LEARNING_S = 10.0
"""Duration of crawling without contact that precedes the first estimate, s."""
THRESHOLD = 6.0
"""Score above which a contact is detected.

The value was tuned with `benchmarks/contact_estimate.py` (random seeds above 999).
"""
COVERAGE = 0.9
"""Nominal probability that a force or position interval contains the true value."""
_LEARNING_SCORE = 4.0
"""Score above which contact hypotheses are compared and the means are not updated."""
_MEMORY = 20
"""Number of gait periods over which the bends and free bends are averaged."""
_RESOLUTION = 1e-12
"""Lower limit of the deviation variance, which applies to exact readings, rad²."""
_SAME_COMMAND = 0.1
"""Minimum deviation of a duty from its mean that indicates a changed gait."""
_STATIONS_PER_SEGMENT = 8
_FILTER_S = 0.09
"""Time constant of the low-pass filter that suppresses segment oscillations, s."""
_ONSET_S = 0.3
"""Maximum time between the start of a contact and the comparison of hypotheses, s."""
_ONSET_STEP_S = 0.06
"""Difference between the contact start times of neighbouring hypotheses, s."""
_LEAST_FORCE = 0.25
"""Smallest hypothetical contact force as a multiple of the maximum floor friction."""
_FORCE_RATIO = 1.3
"""Ratio between neighbouring values of the hypothetical contact force."""
_POWERS = np.arange(12)
_PRUNED = 25.0
"""Cost difference from the best hypothesis above which a hypothesis is dropped."""
_CORRELATION = 2.0
"""Factor on the noise variance that accounts for time-correlated model errors."""


class CredibleInterval(NamedTuple):
    """Interval that contains the true value with probability `COVERAGE`."""

    low: float = math.nan
    high: float = math.nan


@dataclass(frozen=True)
class ContactEstimate:
    """Estimated contact of the snake with an obstacle.

    If no contact is detected, the force and the position are NaN.

    Attributes:
        touched: whether a contact is detected.
        score: maximum ratio of a fitted force to its standard deviation, dimensionless.
        force: contact force normal to the body, positive to the left, N.
        force_interval: credible interval of the force, N.
        place: distance from the first connector to the contact, measured backwards
            along the body, m.
        place_interval: credible interval of `place`, m.
    """

    touched: bool
    score: float
    force: float = math.nan
    force_interval: CredibleInterval = CredibleInterval()
    place: float = math.nan
    place_interval: CredibleInterval = CredibleInterval()


@dataclass(frozen=True)
class Hypotheses:
    """Hypothetical contacts, with the predicted motion and the cost of each hypothesis.

    Attributes:
        station: index of the contact position in the grid, shape (hypotheses,).
        force: contact force, shape (hypotheses,), N.
        velocity: body velocities as in `PushedBody`, shape (hypotheses, 3).
        bend: low-pass filtered prediction of the bend deviation, shape (hypotheses,
            segments), rad.
        cost: sum of squared residuals divided by the noise variance, shape
            (hypotheses,).
        compared: number of samples that contribute to the cost.
    """

    station: np.ndarray
    force: np.ndarray
    velocity: np.ndarray
    bend: np.ndarray
    cost: np.ndarray
    compared: int = 0

    @classmethod
    def none(cls, segments: int) -> Hypotheses:
        """Return an empty set of hypotheses."""
        return cls(
            np.zeros(0, dtype=int),
            np.zeros(0),
            np.zeros((0, 3)),
            np.zeros((0, segments)),
            np.zeros(0),
        )

    def joined(self, other: Hypotheses) -> Hypotheses:
        """Concatenate two sets of hypotheses."""
        arrays = {
            name: np.concatenate([getattr(self, name), getattr(other, name)])
            for name in _OF_EACH
        }
        return Hypotheses(**arrays, compared=self.compared)

    def inflation(self, independent: float) -> float:
        """Return the factor by which model errors increase the noise variance.

        The factor is the mean squared normalised residual of the best hypothesis, but
        at least 1.

        Args:
            independent: number of independent values per sample.
        """
        return max(float(self.cost.min()) / max(self.compared * independent, 1.0), 1.0)

    def pruned(self, limit: float) -> Hypotheses:
        """Return the hypotheses whose cost exceeds the minimum by at most `limit`."""
        kept = self.cost <= self.cost.min() + limit
        return replace(self, **{name: getattr(self, name)[kept] for name in _OF_EACH})


_OF_EACH = ("station", "force", "velocity", "bend", "cost")
"""Attributes of `Hypotheses` with one row per hypothesis."""

# The rows of a sample contain the bends, the free bends and the commands.
_BEND = 0
_FREE = 1
_COMMANDS = slice(2, None)


def _deviation(sample: np.ndarray, mean: np.ndarray) -> np.ndarray:
    return np.asarray(sample[_BEND] - mean[_BEND] - sample[_FREE] + mean[_FREE])


class _Fit(NamedTuple):
    moment: np.ndarray
    information: np.ndarray


class _Gait(NamedTuple):
    shape: np.ndarray
    body: PushedBody
    patterns: np.ndarray


class ContactObserver(Stateful):
    """Observer of the contact force on a snake that crawls in a periodic gait."""

    state_attributes = (
        "period",
        "_samples",
        "_changed",
        "_bins",
        "_sums",
        "_count",
        "_variance",
        "_window",
        "_shape",
        "_filtered",
        "_recent",
        "_hypotheses",
    )

    def __init__(self, spec: RobotSpec, sample_s: float, period: int = 0) -> None:
        """Create an observer without learnt means.

        Args:
            spec: robot specification.
            sample_s: time between samples, s.
            period: period of the commands in samples, or 0 if the period is not known.

        Raises:
            InputError: the robot has fewer than two segments.
        """
        if spec.segments < 2:
            raise InputError("contact estimates need a robot with two or more segments")
        self._spec = spec
        self._sample = sample_s
        g = spec.geometry
        in_samples = spec.scale.time / sample_s
        self.stations = np.linspace(
            0.0, g.body_length, _STATIONS_PER_SEGMENT * spec.segments + 1
        )
        self._length = max(round(WINDOW_S * in_samples), 1)
        self._settled = round(SETTLING_S * in_samples)
        self._learnt = round((SETTLING_S + LEARNING_S) * in_samples)
        self._past = max(round(_ONSET_S * in_samples), 1)
        self._onset_step = max(round(_ONSET_STEP_S * in_samples), 1)
        self._gain = 1 - math.exp(-1 / (_FILTER_S * in_samples))
        # A first-order filter with gain g reduces the number of independent values and
        # the variance of white noise by the factor g/(2 - g).
        self._independent = spec.segments * self._gain / (2 - self._gain)
        self._friction = spec.friction.mu_n * spec.mass.total * GRAVITY
        self.set_period(period)

    def set_period(self, period: int) -> None:
        """Set the period of the commands in samples, and discard the learnt means."""
        n = self._spec.segments
        self.period = period
        self._samples = 0
        self._count = 0
        self._changed = 0
        self._bins = np.zeros(max(period, 1), dtype=int)
        self._sums = np.zeros((max(period, 1), 4, n))
        self._variance = np.zeros(n)
        self._filtered = np.zeros(n)
        self._window: deque[_Fit] = deque(maxlen=self._length)
        # The last filtered deviations are stored, because a contact begins before the
        # score increases.
        self._recent: deque[np.ndarray | None] = deque(maxlen=self._past + 1)
        self._shape = np.zeros((0, n))
        self._gait: _Gait | None = None
        self._hypotheses: Hypotheses | None = None

    def skip(self, samples: int) -> None:
        """Advance by a number of missing samples."""
        for _ in range(min(samples, self._past + 1)):
            self._samples += 1
            self._compare(None)
        self._samples += max(samples - self._past - 1, 0)

    def update(
        self, command: np.ndarray, pressure: np.ndarray, measured_bend: np.ndarray
    ) -> ContactEstimate | None:
        """Process one sample.

        Args:
            command: mean valve states since the last sample, shape (segments, 2).
            pressure: measured gauge pressures, shape (segments, 2), Pa.
            measured_bend: bend readings, shape (segments,), rad, with NaN for missing
                readings.

        Returns:
            Contact estimate, or None if too few samples have been learnt, a measurement
            is missing, or the command differs from the learnt gait.
        """
        if not self.period:
            return None
        k = self._samples % self.period
        self._samples += 1
        if self._samples < self._settled:
            return None
        free = air_bend(self._spec, np.asarray(pressure, dtype=float))
        mean = self._sums[k]
        known = self._bins[k]
        change = np.abs(np.asarray(command).T - mean[_COMMANDS]).max()
        if known and change > _SAME_COMMAND:
            self._changed += 1
            if self._changed > self.period // 2:
                self.set_period(self.period)  # The gait has changed.
            self._compare(None)
            return None
        self._changed = 0
        if not np.isfinite(measured_bend).all() or not np.isfinite(free).all():
            self._compare(None)
            return None
        sample = np.stack([measured_bend, free, *np.asarray(command, dtype=float).T])
        # Half of the samples are sufficient to estimate the variance.
        learnt = self._bins.all() and self._count >= (self._learnt - self._settled) / 2
        estimate = None
        if learnt and self._samples >= self._learnt:
            estimate = self._estimate(sample, k)
        if estimate is None or estimate.score < _LEARNING_SCORE:
            self._learn(sample, k)
        if len(self._window) == self._length:
            return estimate
        return None

    def _learn(self, sample: np.ndarray, k: int) -> None:
        mean = self._sums[k]
        known = self._bins[k]
        if known:
            error = _deviation(sample, mean) * math.sqrt(known / (known + 1))
            self._count += 1
            weight = 1 / min(self._count, self._learnt - self._settled)
            excess = error**2 + _RESOLUTION - self._variance
            self._variance = self._variance + excess * weight
        self._bins[k] = min(known + 1, _MEMORY)
        mean += (sample - mean) / self._bins[k]

    def _learnt_gait(self) -> _Gait:
        if not len(self._shape):
            self._shape = self._sums[:, _BEND].copy()
        if self._gait is None or self._gait.shape is not self._shape:
            body = PushedBody(self._spec, self._shape, self._sample, self.stations)
            self._gait = _Gait(self._shape, body, self._patterns(body))
        return self._gait

    def _patterns(self, body: PushedBody) -> np.ndarray:
        count = len(self.stations)
        station = np.tile(np.arange(count), 2)
        force = np.repeat([self._friction, -self._friction], count)
        torque = force[:, None] * self._spec.bending.stiffness
        patterns = []
        for k in range(self.period):
            velocity = np.tile(body.free_velocity[k - 1], (2 * count, 1))
            _, moment = body.step(k, velocity, force, station)
            per_force = (moment - body.free_moment[k]) / torque
            patterns.append(per_force.reshape(2, count, -1).mean(axis=0))
        return np.array(patterns)

    def _estimate(self, sample: np.ndarray, k: int) -> ContactEstimate:
        mean = self._sums[k]
        # A mean of n samples increases the variance of the deviation by a factor of
        # 1 + 1/n.
        fraction = math.sqrt(self._bins[k] / (self._bins[k] + 1))
        error = _deviation(sample, mean)
        pattern = self._learnt_gait().patterns[k]
        weighted = pattern * fraction**2 / self._variance
        self._window.append(_Fit(weighted @ error, (weighted * pattern).sum(axis=1)))
        moment = np.sum([fit.moment for fit in self._window], axis=0)
        information = np.sum([fit.information for fit in self._window], axis=0)
        # The fitted force is moment/information, and its variance is 1/information.
        score = float(np.abs(moment / np.sqrt(information)).max())
        self._filtered = self._filtered + self._gain * (error - self._filtered)
        suspect = score >= _LEARNING_SCORE
        if not suspect:
            self._hypotheses = None
        self._compare(self._filtered)
        if suspect and self._hypotheses is None and len(self._recent) > self._past:
            self._start()
        if score > THRESHOLD and self._hypotheses is not None:
            return self._contact(score, self._hypotheses)
        return ContactEstimate(touched=False, score=score)

    def _compare(self, filtered: np.ndarray | None) -> None:
        self._recent.append(filtered)
        if self._hypotheses is not None:
            last = self._samples - 1
            self._hypotheses = self._compared(self._hypotheses, last, filtered)

    def _start(self) -> None:
        first = self._samples - len(self._recent)
        size = self._friction * _LEAST_FORCE * _FORCE_RATIO**_POWERS
        sizes = np.concatenate([size, -size])
        station = np.repeat(np.arange(len(self.stations)), len(sizes))
        force = np.tile(sizes, len(self.stations))
        nothing = np.zeros((len(force), self._spec.segments))
        now = Hypotheses.none(self._spec.segments)
        cost_before = 0.0
        for i, filtered in enumerate(self._recent):
            if i % self._onset_step == 0:
                free = self._learnt_gait().body.free_velocity
                start = free[(first + i - 1) % self.period]
                velocity = np.tile(start, (len(force), 1))
                cost = np.full(len(force), cost_before)
                now = now.joined(Hypotheses(station, force, velocity, nothing, cost))
            if filtered is not None:
                cost_before += float((filtered**2 / self._variance).sum())
            now = self._compared(now, first + i, filtered)
        self._hypotheses = now

    def _compared(
        self, now: Hypotheses, i: int, filtered: np.ndarray | None
    ) -> Hypotheses:
        body = self._learnt_gait().body
        velocity, moment = body.step(i, now.velocity, now.force, now.station)
        if filtered is None:
            return replace(now, velocity=velocity)
        excess = moment - body.free_moment[i % self.period]
        bend = excess / self._spec.bending.stiffness
        bend = now.bend + self._gain * (bend - now.bend)
        cost = now.cost + ((filtered - bend) ** 2 / self._variance).sum(axis=1)
        later = replace(
            now, velocity=velocity, bend=bend, cost=cost, compared=now.compared + 1
        )
        return later.pruned(_PRUNED * later.inflation(self._independent))

    def _contact(self, score: float, now: Hypotheses) -> ContactEstimate:
        # The likelihoods for the intervals are wider than the likelihoods for the mean,
        # because model errors are correlated in time.
        variance = 2 * now.inflation(self._independent)
        weight = np.exp((now.cost.min() - now.cost) / variance)
        best = int(now.cost.argmin())
        same = (now.station == now.station[best]) & (now.force * now.force[best] > 0)
        wide = np.exp((now.cost.min() - now.cost) / (_CORRELATION * variance))
        # The intervals are widened by the grid spacing of the hypotheses.
        step = self._spec.geometry.pitch / _STATIONS_PER_SEGMENT
        places = _interval(self.stations[now.station], wide)
        ratio = math.sqrt(_FORCE_RATIO)
        low, high = _interval(now.force, wide)
        low *= ratio if low < 0 else 1 / ratio
        high *= ratio if high > 0 else 1 / ratio
        return ContactEstimate(
            touched=True,
            score=score,
            force=float((weight * now.force)[same].sum() / weight[same].sum()),
            force_interval=CredibleInterval(low, high),
            place=float(self.stations[now.station[best]]),
            place_interval=CredibleInterval(places.low - step, places.high + step),
        )


def _interval(values: np.ndarray, weight: np.ndarray) -> CredibleInterval:
    order = np.argsort(values)
    fraction = np.cumsum(weight[order]) / weight.sum()
    low, high = np.searchsorted(fraction, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    last = min(high, len(values) - 1)
    return CredibleInterval(float(values[order[low]]), float(values[order[last]]))
