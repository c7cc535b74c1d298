"""Reference signals for the bends that a controller tracks."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from srs_twin.compute.arrays import Array, check_positive
from srs_twin.errors import InputError, UnknownNameError

Policy = Literal["refuse", "saturate"]
POLICIES: tuple[Policy, ...] = ("refuse", "saturate")
"""Policies for a reference that exceeds the bend range of the module."""

_ROUNDING = 1e-9
"""Tolerance for comparing times (s) and phases (fraction of a period)."""


@dataclass(frozen=True)
class Reference(ABC):
    """Reference bend as a function of time, rad.

    The methods accept a time or an array of times, and return an array of the same
    shape.
    """

    @property
    @abstractmethod
    def peak(self) -> float:
        """Maximum magnitude of the reference, rad."""

    @abstractmethod
    def value(self, time: ArrayLike) -> Array:
        """Return the bend at a time (s), rad."""

    def rate(self, time: ArrayLike) -> Array:
        """Return the time derivative of the bend at a time (s), rad/s.

        The derivative is 0 at jumps.
        """
        return np.zeros_like(np.asarray(time, dtype=float))[()]

    def is_clipped(self, time: ArrayLike) -> np.ndarray:
        """Return whether the reference is clipped at a time (s)."""
        return np.zeros(np.shape(time), dtype=bool)[()]

    def limited(self, limit: float, policy: Policy = "refuse") -> Reference:
        """Return a reference that stays within the range of the module.

        Args:
            limit: maximum bend of the module at the supply pressure, rad.
            policy: "refuse" to raise an error if the reference exceeds the limit, or
                "saturate" to clip the reference.

        Raises:
            InputError: the reference exceeds the limit and the policy is "refuse", or
                the limit is not positive.
            UnknownNameError: the policy is unknown.
        """
        if policy not in POLICIES:
            raise UnknownNameError(
                "policy for a reference beyond the range", policy, POLICIES
            )
        check_positive("range limit", limit, "rad")
        if self.peak <= limit:
            return self
        if policy == "refuse":
            raise InputError(
                f"the reference reaches {math.degrees(self.peak):.4g}°, but the module"
                f" bends at most {math.degrees(limit):.4g}° at its supply pressure;"
                " reduce the reference, raise the pressure, or let the reference"
                " saturate"
            )
        return ClippedReference(self, limit)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, int | float) and not math.isfinite(value):
                raise InputError(
                    f"reference: {field.name} {value!r} is not allowed; it must be"
                    " finite"
                )


@dataclass(frozen=True)
class Constant(Reference):
    """Constant bend, rad."""

    bend: float

    @property
    def peak(self) -> float:
        """See `Reference.peak`."""
        return abs(self.bend)

    def value(self, time: ArrayLike) -> Array:
        """See `Reference.value`."""
        return np.full_like(np.asarray(time, dtype=float), self.bend)[()]


@dataclass(frozen=True)
class Staircase(Reference):
    """Sequence of bends that are held for equal durations.

    The last bend is held indefinitely.

    Attributes:
        bends: one or more bends, rad.
        hold: duration of each bend, s.
    """

    bends: tuple[float, ...]
    hold: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (len(self.bends) and np.isfinite(self.bends).all()):
            raise InputError(
                f"the bends {self.bends!r} of a staircase are not allowed; give one or"
                " more finite numbers"
            )
        check_positive("staircase hold", self.hold, "s")

    @property
    def peak(self) -> float:
        """See `Reference.peak`."""
        return max(map(abs, self.bends))

    def value(self, time: ArrayLike) -> Array:
        """See `Reference.value`."""
        number = np.floor(np.asarray(time) / self.hold + _ROUNDING).astype(int)
        bends: Array = np.asarray(self.bends)[np.clip(number, 0, len(self.bends) - 1)]
        return bends


@dataclass(frozen=True)
class StepReference(Reference):
    """Step from one bend to another.

    Attributes:
        bend: bend from `time` on, rad.
        before: bend before `time`, rad.
        time: time of the step, s.
    """

    bend: float
    before: float = 0.0
    time: float = 0.0

    @property
    def peak(self) -> float:
        """See `Reference.peak`."""
        return max(abs(self.before), abs(self.bend))

    def value(self, time: ArrayLike) -> Array:
        """See `Reference.value`."""
        return np.where(
            np.asarray(time) > self.time - _ROUNDING, self.bend, self.before
        )[()]


@dataclass(frozen=True)
class _Periodic(Reference):
    amplitude: float
    frequency: float
    phase: float = 0.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("amplitude", "frequency"):
            check_positive(f"reference: {name}", getattr(self, name))

    @property
    def peak(self) -> float:
        """See `Reference.peak`."""
        return abs(self.offset) + self.amplitude

    def _angle(self, time: ArrayLike) -> Array:
        return 2 * math.pi * self.frequency * np.asarray(time, dtype=float) + self.phase


@dataclass(frozen=True)
class Sine(_Periodic):
    """Sine wave, offset + amplitude · sin(2π · frequency · t + phase).

    Attributes:
        amplitude: amplitude, rad, above 0.
        frequency: frequency, Hz, above 0.
        phase: phase at time 0, rad.
        offset: mean value, rad.
    """

    def value(self, time: ArrayLike) -> Array:
        """See `Reference.value`."""
        return self.offset + self.amplitude * np.sin(self._angle(time))

    def rate(self, time: ArrayLike) -> Array:
        """See `Reference.rate`."""
        return 2 * math.pi * self.frequency * self.amplitude * np.cos(self._angle(time))


@dataclass(frozen=True)
class Square(_Periodic):
    """Square wave, offset ± amplitude, in phase with the corresponding `Sine`.

    The value is offset + amplitude in the first half of each period.

    Attributes:
        amplitude: amplitude, rad, above 0.
        frequency: frequency, Hz, above 0.
        phase: phase at time 0, rad.
        offset: mean value, rad.
    """

    def value(self, time: ArrayLike) -> Array:
        """See `Reference.value`."""
        fraction = (self._angle(time) / (2 * math.pi) + _ROUNDING) % 1.0
        return (
            self.offset + np.where(fraction < 0.5, self.amplitude, -self.amplitude)[()]
        )


@dataclass(frozen=True)
class ClippedReference(Reference):
    """Reference that is clipped to the range of the module. See `Reference.limited`.

    Attributes:
        unclipped: original reference.
        limit: maximum bend to either side, rad.
    """

    unclipped: Reference
    limit: float

    @property
    def peak(self) -> float:
        """See `Reference.peak`."""
        return min(self.unclipped.peak, self.limit)

    def value(self, time: ArrayLike) -> Array:
        """See `Reference.value`."""
        return np.clip(self.unclipped.value(time), -self.limit, self.limit)

    def rate(self, time: ArrayLike) -> Array:
        """See `Reference.rate`."""
        return np.where(self.is_clipped(time), 0.0, self.unclipped.rate(time))[()]

    def is_clipped(self, time: ArrayLike) -> np.ndarray:
        """See `Reference.is_clipped`."""
        return np.abs(self.unclipped.value(time)) > self.limit
