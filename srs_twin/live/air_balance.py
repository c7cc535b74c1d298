r"""Estimates of the supply pressure and of leaks from the air that flows into chambers.

While the valve of a chamber is open, the chamber pressure P and the bend q of the
segment satisfy the air balance

$$ \Delta (P\,V(q)) = c \int \dot n_{in}\,dt - (\lambda_0 + \lambda)\,K \int (P - P_a)\,dt, $$

where V is the chamber volume, ṅ_in the flow through an orifice (`pneumatics/flow.py`),
P_a the ambient pressure and K the capacity of a nominal chamber. A stroke is an
interval in which the valve stays open. The flow factor c and the apparent loss λ₀ of an
intact chamber are estimated from many strokes by linear regression with forgetting. The
scatter between strokes is estimated as well, so that a leak λ can be detected within
one stroke.

All chambers share one supply, whose gauge pressure S is modelled as a random walk. Let
r_i be the measured minus the expected amount of air that flows into chamber i during a
stroke. Let h_i be the derivative of this expected amount with respect to S, and v_i the
error. Then r_i = h_i (S − Ŝ) + v_i. A Kalman filter combines the measurements of all
chambers:

$$ \hat S' = \hat S + \frac{\sum_i w_i h_i r_i / \sigma_i^2}{1/P + \sum_i w_i h_i^2 / \sigma_i^2}. $$

Here σ_i is the standard deviation of v_i, and P is the variance of Ŝ. The weights w_i
of Student's t distribution limit the effect of a chamber that leaks or is stuck. If
most filling chambers indicate the same large change, the estimate adopts the change
immediately.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from srs_twin.io.saved_state import Stateful
from srs_twin.live.fault_hypotheses import Inflow
from srs_twin.live.uncertain import Estimates
from srs_twin.pneumatics.chambers import AMBIENT_PA, volume
from srs_twin.pneumatics.flow import REFERENCE_PA, conductances, flow
from srs_twin.pneumatics.orifice import CRITICAL_RATIO
from srs_twin.robot.spec import RobotSpec

PRIOR_SD = 0.05
"""Initial standard deviation of the supply pressure, fraction of the nominal pressure.
"""
LARGEST_SD = 0.2
"""Maximum standard deviation of the estimate, fraction of the nominal pressure."""
WALK = 0.02
"""Random walk of the supply pressure, fraction of the nominal pressure per √s."""
SENSOR_SD = 0.01
"""Standard deviation of the supply sensor, fraction of the nominal pressure."""
LOW_SUPPLY_FRACTION = 0.6
"""Fraction of the nominal pressure below which `low_supply_pressure` is reported."""
RECOVERED_ABOVE = 0.7
"""Fraction of the nominal pressure above which `low_supply_pressure` is cleared."""
SUDDEN = 0.12
"""Minimum size of a sudden pressure change, fraction of the nominal pressure."""
_SUDDEN_SD = 3.0
"""Minimum median residual of a sudden change, in standard deviations."""
_SURPRISE = 3.0
"""Median change, in standard deviations, above which the variance is increased."""
_AGREE = 3
"""Minimum number of filling chambers from which a median is computed."""
_SUPPLY_TAILS = 4.0
"""Degrees of freedom of Student's t distribution for supply residuals."""
_LOWEST = 0.02
"""Lower limit of the estimated supply pressure, fraction of the nominal pressure."""


