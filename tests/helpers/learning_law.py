"""Snake of ideal or faulty modules for tests of learning controllers, independent of the plants."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from snakes import chain

from srs_twin.control.learning import ILC

TICK = 0.01
SEGMENTS = 4
STUCK = {"open": 1.0, "shut": 0.0}


class Modules:
    """Modules whose bend is c⁺ d⁺ − c⁻ d⁻, with d the filled fraction of the last half period.

    At the end of a fill with duty u, the bend is c u, independent of the past.

    Attributes:
        gain: c, shape (segments, 2), rad; tests may change it.
        stuck: (segment, side) → "open" or "shut".
    """

    def __init__(self, gain: Any, frequency: float) -> None:
        self.gain = np.broadcast_to(np.asarray(gain, dtype=float), (SEGMENTS, 2)).copy()
        self.stuck: dict[tuple[int, int], str] = {}
        self._open = np.zeros((round(0.5 / frequency / TICK), SEGMENTS, 2))

    @property
    def bend(self) -> np.ndarray:
        filled = self.gain * self._open.mean(axis=0)
        bend: np.ndarray = filled[:, 0] - filled[:, 1]
        return bend

    def step(self, valves: np.ndarray) -> None:
        slots = valves[None] if valves.ndim == 2 else valves
        fraction = (slots == 1).mean(axis=0)
        for chamber, how in self.stuck.items():
            fraction[chamber] = STUCK[how]
        self._open = np.concatenate([self._open[1:], fraction[None]])


class Run:
    """Simulation of a controller on modules, with a sensor that may be faulty.

    Attributes:
        bend: sensor readings at the beginning of each tick.
        duty: commanded duties of each tick, (ticks, segments, 2).
        events: all events so far.
    """

    def __init__(self, controller: ILC, gain: Any = 1.0) -> None:
        self.controller = controller
        self.modules = Modules(gain, controller.frequency)
        controller.reset(chain((0.03,) * (SEGMENTS + 1)), TICK)
        self.bend: list[np.ndarray] = []
        self.duty: list[np.ndarray] = []
        self.events: list[Any] = []
        self.sensor: Any = lambda time, bend: bend

    def go(self, periods: float) -> Run:
        for _ in range(round(periods / self.controller.frequency / TICK)):
            time = len(self.bend) * TICK
            measured_bend = np.asarray(
                self.sensor(time, self.modules.bend), dtype=float
            )
            # The controller must read sensors only: other attributes do not exist.
            state: Any = SimpleNamespace(time=time, measured_bend=measured_bend)
            self.modules.step(self.controller.step(state))
            signals = self.controller.signals()
            self.bend.append(measured_bend)
            self.duty.append(
                np.stack([signals["duty_plus"], signals["duty_minus"]], axis=-1)
            )
            self.events += self.controller.events()
        return self

    def event_texts(self, kind: str) -> list[str]:
        return [event.text for event in self.events if event.kind == kind]

    def amplitudes(self) -> np.ndarray:
        """Return the peak bends per period that begins with a fill, shape (periods, segments, 2).

        Segment j + 1 lags by a quarter of a period, and the − chamber by half a period.
        A fill that runs at the start counts as the first.
        """
        bend = np.array(self.bend)
        length = round(1 / self.controller.frequency / TICK)
        peaks = []
        for j in range(SEGMENTS):
            for side, sign in ((0, 1), (1, -1)):
                lag = (j / 4 + side / 2) % 1
                begin = round((lag if lag <= 0.5 else lag - 1) * length)
                ends = range(begin + length, len(bend) + 1, length)
                # The peak is read one tick after the end of the fill, well inside the
                # period.
                peaks.append(
                    [(sign * bend[max(end - length, 0) : end, j]).max() for end in ends]
                )
        whole = min(map(len, peaks))
        return np.array([peak[:whole] for peak in peaks]).T.reshape(whole, SEGMENTS, 2)
