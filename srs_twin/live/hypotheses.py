"""Fault hypotheses of one segment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

OBEYS, FILLS, VENTS, LEAKS = range(4)
"""Behaviour of a chamber."""
READS, SILENT, FROZEN, DRIFTS = range(4)
"""Behaviour of a bend sensor."""
STARVED = "starved"
"""Name of the fault of the supply."""


class Hypothesis(NamedTuple):
    """Behaviour of the chambers and the sensor of a segment.

    Attributes:
        name: name of the fault; empty without a fault.
        plus: behaviour of the + chamber.
        minus: behaviour of the − chamber.
        sensor: behaviour of the sensor.
        leak: relative rate at which a leaking chamber loses pressure, 1/s.
        weak: supply pressure of a weak segment, as a fraction of that of the robot.
    """

    name: str
    plus: int = OBEYS
    minus: int = OBEYS
    sensor: int = READS
    leak: float = 0.0
    weak: float = 1.0

    def inflow(self, chamber: int) -> tuple[float, float]:
        """Return leak rate (1/s) and fraction of the supply pressure for a behaviour of a chamber."""
        return self.leak if chamber == LEAKS else 0.0, 0.0 if chamber == VENTS else self.weak


HYPOTHESES = (
    Hypothesis(""),
    Hypothesis("stuck_valve +=open", plus=FILLS),
    Hypothesis("stuck_valve +=closed", plus=VENTS),
    Hypothesis("stuck_valve -=open", minus=FILLS),
    Hypothesis("stuck_valve -=closed", minus=VENTS),
    *(Hypothesis("leak +", plus=LEAKS, leak=rate) for rate in (2.0, 6.0)),
    *(Hypothesis("leak -", minus=LEAKS, leak=rate) for rate in (2.0, 6.0)),
    *(Hypothesis("weak", weak=share) for share in (0.5, 0.15)),
    Hypothesis("dead_sensor", sensor=SILENT),
    Hypothesis("dead_sensor frozen", sensor=FROZEN),
    Hypothesis("drifting_sensor", sensor=DRIFTS),
)

NAMES = tuple(dict.fromkeys(hypothesis.name for hypothesis in HYPOTHESES))
"""Names of the hypotheses; several severities of a fault have the same name."""
HAS_NAME = np.array([[hypothesis.name == name for name in NAMES] for hypothesis in HYPOTHESES], dtype=float)
"""1 where a hypothesis (row) has a name (column)."""
WEAK = NAMES.index("weak")
LEAK = np.array([name.startswith("leak") for name in NAMES])
INDISTINGUISHABLE = ((1, 4), (2, 3))
"""Pairs of names with the same effect on bends, if the two chambers of the segment alternate."""

CHAMBERS = np.array([[hypothesis.plus, hypothesis.minus] for hypothesis in HYPOTHESES])
SENSORS = np.array([hypothesis.sensor for hypothesis in HYPOTHESES])
LEAK_RATES = np.array([hypothesis.leak for hypothesis in HYPOTHESES])
SUPPLY_SHARES = np.array([hypothesis.weak for hypothesis in HYPOTHESES])


def valve_duty(duty: np.ndarray, chambers: np.ndarray) -> np.ndarray:
    """Return the duty of the valves (fraction of time in which they fill) for a chamber behaviour."""
    return np.where(chambers == FILLS, 1.0, np.where(chambers == VENTS, 0.0, duty))
