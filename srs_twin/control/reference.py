"""Reference bends for controllers, as functions of time."""

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
"""Policies for references that exceed the bend range of a segment."""

_ROUNDING = 1e-9
"""Tolerance for comparing times (s) and phases (fractions of a period)."""


@dataclass(frozen=True)
class Reference(ABC):
    """Base class of reference bends that are functions of time.

    The methods accept a time or an array of times, and return an array of equal shape.
    """

    @property
    @abstractmethod
    def peak(self) -> float:
        """Maximum magnitude of the reference bend, rad."""

    @abstractmethod
    def value(self, time: ArrayLike) -> Array:
        """Return the reference bend (rad) at a time (s)."""

    def rate(self, time: ArrayLike) -> Array:
        """Return the rate of change of the reference bend (rad/s) at a time (s).

        The rate is 0 where the reference bend jumps.
        """
        return np.zeros_like(np.asarray(time, dtype=float))[()]

    def is_clipped(self, time: ArrayLike) -> np.ndarray:
        """Return whether the reference bend is clipped at a time (s)."""
        return np.zeros(np.shape(time), dtype=bool)[()]

    def limited(self, limit: float, policy: Policy = "refuse") -> Reference:
        """Return a reference that stays within the bend range of a segment.

        Args:
            limit: maximum bend of the segment at the supply pressure, rad.
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
    """Reference with a constant bend (rad)."""

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
    """Reference that consists of a sequence of constant bends.

    The last bend is held indefinitely.

    Attributes:
        bends: sequence of one or more bends, rad.
        hold: time for which each bend is held, s.
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
    """Reference that steps from one bend to another.

    Attributes:
        bend: bend after the step, rad.
        before: bend before the step, rad.
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
        return abs(self.offset) + self.amplitude

    def _angle(self, time: ArrayLike) -> Array:
        return 2 * math.pi * self.frequency * np.asarray(time, dtype=float) + self.phase


@dataclass(frozen=True)
class Sine(_Periodic):
    """Sine wave given by offset + amplitude · sin(2π · frequency · t + phase).

    Attributes:
        amplitude: amplitude of the wave, above 0, rad.
        frequency: frequency of the wave, above 0, Hz.
        phase: phase of the wave at time 0, rad.
        offset: mean bend, rad.
    """

    def value(self, time: ArrayLike) -> Array:
        """See `Reference.value`."""
        return self.offset + self.amplitude * np.sin(self._angle(time))

    def rate(self, time: ArrayLike) -> Array:
        """See `Reference.rate`."""
        return 2 * math.pi * self.frequency * self.amplitude * np.cos(self._angle(time))


@dataclass(frozen=True)
class Square(_Periodic):
    """Square wave that alternates between offset + amplitude and offset − amplitude.

    The attributes are those of `Sine`. With a phase of 0, the first value is offset +
    amplitude.
    """

    def value(self, time: ArrayLike) -> Array:
        """See `Reference.value`."""
        fraction = (self._angle(time) / (2 * math.pi) + _ROUNDING) % 1.0
        return (
            self.offset + np.where(fraction < 0.5, self.amplitude, -self.amplitude)[()]
        )


@dataclass(frozen=True)
class ClippedReference(Reference):
    """Reference that is clipped to the bend range of a segment.

    Attributes:
        unclipped: reference before clipping.
        limit: maximum bend to the left and to the right, rad.
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
