r"""Interacting multiple model filter that detects faults of each segment.

Each fault hypothesis m describes the behaviour of the valves, the chambers and the bend
sensor of a segment (`fault_hypotheses`). Under each hypothesis, the chamber pressures
follow the first-order model of `pneumatics.lag`. The lagged pressures determine the
drives $A^\pm = G a^\pm$ (rad), which are scaled so that their difference is the free
bend. The bend and its measurements are

$$ q = b + g^+ A_m^+ - g^- A_m^- + d, \qquad y = (1 + e)\,q + s + n, \qquad y_{markers} = q + n'. $$

Symbols:

- q: bend of the segment, rad
- b: constant bias of the module, rad
- g⁺, g⁻: gains of the + and − chambers, dimensionless
- A⁺, A⁻: drives, which are the contributions of the two chambers to the free bend, rad
- G: drive per pressure, rad/Pa
- a⁺, a⁻: chamber pressures after the lag τ₂, Pa
- d: disturbance due to load, inertia and model error, modelled as a first-order
  Gauss–Markov process, rad
- y, y_markers: bends measured by the sensor and by markers, rad
- s: offset of the sensor, rad
- e: scale error of the sensor, dimensionless
- n, n': measurement noise, rad

For each hypothesis, a Kalman filter with a linearised product e q estimates the state
(b, g⁺, g⁻, d, s, e). Under the hypothesis of a drifting sensor, the offset s has a
large random walk. The filters are mixed as in Blom and Bar-Shalom (1988). Faults are
assumed to be rare and permanent.

While a segment has no fault, the detector learns how the pressures deviate from the
first-order model (`pressure_table`). Leaks are detected from air balances
(`air_balance`).

All pressures are relative to the estimated supply pressure (`air_balance`), so a slow
decrease of the supply pressure is not reported as a segment fault. If more than half of
the segments suddenly appear to be weak or to leak, the detector corrects the estimated
supply pressure instead. Without pressure measurements, only weak segments count.

The detector reports the fault `low_supply_pressure` if the estimate is below the
fraction `LOW_SUPPLY_FRACTION` of the nominal pressure by more than one standard
deviation. The report ends when the estimate exceeds the fraction `RECOVERED_ABOVE` by
one standard deviation. During the report, the detector attributes all weak chambers and
leaks to the supply.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from srs_twin.io.saved_state import Stateful
from srs_twin.live.air_balance import (
    LOW_SUPPLY_FRACTION,
    MESSAGES_PER_INDEPENDENT,
    RECOVERED_ABOVE,
    SUDDEN,
    LeakDetector,
    SupplyFilter,
    log_student,
)
from srs_twin.live.fault_hypotheses import (
    CHAMBERS,
    HYPOTHESES,
    LEAK_RATES,
    SENSORS,
    START_S,
    SUPPLY_FRACTIONS,
    WEAK,
    ChamberBehaviour,
    FaultDecision,
    SensorBehaviour,
    valve_duty,
)
from srs_twin.live.pressure_table import PressureLevels
from srs_twin.live.uncertain import Estimates
from srs_twin.pneumatics.chambers import chamber_gains, free_bends, largest_bend
from srs_twin.pneumatics.lag import lag_response, relax, relaxation_of
from srs_twin.robot.spec import RobotSpec

_FAULT_RATE = 1e-3
"""Rate of transitions to each fault hypothesis, 1/s."""
_NOISE_RAD = 0.02
"""Standard deviation of the bend sensor noise, rad."""
_MARKER_NOISE_RAD = 0.025
"""Standard deviation of the noise in bends measured by motion capture, rad."""
_LOSS = 0.05
"""Probability that the reading of an intact bend sensor is missing."""
# Prior standard deviations of the gains g, the biases b (rad), the sensor offsets s
# (rad) and the scale errors e.
_GAIN_SD = 0.15
_BIAS_SD_RAD = 0.05
_OFFSET_SD_RAD = 0.06
_SCALE_SD = 0.05
_PRESSURE_SD = 0.12
"""Initial standard deviation of pressure residuals, relative to the supply pressure."""
_LEAST_PRESSURE_SD = 0.02
"""Minimum standard deviation of pressure residuals, relative to the supply pressure."""
_LOAD_SD = 0.11
"""Standard deviation of the disturbance d, relative to the maximum bend."""
_LOAD_TIME_S = 0.15
"""Time constant of the disturbance d, s."""
_PRESSURE_TIME_S = 0.08
"""Correlation time of the pressure residuals, s."""
# Random walks of the biases (rad/√s), of the gains (1/√s), and of the offsets of intact
# and drifting sensors (rad/√s).
_BIAS_WALK = 0.0014
_GAIN_WALK = 0.0035
_OFFSET_WALK = 0.002
_DRIFT_WALK = 0.03
_FAILED_BELOW = 0.85
"""Ratio of measured to expected pressure below which the supply may have failed.

