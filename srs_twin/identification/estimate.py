r"""Result of a fit, with a verdict on the identifiability of each parameter.

The verdicts of `identifiability` assume that the model is correct. The model does not
explain the data if the RMS of the weighted residuals exceeds `MAX_RESIDUAL_SCALE`,
either for all signals together or for one kind of signal. Estimated values then get the
verdict "cannot tell", because the confidence intervals of a wrong model are
meaningless.

**Independent samples.** Successive residuals are correlated, because the model has
errors and because cameras and filters smooth the noise. If the residuals have the
autocorrelation ρ_k at lag k, n samples are equivalent to n/τ independent samples, where

$$ \tau = 1 + 2 \sum_{k \ge 1} \rho_k . $$

The sum is truncated at the first pair ρ_{2m} + ρ_{2m+1} that is not positive (initial
positive sequence estimator, Geyer 1992, Statistical Science 7). A fit of p parameters
removes about a fraction c = p τ/n of the noise power from the residuals, mainly at low
frequencies. The autocorrelation is therefore replaced by (ρ_k + c)/(1 + c). This
correction is iterated because c depends on τ.

The autocorrelation is averaged over all series, weighted by their power. In short
series, such as pulls or averages of runs, all values are treated as independent
samples.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, Protocol

import numpy as np

from srs_twin.errors import InputError
from srs_twin.trajectory import HtmlResult

IDENTIFIED_ERROR = 0.1
"""Maximum standard error of an identified parameter, in the coordinate z."""

UNIDENTIFIABLE_ERROR = 1.0
"""Standard error at which a parameter becomes unidentifiable, in the coordinate z."""

MAX_RESIDUAL_SCALE = 2.0
"""RMS of the weighted residuals above which the model does not explain the data."""

LEVEL = 0.95
"""Confidence level of the intervals."""

MISFIT_MESSAGE = "the model does not explain the data; these intervals do not hold"

Verdict = Literal["identified", "weakly identified", "cannot tell", "not identifiable"]
Role = Literal["fit", "validation"]


@dataclass(frozen=True)
class Residual:
    """Differences between the measured and predicted values of one signal.

    Attributes:
        name: name of the data set and of the signal, such as ``"step_1 bend_2"``.
        values: residuals, shape (samples,), ordered by time in a time series.
        scale: standard deviation of the expected noise, in `unit`, by which the fit
            divides the residuals.
    """

    name: str
    unit: str
    values: np.ndarray
    scale: float
    role: Role = "fit"

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        if len(self.values):
            return float(np.sqrt(np.mean(self.values**2)))
        return 0.0


@dataclass(frozen=True)
class Parameter:
    """Estimated value of one parameter, with a verdict on its identifiability.

    The verdict depends on the ratio of the standard error to the value, or to the scale
    of a parameter that may be 0 or negative:

    - "identified": the ratio is at most 0.1.
    - "weakly identified": the ratio is below 1, or the estimate is ambiguous.
    - "cannot tell": the model does not explain the data.
    - "not identifiable": the data do not determine the parameter, so `value` is None.

    Attributes:
        name: parameter name as defined in the module `parameters`.
        low: lower end of the 95 % confidence interval.
        high: upper end of the 95 % confidence interval.
        why: reason for the verdict.
    """

    name: str
    unit: str
    verdict: Verdict
    value: float | None = None
    standard_error: float | None = None
    low: float | None = None
    high: float | None = None
    why: str = ""

    def __post_init__(self) -> None:
        numbers = (self.value, self.standard_error, self.low, self.high)
        is_empty = self.verdict == "not identifiable"
        if any((number is None) != is_empty for number in numbers):
            required = "value, standard_error, low and high"
            expected = "no value, standard_error, low or high" if is_empty else required
            raise InputError(
                f"{self.name}: a parameter with the verdict '{self.verdict}' must"
                f" have {expected}"
            )


def half_width(error: float, freedom: float) -> float:
    """Return half the width of the confidence interval of a parameter.

    The argument `error` is the standard error, estimated with `freedom` degrees of
    freedom.
    """
    from scipy import stats  # slow import

    return float(stats.t.ppf(0.5 + LEVEL / 2, freedom)) * error


def verdict_on(error: float, scale: float) -> Verdict:
    """Return the verdict on a parameter with a given standard error.

    The argument `scale` is a significant change of the parameter, in the unit of
    `error`.
    """
    if error <= IDENTIFIED_ERROR * scale:
        return "identified"
    return "weakly identified"


class Estimated(Protocol):
    """Protocol for parameters that may have no value."""

    @property
    def value(self) -> float | None:
        """Estimated value, or None if the parameter is not identifiable."""


def with_value(parameters: Sequence[Estimated]) -> list[int]:
    """Return the indices of the parameters that have a value."""
    return [k for k, parameter in enumerate(parameters) if parameter.value is not None]


def correlation_matrix(
    covariance: np.ndarray, parameters: Sequence[Parameter]
) -> np.ndarray:
    """Return the correlation matrix, with NaN for parameters without a value."""
    matrix = np.full(covariance.shape, np.nan)
    rows = with_value(parameters)
    known = covariance[np.ix_(rows, rows)]
    # Without noise all standard errors are 0. The lower limit prevents a division by 0.
    errors = np.maximum(np.sqrt(np.diag(known)), 1e-150)
    matrix[np.ix_(rows, rows)] = np.clip(known / np.outer(errors, errors), -1.0, 1.0)
    matrix[rows, rows] = 1.0
    return matrix


@dataclass(frozen=True)
class FitEstimate(HtmlResult):
    """Result of a fit.

    Attributes:
        parameters: estimated parameters, in the requested order.
        correlation: correlation matrix of the estimates, shape (parameters,
            parameters), with NaN for parameters without a value.
        residuals: residuals of the fitted data and of the validation data.
        cancels: unidentifiable directions in z, each as a mapping from parameter names
            to components.
        samples: number of fitted samples.
        independent: equivalent number of independent samples (see `correlation_time`).
        residual_scale: standard deviation of the weighted residuals, which is 1 if the
            residuals are as large as expected.
        held: quantities that were constant in the fit and affect the estimates, by
            name.
        derived: quantities computed from the parameters, such as a frequency.
    """

    page: ClassVar[str] = "fit"

    parameters: tuple[Parameter, ...]
    correlation: np.ndarray
    residuals: tuple[Residual, ...] = ()
    cancels: tuple[Mapping[str, float], ...] = ()
    samples: int = 0
    independent: float = 0.0
    residual_scale: float = 0.0
    held: Mapping[str, float] = field(default_factory=dict)
    converged: bool = True
    derived: tuple[Parameter, ...] = ()

    def __getitem__(self, name: str) -> Parameter:
        """Return the parameter with a given name."""
        return next(
            parameter for parameter in self.parameters if parameter.name == name
        )

    @property
    def values(self) -> dict[str, float]:
        """Estimated values by parameter name."""
        return {
            parameter.name: parameter.value
            for parameter in self.parameters
            if parameter.value is not None
        }

    @property
    def misfit(self) -> tuple[str, ...]:
        """Messages about the signals that the model does not explain."""
        if explains_data(self.residuals, self.residual_scale):
            return ()
        return (MISFIT_MESSAGE, *describe_misfit(self.residuals))

    def with_fixed(self, known: Sequence[Parameter]) -> FitEstimate:
        """Return the estimate with additional, independently measured parameters."""
        size = len(self.parameters)
        count = len(known)
        correlation = np.eye(size + count)
        correlation[:size, :size] = self.correlation
        lost = np.isnan(np.diag(correlation))
        correlation[lost] = np.nan
        correlation[:, lost] = np.nan
        return replace(
            self, parameters=(*self.parameters, *known), correlation=correlation
        )

    def rms(self, role: Role) -> float | None:
        """Return the RMS of the weighted residuals, or None if there are no data."""
        squares = [
            (r.values / r.scale) ** 2
            for r in self.residuals
            if r.role == role and len(r.values)
        ]
        if squares:
            return float(np.sqrt(np.concatenate(squares).mean()))
        return None

    def text(self) -> str:
        """Return the estimate as text with one line per parameter."""
        lines = []
        for parameter in (*self.parameters, *self.derived):
            if parameter.value is None:
                lines.append(f"{parameter.name}: {parameter.verdict}; {parameter.why}")
                continue
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            why = f"; {parameter.why}" if parameter.why else ""
            value = f"{parameter.value:.5g} ± {parameter.standard_error:.2g}{unit}"
            interval = f"95 % {parameter.low:.5g} to {parameter.high:.5g}"
            lines.append(
                f"{parameter.name}: {value}, {interval}: {parameter.verdict}{why}"
            )
        return "\n".join((*lines, *self.misfit))


_MIN_SERIES = 20
"""Minimum number of values in a signal that is treated as a time series."""

_GROWTH = 1.5
"""Minimum RMS ratio at which residuals are reported as growing with time.

