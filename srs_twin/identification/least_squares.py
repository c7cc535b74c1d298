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

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from srs_twin.identification.estimate import Estimate, Parameter, Verdict
from srs_twin.identification.independence import correlation_time
from srs_twin.identification.reasons import cancels, hidden_because, wanted_beyond
from srs_twin.identification.search import End, Manner, Residuals, Search, Values, Watch, starts_of
from srs_twin.identification.unknowns import Unknown
from srs_twin.identification.verdicts import IDENTIFIED, Knowledge, knowledge

LEVEL = 0.95
"""Of the confidence intervals."""

_AT_BOUND = 1e-3  # z: closer to a bound, the data want it beyond


def least_squares(
    residuals: Residuals,
    unknowns: Sequence[Unknown],
    *,
    manner: Manner | None = None,
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
        manner: how the search suits the model; default that of a smooth one.
        starts: how many searches; the first from the unknowns' starts, others from the best of many
            points drawn about it.
        seed: of these draws.
        held: what the values refer to, for the estimate.
        watch: is told how far the search is.
        validation: residuals of data that are only looked at in the end, where those take long.

    Raises:
        InputError: no unknown, fewer samples than unknowns, or residuals that are not finite at the start.
    """
    search = Search(residuals, tuple(unknowns), manner or Manner(), watch)
    ends = [search.run(start) for start in starts_of(search, starts, seed)]
    best = min(ends, key=lambda end: end.cost)
    found = _estimate(search, best, ends, held or {})
    if validation is None:
        return found
    return replace(found, residuals=(*found.residuals, *validation(search.values(best.z))))


def _estimate(search: Search, best: End, ends: Sequence[End], held: Values) -> Estimate:
    from scipy import stats

    z, unknowns = best.z, search.unknowns
    residuals = search.residuals(z)
    fitted = [each.values / each.scale for each in residuals if each.role == "fit"]
    samples = sum(len(each) for each in fitted)
    independent = samples / correlation_time(fitted, len(unknowns))
    freedom = max(independent - len(unknowns), 1.0)
    variance = 2 * best.cost / samples * max(independent / freedom, 1.0)
    noise = float(np.sqrt(variance * samples / independent))
    jacobian, doubt = search.derivatives(z, noise)
    # What does not act does not want to be anywhere, least of all at a bound.
    acts = np.linalg.norm(jacobian, axis=0) > 2 * np.linalg.norm(doubt, axis=0)
    bound = acts & ((z - search.low < _AT_BOUND) | (search.high - z < _AT_BOUND))
    inside = np.flatnonzero(~bound)
    known = None
    if inside.size:
        widths = (search.high - search.low)[inside]
        known = knowledge(jacobian[:, inside], doubt[:, inside], noise, widths)
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


def _rivals(best: End, ends: Sequence[End], variance: float, limit: float) -> np.ndarray:
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
