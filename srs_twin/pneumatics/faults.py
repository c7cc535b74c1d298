"""StuckValve: a fault of the valves."""

from __future__ import annotations

from dataclasses import dataclass


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
