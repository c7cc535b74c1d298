"""Whether numbers can be true of a snake: finite, and far below what any snake reaches."""

from __future__ import annotations

from typing import Any

import numpy as np

LARGEST = 1e9
"""Nothing of a snake comes near it in SI units: pressures reach 1e7 Pa, places 1e6 m."""


def plausible(*quantities: Any) -> bool:
    """Say whether all numbers of some arrays are finite and smaller than `LARGEST`."""
    # The sum of squares tells almost always: half a microsecond an array, and no warning.
    if sum(np.vdot(each, each) for each in quantities) < LARGEST**2:
        return True
    return all(implausible(each) is None for each in quantities)


def implausible(values: Any) -> float | None:
    """Return the first number that is not `plausible`, or None where all are."""
    flat = np.ravel(values)
    wrong = flat[~(np.abs(flat) < LARGEST)]
    return float(wrong[0]) if len(wrong) else None
