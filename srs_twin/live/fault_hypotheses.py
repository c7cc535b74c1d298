"""Fault hypotheses for a segment, and the decision rule for detecting faults.

A fault is detected when its probability has exceeded a threshold for a given time.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from srs_twin.io.saved_state import Stateful

LOW_SUPPLY_PRESSURE = "low_supply_pressure"


class ChamberBehaviour(IntEnum):
    """Behaviour of a chamber, which obeys commands, only fills, only vents or leaks."""

    OBEYS = 0
    FILLS = 1
    VENTS = 2
    LEAKS = 3


class SensorBehaviour(IntEnum):
    """Behaviour of a bend sensor, which is intact, silent, frozen or drifting."""

    READS = 0
    SILENT = 1
    FROZEN = 2
    DRIFTS = 3


class Inflow(NamedTuple):
    """Inflow and leak of a filling chamber.

    Attributes:
        leak: relative rate of pressure loss of the chamber, 1/s.
        fraction: supply pressure of the chamber as a fraction of the robot's supply
            pressure, or 0 if no air flows into the chamber.
    """

    leak: float
    fraction: float


class Hypothesis(NamedTuple):
    """Hypothesis about the chambers and the bend sensor of a segment.

    Attributes:
        name: name of the fault, or an empty string for a segment without a fault.
        leak: relative rate of pressure loss of a leaking chamber, 1/s.
        weak: supply pressure of the segment as a fraction of the robot's supply
            pressure.
    """

    name: str
    plus: ChamberBehaviour = ChamberBehaviour.OBEYS
    minus: ChamberBehaviour = ChamberBehaviour.OBEYS
    sensor: SensorBehaviour = SensorBehaviour.READS
    leak: float = 0.0
    weak: float = 1.0

    @property
    def chambers(self) -> tuple[ChamberBehaviour, ChamberBehaviour]:
        """Behaviours of the + chamber and the − chamber."""
        return self.plus, self.minus

    def inflow(self, chamber: ChamberBehaviour) -> Inflow:
        """Return the inflow of a chamber with the given behaviour."""
        leak = self.leak if chamber == ChamberBehaviour.LEAKS else 0.0
        fraction = 0.0 if chamber == ChamberBehaviour.VENTS else self.weak
        return Inflow(leak, fraction)


HYPOTHESES = (
    Hypothesis(""),
    Hypothesis("stuck_valve +=open", plus=ChamberBehaviour.FILLS),
    Hypothesis("stuck_valve +=closed", plus=ChamberBehaviour.VENTS),
    Hypothesis("stuck_valve -=open", minus=ChamberBehaviour.FILLS),
    Hypothesis("stuck_valve -=closed", minus=ChamberBehaviour.VENTS),
    *(
        Hypothesis("leak +", plus=ChamberBehaviour.LEAKS, leak=rate)
        for rate in (2.0, 6.0)
    ),
    *(
        Hypothesis("leak -", minus=ChamberBehaviour.LEAKS, leak=rate)
        for rate in (2.0, 6.0)
    ),
    *(Hypothesis("weak", weak=fraction) for fraction in (0.5, 0.15)),
    Hypothesis("dead_sensor", sensor=SensorBehaviour.SILENT),
    Hypothesis("dead_sensor frozen", sensor=SensorBehaviour.FROZEN),
    Hypothesis("drifting_sensor", sensor=SensorBehaviour.DRIFTS),
)

NAMES = tuple(dict.fromkeys(hypothesis.name for hypothesis in HYPOTHESES))
"""Distinct names of the fault hypotheses.

Hypotheses with different severities of the same fault share one name.
"""
HAS_NAME = np.array(
    [[hypothesis.name == name for name in NAMES] for hypothesis in HYPOTHESES],
    dtype=float,
)
"""Matrix with the entry 1 if a hypothesis (row) has a name (column), otherwise 0."""
WEAK = NAMES.index("weak")
LEAK = np.array([name.startswith("leak") for name in NAMES])
INDISTINGUISHABLE = ((1, 4), (2, 3))
"""Pairs of `NAMES` indices whose faults have equal effects on the bend.

The effects are equal only if the two chambers of a segment fill alternately.
"""

CHAMBERS = np.array([hypothesis.chambers for hypothesis in HYPOTHESES])
SENSORS = np.array([hypothesis.sensor for hypothesis in HYPOTHESES])
LEAK_RATES = np.array([hypothesis.leak for hypothesis in HYPOTHESES])
SUPPLY_FRACTIONS = np.array([hypothesis.weak for hypothesis in HYPOTHESES])


def valve_duty(duty: np.ndarray, chambers: np.ndarray) -> np.ndarray:
    """Return the actual duty of each valve for given commands and chamber behaviours.

    The duty is the fraction of time in which a valve fills its chamber.
    """
    duty = np.where(chambers == ChamberBehaviour.VENTS, 0.0, duty)
    return np.where(chambers == ChamberBehaviour.FILLS, 1.0, duty)


_THRESHOLD = 0.97
"""Probability above which a fault is detected."""
_PATIENCE_S = 0.16
"""Time for which the probability of a fault must stay above `_THRESHOLD`, s."""
_LEAK_THRESHOLD = 0.99
"""Probability above which a leak is detected."""
_LEAK_PATIENCE_S = 0.08
"""Time for which the probability of a leak must stay above `_LEAK_THRESHOLD`, s.

