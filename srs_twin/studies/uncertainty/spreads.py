r"""Spread of one metric over a robot's uncertain numbers: intervals, errors of their ends, sensitivities.

The ends of an interval are sample quantiles q. Their standard errors have two parts,

$$ \mathrm{se}^2 = \mathrm{se}_\text{sampling}^2 + \mathrm{se}_\text{surrogate}^2, \qquad
\mathrm{se}_\text{surrogate}^2 = \frac{G-1}{G} \sum_g (q_{-g} - \bar q)^2 . $$

The first comes from the bootstrap (Efron 1979, Annals of Statistics 7): the samples are drawn again with
replacement. Points of a Sobol sequence fill the space more evenly than independent ones, so it is an upper
bound of the error. The second belongs to metrics that a surrogate predicts at most samples: a delete-a-group
jackknife over the costly runs, in random groups, because consecutive Sobol points form a pattern.

The bootstrap cannot see beyond the outermost samples. All of n samples lie above the quantile of order p
with the probability (1 − p)^n. Below `BOUNDING` samples this exceeds 2.5 % for the ends of a 95 % interval,
and the samples do not bound the interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from srs_twin.scenario.interval_verdict import IntervalVerdict, interval_verdict
from srs_twin.studies.uncertainty.surrogates import corrected

RANGES = {"interval_50": (0.25, 0.75), "interval_95": (0.025, 0.975)}
_ENDS = [end for ends in RANGES.values() for end in ends]
_OUTSIDE = RANGES["interval_95"][0]
BOUNDING = math.ceil(math.log(_OUTSIDE) / math.log(1 - _OUTSIDE))
"""Least number of samples that bounds a 95 % interval: 146."""
_GROUPS = 8
_DRAWINGS = 400  # the bootstrap's own error is 1/√(2·400), 4 % of the standard error
_AT_ONCE = 50  # drawings in memory together


@dataclass(frozen=True)
class Spread:
    """One metric of one plant.

    Attributes:
        value: with the numbers of the robot file.
        halved: the same with half of the time step.
        at_medians: with every uncertain number at its median.
        samples: predicted at each sample of the priors, shape (samples,); NaN where there is no number.
        runs: samples that the plant itself ran; a surrogate predicted the rest.
        sampling: standard errors of the ends of 50 and 95 % from the number of samples, shape (4,).
        surrogate: standard errors of these ends from the surrogate, shape (4,).
        first: Sobol's indices of the first order, shape (d,); None where the numbers are correlated.
        total: total indices, shape (d,).
        doubt: half of the 95 % interval of both, shape (2, d).
        published: published value, if any.
    """

    value: float
    halved: float
    at_medians: float
    samples: np.ndarray
    runs: int
    sampling: np.ndarray
    surrogate: np.ndarray
    first: np.ndarray | None = None
    total: np.ndarray | None = None
    doubt: np.ndarray | None = None
    published: float | None = None

    def interval(self, name: str) -> tuple[float, float]:
        """Return the ends of `interval_50` or `interval_95`."""
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
    def errors(self) -> np.ndarray:
        """Standard errors of the ends of 50 and 95 %, shape (4,)."""
        return np.hypot(self.sampling, self.surrogate)

    @property
    def numerical(self) -> float:
        """u_num: change by a step refined without end, by Richardson extrapolation of the first order."""
        return 2 * abs(self.value - self.halved)

    @property
    def verdict(self) -> IntervalVerdict | None:
        """Verdict on the published value by the 95 % interval; None where nothing is published."""
        if self.published is None:
            return None
        return interval_verdict(self.published, self.interval("interval_95"), self.errors[2:].tolist())

    def ranks(self) -> list[tuple[int, int]]:
        """Return the best and the worst place that each number can take among the causes.

        Total indices count as different if they differ by more than their errors, added in quadrature.
        """
        if self.total is None or self.doubt is None:
            return []
        allowed = np.hypot(self.doubt[1][:, None], self.doubt[1])
        apart = self.total[:, None] - self.total > allowed
        return [
            (1 + int(above), len(self.total) - int(below))
            for above, below in zip(apart.sum(axis=0), apart.sum(axis=1), strict=True)
        ]

    def document(self, names: tuple[str, ...]) -> dict[str, Any]:
        """Return plain data.

        Args:
            names: of the uncertain numbers.
        """
        row: dict[str, Any] = {"value": self.value}
        row |= {name: list(self.interval(name)) for name in RANGES}
        row |= {"interval_50_error": self.errors[:2].tolist(), "interval_95_error": self.errors[2:].tolist()}
        row |= {"median": self.median}
        row["value_at_medians"] = self.at_medians if math.isfinite(self.at_medians) else None
        row |= {"samples": self.count, "runs": self.runs, "u_input": float(np.nanstd(self.samples))}
        row["u_num"] = self.numerical if math.isfinite(self.halved) else None
        row["sensitivity"] = None
        if self.first is not None and self.total is not None and self.doubt is not None:
            keys = ("first", "total", "first_error", "total_error")
            columns = np.array([self.first, self.total, *self.doubt]).T.tolist()
            row["sensitivity"] = {
                name: {**dict(zip(keys, column, strict=True)), "rank": list(rank)}
                for name, column, rank in zip(names, columns, self.ranks(), strict=True)
            }
        verdict = self.verdict
        return row | {"published": self.published, "verdict": None if verdict is None else verdict.value}


def sampling_errors(samples: np.ndarray) -> np.ndarray:
    """Return standard errors of the ends of 50 and 95 % from the number of samples, shape (4,)."""
    known = samples[np.isfinite(samples)]
    found = bootstrap(
        (known,),
        lambda drawn, axis: np.quantile(drawn, _ENDS, axis=axis),
        n_resamples=_DRAWINGS,
        batch=_AT_ONCE,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return np.asarray(found.standard_error)


def predicted(shares: np.ndarray, cheap: np.ndarray, costly: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a costly metric at all samples, and the surrogate's part of the errors of interval ends.

    Args:
        shares: u of all samples, shape (samples, d).
        cheap: the cheap metric, shape (samples,); NaN where there is no number.
        costly: the costly metric at the first samples, shape (fewer,).
    """
    count, kept = len(costly), np.isfinite(cheap)
    kept[:count] &= np.isfinite(costly)
    x, y, few = shares[kept], cheap[kept], costly[kept[:count]]
    samples = np.full(len(cheap), np.nan)
    samples[kept], chosen = corrected(x, y, few)
    if np.isfinite(samples).sum() == len(few):
        return samples, np.zeros(len(_ENDS))  # all are runs; there is no prediction
    group = np.random.default_rng(0).permutation(len(few)) % _GROUPS
    rest = np.arange(len(few), len(y))
    ends = []
    for g in range(_GROUPS):
        stays, leaves = np.flatnonzero(group != g), np.flatnonzero(group == g)
        order = np.concatenate([stays, leaves, rest])
        ends.append(np.nanquantile(corrected(x[order], y[order], few[stays], chosen)[0], _ENDS))
    return samples, np.sqrt((_GROUPS - 1) * np.var(ends, axis=0))
