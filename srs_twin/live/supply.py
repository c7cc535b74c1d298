r"""SupplyFilter: supply pressure of the robot, estimated from the pressures of chambers that fill.

All chambers share one supply. Its gauge pressure S is a random walk. A chamber that fills has the pressure
h S + v, where h is its response to a supply of 1 (`pneumatics.lag`, and what its strokes usually differ from
that by). A Kalman filter combines the chambers:

$$ \hat S' = \hat S + \frac{\sum_i w_i h_i (p_i - h_i \hat S) / \sigma_i^2}
                           {1/P + \sum_i w_i h_i^2 / \sigma_i^2}. $$

Once the air balance of a chamber is known (`balance`), its missing air takes the place of p. The weights w of
Student's t distribution keep one chamber that leaks or is stuck from moving the estimate.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.memory import Remembers, names

PRIOR_SD = 0.05
"""Standard deviation of the supply pressure at the start, share of the nominal one."""
LARGEST_SD = 0.2
"""Largest standard deviation, while no chamber fills, share of the nominal pressure."""
WALK = 0.03
"""Random walk of the supply pressure, share of the nominal one per square root of a second."""
SENSOR_SD = 0.01
"""Standard deviation of a measured supply pressure, share of the nominal one."""
STARVED_BELOW = 0.6
"""Share of the nominal pressure below which the supply is named as starved."""
RECOVERED_ABOVE = 0.7
"""Share of the nominal pressure above which a starved supply counts as sound again."""
_SUDDEN = 3.0
"""Standard deviations from which on a change of the median counts as sudden."""
_AGREE = 3
"""Least number of chambers whose median change is believed."""
_TAILS = 4.0  # degrees of freedom of Student's t
_LOWEST = 0.02  # share of the nominal pressure


class SupplyFilter(Remembers):
    """Kalman filter for the supply pressure (module docstring).

    Attributes:
        nominal: gauge, Pa.
        pressure: estimate, gauge, Pa.
        variance: of the estimate, Pa².
    """

    memory = names("pressure", "variance")

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
        self.variance = min(
            self.variance + (WALK * self.nominal) ** 2 * dt, (LARGEST_SD * self.nominal) ** 2
        )

    def update(
        self, residual: np.ndarray, response: np.ndarray, sd: np.ndarray, weight: np.ndarray,
        repeats: float = 1.0,
    ) -> None:  # fmt: skip
        """Correct by chambers that fill.

        Args:
            residual: z − h S; NaN where nothing was measured.
            response: h, the slope of z by the supply pressure.
            sd: of v.
            weight: of each chamber, 0 to 1.
            repeats: number of measurements that say as much as one that is independent.
        """
        there = ~np.isnan(residual) & (weight > 0) & (response > 0)
        if not there.any():
            return
        residual, response, variance = residual[there], response[there], sd[there] ** 2
        # Where most chambers agree that the pressure has changed, an outlier is what differs from them.
        change = float(np.median(residual / response)) if len(residual) >= _AGREE else 0.0
        median_variance = repeats * np.pi / 2 / len(residual) * float(np.median(variance / response**2))
        if change**2 > _SUDDEN**2 * (self.variance + median_variance):
            self.variance += change**2
        expected = variance + response**2 * self.variance
        robust = (_TAILS + 1) / (_TAILS + (residual - response * change) ** 2 / expected)
        information = weight[there] * np.minimum(robust, 1.0) * response / variance / repeats
        self.variance = 1 / (1 / self.variance + float(information @ response))
        self._set(self.pressure + self.variance * float(information @ residual))

    def measure(self, pressure: float) -> None:
        """Correct by a measured supply pressure (gauge, Pa)."""
        noise = (SENSOR_SD * self.nominal) ** 2
        gain = self.variance / (self.variance + noise)
        self.variance *= 1 - gain
        self._set(self.pressure + gain * (pressure - self.pressure))

    def jump(self, share: float) -> None:
        """Accept that the pressure fell to a share of the estimate."""
        self._set(share * self.pressure)
        self.variance = (LARGEST_SD * self.pressure) ** 2

    def _set(self, pressure: float) -> None:
        self.pressure = max(pressure, _LOWEST * self.nominal)
