"""Stub of MicroPython's `machine`: pins and watchdog write a log with times, sensors read constants."""

import os
import time

_log = open(os.getenv("FIRMWARE_LOG"), "a")  # noqa: SIM115 - open as long as the microcontroller runs


def _write(kind, *values):
    _log.write(f"{time.ticks_us()} {kind} {' '.join(map(str, values))}\n")
    _log.flush()


class Pin:
    """Output that logs every change."""

    IN = 0
    OUT = 1

    def __init__(self, number, mode=IN, value=None):
        """Log the first state, as a pin of the microcontroller takes it."""
        self._number = number
        self._value = None
        if value is not None:
            self.value(value)

    def init(self, mode):
        """Leave a PWM; the pin is low until it is set."""
        self.value(0)

    def value(self, state):
        """Set and log."""
        if state != self._value:
            self._value = state
            _write("pin", self._number, state)


class PWM:
    """Carrier that logs its duty as the pin's value."""

    def __init__(self, pin):
        """Take over a pin."""
        self._pin = pin

    def freq(self, _frequency):
        """Accept any frequency."""

    def duty_u16(self, duty):
        """Log the duty."""
        self._pin.value(duty / 65535)

    def deinit(self):
        """Leave the pin."""


class ADC:
    """Converter that reads half of the supply; the file `fault` makes it raise or hang."""

    def __init__(self, _number):
        """Read any pin."""

    def read_u16(self):
        """Return half of the range."""
        try:
            with open("fault") as file:
                fault = file.read()
        except OSError:
            return 32768
        while fault == "hang":
            pass
        raise OSError(fault)


class WDT:
    """Watchdog that logs its feeds for the supervisor."""

    def __init__(self, timeout):
        """Start."""
        _write("watchdog", timeout)

    def feed(self):
        """Feed."""
        _write("feed")
