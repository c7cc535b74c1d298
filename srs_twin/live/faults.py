r"""FaultBank: which part of a robot has just failed, from commands, bend readings and markers.

Each segment by itself. A hypothesis m says what its valves, chambers and sensor do (`HYPOTHESES`). Under
each, the pressures of the chambers follow from the commands alone, by the lags of `LagPneumatics`, and with
them the drive A± = G a± of either chamber (rad), where a± is the pressure with the lag of the mode τ₂. The
bend and its readings:

$$ q = b + g^+ A_m^+ - g^- A_m^- + d, \qquad y = q + s + n, \qquad y_{markers} = q + n', $$

with bias b and gains g± of the module, which nobody knows and which hardly change, d what load, inertia and
whatever the lags do not tell bend it by (it fades with ρ a tick), and s the sensor's own bias, which drifts
under one of the hypotheses. All are linear in (b, g⁺, g⁻, d, s): one Kalman filter a hypothesis, mixed as by
Blom and Bar-Shalom (1988), the interacting multiple model estimator. Faults begin seldom and do not heal.

A supply that starves makes every segment weak at once: what is weak in one segment alone is no supply.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from srs_twin.pneumatics.chambers import bend_law, bent, gains
from srs_twin.robot.spec import RobotSpec

OBEYS, FILLS, VENTS, LEAKS, WEAK = range(5)
READS, SILENT, FROZEN, DRIFTS = range(4)


class Hypothesis(NamedTuple):
    """What is so in a segment.

    Attributes:
        name: as it is told; empty: nothing is wrong.
        plus: what the + chamber does.
        minus: what the − chamber does.
        sensor: what the sensor does.
    """

    name: str
    plus: int = OBEYS
    minus: int = OBEYS
    sensor: int = READS


HYPOTHESES = (
    Hypothesis(""),
    Hypothesis("stuck_valve +=open", plus=FILLS),
    Hypothesis("stuck_valve +=closed", plus=VENTS),
    Hypothesis("stuck_valve -=open", minus=FILLS),
    Hypothesis("stuck_valve -=closed", minus=VENTS),
    Hypothesis("leak +", plus=LEAKS),
    Hypothesis("leak -", minus=LEAKS),
    Hypothesis("weak", plus=WEAK, minus=WEAK),
    Hypothesis("dead_sensor", sensor=SILENT),
    Hypothesis("dead_sensor frozen", sensor=FROZEN),
    Hypothesis("drifting_sensor", sensor=DRIFTS),
)
STARVED = "starved"
_WEAK = next(k for k, each in enumerate(HYPOTHESES) if each.name == "weak")
_ALIKE = ((1, 4), (2, 3))
"""Where the two chambers take turns, one that never vents bends as if the other one never filled."""
_UNDECIDED = 3
"""Times the patience, before two that look alike are named together."""
_TAILS = 4.0  # degrees of freedom of Student's t
_BIAS, _PLUS, _MINUS, _LOAD, _SENSOR = range(5)


@dataclass(frozen=True)
class BankSettings:
    """What the filters take for granted.

    Attributes:
        begins: probability that a part fails in a tick.
        sure: probability from which a fault is named.
        patience: for how many ticks.
        noise: of bend readings, RMS, rad.
        marker_noise: of a bend by markers, RMS, rad.
        loss: share of readings that are lost.
        gain: spread of the modules' gains.
        bias: of their bends without pressure, rad.
        pressure: what a pressure may differ from its lag's by, as a share of the supply's.
        load: RMS of d, rad.
        load_time: over which d fades, s.
        leak: of a chamber that leaks, as a share of its pressure, 1/s.
        weak: share of the supply's pressure that a weak segment gets.
        drift: of a sensor, rad a square root of a second.
    """

    begins: float = 1e-5
    sure: float = 0.99
    patience: int = 8
    noise: float = 0.02
    marker_noise: float = 0.025
    loss: float = 0.05
    gain: float = 0.15
    bias: float = 0.05
    pressure: float = 0.12
    load: float = 0.08
    load_time: float = 0.15
    leak: float = 6.0
    weak: float = 0.5
    drift: float = 0.03


class FaultBank:
    """Hypotheses of all segments, tick by tick.

    Attributes:
        probability: of each hypothesis, shape (segments, hypotheses).
        mean: of b, g⁺, g⁻, d, s under each, shape (segments, hypotheses, 5).
        named: segment (from 1) → the fault that it was found to have; 0 → the supply.
    """

    def __init__(
        self, spec: RobotSpec, *, supply_pa: float, tick: float, settings: BankSettings = BankSettings()
    ) -> None:
        """Begin with a robot at rest, chambers empty.

        Args:
            spec: the robot, as far as it is known.
            supply_pa: gauge, Pa.
            tick: s.
            settings: of the filters.
        """
        self._settings, self._tick, actuator = settings, tick, spec.actuator
        self._fill, self._vent, self._tau = actuator.tau_fill, actuator.tau_vent, actuator.tau_mode
        count, kinds = spec.segments, len(HYPOTHESES)
        self._supply, self._law = supply_pa, bend_law(spec)
        self._gain = gains(spec)
        self._pressure = np.zeros((count, kinds, 2))
        self._delayed = np.zeros((count, kinds, 2))
        self._does = np.array([[each.plus, each.minus] for each in HYPOTHESES])
        self._sensor = np.array([each.sensor for each in HYPOTHESES])
        s = settings
        self.mean = np.zeros((count, kinds, 5))
        self.mean[..., _PLUS] = self.mean[..., _MINUS] = 1.0
        spread = np.array([s.bias, s.gain, s.gain, s.load, s.noise])
        self._spread = np.tile(np.diag(spread**2), (count, kinds, 1, 1))
        self._fades = np.array([1.0, 1.0, 1.0, math.exp(-tick / s.load_time), 1.0])
        wander = np.array([2e-4, 5e-4, 5e-4, s.load * math.sqrt(1 - self._fades[_LOAD] ** 2), 1e-5])
        self._wander = np.tile(np.diag(wander**2), (kinds, 1, 1))
        self._wander[self._sensor == DRIFTS, _SENSOR, _SENSOR] = s.drift**2 * tick
        self.probability = np.zeros((count, kinds))
        self.probability[:, 0] = 1.0
        # What failed does not heal, but may have been taken for something else at first.
        self._moves = np.full((kinds, kinds), s.begins)
        self._moves[1:, 0] = 0.0
        np.fill_diagonal(self._moves, 0.0)
        np.fill_diagonal(self._moves, 1 - self._moves.sum(axis=1))
        self._last = np.full(count, np.nan)
        self._sure = np.zeros((count, kinds), dtype=int)
        self._either = {pair: np.zeros(count, dtype=int) for pair in _ALIKE}
        self.named: dict[int, str] = {}

    def step(
        self,
        valves: np.ndarray,
        readings: np.ndarray,
        markers: np.ndarray | None = None,
        pressures: np.ndarray | None = None,
    ) -> None:
        """Take a tick.

        Args:
            valves: that were commanded for it: states, shape (segments, 2) or (slots, segments, 2), or
                duties.
            readings: bends at its end, rad, NaN where none came.
            markers: bends by markers, rad, NaN where there are none; None: nowhere.
            pressures: of the chambers, gauge, shape (segments, 2), Pa, NaN where none came; None: nowhere.
        """
        self._mix()
        self._fill_chambers(np.asarray(valves, dtype=float))
        drive = self._gain[:, None] * self._delayed
        drive = drive * self._bent(drive)
        rows = np.ones((*self.probability.shape, 5))
        rows[..., _PLUS], rows[..., _MINUS] = drive[..., 0], -drive[..., 1]
        told = np.asarray(readings, dtype=float)
        likely = self._unlike_readings(told)
        reads = np.isin(self._sensor, (READS, DRIFTS))
        likely += self._update(rows, told, self._settings.noise, reads)
        if markers is not None:
            rows[..., _SENSOR] = 0.0
            everywhere = np.ones(len(HYPOTHESES), dtype=bool)
            likely += self._update(rows, np.asarray(markers), self._settings.marker_noise, everywhere)
        if pressures is not None:
            likely += self._unlike_pressures(np.asarray(pressures, dtype=float))
        weight = self.probability * np.exp(likely - likely.max(axis=1, keepdims=True))
        self.probability = np.maximum(weight / weight.sum(axis=1, keepdims=True), 1e-12)
        self._last = np.where(np.isnan(told), self._last, told)
        self._name()

    def gains(self) -> np.ndarray:
        """Return g⁺ and g⁻ of each segment, shape (segments, 2), by what is most likely."""
        return np.asarray(np.einsum("sm,smi->si", self.probability, self.mean)[:, _PLUS : _MINUS + 1])

    def _fill_chambers(self, valves: np.ndarray) -> None:
        """Advance pressures, and what of them has reached the bend, by a tick."""
        if valves.ndim == 3:
            valves = valves.mean(axis=0)
        duty = (valves + 1) / 2 if (np.abs(valves) > 1 - 1e-9).all() or valves.min() < 0 else valves
        does = self._does
        opens = np.where(does == FILLS, 1.0, np.where(does == VENTS, 0.0, duty[:, None]))
        leak = np.where(does == LEAKS, self._settings.leak, 0.0)
        supply = self._supply * np.where(does == WEAK, self._settings.weak, 1.0)
        rate = opens / self._fill + (1 - opens) / self._vent + leak
        ends = opens * supply / self._fill / rate
        h, tau = self._tick, self._tau
        fast, slow = np.exp(-rate * h), math.exp(-h / tau)
        apart = 1 - rate * tau
        apart = np.where(np.abs(apart) < 1e-6, 1e-6, apart)
        begun = self._pressure - ends
        self._delayed = ends + begun * (fast - slow) / apart + (self._delayed - ends) * slow
        self._pressure = ends + begun * fast

    def _bent(self, drive: np.ndarray) -> np.ndarray:
        """Return what share of a linear drive bends a segment, shape (segments, hypotheses, 1)."""
        linear = drive[..., 0] - drive[..., 1]
        if math.isinf(self._law[0]) and self._law[1] == 0.0:
            return np.ones((*linear.shape, 1))
        found = np.array([bent(x, self._law)[0] for x in linear.ravel()]).reshape(linear.shape)
        at_rest = bent(0.0, self._law)[1]
        share = np.where(np.abs(linear) > 1e-9, found / np.where(linear == 0, 1.0, linear), at_rest)
        return np.asarray(share[..., None])

    def _mix(self) -> None:
        """Let each hypothesis begin from what has led to it, its chambers too, and everything wander."""
        joint = self.probability[:, :, None] * self._moves
        coming = joint.sum(axis=1)
        share = joint / np.maximum(coming[:, None, :], 1e-300)
        mean = np.einsum("sij,sik->sjk", share, self.mean)
        off = self.mean[:, :, None, :] - mean[:, None, :, :]
        spread = np.einsum("sij,sikl->sjkl", share, self._spread)
        spread += np.einsum("sij,sijk,sijl->sjkl", share, off, off)
        self.mean = mean * self._fades
        self._spread = spread * np.outer(self._fades, self._fades) + self._wander
        self._pressure = np.einsum("sij,sik->sjk", share, self._pressure)
        self._delayed = np.einsum("sij,sik->sjk", share, self._delayed)
        self.probability = coming

    def _update(self, rows: np.ndarray, told: np.ndarray, noise: float, where: np.ndarray) -> np.ndarray:
        """Correct by one number a segment; return the logarithm of its likelihood, 0 where there is none."""
        there = ~np.isnan(told)[:, None] & where
        seen = np.einsum("smkl,sml->smk", self._spread, rows)
        variance = np.einsum("smk,smk->sm", rows, seen) + noise**2
        off = np.where(there, np.nan_to_num(told)[:, None] - np.einsum("smk,smk->sm", rows, self.mean), 0.0)
        weight = np.where(there[..., None], seen / variance[..., None], 0.0)
        self.mean = self.mean + weight * off[..., None]
        self._spread = self._spread - weight[..., :, None] * seen[..., None, :]
        return np.where(there, -0.5 * (off**2 / variance + np.log(2 * math.pi * variance)), 0.0)

    def _unlike_readings(self, told: np.ndarray) -> np.ndarray:
        """Return the logarithms of how likely it is to hear nothing, or the same again."""
        found, lost = np.zeros(self.probability.shape), np.isnan(told)[:, None]
        loss = self._settings.loss
        silent, frozen = self._sensor == SILENT, self._sensor == FROZEN
        found[:, ~silent] = np.where(lost, math.log(loss), math.log(1 - loss))
        found[:, silent] = np.where(lost, math.log(0.999), math.log(1e-3 / (2 * math.pi)))
        narrow = self._settings.noise / 10
        again = np.nan_to_num(told - self._last, nan=10.0)[:, None]
        density = -0.5 * (again / narrow) ** 2 - math.log(narrow * math.sqrt(2 * math.pi))
        found[:, frozen] += np.where(lost, 0.0, np.maximum(density, -50.0))
        return found

    def _unlike_pressures(self, told: np.ndarray) -> np.ndarray:
        """Return the logarithms of how likely pressures are; what lags miss of them lasts, so few count."""
        s = self._settings
        share = np.nan_to_num((told[:, None] - self._pressure) / (s.pressure * self._supply))
        log = -np.log1p(share**2 / _TAILS) * (_TAILS + 1) / 2
        return np.asarray(log.sum(axis=-1) * min(self._tick / s.load_time, 1.0))

    def _name(self) -> None:
        """Name what has been sure for long enough."""
        sure = self.probability > self._settings.sure
        self._sure = np.where(sure, self._sure + 1, 0)
        for pair in _ALIKE:
            both = self.probability[:, pair].sum(axis=1) > self._settings.sure
            self._either[pair] = np.where(both, self._either[pair] + 1, 0)
            for j in np.flatnonzero(self._either[pair] >= _UNDECIDED * self._settings.patience):
                names = " or ".join(HYPOTHESES[m].name for m in pair)
                self.named.setdefault(int(j) + 1, names)
        weak = self.probability[:, _WEAK] > 0.5
        if weak.sum() * 2 > len(weak):
            self.named.setdefault(0, STARVED)
        for j, m in np.argwhere(self._sure >= self._settings.patience):
            if m and not (m == _WEAK or 0 in self.named):
                self.named.setdefault(int(j) + 1, HYPOTHESES[m].name)
