r"""Surrogate models: polynomial chaos with sensitivity indices, and a Gaussian process.

**Polynomial chaos** (Sudret 2008, Reliability Engineering & System Safety 93) expands a
result in Legendre polynomials ψ, which are orthonormal for independent inputs
u ∈ (0, 1). The expansion and the sensitivity indices are

$$ y(u) \approx \sum_\alpha c_\alpha \prod_i \psi_{\alpha_i}(u_i), \qquad
S_i = \frac{\sum_{\alpha \in A_i} c_\alpha^2}{\sum_{\alpha \ne 0} c_\alpha^2}, \qquad
T_i = \frac{\sum_{\alpha_i > 0} c_\alpha^2}{\sum_{\alpha \ne 0} c_\alpha^2}, $$

where S_i and T_i are Sobol's first-order and total indices, and the set A_i contains
the terms that depend only on u_i. The polynomial degree is selected by leave-one-out
cross-validation. The error of an index combines the unexplained variance of left-out
samples and the scatter under bootstrap resampling.

The **Gaussian process** (Kennedy and O'Hagan 2000, Biometrika 87) models the
high-fidelity result as a linear trend plus a smooth remainder. The inputs of the
process include the low-fidelity result. The hyperparameters of the process have
log-normal priors and are set to their most probable values.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product

import numpy as np
import scipy.linalg
import scipy.optimize
from scipy.special import eval_legendre

from srs_twin.compute.arrays import Array

_MAX_DEGREE = 10

_SAMPLES_PER_TERM = 5

_MAX_INTERACTION = 2
"""Maximum number of variables in a term of degree above 3."""

_RESAMPLINGS = 20
"""Number of bootstrap samples used to estimate the scatter of the indices."""

_MAX_UNEXPLAINED = 0.5
"""Unexplained fraction of the variance above which a surrogate is rejected."""

_TYPICAL = (0.1, 1.0, 0.01)
"""Medians of the log-normal priors of s, b and n in `GaussianProcess`. The logarithms
of all hyperparameters have a standard deviation of 1.
"""

_TYPICAL_LENGTH = 2.0
"""Median of the log-normal prior of each length scale ℓ in `GaussianProcess`."""


def _terms(variables: int, degree: int) -> np.ndarray:
    """Return the degree of each term in each variable, shape (terms, variables)."""
    rows = [[0] * variables]
    for order in range(1, min(variables, degree, 3) + 1):
        if order <= _MAX_INTERACTION:
            max_degree = degree
        else:
            max_degree = min(degree, 3)
        for which in combinations(range(variables), order):
            for powers in product(range(1, degree + 1), repeat=order):
                if sum(powers) <= max_degree:
                    row = [0] * variables
                    for i, power in zip(which, powers, strict=True):
                        row[i] = power
                    rows.append(row)
    return np.array(rows)


@dataclass(frozen=True)
class PolynomialChaos:
    """Polynomial chaos expansion of one or several results.

    Attributes:
        terms: polynomial degree of each term in each variable, shape (terms, d).
        coefficients: coefficients of the terms, shape (terms, results).
        unexplained: fraction of each result's variance that is unexplained in
            cross-validation, shape (results,).
        residuals: leave-one-out residuals, shape (samples, results).
        index_std: bootstrap standard deviations of the first-order and total indices,
            shape (2, d, results).
    """

    terms: np.ndarray
    coefficients: Array
    unexplained: Array
    residuals: Array
    index_std: Array

    @classmethod
    def fit(cls, fractions: Array, results: Array, *, seed: int = 0) -> PolynomialChaos:
        """Fit results, shape (samples, results), at inputs u, shape (samples, d)."""
        count, variables = fractions.shape
        variance = np.maximum(results.var(axis=0), 1e-300)
        best: tuple[float, Array, Array, Array] | None = None
        for degree in range(1, _MAX_DEGREE + 1):
            terms = _terms(variables, degree)
            if degree > 1 and len(terms) * _SAMPLES_PER_TERM > count:
                break
            design = _design_matrix(fractions, terms)
            coefficients, residuals = _cross_validate(design, results)
            unexplained = (residuals**2).mean(axis=0) / variance
            if best is None or unexplained.mean() < best[0]:
                best = float(unexplained.mean()), terms, coefficients, residuals
        assert best is not None
        _, terms, coefficients, residuals = best
        ridge = 1e-9 * count * np.eye(len(terms))
        rng = np.random.default_rng(seed)
        design = _design_matrix(fractions, terms)
        indices = []
        for _ in range(_RESAMPLINGS):
            rows = rng.integers(count, size=count)
            # The normal equations are accurate enough, because the columns are nearly
            # orthonormal.
            drawn = design[rows]
            fitted = np.linalg.solve(drawn.T @ drawn + ridge, drawn.T @ results[rows])
            indices.append(_indices(terms, fitted))
        unexplained = np.minimum((residuals**2).mean(axis=0) / variance, 1.0)
        return cls(terms, coefficients, unexplained, residuals, np.std(indices, axis=0))

    def at(self, fractions: Array) -> Array:
        """Return the predicted results at inputs u, shape (…, results)."""
        return np.asarray(_design_matrix(fractions, self.terms) @ self.coefficients)

    @cached_property
    def indices(self) -> Array:
        """Sobol's first-order and total indices, shape (2, d, results)."""
        return _indices(self.terms, self.coefficients)

    @property
    def index_half_width(self) -> Array:
        """Half-widths of the 95 % intervals of the indices, shape (2, d, results)."""
        return np.asarray(2 * self.index_std + self.unexplained)


