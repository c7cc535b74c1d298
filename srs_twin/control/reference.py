"""References: the bend that a controller is asked to follow, over time."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.errors import InputError, UnknownNameError

Policy = Literal["refuse", "saturate"]
POLICIES: tuple[Policy, ...] = ("refuse", "saturate")
"""What to do with a reference beyond the module's range."""

_SAME = 1e-9
"""Times closer than this are one, in s or as a share of a period: ticks add up with rounding."""


@dataclass(frozen=True)
class Reference(ABC):
    """A bend over time, rad. Times may be a number or an array, and the answer has their shape."""

    @property
    def frequency_hz(self) -> float | None:
        """How often it repeats itself, Hz; None where it does not."""
        return None

    @property
    @abstractmethod
    def peak(self) -> float:
        """The largest bend to either side that it ever asks for, rad."""

    @abstractmethod
    def value(self, time: Any) -> Any:
        """Return the bend at a time (s), rad."""

    def rate(self, time: Any) -> Any:
        """Return its rate, rad/s; a jump has none."""
        return np.zeros_like(np.asarray(time, dtype=float))[()]

    def beyond(self, time: Any) -> Any:
        """Say whether more is asked for at a time than the module can do, so that `value` is cut."""
        return np.zeros(np.shape(time), dtype=bool)[()]

    def within(self, limit: float, policy: Policy = "refuse") -> Reference:
        """Return a reference that stays within the module's range.

        Args:
            limit: the largest bend of the module, rad: its gain times the supply pressure.
            policy: "refuse" one that goes beyond, or "saturate" it at the limit.

        Raises:
            InputError: it goes beyond and the policy is to refuse, the limit is not above 0, or there is no
                such policy.
        """
        if policy not in POLICIES:
            raise UnknownNameError("policy for a reference beyond the range", policy, POLICIES)
        check_positive("range limit", limit, "rad")
        if self.peak <= limit:
            return self
        if policy == "refuse":
            raise InputError(
                f"the reference asks for {math.degrees(self.peak):.4g}°, but the module bends at most "
                f"{math.degrees(limit):.4g}° at its supply pressure; ask for less, raise the pressure, or "
                "let the reference saturate"
            )
        return Saturated(self, limit)

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, int | float) and not math.isfinite(value):
                raise InputError(f"reference: {each.name} {value!r} is not allowed; it must be finite")


@dataclass(frozen=True)
class Constant(Reference):
    """One bend for ever.

    Attributes:
        level: rad.
    """

    level: float

    @property
    def peak(self) -> float:
        """See `Reference.peak`."""
        return abs(self.level)

    def value(self, time: Any) -> Any:
        """See `Reference.value`."""
        return np.full_like(np.asarray(time, dtype=float), self.level)[()]


@dataclass(frozen=True)
class Staircase(Reference):
    """One bend after another, each held for the same time; the last one stays.

    Attributes:
        levels: rad, one or more.
        hold: how long each is held, s.
    """

    levels: tuple[float, ...]
    hold: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (len(self.levels) and np.isfinite(self.levels).all()):
            raise InputError(
                f"staircase levels {self.levels!r} are not allowed; give one or more, all finite"
            )
        check_positive("staircase hold", self.hold, "s")

    @property
    def peak(self) -> float:
        """See `Reference.peak`."""
        return max(abs(level) for level in self.levels)

    def value(self, time: Any) -> Any:
        """See `Reference.value`."""
        number = np.floor(np.asarray(time) / self.hold + _SAME).astype(int)
        return np.asarray(self.levels)[np.clip(number, 0, len(self.levels) - 1)]


@dataclass(frozen=True)
class Step(Reference):
    """A jump from one bend to another.

    Attributes:
        after: rad, from `time` on.
        before: rad.
        time: s.
    """

    after: float
    before: float = 0.0
    time: float = 0.0

    @property
    def peak(self) -> float:
        """See `Reference.peak`."""
        return max(abs(self.before), abs(self.after))

    def value(self, time: Any) -> Any:
        """See `Reference.value`."""
        return np.where(np.asarray(time) > self.time - _SAME, self.after, self.before)[()]


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
    def frequency_hz(self) -> float:
        """See `Reference.frequency_hz`."""
        return self.frequency

    @property
    def peak(self) -> float:
        """See `Reference.peak`."""
        return abs(self.offset) + self.amplitude

    def _angle(self, time: Any) -> np.ndarray:
        return 2 * math.pi * self.frequency * np.asarray(time, dtype=float) + self.phase


@dataclass(frozen=True)
class Sine(_Periodic):
    """offset + amplitude · sin(2π · frequency · t + phase).

    Attributes:
        amplitude: rad, above 0.
        frequency: Hz, above 0.
        phase: rad.
        offset: rad.
    """

    def value(self, time: Any) -> Any:
        """See `Reference.value`."""
        return self.offset + self.amplitude * np.sin(self._angle(time))

    def rate(self, time: Any) -> Any:
        """See `Reference.rate`."""
        return 2 * math.pi * self.frequency * self.amplitude * np.cos(self._angle(time))


@dataclass(frozen=True)
class Square(_Periodic):
    """offset ± amplitude with the sign of that sine, + where it is 0.

    Attributes:
        amplitude: rad, above 0.
        frequency: Hz, above 0.
        phase: rad.
        offset: rad.
    """

    def value(self, time: Any) -> Any:
        """See `Reference.value`."""
        share = (self._angle(time) / (2 * math.pi) + _SAME) % 1.0
        return self.offset + np.where(share < 0.5, self.amplitude, -self.amplitude)[()]


@dataclass(frozen=True)
class Saturated(Reference):
    """Another reference, cut where it asks for more than the module can do (`Reference.within`).

    Attributes:
        wanted: what was asked for.
        limit: the largest bend to either side, rad.
    """

    wanted: Reference
    limit: float

    @property
    def frequency_hz(self) -> float | None:
        """See `Reference.frequency_hz`."""
        return self.wanted.frequency_hz

    @property
    def peak(self) -> float:
        """See `Reference.peak`."""
        return min(self.wanted.peak, self.limit)

    def value(self, time: Any) -> Any:
        """See `Reference.value`."""
        return np.clip(self.wanted.value(time), -self.limit, self.limit)

    def rate(self, time: Any) -> Any:
        """See `Reference.rate`."""
        return np.where(self.beyond(time), 0.0, self.wanted.rate(time))[()]

    def beyond(self, time: Any) -> Any:
        """See `Reference.beyond`."""
        return np.abs(self.wanted.value(time)) > self.limit
