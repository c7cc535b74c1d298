r"""Units that scale the numerical settings with the size of a robot.

Gravity does not scale with the robot. A snake therefore repeats the motion, with speeds
multiplied by √s, if lengths are multiplied by s, masses by s³, stiffnesses by s⁴ and
times by √s. The numerical settings must change as well: time steps and slip speeds by
√s, contact depths by s. The settings are defined for the shipped robots and multiplied
by powers of the time unit

$$ u = 2^{\operatorname{round}(\frac12 \log_2 (P / P_0))}, \qquad P_0 = 1/16\ \mathrm m, $$

where P is the distance between connectors. Times and speeds are multiplied by u,
lengths by u².

The unit u is 1 for 3.1 cm < P < 12.5 cm, which includes all shipped robots.
Multiplication by a power of two is exact, so that a robot scaled by a power of four
repeats the original motion to the last digit. For other scales, the settings are at
most √2 times too fine or too coarse. Times change by a factor of two (lengths by four)
at P = 3.1 cm, 12.5 cm, 50 cm, and so on.
"""

from __future__ import annotations

import math
from typing import NamedTuple

REFERENCE_PITCH = 1 / 16
"""Reference distance P₀ between connectors, m. It is 5.5 to 7.5 cm in the shipped
robots."""

_ROUND_NUMBERS = (1, 2, 5, 10)
_ROUNDING = 1e-9


class Scale(NamedTuple):
    """Units of a robot's numerical settings, relative to the shipped robots.

    Attributes:
        time: unit u of times and speeds, a power of two, dimensionless.
    """

    time: float = 1.0

    @classmethod
    def of_pitch(cls, pitch: float) -> Scale:
        """Return the scale of a robot with a given connector distance (m)."""
        return cls(2.0 ** round(math.log2(pitch / REFERENCE_PITCH) / 2))

    @property
    def speed(self) -> float:
        """Unit u of speeds, dimensionless."""
        return self.time

    @property
    def length(self) -> float:
        """Unit u² of lengths, dimensionless."""
        return self.time**2


SHIPPED = Scale()
"""Scale of the shipped robots."""


def divide(interval: float, part: float) -> float:
    """Return a time step near `part` that divides an interval into equal steps, s.

    The step is `part` if the interval is a multiple of `part`, and the whole interval
    if the interval is shorter than `part`. Otherwise, the number of steps is 1, 2 or 5
    times a power of ten, and the step is as close as possible to `part`. A control tick
    of 20 ms therefore has the same number of steps after scaling.

    Args:
        interval: interval to divide, s.
        part: intended step, s.
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
