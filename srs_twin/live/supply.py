r"""SupplyFilter: supply pressure of the robot, estimated from the inflow of the chambers.

All chambers share one supply. Its gauge pressure S is a random walk. The inflow of chamber i since its valve
opened exceeds the expected amount by r_i = h_i (S − Ŝ) + v_i, with the noise v_i (`leak_detector`). A Kalman
filter combines the chambers:

$$ \hat S' = \hat S + \frac{\sum_i w_i h_i r_i / \sigma_i^2}{1/P + \sum_i w_i h_i^2 / \sigma_i^2}. $$

The weights w of Student's t distribution limit the effect of a chamber that leaks or is stuck. A large change
is accepted at once if most filling chambers show it.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.io.saved_state import Stateful

PRIOR_SD = 0.02
"""Standard deviation of the supply pressure at the start, share of the nominal one."""
LARGEST_SD = 0.2
"""Largest standard deviation, while no chamber fills, share of the nominal pressure."""
WALK = 0.02
"""Random walk of the supply pressure, share of the nominal one per square root of a second."""
SENSOR_SD = 0.01
"""Standard deviation of a measured supply pressure, share of the nominal one."""
STARVED_BELOW = 0.6
"""Share of the nominal pressure below which `starved` is reported."""
RECOVERED_ABOVE = 0.7
"""Share of the nominal pressure above which `starved` is cleared."""
_SUDDEN = 0.12
"""Change of the chamber pressures that is accepted at once, as a fraction of the nominal supply pressure."""
_SUDDEN_SD = 3.0
"""The same change in standard deviations of the scatter between strokes."""
_SURPRISE = 3.0
"""Change of the median, in standard deviations, above which the variance of the estimate is increased."""
_AGREE = 3
"""Smallest number of chambers whose median is used."""
_TAILS = 4.0  # degrees of freedom of Student's t
_LOWEST = 0.02  # share of the nominal pressure


class SupplyFilter(Stateful):
    """Kalman filter for the supply pressure (module docstring).

    Attributes:
        nominal: gauge, Pa.
        pressure: estimate, gauge, Pa.
        variance: variance of the estimate, Pa².
    """

    state_attributes = ("pressure", "variance")

    def __init__(self, nominal: float) -> None:
        """Begin with the nominal pressure (gauge, Pa)."""
        self.nominal = self.pressure = nominal
        self.variance = (PRIOR_SD * nominal) ** 2

    @property
    def share(self) -> float:
        """Estimate as a share of the nominal pressure."""
        return self.pressure / self.nominal

    @property
    def sd(self) -> float:
        """Standard deviation of the estimate, Pa."""
        return math.sqrt(self.variance)

    def predict(self, dt: float) -> None:
        """Advance by a time step (s)."""
        self.variance = min(self.variance + (WALK * self.nominal) ** 2 * dt, (LARGEST_SD * self.nominal) ** 2)

    def update(
        self, residual: np.ndarray, response: np.ndarray, sd: np.ndarray, weight: np.ndarray,
        repeats: float = 1.0,
    ) -> None:  # fmt: skip
        """Correct the estimate by the residuals of filling chambers.

        Args:
            residual: r; NaN without a measurement.
            response: h.
            sd: standard deviation of v.
            weight: weight of each chamber, 0 to 1.
            repeats: number of successive measurements that carry the information of one independent
                measurement.
        """
        there = ~np.isnan(residual) & (weight > 0) & (response > 0)
        if not there.any():
            return
        residual, response, variance = residual[there], response[there], sd[there] ** 2
        # If most chambers agree on a change, treat those that differ from it as outliers.
        change = 0.0
        if len(residual) >= _AGREE:
            change = float(np.median(residual / response))
            chance = np.pi / 2 / len(residual) * float(np.median(variance / response**2))
            if change**2 > _SURPRISE**2 * (self.variance + chance):
                self.variance += change**2
        expected = variance + response**2 * self.variance
        robust = (_TAILS + 1) / (_TAILS + (residual - response * change) ** 2 / expected)
        information = weight[there] * np.minimum(robust, 1.0) * response / variance / repeats
        self.variance = 1 / (1 / self.variance + float(information @ response))
        self._set(self.pressure + self.variance * float(information @ residual))

    def follow_sudden_change(self, residual: np.ndarray, response: np.ndarray, sd: np.ndarray) -> bool:
        """Follow a sudden change that most chambers show; return whether there was one.

        Args:
            residual: p − h S of filling chambers, Pa.
            response: h.
            sd: standard deviation of p, Pa.
        """
        if len(residual) < _AGREE:
            return False
        change, deviation = float(np.median(residual / response)), float(np.median(residual / sd))
        if abs(change) < _SUDDEN * self.nominal or abs(deviation) < _SUDDEN_SD:
            return False
        self.variance = max(self.variance, (change / 2) ** 2)
        self._set(self.pressure + change)
        return True

    def measure(self, pressure: float) -> None:
        """Correct by a measured supply pressure (gauge, Pa)."""
        noise = (SENSOR_SD * self.nominal) ** 2
        gain = self.variance / (self.variance + noise)
        self.variance *= 1 - gain
        self._set(self.pressure + gain * (pressure - self.pressure))

    def jump(self, share: float) -> None:
        """Lower the estimate to a fraction of its value after a sudden loss."""
        self._set(share * self.pressure)
        self.variance = (LARGEST_SD * self.pressure) ** 2

    def _set(self, pressure: float) -> None:
        self.pressure = max(pressure, _LOWEST * self.nominal)
