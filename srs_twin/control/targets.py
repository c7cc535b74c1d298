r"""How far each side of a snake under iterative learning is to bend for a steering offset (Section 5.1).

The side towards which it turns keeps the amplitude A (0.7 rad in the text), the other one gets less, linear
in the offset φ, down to A · 4/7 (0.4 rad) at |φ| = 0.3:

$$ A_{\text{larger}} = A, \qquad
A_{\text{smaller}} = A \Bigl(1 - \tfrac{3}{7} \tfrac{|\varphi|}{0.3}\Bigr). $$
"""

from __future__ import annotations

import numpy as np

from srs_twin.errors import InputError

LARGEST_OFFSET = 0.3
SMALLEST_SHARE = 4 / 7
"""0.4 of 0.7 rad."""


def checked_offset(offset: float) -> float:
    """Return an offset that has targets.

    Raises:
        InputError: it is beyond ±0.3.
    """
    if not abs(offset) <= LARGEST_OFFSET:
        raise InputError(
            f"ilc offset {offset!r} is not allowed; it must lie between -{LARGEST_OFFSET:g} and "
            f"{LARGEST_OFFSET:g}, for which Section 5.1 gives targets"
        )
    return float(offset)


def targets(amplitude: float, offset: float) -> np.ndarray:
    """Return how far to bend to the left and to the right, shape (2,), rad.

    Args:
        amplitude: A, rad.
        offset: φ, positive to the left.
    """
    smaller = amplitude * (1 - (1 - SMALLEST_SHARE) * abs(offset) / LARGEST_OFFSET)
    return np.array([amplitude, smaller] if offset >= 0 else [smaller, amplitude])
