r"""Identifiability and accuracy of fitted parameters.

Let J be the Jacobian of the weighted residuals with respect to the coordinates z of
`parameters`. J has singular values s_k and right singular vectors v_k. The error E of J
is estimated from the difference between Jacobians computed with the steps h and 2h. A
direction v_k is *unidentifiable* if its effect on the residuals does not exceed the
error of the derivatives:

$$ s_k \le 2\,\lVert E v_k \rVert \quad\text{or}\quad s_k \le 10^{-6} s_1 . $$

Each identifiable direction has the standard error σ/s_k, where σ is the noise of the
weighted residuals. A parameter is not identifiable if its component in the
unidentifiable directions exceeds 0.1. A smaller component increases the variance of the
parameter, as if the parameter were uniformly distributed between its bounds along these
directions. A parameter is also not identifiable if its standard error in z is at least
1. All other parameters are identified if this standard error is at most 0.1, and weakly
identified otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.identification.estimate import (
    IDENTIFIED_ERROR,
    MISFIT_MESSAGE,
    UNIDENTIFIABLE_ERROR,
    Parameter,
    Verdict,
)
from srs_twin.identification.parameters import FreeParameter

MAX_UNIDENTIFIABLE_FRACTION = 0.1
"""Maximum component of an identifiable parameter in the unidentifiable directions."""

_DERIVATIVE_ERRORS = 2.0
"""Factor of the error E in the criterion for unidentifiable directions."""

_RELATIVE_CUTOFF = 1e-6
"""Relative singular value below which a direction is unidentifiable."""

_MIN_COMPONENT = 0.05
"""Minimum magnitude of a component that is listed for an unidentifiable direction."""

_SPREAD_ONLY = "the spread about the best value under a wrong model"


@dataclass(frozen=True)
class Identifiability:
    """Covariance and unidentifiable directions in the coordinates z.

    Attributes:
        covariance: covariance of the n parameters, shape (n, n).
        fraction: component of each parameter in the unidentifiable directions, shape
            (n,).
        directions: unidentifiable directions, shape (directions, n).
    """

    covariance: np.ndarray
    fraction: np.ndarray
    directions: np.ndarray
    names: tuple[str, ...]

    @property
    def errors(self) -> np.ndarray:
        """Standard errors in z, shape (n,)."""
        return np.sqrt(np.diag(self.covariance))

    def is_unidentifiable(self, i: int) -> bool:
        """Return whether parameter i is not identifiable."""
        return bool(
            self.fraction[i] > MAX_UNIDENTIFIABLE_FRACTION
            or self.errors[i] >= UNIDENTIFIABLE_ERROR
        )

    def describe(self, i: int) -> str:
        """Return why parameter i is not identifiable."""
        components = np.abs(self.directions) > _MIN_COMPONENT
        rows = components[components[:, i]]
        others = sorted(
            name for k, name in enumerate(self.names) if k != i and rows[:, k].any()
        )
        if not len(rows):
            return (
                f"its standard error in z is {self.errors[i]:.2g}, which is not below 1"
            )
        if not others:
            return "the residuals do not depend on it"
        return f"only a combination of it with {', '.join(others)} has an effect"

    @property
    def cancels(self) -> tuple[dict[str, float], ...]:
        """Unidentifiable directions, as mappings from parameter names to components."""
        rows = []
        for row in self.directions:
            positive = row * np.sign(row[np.argmax(np.abs(row))])
            rows.append(
                {
                    name: round(float(value), 3)
                    for name, value in zip(self.names, positive, strict=True)
                    if abs(value) > _MIN_COMPONENT
                }
            )
        return tuple(rows)


def identifiability(
    jacobian: np.ndarray,
    error: np.ndarray,
    noise: float,
    widths: np.ndarray,
    names: Iterable[str],
) -> Identifiability:
    """Determine the identifiability of n parameters from a Jacobian.

    Args:
        jacobian: Jacobian J, shape (samples, n).
        error: estimated error E of the Jacobian, shape (samples, n).
        noise: standard deviation σ of a weighted residual, multiplied by the square
            root of the correlation time.
        widths: distance between the bounds of each parameter in z, shape (n,).
        names: names of the parameters.
    """
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    derivative_error = np.linalg.norm(error @ directions.T, axis=0)
    undetermined = (singular <= _DERIVATIVE_ERRORS * derivative_error) | (
        singular <= _RELATIVE_CUTOFF * singular.max(initial=0.0)
    )
    determined = directions[~undetermined]
    unidentifiable = directions[undetermined]
    covariance = (determined.T * (noise / singular[~undetermined]) ** 2) @ determined
    # Without data, a parameter is assumed to be uniformly distributed between its
    # bounds. This distribution has a variance of width²/12.
    prior_std = (np.abs(unidentifiable) @ widths) / np.sqrt(12)
    covariance += (unidentifiable.T * prior_std**2) @ unidentifiable
    fraction = np.linalg.norm(unidentifiable, axis=0)
    return Identifiability(covariance, fraction, unidentifiable, tuple(names))


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of the parameters found by a search.

    Attributes:
        unknowns: the n free parameters.
        z: estimate, shape (n,).
        inside: indices of the parameters whose estimates lie inside the bounds.
        known: identifiability of the parameters in `inside`.
        bias: bias in z due to model errors, shape (n,).
        spread: maximum distance in z to a minimum with an equally good fit, shape (n,).
        quantile: half width of a confidence interval divided by the standard error.
    """

    unknowns: tuple[FreeParameter, ...]
    z: np.ndarray
    converged: bool
    inside: np.ndarray
    known: Identifiability
    bias: np.ndarray
    spread: np.ndarray
    quantile: float
    explained: bool

    def parameter(self, i: int) -> Parameter:
        """Return parameter i with its verdict and confidence interval."""
        unknown = self.unknowns[i]
        z = float(self.z[i])
        index = int(np.searchsorted(self.inside, i))
        lost = ""
        if i not in self.inside:
            lost = _describe_bound(unknown, z)
        elif self.known.is_unidentifiable(index):
            lost = self.known.describe(index)
        if lost:
            return Parameter(unknown.name, unknown.unit, "not identifiable", why=lost)
        error = float(self.known.errors[index])
        value = unknown.value(z)
        verdict, why = self._verdict(error, self.spread[i])
        if 2 * self.bias[i] ** 2 > error**2:
            true = unknown.value(z - self.bias[i])
            model_error = (
                f"mostly model error: data that the reference simulates with {true:.4g}"
                " give this value"
            )
            why = "; ".join(filter(None, (why, model_error)))
        if not self.explained:
            verdict = "cannot tell"
            why = f"{MISFIT_MESSAGE}: {_SPREAD_ONLY}"
        half = self.quantile * error
        low = unknown.value(z - half)
        high = unknown.value(z + half)
        std = unknown.derivative(value) * error
        return Parameter(
            unknown.name, unknown.unit, verdict, value, std, low, high, why
        )

    def _verdict(self, error: float, spread: float) -> tuple[Verdict, str]:
        if spread > max(IDENTIFIED_ERROR, 2 * self.quantile * error):
            return (
                "weakly identified",
                "another start gives a different value with an equally good fit",
            )
        if not self.converged:
            return "weakly identified", "the search did not converge"
        if error > IDENTIFIED_ERROR:
            return "weakly identified", "its standard error is large"
        return "identified", ""

    def covariance(self, kept: Sequence[int]) -> np.ndarray:
        """Return the covariance in z, with NaN for parameters at bounds."""
        matrix = np.full((len(self.unknowns), len(self.unknowns)), np.nan)
        matrix[np.ix_(self.inside, self.inside)] = self.known.covariance
        return matrix[np.ix_(kept, kept)]


def _describe_bound(parameter: FreeParameter, z: float) -> str:
    above = z - parameter.coordinate(parameter.low)
    below = parameter.coordinate(parameter.high) - z
    if above < below:
        where = f"lower bound, {parameter.low:g}"
    else:
        where = f"upper bound, {parameter.high:g}"
    return f"the best fit is at the {where} {parameter.unit}, or beyond"
