r"""ModuleFilter: what each module is like, from the bends that the ensemble cannot explain.

An ensemble of some tens of members finds correlations where none are; numbers that never change are lost in
them. So these have a Kalman filter of their own for each segment. The unexplained bend d_j of the ensemble,
whose members use θ̄ for the module's θ = (g⁺, g⁻, b, ln τ_fill, ln τ_vent), tells of θ by its slopes,

$$ d_j = h^T(θ - θ̄) + v, \qquad
   h = (G p^+,\ -G p^-,\ 1,\ G(g^+ s_f^+ - g^- s_f^-),\ G(g^+ s_v^+ - g^- s_v^-)), $$

where s are the slopes of the pressures by the logarithms of the time constants, and v what no module
explains: it fades, as d does. A pressure that was measured tells of the time constants alone, by the same s.
What the bending stiffness causes looks like other modules, so that is not learnt.
"""

from __future__ import annotations

import numpy as np

from srs_twin.io.saved_state import Stateful

GAIN, BIAS, FILL, VENT, _REST = slice(0, 2), 2, 3, 4, 5
_WIDTH = 6
_LEAST = 0.01  # rad: no unexplained bend is known better


class ModuleFilter(Stateful):
    """Means and covariances of all modules.

    Attributes:
        mean: of θ and v, shape (segments, 6).
        covariance: shape (segments, 6, 6).
    """

    state_attributes = ("mean", "covariance")

    def __init__(self, segments: int, sd: np.ndarray, walk: np.ndarray, fades_s: float) -> None:
        """Begin with what is known before.

        Args:
            segments: how many.
            sd: of θ and v, shape (6,).
            walk: by what θ wanders in a second, shape (5,).
            fades_s: time constant of v, s.
        """
        self._rest, self._walk, self._fades_s = sd[_REST] ** 2, np.append(walk**2, 0.0), fades_s
        self.mean = np.zeros((segments, _WIDTH))
        self.mean[:, GAIN] = 1.0
        self.covariance = np.tile(np.diag(sd**2), (segments, 1, 1))
        self._slopes = np.zeros((segments, 2, 2))

    def advance(self, span: float) -> None:
        """Let a stretch (s) pass."""
        fades = np.ones(_WIDTH)
        fades[_REST] = np.exp(-span / self._fades_s)
        self.mean = self.mean * fades
        self.covariance = self.covariance * np.outer(fades, fades)
        self.covariance[:, range(_WIDTH), range(_WIDTH)] += self._walk * span
        self.covariance[:, _REST, _REST] += self._rest * (1 - fades[_REST] ** 2)

    def fill(
        self, opens: np.ndarray, pressure: np.ndarray, supply: np.ndarray, rates: np.ndarray, h: float
    ) -> None:
        """Advance the slopes of the pressures.

        Args:
            opens: share of the time for which each valve fills, shape (segments, 2).
            pressure: at the end, shape (segments, 2), Pa.
            supply: of each segment, Pa.
            rates: 1/τ_fill, 1/τ_vent and λ of each chamber, shape (3, segments, 2), 1/s.
            h: s.
        """
        fill, vent, leak = rates
        rate = opens * fill + (1 - opens) * vent + leak
        gone = np.exp(-rate * h)
        push = np.stack(
            [-opens * fill * (supply[:, None] - pressure), (1 - opens) * vent * pressure], axis=-1
        )
        self._slopes = self._slopes * gone[..., None] + push * ((1 - gone) / rate)[..., None]

    def read_pressures(self, off: np.ndarray, noise: np.ndarray, corrected: np.ndarray) -> None:
        """Take by what pressures were off, shape (segments, 2), Pa, NaN where none was measured.

        Args:
            off: measured less expected.
            noise: of that, RMS, same shape.
            corrected: share by which the ensemble's pressures then were, shape (segments, 2).
        """
        for side in (0, 1):
            rows = np.zeros((len(off), _WIDTH))
            rows[:, FILL : VENT + 1] = self._slopes[:, side]
            self._take(rows, off[:, side] + (rows * self.mean).sum(axis=1), noise[:, side] ** 2)
        self._slopes = self._slopes * (1 - np.where(np.isnan(off), 0.0, corrected))[..., None]

    def read_unexplained(
        self,
        unexplained: np.ndarray,
        variance: np.ndarray,
        used: np.ndarray,
        drives: np.ndarray,
        gain: np.ndarray,
    ) -> None:
        """Take the bends that the ensemble could not explain.

        Args:
            unexplained: mean of d, shape (segments,), rad; NaN where nothing was measured.
            variance: of it, same shape.
            used: θ̄, shape (segments, 5).
            drives: G p⁺ and −G p⁻, shape (segments, 2), rad.
            gain: bend over pressure of each chamber, signed, shape (segments, 2), rad/Pa.
        """
        rows = np.zeros((len(unexplained), _WIDTH))
        rows[:, GAIN], rows[:, BIAS], rows[:, _REST] = drives, 1.0, 1.0
        rows[:, FILL : VENT + 1] = (gain[..., None] * self._slopes).sum(axis=1)
        told = unexplained + (rows[:, :_REST] * used).sum(axis=1)
        self._take(rows, told, np.maximum(variance, _LEAST**2))

    def _take(self, rows: np.ndarray, told: np.ndarray, variance: np.ndarray) -> None:
        """Correct by one number a segment, NaN where there is none."""
        seen = np.einsum("skl,sl->sk", self.covariance, rows)
        total = (rows * seen).sum(axis=1) + variance
        off = told - (rows * self.mean).sum(axis=1)
        there = ~np.isnan(told)
        weight = np.where(there[:, None], seen / total[:, None], 0.0)
        self.mean = self.mean + weight * np.where(there, off, 0.0)[:, None]
        self.covariance = self.covariance - weight[:, :, None] * seen[:, None, :]
