"""Schedules of piecewise constant valve states, and valve faults.

A valve state is +1 (filling), 0 (closed) or −1 (venting). In arrays of valve states,
the last axis contains the + chamber and the − chamber, in this order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from srs_twin.errors import count_steps
from srs_twin.robot.scale import Scale, divide


@dataclass(frozen=True)
class StuckValve:
    """Fault that holds a valve in one state.

    Attributes:
        segment: segment number, counted from 1 at the head.
        side: 0 for the valve of the + chamber, 1 for the valve of the − chamber.
        state: valve state in which the valve sticks.
        since: time of the fault, measured from `Pneumatics.reset`, s.
    """

    segment: int
    side: int
    state: int
    since: float = 0.0


LAYOUTS = {"3/2": (-1, 1), "in_out": (-1, 0, 1)}
"""Possible states of a 3/2 valve, and of separate inlet and outlet valves."""

SLOT_S = 1e-4
"""Intended duration of a valve slot for a robot with time unit 1 (`robot.scale`), s."""

# Valve events that are closer together than this time (s) differ only by rounding
# errors and are merged.
_EVENT_TOLERANCE = 1e-9


def valve_slot(tick: float, scale: Scale) -> float:
    """Return the duration of a valve slot, s.

    A control tick is divided into a whole number of slots, and valves switch only at
    the start of a slot.

    Args:
        tick: duration of a control tick, s.
        scale: scale of the robot, which determines the intended slot duration.
    """
    return divide(tick, SLOT_S * scale.time)


def count_slots(tick: float, scale: Scale) -> int:
    """Return the number of valve slots in a control tick (s).

    Raises:
        InputError: the tick is not finite or not positive.
    """
    return count_steps("tick", tick, "valve slot", valve_slot(tick, scale))


class Schedule(NamedTuple):
    """Piecewise constant valve states over a time span.

    Attributes:
        span: duration of the schedule, s.
        starts: start time of each interval with constant states, ascending from 0,
            shape (runs,), s.
        states: valve states in each interval, shape (runs, segments, 2).
    """

    span: float
    starts: np.ndarray
    states: np.ndarray

    @classmethod
    def from_slots(cls, commands: np.ndarray, span: float) -> Schedule:
        """Return a schedule of commands that divide a time span (s) into equal slots.

        The commands are valve states, shape (slots, segments, 2).
        """
        if len(commands) == 1:
            return cls(span, np.zeros(1), np.ascontiguousarray(commands))
        changes = np.flatnonzero((commands[1:] != commands[:-1]).any(axis=(1, 2))) + 1
        begins = np.append(0, changes)
        return cls(
            span, span * begins / len(commands), np.ascontiguousarray(commands[begins])
        )

    @property
    def events(self) -> np.ndarray:
        """Times at which the valve states change, shape (runs − 1,), s."""
        return self.starts[1:]

    def slice(self, begin: float, end: float) -> Schedule:
        """Return the part of the schedule between two times (s), shifted to time 0."""
        if (
            begin == 0.0
            and end == self.span
            and self.starts[-1] < end - _EVENT_TOLERANCE
        ):
            return self
        first = (
            int(np.searchsorted(self.starts, begin + _EVENT_TOLERANCE, side="right"))
            - 1
        )
        last = int(np.searchsorted(self.starts, end - _EVENT_TOLERANCE, side="left"))
        starts = np.maximum(self.starts[first:last] - begin, 0.0)
        return Schedule(end - begin, starts, self.states[first:last])

    def with_stuck_valve(
        self, begin: float, segment: int, side: int, state: int
    ) -> Schedule:
        """Return a copy of the schedule in which one valve sticks from a given time on.

        Args:
            begin: time of the fault, s, which may be before the start or after the end
                of the schedule.
            segment: segment index, counted from 0.
            side: 0 for the valve of the + chamber, 1 for the valve of the − chamber.
            state: valve state in which the valve sticks.
        """
        if begin >= self.span - _EVENT_TOLERANCE:
            return self
        starts = self.starts
        states = self.states
        if not (np.abs(starts - max(begin, 0.0)) < _EVENT_TOLERANCE).any():
            after = int(np.searchsorted(starts, begin))
            starts = np.insert(starts, after, begin)
            states = np.insert(states, after, states[after - 1], axis=0)
        states = states.copy()
        states[starts > begin - _EVENT_TOLERANCE, segment, side] = state
        return Schedule(self.span, starts, states)

    def followed_by(self, other: Schedule) -> Schedule:
        """Return a schedule that consists of this schedule followed by another."""
        # The last interval of this schedule and the first interval of the other
        # schedule are merged if their valve states are equal.
        merged = int((self.states[-1] == other.states[0]).all())
        starts = np.concatenate([self.starts, self.span + other.starts[merged:]])
        return Schedule(
            self.span + other.span,
            starts,
            np.concatenate([self.states, other.states[merged:]]),
        )
