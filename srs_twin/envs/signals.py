"""Signal: one number that an agent gives or gets, with its name, unit and bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError


@dataclass(frozen=True)
class Signal:
    """One number of an action or an observation.

    Attributes:
        name: ends with the unit, as keys of files do.
        unit: "1" for a pure number.
        low: smallest value.
        high: largest value.
        what: what it is.
    """

    name: str
    unit: str
    low: float
    high: float
    what: str


Signals = tuple[Signal, ...]


def low(signals: Signals) -> np.ndarray:
    """Return the smallest values, float32 of shape (signals,)."""
    return np.array([each.low for each in signals], dtype=np.float32)


def high(signals: Signals) -> np.ndarray:
    """Return the largest values, float32 of shape (signals,)."""
    return np.array([each.high for each in signals], dtype=np.float32)


def numbered(count: int, name: str, unit: str, low: float, high: float, what: str) -> list[Signal]:
    """Return a signal of each segment or obstacle; # in the name is its number, from 1."""
    return [Signal(name.replace("#", str(k)), unit, low, high, what) for k in range(1, count + 1)]


def taken(signals: Signals, action: object) -> list[float]:
    """Return an agent's action, brought to the bounds of its signals.

    Raises:
        InputError: another shape, or a number that is not finite.
    """
    values = np.asarray(action, dtype=float)
    if values.shape != (len(signals),) or not np.isfinite(values).all():
        names = ", ".join(each.name for each in signals)
        raise InputError(
            f"action {values.tolist()} is not allowed; give {len(signals)} finite numbers: {names}"
        )
    return [
        min(max(value, each.low), each.high) for value, each in zip(values.tolist(), signals, strict=True)
    ]
