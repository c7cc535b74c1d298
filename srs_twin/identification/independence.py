r"""How many independent samples a series of residuals is worth.

Residuals of neighbouring samples resemble each other: of noise that cameras and filters smooth, and of what
the model lacks. With ρ_k their autocorrelation, n samples tell a mean as well as n/τ independent ones,

$$ \tau = 1 + 2 \sum_{k \ge 1} \rho_k , $$

the sum taken while pairs ρ_{2m} + ρ_{2m+1} are positive (Geyer 1992, Statistical Science 7: initial positive
sequence). All series are pooled, each weighted by its power. Series that are too short to tell, such as pulls
or averages of runs, count as independent.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

LEAST_SAMPLES = 20
"""Shorter series say nothing about their autocorrelation."""


def correlation_time(series: Sequence[np.ndarray]) -> float:
    """Return τ, 1 or more.

    Args:
        series: residuals over time, each of shape (samples,), in comparable units.
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
    return max(1.0, float(2 * kept.sum() - 1))


def _autocovariance(values: np.ndarray) -> np.ndarray:
    """Return Σ_t r_t r_{t+k} for k = 0…n−1."""
    size = 1 << (2 * len(values) - 1).bit_length()
    spectrum = np.fft.rfft(values, size)
    return np.asarray(np.fft.irfft(np.abs(spectrum) ** 2, size)[: len(values)])
