"""Estimated values with standard deviations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Estimates(NamedTuple):
    """Estimates of several values.

    Attributes:
        value: estimated values.
        sd: standard deviation of each value, with the shape and unit of `value`.
    """

    value: np.ndarray
    sd: np.ndarray
