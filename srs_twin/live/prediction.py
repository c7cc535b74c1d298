"""What comes next: commands that go on in their rhythm, and what predictions were off by so far."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

SLOT_S = 0.02
_KEPT = 250
_LAGS = range(10, 126)
_SAME = 0.1
"""Commands that differ by less than this from those a period before, on average, are periodic."""
_MEMORY = 8
_BEGINS, _COMPARED = 10, 100
"""Numbers of comparisons that the first scale of forecasts counts as, and that a later one is the mean of."""
_MOST_OFF, _RATIOS = 25.0, (0.1, 10.0)
"""Largest squared error of a forecast that counts, in variances, and range of the mean."""
_T95 = 2.1
"""Half of a 95 % interval over its standard deviation, as few of them have told it."""


@dataclass(frozen=True)
class Prediction:
    """Where a robot will be, if commands go on as they do.

    Attributes:
        begun: our clock, s.
        heading: mean heading then, rad.
        commands: that it takes for granted, slot by slot, shape (slots, segments, 2).
        time: our clock, s, shape (times,).
        pose: x, y (m), mean heading (rad), shape (times, 3).
        pose_sd: standard deviations of that, along and across the heading then (m) and of the heading (rad).
    """

    begun: float
    heading: float
    commands: np.ndarray
    time: np.ndarray
    pose: np.ndarray
    pose_sd: np.ndarray

    def off(self, poses: np.ndarray) -> np.ndarray:
        """Return poses less the predicted ones, along and across the first heading, shape (times, 3)."""
        return _turned(poses - self.pose, -self.heading)

    def covers(self, poses: np.ndarray) -> np.ndarray:
        """Say whether poses lie in the 95 % intervals, shape (times, 3)."""
        return np.asarray(np.abs(self.off(poses)) <= _T95 * self.pose_sd)


def _turned(off: np.ndarray, by: float) -> np.ndarray:
    c, s = math.cos(by), math.sin(by)
    return np.column_stack([c * off[:, 0] - s * off[:, 1], s * off[:, 0] + c * off[:, 1], off[:, 2]])


class Rhythm:
    """Commands of the last seconds, slot by slot, and after how many of them they come again."""

    def __init__(self) -> None:
        """Know none."""
        self._slot = -1
        self._opens: deque[np.ndarray] = deque(maxlen=_KEPT)

    def take(self, time: float, opens: np.ndarray) -> None:
        """Take what is commanded in the slot of a time (s): shares, shape (segments, 2)."""
        slot = math.floor(time / SLOT_S)
        if slot > self._slot + 1:  # a gap: what was before is at another distance now
            self._opens.clear()
        if slot > self._slot:
            self._opens.append(opens)
            self._slot = slot

    def commands(self, slots: int) -> np.ndarray:
        """Return the commands of the next slots, shape (slots, segments, 2): as a period ago, or as now."""
        past, lag = np.array(self._opens), self.period()
        return past[-lag:][np.arange(slots) % lag] if lag else np.repeat(past[-1:], slots, axis=0)

    def came(self, time: float, commands: np.ndarray) -> bool:
        """Say whether those of the slots since a time (s) are these, as far as they have come."""
        ago = self._slot - math.floor(time / SLOT_S)
        if not 0 < ago <= len(self._opens):
            return False
        came = np.array(self._opens)[-ago:][: len(commands)]
        return bool(np.abs(came - commands[: len(came)]).mean() < _SAME)

    def period(self) -> int:
        """Return after how many slots the commands come again; 0: they do not."""
        past = np.array(self._opens)
        recent = past[-_LAGS[-1] // 2 :]
        best = _SAME, 0
        for lag in _LAGS:
            before = past[-len(recent) - lag : -lag]
            if len(before) == len(recent):
                best = min(best, (float(np.abs(recent - before).mean()), lag))
        # A robot that is told nothing has no gait.
        return best[1] if np.ptp(recent, axis=0).any() else 0


class Hindsight:
    """What earlier predictions turned out to be off by, which later ones are corrected and widened by.

    Those whose commands did not come true say nothing of the model, only of how far one may be off.
    """

    def __init__(self, rhythm: Rhythm) -> None:
        """Have seen none.

        Args:
            rhythm: of the commands that came.
        """
        self._rhythm = rhythm
        self._mean = self._variance = self._told = np.zeros((0, 3))
        self._count = 0
        self._open: deque[Prediction] = deque(maxlen=20)
        self._path: deque[tuple[float, np.ndarray]] = deque(maxlen=200)

    def see(self, time: float, pose: np.ndarray) -> None:
        """Take where the robot is (x, y, heading) at a time (s); learn from predictions that are over."""
        self._path.append((time, pose))
        while self._open and self._open[0].time[-1] <= time:
            past = self._open.popleft()
            times, poses = (np.array(each) for each in zip(*self._path, strict=True))
            if times[0] > past.begun:
                continue
            found = past.off(np.column_stack([np.interp(past.time, times, poses[:, k]) for k in range(3)]))
            if len(self._mean) != len(found):
                self._mean = self._variance = self._told = np.zeros_like(found)
                self._count = 0
            self._count += 1
            weight = max(1 / _MEMORY, 1 / self._count)
            off = found - self._mean
            if self._rhythm.came(past.begun, past.commands):
                self._mean = self._mean + weight * off
            self._variance = (1 - weight) * (self._variance + weight * off**2)
            self._told = self._told + weight * (past.pose_sd**2 - self._told)

    def corrected(self, raw: Prediction) -> Prediction:
        """Return a prediction as it is to be told; what it will have been off by is learnt later."""
        self._open.append(raw)
        if len(self._mean) != len(raw.time):
            return raw
        pose = raw.pose + _turned(self._mean, raw.heading)
        # Of few errors the spread is told too small; of old ones little is left.
        count = min(self._count, _MEMORY)
        few = (count + 1) / max(count - 1, 1)
        besides = np.maximum(few * self._variance - self._told, 0.0)
        return replace(raw, pose=pose, pose_sd=np.sqrt(raw.pose_sd**2 + besides))


class ForecastCalibration:
    r"""Scale of the standard deviations of what is predicted from the last message to now.

    What was predicted for a time is compared with what measurements of that time then say:

    $$ s^2 = \overline{(\hat x - x)^2 + \sigma_x^2} \;/\; \overline{\hat\sigma^2} . $$
    """

    def __init__(self, groups: Sequence[int]) -> None:
        """Begin with 1; values of a group, given by their counts, have one scale in common."""
        self._starts, self._counts = np.cumsum([0, *groups[:-1]]), np.array(groups)
        self._ratio, self._count = np.ones(len(groups)), _BEGINS
        self._open: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=200)

    @property
    def scale(self) -> np.ndarray:
        """Factor of each value's standard deviation."""
        return np.repeat(np.sqrt(self._ratio), self._counts)

    def expect(self, time: float, value: np.ndarray, sd: np.ndarray) -> None:
        """Take a prediction for a time (s), with its standard deviations before they are scaled."""
        self._open.append((time, value, sd))

    def compare(self, time: float, value: np.ndarray, sd: np.ndarray) -> None:
        """Take what is known of a time (s) once it was measured."""
        while len(self._open) > 1 and self._open[1][0] < time:
            self._open.popleft()
        if len(self._open) < 2 or not self._open[0][0] <= time:
            return
        (begun, first, first_sd), (ended, second, second_sd) = self._open[0], self._open[1]
        share = (time - begun) / (ended - begun)
        expected = first + share * (second - first)
        variance = (first_sd + share * (second_sd - first_sd)) ** 2
        found = np.minimum(((expected - value) ** 2 + sd**2) / np.maximum(variance, 1e-18), _MOST_OFF)
        mean = np.add.reduceat(found, self._starts) / self._counts
        self._count = min(self._count + 1, _COMPARED)
        self._ratio = np.clip(self._ratio + (mean - self._ratio) / self._count, *_RATIOS)
