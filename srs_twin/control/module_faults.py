"""Detection of dead sensors and stuck valves from the bend readings of a gait.

**Sensors.** A bend sensor is considered dead if all its readings in a period are lost.
A sensor is also considered dead if its readings stay constant during a period in which
a chamber of its segment fills.

**Valves.** A valve may be stuck if the amplitude of its chamber contradicts the duty
cycle in two successive periods. At a duty cycle of 1, an amplitude below a tenth of the
target amplitude is too small. At a duty cycle of 0, an amplitude more than 5 % above
the target amplitude is too large.

Different faults can cause the same readings. For example, a + chamber that never vents
cannot be distinguished from a − chamber that never fills. A suspected segment is
therefore tested by venting both chambers. If the segment remains bent, the valve of the
chamber that causes this bend is stuck open. If the segment straightens and an amplitude
was too small, the valve of the corresponding chamber is stuck shut. If the segment
straightens and an amplitude was too large, the cause is a load or a biased sensor, and
the segment resumes the gait.

During a test, the bend is averaged over one gait period to cancel the motion that the
other segments impose. The averaging begins half a gait period after the start of
venting, when the chambers are empty.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.control.duties import SIDES, ChamberPeriods
from srs_twin.io.saved_state import Stateful
from srs_twin.trajectory import Event

STILL_RAD = 0.02
"""Maximum difference between the readings of a dead sensor in one period, rad."""
MIN_DRIVING_DUTY = 0.1
"""Minimum duty cycle for which a working segment is expected to move."""
WEAK_RATIO = 0.1
"""Smallest normal ratio of amplitude to target amplitude at a duty cycle of 1."""
STRONG_RATIO = 1.05
"""Largest normal ratio of amplitude to target amplitude at a duty cycle of 0."""
SUSPICIOUS_PERIODS = 2
"""Number of successive periods with abnormal amplitudes that start a valve test."""
VENTING_PERIODS = 0.5
"""Time for which a segment vents before its bend is averaged, in gait periods."""
BENT_RATIO = 0.5
"""Ratio of bend to target amplitude above which a vented segment is considered bent."""


class ModuleFaults(Stateful):
    """Detector of dead sensors and stuck valves in the segments of a snake.

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
        """Initialise the fault detection for a gait with a given period (s)."""
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
        """Detect dead sensors in segments whose chambers have completed a period."""
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
        """Start to test segments whose amplitudes contradict their duty cycles.

        All arrays have shape (segments, 2), and amplitudes are in rad.
        """
        ended = ended & self.working[:, None] & ~np.isnan(peak)
        weak = (duty >= 1) & (peak < WEAK_RATIO * target)
        strong = (duty <= 0) & (peak > STRONG_RATIO * target) & ~self._cleared
        self._weak = np.where(ended, (self._weak + 1) * weak, self._weak)
        self._strong = np.where(ended, (self._strong + 1) * strong, self._strong)
        suspected = np.maximum(self._weak, self._strong) >= SUSPICIOUS_PERIODS
        self._start_tests(time, suspected, target)

    def check_amplitudes(self, time: float, peaks: np.ndarray) -> None:
        """Start to test segments whose recorded amplitudes are far below the median."""
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
        """Add bend readings (rad) to the active tests, and evaluate completed tests."""
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
