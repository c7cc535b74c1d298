r"""Limits of a result in words: errors that are too large, an order that is not resolved, a value outside.

An end of a 95 % interval is rough where its standard error exceeds 5 % of the interval's width. The width is
then uncertain by more than 2 √2 · 5 % = 14 %. A total index is rough where half of its 95 % interval exceeds
0.1, because causes that differ by less than 0.14 cannot then be told apart. Standard errors fall as one over
the square root of the number of samples, which gives the number that would do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.robot.priors import Priors
from srs_twin.studies.uncertainty.spreads import BOUNDING, RANGES, Spread
from srs_twin.studies.uncertainty.surrogates import quadratic_samples

ROUGH_END = 0.05
"""Largest standard error of an interval end, as a share of the width of the 95 % interval."""
ROUGH_INDEX = 0.1
"""Largest half of the 95 % interval of a total index."""
MOST = 65536
"""Largest number of samples of a study."""
_MARGIN = 1.5  # of needed samples: standard errors are estimates, too low ones for few samples
_USUAL_RUNS = 64
_LISTED = 3
_MIDDLE = (0.25, 0.75)  # shares of a distribution that count as its middle


@dataclass(frozen=True)
class Shortfall:
    """A part of a result that needs more runs.

    Attributes:
        words: the error, its limit and the reason for the limit.
        samples: number of samples that would do; 0: no more than now.
        runs: number of runs of the twin that would do; 0: no more than now.
    """

    words: str
    samples: int = 0
    runs: int = 0


@dataclass(frozen=True)
class Remarks:
    """Limits of one plant's result for one metric, in words.

    Attributes:
        plant: its name.
        label: of the metric, for people.
        spread: of the metric.
        priors: of the robot's numbers.
        names: of all uncertain numbers, as the indices are ordered.
        asked: number of samples of the study.
        partner: whether the plant has a cheap partner.
    """

    plant: str
    label: str
    spread: Spread
    priors: Priors
    names: Sequence[str]
    asked: int
    partner: bool

    @property
    def subject(self) -> str:
        """Plant and metric."""
        return f"{self.plant}, {self.label}"

    def shortfalls(self) -> list[Shortfall]:
        """Return the parts of the result whose errors are too large."""
        low, high = self.spread.interval("interval_95")
        if not high > low:
            return []
        return [each for each in (self._bounding(), self._ends(high - low), self._indices()) if each]

    def _bounding(self) -> Shortfall | None:
        count, tail = self.spread.count, RANGES["interval_95"][0]
        if count >= BOUNDING:
            return None
        words = (
            f"{self.subject}: {count} samples do not bound the 95 % interval; with a probability of "
            f"{100 * (1 - tail) ** count:.0f} % none of them lies beyond its true lower end, and likewise "
            f"for the upper end ({BOUNDING} samples make that {100 * tail:g} %)"
        )
        # Twice as many: so few samples underestimate the errors of the ends.
        return self._more(words, 2 * BOUNDING)

    def _ends(self, width: float) -> Shortfall | None:
        errors, limit = self.spread.errors[2:], ROUGH_END * width
        if errors.max() <= limit:
            return None
        shares = " and ".join(f"{100 * error / width:.0f} %" for error in errors)
        words = (
            f"{self.subject}: standard errors of the ends of the 95 % interval are {shares} of its width; "
            f"above {100 * ROUGH_END:.0f} % the width is uncertain by more than "
            f"{100 * 2 * math.sqrt(2) * ROUGH_END:.0f} %"
        )
        if not self._predicted:
            return self._more(words, _MARGIN * self.spread.count * float((errors.max() / limit) ** 2))
        samples, runs = (
            _power(_MARGIN * count * growth) if growth > 1 else 0
            for count, growth in (
                (self.spread.count, _growth(self.spread.sampling, limit)),
                (self.spread.runs, _growth(self.spread.surrogate, limit)),
            )
        )
        return Shortfall(words, samples, runs)

    def _indices(self) -> Shortfall | None:
        if self.spread.doubt is None or self.spread.doubt[1].max() <= ROUGH_INDEX:
            return None
        error = min(float(self.spread.doubt[1].max()), 1.0)
        words = (
            f"{self.subject}: total indices have errors of up to ±{100 * error:.0f} %; above "
            f"±{100 * ROUGH_INDEX:.0f} % causes that differ by less than "
            f"{100 * math.sqrt(2) * ROUGH_INDEX:.0f} % cannot be told apart"
        )
        count, least = self.spread.count, quadratic_samples(len(self.names))
        growth = (error / ROUGH_INDEX) ** 2
        if self._predicted and count >= least:
            return Shortfall(words, runs=_power(self.spread.runs * growth))
        return self._more(words, max(count * growth, least))

    @property
    def _predicted(self) -> bool:
        return self.spread.count > self.spread.runs

    def _more(self, words: str, needed: float) -> Shortfall:
        """Return a shortfall of samples that the plant itself runs."""
        count = _power(needed)
        if self.partner and self.spread.count < self.asked:
            return Shortfall(words, count if count > self.asked else 0, count)  # no surrogate predicts them
        return Shortfall(words, count, max(_USUAL_RUNS, self.spread.runs) if self.partner else 0)

    def order(self) -> str:
        """Return a sentence about the largest cause and the resolved order of the causes."""
        spread, ranks = self.spread, self.spread.ranks()
        if len(ranks) < 2 or spread.total is None or spread.doubt is None:
            return ""
        order = np.argsort(-spread.total, kind="stable")
        first = [self.names[i] for i in order if ranks[i][0] == 1]
        tied = sum(best < worst for best, worst in ranks)
        if len(first) > 1:
            words = f"{self._samples} do not resolve the largest cause; it is {_listed(first)}"
        else:
            top = int(order[0])
            words = (
                f"{first[0]} matters most (total index {_percent(spread.total[top], spread.doubt[1, top])})"
            )
            words += f"; {self._samples} do not resolve the order of {tied} others" if tied else ""
        return f"{self.subject}: {words}"

    @property
    def _samples(self) -> str:
        runs = f" ({self.spread.runs} runs)" if self._predicted else ""
        return f"{self.spread.count} samples{runs}"

    def outside(self) -> str:
        """Return the reason for a value outside its own interval; empty for a value inside."""
        spread = self.spread
        name = next((each for each in reversed(RANGES) if _is_outside(spread, each)), None)
        if name is None:
            return ""
        low, high = spread.interval(name)
        side = "above" if spread.value > high else "below"
        share = name.removeprefix("interval_")
        words = (
            f"{self.subject}: the value {spread.value:.3g} lies {side} its {share} % interval "
            f"({low:.3g} to {high:.3g}), because it belongs to the numbers in the robot file and the "
            "interval to numbers drawn from their distributions"
        )
        if not math.isfinite(spread.at_medians):
            return words
        skewed, bent = spread.value - spread.at_medians, spread.at_medians - spread.median
        return (
            f"{words}. The file's numbers instead of the medians of their distributions change it by "
            f"{skewed:+.2g}{self._skewed()}; nonlinearity changes it by {bent:+.2g} "
            f"(median of the samples: {spread.median:.3g})"
        )

    def _skewed(self) -> str:
        """Return the numbers whose values in the file are far from their medians, largest cause first."""
        weights = np.ones(len(self.names)) if self.spread.total is None else self.spread.total
        order = np.argsort(-weights[: len(self.priors.each)], kind="stable")
        found = []
        for prior in (self.priors.each[i] for i in order):
            share = float(prior.shares_of(np.array([prior.value]))[0])
            if not _MIDDLE[0] <= share <= _MIDDLE[1]:
                median = float(prior.at(np.array([0.5]))[0])
                found.append(f"{prior.path} {prior.value:.3g} instead of {median:.3g}")
        return f" ({', '.join(found[:_LISTED])}{', …' if len(found) > _LISTED else ''})" if found else ""


def outside_marks(spread: Spread) -> str:
    """Return "**" for a value outside its 95 % interval, "*" for one outside of 50 % only, else nothing."""
    return "*" * sum(_is_outside(spread, name) for name in RANGES)


def remedy(shortfalls: Sequence[Shortfall], samples: int, costly: int) -> Mapping[str, int]:
    """Return option → number with which a study would have no shortfalls; empty where none is known.

    Args:
        shortfalls: of the study.
        samples: that it had.
        costly: runs of the twin that it had.
    """
    runs = max((each.runs for each in shortfalls), default=0)
    wanted = {"samples": max([runs, *(each.samples for each in shortfalls)]), "twin": runs}
    had = {"samples": samples, "twin": costly}
    return {name: count for name, count in wanted.items() if count > had[name] and count <= MOST}


def _is_outside(spread: Spread, name: str) -> bool:
    low, high = spread.interval(name)
    return high > low and not low <= spread.value <= high


def _growth(errors: np.ndarray, limit: float) -> float:
    """Return the factor of runs that leaves one of two parts of the errors half of the allowed variance."""
    return 2 * float((errors[2:].max() / limit) ** 2)


def _power(count: float) -> int:
    """Return the next power of two: the sizes at which a Sobol sequence is even."""
    return 1 << max(math.ceil(count) - 1, 1).bit_length()


def _percent(share: float, error: float) -> str:
    return f"{100 * share:.0f} ± {100 * min(error, 1.0):.0f} %"


def _listed(names: Sequence[str]) -> str:
    shown = [*names[:_LISTED], *([f"{len(names) - _LISTED} others"] if len(names) > _LISTED else [])]
    return f"{', '.join(shown[:-1])} or {shown[-1]}"
