r"""ILC: iterative learning control of a gait (Section 5.1), one update a period and chamber.

The wave is that of the plain gait without offset (Eq. 13). Where it has a chamber fill, the valve is
pulse-width modulated with that chamber's duty, so that duties of 1 make it the plain gait, valve for valve.
Each chamber has a period of its own (`Cycles`); at its end the duty is corrected by what its segment bent to
that side (`Duties`, Eq. 32). The amplitude of a + chamber is the largest sensed bend in its period, that of a
− chamber the smallest one, negated. Steering is by the targets of the two sides (`targets`); where φ is also
read as Eq. 13's offset (`steering`), the side to turn to is filled for longer besides.

A number of periods are free, at duty 1; the one after them is recorded. Then A is the smallest of all
recorded amplitudes, which every chamber can reach, or a given one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.control.base import Controller, Readings
from srs_twin.control.duties import Cycles, Duties, checked_offset, targets
from srs_twin.control.gait import Gait
from srs_twin.control.module_faults import ModuleFaults
from srs_twin.control.pwm import PulseWidth
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState

K_PER_RAD = 0.3
"""Section 5.1, read as duty per rad."""
FREE_PERIODS = 2
CARRIER_HZ = 60.0
"""Section 5.3: the local control runs at around 60 Hz."""
LEAST_PULSES = 4
"""Carrier periods in a fill."""

SMALLEST = "smallest"
ON_FAULT = ("go_on", "stop")
CLOCKS = ("chamber", "common")
TARGETS = "targets"
STEERINGS = (TARGETS, "targets_and_wave")
_WORDS = {"on_fault": ON_FAULT, "clock": CLOCKS, "steering": STEERINGS}

_MOST_LOST = 0.5
"""Share of a period's readings that may be lost before its peak teaches nothing."""


