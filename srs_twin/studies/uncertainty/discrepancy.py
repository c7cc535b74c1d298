r"""Model discrepancy at measured settings, as a Gaussian process (Kennedy and O'Hagan 2001).

$$ y_i = m(x_i, \theta) + \delta(x_i) + \varepsilon_i, \qquad
\delta \sim \mathcal{GP}\bigl(0,\ s^2 e^{-|x - x'|^2 / 2\ell^2}\bigr), \qquad
\varepsilon \sim \mathcal N(0, \sigma^2), $$

with θ on a grid, and s and ℓ on grids of log-normal priors that the user states. Such
data alone cannot separate parameters from discrepancy, as they determine only the sum m
+ δ (Brynjarsdóttir and O'Hagan 2014, Inverse Problems 30). The priors of s and ℓ
determine how much of a misfit θ has to explain. With s near 0 this is an ordinary fit,
whose intervals are too narrow if the model is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.linalg

_FACTORS = np.array([1 / 3, 1 / np.sqrt(3), 1.0, np.sqrt(3), 3.0])
"""Grid of s and ℓ relative to their medians."""

_WEIGHTS = np.exp(-(np.log(_FACTORS) ** 2) / (2 * np.log(2.0) ** 2))
"""Prior weights of the grid: log-normal with a factor 2 as one standard deviation."""

_DRAWS = 4000
"""Expected number of draws."""


@dataclass(frozen=True)
class Discrepancy:
    """Joint posterior of a model's parameters and its discrepancy.

    Attributes:
        settings: settings x of the measurements, scaled to a common length ℓ, shape (n,
            d).
        measured: measurements y, shape (n,).
        predicted: model m at each θ of the grid, shape (grid, n).
        noise: σ, in the unit of y.
        size: median of s, in the unit of y; one standard deviation is a factor 2.
        length: median of ℓ, in the unit of x; one standard deviation is a factor 2.
        prior: prior probability of each θ of the grid, shape (grid,); None: uniform.
    """

    settings: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    noise: float
    size: float
    length: float
    prior: np.ndarray | None = None

    def _cases(self) -> list[tuple[float, float, np.ndarray, np.ndarray]]:
        """Return s, ℓ, the posterior weights of the θ grid and the inverse covariance, for each s and ℓ."""
        cases = []
        log_posteriors = []
        if self.prior is None:
            log_prior = np.zeros(len(self.predicted))
        else:
            log_prior = np.log(np.maximum(self.prior, 1e-300))
        for (a, wa), (b, wb) in product(zip(_FACTORS, _WEIGHTS, strict=True), repeat=2):
            size = self.size * a
            length = self.length * b
            covariance = _kernel(self.settings, self.settings, size, length)
            covariance += (self.noise**2 + 1e-12 * self.size**2) * np.eye(
                len(self.measured)
            )
            residual = self.measured - self.predicted
            inverse = np.linalg.inv(covariance)
            misfit = np.einsum("ti,ij,tj->t", residual, inverse, residual) / 2
            negative_log_likelihood = misfit + np.linalg.slogdet(covariance)[1] / 2
            log_posteriors.append(log_prior - negative_log_likelihood + np.log(wa * wb))
            cases.append((size, length, inverse))
        largest = max(log_posterior.max() for log_posterior in log_posteriors)
        weights = [np.exp(log_posterior - largest) for log_posterior in log_posteriors]
        total = sum(float(weight.sum()) for weight in weights)
        return [
            (*case[:2], weight / total, case[2])
            for case, weight in zip(cases, weights, strict=True)
        ]

    @property
    def weights(self) -> np.ndarray:
        """Posterior probability of each θ of the grid, shape (grid,)."""
        return np.asarray(sum(weights for _, _, weights, _ in self._cases()))

    def draw(
        self, settings: np.ndarray, predicted: np.ndarray, seed: int = 0
    ) -> np.ndarray:
        """Return draws of noise-free measurements at other settings.

        Args:
            settings: other settings, shape (m, d).
            predicted: model there at each θ of the grid, shape (grid, m).
            seed: random seed.

        Returns:
            Draws, shape (draws, m).
        """
        rng = np.random.default_rng(seed)
        draws = []
        for size, length, weights, inverse in self._cases():
            count = rng.poisson(_DRAWS * weights.sum())
            if not count:
                continue
            cross = _kernel(settings, self.settings, size, length)
            covariance = (
                _kernel(settings, settings, size, length) - cross @ inverse @ cross.T
            )
            root = scipy.linalg.cholesky(
                covariance + 1e-9 * size**2 * np.eye(len(covariance)), lower=True
            )
            which = rng.choice(len(weights), count, p=weights / weights.sum())
            residual = self.measured - self.predicted[which]
            mean = predicted[which] + residual @ inverse @ cross.T
            draws.append(mean + rng.normal(size=(count, len(covariance))) @ root.T)
        return np.concatenate(draws)


def _kernel(x: np.ndarray, y: np.ndarray, size: float, length: float) -> np.ndarray:
    distance = ((x[:, None] - y[None]) ** 2).sum(axis=-1)
    return np.asarray(size**2 * np.exp(-distance / (2 * length**2)))
