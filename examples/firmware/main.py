"""Firmware of a pneumatic snake: obeys the newest command that is in time, and vents without one.

Every 20 ms it takes the newest command, sets the valves, feeds the watchdog and
publishes `valves`, `bends` and, where there are sensors, `pressures`. All chambers vent

- at start, before anything else;
- when the newest command is 0.2 s old (`commands.py`): the controller, the broker or
  the link may be gone;
- when the loop ends by an error, at once;
- when the loop hangs, by the watchdog's reset within `board.WATCHDOG_MS` (the
  hardware's part: `board.py`).
"""

import board  # isort: skip - the valves vent when this is imported

import json
import time

import machine
from commands import Commands
from mqtt_client import MqttClient
from uptime import Uptime

TICK_MS = 20
_MOST_TRIED = 4  # Only the newest messages of a tick are read, so a flood costs no more than a tick.


def _topic(kind):
    return f"srs/{board.NAME}/{kind}".encode()


def _message(now, content):
    """Return a message as bytes.

    Its time is written from integers: floats may be of single precision.
    """
    fields = ", ".join(f'"{key}": {json.dumps(value)}' for key, value in content)
    return f'{{"t": {now // 1000}.{now % 1000:03d}, {fields}}}'.encode()


def _states(fractions):
    """Return the states of a `valves` message: 1 fills, -1 vents, duties are unchanged."""
    return [fraction or -1 for fraction in fractions]


def _rounded(values):
    return [None if value is None else round(value, 4) for value in values]


class Firmware:
    """Loop of the robot."""

    def __init__(self):
        """Connect to nothing yet; the first tick does."""
        self._uptime = Uptime()
        self._commands = Commands(board.SEGMENTS)
        self._client = MqttClient(
            (board.BROKER, board.PORT),
            ("srs-" + board.NAME).encode(),
            _topic("command"),
            (_topic("status"), b'{"t": 0, "text": "lost"}'),
            board.USER.encode(),
            board.PASSWORD.encode(),
        )
        self._connections = 0

    def tick(self, network, watchdog):
        """Obey, feed the watchdog, publish and wait for the next tick."""
        begun = now = self._uptime.ms()
        network.keep(now)
        for payload in reversed(self._client.poll(now)[-_MOST_TRIED:]):
            if self._commands.take(payload, now):
                break
        now = self._uptime.ms()
        plus, minus = self._commands.valves(now)
        board.set_valves(plus, minus)
        watchdog.feed()  # here only: a loop that sets no valves is reset
        self._publish(now, plus, minus)
        time.sleep_ms(max(0, TICK_MS - (self._uptime.ms() - begun)))

    def _publish(self, now, plus, minus):
        if self._client.connections != self._connections:
            self._connections = self._client.connections
            self.say("running")
        self._send(now, "valves", [("plus", _states(plus)), ("minus", _states(minus))])
        self._send(now, "bends", [("rad", _rounded(board.bends()))])
        pressures = board.pressures()
        if pressures is not None:
            self._send(
                now,
                "pressures",
                [("plus", _rounded(pressures[0])), ("minus", _rounded(pressures[1]))],
            )
        self._client.flush(now)

    def _send(self, now, kind, content):
        self._client.publish(_topic(kind), _message(now, content))

    def say(self, text):
        """Publish a status."""
        self._send(self._uptime.ms(), "status", [("text", text)])

    def close(self):
        """Say that the robot has stopped, if the link allows."""
        self.say("stopped")
        self._client.disconnect(self._uptime.ms())


def main():
    """Run until the power or the watchdog ends it."""
    board.vent()
    time.sleep_ms(board.GRACE_MS)
    network = board.Network()
    firmware = Firmware()
    watchdog = machine.WDT(timeout=board.WATCHDOG_MS)
    try:
        while True:
            firmware.tick(network, watchdog)
    finally:
        board.vent()
        firmware.close()


main()
