r"""What the cross-section of the pressure chambers does to the strip between them.

A rectangular chamber rounds as soon as it is filled and presses on the strip beside it (Section 2.2.2,
Fig. 14a, c). The filled chamber is on the outside of the bend, so it bows the strip against the bend; once
round, it presses no further. The strip then feels

$$ q_s = q - b\,q_c \tanh(q / q_c) $$

in place of the bend q: a slope of 1 − b at q = 0, less than 0 for b > 1, and 1 again beyond a few q_c. The
text says that such readings are not monotonic at small angles; its numbers are in a figure that is lost, so
b and q_c are estimates. The press is taken to follow the bend at rest, not the momentary pressure.
"""

from __future__ import annotations

import numpy as np

PRESSED = {"semicircular": 0.0, "rectangular": 2.0}
"""b, by cross-section. Estimate: 2 turns the reading round, as fast backwards at q = 0 as it should rise."""

ROUND_AT = 0.15
"""q_c, the bend at which a rectangular chamber has become about round, rad (estimate, 8.6°)."""


def felt_bend(bend: np.ndarray, chamber: str) -> np.ndarray:
    """Return the bend that the strip feels, q_s, rad.

    Args:
        bend: q, rad, any shape; what is not finite stays so.
        chamber: a name in `PRESSED`.
    """
    press = PRESSED[chamber]
    if press == 0.0:
        return bend
    felt: np.ndarray = bend - press * ROUND_AT * np.tanh(bend / ROUND_AT)
    return felt
