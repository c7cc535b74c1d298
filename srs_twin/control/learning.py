"""Iterative learning control of a gait (Section 5.1).

The controller modifies an open-loop gait without steering offset (Eq. 13). While the
gait fills a chamber, the valve of the chamber is pulse-width modulated. If all duty
cycles are 1, the valves switch as in the open-loop gait.

At the end of each period of a chamber (`ChamberPeriods`), the measured amplitude is
used to correct the duty cycle of the chamber (`Duties`, Eq. 32). For a + chamber,
the amplitude is the maximum bend reading in the period. For a − chamber, the amplitude
is the negated minimum bend reading. For steering, the chambers on the left and on the
right have different target amplitudes (`targets`). With `steering="targets_and_wave"`,
the steering offset φ also changes the wave as in Eq. 13. The chambers on the inner side
of the turn then fill for a longer time.

During the first gait periods, called free periods, all duty cycles are 1. The target
amplitude A is either a given value or the minimum amplitude in the next period. Every
chamber can reach this minimum.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.control.base import Controller, SensorReadings
from srs_twin.control.duties import ChamberPeriods, Duties, targets, validated_offset
from srs_twin.control.gait import Gait
from srs_twin.control.module_faults import ModuleFaults
from srs_twin.control.pwm import PulseWidthModulator
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState

K_PER_RAD = 0.3
"""Learning gain k of Section 5.1, interpreted as a change in duty cycle, 1/rad."""
FREE_PERIODS = 2
"""Number of free gait periods, in which all duty cycles are 1."""
CARRIER_HZ = 60.0
"""Carrier frequency of the pulse-width modulation, Hz (about 60 Hz in Section 5.3)."""
MIN_PULSES = 4
"""Minimum number of carrier periods while a chamber fills."""

SMALLEST = "smallest"
"""Value of the argument `target` that selects the minimum recorded amplitude."""
ON_FAULT = ("go_on", "stop")
TARGETS = "targets"
"""Value of the argument `steering` for which φ does not change the wave."""
STEERINGS = (TARGETS, "targets_and_wave")

_MAX_LOST = 0.5
"""Maximum fraction of lost readings in a period with a valid amplitude."""


class ILC(Controller):
    """Controller that iteratively learns the duty cycles of a gait.

    Attributes:
        offset: steering offset φ, between −0.3 and 0.3, which may be changed during a
            run.
        amplitude: target amplitude A, or None until it is known, rad.
        duties: learnt duty cycles, which do not apply to faulty segments or to segments
            under test.
        faults: detector of dead sensors and stuck valves.
    """

    kind = "ilc"
    state_attributes = (
        *("_gait", "_pulses", "_periods", "_readings", "duties", "faults", "amplitude"),
        *("_offset", "_amplitudes", "_record", "_events", "_command", "_targets"),
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
        steering: str = TARGETS,
        phase: float = 0.0,
        phase_step: float | None = None,
    ) -> None:
        """Create the controller.

        Args:
            frequency: gait frequency f, Hz.
            offset: steering offset φ, positive to the left.
            target: target amplitude A, rad, or "smallest" for the minimum recorded
                amplitude.
            k: learning gain k, 1/rad.
            free_periods: number of gait periods before the amplitudes are recorded.
            carrier_hz: carrier frequency of the pulse-width modulation, Hz.
            on_fault: action after a fault is detected, either "go_on" to continue
                without the faulty segment or "stop" to end the run.
            steering: "targets" if φ changes only the target amplitudes, or
                "targets_and_wave" if φ also changes the wave of Eq. 13.
            phase: phase ψ of the wave at time 0, rad.
            phase_step: phase lag β per segment, by default `RobotSpec.phase_step`, rad.

        Raises:
            InputError: an argument is out of range, or the carrier frequency is too low
                for the gait frequency.
            UnknownNameError: `target`, `on_fault` or `steering` has an unknown value.
        """
        if on_fault not in ON_FAULT:
            raise UnknownNameError("on_fault", on_fault, ON_FAULT)
        if steering not in STEERINGS:
            raise UnknownNameError("steering", steering, STEERINGS)
        self._fixed_target: float | None = None
        if not isinstance(target, str):
            check_positive("ilc target", target)
            self._fixed_target = float(target)
        elif target != SMALLEST:
            raise UnknownNameError("target", target, [SMALLEST])
        check_positive("ilc k", k)
        check_positive("ilc carrier_hz", carrier_hz)
        if free_periods < 1:
            raise InputError(
                f"ilc `free_periods` {free_periods!r} is not allowed; it must be 1 or"
                " more"
            )
        self._gait = Gait(frequency, phase=phase, phase_step=phase_step)
        lowest_hz = 2 * MIN_PULSES * frequency
        if carrier_hz < lowest_hz:
            raise InputError(
                f"ilc `carrier_hz` {carrier_hz:g} gives fewer than {MIN_PULSES} pulses"
                f" per fill at a gait frequency of {frequency:g} Hz; it must be at"
                f" least {lowest_hz:g}"
            )
        self.frequency = frequency
        self._k = k
        self._free_periods = free_periods
        self._carrier_hz = carrier_hz
        self._on_fault = on_fault
        self._steering = steering
        self._offset = validated_offset(offset)
        self._initialise(0)

    @property
    def offset(self) -> float:
        """Steering offset φ, positive to the left."""
        return self._offset

    @offset.setter
    def offset(self, value: float) -> None:
        self._offset = validated_offset(value)
        self.duties.restart_convergence()
        self._set_commands()

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: the control tick is too long for the gait frequency.
        """
        self._gait.reset(spec, tick)
        self._gait.offset = 0.0
        self._pulses = PulseWidthModulator(
            self._carrier_hz,
            tick,
            spec.segments,
            aligned=True,
            allow_long_ticks=True,
            scale=spec.scale,
        )
        self._periods = ChamberPeriods(self._gait.phase_lag, self.frequency, tick)
        self._steer_wave()
        starts = self._periods.fill_starts
        self._last_chamber = np.unravel_index(starts.argmax(), starts.shape)
        self._initialise(spec.segments)

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valve states for the next tick, shape (slots, segments, 2)."""
        time = float(state.time)
        self._steer_wave()
        self._events += self._readings.update(time, state.measured_bend)
        self._periods.update(self._readings.value, self._readings.lost)
        if self.faults.tested.any():
            self.faults.update_tests(time, self._readings.value)
            self._set_commands()
        if self._periods.due(time):
            self._learn(time)
            self._set_commands()
        pulses = self._pulses.step(self._command)
        valves: np.ndarray = np.minimum(self._gait.valves_at(time), pulses)
        return valves

    def signals(self) -> dict[str, float | np.ndarray]:
        """Return the duty cycles, the amplitudes (rad) and the steering offset.

        Unknown amplitudes are NaN.
        """
        return {
            "duty_plus": self._command[:, 0],
            "duty_minus": self._command[:, 1],
            "target_plus": self._targets[:, 0],
            "target_minus": self._targets[:, 1],
            "amplitude_plus": self._amplitudes[:, 0],
            "amplitude_minus": self._amplitudes[:, 1],
            "offset": self._offset,
        }

    def events(self) -> list[Event]:
        """Return the events since the last call, including detected faults."""
        return super().events() + self.faults.events()

    def describe(self) -> dict[str, object]:
        """Return the settings, the target amplitude and the detected faults."""
        return {
            "k_per_rad": self._k,
            "carrier_hz": self._carrier_hz,
            "free_periods": self._free_periods,
            "target": SMALLEST if self._fixed_target is None else self._fixed_target,
            "on_fault": self._on_fault,
            "steering": self._steering,
            "fill_begins_s": self._periods.fill_starts.tolist(),
            "amplitude_rad": self.amplitude,
            "faults": list(self.faults.detected),
        }

    def _steer_wave(self) -> None:
        if self._steering != TARGETS and self._gait.offset != self._offset:
            self._gait.offset = self._offset
            self._periods.steer(math.asin(self._offset))

    def _initialise(self, segments: int) -> None:
        self._readings = SensorReadings(segments)
        self.duties = Duties(segments, self._k)
        self.faults = ModuleFaults(segments, 1 / self.frequency)
        self.amplitude = self._fixed_target
        self._amplitudes: np.ndarray = np.full((segments, 2), math.nan)
        self._record = np.full((2, segments, 2), math.nan)
        self._events: list[Event] = []
        self._set_commands()

    def _set_commands(self) -> None:
        working = self.faults.working[:, None]
        amplitude = math.nan if self.amplitude is None else self.amplitude
        sides = targets(amplitude, self._offset)
        self._command: np.ndarray = np.where(working, self.duties.value, 0.0)
        self._targets: np.ndarray = np.where(working, sides, math.nan)
        self.finished = self._on_fault == "stop" and bool(self.faults.detected)

    def _learn(self, time: float) -> None:
        periods = self._periods
        faults = self.faults
        ended = periods.advance(time)
        if not ended.any():
            return
        faults.check_sensors(time, ended, self._command, periods)
        peak = np.where(periods.lost <= _MAX_LOST, periods.peak, math.nan)
        # Ignore periods that began before the end of a valve test, because both
        # chambers of the segment vent during the test.
        measured = (
            ended & ~np.isnan(peak) & (periods.started >= faults.resumed[:, None])
        )
        self._amplitudes = np.where(measured, peak, self._amplitudes)
        if self.amplitude is None:
            self._record_amplitudes(time, measured)
        if self.amplitude is None:
            return
        self._set_commands()
        faults.check_valves(time, measured, self.duties.value, peak, self._targets)
        free = periods.number <= self._free_periods + 1
        updated = measured & ~free & faults.working[:, None]
        self._events += self.duties.learn(time, updated, peak, self._targets)
        self._events += self.duties.converged(time, faults.working)
        # Report once per gait period, when the chamber that fills last ends its period.
        if ended[self._last_chamber]:
            number = int(periods.number[self._last_chamber]) - 1
            self._events += self.duties.summary(time, number, faults.working)

    def _record_amplitudes(self, time: float, measured: np.ndarray) -> None:
        number = self._periods.number
        working = self.faults.working
        recorded = measured & (
            (number <= self._free_periods + 2) | np.isnan(self._record[1])
        )
        self._record = np.where(
            recorded, np.stack([self._record[1], self._amplitudes]), self._record
        )
        too_early = (number[working] < self._free_periods + 2).any()
        if too_early or np.isnan(self._record[1][working]).all():
            return
        self.faults.check_amplitudes(time, self._record)
        working = self.faults.working
        if working.any():
            record = np.where(working[:, None], self._record[1], math.nan)
            j, side = np.unravel_index(np.nanargmin(record), record.shape)
            self.amplitude = float(record[j, side])
            text = (
                f"target {self.amplitude:.4g} rad, the smallest amplitude recorded"
                f" (segment {j + 1})"
            )
            self._events.append(Event(time, "target", text))
