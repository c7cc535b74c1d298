"""Pneumatics: what turns valve commands into pressures and free bends. Trace: what the chambers did."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import asdict
from typing import Any, ClassVar, NamedTuple

import numpy as np

from srs_twin.compute.arrays import first_implausible, is_plausible
from srs_twin.errors import DivergedError, InputError, check_choice
from srs_twin.io.saved_state import Stateful
from srs_twin.pneumatics.valves import LAYOUTS, Schedule, StuckValve
from srs_twin.robot.spec import RobotSpec

Known = np.ndarray | None
"""Of each segment, shape (segments,); None where nobody knows it."""


class Trace(NamedTuple):
    """What the chambers did at given times; kernels take it as it is.

    Attributes:
        pressure: gauge, shape (times, segments, 2), Pa.
        bend: free bend, shape (times, segments), rad.
        bend_rate: its rate, shape (times, segments), rad/s.
        bend_acceleration: its acceleration, shape (times, segments), rad/s².
        valves: valve states that led there, shape (times, segments, 2).
        air: work drawn from the supply since `reset`, shape (times,), J.
    """

    pressure: np.ndarray
    bend: np.ndarray
    bend_rate: np.ndarray
    bend_acceleration: np.ndarray
    valves: np.ndarray
    air: np.ndarray

    @classmethod
    def empty(cls, times: int, segments: int) -> Trace:
        """Return a trace to be filled."""
        sides = times, segments, 2
        q, dq, ddq = (np.empty((times, segments)) for _ in range(3))
        return cls(np.empty(sides), q, dq, ddq, np.empty(sides, dtype=np.int8), np.empty(times))

    def at(self, rows: np.ndarray) -> Trace:
        """Return some of the times, by their numbers."""
        return Trace(*(column.take(rows, axis=0) for column in self))


class Pneumatics(Stateful, ABC):
    """Valves and chambers of a robot, and the bend that they would give a segment without load.

    A subclass says in `_follow` what the chambers do; commands reach it the valve delay later.

    Attributes:
        kind: short name.
        feels_bend: whether pressures depend on the actual bend, so that a plant whose bends are not the
            free ones must tell them to `advance`.
        felt_s: how long chambers that feel the bends may take these to go on as they do, s: bodies and
            chambers take turns at least that often.
        stiffness: most that closed chambers stiffen a segment by, N·m/rad.
        overshoot: how many times the supply's pressure a chamber may reach.
        pressure: gauge pressures now, shape (segments, 2), Pa.
        bend: free bends now, shape (segments,), rad.
        air: work drawn from the supply since `reset`, J: the supply's gauge pressure times the volume of
            air drawn from it, measured at the supply's pressure. Venting gives nothing back.
        metered: whether `air` and `openings` are known; they stay 0 else.
        openings: how often each chamber's inlet has opened, shape (segments, 2).
        valves: last valve states, shape (segments, 2).
        stuck: valves that do not obey, none at first.
        rest_bend: bends of free segments without pressure, shape (segments,), rad.
    """

    state_attributes: ClassVar[tuple[str, ...]] = (
        "pressure",
        "bend",
        "air",
        "_elapsed",
        "openings",
        "valves",
        "_coming",
        "stuck",
    )
    kind = "own"
    stuck: tuple[StuckValve, ...] = ()
    feels_bend = False
    overshoot = 1.0
    metered = True
    felt_s = math.inf
    stiffness = 0.0

    def __init__(self, spec: RobotSpec, *, layout: str, valve_delay_s: float = 0.0) -> None:
        check_choice("valve layout", layout, LAYOUTS)
        not_negative(valve_delay_s=valve_delay_s)
        self.layout, self._delay = layout, valve_delay_s
        self._segments = spec.segments
        self.rest_bend = spec.modules.array("bias")
        self.reset()

    def reset(self) -> None:
        """Empty all chambers and close all inlets."""
        shape = (self._segments, 2)
        self.pressure = np.zeros(shape)
        self.bend = self.rest_bend.copy()
        self.air = 0.0
        self._elapsed = 0.0
        self.openings = np.zeros(shape, dtype=int)
        self.valves = np.full(shape, -1, dtype=np.int8)
        self._coming = Schedule(self._delay, np.zeros(1), self.valves[None])

    def place(self, pressure: np.ndarray, bend: np.ndarray) -> None:
        """Begin with these pressures and free bends; valves and what is metered stay as they are.

        Args:
            pressure: gauge, shape (segments, 2), Pa.
            bend: shape (segments,), rad.

        Raises:
            InputError: chambers whose pressures are given, or pressures and bends that they do not reach.
        """
        raise InputError(f"pneumatics '{self.kind}' cannot begin with pressures of one's own")

    def resting(self) -> Trace:
        """Return a trace of one moment, now, taken to be at rest."""
        trace = Trace.empty(1, self._segments)
        trace.pressure[0], trace.bend[0], trace.valves[0] = self.pressure, self.bend, self.valves
        trace.bend_rate[:] = trace.bend_acceleration[:] = 0.0
        trace.air[:] = self.air
        return trace

    def now(self) -> Trace:
        """Return a trace of one moment, now, as the chambers go on with their valves as they are."""
        return self._follow(Schedule(0.0, np.zeros(1), self.valves[None]), np.zeros(1), None, None)

    def schedule(self, valves: np.ndarray, span: float) -> Schedule:
        """Return checked commands as a schedule.

        Args:
            valves: (segments, 2), or (slots, segments, 2), equal parts of the stretch.
            span: its length, s.

        Raises:
            InputError: a wrong shape, or a state that the valve layout does not have.
        """
        commands = np.asarray(valves)
        if commands.ndim == 2:
            commands = commands[None]
        if commands.ndim != 3 or commands.shape[1:] != (self._segments, 2):
            raise InputError(
                f"valves have shape {np.shape(valves)}; allowed: ({self._segments}, 2) or "
                f"(slots, {self._segments}, 2)"
            )
        self.check(commands)
        return Schedule.of_slots(commands.astype(np.int8), span)

    def check(self, states: np.ndarray) -> None:
        """Refuse states that the valve layout does not have.

        Raises:
            InputError: there is one.
        """
        known = LAYOUTS[self.layout]
        possible = states == known[0]
        for state in known[1:]:
            possible |= states == state
        if not possible.all():
            raise InputError(
                f"valve state {states[~possible][0]} is not possible with layout {self.layout}; "
                f"allowed: {known}"
            )

    def effective(self, schedule: Schedule) -> Schedule:
        """Return what the valves will do while these commands are given: these, late, but the stuck."""
        happening = schedule
        if self._delay:
            happening = self._coming.then(schedule).part(0.0, schedule.span)
        for valve in self.stuck:
            happening = happening.stuck(
                valve.since - self._elapsed, valve.segment - 1, valve.side, valve.state
            )
        return happening

    def advance(
        self, schedule: Schedule, times: np.ndarray, *, bend: Known = None, bend_rate: Known = None
    ) -> Trace:
        """Advance by a schedule's span and return what happened at `times`.

        Args:
            schedule: checked valve states, as commanded.
            times: ascending, within [0, span], s from its start.
            bend: the segments' actual bends at the start, shape (segments,), rad; only chambers that
                feel them take notice. None: the free ones, throughout.
            bend_rate: their rates, shape (segments,), rad/s; over the stretch they are taken to go on.

        Raises:
            DivergedError: pressures, free bends or air drawn are not finite and plausible.
        """
        self._refuse_implausible()
        if schedule.states.dtype != np.int8:
            schedule = schedule._replace(states=schedule.states.astype(np.int8))
        happening = self.effective(schedule)
        if self._delay:
            whole = self._coming.then(schedule)
            self._coming = whole.part(schedule.span, whole.span)
        trace = self._follow(happening, times, bend, bend_rate)
        before = np.concatenate([self.valves[None], happening.states[:-1]])
        self.openings = self.openings + ((happening.states == 1) & (before != 1)).sum(axis=0)
        self.valves = happening.states[-1]
        self._elapsed += schedule.span
        return trace

    def _refuse_implausible(self) -> None:
        """Refuse to go on from a state that no chambers have."""
        if is_plausible(self.pressure, self.bend, self.air):
            return
        for name, values in (("pressure", self.pressure), ("free bend", self.bend), ("air drawn", self.air)):
            wrong = first_implausible(values)
            if wrong is not None:
                what = f"{name} is {wrong:g}, which no chamber reaches"
                raise DivergedError(f"pneumatics '{self.kind}'", self._elapsed, what)

    @abstractmethod
    def _follow(self, schedule: Schedule, times: np.ndarray, bend: Known, bend_rate: Known) -> Trace:
        """Do what `advance` says, with the valve states as they are; set pressure, bend and air."""

    def regulate(self, supply_pa: float) -> None:
        """Set the supply's pressure from now on, also over a `reset`.

        Args:
            supply_pa: gauge, Pa; at most what the chambers were made for.

        Raises:
            InputError: more than that or below 0, or chambers without a regulator.
        """
        raise InputError(
            f"pneumatics '{self.kind}' has no supply that could be regulated; 'lag' and 'orifice' have"
        )

    def describe(self) -> dict[str, Any]:
        """Return the settings worth recording (JSON values)."""
        stuck = {"stuck_valves": [asdict(valve) for valve in self.stuck]} if self.stuck else {}
        return {"kind": self.kind, "valve_delay_s": self._delay} | stuck


def not_negative(**values: float) -> None:
    """Refuse numbers that are below 0 or not finite.

    Raises:
        InputError: the first of them, by its name.
    """
    for name, value in values.items():
        if not (math.isfinite(value) and value >= 0):
            raise InputError(f"{name} {value!r} is not allowed; it must be finite and 0 or more")