class SupplyFilter(Stateful):
    """Kalman filter for the supply pressure. See the module docstring.

    Attributes:
        nominal: nominal gauge pressure, Pa.
        pressure: estimated gauge pressure, Pa.
        variance: variance of the estimate, Pa².
    """

    state_attributes = ("pressure", "variance")

    def __init__(self, nominal: float) -> None:
        """Initialise the estimate with the nominal gauge pressure (Pa)."""
        self.nominal = self.pressure = nominal
        self.variance = (PRIOR_SD * nominal) ** 2

    @property
    def fraction(self) -> float:
        """Estimated pressure as a fraction of the nominal pressure."""
        return self.pressure / self.nominal

    @property
    def sd(self) -> float:
        """Standard deviation of the estimate, Pa."""
        return math.sqrt(self.variance)

    def predict(self, dt: float) -> None:
        """Increase the variance of the estimate over a time step (s)."""
        self.variance = min(
            self.variance + (WALK * self.nominal) ** 2 * dt,
            (LARGEST_SD * self.nominal) ** 2,
        )

    def update(
        self,
        residual: np.ndarray,
        response: np.ndarray,
        sd: np.ndarray,
        weight: np.ndarray,
        repeats: float = 1.0,
    ) -> None:
        """Correct the estimate with measurements of filling chambers.

        Args:
            residual: measured minus expected value of each chamber. Missing
                measurements are NaN.
            response: derivative h of each residual with respect to the supply pressure.
            sd: standard deviation of the error v of each chamber.
            weight: weight of each chamber, from 0 to 1.
            repeats: number of correlated measurements that carry the information of one
                independent measurement.
        """
        there = ~np.isnan(residual) & (weight > 0) & (response > 0)
        if not there.any():
            return
        residual = residual[there]
        response = response[there]
        weight = weight[there]
        variance = sd[there] ** 2
        # If the median indicates a change, outliers are identified by their difference
        # from the median.
        change = 0.0
        if len(residual) >= _AGREE:
            change = float(np.median(residual / response))
            scatter = float(np.median(variance / response**2))
            chance = np.pi / 2 / len(residual) * scatter
            if change**2 > _SURPRISE**2 * (self.variance + chance):
                self.variance += change**2
                # Messages before a sudden change are not correlated with messages after
                # the change.
                repeats = 1.0
        expected = variance + response**2 * self.variance
        square = (residual - response * change) ** 2 / expected
        robust = np.minimum((_SUPPLY_TAILS + 1) / (_SUPPLY_TAILS + square), 1.0)
        information = weight * robust * response / variance / repeats
        self.variance = 1 / (1 / self.variance + float(information @ response))
        self._set(self.pressure + self.variance * float(information @ residual))

    def follow_sudden_change(
        self, residual: np.ndarray, response: np.ndarray, sd: np.ndarray
    ) -> bool:
        """Adopt a sudden change that most chambers indicate.

        Returns:
            Whether a sudden change was detected.
        """
        if len(residual) < _AGREE:
            return False
        change = float(np.median(residual / response))
        deviation = float(np.median(residual / sd))
        if abs(change) < SUDDEN * self.nominal or abs(deviation) < _SUDDEN_SD:
            return False
        self.variance = max(self.variance, (change / 4) ** 2)
        self._set(self.pressure + change)
        return True

    def measure(self, pressure: float) -> None:
        """Correct the estimate with a measured gauge pressure (Pa)."""
        noise = (SENSOR_SD * self.nominal) ** 2
        kalman_gain = self.variance / (self.variance + noise)
        self.variance *= 1 - kalman_gain
        self._set(self.pressure + kalman_gain * (pressure - self.pressure))

    def jump(self, fraction: float) -> None:
        """Multiply the estimate by a fraction and increase its variance."""
        self._set(fraction * self.pressure)
        self.variance = (LARGEST_SD * self.pressure) ** 2

    def _set(self, pressure: float) -> None:
        self.pressure = max(pressure, _LOWEST * self.nominal)


FLOW_SD = 0.3
"""Prior standard deviation of the flow factor c.

The value is large, so that a chamber filling half as fast as in the robot file is not
mistaken for a leak during the first strokes.
"""
LOSS_SD = 0.3
"""Prior standard deviation of the apparent loss λ₀, 1/s."""
FORGETTING = 0.95
"""Factor by which the weight of a stroke decreases with each later stroke."""
MOST_STROKES = 40
"""Maximum number of strokes over which the scatter is averaged."""
SCATTER = 0.05
"""Prior standard deviation of the inflow from stroke to stroke, fraction of the inflow.
"""
SCATTER_STROKES = 3
"""Number of initial strokes that do not change the scatter."""
LEAST_SCATTER = 0.02
"""Lower limit of the standard deviation between strokes, fraction of the inflow."""
MESSAGES_PER_INDEPENDENT = 16
"""Number of messages that carry the information of one independent message."""
AMOUNT_SD = 0.013
"""Standard deviation of an amount of air, fraction of K times the nominal pressure."""
LEAK_RATE_SD = 0.3
"""Relative standard deviation of a leak rate."""
WEAK_INFLOW_SD = 0.7
"""Relative standard deviation of the inflow from a weak supply."""
LEAST_INFLOW = 0.1
"""Minimum inflow of a usable stroke, fraction of K times the nominal pressure."""
LONGEST_GAP_S = 0.1
"""Time without a message after which a stroke is ended, s."""
SOUND = 0.98
"""Probability of no fault above which the strokes of a segment are used for learning."""
LIMIT = 3.0
"""Limit at which residuals are clipped in the scatter, in standard deviations."""
TAILS = 12.0
"""Degrees of freedom of Student's t distribution for stroke residuals."""


