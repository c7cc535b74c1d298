r"""Weighted nonlinear least squares with confidence intervals and identifiability.

**Search.** SciPy's trust-region method minimises the sum of squared weighted residuals
within bounds, in the coordinates z of `parameters`. If the model has kinks, the search
continues from the first minimum with a coarser difference step. Additional starting
points are drawn at random with a fixed seed, so the search is deterministic.

An optional first stage uses only residuals that vary monotonically over a large range
of the parameters. For a crawling robot, these are the residuals of the bends.

**Intervals.** Let S be the sum of squares at the estimate, p the number of parameters
and n the number of samples. Due to correlations, these samples are equivalent to n/τ
independent samples (`correlation_time`). The covariance is

$$ C = s^2\,\tau\,(J^\top J)^{-1}, \qquad s^2 = \frac{S}{n}\,\frac{n/\tau}{n/\tau - p}.
$$

The confidence intervals are computed in z with Student's t distribution and n/τ − p
degrees of freedom. The interval of a positive parameter is therefore asymmetric. The
intervals are exact if the effect of a parameter varies slowly compared with the
correlation time of the residuals, and too wide otherwise.

**Model error.** Model errors bias the estimate even if the residuals are small. The
bias is estimated by indirect inference with a better model, the *reference*
(Gouriéroux, Monfort and Renault 1993, Journal of Applied Econometrics 8). The model is
fitted to data that the reference simulates with the parameters z₀. The bias b(z₀) is
the difference between the fitted parameters and z₀.

The bias at the unknown true parameters is approximated by the iteration
b_{k+1} = b(z − b_k) with b₁ = b(z). The covariance becomes

$$ C \to C + b_n b_n^\top + (b_n - b_{n-1})(b_n - b_{n-1})^\top , $$

where the last term is the uncertainty of the bias. The iteration ends when the bias
changes by less than the standard errors, or after five searches. The estimate itself is
not corrected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.compute.arrays import Array
from srs_twin.errors import InputError
from srs_twin.identification.estimate import (
    LEVEL,
    FitEstimate,
    Residual,
    correlation_matrix,
    correlation_time,
    explains_data,
    half_width,
)
from srs_twin.identification.identifiability import (
    Accuracy,
    Identifiability,
    identifiability,
)
from srs_twin.identification.parameters import FreeParameter

Values = Mapping[str, float]
Residuals = Callable[[Values], Sequence[Residual]]
ResidualFilter = Callable[[Residual], bool]

Refit = Callable[[Values], Values]
"""Function that fits the model to data simulated by a reference model."""

Watch = Callable[[int, float], None]
"""Callback that receives the number of model runs and the smallest weighted RMS."""

_START_RANGE = 1.5
"""Maximum change of each coordinate z for additional starting points."""

_MIN_START_DISTANCE = 0.7
"""Minimum distance in z between two starting points."""

_CANDIDATES_PER_START = 12
"""Number of random candidates per additional starting point."""

_MAX_COARSE_SEARCHES = 4

_IMPROVEMENT = 0.99
"""Ratio of new to old sum of squares below which the search is repeated."""

_MAX_ITERATIONS = 100


@dataclass(frozen=True)
class SearchOptions:
    """Settings of a search.

    Attributes:
        step: step of finite differences in z. Models that are not smooth need a larger
            step.
        coarse_step: step in z of the first stage. Without a first stage, the search is
            repeated with this step to leave the local minima of a model with kinks.
        tolerance: relative change of the sum of squares or of z at which the search
            ends, by default derived from `step`.
        first_stage: filter that selects the residuals of the first stage, which are
            monotonic over a large range of the parameters.
        identifiability_step: step of the Jacobian from which the identifiability is
            computed. If this value is None or the uncertainty of the estimate is below
            `step`, the Jacobian is computed with `step`.
        target_rms: RMS of the weighted residuals at which the search ends early.
        max_runs: maximum number of model runs, or None for no limit. A search that
            reaches this limit counts as not converged.
    """

    step: float = 1e-4
    coarse_step: float | None = None
    tolerance: float | None = None
    first_stage: ResidualFilter | None = None
    identifiability_step: float | None = None
    target_rms: float = 0.0
    max_runs: int | None = None

    @property
    def effective_tolerance(self) -> float:
        """Tolerance of the search, which by default is derived from `step`."""
        return self.tolerance or max(1e-12, 1e-3 * self.step**2)


@dataclass(frozen=True)
class SearchResult:
    """Coordinates z of a minimum, and half the sum of squared weighted residuals."""

    z: Array
    cost: float
    converged: bool


class Search:
    """Weighted residuals as a function of z, with methods that minimise them."""

    def __init__(
        self,
        residuals: Residuals,
        unknowns: tuple[FreeParameter, ...],
        options: SearchOptions,
        watch: Watch | None,
    ) -> None:
        self.unknowns = unknowns
        self._options = options
        self._residuals = residuals
        self._watch = watch
        self._runs = 0
        self._smallest_rms = np.inf
        self._is_searching = False
        self._runs_left = np.inf
        self._best = SearchResult(np.zeros(0), np.inf, False)
        if not unknowns:
            raise InputError("no parameter is given; name at least one free parameter")
        self.low, self.high, self.start = (
            np.array(
                [unknown.coordinate(getattr(unknown, end)) for unknown in unknowns]
            )
            for end in ("low", "high", "start")
        )
        weighted = self.weighted(self.start)
        if len(weighted) <= len(unknowns):
            raise InputError(
                f"{len(weighted)} samples cannot determine {len(unknowns)} parameters;"
                " give more data or fewer parameters"
            )
        if not np.isfinite(weighted).all():
            raise InputError(
                "some residuals are not finite at the start of the search; check the"
                " data"
            )

    def values(self, z: Array) -> dict[str, float]:
        """Return the parameter values at z, keyed by parameter name."""
        return {
            unknown.name: unknown.value(float(at))
            for unknown, at in zip(self.unknowns, z, strict=True)
        }

    def residuals(self, z: Array) -> tuple[Residual, ...]:
        """Run the model and return all residuals at z."""
        return tuple(self._residuals(self.values(z)))

    def weighted(self, z: Array, only: ResidualFilter | None = None) -> Array:
        """Return the weighted residuals of the fitted data at z.

        If the filter `only` is given, it selects the residuals that are returned.

        Raises:
            _SearchStoppedError: the maximum number of runs or the target RMS is
                reached.
        """
        if self._is_searching and self._runs_left <= 0:
            raise _SearchStoppedError
        fitted = [residual for residual in self.residuals(z) if residual.role == "fit"]
        weighted = _weighted(fitted)
        self._record_run(z, weighted)
        if self._is_searching and self._best.converged:
            raise _SearchStoppedError
        if only is None:
            return weighted
        return _weighted([residual for residual in fitted if only(residual)])

    def _record_run(self, z: Array, weighted: Array) -> None:
        self._runs_left -= 1
        cost = 0.5 * float(weighted @ weighted)
        rms = float(np.sqrt(2 * cost / max(len(weighted), 1)))
        if cost < self._best.cost:
            self._best = SearchResult(z.copy(), cost, rms < self._options.target_rms)
        if self._watch is not None and len(weighted):
            self._runs += 1
            self._smallest_rms = min(self._smallest_rms, rms)
            self._watch(self._runs, self._smallest_rms)

    def jacobian(self, z: Array, h: float, only: ResidualFilter | None = None) -> Array:
        """Return the Jacobian by central differences (one-sided at bounds)."""
        columns = []
        for i in range(len(z)):
            up = z.copy()
            down = z.copy()
            up[i] = min(z[i] + h, self.high[i])
            down[i] = max(z[i] - h, self.low[i])
            change = self.weighted(up, only) - self.weighted(down, only)
            columns.append(change / (up[i] - down[i]))
        return np.stack(columns, axis=1)

    def jacobian_and_error(self, z: Array, noise: float) -> tuple[Array, Array]:
        """Return the Jacobian and an estimate of its error, each of shape (samples, n).

        `noise` is the standard deviation of a weighted residual.
        """
        step = self._options.step
        wide = self._options.identifiability_step
        if wide is not None:
            singular = np.linalg.svd(self.jacobian(z, wide), compute_uv=False)
            if noise > step * singular[-1]:
                step = wide
        fine = self.jacobian(z, step)
        coarse = self.jacobian(z, 2 * step)
        if wide is None:
            return fine, coarse - fine
        # If the model is not smooth, the Jacobians with both step sizes are equally
        # accurate. The error of their mean is half the difference between them.
        return (fine + coarse) / 2, (coarse - fine) / 2

    def bias(self, z: Array, refit: Refit) -> Array:
        """Return the bias b(z) from a fit to data that the reference simulates at z."""
        values = refit(self.values(z))
        found = [unknown.coordinate(values[unknown.name]) for unknown in self.unknowns]
        return np.array(found) - z

    def run(self, start: Array) -> SearchResult:
        """Search from a starting point and return the minimum.

        A search that is stopped early returns the best point found.
        """
        options = self._options
        self._best = SearchResult(start, np.inf, False)
        self._is_searching = True
        self._runs_left = options.max_runs or np.inf
        try:
            if options.first_stage is None:
                return self._minimize_with_kinks(start)
            first = self._minimize(
                start, options.coarse_step or options.step, options.first_stage
            )
            return self._minimize(first.z, options.step)
        except _SearchStoppedError:
            return self._best
        finally:
            self._is_searching = False

    def start_cost(self, z: Array) -> float:
        """Return the sum of squares by which starting points are ranked."""
        return float(np.sum(self.weighted(z, self._options.first_stage) ** 2))

    def _minimize_with_kinks(self, start: Array) -> SearchResult:
        """Minimise with alternating fine and coarse steps to leave local minima."""
        fine = self._options.step
        coarse = self._options.coarse_step
        end = self._minimize(start, fine)
        if coarse is None:
            return end
        for _ in range(_MAX_COARSE_SEARCHES):
            before = end
            other = self._minimize(end.z, coarse)
            if other.cost < before.cost:
                end = self._minimize(other.z, fine)
            if not end.cost < _IMPROVEMENT * before.cost:
                break
        return end

    def _minimize(
        self, start: Array, step: float, only: ResidualFilter | None = None
    ) -> SearchResult:
        from scipy import optimize  # slow import

        # The prior adds one observation per parameter. A parameter that does not affect
        # the filtered residuals therefore keeps its initial value.
        count = 0 if only is None else len(start)
        prior = np.eye(count, len(start))
        tolerance = self._options.effective_tolerance
        result = optimize.least_squares(
            lambda z: np.concatenate([self.weighted(z, only), prior @ (z - start)]),
            start,
            lambda z: np.concatenate([self.jacobian(z, step, only), prior]),
            bounds=(self.low, self.high),
            ftol=tolerance,
            xtol=tolerance,
            gtol=1e-15,
            max_nfev=_MAX_ITERATIONS,
        )
        return SearchResult(result.x, float(result.cost), result.status > 0)


class _SearchStoppedError(Exception):
    """Signal that a search has reached its maximum number of runs or its target RMS."""


def _weighted(residuals: Sequence[Residual]) -> Array:
    weighted = [residual.values / residual.scale for residual in residuals]
    return np.concatenate([np.zeros(0), *weighted])


def select_starts(search: Search, count: int) -> list[Array]:
    """Return the given starting point and the best of many random points around it."""
    size = (_CANDIDATES_PER_START * (count - 1), len(search.start))
    shifts = np.random.default_rng(0).uniform(-_START_RANGE, _START_RANGE, size)
    candidates = [
        np.clip(search.start + shift, search.low, search.high) for shift in shifts
    ]
    candidates.sort(key=search.start_cost)
    starts = [search.start]
    for z in candidates:
        nearest = min(np.linalg.norm(z - start) for start in starts)
        if len(starts) < count and nearest > _MIN_START_DISTANCE:
            starts.append(z)
    return starts


_BOUND_DISTANCE = 1e-3
"""Maximum distance in z at which a parameter counts as being at its bound."""


def least_squares(
    residuals: Residuals,
    unknowns: Sequence[FreeParameter],
    *,
    options: SearchOptions | None = None,
    starts: int = 1,
    held: Values | None = None,
    watch: Watch | None = None,
    validation: Residuals | None = None,
    refit: Refit | None = None,
) -> FitEstimate:
    """Fit parameters to data by weighted nonlinear least squares.

    Args:
        residuals: function that returns the residuals of all data for given parameter
            values. The number and the lengths of the residuals must not depend on the
            values.
        unknowns: free parameters.
        options: settings of the search, by default for a smooth model.
        starts: number of searches, each from a different starting point.
        held: constant values that affect the estimates and are stored in the result.
        watch: progress callback.
        validation: function that returns the residuals of the validation data, called
            once after the search.
        refit: function that fits the model to data of a reference model, to estimate
            the bias due to model errors.
    """
    search = Search(residuals, tuple(unknowns), options or SearchOptions(), watch)
    ends = [search.run(start) for start in select_starts(search, starts)]
    best = min(ends, key=lambda end: end.cost)
    estimate = _estimate(search, best, ends, held or {}, refit)
    if validation is None:
        return estimate
    return replace(
        estimate, residuals=(*estimate.residuals, *validation(search.values(best.z)))
    )


def _estimate(
    search: Search,
    best: SearchResult,
    ends: Sequence[SearchResult],
    held: Values,
    refit: Refit | None,
) -> FitEstimate:
    from scipy import stats

    z = best.z
    unknowns = search.unknowns
    residuals = search.residuals(z)
    samples, independent, freedom = _count_samples(residuals, len(unknowns))
    variance = 2 * best.cost / samples * max(independent / freedom, 1.0)
    noise = float(np.sqrt(variance * samples / independent))
    scale = float(np.sqrt(variance))
    inside, known = _identify(search, z, noise)
    bias = np.zeros(len(z))
    explained = explains_data(residuals, scale)
    if refit is not None and explained:
        errors = np.full(len(z), np.inf)
        errors[inside] = known.errors
        bias, change = _iterate_bias(search, z, refit, errors)
        terms = np.stack([bias, change])[:, inside]
        known = replace(known, covariance=known.covariance + terms.T @ terms)
    limit = stats.chi2.ppf(LEVEL, len(unknowns)) * variance * samples / independent
    spread = _spread_of_minima(best, ends, limit)
    quantile = half_width(1.0, freedom)
    accuracy = Accuracy(
        unknowns, z, best.converged, inside, known, bias, spread, quantile, explained
    )
    kept = [i for i, unknown in enumerate(unknowns) if not unknown.nuisance]
    parameters = tuple(map(accuracy.parameter, kept))
    correlation = correlation_matrix(accuracy.covariance(kept), parameters)
    return FitEstimate(
        parameters,
        correlation,
        residuals,
        known.cancels,
        samples,
        float(independent),
        scale,
        held,
        best.converged,
    )


def _identify(
    search: Search, z: Array, noise: float
) -> tuple[np.ndarray, Identifiability]:
    jacobian, error = search.jacobian_and_error(z, noise)
    # The search may leave a parameter without effect anywhere, even at a bound.
    has_effect = np.linalg.norm(jacobian, axis=0) > 2 * np.linalg.norm(error, axis=0)
    at_bound = has_effect & (
        (z - search.low < _BOUND_DISTANCE) | (search.high - z < _BOUND_DISTANCE)
    )
    inside = np.flatnonzero(~at_bound)
    widths = (search.high - search.low)[inside]
    names = [search.unknowns[i].name for i in inside]
    known = identifiability(jacobian[:, inside], error[:, inside], noise, widths, names)
    return inside, known


def _count_samples(
    residuals: Sequence[Residual], unknowns: int
) -> tuple[int, float, float]:
    fitted = [
        residual.values / residual.scale
        for residual in residuals
        if residual.role == "fit"
    ]
    samples = sum(map(len, fitted))
    independent = samples / correlation_time(fitted, unknowns)
    return samples, independent, max(independent - unknowns, 1.0)


def _iterate_bias(
    search: Search, z: Array, refit: Refit, errors: Array
) -> tuple[Array, Array]:
    bias = search.bias(z, refit)
    change = np.full(len(z), np.inf)
    for _ in range(_MAX_REFITS - 1):
        before = bias
        bias = search.bias(np.clip(z - bias, search.low, search.high), refit)
        change = bias - before
        if (np.abs(change) <= errors).all():
            break
    return bias, change


_MAX_REFITS = 5
"""Maximum number of fits to data of the reference model."""


def _spread_of_minima(
    best: SearchResult, ends: Sequence[SearchResult], limit: float
) -> Array:
    """Return the maximum distance of each parameter in z to an equivalent minimum."""
    minima = [end.z for end in ends if 2 * (end.cost - best.cost) <= limit]
    return np.asarray(np.abs(np.array(minima) - best.z).max(axis=0))
