"""Readings: what the sensors said last, without what no segment can be."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.trajectory import Event

LARGEST_READING = 2 * math.pi
"""No segment bends further, rad: a reading beyond is a lost one."""


class Readings:
    """The sensed bends of a controller, tick by tick.

    A reading that is not finite, or larger than a full turn, is a lost one: the last good one stands for it
    (0 before the first), and an event says so.

    Attributes:
        value: the last good readings, shape (segments,), rad.
        lost: whose last reading was lost, shape (segments,).
    """

    def __init__(self, segments: int) -> None:
        """Make the readings of so many segments, none of them read yet."""
        self.value: np.ndarray = np.zeros(segments)
        self.lost: np.ndarray = np.zeros(segments, dtype=bool)

    def take(self, time: float, sensed: np.ndarray) -> list[Event]:
        """Take the readings of a tick, shape (segments,), and return what is to be told of them.

        Args:
            time: s.
            sensed: rad, shape (segments,).
        """
        sensed = np.asarray(sensed, dtype=float)
        lost = ~(np.abs(sensed) <= LARGEST_READING)
        self.value = np.where(lost, self.value, sensed)
        if (lost == self.lost).all():
            return []
        events = []
        for j in np.flatnonzero(lost & ~self.lost):
            text = f"segment {j + 1}: reading lost; the last good one, {self.value[j]:.4g} rad, is held"
            events.append(Event(time, "reading_lost", text))
        for j in np.flatnonzero(self.lost & ~lost):
            events.append(Event(time, "reading_back", f"segment {j + 1}: readings are back"))
        self.lost = lost
        return events