def _design_matrix(fractions: Array, terms: np.ndarray) -> Array:
    """Return the value of each term at each sample, shape (samples, terms)."""
    orders = np.arange(terms.max(initial=0) + 1)
    polynomials = eval_legendre(orders, 2 * fractions[..., None] - 1) * np.sqrt(
        2 * orders + 1
    )
    design = np.ones((len(fractions), len(terms)))
    for i in range(terms.shape[1]):
        design *= polynomials[:, i, terms[:, i]]
    return design


def _cross_validate(design: Array, results: Array) -> tuple[Array, Array]:
    basis, triangle = scipy.linalg.qr(design, mode="economic")
    coefficients = scipy.linalg.lstsq(triangle, basis.T @ results)[0]
    # A leave-one-out residual is the residual divided by 1 − h, where the leverage h is
    # the sample's diagonal element of the hat matrix.
    leverage = np.minimum((basis**2).sum(axis=1), 1 - 1e-9)
    return coefficients, (results - design @ coefficients) / (1 - leverage)[:, None]


def _indices(terms: np.ndarray, coefficients: Array) -> Array:
    power = coefficients**2
    has_one_variable = (terms > 0).sum(axis=1) == 1
    variance = np.maximum(power[1:].sum(axis=0), 1e-300)
    first = [
        power[has_one_variable & (terms[:, i] > 0)].sum(axis=0)
        for i in range(terms.shape[1])
    ]
    total = [power[terms[:, i] > 0].sum(axis=0) for i in range(terms.shape[1])]
    indices: Array = np.array([first, total]) / variance
    return indices


