"""Steps: where an integrator's steps end within a stretch of time, and after which of them to look."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from srs_twin.plants.kernels import GAMMA


@dataclass(frozen=True)
class Steps:
    """The steps of a stretch; equal stretches without valve events share one, so nothing may be written to.

    Attributes:
        ends: ascending, from the stretch's start, shape (steps,), s.
        marks: numbers of steps after which a sample is due, ascending, shape (samples,).
    """

    ends: np.ndarray
    marks: np.ndarray

    @classmethod
    def between(cls, span: float, events: np.ndarray, samples: int, *, longest: float, same: float) -> Steps:
        """Return steps on an even grid, in step with the samples, and on every valve event in between.

        Args:
            span: length of the stretch, s.
            events: when valves change, ascending, s from its start.
            samples: how many, equally spaced, the last at the end.
            longest: no step is longer, s.
            same: events that are closer to the end of another step, or to each other, end none of their own,
                s.
        """
        per_sample = math.ceil(span / samples / longest * (1 - 1e-12))
        even = _even(span, samples, per_sample)
        if not len(events):
            return even
        grid = span / (samples * per_sample)
        steps = events / grid
        # Whichever of them rounding puts first.
        events = events[np.abs(steps - np.round(steps)) * grid > same]
        events = events[np.diff(events, prepend=-1.0) > same]
        marks = even.marks + np.searchsorted(events, even.ends[even.marks - 1])
        return cls(np.sort(np.concatenate([even.ends, events])), marks)

    @cached_property
    def lengths(self) -> np.ndarray:
        """Return the steps' lengths, shape (steps,), s."""
        return self.ends - self._starts

    @cached_property
    def moments(self) -> np.ndarray:
        """Return the start and each step's two stages, shape (1 + 2 · steps,), s."""
        found = np.zeros(1 + 2 * len(self.ends))
        found[1::2], found[2::2] = self._starts + GAMMA * self.lengths, self._starts + self.lengths
        return found

    def pieces(self, turn: float) -> Iterator[tuple[float, float, Steps]]:
        """Yield begin and end (s) and steps of pieces about as long as `turn` (s), of a step at least."""
        firsts = np.unique(np.floor(self.ends / turn * (1 - 1e-9)), return_index=True)[1]
        for first, last in zip(firsts, [*firsts[1:], len(self.ends)], strict=True):
            begun = float(self.ends[first - 1]) if first else 0.0
            inside = self.marks[(self.marks > first) & (self.marks <= last)] - first
            yield begun, float(self.ends[last - 1]), Steps(self.ends[first:last] - begun, inside)

    @property
    def _starts(self) -> np.ndarray:
        return np.append(0.0, self.ends[:-1])


@lru_cache(maxsize=64)
def _even(span: float, samples: int, per_sample: int) -> Steps:
    """Return steps on the even grid alone; a controller's ticks ask for the same ones again and again."""
    count = samples * per_sample
    ends = span / count * np.arange(1, count + 1)
    return Steps(ends, np.arange(per_sample, count + 1, per_sample))