class ILC(Controller):
    """Iterative learning control of a gait (module docstring).

    Attributes:
        frequency: of the gait, f, Hz.
        offset: φ, positive to the left, at most 0.3 either way; may be changed while it runs.
        amplitude: A, rad; None until it is known.
        duties: what was learnt; segments with a fault vent all the same.
        faults: what is wrong with the modules.
    """

    kind = "ilc"
    state_attributes = (
        *("_gait", "_pulses", "_cycles", "_readings", "duties", "faults", "amplitude"),
        *("_offset", "_peak", "_record", "_events", "_command", "_aim"),
    )
    frequency: float
    layouts = ("3/2",)

    def __init__(
        self,
        frequency: float,
        offset: float = 0.0,
        *,
        target: float | str = SMALLEST,
        k: float = K_PER_RAD,
        free_periods: int = FREE_PERIODS,
        carrier_hz: float = CARRIER_HZ,
        on_fault: str = "go_on",
        clock: str = "chamber",
        steering: str = TARGETS,
        phase: float = 0.0,
        phase_step: float | None = None,
    ) -> None:
        """Make the controller.

        Args:
            frequency: f, Hz.
            offset: φ.
            target: A, rad, or "smallest".
            k: duty per rad.
            free_periods: before the recorded one.
            carrier_hz: of the pulse-width modulation, Hz.
            on_fault: "go_on" without a module that has a fault, or "stop" the run.
            clock: "chamber", one for each, or "common", the text's single interrupt a period.
            steering: "targets", or "targets_and_wave": φ also acts on the wave, as in Eq. 13.
            phase: ψ of the wave, rad.
            phase_step: β, rad; None takes the robot's.

        Raises:
            InputError: a number out of its range, or too few pulses in a fill.
            UnknownNameError: a word that is none of those above.
        """
        for what, word in {"on_fault": on_fault, "clock": clock, "steering": steering}.items():
            if word not in _WORDS[what]:
                raise UnknownNameError(what, word, _WORDS[what])
        if isinstance(target, str) and target != SMALLEST:
            raise UnknownNameError("target", target, [SMALLEST])
        given = None if isinstance(target, str) else float(target)
        numbers = {"k": k, "carrier_hz": carrier_hz} | ({} if given is None else {"target": given})
        for name, value in numbers.items():
            check_positive(f"ilc {name}", value)
        if free_periods < 1:
            raise InputError(f"ilc free_periods {free_periods!r} is not allowed; it must be 1 or more")
        self._gait = Gait(frequency, phase=phase, phase_step=phase_step)
        if carrier_hz < 2 * LEAST_PULSES * frequency:
            raise InputError(
                f"ilc carrier_hz {carrier_hz:g} gives a fill at {frequency:g} Hz fewer than {LEAST_PULSES} "
                f"pulses; {2 * LEAST_PULSES * frequency:g} Hz or more would do"
            )
        self.frequency = frequency
        self._given, self._k, self._free, self._carrier = given, k, free_periods, carrier_hz
        self._on_fault, self._clock, self._steering = on_fault, clock, steering
        self._events: list[Event] = []
        self._offset = checked_offset(offset)
        self._prepare(0)

    @property
    def offset(self) -> float:
        """φ, the steering offset; it changes the targets, and the wave only if `steering` says so."""
        return self._offset

    @offset.setter
    def offset(self, value: float) -> None:
        self._offset = checked_offset(value)
        self.duties.forget()
        self._settle()

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: a tick that is no multiple of 0.1 ms, or too few of them in a period.
        """
        self._gait.reset(spec, tick)
        self._gait.offset = 0.0
        self._pulses = PulseWidth(self._carrier, tick, spec.segments, together=True, long_ticks=True)
        common = self._clock == "common"
        self._cycles = Cycles(self._gait.lag, self.frequency, tick, common=common)
        self._steer()
        self._last = np.unravel_index(self._cycles.begins.argmax(), self._cycles.begins.shape)
        self._prepare(spec.segments)

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valves of the coming tick, shape (slots, segments, 2)."""
        time = float(state.time)
        self._steer()
        self._events += self._readings.take(time, state.sensed)
        self._cycles.take(self._readings.value, self._readings.lost)
        if self.faults.testing:
            self.faults.look(time, self._readings.value)
            self._settle()
        if self._cycles.due(time):
            self._turn(time)
            self._settle()
        pulses = self._pulses.step(self._command)
        return np.minimum(self._gait.valves_at(time), pulses)

    def signals(self) -> dict[str, Any]:
        """Return duties, targets, the amplitudes measured last, the offset; NaN where there is none yet."""
        return {
            "duty_plus": self._command[:, 0],
            "duty_minus": self._command[:, 1],
            "target_plus": self._aim[:, 0],
            "target_minus": self._aim[:, 1],
            "amplitude_plus": self._peak[:, 0],
            "amplitude_minus": self._peak[:, 1],
            "offset": self._offset,
        }

    def events(self) -> list[Event]:
        """Return the events since the last call: updates, targets, duties at their bounds, faults."""
        events, self._events = self._events + self.faults.events(), []
        return events

    def describe(self) -> dict[str, Any]:
        """Return the settings, each chamber's clock, A, and the faults that were found."""
        return {
            "k_per_rad": self._k,
            "carrier_hz": self._carrier,
            "free_periods": self._free,
            "target": SMALLEST if self._given is None else self._given,
            "on_fault": self._on_fault,
            "clock": self._clock,
            "steering": self._steering,
            "fill_begins_s": self._cycles.begins.tolist(),
            "amplitude_rad": self.amplitude,
            "faults": list(self.faults.named),
        }

    def _steer(self) -> None:
        """Let the wave and the clocks of its fills follow φ."""
        if self._steering != TARGETS and self._gait.offset != self._offset:
            self._gait.offset = self._offset
            self._cycles.steer(math.asin(self._offset))

    def _prepare(self, segments: int) -> None:
        self._readings = Readings(segments)
        self.duties = Duties(segments, self._k)
        self.faults = ModuleFaults(segments, 1 / self.frequency)
        self.amplitude = self._given
        self._peak: np.ndarray = np.full((segments, 2), math.nan)
        self._record = np.full((2, segments, 2), math.nan)
        self._events.clear()
        self._settle()

    def _settle(self) -> None:
        """Set the duties that chambers get and what they are to reach; neither where a module is not at work.

        It comes after whatever changes them, so that a tick need not.
        """
        working = self.faults.working[:, None]
        sides = targets(math.nan if self.amplitude is None else self.amplitude, self._offset)
        self._command: np.ndarray = np.where(working, self.duties.value, 0.0)
        self._aim: np.ndarray = np.where(working, sides, math.nan)
        self.finished = self._on_fault == "stop" and bool(self.faults.named)

    def _turn(self, time: float) -> None:
        """Learn from the periods that have ended."""
        cycles, faults = self._cycles, self.faults
        ended = cycles.turn(time)
        if not ended.any():
            return
        faults.judge_sensors(time, ended, self._command, cycles)
        peak = np.where(cycles.lost <= _MOST_LOST, cycles.peak, math.nan)
        measured = ended & ~np.isnan(peak) & (cycles.since >= faults.back[:, None])
        self._peak = np.where(measured, peak, self._peak)
        if self.amplitude is None:
            self._choose(time, measured)
        if self.amplitude is None:
            return
        self._settle()
        faults.judge_valves(time, measured, self.duties.value, peak, self._aim)
        free = cycles.number <= self._free + 1
        taught = measured & ~free & faults.working[:, None]
        self._events += self.duties.learn(time, taught, peak, self._aim)
        self._events += self.duties.converged(time, faults.working)
        if ended[self._last]:
            number = int(cycles.number[self._last]) - 1
            self._events += self.duties.summary(time, number, faults.working)

    def _choose(self, time: float, measured: np.ndarray) -> None:
        """Record what was measured up to the period after the free ones; once all is there, choose A."""
        number, working = self._cycles.number, self.faults.working
        recorded = measured & ((number <= self._free + 2) | np.isnan(self._record[1]))
        self._record = np.where(recorded, np.stack([self._record[1], self._peak]), self._record)
        if (number[working] < self._free + 2).any() or np.isnan(self._record[1][working]).all():
            return
        self.faults.judge_record(time, self._record)
        working = self.faults.working
        if working.any():
            record = np.where(working[:, None], self._record[1], math.nan)
            j, side = np.unravel_index(np.nanargmin(record), record.shape)
            self.amplitude = float(record[j, side])
            text = f"target {self.amplitude:.4g} rad, the smallest amplitude recorded (segment {j + 1})"
            self._events.append(Event(time, "target", text))