class GaussianProcess:
    r"""Gaussian process with a linear trend, fitted to noisy samples.

    The covariance function is

    $$ k(x, x') = s^2 e^{-\frac12 \sum_i (x_i - x'_i)^2 / \ell_i^2} + b^2 (1 + x \cdot x') + n^2 \delta $$

    Attributes:
        log_hyperparameters: natural logarithms of s, b, n and ℓ.
    """

    def __init__(
        self,
        x: Array,
        y: Array,
        *,
        log_hyperparameters: Array | None = None,
    ) -> None:
        """Fit the process to samples.

        Args:
            x: inputs, scaled to magnitudes of about 1, shape (samples, d).
            y: values, scaled to magnitudes of about 1, shape (samples,).
            log_hyperparameters: natural logarithms of the hyperparameters, or None to
                use the most probable values.
        """
        self._x = x
        self._y = y
        if log_hyperparameters is None:
            centre = np.log([*_TYPICAL, *np.full(x.shape[1], _TYPICAL_LENGTH)])
            result = scipy.optimize.minimize(
                self._negative_log_posterior,
                centre,
                args=(centre,),
                method="L-BFGS-B",
                bounds=[(c - 5, c + 5) for c in centre],
                options={"maxiter": 60},
            )
            log_hyperparameters = np.asarray(result.x)
        self.log_hyperparameters = log_hyperparameters
        self._factor = scipy.linalg.cho_factor(
            self._covariance(log_hyperparameters), lower=True
        )
        self._weights = scipy.linalg.cho_solve(self._factor, y)

    def at(self, x: Array) -> Array:
        """Return the posterior mean at inputs x."""
        return np.asarray(_kernel(self.log_hyperparameters, x, self._x) @ self._weights)

    def covariance(self, x: Array) -> Array:
        """Return the posterior covariance of the noise-free function at inputs x."""
        cross = _kernel(self.log_hyperparameters, x, self._x)
        prior = _kernel(self.log_hyperparameters, x, x)
        return np.asarray(prior - cross @ scipy.linalg.cho_solve(self._factor, cross.T))

    @property
    def leave_one_out_residuals(self) -> Array:
        """Difference between each sample and its prediction from all other samples."""
        inverse = scipy.linalg.cho_solve(self._factor, np.eye(len(self._y)))
        return np.asarray(self._weights / np.diag(inverse))

    def _covariance(self, log_hyperparameters: Array) -> Array:
        kernel = _kernel(log_hyperparameters, self._x, self._x)
        return np.asarray(
            kernel + (np.exp(2 * log_hyperparameters[2]) + 1e-9) * np.eye(len(self._y))
        )

    def _negative_log_posterior(
        self, log_hyperparameters: Array, centre: Array
    ) -> float:
        try:
            factor = scipy.linalg.cholesky(
                self._covariance(log_hyperparameters), lower=True
            )
        except scipy.linalg.LinAlgError:
            return 1e12
        # If L is the Cholesky factor of the covariance, L⁻¹ y is white noise with unit
        # variance.
        white = scipy.linalg.solve_triangular(factor, self._y, lower=True)
        prior = float(((log_hyperparameters - centre) ** 2).sum())
        return float(white @ white / 2 + np.log(np.diag(factor)).sum() + prior / 2)


def _kernel(log_hyperparameters: Array, x: Array, y: Array) -> Array:
    # In `GaussianProcess`, these variables are called s², b² and ℓ.
    size = np.exp(2 * log_hyperparameters[0])
    slope = np.exp(2 * log_hyperparameters[1])
    lengths = np.exp(log_hyperparameters[3:])
    distance = (((x[:, None] - y[None]) / lengths) ** 2).sum(axis=-1)
    return np.asarray(size * np.exp(-distance / 2) + slope * (1 + x @ y.T))


def predict_high_fidelity(
    fractions: Array, low: Array, high: Array, log_hyperparameters: Array | None = None
) -> tuple[Array, Array]:
    """Predict a high-fidelity result at all samples from a low-fidelity result.

    Random leave-one-out residuals are added to the predictions, so that quantiles of
    the predictions include the surrogate error. If the surrogate explains less than
    half of the variance of left-out samples, the predictions are NaN.

    Args:
        fractions: inputs u of all samples, shape (samples, d).
        low: low-fidelity result, shape (samples,).
        high: high-fidelity result at the first n samples, shape (n,).
        log_hyperparameters: natural logarithms of the Gaussian process hyperparameters,
            or None to use the most probable values.

    Returns:
        High-fidelity result at all samples, and logarithms of the hyperparameters.
    """
    count = len(high)
    scale = max(float(high.std()), 1e-300)
    mean = float(high.mean())
    low_scale = max(float(low.std()), 1e-300)
    low_mean = float(low.mean())
    x = np.column_stack([2 * fractions - 1, (low - low_mean) / low_scale])
    y = (high - mean) / scale
    process = GaussianProcess(x[:count], y, log_hyperparameters=log_hyperparameters)
    prediction = mean + scale * process.at(x)
    residuals = process.leave_one_out_residuals
    prediction += scale * np.random.default_rng(0).choice(residuals, len(prediction))
    if (residuals**2).mean() > _MAX_UNEXPLAINED:
        prediction[:] = np.nan
    prediction[:count] = high
    return prediction, process.log_hyperparameters
