r"""least_squares: find unknowns from residuals, with what these data can and cannot tell of them.

**Search.** SciPy's trust-region method finds where the sum of squared weighted residuals is least, within
bounds, in the coordinates of `unknowns`, with central differences for the Jacobian and as few runs of a model
as can be. Of a model with kinks it is tried anew with a coarse step where it ended. Where a *guide* names
residuals that change evenly with the unknowns however far off these are, the search begins by them alone: of
a crawling robot the bends, while path and heading say little from some per cent on, for then it has turned
elsewhere. Everything is deterministic: more starts than one are drawn from a seed.

**Intervals.** With S the sum at the estimate, n samples worth n/τ independent ones (`correlation_time`) and p
unknowns, the covariance is

$$ C = s^2\,\tau\,(J^\top J)^{-1}, \qquad s^2 = \frac{S}{n}\,\frac{n/\tau}{n/\tau - p}, $$

and intervals take Student's t with n/τ − p degrees of freedom, in z: those of logarithms are not symmetric.
This is exact for unknowns whose effect is slower than the correlation of the residuals and overstates the
error of others.

**Error of the model.** What a model lacks moves the estimate, and residuals may show nothing of it. A
*reference*, a better model, shows it: of data that it makes with values z₀ the search finds others, and
b(z₀), their difference, is by how much an estimate is off there (indirect inference: Gouriéroux, Monfort and
Renault 1993, Journal of Applied Econometrics 8). The bias that counts is that at the true values, and b
depends on them. With b₁ = b(z), the iteration b_{k+1} = b(z − b_k) approaches it,

$$ C \to C + b_n b_n^\top + (b_n - b_{n-1})(b_n - b_{n-1})^\top ; $$

the last term is how closely b is known. The iteration ends when no element of b changes by more than its
standard error in C, or after five searches. The values stay as they are: those with which the model fits
best.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.estimate import (
    IDENTIFIED,
    UNEXPLAINED,
    Estimate,
    Identifiability,
    Parameter,
    Residual,
    Verdict,
    bound_reason,
    cancels,
    correlation_time,
    explains,
    hidden_reason,
    identifiability,
)
from srs_twin.identification.unknowns import Unknown

Values = Mapping[str, float]
Residuals = Callable[[Values], Sequence[Residual]]
Guide = Callable[[Residual], bool]

Refit = Callable[[Values], Values]
"""Returns what a search finds, by name, of data that a reference makes with these values."""

Watch = Callable[[int, float], None]
"""Called while a search goes on, with how often the model was run and the least weighted RMS so far."""

_SPREAD = 1.5  # z: how far other starts lie from the first
_APART = 0.7  # z: between starts
_DRAWN = 12  # candidates for each start besides the first
_ATTEMPTS = 4
_BETTER = 0.99  # share of the sum of squares below which another attempt is worth it
_MOST_STEPS = 100


@dataclass(frozen=True)
class SearchOptions:
    """How a search suits a model.

    Attributes:
        step: of the differences, in z; larger for models that are not smooth.
        coarse: a larger step with which a search that has ended is tried anew, for models with kinks; with a
            guide, that of the search by the guide, and none is tried anew.
        tolerance: share of the sum of squares, or of z, below which a step ends the search; None: what suits
            the step of the differences.
        guide: says which residuals change evenly with the unknowns, however far off these are. A search
            begins by them alone and goes on by all of them.
        telling: step of the differences by which is judged what the data tell, where they leave open more
            than the search's step; None: that of the search.
        enough: RMS of the weighted residuals below which a search ends: nothing is left to explain.
        most_runs: how often a search may run the model; one that would run it more often ends at the best it
            has found, as not converged. None: as often as it takes.
    """

    step: float = 1e-4
    coarse: float | None = None
    tolerance: float | None = None
    guide: Guide | None = None
    telling: float | None = None
    enough: float = 0.0
    most_runs: int | None = None

    @property
    def ending(self) -> float:
        """The tolerance that holds."""
        return max(1e-12, 1e-3 * self.step**2) if self.tolerance is None else self.tolerance


@dataclass(frozen=True)
class SearchEnd:
    """Where a search ended: z of shape (n,), half the sum of squares, whether it converged."""

    z: np.ndarray
    cost: float
    converged: bool


class Search:
    """Weighted residuals as a function of z, and their derivatives."""

    def __init__(
        self, residuals: Residuals, unknowns: tuple[Unknown, ...], options: SearchOptions, watch: Watch | None
    ) -> None:
        self.unknowns, self._options, self._residuals = unknowns, options, residuals
        self._watch, self._runs, self._least_rms = watch, 0, np.inf
        self._searching, self._left, self._best = False, np.inf, SearchEnd(np.zeros(0), np.inf, False)
        if not unknowns:
            raise InputError("a fit needs at least one unknown")
        self.low = np.array([each.coordinate(each.low) for each in unknowns])
        self.high = np.array([each.coordinate(each.high) for each in unknowns])
        first = np.array([each.coordinate(each.start) for each in unknowns])
        weighted = self.weighted(first)
        if len(weighted) <= len(unknowns):
            raise InputError(
                f"{len(weighted)} samples cannot tell {len(unknowns)} unknowns; more data are needed"
            )
        if not np.isfinite(weighted).all():
            raise InputError("residuals are not finite where the search starts; check the data")

    def values(self, z: np.ndarray) -> dict[str, float]:
        """Return the values of the unknowns at z, by name."""
        return {each.name: each.value(float(at)) for each, at in zip(self.unknowns, z, strict=True)}

    def residuals(self, z: np.ndarray) -> tuple[Residual, ...]:
        """Return all residuals at z; this runs the model."""
        return tuple(self._residuals(self.values(z)))

    def weighted(self, z: np.ndarray, only: Guide | None = None) -> np.ndarray:
        """Return weighted residuals of the data to fit, shape (samples,), or those that a guide takes.

        Raises:
            _StoppedError: a search has no run left, or nothing to explain.
        """
        if self._searching and self._left <= 0:
            raise _StoppedError
        fitted = [each for each in self.residuals(z) if each.role == "fit"]
        every = _weighted(fitted)
        self._note(z, every)
        if self._searching and self._best.converged:
            raise _StoppedError
        return every if only is None else _weighted([each for each in fitted if only(each)])

    def _note(self, z: np.ndarray, weighted: np.ndarray) -> None:
        """Count a run, and remember the best of them."""
        self._left -= 1
        cost = 0.5 * float(weighted @ weighted)
        rms = float(np.sqrt(2 * cost / max(len(weighted), 1)))
        if cost < self._best.cost:
            self._best = SearchEnd(z.copy(), cost, rms < self._options.enough)
        if self._watch is not None and len(weighted):
            self._runs += 1
            self._least_rms = min(self._least_rms, rms)
            self._watch(self._runs, self._least_rms)

    def jacobian(self, z: np.ndarray, h: float, only: Guide | None = None) -> np.ndarray:
        """Return derivatives by central differences of step h, one-sided at bounds, shape (samples, n)."""
        columns = []
        for i in range(len(z)):
            up, down = z.copy(), z.copy()
            up[i], down[i] = min(z[i] + h, self.high[i]), max(z[i] - h, self.low[i])
            columns.append((self.weighted(up, only) - self.weighted(down, only)) / (up[i] - down[i]))
        return np.stack(columns, axis=1)

    def derivatives(self, z: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
        """Return a Jacobian, and by how much it may be wrong, shape (samples, n) each.

        Args:
            z: where.
            noise: of a weighted residual.
        """
        step, telling = self._options.step, self._options.telling
        if telling is not None:
            least = float(np.linalg.svd(self.jacobian(z, telling), compute_uv=False)[-1])
            step = telling if noise > step * least else step
        fine, coarse = self.jacobian(z, step), self.jacobian(z, 2 * step)
        if telling is None:
            return fine, coarse - fine
        # Of a model that is not smooth neither is the better one: two samples, and the error of their mean.
        return (fine + coarse) / 2, (coarse - fine) / 2

    def shift(self, z: np.ndarray, refit: Refit) -> np.ndarray:
        """Return how far from z a search ends in data that a reference makes with it, shape (n,)."""
        values = refit(self.values(z))
        return np.array([each.coordinate(values[each.name]) for each in self.unknowns]) - z

    def run(self, start: np.ndarray) -> SearchEnd:
        """Search from a start, by the guide first; where the runs are spent, return the best there was."""
        options = self._options
        self._best = SearchEnd(start, np.inf, False)
        self._searching, self._left = True, options.most_runs or np.inf
        try:
            if options.guide is None:
                return self._through_kinks(start)
            led = self._once(start, options.coarse or options.step, options.guide)
            return self._once(led.z, options.step)
        except _StoppedError:
            return self._best
        finally:
            self._searching = False

    def preferred(self, z: np.ndarray) -> float:
        """Return how badly z suits as a start: by the guide, where there is one."""
        return float(np.sum(self.weighted(z, self._options.guide) ** 2))

    def _through_kinks(self, start: np.ndarray) -> SearchEnd:
        """Search by all residuals; where a kink may have held it up, again with the coarse step, and on."""
        fine, coarse = self._options.step, self._options.coarse
        end = self._once(start, fine)
        for _ in range(_ATTEMPTS):
            if coarse is None:
                break
            before, other = end, self._once(end.z, coarse)
            end = self._once(other.z, fine) if other.cost < before.cost else before
            if not end.cost < _BETTER * before.cost:
                break
        return end

    def _once(self, start: np.ndarray, step: float, only: Guide | None = None) -> SearchEnd:
        # Half a second to import: only for who fits.
        from scipy import optimize

        # What a guide says nothing of stays where it is: the start counts as one observation.
        held = np.zeros((0, len(start))) if only is None else np.eye(len(start))
        found = optimize.least_squares(
            lambda z: np.concatenate([self.weighted(z, only), held @ (z - start)]),
            start,
            lambda z: np.concatenate([self.jacobian(z, step, only), held]),
            bounds=(self.low, self.high),
            ftol=self._options.ending,
            xtol=self._options.ending,
            gtol=1e-15,
            max_nfev=_MOST_STEPS,
        )
        return SearchEnd(found.x, float(found.cost), found.status > 0)


class _StoppedError(Exception):
    """A search has run the model as often as it may, or nothing is left to explain."""


def _weighted(residuals: Sequence[Residual]) -> np.ndarray:
    found = [each.values / each.scale for each in residuals]
    return np.concatenate(found) if found else np.zeros(0)


def starts_of(search: Search, count: int, seed: int) -> list[np.ndarray]:
    """Return the first start and, of many drawn about it, those that fit best."""
    first = np.array([each.coordinate(each.start) for each in search.unknowns])
    draw = np.random.default_rng(seed)
    shifts = draw.uniform(-_SPREAD, _SPREAD, (_DRAWN * (count - 1), len(first)))
    drawn = [np.clip(first + shift, search.low, search.high) for shift in shifts]
    drawn.sort(key=search.preferred)
    chosen = [first]
    for z in drawn:
        # Two that lie close together end alike.
        if len(chosen) < count and all(np.linalg.norm(z - other) > _APART for other in chosen):
            chosen.append(z)
    return chosen


LEVEL = 0.95
"""Of the confidence intervals."""

_AT_BOUND = 1e-3  # z: closer to a bound, the data want it beyond


def least_squares(
    residuals: Residuals,
    unknowns: Sequence[Unknown],
    *,
    options: SearchOptions | None = None,
    starts: int = 1,
    seed: int = 0,
    held: Values | None = None,
    watch: Watch | None = None,
    validation: Residuals | None = None,
    refit: Refit | None = None,
) -> Estimate:
    """Fit unknowns to data.

    Args:
        residuals: of all data, by the values of the unknowns; their number and lengths never change.
            Those whose role is not "fit" are only looked at in the end.
        unknowns: what is looked for.
        options: how the search suits the model; default that of a smooth one.
        starts: how many searches; the first from the unknowns' starts, others from the best of many
            points drawn about it.
        seed: of these draws.
        held: what the values refer to, for the estimate.
        watch: is told how far the search is.
        validation: residuals of data that are only looked at in the end, where those take long.
        refit: shows the error of the model, where this explains the data.

    Raises:
        InputError: no unknown, fewer samples than unknowns, or residuals that are not finite at the start.
    """
    search = Search(residuals, tuple(unknowns), options or SearchOptions(), watch)
    ends = [search.run(start) for start in starts_of(search, starts, seed)]
    best = min(ends, key=lambda end: end.cost)
    found = _estimate(search, best, ends, held or {}, refit)
    if validation is None:
        return found
    return replace(found, residuals=(*found.residuals, *validation(search.values(best.z))))


def _estimate(
    search: Search, best: SearchEnd, ends: Sequence[SearchEnd], held: Values, refit: Refit | None
) -> Estimate:
    from scipy import stats

    z, unknowns = best.z, search.unknowns
    residuals = search.residuals(z)
    fitted = [each.values / each.scale for each in residuals if each.role == "fit"]
    samples = sum(len(each) for each in fitted)
    independent = samples / correlation_time(fitted, len(unknowns))
    freedom = max(independent - len(unknowns), 1.0)
    variance = 2 * best.cost / samples * max(independent / freedom, 1.0)
    noise, scale = float(np.sqrt(variance * samples / independent)), float(np.sqrt(variance))
    jacobian, doubt = search.derivatives(z, noise)
    # What does not act does not want to be anywhere, least of all at a bound.
    acts = np.linalg.norm(jacobian, axis=0) > 2 * np.linalg.norm(doubt, axis=0)
    bound = acts & ((z - search.low < _AT_BOUND) | (search.high - z < _AT_BOUND))
    inside = np.flatnonzero(~bound)
    widths = (search.high - search.low)[inside]
    known = identifiability(jacobian[:, inside], doubt[:, inside], noise, widths)
    off, explained = np.zeros(len(z)), explains(residuals, scale)
    if refit is not None and explained:
        errors = np.full(len(z), np.inf)
        errors[inside] = known.errors
        off, change = _bias(search, z, refit, errors)
        moved = np.stack([off, change])[:, inside]
        known = replace(known, covariance=known.covariance + moved.T @ moved)
    quantile = float(stats.t.ppf(0.5 + LEVEL / 2, freedom))
    reach = _rivals(best, ends, variance * samples / independent, stats.chi2.ppf(LEVEL, len(unknowns)))
    found, kept = [], []
    for i, unknown in enumerate(unknowns):
        if unknown.nuisance:
            continue
        place = int(np.searchsorted(inside, i))
        why = ""
        if bound[i]:
            why = bound_reason(unknown, z[i])
        elif known.hidden(place):
            why = hidden_reason(unknowns, inside, known, place)
        if why:
            found.append(Parameter(unknown.name, unknown.unit, "not identifiable", why=why))
        else:
            error = float(known.errors[place])
            each = _numbers(unknown, float(z[i]), error, quantile, reach[i], best.converged)
            if 2 * off[i] ** 2 > error**2:
                true = unknown.value(z[i] - off[i])
                why = f"mostly the model's error: it finds this value where the reference has {true:.4g}"
                each = replace(each, why="; ".join(filter(None, (each.why, why))))
            if not explained:
                each = replace(each, verdict="cannot tell", why=f"{UNEXPLAINED}: {_SPREAD_ONLY}")
            found.append(each)
        kept.append(i)
    correlation, blind = _correlation(found, kept, inside, known), cancels(unknowns, inside, known)
    return Estimate(
        tuple(found), correlation, residuals, blind, samples, float(independent), scale, held, best.converged
    )


def _bias(search: Search, z: np.ndarray, refit: Refit, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bias of an estimate by the reference, and its change in the last iteration, shape (n,) each.

    Args:
        search: of the estimate.
        z: the estimate.
        refit: searches data that the reference makes.
        errors: standard errors in z; smaller changes end the iteration.
    """
    bias, change = search.shift(z, refit), np.full(len(z), np.inf)
    for _ in range(_MOST_REFITS - 1):
        before, bias = bias, search.shift(np.clip(z - bias, search.low, search.high), refit)
        change = bias - before
        if (np.abs(change) <= errors).all():
            break
    return bias, change


