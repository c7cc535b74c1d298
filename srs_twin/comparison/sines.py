r"""Sines in recorded signals: their frequency, and amplitude and phase by least squares.

$$ x(t) \approx \bar x + A \sin(2\pi f t + \varphi). $$
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# A sine leaves no more than this share of its amplitude, RMS, when it is fitted.
_PURE = 1e-4


@dataclass(frozen=True)
class SineFit:
    """A sine fitted to samples.

    Attributes:
        amplitude: A, unit of the signal, 0 or more.
        phase: φ at time 0, rad.
        offset: mean.
        residual: RMS of what is left.
    """

    amplitude: float
    phase: float
    offset: float
    residual: float


def fit_sine(time: np.ndarray, values: np.ndarray, frequency: float) -> SineFit:
    """Return the sine of a frequency (Hz) that leaves the least squares of samples, shape (samples,)."""
    angle = 2 * np.pi * frequency * time
    basis = np.stack([np.sin(angle), np.cos(angle), np.ones_like(angle)], axis=-1)
    (sine, cosine, offset), *_ = np.linalg.lstsq(basis, values, rcond=None)
    left = values - basis @ np.array([sine, cosine, offset])
    rms = float(np.sqrt(np.mean(left**2)))
    return SineFit(float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine)), float(offset), rms)


def frequency_of(time: np.ndarray, values: np.ndarray) -> float | None:
    """Return the frequency of a signal that is a sine without noise, Hz; None where it is something else.

    Samples m apart of a sine obey x(t + m) + x(t − m) = 2 cos(2π f m) x(t) + const. Neighbours give a
    first f; samples about a quarter period apart, where the cosine tells most, the final one.

    Args:
        time: equally spaced but for the last sample, shape (samples,), s.
        values: shape (samples,).
    """
    values, time = values[:-1], time[:-1]
    if len(values) < 8 or np.ptp(values) == 0:
        return None
    period = (time[-1] - time[0]) / (len(time) - 1)
    turn = _turn(values, 1)
    if turn is None:
        return None
    quarter = max(1, round(np.pi / 2 / turn))
    if quarter > 1 and 2 * quarter + 8 <= len(values):
        finer = _turn(values, quarter)
        turn = turn if finer is None else finer / quarter
    frequency = float(turn / (2 * np.pi * period))
    fit = fit_sine(time, values, frequency)
    return frequency if fit.residual <= _PURE * fit.amplitude else None


def _turn(values: np.ndarray, apart: int) -> float | None:
    """Return by what angle the sine turns from a sample to one so many later, between 0 and π."""
    middle = values[apart:-apart]
    both = values[2 * apart :] + values[: -2 * apart]
    middle, both = middle - middle.mean(), both - both.mean()
    cosine = (middle @ both) / (2 * (middle @ middle))
    return float(np.arccos(cosine)) if 0 < 1 - cosine < 2 else None
