r"""Friction from a spring car (Eq. 17, Table 2): the spring's largest deformation as motion begins.

$$ \mu = \frac{k\,\Delta L_{max}}{m g}, $$

once for each pull, along with wheels that roll and across with wheels held. The estimate is the mean over the
pulls with its standard error, grown by what is not known of k and m, which all pulls share. It is the
friction at which motion begins; while the robot slides it may be less: `coasting` measures that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.data_set import DataSet, data_sets, fingerprint, keep_apart
from srs_twin.identification.estimate import Estimate, Parameter, Residual, Role, Verdict
from srs_twin.identification.least_squares import LEVEL
from srs_twin.identification.verdicts import IDENTIFIED, KNOWN
from srs_twin.spec import GRAVITY

_NAMES = ("friction.mu_t", "friction.mu_n")
_WAYS = ("along", "across")
_LEAST_PULLS = 2


@dataclass(frozen=True)
class Pulls:
    """What a spring car measured.

    Attributes:
        along: largest deformation of the spring in each pull with rolling wheels, m.
        across: the same, across the body or with wheels held, m.
        stiffness: k of the spring, N/m.
        mass: m of what was pulled, kg.
        stiffness_error: standard error of k, N/m.
        mass_error: standard error of m, kg.
        name: what the data are called.
        sha256: of their file; empty where there is none.
    """

    along: Sequence[float]
    across: Sequence[float]
    stiffness: float
    mass: float
    stiffness_error: float = 0.0
    mass_error: float = 0.0
    name: str = "pulls"
    sha256: str = ""

    def __post_init__(self) -> None:
        for what in ("stiffness", "mass"):
            value, error = getattr(self, what), getattr(self, f"{what}_error")
            if not (math.isfinite(value) and value > 0 and math.isfinite(error) and 0 <= error < value):
                raise InputError(
                    f"{self.name}: {what} {value!r} with error {error!r} is not allowed; it must be above 0 "
                    "and its error smaller"
                )
        for way in _WAYS:
            pulls = np.asarray(getattr(self, way), dtype=float)
            if pulls.ndim != 1 or not (np.isfinite(pulls) & (pulls >= 0)).all():
                raise InputError(f"{self.name}: pulls {way} must be a list of lengths in m, 0 or more")
            if len(pulls) == 1:
                raise InputError(
                    f"{self.name}: one pull {way} does not show its scatter; give 2 or more, or none"
                )

    @property
    def factor(self) -> float:
        """Friction coefficient over deformation, 1/m."""
        return self.stiffness / (self.mass * GRAVITY)

    def coefficients(self, way: str) -> np.ndarray:
        """Return μ of each pull "along" or "across"."""
        return self.factor * np.asarray(getattr(self, way), dtype=float)

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        along, across = (np.asarray(getattr(self, way), dtype=float) for way in _WAYS)
        used = fingerprint(along, across, np.array([self.stiffness, self.mass]))
        return DataSet(self.name, self.sha256 or used, role, len(along) + len(across))


def fit_pulls(pulls: Pulls, *, validation: Sequence[Pulls] = ()) -> Estimate:
    """Return μ_t and μ_n; a direction that was not pulled is not identifiable.

    Args:
        pulls: what was measured.
        validation: pulls to hold the estimate against.

    Raises:
        InputError: pulls to validate with that are also fitted.
    """
    keep_apart(data_sets([pulls], validation))
    shared = (pulls.stiffness_error / pulls.stiffness) ** 2 + (pulls.mass_error / pulls.mass) ** 2
    values = [pulls.coefficients(way) for way in _WAYS]
    means = np.array([each.mean() if len(each) else np.nan for each in values])
    own = np.array([each.var(ddof=1) / len(each) if len(each) else np.nan for each in values])
    covariance = np.diag(own) + shared * np.outer(means, means)
    errors = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / np.outer(errors, errors)
    found = [_parameter(k, values[k], means[k], own[k], errors[k]) for k in range(2)]
    for k, each in enumerate(found):
        if each.value is None:
            correlation[k], correlation[:, k] = np.nan, np.nan
        else:
            correlation[k, k] = 1.0
    scatter = [max(float(each.std(ddof=1)), 1e-12) if len(each) else math.nan for each in values]
    residuals = tuple(
        Residual(f"{data.name} {way}", "1", data.coefficients(way) - means[k], scatter[k], role)
        for data, role in _with_roles(pulls, validation)
        for k, way in enumerate(_WAYS)
        if len(values[k]) and len(data.coefficients(way))
    )
    samples = sum(len(each) for each in values)
    held = {"mass_kg": pulls.mass, "spring_n_per_m": pulls.stiffness}
    return Estimate(tuple(found), correlation, residuals, (), samples, float(samples), 1.0, held)


def _with_roles(pulls: Pulls, validation: Sequence[Pulls]) -> list[tuple[Pulls, Role]]:
    return [(pulls, "fit"), *((each, "validation") for each in validation)]


def _parameter(k: int, values: np.ndarray, mean: float, own: float, error: float) -> Parameter:
    from scipy import stats

    if len(values) < _LEAST_PULLS:
        return Parameter(_NAMES[k], "1", "not identifiable", why=f"nothing was pulled {_WAYS[k]}")
    if error >= KNOWN * mean:
        why = f"the pulls {_WAYS[k]} scatter as much as they measure"
        return Parameter(_NAMES[k], "1", "not identifiable", why=why)
    # Welch-Satterthwaite: what all pulls share is taken as known from many measurements.
    freedom = (len(values) - 1) * (error**2 / own) ** 2 if own > 0 else np.inf
    reach = float(stats.t.ppf(0.5 + LEVEL / 2, freedom)) * error
    verdict: Verdict = "identified" if error <= IDENTIFIED * mean else "weakly identified"
    return Parameter(_NAMES[k], "1", verdict, float(mean), float(error), max(mean - reach, 0.0), mean + reach)
