r"""FaultBank: which part of a robot has just failed, from commands, bend readings, pressures and markers.

Each segment by itself. A hypothesis m says what its valves, chambers and sensor do (`HYPOTHESES`). Under
each, the pressures of the chambers follow from the commands alone, by the lags of `LagPneumatics`, and with
them the drive A± = G a± of either chamber (rad), where a± is the pressure with the lag of the mode τ₂. The
bend and its readings:

$$ q = b + g^+ A_m^+ - g^- A_m^- + d, \qquad y = q + s + n, \qquad y_{markers} = q + n', $$

with bias b and gains g± of the module, which nobody knows and which hardly change, d what load, inertia and
whatever the lags do not tell bend it by (it fades with ρ a tick), and s the sensor's own bias, which drifts
under one of the hypotheses. All are linear in (b, g⁺, g⁻, d, s): one Kalman filter a hypothesis, mixed as by
Blom and Bar-Shalom (1988), the interacting multiple model estimator. Faults begin seldom and do not heal.

How pressures differ from the lags is learnt while a segment is sound, by how long ago its valves switched:
chambers of one robot repeat themselves. What a chamber loses is told by its balance of air (`balance`).

A supply that starves makes every segment weak at once: what is weak in one segment alone is no supply, and
where several segments are in doubt at once, a part of one of them is named later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from srs_twin.io.saved_state import Stateful
from srs_twin.live.balance import AirBalance
from srs_twin.pneumatics.chambers import free_bends, gains, largest_bend
from srs_twin.robot.spec import RobotSpec

OBEYS, FILLS, VENTS, LEAKS = range(4)
READS, SILENT, FROZEN, DRIFTS = range(4)


class Hypothesis(NamedTuple):
    """What is so in a segment.

    Attributes:
        name: as it is told; empty: nothing is wrong.
        plus: what the + chamber does.
        minus: what the − chamber does.
        sensor: what the sensor does.
        leak: of a chamber that leaks, as a share of its pressure, 1/s.
        weak: share of the supply's pressure that a weak segment gets.
    """

    name: str
    plus: int = OBEYS
    minus: int = OBEYS
    sensor: int = READS
    leak: float = 0.0
    weak: float = 1.0

    def inflow(self, does: int) -> tuple[float, float]:
        """Return leak and share of the supply of a chamber that does this while its valve lets air in."""
        return self.leak if does == LEAKS else 0.0, 0.0 if does == VENTS else self.weak


HYPOTHESES = (
    Hypothesis(""),
    Hypothesis("stuck_valve +=open", plus=FILLS),
    Hypothesis("stuck_valve +=closed", plus=VENTS),
    Hypothesis("stuck_valve -=open", minus=FILLS),
    Hypothesis("stuck_valve -=closed", minus=VENTS),
    *(Hypothesis("leak +", plus=LEAKS, leak=rate) for rate in (2.0, 6.0)),
    *(Hypothesis("leak -", minus=LEAKS, leak=rate) for rate in (2.0, 6.0)),
    *(Hypothesis("weak", weak=share) for share in (0.5, 0.15)),
    Hypothesis("dead_sensor", sensor=SILENT),
    Hypothesis("dead_sensor frozen", sensor=FROZEN),
    Hypothesis("drifting_sensor", sensor=DRIFTS),
)
STARVED = "starved"
_NAMES = tuple(dict.fromkeys(each.name for each in HYPOTHESES))
_SAME = np.array([[each.name == name for name in _NAMES] for each in HYPOTHESES], dtype=float)
"""Whether a hypothesis has a name: how severe a fault is does not change what it is called."""
_WEAK = _NAMES.index("weak")
_LEAK = np.array([name.startswith("leak") for name in _NAMES])
_ALIKE = ((1, 4), (2, 3))
"""Where the two chambers take turns, one that never vents bends as if the other one never filled."""
_AGES, _AGE_S, _MOST_SEEN = 25, 0.02, 40
"""For how many ages of a valve's state, of which length, pressures are learnt, from how many at most."""
_BALANCED = 3
"""Strokes after which a chamber's balance of air says whether it leaks."""
_FEW, _ALONE = 0.1, 0.8
"""Where no other segment is that likely weak, each measurement makes it so much less likely of one."""
_DOUBT, _LONGER = 0.5, 3.0
"""A segment that is less likely sound than that is in doubt; by how much longer others then have to wait."""
_TAILS = 4.0  # degrees of freedom of Student's t
_AT_REST = 1e-6  # rad
_BIAS, _PLUS, _MINUS, _LOAD, _SENSOR = range(5)


