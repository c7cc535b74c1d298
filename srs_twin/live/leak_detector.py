r"""LeakDetector: balance of the air in each filling chamber.

A stroke begins when the valve of a chamber opens. From then on, the measured pressure P and the bend q of its
segment satisfy

$$ \Delta (P\,V(q)) = c \int \dot n_{in}\,dt - (\lambda_0 + \lambda)\,K \int (P - P_a)\,dt, $$

with the flow of an orifice (`pneumatics/flow.py`) and the capacity K of a nominal chamber. The factor c and
the apparent loss λ₀ of an intact chamber are estimated over many strokes (linear regression with forgetting),
and so is the scatter between strokes. A leak λ is then visible within one stroke. First-order chambers
satisfy such a balance as well, with other c and λ₀.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled
from srs_twin.io.saved_state import Stateful
from srs_twin.pneumatics.chambers import AMBIENT_PA, volume
from srs_twin.pneumatics.flow import REFERENCE_PA, conductances, flow
from srs_twin.pneumatics.orifice import CRITICAL_RATIO
from srs_twin.robot.spec import RobotSpec

FLOW_SD = 0.15
"""Prior standard deviation of c."""
LOSS_SD = 0.3
"""Prior standard deviation of λ₀, 1/s."""
FORGETTING = 0.95
"""Weight of a stroke relative to the next one."""
MOST_STROKES = 40
"""Number of strokes over which the scatter is averaged."""
SCATTER = 0.05
"""Prior scatter between strokes, share of the inflow."""
SCATTER_STROKES = 3
"""Weight of the prior scatter, in strokes."""
LEAST_SCATTER = 0.02
"""Lower limit of the scatter, share of the inflow."""
MESSAGES_PER_INDEPENDENT = 16
"""Number of successive messages that carry the information of one independent message."""
AMOUNT_SD = 0.013
"""Standard deviation of an amount at the time of a message, share of K times the supply pressure."""
LEAK_RATE_SD = 0.3
"""Relative standard deviation of the rate of a leak."""
WEAK_INFLOW_SD = 0.7
"""Relative standard deviation of the inflow from a weak supply."""
LEAST_INFLOW = 0.1
"""Inflow above which a stroke is used, share of K times the supply pressure."""
LONGEST_GAP_S = 0.1
"""Interval between messages that ends a stroke, s."""
SOUND = 0.9
"""Probability of no fault above which the fit of a chamber is updated."""
LIMIT = 3.0
"""Limit, in standard deviations, at which a residual is clipped when the scatter is updated."""
TAILS = 12.0
"""Degrees of freedom of Student's t distribution for the residuals of strokes."""


class StrokeStatistics(NamedTuple):
    """Statistics of each chamber, shape (segments, 2, …); amounts are shares of K times the supply pressure.

    Attributes:
        fit: c and λ₀ (1/s).
        information: inverse covariance of the fit: c with c, c with λ₀, λ₀ with λ₀.
        pending: contributions of the current stroke: to the information (3), to its product with the fit
            (2), and to the scatter.
        scatter: variance between strokes, share of the squared inflow.
        learnt: number of strokes in the fit.
        time: time of the last pressure of the stroke, s; NaN without one.
        begun: amount of air at the start of the stroke and its standard deviation.
        reached: amount of air at the last pressure and its standard deviation.
        rates: pressure over the supply pressure, inflow of each variant (1/s), and the derivative of the
            inflow with respect to the supply pressure (1/(s Pa)).
        sums: integrals of the rates over the stroke.
        supply: supply pressure at the start of the stroke and at its last pressure, gauge, Pa, and the
            standard deviation of the latter.
        log_likelihood: log-likelihood of each variant.
    """

    fit: np.ndarray
    information: np.ndarray
    pending: np.ndarray
    scatter: np.ndarray
    learnt: np.ndarray
    time: np.ndarray
    begun: np.ndarray
    reached: np.ndarray
    rates: np.ndarray
    sums: np.ndarray
    supply: np.ndarray
    log_likelihood: np.ndarray


