"""Schedule: which valve stands how, and from when. StuckValve: a fault of one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True)
class StuckValve:
    """A valve that no longer obeys.

    Attributes:
        segment: from 1, at the head.
        side: 0 for the + chamber's, 1 for the − chamber's.
        state: in which it stays, +1 filling, 0 holding, −1 venting.
        since: s from `Pneumatics.reset` on.
    """

    segment: int
    side: int
    state: int
    since: float = 0.0


LAYOUTS = {"3/2": (-1, 1), "in_out": (-1, 0, 1)}
"""Valve layout → states it can take: one 3/2 valve a chamber, or an inlet and an outlet valve."""

SLOT_S = 1e-4
"""Edges inside a tick fall on a raster of 0.1 ms."""

_SAME = 1e-9  # s: events closer than this are one


class Schedule(NamedTuple):
    """Valve states over a stretch of time, piecewise constant; kernels take it as it is.

    Attributes:
        span: length of the stretch, s.
        starts: when each state begins, ascending from 0, shape (runs,), s from the start of the stretch.
        states: +1 fill, 0 hold, −1 vent, shape (runs, segments, 2), columns + and − chamber.
    """

    span: float
    starts: np.ndarray
    states: np.ndarray

    @classmethod
    def of_slots(cls, commands: np.ndarray, span: float) -> Schedule:
        """Return the schedule of commands that share a stretch equally, shape (slots, segments, 2)."""
        if len(commands) == 1:
            return cls(span, np.zeros(1), np.ascontiguousarray(commands))
        changes = np.flatnonzero((commands[1:] != commands[:-1]).any(axis=(1, 2))) + 1
        begins = np.append(0, changes)
        return cls(span, span * begins / len(commands), np.ascontiguousarray(commands[begins]))

    @property
    def events(self) -> np.ndarray:
        """Return the times at which a valve changes, shape (runs − 1,), s."""
        return self.starts[1:]

    def stretched(self, span: float) -> Schedule:
        """Return the same order of states over another span (s)."""
        return Schedule(span, self.starts * (span / self.span), self.states)

    def part(self, begin: float, end: float) -> Schedule:
        """Return the schedule from `begin` to `end`, its times counted from `begin` (s)."""
        if begin == 0.0 and end == self.span and self.starts[-1] < end - _SAME:
            return self
        first = int(np.searchsorted(self.starts, begin + _SAME, side="right")) - 1
        last = int(np.searchsorted(self.starts, end - _SAME, side="left"))
        starts = np.maximum(self.starts[first:last] - begin, 0.0)
        return Schedule(end - begin, starts, self.states[first:last])

    def stuck(self, begin: float, segment: int, side: int, state: int) -> Schedule:
        """Return the same with one valve in one state from `begin` (s) on.

        Args:
            begin: s, before the stretch or in it; after it nothing changes.
            segment: from 0.
            side: 0 for the + chamber's valve, 1 for the − chamber's.
            state: in which it stays.
        """
        if begin >= self.span - _SAME:
            return self
        starts, states = self.starts, self.states
        if not (np.abs(starts - max(begin, 0.0)) < _SAME).any():
            after = int(np.searchsorted(starts, begin))
            starts = np.insert(starts, after, begin)
            states = np.insert(states, after, states[after - 1], axis=0)
        states = states.copy()
        states[starts > begin - _SAME, segment, side] = state
        return Schedule(self.span, starts, states)

    def then(self, other: Schedule) -> Schedule:
        """Return this schedule and another after it as one."""
        same = int((self.states[-1] == other.states[0]).all())
        starts = np.concatenate([self.starts, self.span + other.starts[same:]])
        return Schedule(self.span + other.span, starts, np.concatenate([self.states, other.states[same:]]))
