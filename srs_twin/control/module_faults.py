"""ModuleFaults: which module has a dead sensor or a stuck valve, told from its readings alone.

A sensor is dead where its readings do not move for a whole period though its chambers fill, or are all lost.

A valve is suspected where a chamber stays under a tenth of its target at full duty, or over it at none, for
two periods. To a sensor a + chamber that never vents looks as a − chamber that never fills: the segment
swings between straight and left. So both chambers vent. If the segment then rests bent, the
chamber on that side is stuck open; if it rests straight, the one that was too weak is stuck shut. A chamber
that was too strong, and yet rests straight, has another reason (load, a biased sensor): back to work.
The resting bend is the mean of a whole period, which the other modules' gait leaves alone, after half a
period to empty the chambers.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.control.duties import SIDES, Cycles
from srs_twin.io.saved_state import Stateful
from srs_twin.trajectory import Event

STILL_RAD = 0.02
"""Readings of a period that lie no further apart do not move, rad."""
DRIVEN = 0.1
"""Duty of a chamber that must move its segment."""
WEAK = 0.1
"""Share of its target that a chamber at full duty must reach."""
STRONG = 1.05
"""Share of its target beyond which a chamber without air must not go."""
PATIENCE = 2
"""For how many periods a chamber may be too weak or too strong."""
EMPTYING = 0.5
"""How long chambers vent before it counts how the segment rests, periods."""
BENT = 0.5
"""Share of the target from which on a vented segment is bent."""


class ModuleFaults(Stateful):
    """Watches the segments of a snake, and names what is wrong with them.

    Attributes:
        named: what was found, in order.
        faulty: segments that have a fault, shape (segments,).
        tested: segments that vent to see how they rest, shape (segments,).
        testing: whether there are any.
        back: when each came back from its last test, shape (segments,), s.
    """

    state_attributes = (
        *("named", "faulty", "tested", "testing", "back", "_weak", "_strong", "_cleared"),
        *("_since", "_bent", "_rest", "_looks", "_events"),
    )

    def __init__(self, segments: int, period: float) -> None:
        """Make a watch over so many segments with a gait period (s)."""
        self.named: list[str] = []
        self.faulty = np.zeros(segments, dtype=bool)
        self.tested = np.zeros(segments, dtype=bool)
        self.testing = False
        self.back = np.full(segments, -math.inf)
        self._period = period
        self._weak, self._strong = np.zeros((segments, 2), dtype=int), np.zeros((segments, 2), dtype=int)
        self._cleared = np.zeros((segments, 2), dtype=bool)
        self._since, self._bent = np.zeros(segments), np.zeros(segments)
        self._rest, self._looks = np.zeros(segments), np.zeros(segments)
        self._events: list[Event] = []

    @property
    def working(self) -> np.ndarray:
        """Segments that are neither faulty nor tested, shape (segments,)."""
        return ~(self.faulty | self.tested)

    def events(self) -> list[Event]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def judge_sensors(self, time: float, ended: np.ndarray, duty: np.ndarray, cycles: Cycles) -> None:
        """Look for dead sensors.

        Args:
            time: s.
            ended: chambers of which a period has ended, shape (segments, 2).
            duty: in that period, same shape.
            cycles: what was read in it.
        """
        whole = ended & (cycles.number > 2) & self.working[:, None]
        driven = duty.max(axis=1, keepdims=True) >= DRIVEN
        silent = (whole & (cycles.lost == 1)).any(axis=1)
        still = (whole & driven & (cycles.span <= STILL_RAD)).any(axis=1)
        for j in map(int, np.flatnonzero(silent)):
            self._name(time, j, "sensor dead, all readings of a period are lost")
        for j in map(int, np.flatnonzero(still & ~silent)):
            self._name(time, j, f"sensor dead, readings stay within {STILL_RAD:g} rad")

    def judge_valves(
        self, time: float, ended: np.ndarray, duty: np.ndarray, peak: np.ndarray, target: np.ndarray
    ) -> None:
        """Look for stuck valves.

        Args:
            time: s.
            ended: chambers of which a period has ended, shape (segments, 2).
            duty: in that period, same shape.
            peak: … and how far the segment bent, same shape, rad; NaN where nobody knows.
            target: … and how far it should, same shape, rad.
        """
        ended = ended & self.working[:, None] & ~np.isnan(peak)
        weak = (duty >= 1) & (peak < WEAK * target)
        strong = (duty <= 0) & (peak > STRONG * target) & ~self._cleared
        self._weak = np.where(ended, np.where(weak, self._weak + 1, 0), self._weak)
        self._strong = np.where(ended, np.where(strong, self._strong + 1, 0), self._strong)
        self._test(time, (self._weak >= PATIENCE) | (self._strong >= PATIENCE), target)

    def judge_record(self, time: float, peaks: np.ndarray) -> None:
        """Look for chambers that reach next to nothing of what the others do, before there is a target.

        Args:
            time: s.
            peaks: of the free periods that are judged, at full duty, shape (periods, segments, 2), rad.
        """
        usual = float(np.nanmedian(peaks[-1][self.working]))
        weak = (peaks <= max(WEAK * usual, 0.0)).all(axis=0) & self.working[:, None]
        self._weak[weak] = PATIENCE
        self._test(time, weak, np.full(weak.shape, usual))

    def _test(self, time: float, chambers: np.ndarray, target: np.ndarray) -> None:
        """Begin to test the segments of some chambers, shape (segments, 2); targets in rad."""
        for j in np.flatnonzero(chambers.any(axis=1) & self.working):
            self.tested[j], self.testing = True, True
            self._since[j], self._bent[j] = time, BENT * float(target[j].min())
            self._rest[j] = self._looks[j] = 0
            text = f"segment {j + 1}: a valve may be stuck; both chambers vent"
            self._events.append(Event(time, "fault_suspected", text))

    def look(self, time: float, reading: np.ndarray) -> None:
        """Take the readings of a tick, shape (segments,), rad, while segments are tested; end their tests."""
        through = (time - self._since) / self._period
        late = self.tested & (through >= EMPTYING)
        self._rest[late] += reading[late]
        self._looks += late
        for j in np.flatnonzero(self.tested & (through >= EMPTYING + 1)):
            self.tested[j], self.back[j] = False, time
            self._decide(time, int(j), self._rest[j] / max(self._looks[j], 1))
        self.testing = bool(self.tested.any())

    def _decide(self, time: float, j: int, rest: float) -> None:
        weak = self._weak[j] >= PATIENCE
        if abs(rest) > self._bent[j]:
            self._name(time, j, f"valve of the {SIDES[int(rest < 0)]} chamber stuck open")
        elif weak.all():
            self._name(time, j, "neither chamber bends it: both valves stuck shut, or no air")
        elif weak.any():
            self._name(time, j, f"valve of the {SIDES[int(np.argmax(weak))]} chamber stuck shut")
        else:
            self._cleared[j] = True
            text = f"segment {j + 1}: rests straight when vented; no valve is stuck"
            self._events.append(Event(time, "fault_not_found", text))
        self._weak[j] = self._strong[j] = 0

    def _name(self, time: float, j: int, what: str) -> None:
        self.faulty[j] = True
        self.named.append(f"segment {j + 1}: {what}")
        self._events.append(Event(time, "fault", self.named[-1]))