class ChamberConstants(NamedTuple):
    """Constants of the chambers.

    Attributes:
        dead: volume without bend, m³.
        displacement: change of the volume with the bend, m³/rad.
        conductance: conductance of the inlet valves, J/(s Pa).
        unit: K times the supply pressure, J.
        supply: nominal supply pressure, gauge, Pa.
        leaks: leak of each variant, 1/s.
        shares: supply pressure of each variant, as a fraction of the measured one.
    """

    dead: float
    displacement: float
    conductance: float
    unit: float
    supply: float
    leaks: np.ndarray
    shares: np.ndarray


class LeakDetector(Stateful):
    """Balances of air of all chambers.

    Attributes:
        strokes: statistics.
    """

    state_attributes = ("strokes",)

    def __init__(self, spec: RobotSpec, *, supply_pa: float, variants: Sequence[tuple[float, float]]) -> None:
        """Create a detector with the values of the robot file.

        Args:
            spec: the robot.
            supply_pa: gauge, Pa.
            variants: possible faults of a chamber as leak (1/s) and fraction of the supply pressure, 0
                without any inflow; the first variant has no fault.
        """
        conductance, _, capacity = conductances(spec, CRITICAL_RATIO)
        leaks, shares = np.array(variants, dtype=float).T
        self._constants = ChamberConstants(
            spec.chamber.dead_volume, spec.chamber.displacement, conductance * REFERENCE_PA,
            capacity * supply_pa, supply_pa, leaks.copy(), shares.copy(),
        )  # fmt: skip
        chambers = (spec.segments, 2)
        self.strokes = StrokeStatistics(
            fit=np.tile([1.0, 0.0], (*chambers, 1)),
            information=np.tile([1 / FLOW_SD**2, 0.0, 1 / LOSS_SD**2], (*chambers, 1)),
            pending=np.zeros((*chambers, 6)),
            scatter=np.full(chambers, SCATTER**2),
            learnt=np.zeros(chambers),
            time=np.full(chambers, np.nan),
            begun=np.zeros((*chambers, 2)),
            reached=np.zeros((*chambers, 2)),
            rates=np.zeros((*chambers, 2 + len(variants))),
            sums=np.zeros((*chambers, 2 + len(variants))),
            supply=np.zeros((*chambers, 3)),
            log_likelihood=np.zeros((*chambers, len(variants))),
        )

    def drop(self, chambers: np.ndarray) -> None:
        """End the strokes of a mask of chambers, shape (segments, 2), as valves may have switched unseen."""
        self.strokes.time[chambers] = np.nan
        # What was learnt in complete strokes remains valid.
        for values in (self.strokes.pending, self.strokes.sums, self.strokes.log_likelihood):
            values[chambers] = 0.0

    def residuals(self, time: float, pressure: np.ndarray, filled: np.ndarray) -> np.ndarray:
        """Return the residuals of current strokes, from which the supply pressure is estimated.

        Args:
            time: s.
            pressure: as in `update`.
            filled: as in `update`.

        Returns:
            Excess of air over the expected amount, its derivative with respect to the supply pressure (1/Pa)
            and its variance, shape (segments, 2, 3); NaN where they are unknown.
        """
        residuals = np.full((*pressure.shape, 3), np.nan)
        _residuals(time, pressure, filled, self.strokes, residuals)
        return residuals

    def update(
        self,
        time: float,
        pressure: np.ndarray,
        bend: np.ndarray,
        bend_sd: np.ndarray,
        filled: np.ndarray,
        sound: np.ndarray,
        supply: tuple[float, float],
    ) -> np.ndarray:
        """Update with measured pressures.

        Args:
            time: s.
            pressure: gauge, shape (segments, 2), Pa, NaN where they are missing.
            bend: bend of each segment, rad.
            bend_sd: standard deviation of the bend, rad.
            filled: time for which each chamber has been filled, shape (segments, 2), s; 0 while it vents.
            sound: probability of no fault of each segment.
            supply: supply pressure (gauge, Pa) and its standard deviation.

        Returns:
            Changes of the log-likelihoods of the variants, shape (segments, 2, variants).
        """
        added = np.zeros_like(self.strokes.log_likelihood)
        _update(time, pressure, bend, bend_sd, filled, sound, supply, self.strokes, self._constants, added)
        return added


