"""Whole-body grasp, in which the tail curls around an object and the front drags it.

A grasp has three phases:

1. *Curl.* The holding segments at the tail bend towards the object, and all other
   segments vent. The duty cycle of the holding segments rises gradually from 0 to 1,
   because a fast curl would push the object away.
2. *Drag.* The holding segments stay filled, and the other segments perform the gait of
   Eq. 13.
3. *Release.* The holding segments vent, and the other segments continue the gait. The
   release begins after a given time, or after the centre of mass has moved a given
   distance.

In the mode "open_loop", the drag begins at a given time. In the mode "sensed", the drag
begins when the bend readings of the holding segments have settled, or at a given time
at the latest. If the holding segments then bend as far as without an object, the tail
has missed the object, and the run ends.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.control.base import Controller, SensorReadings
from srs_twin.control.gait import Gait
from srs_twin.errors import InputError, check_choice
from srs_twin.pneumatics.chambers import largest_bend
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState

MODES = ("open_loop", "sensed")
SIDES = ("left", "right")
_SLOTS = 20
"""Number of time slots per control tick, which limits the duty cycle resolution."""
_SETTLED_RAD_PER_S = 0.3
"""Bend rate below which the bend readings are considered settled, rad/s."""
_SETTLING_S = 0.3
"""Time interval over which the bend rate is averaged, s."""
_GRIP_RAD = 0.1
"""Minimum value of `Grasp.grip` if the tail encloses an object, rad."""


class Phase(IntEnum):
    """Phase of a grasp."""

    CURL = 1
    DRAG = 2
    RELEASE = 3


def _reached(value: float, limit: float | None) -> bool:
    return limit is not None and value >= limit


def check_hold(hold: int, spec: RobotSpec) -> None:
    """Check the number of holding segments.

    Raises:
        InputError: there is no holding segment, or fewer than two segments remain for
            crawling.
    """
    if not 1 <= hold <= spec.segments - 2:
        raise InputError(
            f"{hold} holding segments are not allowed; {spec.name} has {spec.segments}"
            " segments, of which at least two must crawl"
        )


def check_release(mode: str, drag_m: float | None) -> None:
    """Check that the grasp mode allows a drag distance (m).

    Raises:
        InputError: a drag distance is given in the mode "open_loop".
    """
    if drag_m is not None and mode == "open_loop":
        raise InputError(
            "`drag_m` is allowed only in the mode 'sensed'; for mode 'open_loop', set"
            " `release_after_s` instead"
        )


def hold_with(valves: np.ndarray, hold: int, duty: float, pulses: int = 1) -> None:
    """Set the valve states of the holding segments for a given duty cycle.

    Args:
        valves: valve states in one control tick, changed in place, shape (slots,
            segments, 2).
        hold: number of holding segments at the tail.
        duty: duty cycle from −1 to 1, which fills the left chambers if it is positive
            and the right chambers if it is negative.
        pulses: number of equal pulses per tick.
    """
    slots = len(valves) // pulses
    chamber = 0 if duty >= 0 else 1
    valves[:, -hold:] = -1
    for pulse in range(pulses):
        begin = pulse * slots
        valves[begin : begin + round(abs(duty) * slots), -hold:, chamber] = 1


class Grasp(Controller):
    """Controller that grasps an object next to the tail and drags it.

    Attributes:
        phase: current phase of the grasp.
        grip: free bend at the nominal pressure minus the mean measured bend of the
            holding segments, rad.
        duty: duty cycle of the holding segments, from −1 (right chambers) to 1 (left
            chambers).
    """

    kind = "grasp"
    state_attributes = (
        "finished",
        "phase",
        "grip",
        "duty",
        "_since",
        "_start",
        "_past",
        "_readings",
        "_events",
    )
    layouts = ("3/2", "in_out")
    frequency: float

    def __init__(
        self,
        frequency: float,
        *,
        mode: str = "sensed",
        side: str = "left",
        hold: int = 4,
        curl_s: float = 1.5,
        drag_after_s: float = 2.0,
        release_after_s: float | None = None,
        drag_m: float | None = None,
        phase_step: float | None = None,
    ) -> None:
        """Create the controller.

        Args:
            frequency: gait frequency of the dragging segments, Hz.
            mode: grasp mode, one of `MODES`.
            side: side of the body on which the object lies, one of `SIDES`.
            hold: number of holding segments at the tail.
            curl_s: time in which the duty cycle of the holding segments rises from 0 to
                1, s.
            drag_after_s: start time of the drag in the mode "open_loop", or latest
                start time of the drag in the mode "sensed", s.
            release_after_s: time from the start of the drag to the release, or None for
                no time limit, s.
            drag_m: drag distance after which the object is released, or None for no
                limit, m. The mode "open_loop" requires None.
            phase_step: phase lag of the gait per segment, by default
                `RobotSpec.phase_step`, rad.

        Raises:
            InputError: the mode or the side is unknown, or a drag distance is given in
                the mode "open_loop".
        """
        check_choice("mode", mode, MODES)
        check_choice("side", side, SIDES)
        check_release(mode, drag_m)
        self.frequency = frequency
        self.mode = mode
        self.side = side
        self.hold = hold
        self.curl_s = curl_s
        self.drag_after_s = drag_after_s
        self.release_after_s = release_after_s
        self.drag_m = drag_m
        self._gait = Gait(frequency, phase_step=phase_step)

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: the number of holding segments does not suit the robot.
        """
        check_hold(self.hold, spec)
        self._gait.reset(spec, tick)
        self._tick = tick
        self._segments = spec.segments
        self._free_bend = largest_bend(spec, spec.supply.nominal)
        self.phase = Phase.CURL
        self.grip = 0.0
        self.duty = 0.0
        self.finished = False
        self._since = 0.0
        self._start = np.zeros(2)
        self._past: list[np.ndarray] = []
        self._readings = SensorReadings(spec.segments)
        self._events = list[Event]()

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valve states for the next tick, shape (slots, segments, 2)."""
        time = float(state.time)
        self._events += self._readings.update(time, state.measured_bend)
        toward = 1.0 if self.side == "left" else -1.0
        bends = toward * self._readings.value[-self.hold :]
        self._past = [*self._past, bends][-max(round(_SETTLING_S / self._tick), 2) :]
        self.grip = float(self._free_bend - bends.mean())
        self._change_phase(time, np.asarray(state.com))
        valves = np.asarray(self._gait.valves_at(time - self._since))
        if valves.ndim == 2:
            valves = np.repeat(valves[None], _SLOTS, axis=0)
        if self.phase is Phase.CURL:
            valves[:] = -1
            duty = min(time / self.curl_s, 1.0)
        else:
            duty = float(self.phase is Phase.DRAG)
        self.duty = toward * duty
        hold_with(valves, self.hold, self.duty)
        return valves

    def _change_phase(self, time: float, com: np.ndarray) -> None:
        if self.finished:
            return
        if self.phase is Phase.CURL and time >= self.curl_s:
            change = np.abs(self._past[-1] - self._past[0]).max()
            rate = change / (self._tick * (len(self._past) - 1))
            is_sensed = self.mode == "sensed"
            has_settled = is_sensed and rate < _SETTLED_RAD_PER_S
            if not (has_settled or time >= self.drag_after_s):
                return
            if is_sensed and self.grip < _GRIP_RAD:
                missed = "the tail has curled without enclosing an object"
                self._events.append(Event(time, "grasp_missed", missed))
                self.finished = True
            else:
                self._begin(Phase.DRAG, time, com)
        elif self.phase is Phase.DRAG:
            moved = np.hypot(*(com - self._start))
            if _reached(time - self._since, self.release_after_s) or _reached(
                moved, self.drag_m
            ):
                self._begin(Phase.RELEASE, time, com)

    def _begin(self, phase: Phase, time: float, com: np.ndarray) -> None:
        if phase is Phase.DRAG:
            self._since = time
            self._start = com.copy()
        self.phase = phase
        name = phase.name.lower()
        text = (
            f"{name} begins; the holding segments bend {self.grip:.2g} rad less than"
            " without an object"
        )
        self._events.append(Event(time, "grasp", text))

    def signals(self) -> dict[str, float]:
        """Return the number of the grasp phase, and the grip (rad)."""
        return {"grasp_phase": float(self.phase), "grip": self.grip}
