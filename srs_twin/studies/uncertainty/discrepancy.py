r"""Model discrepancy: what a model misses at measured settings, a Gaussian process (Kennedy, O'Hagan 2001).

$$ y_i = m(x_i, \theta) + \delta(x_i) + \varepsilon_i, \qquad
\delta \sim \mathcal{GP}\bigl(0,\ s^2 e^{-|x - x'|^2 / 2\ell^2}\bigr), \qquad
\varepsilon \sim \mathcal N(0, \sigma^2), $$

with θ on a grid, and s and ℓ on grids of log-normal priors that the user states. Parameters and discrepancy
cannot be told apart by such data alone: whatever δ may be, θ need not (Brynjarsdóttir and O'Hagan 2014,
Inverse Problems 30). What s and ℓ are taken to be decides how much of a misfit θ has to explain; with s near
0 this is an ordinary fit, whose intervals are too narrow where the model is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.linalg

_FACTORS = np.array([1 / 3, 1 / np.sqrt(3), 1.0, np.sqrt(3), 3.0])
_WEIGHTS = np.exp(-(np.log(_FACTORS) ** 2) / (2 * np.log(2.0) ** 2))
_DRAWS = 4000


@dataclass(frozen=True)
class Discrepancy:
    """A model's parameters and what it misses, given measurements.

    Attributes:
        settings: x of the measurements, scaled so that ℓ is one number, shape (n, d).
        measured: y, shape (n,).
        predicted: m at each θ of the grid, shape (grid, n).
        noise: σ, in the unit of y.
        size: median of s, in the unit of y; a factor 2 either way has two thirds of its prior.
        length: median of ℓ, in the unit of x, known as well.
        prior: of each θ of the grid, shape (grid,); None: all alike.
    """

    settings: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    noise: float
    size: float
    length: float
    prior: np.ndarray | None = None

    def _cases(self) -> list[tuple[float, float, np.ndarray, np.ndarray]]:
        """Return s, ℓ, the posterior weights of the grid and the inverse covariance, for each s and ℓ."""
        cases, logs = [], []
        start = (
            np.zeros(len(self.predicted)) if self.prior is None else np.log(np.maximum(self.prior, 1e-300))
        )
        for (a, wa), (b, wb) in product(zip(_FACTORS, _WEIGHTS, strict=True), repeat=2):
            size, length = self.size * a, self.length * b
            covariance = _kernel(self.settings, self.settings, size, length)
            covariance += (self.noise**2 + 1e-12 * self.size**2) * np.eye(len(self.measured))
            off, inverse = self.measured - self.predicted, np.linalg.inv(covariance)
            surprise = np.einsum("ti,ij,tj->t", off, inverse, off) / 2 + np.linalg.slogdet(covariance)[1] / 2
            logs.append(start - surprise + np.log(wa * wb))
            cases.append((size, length, inverse))
        most = max(each.max() for each in logs)
        weights = [np.exp(each - most) for each in logs]
        total = sum(float(each.sum()) for each in weights)
        return [(*case[:2], each / total, case[2]) for case, each in zip(cases, weights, strict=True)]

    @property
    def weights(self) -> np.ndarray:
        """Posterior probability of each θ of the grid, shape (grid,)."""
        return np.asarray(sum(weights for _, _, weights, _ in self._cases()))

    def draw(self, settings: np.ndarray, predicted: np.ndarray, seed: int = 0) -> np.ndarray:
        """Return draws of what would be measured at other settings, without noise.

        Args:
            settings: shape (m, d).
            predicted: the model there, at each θ of the grid, shape (grid, m).
            seed: of the draws.

        Returns:
            Shape (draws, m).
        """
        rng, drawn = np.random.default_rng(seed), []
        for size, length, weights, inverse in self._cases():
            count = rng.poisson(_DRAWS * weights.sum())
            if not count:
                continue
            across = _kernel(settings, self.settings, size, length)
            rest = _kernel(settings, settings, size, length) - across @ inverse @ across.T
            root = scipy.linalg.cholesky(rest + 1e-9 * size**2 * np.eye(len(rest)), lower=True)
            which = rng.choice(len(weights), count, p=weights / weights.sum())
            off = self.measured - self.predicted[which]
            drawn.append(
                predicted[which] + off @ inverse @ across.T + rng.normal(size=(count, len(rest))) @ root.T
            )
        return np.concatenate(drawn)


def _kernel(x: np.ndarray, y: np.ndarray, size: float, length: float) -> np.ndarray:
    far = ((x[:, None] - y[None]) ** 2).sum(axis=-1)
    return np.asarray(size**2 * np.exp(-far / (2 * length**2)))
