r"""Models of results: polynomial chaos, which gives sensitivities, and a Gaussian process.

**Polynomial chaos** (Sudret 2008, Reliability Engineering & System Safety 93). With Legendre polynomials ψ
that are orthonormal over independent shares u ∈ (0, 1),

$$ y(u) \approx \sum_\alpha c_\alpha \prod_i \psi_{\alpha_i}(u_i), \qquad
S_i = \frac{\sum_{\alpha \in A_i} c_\alpha^2}{\sum_{\alpha \ne 0} c_\alpha^2}, \qquad
T_i = \frac{\sum_{\alpha_i > 0} c_\alpha^2}{\sum_{\alpha \ne 0} c_\alpha^2}, $$

with A_i the terms in u_i alone: Sobol's first-order and total indices. The degree is the one that predicts
left-out samples best. What it does not explain of them is part of the indices' error, and so is what
repeated drawing of the samples changes.

**Gaussian process** (Kennedy and O'Hagan 2000, Biometrika 87: one fidelity predicts the other). The costly
result is linear in the cheap one and in the inputs, plus a smooth rest. All variances and lengths have
log-normal priors and take their most probable values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product

import numpy as np
import scipy.linalg
import scipy.optimize
from scipy.special import eval_legendre

_MOST_DEGREE = 10
_PER_TERM = 5  # samples a coefficient
_TOGETHER = 2  # variables in a term of more than the third degree
_AGAIN = 20  # drawings with replacement
_UNEXPLAINED = 0.5  # of a variance


def _terms(variables: int, degree: int) -> np.ndarray:
    """Return the exponents of all terms up to a degree, shape (terms, variables)."""
    rows = [[0] * variables]
    for together in range(1, min(variables, degree, 3) + 1):
        for which in combinations(range(variables), together):
            for powers in product(range(1, degree + 1), repeat=together):
                if sum(powers) <= (degree if together <= _TOGETHER else min(degree, 3)):
                    row = [0] * variables
                    for i, power in zip(which, powers, strict=True):
                        row[i] = power
                    rows.append(row)
    return np.array(rows)


def quadratic_samples(variables: int) -> int:
    """Return the least number of samples for an expansion of the second degree."""
    return _PER_TERM * len(_terms(variables, 2))


@dataclass(frozen=True)
class Chaos:
    """A polynomial chaos expansion of some results.

    Attributes:
        terms: exponents, shape (terms, d).
        coefficients: shape (terms, results).
        unexplained: share of each result's variance that left-out samples show it not to predict.
        rest: what it misses of left-out samples, shape (samples, results).
        spread: standard deviation of first-order and total indices over repeated drawings,
            shape (2, d, results).
    """

    terms: np.ndarray
    coefficients: np.ndarray
    unexplained: np.ndarray
    rest: np.ndarray
    spread: np.ndarray

    @classmethod
    def fit(cls, shares: np.ndarray, results: np.ndarray, *, seed: int = 0) -> Chaos:
        """Fit results, shape (samples, results), to shares, shape (samples, d)."""
        count, variables = shares.shape
        variance = np.maximum(results.var(axis=0), 1e-300)
        best: tuple[float, np.ndarray, np.ndarray, np.ndarray] | None = None
        for degree in range(1, _MOST_DEGREE + 1):
            terms = _terms(variables, degree)
            if degree > 1 and len(terms) * _PER_TERM > count:
                break
            design = _design(shares, terms)
            coefficients, rest = _left_out(design, results)
            missed = (rest**2).mean(axis=0) / variance
            if best is None or missed.mean() < best[0]:
                best = float(missed.mean()), terms, coefficients, rest
        assert best is not None
        _, terms, coefficients, rest = best
        ridge = 1e-9 * count * np.eye(len(terms))
        rng, design, found = np.random.default_rng(seed), _design(shares, terms), []
        for _ in range(_AGAIN):
            rows = rng.integers(count, size=count)
            # Normal equations: the columns are all but orthonormal.
            again = design[rows]
            found.append(_indices(terms, np.linalg.solve(again.T @ again + ridge, again.T @ results[rows])))
        missed = np.minimum((rest**2).mean(axis=0) / variance, 1.0)
        return cls(terms, coefficients, missed, rest, np.std(found, axis=0))

    def at(self, shares: np.ndarray) -> np.ndarray:
        """Return the results at shares, shape (…, results)."""
        return np.asarray(_design(shares, self.terms) @ self.coefficients)

    @cached_property
    def indices(self) -> np.ndarray:
        """Sobol's first-order and total indices, shape (2, d, results)."""
        return _indices(self.terms, self.coefficients)

    @property
    def error(self) -> np.ndarray:
        """Half of the indices' 95 % interval: drawing, and what is not explained; same shape."""
        return np.asarray(2 * self.spread + self.unexplained)


