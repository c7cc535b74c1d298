"""Test rig for `examples/firmware`: the files themselves in MicroPython's Unix port, with broker and link.

`machine` and `network` are stubs (`firmware_stubs`). Pins and watchdog write a log with
times of the monotonic clock that all processes of a machine share. `Robot` reads it and
acts as the hardware would: a processor that hangs leaves its pins as they are, and the
watchdog's reset sets them low. The controller (`python firmware_rig.py PORT LOG`)
numbers its commands by the pattern of the valves, so the pins show which one is obeyed.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import numpy as np
from brokers import Broker

from srs_twin.live.links import BrokerAccess, MqttLink
from srs_twin.live.messages import COMMAND

ROOT = Path(__file__).resolve().parents[2]
FIRMWARE = ROOT / "examples/firmware"
STUBS = Path(__file__).parent / "firmware_stubs"
HOLD_S = 0.2
WATCHDOG_S = 1.0
NAME = "snake"
SEGMENTS = 4
PATTERNS = 255
PERIOD_S = 0.02  # unless CONTROLLER_PERIOD_S is set
_VALVES = tuple(range(2, 10))  # pins of board.py
_POLL_S = 0.005


def micropython() -> list[str] | None:
    """Return the command that starts MicroPython, or None where it is not installed."""
    if result := shutil.which("micropython", path=os.environ.get("PATH", "")):
        return [result]
    if importlib.util.find_spec("micropython_run"):
        code = (
            "import sys, micropython_run as m; sys.exit(m.run_main(['micropython',"
            " *sys.argv[1:]]))"
        )
        return [sys.executable, "-c", code]
    return None


def lay(folder: Path, port: int) -> None:
    """Copy firmware and stubs into a folder and set the address of the broker, as a user would."""
    for file in (*FIRMWARE.glob("*.py"), *STUBS.glob("*.py")):
        shutil.copy(file, folder)
    board = folder / "board.py"
    text = board.read_text("utf-8")
    for line in (f'BROKER, PORT = "127.0.0.1", {port}', "GRACE_MS = 0"):
        text, count = re.subn(rf"(?m)^{line.split(' = ')[0]} = .*$", line, text)
        assert count == 1
    board.write_text(text, "utf-8")


def pattern(number: int) -> np.ndarray:
    """Return the valve states (segments, 2) of a command: bits of 1 to 255."""
    bits = number % PATTERNS + 1
    return np.array([1 if bits >> k & 1 else -1 for k in range(2 * SEGMENTS)]).reshape(
        SEGMENTS, 2
    )


class Cause(Enum):
    """Reason why the chambers were vented."""

    EXPIRY = "the command had expired"
    ERROR = "the loop ended by an error"
    RESET = "the watchdog reset the processor"


@dataclass
class Vent:
    """One time at which all chambers were vented.

    Attributes:
        time: when the last valve closed, s.
        command: when the command that was obeyed last had been sent, s.
        fed: when the watchdog was fed last, s.
        cause: why.
    """

    time: float
    command: float
    fed: float
    cause: Cause

    @property
    def delay(self) -> float:
        """Time since the command's expiry, s; negative where it still held."""
        return self.time - self.command - HOLD_S


@dataclass
class Robot:
    """Microcontroller: MicroPython in a process, its pins and its watchdog.

    Attributes:
        folder: of the firmware; the log as well.
        feeds: (time, bits of the open valves) of each feed, s.
        closings: (time, bits before, time of the last feed, cause) of each time at
            which all valves closed.
        resets: times of the watchdog's resets, s.
    """

    folder: Path
    feeds: list[tuple[float, int]] = field(default_factory=list)
    closings: list[tuple[float, int, float, Cause]] = field(default_factory=list)
    resets: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._log = self.folder / "log"
        self._read = 0
        self._rest = ""
        self._log.touch()
        self._pins: dict[int, float] = {}
        self._bits = self._before = 0
        self._closed = self._fed = 0.0
        self._armed = False
        self._over = threading.Event()
        self._start()
        self._thread = threading.Thread(target=self._supervise, daemon=True)
        self._thread.start()

    def _start(self) -> None:
        command = micropython()
        assert command is not None
        self._armed = False
        environment = {**os.environ, "FIRMWARE_LOG": str(self._log)}
        with (self.folder / "errors").open("ab") as errors:
            self.process = subprocess.Popen(
                [*command, "main.py"],
                cwd=self.folder,
                env=environment,
                stderr=errors,
                stdout=errors,
            )

    def _supervise(self) -> None:
        while not self._over.is_set():
            self._follow()
            if self._armed and time.monotonic() > self._fed + WATCHDOG_S:
                self._reset()
            time.sleep(_POLL_S)

    def _reset(self) -> None:
        now = time.monotonic()
        self.process.kill()
        self.process.wait()
        self._follow()
        self.resets.append(now)
        if self._before:
            at, cause = (
                (now, Cause.RESET) if self._bits else (self._closed, Cause.ERROR)
            )
            self.closings.append((at, self._before, self._fed, cause))
        self._pins.clear()
        self._bits = self._before = 0
        (self.folder / "fault").unlink(missing_ok=True)
        self._start()

    def _follow(self) -> None:
        with self._log.open(encoding="utf-8") as file:
            file.seek(self._read)
            text = file.read()
            self._read = file.tell()
        *lines, self._rest = (self._rest + text).split("\n")
        for line in lines:
            ticks, kind, *values = line.split()
            self._take(int(ticks) / 1e6, kind, values)

    def _take(self, at: float, kind: str, values: list[str]) -> None:
        if kind == "pin" and int(values[0]) in _VALVES:
            self._pins[int(values[0])] = float(values[1])
            self._bits = sum(
                1 << k for k, pin in enumerate(_VALVES) if self._pins.get(pin, 0) > 0
            )
            if not self._bits:
                self._closed = at
        elif kind == "watchdog":
            self._armed = True
            self._fed = at
        elif kind == "feed":
            if self._before and not self._bits:
                self.closings.append(
                    (self._closed, self._before, self._fed, Cause.EXPIRY)
                )
            self._fed = at
            self._before = self._bits
            self.feeds.append((at, self._bits))

    @property
    def filling(self) -> bool:
        """Whether any valve is open."""
        return self._bits != 0

    def kill(self) -> None:
        """End the interpreter at once; its pins stay."""
        self.process.kill()

    def fault(self, kind: str) -> None:
        """Make the sensors' driver hang ("hang") or raise (any other text)."""
        part = self.folder / "fault.part"
        part.write_text(kind, "utf-8")
        part.rename(self.folder / "fault")

    def close(self) -> None:
        """Switch it off."""
        self._over.set()
        self._thread.join()
        self.process.kill()
        self.process.wait()
        self._follow()