If most segments appear to leak or to be weak, the supply is then held responsible."""
_SETTLED_S = 0.1
"""Filling time after which the chamber pressure is close to the supply pressure, s."""
_BALANCED_STROKES = 3
"""Number of strokes from which the air balance of a chamber is used to detect leaks."""
_TAILS = 4.0
"""Degrees of freedom of Student's t distribution for normalised residuals."""
_AT_REST_RAD = 1e-6
_LEAST_PROBABILITY = 1e-12
_FROZEN_NOISE = 0.1
"""Standard deviation of changes in frozen readings, relative to the sensor noise."""
_SUPPLY_EXPLAINS = (SUPPLY_FRACTIONS < 1.0) | np.isin(
    CHAMBERS, (ChamberBehaviour.LEAKS, ChamberBehaviour.VENTS)
).any(axis=1)
"""Mask of the hypotheses that a low supply pressure can explain."""


class _State(IntEnum):
    BIAS = 0
    PLUS = 1
    MINUS = 2
    LOAD = 3
    OFFSET = 4
    SCALE = 5


_MODULE = [_State.PLUS, _State.MINUS, _State.BIAS]


class FaultDetector(Stateful):
    """Fault detector with an interacting multiple model filter for each segment.

    Attributes:
        probability: probability of each hypothesis, shape (segments, hypotheses).
        mean: estimated states (b, g⁺, g⁻, d, s, e), shape (segments, hypotheses, 6).
        decision: decision rule with the detected faults.
        time: time since the last start of the robot, s.
    """

    state_attributes = (
        "probability",
        "mean",
        "_covariance",
        "_levels",
        "decision",
        "leaks",
        "supply",
    )

    def __init__(self, spec: RobotSpec, *, supply_pa: float) -> None:
        """Initialise the detector for a nominal gauge pressure of the supply (Pa)."""
        self._spec = spec
        actuator = spec.actuator
        self._fill = actuator.tau_fill
        self._vent = actuator.tau_vent
        self._tau = actuator.tau_mode
        count = spec.segments
        kinds = len(HYPOTHESES)
        self.supply = SupplyFilter(supply_pa)
        self._gain = chamber_gains(spec)
        # If the robot is already moving or has restarted, its pressures are unknown
        # until several time constants have passed.
        self._settling_s = 4 * (max(self._fill, self._vent) + self._tau)
        self._pressure = np.zeros((count, kinds, 2))
        self._delayed = np.zeros((count, kinds, 2))
        self._levels = PressureLevels(count, _PRESSURE_SD)
        self.mean = np.zeros((count, kinds, 6))
        self.mean[..., _State.PLUS] = self.mean[..., _State.MINUS] = 1.0
        self._largest = largest_bend(spec, supply_pa)
        self._load = _LOAD_SD * self._largest
        self._obeys = np.isin(
            CHAMBERS, (ChamberBehaviour.OBEYS, ChamberBehaviour.LEAKS)
        )
        inflows = [h.inflow(chamber) for h in HYPOTHESES for chamber in h.chambers]
        variants = list(dict.fromkeys(inflows))
        self._variant = np.reshape(list(map(variants.index, inflows)), (kinds, 2))
        self.leaks = LeakDetector(spec, supply_pa=supply_pa, variants=variants)
        sd = _BIAS_SD_RAD, _GAIN_SD, _GAIN_SD, self._load, _OFFSET_SD_RAD, _SCALE_SD
        self._covariance = np.tile(np.diag(np.square(sd)), (count, kinds, 1, 1))
        self.probability = np.zeros((count, kinds))
        self.probability[:, 0] = 1.0
        # The level is the latest median ratio of measured to expected pressures in
        # filling chambers, or NaN as long as too few chambers have settled.
        self._level = math.nan
        self._last = np.full(count, np.nan)
        self.time = 0.0
        self.decision = FaultDecision(count)

    @property
    def detected_faults(self) -> dict[int, str]:
        """Detected faults, keyed by segment number or 0 for the supply."""
        return self.decision.detected_faults

    def clear_fault(self, number: int) -> None:
        """Clear the detected fault of a segment, or of the supply if `number` is 0."""
        self.decision.clear(number)
        if number == 0:
            self.supply = SupplyFilter(self.supply.nominal)
        else:
            self.probability[number - 1] = 0.0
            self.probability[number - 1, 0] = 1.0

    def restart(self) -> None:
        """Treat the pressures as unknown after a restart, but keep learnt values."""
        self.time = 0.0
        self._level = math.nan
        self.leaks.drop_all()

    def inflate(self, switched: np.ndarray, dt: float) -> None:
        """Increase the variance of the disturbances d after unobserved duty changes.

        The duties changed by `switched`, shape (segments, 2), within a time `dt` (s).
        """
        self.leaks.drop(switched > 0)
        reached = 1 - math.exp(-dt / self._fill)
        change = self._largest * switched.sum(axis=1) / 2 * reached
        self._covariance[..., _State.LOAD, _State.LOAD] += change[:, None] ** 2

    def most_likely(self) -> np.ndarray:
        """Return the index of the most likely hypothesis for each segment."""
        return self.decision.most_likely(self.probability)

    def modules(self) -> Estimates:
        """Return estimates of g⁺, g⁻ and b (rad), shape (segments, 3)."""
        values = self.mean[..., _MODULE]
        variances = np.einsum("smii->smi", self._covariance)[..., _MODULE]
        mean = np.einsum("sm,smi->si", self.probability, values)
        square = variances + (values - mean[:, None]) ** 2
        variance = np.einsum("sm,smi->si", self.probability, square)
        return Estimates(mean, np.sqrt(variance))

    def corrected(self, readings: np.ndarray) -> Estimates:
        """Correct bend readings (rad) for estimated sensor offsets and scale errors."""
        mean = np.einsum("sm,smk->sk", self.probability, self.mean)
        bends = (readings - mean[:, _State.OFFSET]) / (1 + mean[:, _State.SCALE])
        observation_matrix = np.zeros_like(mean)
        observation_matrix[:, _State.OFFSET] = 1.0
        observation_matrix[:, _State.SCALE] = np.nan_to_num(bends)
        variance = np.einsum(
            "sm,sk,smkl,sl->s",
            self.probability,
            observation_matrix,
            self._covariance,
            observation_matrix,
        )
        return Estimates(bends, np.sqrt(variance))

    def parameters(self) -> dict[str, Estimates]:
        """Return the gains ("gain") and biases ("bias_rad", rad) of the modules."""
        mean, sd = self.modules()
        return {
            "gain": Estimates(mean[:, :2], sd[:, :2]),
            "bias_rad": Estimates(mean[:, 2], sd[:, 2]),
        }

    def predict(self, duty: np.ndarray, dt: float) -> None:
        """Advance all hypotheses by one time step (s) with the commanded duties."""
        self.time += dt
        self.supply.predict(dt)
        self._mix(dt)
        duty = np.asarray(duty, dtype=float)
        self._levels.ages.advance(duty, dt)
        self._advance_chambers(duty, dt)

    def update(
        self,
        readings: np.ndarray | None = None,
        markers: np.ndarray | None = None,
        pressures: np.ndarray | None = None,
        *,
        dt: float = 0.02,
        heading_noise_scale: float = 1.0,
    ) -> None:
        """Update all hypotheses with measurements made at the current time.

        Args:
            readings: bends measured by the sensors, shape (segments,), rad, with NaN
                for missing readings, or None if no message arrived.
            markers: bends measured by motion capture, shape (segments,), rad, with NaN
                for missing bends, or None if no frame arrived.
            pressures: gauge pressures of the chambers, shape (segments, 2), Pa, with
                NaN for missing pressures, or None if no message arrived.
            dt: time since the previous pressure message, s.
            heading_noise_scale: heading noise of motion capture, divided by the assumed
                heading noise.
        """
        if self.time < self._settling_s:
            return
        observation_matrix = self._observation_matrix()
        log_likelihood = np.zeros(self.probability.shape)
        if readings is not None:
            readings = np.asarray(readings, dtype=float)
            log_likelihood += self._sensor_log_likelihood(readings)
            log_likelihood += self._update_by_readings(observation_matrix, readings)
        if markers is not None:
            noise = heading_noise_scale * _MARKER_NOISE_RAD
            log_likelihood += self._measurement_update(
                observation_matrix, np.asarray(markers), noise
            )
        if pressures is not None:
            pressures = np.asarray(pressures, dtype=float)
            log_likelihood += self._pressure_log_likelihood(pressures, dt)
            log_likelihood += self._leak_log_likelihood(pressures, observation_matrix)
        log_likelihood -= log_likelihood.max(axis=1, keepdims=True)
        weight = self.probability * np.exp(log_likelihood)
        weight /= weight.sum(axis=1, keepdims=True)
        self.probability = np.maximum(weight, _LEAST_PROBABILITY)
        self._judge_supply()
        self.decision.update(self.time, self.probability)

    def update_supply(self, pressure: float) -> None:
        """Update the supply estimate with a measured gauge pressure (Pa)."""
        before = self.supply.pressure
        self.supply.measure(pressure)
        self._rescale(before)
        self._judge_supply()

    def _advance_chambers(self, duty: np.ndarray, dt: float) -> None:
        duty = valve_duty(duty[:, None], CHAMBERS)
        leak = np.where(CHAMBERS == ChamberBehaviour.LEAKS, LEAK_RATES[:, None], 0.0)
        supply = self.supply.pressure * SUPPLY_FRACTIONS[:, None]
        relaxation = relaxation_of(
            duty / self._fill, (1 - duty) / self._vent, supply, leak
        )
        self._delayed = lag_response(
            self._delayed, self._pressure, relaxation, self._tau, dt
        )
        self._pressure = relax(self._pressure, *relaxation, dt)

    def _observation_matrix(self) -> np.ndarray:
        drive = self._gain[:, None] * self._delayed
        linear = drive[..., 0] - drive[..., 1]
        # If both drives are equal, the scale factor of the drives is undefined and is
        # computed for a small difference instead.
        linear = np.where(np.abs(linear) < _AT_REST_RAD, _AT_REST_RAD, linear)
        drive = drive * (free_bends(self._spec, linear) / linear)[..., None]
        observation_matrix = np.ones((*self.probability.shape, 6))
        observation_matrix[..., _State.PLUS] = drive[..., 0]
        observation_matrix[..., _State.MINUS] = -drive[..., 1]
        observation_matrix[..., [_State.OFFSET, _State.SCALE]] = 0.0
        return observation_matrix

    def _mix(self, dt: float) -> None:
        # Faults are permanent, but transitions between faults are possible, because
        # new measurements may change the most likely fault.
        transition = np.full((len(HYPOTHESES),) * 2, _FAULT_RATE * dt)
        transition[1:, 0] = 0.0
        np.fill_diagonal(transition, 0.0)
        np.fill_diagonal(transition, 1 - transition.sum(axis=1))
        decay = np.array([1.0, 1.0, 1.0, math.exp(-dt / _LOAD_TIME_S), 1.0, 1.0])
        root = math.sqrt(dt)
        bias = _BIAS_WALK * root
        gain = _GAIN_WALK * root
        offset = _OFFSET_WALK * root
        load = self._load * math.sqrt(1 - decay[_State.LOAD] ** 2)
        sound = np.diag([bias, gain, gain, load, offset, 0.0]) ** 2
        noise = np.tile(sound, (len(HYPOTHESES), 1, 1))
        drifts = SENSORS == SensorBehaviour.DRIFTS
        noise[drifts, _State.OFFSET, _State.OFFSET] = (_DRIFT_WALK * root) ** 2
        # `joint` is the probability that hypothesis i was true before the step and
        # hypothesis j is true after the step. `fraction` is the conditional probability
        # of i, given j.
        joint = self.probability[:, :, None] * transition
        predicted = joint.sum(axis=1)
        fraction = joint / np.maximum(predicted[:, None, :], 1e-300)
        mean = np.einsum("sij,sik->sjk", fraction, self.mean)
        difference = self.mean[:, :, None, :] - mean[:, None, :, :]
        covariance = np.einsum("sij,sikl->sjkl", fraction, self._covariance)
        covariance += np.einsum("sij,sijk,sijl->sjkl", fraction, difference, difference)
        self.mean = mean * decay
        self._covariance = covariance * np.outer(decay, decay) + noise
        self._pressure = np.einsum("sij,sik->sjk", fraction, self._pressure)
        self._delayed = np.einsum("sij,sik->sjk", fraction, self._delayed)
        self.probability = predicted

    def _update_by_readings(
        self, observation_matrix: np.ndarray, readings: np.ndarray
    ) -> np.ndarray:
        reading_matrix = observation_matrix.copy()
        # The reading is (1 + e) q + s, with the derivatives 1 with respect to s and q
        # with respect to e.
        reading_matrix[..., _State.OFFSET] = 1.0
        reading_matrix[..., _State.SCALE] = np.einsum(
            "smk,smk->sm", observation_matrix, self.mean
        )
        self._last = np.where(np.isnan(readings), self._last, readings)
        reads = np.isin(SENSORS, (SensorBehaviour.READS, SensorBehaviour.DRIFTS))
        return self._measurement_update(reading_matrix, readings, _NOISE_RAD, reads)

    def _measurement_update(
        self,
        observation_matrix: np.ndarray,
        measured: np.ndarray,
        noise: float,
        used: np.ndarray | bool = True,
    ) -> np.ndarray:
        """Correct the Kalman filters, and return log-likelihoods of all hypotheses."""
        available = ~np.isnan(measured)[:, None] & used
        cross_covariance = np.einsum(
            "smkl,sml->smk", self._covariance, observation_matrix
        )
        variance = (
            np.einsum("smk,smk->sm", observation_matrix, cross_covariance) + noise**2
        )
        predicted = np.einsum("smk,smk->sm", observation_matrix, self.mean)
        innovation = np.nan_to_num(measured)[:, None] - predicted
        innovation = np.where(available, innovation, 0.0)
        kalman_gain = np.where(
            available[..., None], cross_covariance / variance[..., None], 0.0
        )
        self.mean = self.mean + kalman_gain * innovation[..., None]
        self._covariance = (
            self._covariance
            - kalman_gain[..., :, None] * cross_covariance[..., None, :]
        )
        # The distribution of model errors has heavy tails under every hypothesis, so
        # Gaussian densities would cause false detections.
        log = log_student(innovation**2 / variance, _TAILS)
        log = log - np.log(variance * 2 * math.pi) / 2
        return np.where(available, log, 0.0)

    def _sensor_log_likelihood(self, readings: np.ndarray) -> np.ndarray:
        log_likelihood = np.zeros(self.probability.shape)
        lost = np.isnan(readings)[:, None]
        silent = SENSORS == SensorBehaviour.SILENT
        frozen = SENSORS == SensorBehaviour.FROZEN
        usual = np.where(lost, math.log(_LOSS), math.log(1 - _LOSS))
        log_likelihood[:, ~silent] = usual
        log_likelihood[:, silent] = np.where(
            lost, math.log(0.999), math.log(1e-3 / (2 * math.pi))
        )
        narrow = _NOISE_RAD * _FROZEN_NOISE
        change = np.nan_to_num(readings - self._last, nan=10.0)[:, None]
        scale = math.log(narrow * math.sqrt(2 * math.pi))
        density = -0.5 * (change / narrow) ** 2 - scale
        log_likelihood[:, frozen] += np.where(lost, 0.0, np.maximum(density, -50.0))
        return log_likelihood

    def _pressure_log_likelihood(self, pressures: np.ndarray, dt: float) -> np.ndarray:
        usual, sd = self._levels.read()
        self._update_supply(pressures, Estimates(usual, sd + _LEAST_PRESSURE_SD))
        residual = pressures[:, None] - self._pressure
        residual = np.nan_to_num(residual / self.supply.pressure)
        # The mean residuals were learnt from valves that obeyed the commands, so the
        # means apply only to hypotheses with such valves.
        residual = residual - np.where(self._obeys, usual[:, None], 0.0)
        spread = np.where(self._obeys, sd[:, None] + _LEAST_PRESSURE_SD, _PRESSURE_SD)
        log = log_student((residual / spread) ** 2, _TAILS) - np.log(spread)
        log = np.where(np.isnan(pressures)[:, None], 0.0, log)
        # After enough strokes, leaks are detected from the air balance instead of the
        # pressure residuals.
        balanced = (self.leaks.learnt >= _BALANCED_STROKES)[:, None]
        replaced = balanced & (CHAMBERS == ChamberBehaviour.LEAKS)
        log = np.where(replaced, log.max(axis=1, keepdims=True), log)
        learns = ~np.isnan(pressures) & (self.probability[:, :1] > 0.9)
        self._levels.update(residual[:, 0], learns)
        return np.asarray(log.sum(axis=-1) * min(dt / _PRESSURE_TIME_S, 1.0))

    def _update_supply(self, pressures: np.ndarray, usual: Estimates) -> None:
        before = self.supply.pressure
        response = self._pressure[:, 0] / before + usual.value
        sd = before * usual.sd
        obeys = np.einsum("sm,mc->sc", self.probability, self._obeys)
        obeys[self.decision.faulty] = 0.0
        filled = self._levels.ages.filled_s
        residual = pressures - before * response
        settled = (filled > _SETTLED_S) & ~np.isnan(pressures) & (obeys > 0.5)
        if settled.sum() * 2 >= len(pressures):
            expected = before * response[settled]
            self._level = float(np.median(pressures[settled] / expected))
        # Chambers whose mean residuals are still unknown are ignored, because most of
        # these chambers may appear to have lost pressure.
        known = settled & self._levels.are_known()
        if self.supply.follow_sudden_change(
            residual[known], response[known], sd[known]
        ):
            self.leaks.drop_all()
            self._adopt_supply(before)
            return
        # Before the first learnt stroke of a chamber, the pressure of the filled
        # chamber is used instead of the air balance.
        balanced = self.leaks.learnt >= 1
        balance = self.leaks.residuals(self.time, pressures, filled)
        self.supply.update(
            np.where(balanced, balance.residual, residual),
            np.where(balanced, balance.derivative, response),
            np.where(balanced, balance.sd, sd),
            np.where(balanced | settled, obeys, 0.0),
            MESSAGES_PER_INDEPENDENT,
        )
        self._adopt_supply(before)

    def _adopt_supply(self, before: float) -> None:
        self._rescale(before)
        if before - self.supply.pressure > SUDDEN * self.supply.nominal:
            # Until the loss of supply pressure is detected, chambers with low pressures
            # appear to leak or not to fill.
            likely = np.where(_SUPPLY_EXPLAINS, self.probability, 0.0).argmax(axis=1)
            self._attribute_to_supply(_SUPPLY_EXPLAINS, likely)

    def _rescale(self, before: float) -> None:
        fraction = self.supply.pressure / before
        self._pressure *= fraction
        self._delayed *= fraction

    def _judge_supply(self) -> None:
        weak = SUPPLY_FRACTIONS < 1.0
        weak_or_leaks = weak | (LEAK_RATES > 0.0)
        kind = np.flatnonzero(weak)[self.probability[:, weak].sum(axis=0).argmax()]
        if math.isnan(self._level):
            fraction = SUPPLY_FRACTIONS[kind]
            common = weak
        else:
            # A supply failure is more likely than simultaneous leaks in several
            # segments.
            fraction = self._level
            common = weak_or_leaks
        suspect = self.probability[:, common].sum(axis=1) > 0.5
        if fraction < _FAILED_BELOW and suspect.mean() > 0.5:
            before = self.supply.pressure
            self.supply.jump(fraction)
            self._rescale(before)
            self._attribute_to_supply(common, np.full(len(self.probability), kind))
            self.leaks.drop_all()
        if self.time < START_S:
            return
        if self.decision.low_supply_pressure:
            # The apparent leaks at a low supply pressure would otherwise remain after
            # the supply has recovered.
            likely = np.where(weak_or_leaks, self.probability, 0.0).argmax(axis=1)
            self._attribute_to_supply(weak_or_leaks, likely)
        # If no pressures are measured, the standard deviation of the supply pressure is
        # ignored, because it never decreases.
        sd = 0.0 if math.isnan(self._level) else self.supply.sd
        if self.supply.pressure + sd < LOW_SUPPLY_FRACTION * self.supply.nominal:
            self.decision.pairs[0, 0] = WEAK
        elif self.supply.pressure - sd > RECOVERED_ABOVE * self.supply.nominal:
            self.decision.clear(0)

    def _attribute_to_supply(self, common: np.ndarray, kind: np.ndarray) -> None:
        moved = self.probability[:, common].sum(axis=1)
        segments = np.flatnonzero(moved > 0.5)
        for states in (self.mean, self._covariance):
            states[segments, 0] = states[segments, kind[segments]]
        self.probability[:, 0] += moved
        self.probability[:, common] = _LEAST_PROBABILITY

    def _leak_log_likelihood(
        self, pressures: np.ndarray, observation_matrix: np.ndarray
    ) -> np.ndarray:
        bends = np.einsum("smk,smk->sm", observation_matrix, self.mean)
        bend = (self.probability * bends).sum(axis=1)
        variance = np.einsum(
            "smk,smkl,sml->sm", observation_matrix, self._covariance, observation_matrix
        )
        variance += (bends - bend[:, None]) ** 2
        sd = np.sqrt((self.probability * variance).sum(axis=1))
        log_likelihood = self.leaks.update(
            self.time,
            pressures,
            Estimates(bend, sd),
            self._levels.ages.filled_s,
            self.probability[:, 0],
            self.supply,
        )
        return np.asarray(log_likelihood[:, np.arange(2), self._variant].sum(axis=-1))
