r"""Uncertainty of a metric: prediction intervals, their errors and sensitivity indices.

The bounds of the intervals are sample quantiles q. The standard error of a bound
combines a sampling error and a surrogate error:

$$ \mathrm{se}^2 = \mathrm{se}_\text{sampling}^2 + \mathrm{se}_\text{surrogate}^2,
\qquad
\mathrm{se}_\text{surrogate}^2 = \frac{G-1}{G} \sum_g (q_{-g} - \bar q)^2 . $$

The sampling error is estimated by the bootstrap (Efron 1979, Annals of Statistics 7).
This estimate is an upper bound, because points of a Sobol sequence are distributed more
evenly than independent points. For metrics that a surrogate predicts, the surrogate
error is estimated by a delete-a-group jackknife over the twin runs. In the equation,
q_{-g} is the quantile without group g of G groups, and \bar q is the mean of these
quantiles. The groups are random, because consecutive Sobol points are not independent.

The bootstrap cannot represent values beyond the outermost samples. With probability
(1 − p)^n, all n samples lie above the quantile of order p. For p = 2.5 %, this
probability exceeds 2.5 % if n is below `MIN_BOUNDING_SAMPLES`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from scipy.stats import bootstrap

from srs_twin.compute.arrays import Array
from srs_twin.scenario.expectation import IntervalVerdict, interval_verdict
from srs_twin.studies.uncertainty.surrogates import predict_high_fidelity

RANGES = {"interval_50": (0.25, 0.75), "interval_95": (0.025, 0.975)}
_PROBABILITIES = [probability for ends in RANGES.values() for probability in ends]
_TAIL = RANGES["interval_95"][0]

MIN_BOUNDING_SAMPLES = math.ceil(math.log(_TAIL) / math.log(1 - _TAIL))
"""Minimum number of samples for a 95 % interval (146)."""

_MAX_END_ERROR = 0.05
"""Standard error of an interval bound above which a warning is given, relative to the
interval width.
"""

_MAX_INDEX_ERROR = 0.1
"""Half-width of the 95 % interval of a total index above which a warning is given."""

_GROUPS = 8

_RESAMPLINGS = 400
"""Number of bootstrap samples, which estimate a standard error with a relative error of
1/√(2·400), or about 4 %.
"""

_BATCH = 50


class SensitivityDocument(TypedDict):
    """Sensitivity indices of one quantity with their errors, and its possible ranks."""

    first: float
    total: float
    first_error: float
    total_error: float
    rank: Sequence[int]


class MetricDocument(TypedDict):
    """Distribution of a metric as JSON-compatible data (`MetricUncertainty`)."""

    value: float
    interval_50: Sequence[float]
    interval_95: Sequence[float]
    interval_50_error: Sequence[float]
    interval_95_error: Sequence[float]
    median: float
    value_at_medians: float | None
    samples: int
    runs: int
    u_input: float
    u_num: float | None
    sensitivity: Mapping[str, SensitivityDocument] | None
    published: float | None
    verdict: str | None


class TargetDocument(TypedDict):
    """Plant and metric whose uncertainty is explained."""

    plant: str
    metric: str


class SwingDocument(TypedDict):
    """Effect of one quantity as JSON-compatible data (`propagation.Swing`)."""

    parameter: str
    low: float
    high: float
    error: float


class UncertaintyDocument(TypedDict):
    """Result of an uncertainty study as JSON-compatible data.

    Attributes:
        plants: distribution of each metric, keyed by plant name and metric.
        swings: effect of each quantity on the target metric.
        segments: speed ranges of the twin, or None (`Propagation.segments`).
    """

    scenario: str
    robot: str
    changes: Sequence[object]
    contact: str | None
    plants: Mapping[str, Mapping[str, MetricDocument]]
    measure_next: Sequence[object]
    swings: Sequence[SwingDocument]
    segments: Mapping[str, Sequence[float]] | None
    warnings: Sequence[str]
    target: TargetDocument
    fidelity: Mapping[str, object]
    priors: object
    forms: Mapping[str, Sequence[object]]


@dataclass(frozen=True)
class SobolIndices:
    """Sensitivity indices of one metric.

    Attributes:
        first: first-order indices, shape (d,).
        total: total indices, shape (d,).
        half_width: half-widths of the 95 % intervals of the first-order and total
            indices, shape (2, d).
    """

    first: Array
    total: Array
    half_width: Array

    def ranks(self) -> list[tuple[int, int]]:
        """Return the best and worst possible rank of each quantity by its total index.

        Two indices count as different if their difference exceeds the root sum of
        squares of their half-widths.
        """
        limit = np.hypot(self.half_width[1][:, None], self.half_width[1])
        is_larger = self.total[:, None] - self.total > limit
        return [
            (1 + int(above), len(self.total) - int(below))
            for above, below in zip(
                is_larger.sum(axis=0), is_larger.sum(axis=1), strict=True
            )
        ]

    def document(self, names: tuple[str, ...]) -> dict[str, SensitivityDocument]:
        """Return the indices and ranks of each quantity as JSON-compatible data."""
        columns = np.array([self.first, self.total, *self.half_width]).T.tolist()
        return {
            name: {
                "first": first,
                "total": total,
                "first_error": first_error,
                "total_error": total_error,
                "rank": list(rank),
            }
            for name, (first, total, first_error, total_error), rank in zip(
                names, columns, self.ranks(), strict=True
            )
        }


@dataclass(frozen=True)
class MetricUncertainty:
    """Distribution of a metric for one plant.

    Attributes:
        value: value with the parameters from the robot file.
        half_timestep: value with half the time step.
        at_medians: value with all uncertain parameters at their medians.
        samples: values at samples from the priors, or NaN if unknown, shape (samples,).
        runs: number of samples that are simulated rather than predicted by a surrogate.
        sampling: standard errors of the bounds of the 50 % and 95 % intervals due to
            sampling, shape (4,).
        surrogate: standard errors of these bounds due to the surrogate, shape (4,).
        indices: sensitivity indices, or None if the metric is constant or the
            parameters are correlated.
    """

    value: float
    half_timestep: float
    at_medians: float
    samples: Array
    runs: int
    sampling: Array
    surrogate: Array
    indices: SobolIndices | None = None
    published: float | None = None

    def interval(self, name: str) -> tuple[float, float]:
        """Return the bounds of `interval_50` or `interval_95`."""
        low, high = np.nanquantile(self.samples, RANGES[name])
        return float(low), float(high)

    @property
    def count(self) -> int:
        """Number of samples with a value."""
        return int(np.isfinite(self.samples).sum())

    @property
    def median(self) -> float:
        """Median over the samples."""
        return float(np.nanmedian(self.samples))

    @property
    def errors(self) -> Array:
        """Total standard errors of the 50 % and 95 % interval bounds, shape (4,)."""
        return np.hypot(self.sampling, self.surrogate)

    @property
    def numerical_error(self) -> float:
        """Time-step error, estimated by first-order Richardson extrapolation."""
        return 2 * abs(self.value - self.half_timestep)

    def warnings(self) -> list[str]:
        """Return warnings about too few samples and large errors."""
        low, high = self.interval("interval_95")
        if not high > low:
            return []
        texts = []
        if self.count < MIN_BOUNDING_SAMPLES:
            texts.append(
                f"{self.count} samples do not bound the 95 % interval. With a"
                f" probability of {100 * (1 - _TAIL) ** self.count:.0f} %, no sample"
                " lies beyond its true lower end, and likewise for the upper end;"
                f" {MIN_BOUNDING_SAMPLES} samples reduce this probability to"
                f" {100 * _TAIL:g} %"
            )
        errors = self.errors[2:] / (high - low)
        if errors.max() > _MAX_END_ERROR:
            width_error = 2 * math.sqrt(2) * _MAX_END_ERROR
            texts.append(
                "the standard errors of the ends of the 95 % interval are"
                f" {' and '.join(f'{100 * error:.0f} %' for error in errors)} of its"
                f" width; above {100 * _MAX_END_ERROR:.0f} %, the width is uncertain"
                f" by more than {100 * width_error:.0f} %"
            )
        if self.indices is not None:
            error = min(float(self.indices.half_width[1].max()), 1.0)
            if error > _MAX_INDEX_ERROR:
                texts.append(
                    f"total indices have errors of up to ±{100 * error:.0f} %; above"
                    f" ±{100 * _MAX_INDEX_ERROR:.0f} %, causes that differ by less"
                    f" than {100 * math.sqrt(2) * _MAX_INDEX_ERROR:.0f} % cannot be"
                    " distinguished"
                )
        return texts

    @property
    def verdict(self) -> IntervalVerdict | None:
        """Position of the published value relative to the 95 % interval, or None."""
        if self.published is None:
            return None
        return interval_verdict(
            self.published, self.interval("interval_95"), self.errors[2:].tolist()
        )

    def document(self, names: tuple[str, ...]) -> MetricDocument:
        """Return the distribution as JSON-compatible data, given the quantity names."""
        sensitivity = None
        if self.indices is not None:
            sensitivity = self.indices.document(names)
        verdict = self.verdict
        return {
            "value": self.value,
            "interval_50": list(self.interval("interval_50")),
            "interval_95": list(self.interval("interval_95")),
            "interval_50_error": self.errors[:2].tolist(),
            "interval_95_error": self.errors[2:].tolist(),
            "median": self.median,
            "value_at_medians": _finite(self.at_medians),
            "samples": self.count,
            "runs": self.runs,
            "u_input": float(np.nanstd(self.samples)),
            "u_num": _finite(self.numerical_error),
            "sensitivity": sensitivity,
            "published": self.published,
            "verdict": None if verdict is None else verdict.value,
        }


def _finite(value: float) -> float | None:
    if math.isfinite(value):
        return value
    return None


def count_text(samples: int, runs: int) -> str:
    """Return the number of samples, and the number of runs if it is smaller."""
    text = f"{samples} samples"
    if runs < samples:
        text += f", {runs} runs"
    return text


def sampling_errors(samples: Array) -> Array:
    """Return the standard errors of the interval bounds due to sampling, shape (4,)."""
    known = samples[np.isfinite(samples)]
    result = bootstrap(
        (known,),
        lambda drawn, axis: np.quantile(drawn, _PROBABILITIES, axis=axis),
        n_resamples=_RESAMPLINGS,
        batch=_BATCH,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return np.asarray(result.standard_error)


def predict_twin(fractions: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Predict the twin's metric at all samples.

    Args:
        fractions: inputs u of all samples, shape (samples, d).
        low: low-fidelity metric, or NaN if unknown, shape (samples,).
        high: metric of the twin at the first n samples, shape (n,).

    Returns:
        Metric at all samples, shape (samples,), and standard errors of the interval
        bounds due to the surrogate, shape (4,).
    """
    count = len(high)
    is_known = np.isfinite(low)
    is_known[:count] &= np.isfinite(high)
    x = fractions[is_known]
    y = low[is_known]
    runs = high[is_known[:count]]
    samples = np.full(len(low), np.nan)
    samples[is_known], hyperparameters = predict_high_fidelity(x, y, runs)
    if np.isfinite(samples).sum() == len(runs):
        # Only simulated samples have values, so there is no surrogate error.
        return samples, np.zeros(len(_PROBABILITIES))
    group = np.random.default_rng(0).permutation(len(runs)) % _GROUPS
    predicted = np.arange(len(runs), len(y))
    ends = []
    for g in range(_GROUPS):
        stay = np.flatnonzero(group != g)
        leave = np.flatnonzero(group == g)
        order = np.concatenate([stay, leave, predicted])
        prediction, _ = predict_high_fidelity(
            x[order], y[order], runs[stay], hyperparameters
        )
        ends.append(np.nanquantile(prediction, _PROBABILITIES))
    return samples, np.sqrt((_GROUPS - 1) * np.var(ends, axis=0))