class Wire:
    """TCP link of the robot to the broker that can stall and break.

    Attributes:
        port: on which it listens.
        stalled: nothing gets through, and nothing is lost: the far side's buffers fill.
    """

    def __init__(self, broker: int) -> None:
        self._broker = broker
        self.stalled = False
        self._over = False
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(0.05)
        self.port: int = self._listener.getsockname()[1]
        self._ends: list[socket.socket] = []
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        while not self._over:
            with contextlib.suppress(OSError):
                near, _ = self._listener.accept()
                try:
                    far = socket.create_connection(("127.0.0.1", self._broker))
                except OSError:
                    near.close()
                    continue
                for one, other in ((near, far), (far, near)):
                    one.settimeout(None)
                    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    threading.Thread(
                        target=self._pump, args=(one, other), daemon=True
                    ).start()
                self._ends = [near, far]

    def _pump(self, one: socket.socket, other: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := one.recv(4096):
                while self.stalled:
                    time.sleep(0.002)
                other.sendall(data)
        for item in (one, other):
            with contextlib.suppress(OSError):
                item.shutdown(socket.SHUT_RDWR)

    def cut(self) -> None:
        """Break the connection."""
        for item in self._ends:
            with contextlib.suppress(OSError):
                item.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Break the connection and listen no longer."""
        self._over = True
        self.stalled = False
        self.cut()
        self._thread.join()
        self._listener.close()


class Controller:
    """A process that commands at 50 Hz, over the link that the shadow uses."""

    def __init__(self, folder: Path, port: int) -> None:
        self._log = folder / "commands"
        self._port = port
        self._log.touch()
        self.start()

    def start(self) -> None:
        """Start it; it continues its numbers."""
        self.process = subprocess.Popen(
            [sys.executable, __file__, str(self._port), str(self._log)]
        )

    def kill(self) -> None:
        """End it at once."""
        self.process.kill()
        self.process.wait()

    def sent(self) -> list[tuple[int, float]]:
        """Return (bits of the valves, time in s) of all commands."""
        lines = self._log.read_text("utf-8").split("\n")[:-1]
        return [
            (int(number) % PATTERNS + 1, float(at))
            for number, at in (line.split() for line in lines)
        ]


class Rig:
    """Robot, link, broker and controller."""

    def __init__(self, folder: Path) -> None:
        self.broker = Broker(folder)
        self.wire = Wire(self.broker.port)
        lay(folder, self.wire.port)
        self.robot = Robot(folder)
        self.controller = Controller(folder, self.broker.port)

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        for close in (
            self.controller.kill,
            self.robot.close,
            self.wire.close,
            self.broker.kill,
        ):
            close()

    def vents(self) -> list[Vent]:
        """Return when and after which command all chambers were vented, so far."""
        sent = self.controller.sent()
        return [
            Vent(at, latest(sent, bits, fed), fed, cause)
            for at, bits, fed, cause in self.robot.closings
        ]

    def oldest(self) -> float:
        """Return the largest age of a command at the time at which the valves were set for it, s."""
        sent = self.controller.sent()
        return max(
            (at - latest(sent, bits, at) for at, bits in self.robot.feeds if bits),
            default=0.0,
        )


def latest(sent: list[tuple[int, float]], bits: int, before: float) -> float:
    """Return when the latest command of a pattern before a time was sent, s."""
    return max(at for item, at in sent if item == bits and at <= before)


def command(port: int, log: Path) -> None:
    """Command at 50 Hz until killed; write each command's number and time before it is sent."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    number = len(log.read_text("utf-8").split("\n"))
    while True:
        try:
            link = MqttLink(
                NAME, SEGMENTS, BrokerAccess(port=port), kinds=(), speaks=NAME
            )
            break
        except Exception:  # the broker is away
            time.sleep(0.1)
    period = float(os.environ.get("CONTROLLER_PERIOD_S", PERIOD_S))
    with log.open("a", encoding="utf-8") as file:
        due = time.monotonic()
        while True:
            number += 1
            at = time.monotonic()
            file.write(f"{number} {at!r}\n")
            file.flush()
            link.send(COMMAND, pattern(number), at=at)
            due = max(due + period, at)
            time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    command(int(sys.argv[1]), Path(sys.argv[2]))
