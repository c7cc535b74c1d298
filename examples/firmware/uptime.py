"""Milliseconds since start, without the wrap-around of the microcontroller's ticks."""

import time


class Uptime:
    """Clock that counts up from zero.

    Ticks return to zero after 2^30 ms (12.4 days). Their difference is right as long as
    `ms` is called every 6 days. The sum of the differences is an integer of any size
    and never a float: most microcontrollers have single precision, which resolves 31 ms
    after 5 days.
    """

    def __init__(self, ticks=time.ticks_ms, difference=time.ticks_diff):
        """Start at zero.

        Args:
            ticks: function that returns the ticks, ms.
            difference: function that subtracts two values of `ticks`.
        """
        self._ticks = ticks
        self._difference = difference
        self._last = ticks()
        self._total = 0

    def ms(self):
        """Return the time since start, ms."""
        now = self._ticks()
        self._total += self._difference(now, self._last)
        self._last = now
        return self._total