@dataclass(frozen=True)
class BankSettings:
    """What the filters take for granted.

    Attributes:
        begins: rate at which a part fails, 1/s.
        sure: probability from which a fault is named.
        patience: for how long it must be that sure, s.
        leak: the same two of leaks, which single messages tell.
        learns: for how long at first nothing is named, s.
        noise: of bend readings, RMS, rad.
        marker_noise: of a bend by markers, RMS, rad.
        loss: share of readings that are lost.
        gain: spread of the modules' gains.
        bias: of their bends without pressure, rad.
        pressure: what a pressure may differ from its lag's by, as a share of the supply's, before it has been
            seen, and at the least.
        load: RMS of d, as a share of the largest bend.
        load_time: over which d fades, s.
        pressure_time: over which what lags miss of a pressure lasts, s.
        wander: by what a bias (rad) and a gain wander, a square root of a second.
        drift: of a sensor, rad a square root of a second.
    """

    begins: float = 1e-3
    sure: float = 0.97
    patience: float = 0.16
    leak: tuple[float, float] = (0.99, 0.08)
    learns: float = 2.0
    noise: float = 0.02
    marker_noise: float = 0.025
    loss: float = 0.05
    gain: float = 0.15
    bias: float = 0.05
    pressure: tuple[float, float] = (0.12, 0.02)
    load: float = 0.11
    load_time: float = 0.15
    pressure_time: float = 0.08
    wander: tuple[float, float] = (0.0014, 0.0035)
    drift: float = 0.03