A short time is sufficient, because a single pressure reading can reveal a leak.
"""
START_S = 2.0
"""Time after the start of the robot during which no fault is detected, s."""
_DOUBT = 0.5
"""Probability of no fault below which a segment is suspected of a fault."""
_PATIENCE_FACTOR = 3.0
"""Factor on the time before detection if another segment is suspected of a fault."""


class FaultDecision(Stateful):
    """Detected faults of the segments and the supply.

    Attributes:
        pairs: indices into `NAMES` of the detected fault or of two indistinguishable
            faults, shape (segments + 1, 2). Row 0 belongs to the supply. Unused entries
            are −1.
    """

    state_attributes = ("pairs", "_since", "_either_since")

    def __init__(self, segments: int) -> None:
        self.pairs = np.full((segments + 1, 2), -1, dtype=int)
        # Times at which the probabilities of faults and pairs of indistinguishable
        # faults exceeded the threshold, or infinity.
        self._since = np.full((segments, len(NAMES)), np.inf)
        self._either_since = np.full((segments, len(INDISTINGUISHABLE)), np.inf)

    @property
    def detected_faults(self) -> dict[int, str]:
        """Names of the detected faults, keyed by segment number or 0 for the supply."""
        detected = {0: LOW_SUPPLY_PRESSURE} if self.low_supply_pressure else {}
        for j in np.flatnonzero(self.faulty) + 1:
            names = [NAMES[m] for m in self.pairs[j] if m >= 0]
            detected[int(j)] = " or ".join(names)
        return detected

    @property
    def low_supply_pressure(self) -> bool:
        """Whether a low supply pressure is detected."""
        return bool(self.pairs[0, 0] >= 0)

    @property
    def faulty(self) -> np.ndarray:
        """Whether each segment has a detected fault, shape (segments,)."""
        return np.asarray(self.pairs[1:, 0] >= 0)

    def clear(self, number: int) -> None:
        """Remove the detected fault of a segment, or of the supply if `number` is 0."""
        self.pairs[number] = -1

    def most_likely(self, probability: np.ndarray) -> np.ndarray:
        """Return the index of the most likely hypothesis for each segment.

        The index is 0 for a segment without a detected fault. For other segments, only
        hypotheses of the detected faults are considered.
        """
        likely = np.zeros(len(probability), dtype=int)
        for j in np.flatnonzero(self.faulty):
            among = HAS_NAME[:, [m for m in self.pairs[j + 1] if m >= 0]].sum(axis=1)
            likely[j] = np.argmax(probability[j] * among)
        return likely

    def update(self, time: float, probability: np.ndarray) -> None:
        """Detect and clear faults at a time (s) from the hypothesis probabilities."""
        pairs = self.pairs
        if time < START_S:
            self._since[:] = np.inf
            self._either_since[:] = np.inf
            return
        likely = probability @ HAS_NAME
        # Segments rarely fail at the same time. If several segments are suspected of a
        # fault, there may be a common cause, for example the supply.
        doubted = likely[:, 0] < _DOUBT
        factor = np.where(doubted.sum() - doubted > 0, _PATIENCE_FACTOR, 1.0)[:, None]
        threshold = np.where(LEAK, _LEAK_THRESHOLD, _THRESHOLD)
        patience = factor * np.where(LEAK, _LEAK_PATIENCE_S, _PATIENCE_S) - 1e-9
        weak = likely[:, WEAK]
        count = len(likely)
        if count > 1:
            other_weak = (weak.sum() - weak) / (count - 1)
            likely[:, WEAK] = weak * np.minimum(2 * other_weak, 1.0)
            likely /= likely.sum(axis=1, keepdims=True)
        self._since = np.where(
            likely > threshold, np.minimum(self._since, time), np.inf
        )
        either = [
            likely[:, pair].sum(axis=1) > _THRESHOLD for pair in INDISTINGUISHABLE
        ]
        self._either_since = np.where(
            np.transpose(either), np.minimum(self._either_since, time), np.inf
        )
        if not self.low_supply_pressure:
            for j, m in np.argwhere(time - self._since >= patience):
                # Later evidence may distinguish the two faults of a detected pair.
                is_new = pairs[j + 1, 0] < 0 or m in pairs[j + 1]
                if is_new and m not in (0, WEAK):
                    pairs[j + 1] = m, -1
            for j, k in np.argwhere(time - self._either_since >= patience[:, :1]):
                if pairs[j + 1, 0] < 0:
                    pairs[j + 1] = INDISTINGUISHABLE[k]
        sound = np.append(False, likely[:, 0] > _THRESHOLD)
        pairs[sound & (pairs[:, 0] >= 0)] = -1
