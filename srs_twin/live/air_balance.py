r"""Estimation of the supply pressure and of leaks from the air flow into the chambers.

While a valve fills a chamber, the absolute chamber pressure P and the bend q of the
segment satisfy the air balance

$$ \Delta (P\,V(q)) = c \int \dot n_{in}\,dt - (\lambda_0 + \lambda)\,K \int (P - P_a)\,dt, $$

where V is the chamber volume, ṅ_in the flow through an orifice (`pneumatics/flow.py`),
P_a the ambient pressure and K the capacity of a nominal chamber. A stroke is an
interval in which the valve fills the chamber without interruption. The flow factor c
and the apparent loss λ₀ of an intact chamber are estimated from many strokes by linear
regression with exponential forgetting. The variation of the inflow between strokes is
also estimated, so that a leak with the rate λ can be detected within one stroke.

All chambers share one supply, whose gauge pressure S is modelled as a random walk with
the estimate Ŝ. The residual r_i is the measured minus the expected amount of air that
flows into chamber i during a stroke. The residual satisfies r_i = h_i (S − Ŝ) + v_i.
Here h_i is the derivative of the expected amount with respect to S, and v_i is the
measurement error. A Kalman filter combines the residuals of all chambers:

$$ \hat S' = \hat S + \frac{\sum_i w_i h_i r_i / \sigma_i^2}{1/P + \sum_i w_i h_i^2 / \sigma_i^2}. $$

Here σ_i is the standard deviation of v_i, and P is the variance of Ŝ. The weights w_i,
which are based on Student's t distribution, limit the effect of a chamber that leaks or
whose valve is stuck. If most filling chambers indicate the same large change of the
supply pressure, the filter adopts this change immediately.
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
"""Initial standard deviation of the supply pressure, relative to the nominal pressure.
"""
LARGEST_SD = 0.2
"""Maximum standard deviation of the supply pressure, relative to the nominal pressure.
"""
WALK = 0.02
"""Random walk of the supply pressure per √s, relative to the nominal pressure."""
SENSOR_SD = 0.01
"""Standard deviation of the supply sensor noise, relative to the nominal pressure."""
LOW_SUPPLY_FRACTION = 0.6
"""Fraction of the nominal pressure below which `low_supply_pressure` is reported."""
RECOVERED_ABOVE = 0.7
"""Fraction of the nominal pressure above which `low_supply_pressure` is cleared."""
SUDDEN = 0.12
"""Minimum sudden change of the supply pressure, relative to the nominal pressure."""
_SUDDEN_SD = 3.0
"""Minimum median residual that indicates a sudden change, in standard deviations."""
_SURPRISE = 3.0
"""Median pressure change, in standard deviations, above which the variance increases.
"""
_AGREE = 3
"""Minimum number of filling chambers from which a median is computed."""
_SUPPLY_TAILS = 4.0
"""Degrees of freedom of Student's t distribution for supply residuals."""
_LOWEST = 0.02
"""Lower limit of the estimated supply pressure, relative to the nominal pressure."""


class SupplyFilter(Stateful):
    """Kalman filter for the gauge pressure of the supply.

    Attributes:
        nominal: nominal gauge pressure, Pa.
        pressure: estimated gauge pressure, Pa.
        variance: variance of the estimate, Pa².
    """

    state_attributes = ("pressure", "variance")

    def __init__(self, nominal: float) -> None:
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
            residual: measured minus expected value for each chamber, or NaN for a
                missing measurement.
            response: derivative h of the expected value with respect to the supply
                pressure, for each chamber.
            sd: standard deviation of the measurement error v, for each chamber.
            weight: weight of each chamber, from 0 to 1.
            repeats: number of successive measurements that are as informative as one
                independent measurement.
        """
        there = ~np.isnan(residual) & (weight > 0) & (response > 0)
        if not there.any():
            return
        residual = residual[there]
        response = response[there]
        weight = weight[there]
        variance = sd[there] ** 2
        # If enough chambers are filling, outliers are identified by the deviation from
        # the median change of all chambers.
        change = 0.0
        if len(residual) >= _AGREE:
            change = float(np.median(residual / response))
            scatter = float(np.median(variance / response**2))
            chance = np.pi / 2 / len(residual) * scatter
            if change**2 > _SURPRISE**2 * (self.variance + chance):
                self.variance += change**2
                # Messages after a sudden change are independent of earlier messages.
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
        """Adopt a sudden pressure change if most filling chambers indicate it.

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
        """Scale the estimate by a fraction, and set the variance from `LARGEST_SD`."""
        self._set(fraction * self.pressure)
        self.variance = (LARGEST_SD * self.pressure) ** 2

    def _set(self, pressure: float) -> None:
        self.pressure = max(pressure, _LOWEST * self.nominal)