The ratio is the RMS in the second half of a series divided by the RMS in the first
half.
"""


def residuals_by_kind(residuals: Sequence[Residual]) -> dict[str, list[Residual]]:
    """Group the fitted residuals by kind of signal, with the largest RMS first."""
    kinds: dict[str, list[Residual]] = {}
    for residual in residuals:
        if residual.role == "fit" and len(residual.values):
            kind = re.sub(r"_(\d+|x|y)$", "", residual.name.rpartition(" ")[2])
            kinds.setdefault(kind, []).append(residual)
    return dict(sorted(kinds.items(), key=lambda kind: -_weighted_rms(kind[1])))


def _weighted_rms(residuals: Sequence[Residual]) -> float:
    squares = [(residual.rms / residual.scale) ** 2 for residual in residuals]
    return float(np.sqrt(np.mean(squares)))


def explains_data(residuals: Sequence[Residual], scale: float) -> bool:
    """Return whether the residuals are consistent with the noise.

    Both the residuals of each kind of signal and the standard deviation `scale` of all
    weighted residuals are checked.
    """
    scales = map(_weighted_rms, residuals_by_kind(residuals).values())
    return max(scale, *scales, 0.0) <= MAX_RESIDUAL_SCALE


def describe_misfit(residuals: Sequence[Residual]) -> Iterator[str]:
    """Yield a description of each kind of signal whose residuals exceed the noise."""
    for kind, signals in residuals_by_kind(residuals).items():
        if (scale := _weighted_rms(signals)) <= 1:
            break
        worst = max(signals, key=lambda residual: residual.rms / residual.scale)
        halves = [
            [np.sum(half**2) for half in np.array_split(residual.values, 2)]
            for residual in signals
        ]
        before, after = np.sum(halves, axis=0)
        is_growing = len(worst.values) >= _MIN_SERIES and after > _GROWTH**2 * before
        growing = ", growing with time" if is_growing else ""
        name = worst.name.rpartition(" ")[0]
        where = f", most in {name}" if name else ""
        yield f"residuals of {kind}: {scale:.3g} times the noise{where}{growing}"


MIN_CORRELATED_SAMPLES = 20
"""Minimum number of samples in a series whose autocorrelation is estimated."""

_ITERATIONS = 5
"""Number of iterations of the correction for fitted parameters."""

_MAX_REMOVED_FRACTION = 0.5
"""Maximum fraction c of the noise power that a fit is assumed to remove."""


def correlation_time(series: Sequence[np.ndarray], unknowns: int = 0) -> float:
    """Return the correlation time τ in samples, which is at least 1.

    Args:
        series: time series of weighted residuals, each of shape (samples,).
        unknowns: number p of fitted parameters.
    """
    long = [
        residuals for residuals in series if len(residuals) >= MIN_CORRELATED_SAMPLES
    ]
    if not long or not any(residuals.any() for residuals in long):
        return 1.0
    longest = max(len(residuals) for residuals in long)
    total = np.zeros(longest)
    largest = max(abs(residuals).max() for residuals in long)
    for residuals in long:
        total[: len(residuals)] += _autocovariance(residuals / largest)
    rho = total / total[0]
    pairs = rho[: longest // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    kept = pairs[: ends[0]] if ends.size else pairs
    lags = 2 * len(kept) - 1  # excludes lag 0
    uncorrected = max(1.0, float(2 * kept.sum() - 1))
    samples = sum(len(residuals) for residuals in long)
    time = uncorrected
    for _ in range(_ITERATIONS):
        removed = min(unknowns * time / samples, _MAX_REMOVED_FRACTION)
        correlations = (float(kept.sum()) - 1 + lags * removed) / (1 + removed)
        time = max(1.0, 1.0 + 2 * correlations)
    return time


def _autocovariance(values: np.ndarray) -> np.ndarray:
    """Return the sums Σ_t r_t r_{t+k} for the lags k = 0…n−1."""
    size = 1 << (2 * len(values) - 1).bit_length()
    spectrum = np.fft.rfft(values, size)
    return np.asarray(np.fft.irfft(np.abs(spectrum) ** 2, size)[: len(values)])
