"""Uncertain and UncertainArray: estimates with their standard deviations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Uncertain(NamedTuple):
    """Estimates of several values.

    Attributes:
        value: estimates.
        sd: standard deviations, same shape and unit.
    """

    value: np.ndarray
    sd: np.ndarray