@compiled
def _update(time, pressure, bend, bend_sd, filled, sound, supply, strokes, constants, added):  # type: ignore[no-untyped-def]
    """See `LeakDetector.update`."""
    for j in range(pressure.shape[0]):
        for side in range(2):
            gauge, since = pressure[j, side], time - strokes.time[j, side]
            if math.isnan(gauge):
                continue
            continues = since < LONGEST_GAP_S and filled[j, side] > since - 1e-6
            pending, sums = strokes.pending[j, side], strokes.sums[j, side]
            supply_now = strokes.supply[j, side]
            if continues:
                # Correct the inflow of the stroke for the change of the estimated supply pressure.
                for k in range(len(constants.shares)):
                    if constants.shares[k] == 1.0:
                        sums[1 + k] += sums[-1] * (supply[0] - supply_now[1])
            supply_now[1], supply_now[2] = supply
            if continues:
                # A lost command may have closed the valve before the last message. Therefore a message is
                # used only after the next one confirms that the valve is open.
                if sums[1] > LEAST_INFLOW:
                    _accumulate(j, side, strokes)
                    for k in range(len(added[j, side])):
                        log_likelihood = _log_likelihood(j, side, k, constants, strokes)
                        added[j, side, k] = log_likelihood - strokes.log_likelihood[j, side, k]
                        # The sums grow over the whole stroke, so its new likelihood replaces the one before.
                        strokes.log_likelihood[j, side, k] = log_likelihood
            else:
                if pending[0] > 0.0 and sound[j] > SOUND:
                    _learn(j, side, strokes)
                strokes.time[j, side] = math.nan
                pending[:] = 0.0
                sums[:] = 0.0
                strokes.log_likelihood[j, side, :] = 0.0
            if filled[j, side] <= 0.0:
                continue
            size, growth = volume(constants.dead, constants.displacement, bend[j], side)
            held = (gauge + AMBIENT_PA) / constants.unit
            reached, rates = strokes.reached[j, side], strokes.rates[j, side]
            reached[0], reached[1] = held * size, held * abs(growth) * bend_sd[j]
            if not continues:
                strokes.begun[j, side, 0], strokes.begun[j, side, 1] = reached[0], reached[1]
                supply_now[0] = supply[0]
            last, slope = len(rates) - 1, 0.0
            for k in range(len(rates)):
                if k == 0:
                    now = gauge / constants.supply
                elif k == last:
                    now = slope
                else:
                    now, line = 0.0, constants.shares[k - 1] * supply[0]
                    if line > 0.0:
                        passed, _, _ = flow(line + AMBIENT_PA, gauge + AMBIENT_PA, CRITICAL_RATIO)
                        now = constants.conductance * passed / constants.unit
                        if k == 1:  # a difference quotient, because the slope diverges at equal pressures
                            inside, sd = gauge + AMBIENT_PA, max(supply[1], 1.0)
                            more, _, _ = flow(line + sd + AMBIENT_PA, inside, CRITICAL_RATIO)
                            less, _, _ = flow(line - sd + AMBIENT_PA, inside, CRITICAL_RATIO)
                            slope = constants.conductance * (more - less) / (2 * sd) / constants.unit
                if continues:
                    # The trapezoidal rule suffices: pressures arrive many times per stroke.
                    sums[k] += since * (rates[k] + now) / 2
                rates[k] = now
            strokes.time[j, side] = time


@compiled
def _residuals(time, pressure, filled, strokes, residuals):  # type: ignore[no-untyped-def]
    """See `LeakDetector.residuals`."""
    for j in range(pressure.shape[0]):
        for side in range(2):
            since, sums = time - strokes.time[j, side], strokes.sums[j, side]
            continues = since < LONGEST_GAP_S and filled[j, side] > since - 1e-6
            if continues and sums[1] > LEAST_INFLOW and not math.isnan(pressure[j, side]):
                residual, variance, _ = _residual(j, side, sums[1], 0.0, strokes)
                residuals[j, side, 0], residuals[j, side, 2] = residual, variance
                residuals[j, side, 1] = strokes.fit[j, side, 0] * sums[-1]