_MOST_REFITS = 5
"""Searches in data of the reference. The bias of gait fits settles within three to five."""

_SPREAD_ONLY = "the spread about the best value under a wrong model"


def _numbers(
    unknown: Unknown, z: float, error: float, quantile: float, rival: float, converged: bool
) -> Parameter:
    value = unknown.value(z)
    verdict: Verdict = "identified" if error <= IDENTIFIED else "weakly identified"
    why = "" if verdict == "identified" else "its standard error is large"
    if not converged:
        verdict, why = "weakly identified", "the search did not come to an end"
    if rival > max(IDENTIFIED, 2 * quantile * error):
        verdict, why = "weakly identified", "another start ends elsewhere and fits as well"
    low, high = unknown.value(z - quantile * error), unknown.value(z + quantile * error)
    return Parameter(unknown.name, unknown.unit, verdict, value, unknown.slope(value) * error, low, high, why)


def _rivals(best: SearchEnd, ends: Sequence[SearchEnd], variance: float, limit: float) -> np.ndarray:
    """Return how far, in z, searches went apart that fit as well as the best, by unknown."""
    alike = [end.z for end in ends if 2 * (end.cost - best.cost) <= limit * variance]
    return np.asarray(np.abs(np.array(alike) - best.z).max(axis=0))


def _correlation(
    found: Sequence[Parameter], kept: Sequence[int], inside: np.ndarray, known: Identifiability
) -> np.ndarray:
    """Return the correlation of what has numbers, NaN elsewhere, shape (parameters, parameters)."""
    matrix = np.full((len(found), len(found)), np.nan)
    rows = [k for k, each in enumerate(found) if each.value is not None]
    if rows:
        places = np.searchsorted(inside, [kept[k] for k in rows])
        # Without noise nothing has an error, and nothing a correlation.
        errors = np.maximum(known.errors[places], 1e-150)
        scaled = known.covariance[np.ix_(places, places)] / np.outer(errors, errors)
        matrix[np.ix_(rows, rows)] = np.clip(scaled, -1.0, 1.0)
        matrix[rows, rows] = 1.0
    return matrix
