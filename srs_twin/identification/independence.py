r"""How many independent samples a series of residuals is worth.

Residuals of neighbouring samples resemble each other: of noise that cameras and filters smooth, and of what
the model lacks. With ρ_k their autocorrelation, n samples tell a mean as well as n/τ independent ones,

$$ \tau = 1 + 2 \sum_{k \ge 1} \rho_k , $$

the sum taken while pairs ρ_{2m} + ρ_{2m+1} are positive (Geyer 1992, Statistical Science 7: initial positive
sequence). A fit of p unknowns takes the slow part of the noise out of the residuals, about a share c = p
τ/n of their power at all short lags; it is put back, ρ_k → (ρ_k + c)/(1 + c), with τ as it comes out. All
series are pooled, each weighted by its power. Series that are too short to tell, such as pulls or averages
of runs, count as independent.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

LEAST_SAMPLES = 20
"""Shorter series say nothing about their autocorrelation."""


_ROUNDS = 5
_MOST_TAKEN = 0.5  # c beyond which a fit has taken so much that the rest says nothing of it


def correlation_time(series: Sequence[np.ndarray], unknowns: int = 0) -> float:
    """Return τ, 1 or more.

    Args:
        series: residuals over time, each of shape (samples,), in comparable units.
        unknowns: p, how many numbers were fitted.
    """
    long = [each for each in series if len(each) >= LEAST_SAMPLES]
    if not long or not any(each.any() for each in long):
        return 1.0
    most = max(len(each) for each in long)
    total = np.zeros(most)
    for each in long:
        total[: len(each)] += _autocovariance(each / max(abs(r).max() for r in long))
    rho = total / total[0]
    pairs = rho[: most // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    kept = pairs[: ends[0]] if ends.size else pairs
    lags = 2 * len(kept) - 1  # besides lag 0
    plain = max(1.0, float(2 * kept.sum() - 1))
    samples, time = sum(len(each) for each in long), plain
    for _ in range(_ROUNDS):
        taken = min(unknowns * time / samples, _MOST_TAKEN)
        time = max(1.0, 1.0 + 2 * (float(kept.sum()) - 1 + lags * taken) / (1 + taken))
    return time


def _autocovariance(values: np.ndarray) -> np.ndarray:
    """Return Σ_t r_t r_{t+k} for k = 0…n−1."""
    size = 1 << (2 * len(values) - 1).bit_length()
    spectrum = np.fft.rfft(values, size)
    return np.asarray(np.fft.irfft(np.abs(spectrum) ** 2, size)[: len(values)])
