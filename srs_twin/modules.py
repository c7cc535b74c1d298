"""Modules: by how much each module of a snake departs from the nominal one (Section 5.1).

No two are cast alike: air pressure bends one chamber further than another, a body at rest is not quite
straight, air flows faster here than there, a sensor has drifted since its calibration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from srs_twin.errors import InputError

PerChamber = tuple[tuple[float, float], ...]

# Attribute → shape beyond the segments, least and largest allowed number.
_BOUNDS = {
    "gain": ((2,), 0.01, 100.0), "tau_fill": ((2,), 0.01, 100.0), "tau_vent": ((2,), 0.01, 100.0),
    "bias": ((), -math.pi, math.pi), "sensor_gain": ((), 0.01, 100.0),
    "sensor_bias": ((), -math.pi, math.pi),
}  # fmt: skip


@dataclass(frozen=True)
class Modules:
    """What is each module's own, segments head first, + chamber before −.

    Attributes:
        gain: bend over pressure of each chamber as a multiple of the actuator's, shape (segments, 2).
        bias: bend of each free segment without pressure, shape (segments,), rad.
        tau_fill: τ₁ of filling as a multiple of the actuator's, shape (segments, 2).
        tau_vent: τ₁ of venting as a multiple of the actuator's, shape (segments, 2).
        sensor_gain: sensed over actual bend, shape (segments,).
        sensor_bias: what a straight segment's sensor says, shape (segments,), rad.
    """

    gain: PerChamber
    bias: tuple[float, ...]
    tau_fill: PerChamber
    tau_vent: PerChamber
    sensor_gain: tuple[float, ...]
    sensor_bias: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, (shape, low, high) in _BOUNDS.items():
            values = np.asarray(getattr(self, name), dtype=float)
            if values.shape != (len(self.gain), *shape):
                raise InputError(
                    f"modules.{name} has shape {values.shape}; allowed: {(len(self.gain), *shape)}"
                )
            if not ((values >= low) & (values <= high)).all():
                wrong = values[~((values >= low) & (values <= high))][0]
                raise InputError(f"modules.{name} {wrong:g} is not allowed; it must be {low:g} to {high:g}")

    @classmethod
    def alike(cls, segments: int) -> Modules:
        """Return modules that are all nominal."""
        both, ones, none = ((1.0, 1.0),) * segments, (1.0,) * segments, (0.0,) * segments
        return cls(both, none, both, both, ones, none)

    @classmethod
    def of(cls, **arrays: np.ndarray) -> Modules:
        """Return modules from arrays of the attributes' shapes."""
        tuples: dict[str, Any] = {each.name: _tuples(arrays[each.name]) for each in fields(cls)}
        return cls(**tuples)

    def array(self, name: str) -> np.ndarray:
        """Return an attribute as an array."""
        return np.array(getattr(self, name), dtype=float)


def _tuples(values: np.ndarray) -> tuple[Any, ...]:
    return tuple(_tuples(row) if np.ndim(row) else float(row) for row in values)
