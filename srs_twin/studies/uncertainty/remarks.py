r"""Limitations of a result as text: large errors, an unresolved ranking, a value outside its interval.

The end of a 95 % interval is inaccurate if its standard error exceeds 5 % of the
interval's width; the width is then uncertain by more than 2 √2 · 5 % = 14 %. A total
index is inaccurate if half its 95 % interval exceeds 0.1; causes that differ by less
than 0.14 cannot then be distinguished. Standard errors decrease with the square root of
the number of samples, which gives the number that is needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.studies.uncertainty.metric_uncertainty import (
    MIN_BOUNDING_SAMPLES,
    RANGES,
    MetricUncertainty,
)
from srs_twin.studies.uncertainty.study import UncertaintyStudy
from srs_twin.studies.uncertainty.surrogates import quadratic_samples

MAX_END_ERROR = 0.05
"""Largest standard error of an interval end, relative to the width of the 95 % interval."""

MAX_INDEX_ERROR = 0.1
"""Largest half width of the 95 % interval of a total index."""

MAX_SAMPLES = 65536
"""Largest number of samples of a study."""

_MARGIN = 1.5
"""Safety factor on the estimated number of samples, because standard errors from few samples are too low."""

_DEFAULT_RUNS = 64
"""Default number of runs of the twin."""

_MAX_LISTED = 3
"""Largest number of names in a text."""

_MIDDLE = (0.25, 0.75)
"""Probabilities between which a value counts as close to its median."""


@dataclass(frozen=True)
class Shortfall:
    """Error of a result that more runs would reduce.

    Attributes:
        words: error, limit and reason for the limit.
        samples: number of samples that suffices; 0: no more are needed.
        runs: number of runs of the twin that suffices; 0: no more are needed.
    """

    words: str
    samples: int = 0
    runs: int = 0


@dataclass(frozen=True)
class Remarks:
    """Limitations of one plant's result for one metric.

    Attributes:
        plant: name of the plant.
        label: label of the metric.
        uncertainty: uncertainty of the metric.
        study: study.
    """

    plant: str
    label: str
    uncertainty: MetricUncertainty
    study: UncertaintyStudy

    @property
    def subject(self) -> str:
        """Plant and metric."""
        return f"{self.plant}, {self.label}"

    def shortfalls(self) -> list[Shortfall]:
        """Return the errors that are too large."""
        low, high = self.uncertainty.interval("interval_95")
        if not high > low:
            return []
        shortfalls = (
            self._bounding_shortfall(),
            self._end_shortfall(high - low),
            self._index_shortfall(),
        )
        return [shortfall for shortfall in shortfalls if shortfall]

    def _bounding_shortfall(self) -> Shortfall | None:
        count = self.uncertainty.count
        tail = RANGES["interval_95"][0]
        if count >= MIN_BOUNDING_SAMPLES:
            return None
        words = (
            f"{self.subject}: {count} samples do not bound the 95 % interval; with a"
            f" probability of {100 * (1 - tail) ** count:.0f} % none of them is beyond"
            " its true lower end, and likewise for the upper end"
            f" ({MIN_BOUNDING_SAMPLES} samples make that {100 * tail:g} %)"
        )
        # Suggest twice as many, because few samples underestimate the errors of the
        # ends.
        return self._sample_shortfall(words, 2 * MIN_BOUNDING_SAMPLES)

    def _end_shortfall(self, width: float) -> Shortfall | None:
        errors = self.uncertainty.errors[2:]
        limit = MAX_END_ERROR * width
        if errors.max() <= limit:
            return None
        shares = " and ".join(f"{100 * error / width:.0f} %" for error in errors)
        words = (
            f"{self.subject}: standard errors of the ends of the 95 % interval are"
            f" {shares} of its width; above {100 * MAX_END_ERROR:.0f} % the width is"
            f" uncertain by more than {100 * 2 * math.sqrt(2) * MAX_END_ERROR:.0f} %"
        )
        if not self._is_predicted:
            needed = (
                _MARGIN * self.uncertainty.count * float((errors.max() / limit) ** 2)
            )
            return self._sample_shortfall(words, needed)
        samples, runs = (
            _next_power_of_two(_MARGIN * count * growth) if growth > 1 else 0
            for count, growth in (
                (self.uncertainty.count, _growth(self.uncertainty.sampling, limit)),
                (self.uncertainty.runs, _growth(self.uncertainty.surrogate, limit)),
            )
        )
        return Shortfall(words, samples, runs)

    def _index_shortfall(self) -> Shortfall | None:
        indices = self.uncertainty.indices
        if indices is None or indices.half_width[1].max() <= MAX_INDEX_ERROR:
            return None
        error = min(float(indices.half_width[1].max()), 1.0)
        words = (
            f"{self.subject}: total indices have errors of up to ±{100 * error:.0f} %;"
            f" above ±{100 * MAX_INDEX_ERROR:.0f} % causes that differ by less than"
            f" {100 * math.sqrt(2) * MAX_INDEX_ERROR:.0f} % cannot be distinguished"
        )
        count = self.uncertainty.count
        smallest = quadratic_samples(len(self.study.names))
        growth = (error / MAX_INDEX_ERROR) ** 2
        if self._is_predicted and count >= smallest:
            return Shortfall(
                words, runs=_next_power_of_two(self.uncertainty.runs * growth)
            )
        return self._sample_shortfall(words, max(count * growth, smallest))

    @property
    def _is_predicted(self) -> bool:
        return self.uncertainty.count > self.uncertainty.runs

    def _sample_shortfall(self, words: str, needed: float) -> Shortfall:
        """Return a shortfall of samples that the plant itself must run."""
        count = _next_power_of_two(needed)
        requested = self.study.samples
        if self.plant != "twin" or self.study.surrogate_scenario is None:
            return Shortfall(words, count)
        if self.uncertainty.count < requested:
            # The surrogate failed to predict the remaining samples.
            return Shortfall(words, count if count > requested else 0, count)
        return Shortfall(words, count, max(_DEFAULT_RUNS, self.uncertainty.runs))

    def ranking_text(self) -> str:
        """Return a sentence on the largest cause and the resolved ranking of the causes."""
        indices = self.uncertainty.indices
        if indices is None or len(self.study.names) < 2:
            return ""
        ranks = indices.ranks()
        total = indices.total
        order = np.argsort(-total, kind="stable")
        first = [self.study.names[i] for i in order if ranks[i][0] == 1]
        tied = sum(best < worst for best, worst in ranks)
        if len(first) > 1:
            words = (
                f"{self._samples_text} do not resolve the largest cause; it is"
                f" {_alternatives(first)}"
            )
        else:
            share = _percent(total[order[0]], indices.half_width[1, order[0]])
            words = f"{first[0]} matters most (total index {share})"
            words += (
                f"; {self._samples_text} do not resolve the order of {tied} others"
                if tied
                else ""
            )
        return f"{self.subject}: {words}"

    @property
    def _samples_text(self) -> str:
        if self._is_predicted:
            runs = f" ({self.uncertainty.runs} runs)"
        else:
            runs = ""
        return f"{self.uncertainty.count} samples{runs}"

    def outside_text(self) -> str:
        """Return the reason for a value outside its own interval; empty for a value inside."""
        uncertainty = self.uncertainty
        name = next(
            (key for key in reversed(RANGES) if _is_outside(uncertainty, key)), None
        )
        if name is None:
            return ""
        low, high = uncertainty.interval(name)
        side = "above" if uncertainty.value > high else "below"
        share = name.removeprefix("interval_")
        words = (
            f"{self.subject}: the value {uncertainty.value:.3g} is {side} its {share} %"
            f" interval ({low:.3g} to {high:.3g}), because it belongs to the numbers in"
            " the robot file and the interval to numbers drawn from their"
            " distributions"
        )
        if not math.isfinite(uncertainty.at_medians):
            return words
        by_skewness = uncertainty.value - uncertainty.at_medians
        by_nonlinearity = uncertainty.at_medians - uncertainty.median
        return (
            f"{words}. The file's numbers instead of the medians of their distributions"
            f" change it by {by_skewness:+.2g}{self._skewed_parameters()}; nonlinearity"
            f" changes it by {by_nonlinearity:+.2g} (median of the samples:"
            f" {uncertainty.median:.3g})"
        )

    def _skewed_parameters(self) -> str:
        """Return the parameters whose values in the file are far from their medians, largest cause first."""
        indices = self.uncertainty.indices
        if indices is None:
            weights = np.ones(len(self.study.names))
        else:
            weights = indices.total
        order = np.argsort(-weights[: len(self.study.priors.parameters)], kind="stable")
        texts = []
        for prior in (self.study.priors.parameters[i] for i in order):
            share = float(prior.cdf(np.array([prior.value]))[0])
            if not _MIDDLE[0] <= share <= _MIDDLE[1]:
                median = float(prior.quantile(np.array([0.5]))[0])
                texts.append(f"{prior.path} {prior.value:.3g} instead of {median:.3g}")
        more = ", …" if len(texts) > _MAX_LISTED else ""
        if texts:
            return f" ({', '.join(texts[:_MAX_LISTED])}{more})"
        return ""


def outside_marks(uncertainty: MetricUncertainty) -> str:
    """Return "**" for a value outside its 95 % interval, "*" for one outside only that of 50 %, else ""."""
    return "*" * sum(_is_outside(uncertainty, name) for name in RANGES)


def remedy(shortfalls: Sequence[Shortfall], study: UncertaintyStudy) -> dict[str, int]:
    """Return the options (name → number) with which a study would have no shortfalls; empty if unknown."""
    runs = max((shortfall.runs for shortfall in shortfalls), default=0)
    needed = {
        "samples": max([runs, *(shortfall.samples for shortfall in shortfalls)]),
        "twin": runs,
    }
    present = {"samples": study.samples, "twin": study.twin_samples}
    return {
        name: count
        for name, count in needed.items()
        if present[name] < count <= MAX_SAMPLES
    }


def _is_outside(uncertainty: MetricUncertainty, name: str) -> bool:
    low, high = uncertainty.interval(name)
    return high > low and not low <= uncertainty.value <= high


def _growth(errors: np.ndarray, limit: float) -> float:
    """Return the factor on the number of runs that reduces an error part to half of the allowed variance."""
    return 2 * float((errors[2:].max() / limit) ** 2)


def _next_power_of_two(count: float) -> int:
    """Return the next power of two, as a Sobol sequence is balanced only at these sizes."""
    return 1 << max(math.ceil(count) - 1, 1).bit_length()


def _percent(share: float, error: float) -> str:
    return f"{100 * share:.0f} ± {100 * min(error, 1.0):.0f} %"


def _alternatives(names: Sequence[str]) -> str:
    if len(names) > _MAX_LISTED:
        more = [f"{len(names) - _MAX_LISTED} others"]
    else:
        more = []
    listed = [*names[:_MAX_LISTED], *more]
    return f"{', '.join(listed[:-1])} or {listed[-1]}"