FLOW_SD = 0.3
"""Prior standard deviation of the flow factor c.

With this large value, a chamber that fills at half the nominal rate is not mistaken for
a leaking chamber during the first strokes.
"""
LOSS_SD = 0.3
"""Prior standard deviation of the apparent loss λ₀, 1/s."""
FORGETTING = 0.95
"""Factor by which the weight of earlier strokes decreases with each new stroke."""
MOST_STROKES = 40
"""Maximum number of strokes from which the inflow variation is estimated."""
SCATTER = 0.05
"""Prior relative standard deviation of the inflow between strokes."""
SCATTER_STROKES = 3
"""Number of initial strokes that do not affect the estimated inflow variation."""
LEAST_SCATTER = 0.02
"""Lower limit of the relative standard deviation of the inflow between strokes."""
MESSAGES_PER_INDEPENDENT = 16
"""Number of successive messages that are as informative as one independent message."""
AMOUNT_SD = 0.013
"""Standard deviation of a measured air increase, in the unit of `LeakDetector`."""
LEAK_RATE_SD = 0.3
"""Relative standard deviation of the leak rate under a leak hypothesis."""
WEAK_INFLOW_SD = 0.7
"""Relative standard deviation of the inflow from a weak supply."""
LEAST_INFLOW = 0.1
"""Minimum inflow of a usable stroke, in the unit of `LeakDetector`."""
LONGEST_GAP_S = 0.1
"""Time without a message after which a stroke is ended, s."""
SOUND = 0.98
"""Probability of no fault above which the strokes of a segment are learnt."""
LIMIT = 3.0
"""Limit of each residual in the estimate of inflow variation, in standard deviations.
"""
TAILS = 12.0
"""Degrees of freedom of Student's t distribution for stroke residuals."""


def log_student(square: np.ndarray, tails: float) -> np.ndarray:
    """Return log-likelihoods for Student's t distribution without the constant term.

    Args:
        square: squared residuals divided by the noise variance.
        tails: degrees of freedom.
    """
    return np.asarray(-np.log1p(square / tails) * (tails + 1) / 2)


_volume = np.vectorize(volume, otypes=[float, float])
_flow = np.vectorize(
    lambda first, second: flow(first, second, CRITICAL_RATIO)[0], otypes=[float]
)
# The columns of the stroke integrals are the gauge pressure, the inflow of each variant
# and the derivative of the inflow with respect to the supply pressure.
_OUTFLOW = 0
_SOUND_INFLOW = 1
_INFLOWS = slice(1, -1)
_DERIVATIVE = -1
# Indices of the supply pressures at the start of a stroke and at the last message.
_FIRST = 0
_LAST = 1


class SupplyResidual(NamedTuple):
    """Inflow residuals of filling chambers at the estimated supply pressure.

    Attributes:
        residual: measured minus expected increase of the air in each chamber, in the
            unit of `LeakDetector`, shape (segments, 2), or NaN if unknown.
        derivative: derivative of the expected increase with respect to the supply
            pressure, shape (segments, 2), 1/Pa.
        sd: standard deviation of each residual, shape (segments, 2).
    """

    residual: np.ndarray
    derivative: np.ndarray
    sd: np.ndarray


