"""The robot's electronics: valves, sensors, Wi-Fi and the broker's address.

Edit this file for your robot.

The values are for a Raspberry Pi Pico W, four segments and Hall sensors at a
multiplexer (74HC4051).

Each chamber has a valve that vents without current. The gate of its transistor has a
pull-down resistor, so the pin must be high to fill. During a reset all pins are inputs,
the transistors block, and every chamber vents. The safety of the robot after a reset
depends on this property of the hardware, not on software.
"""

from machine import ADC, PWM, Pin

SEGMENTS = 4
PLUS_PINS = (2, 4, 6, 8)  # head first
MINUS_PINS = (3, 5, 7, 9)
CARRIER_HZ = 60  # of duties


class Valve:
    """One valve; it vents from its construction on."""

    def __init__(self, number):
        """Vent.

        Args:
            number: pin.
        """
        self._pin = Pin(number, Pin.OUT, value=0)
        self._pwm = None

    def fill(self, fraction):
        """Fill for a fraction (0 to 1) of the carrier's period; 0 vents and 1 fills, both at once."""
        if 0 < fraction < 1:
            if self._pwm is None:
                self._pwm = PWM(self._pin)
                self._pwm.freq(CARRIER_HZ)
            self._pwm.duty_u16(int(65535 * fraction))
            return
        if self._pwm is not None:
            self._pwm.deinit()
            self._pwm = None
            self._pin.init(Pin.OUT)
        self._pin.value(int(fraction))


# Before anything else is set up.
_PLUS = [Valve(number) for number in PLUS_PINS]
_MINUS = [Valve(number) for number in MINUS_PINS]


def set_valves(plus, minus):
    """Set all valves; `plus` and `minus` have one fraction (0 vents, 1 fills) per segment."""
    for valves, fractions in ((_PLUS, plus), (_MINUS, minus)):
        for valve, fraction in zip(valves, fractions):  # noqa: B905 - MicroPython's zip has no `strict`
            valve.fill(fraction)


def vent():
    """Vent all chambers."""
    for valve in _PLUS + _MINUS:
        valve.fill(0)


NAME = "snake"  # in the topics: srs/NAME/...
BROKER, PORT = "192.168.1.10", 1883  # an IPv4 address, no name
USER = ""
PASSWORD = ""
WIFI_NAME = ""
WIFI_PASSWORD = ""

WATCHDOG_MS = (
    1000  # After a hang the chambers vent within this time. ESP32: not below 1000.
)
GRACE_MS = 2000  # Ctrl-C reaches the prompt within this time after a reset, before the watchdog starts.

_SELECT = [Pin(number, Pin.OUT, value=0) for number in (10, 11, 12)]
_HALL = ADC(26)
# bend = slope (voltage - rest): `srs-twin calibrate` measures the curve of a sensor.
HALL_REST_V = (1.65, 1.65, 1.65, 1.65)
HALL_SLOPE_RAD_PER_V = (1.0, 1.0, 1.0, 1.0)
_BROKEN_V = 0.05  # A broken or shorted wire reads the supply or ground.
_SUPPLY_V = 3.3
_LARGEST_RAD = 3.0  # No module bends further; the shadow refuses a message beyond 2 pi.


def bends():
    """Return each segment's bend, rad, positive to the left; None where the sensor is broken."""
    found = []
    for j in range(SEGMENTS):
        for bit, pin in enumerate(_SELECT):
            pin.value(j >> bit & 1)
        volts = _HALL.read_u16() * _SUPPLY_V / 65535
        bend = HALL_SLOPE_RAD_PER_V[j] * (volts - HALL_REST_V[j])
        working = _BROKEN_V < volts < _SUPPLY_V - _BROKEN_V and abs(bend) < _LARGEST_RAD
        found.append(bend if working else None)
    return found


def pressures():
    """Return the gauge pressures of the + and of the - chambers, kPa, or None without sensors."""
    return


class Network:
    """Wi-Fi that connects in the background."""

    def __init__(self):
        """Switch it on; this may take a second."""
        import network

        self._wlan = network.WLAN(network.STA_IF)
        self._tried = None
        self._wlan.active(True)

    def keep(self, now):
        """Connect again, every five seconds where there is no connection (now: ms)."""
        if self._tried is not None and (
            now - self._tried < 5000 or self._wlan.isconnected()
        ):
            return
        self._tried = now
        try:
            self._wlan.connect(WIFI_NAME, WIFI_PASSWORD)
        except OSError:
            pass  # It is connecting already.
