r"""least_squares: find unknowns from residuals, with what these data can and cannot tell of them.

The sum of squared weighted residuals is least at the estimate; SciPy's trust-region method finds it within
bounds, in the coordinates of `unknowns`, with central differences for the Jacobian. With S the sum, n samples
worth n/τ independent ones (`independence`) and p unknowns, the covariance is

$$ C = s^2\,\tau\,(J^\top J)^{-1}, \qquad s^2 = \frac{S}{n}\,\frac{n/\tau}{n/\tau - p}, $$

and intervals take Student's t with n/τ − p degrees of freedom, in z: those of logarithms are not symmetric.
This is exact for unknowns whose effect is slower than the correlation of the residuals and
overstates the error of others. Everything is deterministic: more starts than one are drawn from a seed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.estimate import Estimate, Parameter, Residual, Verdict
from srs_twin.identification.independence import correlation_time
from srs_twin.identification.reasons import cancels, hidden_because, wanted_beyond
from srs_twin.identification.unknowns import Unknown
from srs_twin.identification.verdicts import IDENTIFIED, Knowledge, knowledge

Values = Mapping[str, float]
Residuals = Callable[[Values], Sequence[Residual]]

Watch = Callable[[int, float], None]
"""Called while a search goes on, with how often the model was run and the least weighted RMS so far."""

LEVEL = 0.95
"""Of the confidence intervals."""

_SPREAD = 1.5  # z: how far other starts lie from the first
_APART = 0.7  # z: between starts
_DRAWN = 12  # candidates for each start besides the first
_ATTEMPTS = 4
_BETTER = 0.99  # share of the sum of squares below which another attempt is worth it
_AT_BOUND = 1e-3  # z: closer to a bound, the data want it beyond


def least_squares(
    residuals: Residuals,
    unknowns: Sequence[Unknown],
    *,
    step: float = 1e-4,
    coarse: float | None = None,
    tolerance: float | None = None,
    starts: int = 1,
    seed: int = 0,
    held: Values | None = None,
    watch: Watch | None = None,
    validation: Residuals | None = None,
) -> Estimate:
    """Fit unknowns to data.

    Args:
        residuals: of all data, by the values of the unknowns; their number and lengths never change.
            Those whose role is not "fit" are only looked at in the end.
        unknowns: what is looked for.
        step: of the differences, in z; larger for models that are not smooth.
        coarse: a larger step with which a search that has ended is tried anew, for models with kinks.
        tolerance: share of the sum of squares, or of z, below which a step ends the search; default what
            suits the step of the differences.
        starts: how many searches; the first from the unknowns' starts, others from the best of many
            points drawn about it.
        seed: of these draws.
        held: what the values refer to, for the estimate.
        watch: is told how far the search is.
        validation: residuals of data that are only looked at in the end, where those take long.

    Raises:
        InputError: no unknown, fewer samples than unknowns, or residuals that are not finite at the start.
    """
    search = _Search(residuals, tuple(unknowns), step, coarse, tolerance, watch)
    ends = [search.run(start) for start in _starts(search, starts, seed)]
    best = min(ends, key=lambda end: end.cost)
    found = _estimate(search, best, ends, held or {})
    if validation is None:
        return found
    return replace(found, residuals=(*found.residuals, *validation(search.values(best.z))))


@dataclass(frozen=True)
class _End:
    """Where a search ended: z of shape (n,), half the sum of squares, whether it converged."""

    z: np.ndarray
    cost: float
    converged: bool


class _Search:
    """Weighted residuals as a function of z, and their derivatives."""

    def __init__(
        self, residuals: Residuals, unknowns: tuple[Unknown, ...], step: float, coarse: float | None,
        tolerance: float | None,
        watch: Watch | None,
    ) -> None:  # fmt: skip
        self.unknowns, self.step, self._coarse, self._residuals = unknowns, step, coarse, residuals
        self._tolerance = max(1e-12, 1e-3 * step**2) if tolerance is None else tolerance
        self._watch, self._runs, self._least = watch, 0, np.inf
        if not unknowns:
            raise InputError("a fit needs at least one unknown")
        self.low = np.array([each.coordinate(each.low) for each in unknowns])
        self.high = np.array([each.coordinate(each.high) for each in unknowns])
        first = self.weighted(np.array([each.coordinate(each.start) for each in unknowns]))
        if len(first) <= len(unknowns):
            raise InputError(
                f"{len(first)} samples cannot tell {len(unknowns)} unknowns; more data are needed"
            )
        if not np.isfinite(first).all():
            raise InputError("residuals are not finite where the search starts; check the data")

    def values(self, z: np.ndarray) -> dict[str, float]:
        return {each.name: each.value(float(at)) for each, at in zip(self.unknowns, z, strict=True)}

    def residuals(self, z: np.ndarray) -> tuple[Residual, ...]:
        return tuple(self._residuals(self.values(z)))

    def weighted(self, z: np.ndarray) -> np.ndarray:
        found = [each.values / each.scale for each in self.residuals(z) if each.role == "fit"]
        weighted = np.concatenate(found) if found else np.zeros(0)
        if self._watch is not None and len(weighted):
            self._runs += 1
            self._least = min(self._least, float(np.sqrt(np.mean(weighted**2))))
            self._watch(self._runs, self._least)
        return weighted

    def jacobian(self, z: np.ndarray, step: float | None = None) -> np.ndarray:
        """Return derivatives by central differences, one-sided at bounds, shape (samples, n)."""
        h = self.step if step is None else step
        columns = []
        for i in range(len(z)):
            up, down = z.copy(), z.copy()
            up[i], down[i] = min(z[i] + h, self.high[i]), max(z[i] - h, self.low[i])
            columns.append((self.weighted(up) - self.weighted(down)) / (up[i] - down[i]))
        return np.stack(columns, axis=1)

    def run(self, start: np.ndarray) -> _End:
        """Search from a start; where a kink may have held it up, again with the coarse step, and so on."""
        end = self._once(start, self.step)
        for _ in range(_ATTEMPTS if self._coarse else 0):
            before = end
            coarse = self._once(end.z, self._coarse)
            end = self._once(coarse.z, self.step) if coarse.cost < before.cost else before
            if not end.cost < _BETTER * before.cost:
                break
        return end

    def _once(self, start: np.ndarray, step: float | None) -> _End:
        # Half a second to import: only for who fits.
        from scipy import optimize

        found = optimize.least_squares(
            self.weighted, start, lambda z: self.jacobian(z, step), (self.low, self.high), "trf",
            ftol=self._tolerance, xtol=self._tolerance, gtol=1e-15, max_nfev=100,
        )  # fmt: skip
        return _End(found.x, float(found.cost), found.status > 0)


def _starts(search: _Search, count: int, seed: int) -> list[np.ndarray]:
    """Return the first start and, of many drawn about it, those that fit best."""
    first = np.array([each.coordinate(each.start) for each in search.unknowns])
    draw = np.random.default_rng(seed)
    shifts = draw.uniform(-_SPREAD, _SPREAD, (_DRAWN * (count - 1), len(first)))
    drawn = [np.clip(first + shift, search.low, search.high) for shift in shifts]
    drawn.sort(key=lambda z: float(np.sum(search.weighted(z) ** 2)))
    chosen = [first]
    for z in drawn:
        # Two that lie close together end alike.
        if len(chosen) < count and all(np.linalg.norm(z - other) > _APART for other in chosen):
            chosen.append(z)
    return chosen


def _estimate(search: _Search, best: _End, ends: Sequence[_End], held: Values) -> Estimate:
    from scipy import stats

    z, unknowns = best.z, search.unknowns
    residuals = search.residuals(z)
    fitted = [each.values / each.scale for each in residuals if each.role == "fit"]
    samples = sum(len(each) for each in fitted)
    independent = samples / correlation_time(fitted, len(unknowns))
    freedom = max(independent - len(unknowns), 1.0)
    variance = 2 * best.cost / samples * max(independent / freedom, 1.0)
    noise = float(np.sqrt(variance * samples / independent))
    jacobian = search.jacobian(z)
    coarser = search.jacobian(z, 2 * search.step) - jacobian
    # What does not act does not want to be anywhere, least of all at a bound.
    acts = np.linalg.norm(jacobian, axis=0) > 2 * np.linalg.norm(coarser, axis=0)
    bound = acts & ((z - search.low < _AT_BOUND) | (search.high - z < _AT_BOUND))
    inside = np.flatnonzero(~bound)
    known = None
    if inside.size:
        widths = (search.high - search.low)[inside]
        known = knowledge(jacobian[:, inside], coarser[:, inside], noise, widths)
    quantile = float(stats.t.ppf(0.5 + LEVEL / 2, freedom))
    reach = _rivals(best, ends, variance * samples / independent, stats.chi2.ppf(LEVEL, len(unknowns)))
    found, kept = [], []
    for i, unknown in enumerate(unknowns):
        if unknown.nuisance:
            continue
        place = int(np.searchsorted(inside, i))
        if bound[i]:
            found.append(
                Parameter(unknown.name, unknown.unit, "not identifiable", why=wanted_beyond(unknown, z[i]))
            )
        elif known is None or known.hidden(place):
            why = hidden_because(unknowns, inside, known, place)
            found.append(Parameter(unknown.name, unknown.unit, "not identifiable", why=why))
        else:
            error = float(known.errors[place])
            found.append(_numbers(unknown, float(z[i]), error, quantile, reach[i], best.converged))
        kept.append(i)
    return Estimate(
        tuple(found), _correlation(found, kept, inside, known), residuals,
        cancels(unknowns, inside, known), samples, float(independent), float(np.sqrt(variance)), dict(held),
        best.converged,
    )  # fmt: skip


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


def _rivals(best: _End, ends: Sequence[_End], variance: float, limit: float) -> np.ndarray:
    """Return how far, in z, searches went apart that fit as well as the best, by unknown."""
    alike = [end.z for end in ends if 2 * (end.cost - best.cost) <= limit * variance]
    return np.asarray(np.abs(np.array(alike) - best.z).max(axis=0))


def _correlation(
    found: Sequence[Parameter], kept: Sequence[int], inside: np.ndarray, known: Knowledge | None
) -> np.ndarray:
    """Return the correlation of what has numbers, NaN elsewhere, shape (parameters, parameters)."""
    matrix = np.full((len(found), len(found)), np.nan)
    rows = [k for k, each in enumerate(found) if each.value is not None]
    if known is not None and rows:
        places = np.searchsorted(inside, [kept[k] for k in rows])
        # Without noise nothing has an error, and nothing a correlation.
        errors = np.maximum(known.errors[places], 1e-150)
        matrix[np.ix_(rows, rows)] = np.clip(
            known.covariance[np.ix_(places, places)] / np.outer(errors, errors), -1.0, 1.0
        )
        matrix[rows, rows] = 1.0
    return matrix