class _Residual(NamedTuple):
    """Residuals of the air balances, shape (segments, 2, variants).

    Attributes:
        fit_variance: contribution to the variance from the uncertainty of c and λ₀.
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

    The unit of air amounts is the capacity K times the nominal supply pressure.

    Attributes:
        fit: flow factor c and apparent loss λ₀ (1/s) of each chamber, shape (segments,
            2, 2).
        scatter: squared relative standard deviation of the inflow between strokes,
            shape (segments, 2).
        learnt: number of learnt strokes of each chamber, at most `MOST_STROKES`, shape
            (segments, 2).
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

        The first of the inflow variants must describe a chamber without a fault.
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
        """Return the inflow residuals for arguments that are described in `update`."""
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
            pressure: gauge pressures of the chambers, or NaN for missing measurements,
                shape (segments, 2), Pa.
            bend: estimated bend of each segment, rad.
            filled: time since each chamber began to fill, or 0 for a venting chamber,
                shape (segments, 2), s.
            sound: probability that each segment has no fault, shape (segments,).
            supply: filter for the supply pressure.

        Returns:
            Change of the log-likelihood of each variant, shape (segments, 2, variants).
        """
        seen = ~np.isnan(pressure)
        continues = self._continues(time, pressure, filled)
        change = np.where(continues, supply.pressure - self._supply[..., _LAST], 0.0)
        # If the estimated supply pressure has changed, the expected inflow of the
        # stroke is corrected.
        missed = (self._sums[..., _DERIVATIVE] * change)[..., None]
        self._sums[..., _INFLOWS] += np.where(self._fractions == 1.0, missed, 0.0)
        self._supply[seen, _LAST] = supply.pressure
        self._supply_sd = supply.sd
        # A lost command may have closed the valve, so a message is used only after the
        # next message confirms that the valve is still open.
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
        held = inside / self._unit
        held_sd = held * np.abs(growth) * bend.sd[:, None]
        reached = np.stack([held * size, held_sd], axis=-1)
        self._reached[filling] = reached[filling]
        line = supply.pressure
        sd = max(supply.sd, 1.0)
        lines = np.append(self._fractions * line, [line + sd, line - sd])
        flows = self._conductance * _flow(lines + AMBIENT_PA, inside[..., None])
        flows[..., :-2] *= self._fractions > 0.0
        # Finite differences are used, because the exact derivative becomes very large
        # at equal pressures.
        derivative = (flows[..., -2:-1] - flows[..., -1:]) / (2 * sd)
        gauge = np.nan_to_num(pressure)[..., None] / self._nominal
        rates = np.concatenate([gauge, flows[..., :-2], derivative], axis=-1)
        begins = np.isnan(self._time)
        since = np.where(filling & ~begins, time - self._time, 0.0)
        self._sums += since[..., None] * (self._rates + rates) / 2
        self._rates[filling] = rates[filling]
        begins &= filling
        self._begun[begins] = self._reached[begins]
        self._supply[begins, _FIRST] = line
        self._time[filling] = time

    def _residual(self) -> _Residual:
        inflow = self._sums[..., _INFLOWS]
        outflow = self._sums[..., [_OUTFLOW]]
        # Without a leak, the amount of air increases by c · inflow − λ₀ · outflow. A
        # leak λ reduces this increase by λ · outflow.
        row = np.stack([inflow, np.broadcast_to(-outflow, inflow.shape)], axis=-1)
        gain = (self._reached - self._begun)[..., :1]
        residual = gain - (row @ self.fit[..., None])[..., 0] + self._leaks * outflow
        learnt = ((row @ np.linalg.inv(self._information)) * row).sum(axis=-1)
        read = self._reached[..., 1] ** 2 + self._begun[..., 1] ** 2 + AMOUNT_SD**2
        # The supply pressure may have changed at any time within the stroke, so the
        # change increases the variance.
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
        log = log_student(residual**2 / variance, TAILS)
        return np.asarray(log - np.log(variance) / 2)

    def _accumulate(self, used: np.ndarray) -> None:
        inflow = self._sums[..., _SOUND_INFLOW]
        pending = self._pending
        residual, variance, fit_variance = self._residual().sound()
        # The errors of messages within a stroke are correlated, so only the most
        # informative message is used.
        weight = 1 / (variance - fit_variance)
        known = pending[..., _Message.WEIGHT] * pending[..., _Message.INFLOW] ** 2
        better = used & (weight * inflow**2 > known)
        message = [inflow, -self._sums[..., _OUTFLOW], residual, weight]
        pending[better, : _Message.EXCESS] = np.stack(message, axis=-1)[better]
        excess = np.minimum(residual**2, LIMIT**2 * variance) - variance
        pending[used, _Message.EXCESS] = excess[used] / inflow[used] ** 2

    def _learn(self, chambers: np.ndarray) -> None:
        pending = self._pending[chambers]
        row = pending[:, [_Message.INFLOW, _Message.OUTFLOW]]
        residual = pending[:, [_Message.RESIDUAL]]
        weight = pending[:, [_Message.WEIGHT]]
        excess = pending[:, _Message.EXCESS]
        learnt = np.minimum(self.learnt[chambers] + 1, MOST_STROKES)
        # The first strokes do not affect the estimated variation, because their
        # residuals include the error of the initial supply pressure.
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