_volume = np.vectorize(volume, otypes=[float, float])
_flow = np.vectorize(
    lambda first, second: flow(first, second, CRITICAL_RATIO)[0], otypes=[float]
)
# The columns of the stroke integrals are gauge pressure, inflow of each variant, and
# derivative of the inflow with respect to the supply pressure.
_OUTFLOW = 0
_SOUND_INFLOW = 1
_INFLOWS = slice(1, -1)
_DERIVATIVE = -1
# The supply pressure is stored at the start of a stroke and at the last message.
_FIRST = 0
_LAST = 1


class SupplyResidual(NamedTuple):
    """Inflow residuals of filling chambers at the estimated supply pressure.

    Attributes:
        residual: measured minus expected amount of air, shape (segments, 2). Unknown
            residuals are NaN.
        derivative: derivative of the expected amount with respect to the supply
            pressure, 1/Pa, shape (segments, 2).
        sd: standard deviation of the residual, shape (segments, 2).
    """

    residual: np.ndarray
    derivative: np.ndarray
    sd: np.ndarray


class _Residual(NamedTuple):
    """Residuals of the air balances, shape (segments, 2, variants).

    Attributes:
        value: residual of each balance.
        variance: variance of each residual.
        fit_variance: part of the variance that is due to the uncertainty of c and λ₀.
    """

    value: np.ndarray
    variance: np.ndarray
    fit_variance: np.ndarray

    def sound(self) -> _Residual:
        return _Residual(*(values[..., 0] for values in self))


class _Message(IntEnum):
    INFLOW = 0
    OUTFLOW = 1
    RESIDUAL = 2
    WEIGHT = 3
    EXCESS = 4


