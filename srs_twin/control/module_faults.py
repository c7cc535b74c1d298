"""Detection of dead sensors and stuck valves from the bend readings of a gait.

**Sensors.** A sensor is considered dead if all readings of a period are lost. A sensor
is also considered dead if its readings stay constant over a period in which a chamber
of the segment fills.

**Valves.** A valve may be stuck if the amplitude of its chamber contradicts the duty in
two successive periods. At full duty, an amplitude below a tenth of the target is a
contradiction. At duty 0, an amplitude above the target is a contradiction. A + chamber
that never vents and a − chamber that never fills produce the same readings. In either
case, the segment moves between straight and bent to the left. A suspected segment is
therefore tested by venting both chambers. If the segment remains bent, the valve of the
chamber that bends the segment to this side is stuck open. If the segment straightens
and an amplitude was too small, the valve of the chamber with this amplitude is stuck
shut. If the segment straightens and an amplitude was too large, the cause is a load or
a biased sensor, and the segment resumes the gait. The bend at rest is averaged over a
whole period, which cancels the motion imposed by the segments that continue the gait.
The average begins half a period after the start of venting, when the chambers are
empty.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.control.duties import SIDES, ChamberPeriods
from srs_twin.io.saved_state import Stateful
from srs_twin.trajectory import Event

STILL_RAD = 0.02
"""Maximum range of the readings of a dead sensor in one period, rad."""
MIN_DRIVING_DUTY = 0.1
"""Minimum duty from which a working segment is expected to move, dimensionless."""
WEAK_RATIO = 0.1
"""Ratio of amplitude to target below which a chamber at full duty is suspicious."""
STRONG_RATIO = 1.05
"""Ratio of amplitude to target above which a chamber at duty 0 is suspicious."""
SUSPICIOUS_PERIODS = 2
"""Number of successive periods with a suspicious amplitude before a test starts."""
VENTING_PERIODS = 0.5
"""Venting time before the bend at rest is measured, in gait periods."""
BENT_RATIO = 0.5
"""Ratio of the bend at rest to the target above which a vented segment counts as bent.
"""


class ModuleFaults(Stateful):
    """Fault detection for the modules of a snake.

    Attributes:
        detected: descriptions of the detected faults, in chronological order.
        faulty: whether each segment has a detected fault, shape (segments,).
        tested: whether each segment is being vented for a test, shape (segments,).
        resumed: end time of the last test of each segment, shape (segments,), s.
    """

    state_attributes = (
        *("detected", "faulty", "tested", "resumed", "_weak", "_strong", "_cleared"),
        *("_test_started", "_bent_above", "_rest_sum", "_rest_count", "_events"),
    )

    def __init__(self, segments: int, period: float) -> None:
        """Initialise the fault detection for a gait with the given period (s)."""
        self.detected: list[str] = []
        self.faulty = np.zeros(segments, dtype=bool)
        self.tested = np.zeros(segments, dtype=bool)
        self.resumed = np.full(segments, -math.inf)
        self._period = period
        self._weak = np.zeros((segments, 2), dtype=int)
        self._strong = np.zeros((segments, 2), dtype=int)
        self._cleared = np.zeros((segments, 2), dtype=bool)
        self._test_started = np.zeros(segments)
        self._bent_above = np.zeros(segments)
        self._rest_sum = np.zeros(segments)
        self._rest_count = np.zeros(segments)
        self._events: list[Event] = []

    @property
    def working(self) -> np.ndarray:
        """Whether each segment is neither faulty nor under test, shape (segments,)."""
        return ~(self.faulty | self.tested)

    def events(self) -> list[Event]:
        """Return the events since the last call."""
        events = self._events
        self._events = []
        return events

    def check_sensors(
        self, time: float, ended: np.ndarray, duty: np.ndarray, periods: ChamberPeriods
    ) -> None:
        """Detect dead sensors."""
        # The first period of a chamber is incomplete if the chamber is already filling
        # at time 0.
        whole = ended & (periods.number > 2) & self.working[:, None]
        driven = duty.max(axis=1, keepdims=True) >= MIN_DRIVING_DUTY
        silent = (whole & (periods.lost == 1)).any(axis=1)
        still = (whole & driven & (periods.span <= STILL_RAD)).any(axis=1)
        for j in map(int, np.flatnonzero(silent)):
            self._report(time, j, "sensor dead, all readings of a period are lost")
        for j in map(int, np.flatnonzero(still & ~silent)):
            self._report(
                time, j, f"sensor dead, readings stay within {STILL_RAD:g} rad"
            )

    def check_valves(
        self,
        time: float,
        ended: np.ndarray,
        duty: np.ndarray,
        peak: np.ndarray,
        target: np.ndarray,
    ) -> None:
        """Start tests of the segments whose amplitudes contradict the duties.

        All arrays have shape (segments, 2).
        """
        ended = ended & self.working[:, None] & ~np.isnan(peak)
        weak = (duty >= 1) & (peak < WEAK_RATIO * target)
        strong = (duty <= 0) & (peak > STRONG_RATIO * target) & ~self._cleared
        self._weak = np.where(ended, (self._weak + 1) * weak, self._weak)
        self._strong = np.where(ended, (self._strong + 1) * strong, self._strong)
        suspected = np.maximum(self._weak, self._strong) >= SUSPICIOUS_PERIODS
        self._start_tests(time, suspected, target)

    def check_amplitudes(self, time: float, peaks: np.ndarray) -> None:
        """Start tests of segments whose amplitude is far below the median."""
        median = float(np.nanmedian(peaks[-1][self.working]))
        weak = (peaks <= max(WEAK_RATIO * median, 0.0)).all(axis=0)
        weak &= self.working[:, None]
        self._weak[weak] = SUSPICIOUS_PERIODS
        self._start_tests(time, weak, np.full(weak.shape, median))

    def _start_tests(
        self, time: float, chambers: np.ndarray, target: np.ndarray
    ) -> None:
        for j in np.flatnonzero(chambers.any(axis=1) & self.working):
            self.tested[j] = True
            self._bent_above[j] = BENT_RATIO * float(target[j].min())
            self._test_started[j] = time
            self._rest_sum[j] = self._rest_count[j] = 0
            text = f"segment {j + 1}: a valve may be stuck; both chambers vent"
            self._events.append(Event(time, "fault_suspected", text))

    def update_tests(self, time: float, reading: np.ndarray) -> None:
        """Add bend readings (rad) to the active tests, and end finished tests."""
        elapsed = (time - self._test_started) / self._period
        resting = self.tested & (elapsed >= VENTING_PERIODS)
        self._rest_sum[resting] += reading[resting]
        self._rest_count += resting
        for j in np.flatnonzero(self.tested & (elapsed >= VENTING_PERIODS + 1)):
            self.tested[j] = False
            self.resumed[j] = time
            rest = self._rest_sum[j] / max(self._rest_count[j], 1)
            self._end_test(time, int(j), rest)

    def _end_test(self, time: float, j: int, rest: float) -> None:
        weak = self._weak[j] >= SUSPICIOUS_PERIODS
        if abs(rest) > self._bent_above[j]:
            side = SIDES[int(rest < 0)]
            self._report(time, j, f"valve of the {side} chamber stuck open")
        elif weak.all():
            both = "both valves stuck shut, or no air"
            self._report(time, j, f"neither chamber bends the segment: {both}")
        elif weak.any():
            side = SIDES[int(np.argmax(weak))]
            self._report(time, j, f"valve of the {side} chamber stuck shut")
        else:
            self._cleared[j] = True
            text = f"segment {j + 1}: rests straight when vented; no valve is stuck"
            self._events.append(Event(time, "fault_not_found", text))
        self._weak[j] = self._strong[j] = 0

    def _report(self, time: float, j: int, fault: str) -> None:
        self.faulty[j] = True
        self.detected.append(f"segment {j + 1}: {fault}")
        self._events.append(Event(time, "fault", self.detected[-1]))
