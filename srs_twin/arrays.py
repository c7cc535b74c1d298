"""Arrays of a simulation: whether their numbers are finite and possible, and records of them joined.

Whether numbers can be true of a snake: finite, and far below what any snake reaches.

Records: dataclasses whose fields are arrays with the samples first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, TypeVar

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


Record = TypeVar("Record")


def joined(parts: Sequence[Record]) -> Record:
    """Return several records of one kind, one after the other, as one.

    Args:
        parts: one or more; like fields have like shapes but for the samples. One alone is returned itself.
    """
    if len(parts) == 1:
        return parts[0]
    kind: Any = type(parts[0])
    return kind(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(kind)))
