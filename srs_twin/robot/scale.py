r"""Units that scale the numerical settings with the size of a robot.

Gravity does not scale with the robot. If lengths are multiplied by s, masses by s³,
stiffnesses by s⁴ and time constants by √s, a snake therefore repeats its motion with
speeds multiplied by √s. The simulation must then multiply time steps and slip speeds by
√s, and contact depths by s. The settings are defined for the shipped robots and, for
other robots, multiplied by powers of the time unit

$$ u = 2^{\operatorname{round}(\frac12 \log_2 (P / P_0))}, \qquad P_0 = 1/16\ \mathrm m, $$

where P is the distance between adjacent connectors. Times and speeds are multiplied by
u, and lengths by the length unit u².

The time unit is 1 for 3.1 cm < P < 12.5 cm, which includes all shipped robots, and
doubles at P = 12.5 cm, 50 cm and so on. Multiplication by a power of two is exact, so a
robot scaled by a power of four repeats the original motion to the last digit. For other
scales, times and speeds differ from the ideal scaling by at most a factor of √2, and
lengths by at most a factor of 2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

REFERENCE_PITCH = 1 / 16
"""Reference distance P₀ between connectors, m. The shipped robots have distances of 4.7
to 7.5 cm."""

_ROUND_NUMBERS = (1, 2, 5, 10)
_ROUNDING = 1e-9


class Scale(NamedTuple):
    """Units of a robot's numerical settings, relative to the shipped robots.

    Attributes:
        time: time unit u, a power of two by which times and speeds are multiplied,
            dimensionless.
    """

    time: float = 1.0

    @classmethod
    def of_pitch(cls, pitch: float) -> Scale:
        """Return the scale of a robot from the distance between its connectors (m)."""
        return cls(2.0 ** round(math.log2(pitch / REFERENCE_PITCH) / 2))

    @property
    def speed(self) -> float:
        """Factor u by which speeds are multiplied, dimensionless."""
        return self.time

    @property
    def length(self) -> float:
        """Length unit u², dimensionless."""
        return self.time**2


SHIPPED = Scale()
"""Scale of the shipped robots."""


def divide(interval: float, part: float) -> float:
    """Return a time step near `part` that divides an interval into equal steps, s.

    The step is `part` if the interval is a multiple of `part`, and the whole interval
    if it is shorter than `part`. Otherwise, the number of steps is 1, 2 or 5 times a
    power of ten, and the step is as close as possible to `part`. When a control tick of
    20 ms is scaled with the robot, the number of steps therefore stays the same.

    Args:
        interval: interval to divide, s.
        part: preferred time step, s.
    """
    ratio = interval / part
    if not 1.0 < ratio < math.inf:
        return interval
    if abs(ratio - round(ratio)) <= _ROUNDING * ratio:
        return part
    power = 10.0 ** math.floor(math.log10(ratio))
    number = min(
        (power * n for n in _ROUND_NUMBERS), key=lambda n: abs(math.log(n / ratio))
    )
    return interval / number