def _design(shares: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Return each term at each sample."""
    orders = np.arange(terms.max(initial=0) + 1)
    each = eval_legendre(orders, 2 * shares[..., None] - 1) * np.sqrt(2 * orders + 1)
    design = np.ones((len(shares), len(terms)))
    for i in range(terms.shape[1]):
        design *= each[:, i, terms[:, i]]
    return design


def _left_out(design: np.ndarray, results: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return least-squares coefficients, and what each sample is off from a fit to the others."""
    basis, triangle = scipy.linalg.qr(design, mode="economic")
    coefficients = scipy.linalg.lstsq(triangle, basis.T @ results)[0]
    leverage = np.minimum((basis**2).sum(axis=1), 1 - 1e-9)
    return coefficients, (results - design @ coefficients) / (1 - leverage)[:, None]


def _indices(terms: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    power, alone = coefficients**2, (terms > 0).sum(axis=1) == 1
    total = np.maximum(power[1:].sum(axis=0), 1e-300)
    first = [power[alone & (terms[:, i] > 0)].sum(axis=0) for i in range(terms.shape[1])]
    every = [power[terms[:, i] > 0].sum(axis=0) for i in range(terms.shape[1])]
    return np.array([first, every]) / total


class GaussianProcess:
    r"""A smooth function of x with a linear part, from samples with noise.

    $$ k(x, x') = s^2 e^{-\frac12 \sum_i (x_i - x'_i)^2 / \ell_i^2} + b^2 (1 + h \cdot h') + n^2 \delta $$

    Attributes:
        chosen: natural logarithms of s, b, n and ℓ.
    """

    def __init__(
        self,
        x: np.ndarray,
        y: np.ndarray,
        *,
        linear: np.ndarray | None = None,
        typical: Sequence[float] = (0.1, 1.0, 0.01, 2.0),
        chosen: np.ndarray | None = None,
    ) -> None:
        """Fit a sample.

        Args:
            x: inputs, of about the size 1, shape (samples, d).
            y: of about the size 1, shape (samples,).
            linear: h, shape (samples, …); default x.
            typical: medians of the log-normal priors of s, b, n and all ℓ; a factor e each way.
            chosen: these, instead of the most probable ones.
        """
        self._x, self._y, self._h = x, y, x if linear is None else linear
        centre = np.log([*typical[:3], *np.full(x.shape[1], typical[3])])
        self.chosen = centre if chosen is None else chosen
        if chosen is None:
            found = scipy.optimize.minimize(
                self._surprise,
                centre,
                args=(centre,),
                method="L-BFGS-B",
                bounds=[(c - 5, c + 5) for c in centre],
                options={"maxiter": 60},
            )
            self.chosen = found.x
        self._factor = scipy.linalg.cho_factor(self._covariance(self.chosen), lower=True)
        self._weights = scipy.linalg.cho_solve(self._factor, y)

    def at(self, x: np.ndarray, linear: np.ndarray | None = None) -> np.ndarray:
        """Return the mean at inputs."""
        return np.asarray(self._kernel(x, x if linear is None else linear) @ self._weights)

    def covariance(self, x: np.ndarray, linear: np.ndarray | None = None) -> np.ndarray:
        """Return the covariance of the function at inputs, without noise."""
        h = x if linear is None else linear
        across = self._kernel(x, h)
        own = _kernel(self.chosen, x, h, x, h)
        return np.asarray(own - across @ scipy.linalg.cho_solve(self._factor, across.T))

    @property
    def left_out(self) -> np.ndarray:
        """What each sample is off from what the others predict, shape (samples,)."""
        inverse = scipy.linalg.cho_solve(self._factor, np.eye(len(self._y)))
        return np.asarray(self._weights / np.diag(inverse))

    def _kernel(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        return _kernel(self.chosen, x, h, self._x, self._h)

    def _covariance(self, chosen: np.ndarray) -> np.ndarray:
        kernel = _kernel(chosen, self._x, self._h, self._x, self._h)
        return np.asarray(kernel + (np.exp(2 * chosen[2]) + 1e-9) * np.eye(len(self._y)))

    def _surprise(self, chosen: np.ndarray, centre: np.ndarray) -> float:
        """Return minus the logarithm of the posterior density of the chosen."""
        try:
            factor = scipy.linalg.cholesky(self._covariance(chosen), lower=True)
        except scipy.linalg.LinAlgError:
            return 1e12
        white = scipy.linalg.solve_triangular(factor, self._y, lower=True)
        prior = float(((chosen - centre) ** 2).sum())
        return float(white @ white / 2 + np.log(np.diag(factor)).sum() + prior / 2)


def _kernel(chosen: np.ndarray, x: np.ndarray, h: np.ndarray, y: np.ndarray, g: np.ndarray) -> np.ndarray:
    size, slope, lengths = np.exp(2 * chosen[0]), np.exp(2 * chosen[1]), np.exp(chosen[3:])
    far = (((x[:, None] - y[None]) / lengths) ** 2).sum(axis=-1)
    return np.asarray(size * np.exp(-far / 2) + slope * (1 + h @ g.T))


def corrected(
    shares: np.ndarray, cheap: np.ndarray, costly: np.ndarray, chosen: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return a costly result at all samples, from a cheap one there and the costly one at the first of them.

    Args:
        shares: u of all samples, shape (samples, d).
        cheap: the cheap result, shape (samples,).
        costly: the costly one at the first samples, shape (fewer,).
        chosen: hyperparameters found before.

    Returns:
        The costly result at all samples, the given ones as given, and the hyperparameters. What the model
        misses of samples that it has not seen is added at random, so that quantiles do not lack it. Where
        it explains less than half of their variance nothing is predicted: NaN.
    """
    count = len(costly)
    scale, middle = max(float(costly.std()), 1e-300), float(costly.mean())
    by, at = max(float(cheap.std()), 1e-300), float(cheap.mean())
    x = np.column_stack([2 * shares - 1, (cheap - at) / by])
    y = (costly - middle) / scale
    process = GaussianProcess(x[:count], y, chosen=chosen)
    found = middle + scale * process.at(x)
    rest = process.left_out
    found += scale * np.random.default_rng(0).choice(rest, len(found))
    if (rest**2).mean() > _UNEXPLAINED:
        found[:] = np.nan
    found[:count] = costly
    return found, process.chosen