@compiled
def _covariance(information):  # type: ignore[no-untyped-def]
    """Return the covariance of the fit: c with c, c with λ₀, λ₀ with λ₀."""
    size = information[0] * information[2] - information[1] ** 2
    return information[2] / size, -information[1] / size, information[0] / size


@compiled
def _residual(j, side, inflow, leak, strokes):  # type: ignore[no-untyped-def]
    """Return the residual of a stroke, its variance, and the variance that the fit contributes."""
    outflow, fit = strokes.sums[j, side, 0], strokes.fit[j, side]
    flow_sd2, covariance, loss_sd2 = _covariance(strokes.information[j, side])
    gain = strokes.reached[j, side, 0] - strokes.begun[j, side, 0]
    residual = gain - fit[0] * inflow + (fit[1] + leak) * outflow
    learnt = flow_sd2 * inflow**2 - 2 * covariance * inflow * outflow + loss_sd2 * outflow**2
    read = strokes.reached[j, side, 1] ** 2 + strokes.begun[j, side, 1] ** 2 + AMOUNT_SD**2
    # The time at which the supply pressure changed within the stroke is unknown.
    begun, now, sd = strokes.supply[j, side]
    changed = (now - begun) ** 2 + sd**2
    read += changed * (fit[0] * strokes.sums[j, side, -1]) ** 2
    return residual, learnt + read + strokes.scatter[j, side] * inflow**2, learnt


@compiled
def _log_likelihood(j, side, variant, constants, strokes):  # type: ignore[no-untyped-def]
    """Return the log-likelihood of a variant."""
    inflow, leak = strokes.sums[j, side, 1 + variant], constants.leaks[variant]
    residual, variance, _ = _residual(j, side, inflow, leak, strokes)
    variance += (LEAK_RATE_SD * leak * strokes.sums[j, side, 0]) ** 2
    if constants.shares[variant] < 1.0:
        variance += (WEAK_INFLOW_SD * inflow) ** 2
    # Student's t distribution: a single outlier must not decide for a fault.
    return -math.log1p(residual * residual / variance / TAILS) * (TAILS + 1) / 2 - math.log(variance) / 2


@compiled
def _accumulate(j, side, strokes):  # type: ignore[no-untyped-def]
    """Add a message to the pending statistics of its stroke, for `_learn` if there is no fault."""
    inflow, outflow, pending = strokes.sums[j, side, 1], -strokes.sums[j, side, 0], strokes.pending[j, side]
    residual, variance, learnt = _residual(j, side, inflow, 0.0, strokes)
    weight = 1 / (MESSAGES_PER_INDEPENDENT * (variance - learnt))
    pending[0] += weight * inflow * inflow
    pending[1] += weight * inflow * outflow
    pending[2] += weight * outflow * outflow
    pending[3] += weight * inflow * residual
    pending[4] += weight * outflow * residual
    # Clip outliers, so that a single one increases the scatter by at most a residual at the limit.
    pending[5] = (min(residual**2, LIMIT**2 * variance) - variance) / inflow**2


@compiled
def _learn(j, side, strokes):  # type: ignore[no-untyped-def]
    """Update c, λ₀ and the scatter with a stroke without a fault."""
    pending, information, fit = strokes.pending[j, side], strokes.information[j, side], strokes.fit[j, side]
    strokes.learnt[j, side] = min(strokes.learnt[j, side] + 1, MOST_STROKES)
    share = 1 / (strokes.learnt[j, side] + SCATTER_STROKES)
    scatter = strokes.scatter[j, side] + share * pending[5]
    strokes.scatter[j, side] = max(scatter, LEAST_SCATTER**2)
    # Old strokes lose weight, so that the fit follows slow changes of the chambers.
    information[0] = FORGETTING * information[0] + (1 - FORGETTING) / FLOW_SD**2 + pending[0]
    information[1] = FORGETTING * information[1] + pending[1]
    information[2] = FORGETTING * information[2] + (1 - FORGETTING) / LOSS_SD**2 + pending[2]
    flow_sd2, covariance, loss_sd2 = _covariance(information)
    fit[0] += flow_sd2 * pending[3] + covariance * pending[4]
    fit[1] += covariance * pending[3] + loss_sd2 * pending[4]