class LeakDetector(Stateful):
    """Leak detector based on the air balances of all chambers.

    Amounts of air are expressed as fractions of K times the nominal supply pressure.

    Attributes:
        fit: flow factor c and apparent loss λ₀ (1/s) of each chamber, shape (segments,
            2, 2).
        scatter: variance between strokes, fraction of the squared inflow, shape
            (segments, 2).
        learnt: number of strokes learnt for each chamber, shape (segments, 2).
    """

    state_attributes = (
        "fit",
        "scatter",
        "learnt",
        "_information",
        "_pending",
        "_time",
        "_begun",
        "_reached",
        "_rates",
        "_sums",
        "_supply",
        "_supply_sd",
        "_log_likelihood",
    )

    def __init__(
        self,
        spec: RobotSpec,
        *,
        supply_pa: float,
        variants: Sequence[Inflow],
    ) -> None:
        """Initialise the detector for a nominal gauge pressure of the supply (Pa).

        The first inflow variant must describe a chamber without a fault.
        """
        conductance, _, capacity = conductances(spec, CRITICAL_RATIO)
        self._chamber = spec.chamber
        self._nominal = supply_pa
        self._unit = capacity * supply_pa
        self._conductance = conductance * REFERENCE_PA / self._unit
        self._leaks, self._fractions = np.array(variants, dtype=float).T
        shape = (spec.segments, 2)
        count = len(variants)
        self.fit = np.tile([1.0, 0.0], (*shape, 1))
        self.scatter = np.full(shape, SCATTER**2)
        self.learnt = np.zeros(shape)
        self._prior = np.diag([1 / FLOW_SD**2, 1 / LOSS_SD**2])
        self._information = np.tile(self._prior, (*shape, 1, 1))
        self._pending = np.zeros((*shape, len(_Message)))
        self._time = np.full(shape, np.nan)
        self._begun = np.zeros((*shape, 2))
        self._reached = np.zeros((*shape, 2))
        self._rates = np.zeros((*shape, count + 2))
        self._sums = np.zeros((*shape, count + 2))
        self._supply = np.zeros((*shape, 2))
        self._supply_sd = 0.0
        self._log_likelihood = np.zeros((*shape, count))

    def drop_all(self) -> None:
        """End the strokes of all chambers."""
        self.drop(np.ones(self.learnt.shape, dtype=bool))

    def drop(self, chambers: np.ndarray) -> None:
        """End the strokes of chambers whose valves may have switched unnoticed."""
        self._time[chambers] = np.nan
        for values in (self._pending, self._sums, self._log_likelihood):
            values[chambers] = 0.0

    def residuals(
        self, time: float, pressure: np.ndarray, filled: np.ndarray
    ) -> SupplyResidual:
        """Return the residuals from which the supply pressure is estimated."""
        used = self._continues(time, pressure, filled) & self._is_informative()
        residual = self._residual().sound()
        return SupplyResidual(
            np.where(used, residual.value, np.nan),
            self.fit[..., 0] * self._sums[..., _DERIVATIVE],
            np.sqrt(residual.variance),
        )

    def update(
        self,
        time: float,
        pressure: np.ndarray,
        bend: Estimates,
        filled: np.ndarray,
        sound: np.ndarray,
        supply: SupplyFilter,
    ) -> np.ndarray:
        """Update the air balances with measured pressures.

        Args:
            time: current time, s.
            pressure: gauge pressures of the chambers, shape (segments, 2), Pa. Missing
                pressures are NaN.
            bend: estimated bend of each segment, rad.
            filled: time for which each chamber has been filled, shape (segments, 2), s.
                The filling time of a venting chamber is 0.
            sound: probability that each segment has no fault, shape (segments,).
            supply: filter for the supply pressure.

        Returns:
            Change of the log-likelihood of each variant, shape (segments, 2, variants).
        """
        seen = ~np.isnan(pressure)
        continues = self._continues(time, pressure, filled)
        change = np.where(continues, supply.pressure - self._supply[..., _LAST], 0.0)
        # The inflow of the stroke is corrected for the change of the estimated supply
        # pressure.
        missed = (self._sums[..., _DERIVATIVE] * change)[..., None]
        self._sums[..., _INFLOWS] += np.where(self._fractions == 1.0, missed, 0.0)
        self._supply[seen, _LAST] = supply.pressure
        self._supply_sd = supply.sd
        # A message is used only after the next message confirms that the valve is still
        # open. A lost command may have closed the valve before the last message.
        used = continues & self._is_informative()
        self._accumulate(used)
        added = self._log_likelihoods() - self._log_likelihood
        added = np.where(used[..., None], added, 0.0)
        self._log_likelihood += added
        ended = seen & ~continues
        has_message = self._pending[..., _Message.WEIGHT] > 0.0
        self._learn(ended & has_message & (sound > SOUND)[:, None])
        self.drop(ended)
        self._advance(time, seen & (filled > 0.0), pressure, bend, supply)
        return added

    def _is_informative(self) -> np.ndarray:
        return np.asarray(self._sums[..., _SOUND_INFLOW] > LEAST_INFLOW)

    def _continues(
        self, time: float, pressure: np.ndarray, filled: np.ndarray
    ) -> np.ndarray:
        since = time - self._time
        opened: np.ndarray = (
            ~np.isnan(pressure) & (since < LONGEST_GAP_S) & (filled > since - 1e-6)
        )
        return opened

    def _advance(
        self,
        time: float,
        filling: np.ndarray,
        pressure: np.ndarray,
        bend: Estimates,
        supply: SupplyFilter,
    ) -> None:
        chamber = self._chamber
        inside = np.nan_to_num(pressure) + AMBIENT_PA
        size, growth = _volume(
            chamber.dead_volume, chamber.displacement, bend.value[:, None], [0, 1]
        )
        # The amount of air, pressure times volume, is expressed as a fraction of K
        # times the nominal supply pressure.
        held = inside / self._unit
        held_sd = held * np.abs(growth) * bend.sd[:, None]
        reached = np.stack([held * size, held_sd], axis=-1)
        self._reached[filling] = reached[filling]
        line = supply.pressure
        sd = max(supply.sd, 1.0)
        lines = np.append(self._fractions * line, [line + sd, line - sd])
        flows = self._conductance * _flow(lines + AMBIENT_PA, inside[..., None])
        flows[..., :-2] *= self._fractions > 0.0
        # The derivative is computed by finite differences, because the exact derivative
        # diverges at equal pressures.
        derivative = (flows[..., -2:-1] - flows[..., -1:]) / (2 * sd)
        gauge = np.nan_to_num(pressure)[..., None] / self._nominal
        rates = np.concatenate([gauge, flows[..., :-2], derivative], axis=-1)
        begins = np.isnan(self._time)
        since = np.where(filling & ~begins, time - self._time, 0.0)
        # The trapezoidal rule integrates all rates over the time since the last
        # message.
        self._sums += since[..., None] * (self._rates + rates) / 2
        self._rates[filling] = rates[filling]
        begins &= filling
        self._begun[begins] = self._reached[begins]
        self._supply[begins, _FIRST] = line
        self._time[filling] = time

    def _residual(self) -> _Residual:
        inflow = self._sums[..., _INFLOWS]
        outflow = self._sums[..., [_OUTFLOW]]
        # The balance is linear in c and λ₀. Without a leak, the amount of air increases
        # by c · inflow − λ₀ · outflow. A leak λ reduces the increase by λ · outflow.
        row = np.stack([inflow, np.broadcast_to(-outflow, inflow.shape)], axis=-1)
        gain = (self._reached - self._begun)[..., :1]
        residual = gain - (row @ self.fit[..., None])[..., 0] + self._leaks * outflow
        learnt = ((row @ np.linalg.inv(self._information)) * row).sum(axis=-1)
        read = self._reached[..., 1] ** 2 + self._begun[..., 1] ** 2 + AMOUNT_SD**2
        # The time at which the supply pressure changed within the stroke is unknown.
        change = self._supply[..., _LAST] - self._supply[..., _FIRST]
        derivative = self.fit[..., 0] * self._sums[..., _DERIVATIVE]
        read += (change**2 + self._supply_sd**2) * derivative**2
        variance = learnt + read[..., None] + self.scatter[..., None] * inflow**2
        return _Residual(residual, variance, learnt)

    def _log_likelihoods(self) -> np.ndarray:
        residual, variance, _ = self._residual()
        outflow = self._sums[..., [_OUTFLOW]]
        weak_sd = WEAK_INFLOW_SD * self._sums[..., _INFLOWS]
        variance += (LEAK_RATE_SD * self._leaks * outflow) ** 2
        variance += (self._fractions < 1.0) * weak_sd**2
        return np.asarray(
            -np.log1p(residual**2 / variance / TAILS) * (TAILS + 1) / 2
            - np.log(variance) / 2
        )

    def _accumulate(self, used: np.ndarray) -> None:
        inflow = self._sums[..., _SOUND_INFLOW]
        pending = self._pending
        residual, variance, fit_variance = self._residual().sound()
        # Message errors within a stroke are correlated, so only one message per stroke
        # is used.
        weight = 1 / (variance - fit_variance)
        known = pending[..., _Message.WEIGHT] * pending[..., _Message.INFLOW] ** 2
        better = used & (weight * inflow**2 > known)
        message = [inflow, -self._sums[..., _OUTFLOW], residual, weight]
        pending[better, : _Message.EXCESS] = np.stack(message, axis=-1)[better]
        # Residuals are limited, so that a single outlier cannot dominate the scatter.
        excess = np.minimum(residual**2, LIMIT**2 * variance) - variance
        pending[used, _Message.EXCESS] = excess[used] / inflow[used] ** 2

    def _learn(self, chambers: np.ndarray) -> None:
        pending = self._pending[chambers]
        row = pending[:, [_Message.INFLOW, _Message.OUTFLOW]]
        residual = pending[:, [_Message.RESIDUAL]]
        weight = pending[:, [_Message.WEIGHT]]
        excess = pending[:, _Message.EXCESS]
        learnt = np.minimum(self.learnt[chambers] + 1, MOST_STROKES)
        # Residuals of the first strokes include the error of the initial supply
        # pressure.
        fraction = np.where(learnt > SCATTER_STROKES, 1 / learnt, 0.0)
        scatter = self.scatter[chambers] + fraction * excess
        self.learnt[chambers] = learnt
        self.scatter[chambers] = np.maximum(scatter, LEAST_SCATTER**2)
        information = FORGETTING * self._information[chambers]
        information += (1 - FORGETTING) * self._prior
        information += weight[..., None] * row[:, :, None] * row[:, None, :]
        self._information[chambers] = information
        self.fit[chambers] += np.linalg.solve(
            information, (weight * residual * row)[..., None]
        )[..., 0]
