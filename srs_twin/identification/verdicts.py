r"""What data can tell: from the Jacobian's singular values, never by hand.

Let J be the derivatives of the weighted residuals by the coordinates z of `unknowns`, s_k its singular
values with directions v_k, and E the difference between two Jacobians from steps h and 2h, which shows how
far J itself is to be trusted. A direction is *blind* where moving along it does nothing that could be told
from the error of the derivatives,

$$ s_k \le 2\,\lVert E v_k \rVert \quad\text{or}\quad s_k \le 10^{-6} s_1 . $$

The others have the standard error σ/s_k. A parameter with a share of more than a tenth in the blind
directions is not identifiable. So is one whose standard error is 1 or more in z, a factor e either way,
for then the data hardly say more than its bounds do. Up to 0.1 it is identified, between them weakly. A
smaller share in a blind direction adds the spread that the bounds leave to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

IDENTIFIED = 0.1
"""Largest standard error in z of what is identified."""

KNOWN = 1.0
"""Standard error in z from which on nothing is known."""

BLIND_SHARE = 0.1
"""Share in blind directions from which on a parameter is not identifiable."""

_TRUSTED = 2.0
_LEAST = 1e-6


@dataclass(frozen=True)
class Knowledge:
    """What a Jacobian says, all in coordinates z.

    Attributes:
        covariance: shape (n, n).
        share: of each parameter in the blind directions, shape (n,).
        blind: these directions, shape (blind, n).
    """

    covariance: np.ndarray
    share: np.ndarray
    blind: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """Standard errors, shape (n,)."""
        return np.sqrt(np.diag(self.covariance))

    def hidden(self, i: int) -> bool:
        """Say whether parameter i is not identifiable."""
        return bool(self.share[i] > BLIND_SHARE or self.errors[i] >= KNOWN)


def knowledge(jacobian: np.ndarray, error: np.ndarray, noise: float, widths: np.ndarray) -> Knowledge:
    """Return what a Jacobian says.

    Args:
        jacobian: J, shape (samples, n).
        error: E, same shape.
        noise: σ of a weighted residual, grown by the root of the correlation time.
        widths: between the bounds of each parameter, in z, shape (n,).
    """
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    doubt = np.linalg.norm(error @ directions.T, axis=0)
    is_blind = (singular <= _TRUSTED * doubt) | (singular <= _LEAST * singular[0])
    seen, blind = directions[~is_blind], directions[is_blind]
    covariance = (seen.T * (noise / singular[~is_blind]) ** 2) @ seen
    # Uniform between the bounds: the variance of what nobody knows.
    reach = (np.abs(blind) @ widths) / np.sqrt(12)
    covariance += (blind.T * reach**2) @ blind
    return Knowledge(covariance, np.linalg.norm(blind, axis=0), blind)