class FaultBank(Stateful):
    """Hypotheses of all segments, from measurement to measurement.

    Attributes:
        settings: of the filters.
        probability: of each hypothesis, shape (segments, hypotheses).
        mean: of b, g⁺, g⁻, d, s under each, shape (segments, hypotheses, 5).
        time: since the beginning, s.
    """

    state_attributes = (
        "probability",
        "mean",
        "_spread",
        "_pressure",
        "_delayed",
        "_filling",
        "_age",
        "_habit",
        "_last",
        "_since",
        "_either",
        "_named",
        "balance",
        "time",
    )

    def __init__(self, spec: RobotSpec, *, supply_pa: float, settings: BankSettings = BankSettings()) -> None:
        """Begin with a robot at rest, chambers empty.

        Args:
            spec: the robot, as far as it is known.
            supply_pa: gauge, Pa.
            settings: of the filters.
        """
        self.settings, self._spec, actuator = settings, spec, spec.actuator
        self._fill, self._vent, self._tau = actuator.tau_fill, actuator.tau_vent, actuator.tau_mode
        count, kinds = spec.segments, len(HYPOTHESES)
        self._supply, self._gain = supply_pa, gains(spec)
        # Whoever starts beside a robot that moves does not know what its chambers hold.
        self._settles = 4 * (max(self._fill, self._vent) + self._tau)
        self._pressure = np.zeros((count, kinds, 2))
        self._delayed = np.zeros((count, kinds, 2))
        # Since when valves are as they are, and what was seen of pressures so long after they switched: how
        # often, mean and variance.
        self._filling, self._age = np.zeros((count, 2), dtype=int), np.zeros((count, 2))
        self._habit = np.zeros((count, 2, 2, _AGES, 3))
        self._habit[..., 0], self._habit[..., 2] = 1.0, settings.pressure[0] ** 2
        self._does = np.array([[each.plus, each.minus] for each in HYPOTHESES])
        self._sensor = np.array([each.sensor for each in HYPOTHESES])
        self._severe = np.array([[each.leak, each.weak] for each in HYPOTHESES])
        s = settings
        self.mean = np.zeros((count, kinds, 5))
        self.mean[..., _PLUS] = self.mean[..., _MINUS] = 1.0
        self._largest = largest_bend(spec, supply_pa)
        self._load = s.load * self._largest
        self._obeys = np.isin(self._does, (OBEYS, LEAKS))
        own = [(each.inflow(each.plus), each.inflow(each.minus)) for each in HYPOTHESES]
        variants = list(dict.fromkeys(each for pair in own for each in pair))
        self._variant = np.array([[variants.index(each) for each in pair] for pair in own])
        self.balance = AirBalance(spec, supply_pa=supply_pa, variants=variants)
        spread = np.array([s.bias, s.gain, s.gain, self._load, s.noise])
        self._spread = np.tile(np.diag(spread**2), (count, kinds, 1, 1))
        self.probability = np.zeros((count, kinds))
        self.probability[:, 0] = 1.0
        self._last = np.full(count, np.nan)
        self.time = 0.0
        self._since = np.full((count, len(_NAMES)), np.inf)
        self._either = np.full((count, len(_ALIKE)), np.inf)
        self._named = np.full((count + 1, 2), -1, dtype=int)

    @property
    def named(self) -> dict[int, str]:
        """Segment (from 1) → the fault that it was found to have; 0 → the supply."""
        told = {j: [_NAMES[m] for m in pair if m >= 0] for j, pair in enumerate(self._named.tolist())}
        return {j: " or ".join(each) if j else STARVED for j, each in told.items() if each}

    def forget(self, number: int) -> None:
        """Take a segment (from 1; 0: the supply) for whole again, as after a repair."""
        self._named[number] = -1
        if number:
            self.probability[number - 1] = 0.0
            self.probability[number - 1, 0] = 1.0

    def doubt(self, switched: np.ndarray, span: float) -> None:
        """Take it that nobody knows when valves switched.

        Args:
            switched: by what share, shape (segments, 2).
            span: in which they did, s.
        """
        self.balance.drop(switched > 0)
        off = self._largest * switched.sum(axis=1) / 2 * (1 - math.exp(-span / self._fill))
        self._spread[..., _LOAD, _LOAD] += off[:, None] ** 2

    def likely(self) -> np.ndarray:
        """Return the hypothesis that each segment is taken to follow: what was named, else the first."""
        found = np.zeros(len(self.probability), dtype=int)
        for j, pair in enumerate(self._named[1:].tolist()):
            if pair[0] >= 0:
                found[j] = np.argmax(self.probability[j] * _SAME[:, [m for m in pair if m >= 0]].sum(axis=1))
            elif self._named[0, 0] >= 0:
                found[j] = np.argmax(self.probability[j] * _SAME[:, _WEAK])
        return found

    def advance(self, opens: np.ndarray, span: float) -> None:
        """Let a stretch pass.

        Args:
            opens: share of the time for which each valve was told to fill, shape (segments, 2).
            span: s.
        """
        self.time += span
        self._mix(span)
        filling = (np.asarray(opens) > 0.5).astype(int)
        self._age = np.where(filling == self._filling, self._age + span, 0.0)
        self._filling = filling
        self._fill_chambers(np.asarray(opens, dtype=float), span)

    def read(
        self, readings: np.ndarray | None = None, markers: np.ndarray | None = None,
        pressures: np.ndarray | None = None, *, span: float = 0.02, rough: float = 1.0,
    ) -> None:  # fmt: skip
        """Take what was measured now.

        Args:
            readings: bends by the sensors, shape (segments,), rad, NaN of sensors that say nothing; None: no
                message came.
            markers: bends by markers, rad, NaN where there are none; None: no frame came.
            pressures: of the chambers, gauge, shape (segments, 2), Pa, NaN where none came; None: no message.
            span: how long these pressures are after the last ones, s.
            rough: how many times as noisy as usual markers are.
        """
        if self.time < self._settles:
            return
        drive = self._gain[:, None] * self._delayed
        drive = drive * self._bent(drive)
        rows = np.ones((*self.probability.shape, 5))
        rows[..., _PLUS], rows[..., _MINUS] = drive[..., 0], -drive[..., 1]
        likely = np.zeros(self.probability.shape)
        if readings is not None:
            told = np.asarray(readings, dtype=float)
            reads = np.isin(self._sensor, (READS, DRIFTS))
            likely += self._unlike_readings(told) + self._update(rows, told, self.settings.noise, reads)
            self._last = np.where(np.isnan(told), self._last, told)
        if markers is not None:
            rows[..., _SENSOR] = 0.0
            everywhere = np.ones(len(HYPOTHESES), dtype=bool)
            likely += self._update(rows, np.asarray(markers), rough * self.settings.marker_noise, everywhere)
        if pressures is not None:
            rows[..., _SENSOR] = 0.0
            told = np.asarray(pressures, dtype=float)
            likely += self._unlike_pressures(told, span) + self._unbalanced(told, rows)
        weight = self.probability * np.exp(likely - likely.max(axis=1, keepdims=True))
        # A supply is weak for all, or for none.
        weak = (weight @ _SAME[:, _WEAK]) / weight.sum(axis=1)
        alone = (weak > 0.5) & ((weak > _FEW).sum() < min(2, len(weak)))
        weight[:, _SAME[:, _WEAK] > 0] *= np.where(alone, _ALONE, 1.0)[:, None]
        self.probability = np.maximum(weight / weight.sum(axis=1, keepdims=True), 1e-12)
        self._name()

    def gains(self) -> np.ndarray:
        """Return g⁺ and g⁻ of each segment, shape (segments, 2), by what is most likely."""
        return np.asarray(np.einsum("sm,smi->si", self.probability, self.mean)[:, _PLUS : _MINUS + 1])

    def _fill_chambers(self, told: np.ndarray, span: float) -> None:
        """Advance pressures, and what of them has reached the bend."""
        does = self._does
        opens = np.where(does == FILLS, 1.0, np.where(does == VENTS, 0.0, told[:, None]))
        leak = np.where(does == LEAKS, self._severe[:, :1], 0.0)
        supply = self._supply * self._severe[:, 1:]
        rate = opens / self._fill + (1 - opens) / self._vent + leak
        ends = opens * supply / self._fill / rate
        fast, slow = np.exp(-rate * span), math.exp(-span / self._tau)
        apart = 1 - rate * self._tau
        apart = np.where(np.abs(apart) < 1e-6, 1e-6, apart)
        begun = self._pressure - ends
        self._delayed = ends + begun * (fast - slow) / apart + (self._delayed - ends) * slow
        self._pressure = ends + begun * fast

    def _bent(self, drive: np.ndarray) -> np.ndarray:
        """Return what share of a linear drive bends a segment, shape (segments, hypotheses, 1)."""
        linear = drive[..., 0] - drive[..., 1]
        # At rest the share is the slope.
        linear = np.where(np.abs(linear) < _AT_REST, _AT_REST, linear)
        return np.asarray((free_bends(self._spec, linear) / linear)[..., None])

    def _mix(self, span: float) -> None:
        """Let each hypothesis begin from what has led to it, its chambers too, and everything wander."""
        s = self.settings
        # What failed does not heal, but may have been taken for something else at first.
        moves = np.full((len(HYPOTHESES),) * 2, s.begins * span)
        moves[1:, 0] = 0.0
        np.fill_diagonal(moves, 0.0)
        np.fill_diagonal(moves, 1 - moves.sum(axis=1))
        fades = np.array([1.0, 1.0, 1.0, math.exp(-span / s.load_time), 1.0])
        bias, gain = (each * math.sqrt(span) for each in s.wander)
        wander = np.diag([bias, gain, gain, self._load * math.sqrt(1 - fades[_LOAD] ** 2), 1e-5]) ** 2
        wanders = np.tile(wander, (len(HYPOTHESES), 1, 1))
        wanders[self._sensor == DRIFTS, _SENSOR, _SENSOR] = s.drift**2 * span
        joint = self.probability[:, :, None] * moves
        coming = joint.sum(axis=1)
        share = joint / np.maximum(coming[:, None, :], 1e-300)
        mean = np.einsum("sij,sik->sjk", share, self.mean)
        off = self.mean[:, :, None, :] - mean[:, None, :, :]
        spread = np.einsum("sij,sikl->sjkl", share, self._spread)
        spread += np.einsum("sij,sijk,sijl->sjkl", share, off, off)
        self.mean = mean * fades
        self._spread = spread * np.outer(fades, fades) + wanders
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
        # Student's t: what the lags miss is now and then far off, under every hypothesis.
        log = -np.log1p(off**2 / variance / _TAILS) * (_TAILS + 1) / 2 - np.log(variance * 2 * math.pi) / 2
        return np.where(there, log, 0.0)

    def _unlike_readings(self, told: np.ndarray) -> np.ndarray:
        """Return the logarithms of how likely it is to hear nothing, or the same again."""
        found, lost = np.zeros(self.probability.shape), np.isnan(told)[:, None]
        loss = self.settings.loss
        silent, frozen = self._sensor == SILENT, self._sensor == FROZEN
        found[:, ~silent] = np.where(lost, math.log(loss), math.log(1 - loss))
        found[:, silent] = np.where(lost, math.log(0.999), math.log(1e-3 / (2 * math.pi)))
        narrow = self.settings.noise / 10
        again = np.nan_to_num(told - self._last, nan=10.0)[:, None]
        density = -0.5 * (again / narrow) ** 2 - math.log(narrow * math.sqrt(2 * math.pi))
        found[:, frozen] += np.where(lost, 0.0, np.maximum(density, -50.0))
        return found

    def _unlike_pressures(self, told: np.ndarray, span: float) -> np.ndarray:
        """Return the logarithms of how likely pressures are; what lags miss of them lasts, so few count."""
        first, least = self.settings.pressure
        off = np.nan_to_num((told[:, None] - self._pressure) / self._supply)
        age = np.minimum(self._age / _AGE_S, _AGES - 1).astype(int)
        place = *np.indices(told.shape), self._filling, age
        seen, usual, variance = np.moveaxis(self._habit[place], -1, 0)
        # What valves do that do not obey was never seen.
        off = off - np.where(self._obeys, usual[:, None], 0.0)
        spread = np.where(self._obeys, np.sqrt(variance)[:, None] + least, first)
        log = -np.log1p((off / spread) ** 2 / _TAILS) * (_TAILS + 1) / 2 - np.log(spread)
        # Whether a chamber leaks its balance says, once it knows what is usual.
        balanced = (self.balance.books.seen >= _BALANCED)[:, None] & (self._does == LEAKS)
        log = np.where(balanced, log.max(axis=1, keepdims=True), log)
        learns = ~np.isnan(told) & (self.probability[:, :1] > 0.9)
        more = np.where(learns, np.minimum(seen + 1, _MOST_SEEN), seen)
        news = np.where(learns, off[:, 0], 0.0)
        variance = np.where(learns, variance + (news**2 - variance) / more, variance)
        self._habit[place] = np.stack([more, usual + news / more, variance], axis=-1)
        return np.asarray(log.sum(axis=-1) * min(span / self.settings.pressure_time, 1.0))

    def _unbalanced(self, told: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the logarithms of how likely it is what chambers that fill have taken in."""
        each = np.einsum("smk,smk->sm", rows, self.mean)
        bend = (self.probability * each).sum(axis=1)
        variance = np.einsum("smk,smkl,sml->sm", rows, self._spread, rows) + (each - bend[:, None]) ** 2
        sd = np.sqrt((self.probability * variance).sum(axis=1))
        filled = np.where(self._filling == 1, self._age, 0.0)
        found = self.balance.read(self.time, told, bend, sd, filled, self.probability[:, 0])
        return np.asarray(found[:, np.arange(2), self._variant].sum(axis=-1))

    def _name(self) -> None:
        """Name what has been sure for long enough."""
        s, named = self.settings, self._named
        likely = self.probability @ _SAME
        if self.time < s.learns:
            return
        # Parts seldom fail together: where others are in doubt as well, what they have in common may have.
        doubted = likely[:, 0] < _DOUBT
        longer = np.where(doubted.sum() - doubted > 0, _LONGER, 1.0)
        sure, patience = np.where(_LEAK[:, None], s.leak, (s.sure, s.patience)).T
        patience = longer[:, None] * patience - 1e-9
        weak, count = likely[:, _WEAK], len(likely)
        if (weak > 0.5).sum() * 2 > count:
            named[0, 0] = _WEAK
        if count > 1:
            others = (weak.sum() - weak) / (count - 1)
            likely[:, _WEAK] = weak * np.minimum(2 * others, 1.0)
            likely /= likely.sum(axis=1, keepdims=True)
        self._since = np.where(likely > sure, np.minimum(self._since, self.time), np.inf)
        for j, m in np.argwhere(self.time - self._since >= patience):
            # Of two that were named together one may have turned out to be right.
            if m and (named[j + 1, 0] < 0 or m in named[j + 1]) and not (m == _WEAK or named[0, 0] >= 0):
                named[j + 1] = m, -1
        for k, pair in enumerate(_ALIKE):
            both = likely[:, pair].sum(axis=1) > s.sure
            self._either[:, k] = np.where(both, np.minimum(self._either[:, k], self.time), np.inf)
            for j in np.flatnonzero(self.time - self._either[:, k] >= patience[:, 0]) + 1:
                if named[j, 0] < 0 and named[0, 0] < 0:
                    named[j] = pair
        sound = np.append(False, likely[:, 0] > s.sure)  # what was named was something that passed
        named[sound & (named[:, 0] >= 0)] = -1
