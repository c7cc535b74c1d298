"""Base class for pneumatic models."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import asdict
from typing import ClassVar, NamedTuple

import numpy as np

from srs_twin.compute.arrays import first_implausible, is_plausible
from srs_twin.errors import DivergedError, InputError, check_choice
from srs_twin.io.saved_state import Stateful
from srs_twin.pneumatics.valves import LAYOUTS, Schedule, StuckValve
from srs_twin.robot.spec import RobotSpec

OptionalArray = np.ndarray | None
"""Array with one value per segment, shape (segments,), or None for unknown values."""


class Trace(NamedTuple):
    """States of the chambers at several times.

    Attributes:
        pressure: gauge pressures, shape (times, segments, 2), Pa.
        bend, bend_rate, bend_acceleration: free bends (rad) and their first two time
            derivatives (rad/s, rad/s²), shape (times, segments) each.
        valves: valve states immediately before each time, shape (times, segments, 2).
        pneumatic_energy: pneumatic energy consumed since `reset`, shape (times,), J.
    """

    pressure: np.ndarray
    bend: np.ndarray
    bend_rate: np.ndarray
    bend_acceleration: np.ndarray
    valves: np.ndarray
    pneumatic_energy: np.ndarray

    @classmethod
    def empty(
        cls, times: int, segments: int, chambers: int = 2, axes: tuple[int, ...] = ()
    ) -> Trace:
        """Return an uninitialised trace with additional `axes` in the bend arrays."""
        sides = times, segments, chambers
        q, dq, ddq = (np.empty((times, segments, *axes)) for _ in range(3))
        return cls(
            np.empty(sides), q, dq, ddq, np.empty(sides, dtype=np.int8), np.empty(times)
        )

    def at(self, rows: np.ndarray) -> Trace:
        """Return a trace that contains only the rows with the given indices."""
        return Trace(*(column.take(rows, axis=0) for column in self))


class Pneumatics(Stateful, ABC):
    """Base class for models of valves, chambers and free bends.

    The free bend is the bend of a segment without load. A subclass implements the
    physics in `_simulate`, which receives valve states that already include the valve
    delay and stuck valves.

    Attributes:
        kind: short name of the pneumatic model.
        depends_on_bend: whether the pressures depend on the actual bends. If so, a
            plant whose segments yield to loads must pass the actual bends to `advance`.
        coupling_step_s: maximum interval at which the model and the plant exchange
            pressures and bends, s.
        stiffness: maximum stiffness that closed chambers add to a segment, N·m/rad.
        max_pressure_ratio: maximum gauge pressure in a chamber divided by the gauge
            supply pressure.
        pressure: current gauge pressures, shape (segments, 2), Pa.
        bend: current free bends, shape (segments,), rad.
        pneumatic_energy: pneumatic energy consumed since `reset`, which is the gauge
            supply pressure times the volume of the consumed air at this pressure, J.
        line_energy: maximum energy p V of the air in the supply line, which the chambers
            can use in addition to `pneumatic_energy`, J.
        measures_air: whether `pneumatic_energy` and `openings` are meaningful.
        openings: number of times that each inlet has opened since `reset`, shape
            (segments, 2).
        valves: current valve states, shape (segments, 2).
        stuck: faults of valves that stick in one state.
        rest_bend: free bends at ambient pressure, shape (segments,), rad.
    """

    state_attributes: ClassVar[tuple[str, ...]] = (
        "pressure",
        "bend",
        "pneumatic_energy",
        "_elapsed",
        "openings",
        "valves",
        "_pending",
        "stuck",
    )
    kind = "own"
    stuck: tuple[StuckValve, ...] = ()
    depends_on_bend = False
    max_pressure_ratio = 1.0
    line_energy = 0.0
    measures_air = True
    coupling_step_s = math.inf
    stiffness = 0.0

    def __init__(
        self, spec: RobotSpec, *, layout: str, valve_delay_s: float = 0.0
    ) -> None:
        check_choice("valve layout", layout, LAYOUTS)
        check_not_negative(valve_delay_s=valve_delay_s)
        self.layout = layout
        self._delay = valve_delay_s
        self._segments = spec.segments
        self._chambers = spec.chambers
        self.rest_bend = spec.modules.array("bias")
        self.reset()

    def reset(self) -> None:
        """Vent all chambers to ambient pressure and close all inlets."""
        shape = (self._segments, self._chambers)
        self.pressure = np.zeros(shape)
        self.bend = self.rest_bend.copy()
        self.pneumatic_energy = 0.0
        self._elapsed = 0.0
        self.openings = np.zeros(shape, dtype=int)
        self.valves = np.full(shape, -1, dtype=np.int8)
        self._pending = Schedule(self._delay, np.zeros(1), self.valves[None])

    def set_state(self, pressure: np.ndarray, bend: np.ndarray) -> None:
        """Set the pressures and free bends, but not the valve states or the energy.

        Args:
            pressure: gauge pressures, shape (segments, 2), Pa.
            bend: free bends, shape (segments,), rad.

        Raises:
            InputError: the model does not support given pressures, or the chambers
                cannot reach the given values.
        """
        raise InputError(
            f"pneumatics '{self.kind}' cannot start with given pressures; use"
            " 'lag' or 'orifice'"
        )

    def rest_trace(self) -> Trace:
        """Return a one-row trace of the current state in which all bend rates are 0."""
        trace = self._empty_trace(1)
        trace.pressure[0] = self.pressure
        trace.bend[0] = self.bend
        trace.valves[0] = self.valves
        trace.bend_rate[:] = trace.bend_acceleration[:] = 0.0
        trace.pneumatic_energy[:] = self.pneumatic_energy
        return trace

    def _empty_trace(self, times: int) -> Trace:
        return Trace.empty(times, *self.pressure.shape, self.bend.shape[1:])

    def current_trace(self) -> Trace:
        """Return a one-row trace of the current state with the current bend rates."""
        return self._simulate(
            Schedule(0.0, np.zeros(1), self.valves[None]), np.zeros(1), None, None
        )

    def schedule(self, valves: np.ndarray, span: float) -> Schedule:
        """Check valve commands and convert them to a schedule.

        Args:
            valves: valve states, shape (segments, 2), or shape (slots, segments, 2) for
                equally long slots.
            span: duration of the schedule, s.

        Raises:
            InputError: the shape is wrong, or the valve layout does not support one of
                the states.
        """
        commands = np.asarray(valves)
        if commands.ndim == 2:
            commands = commands[None]
        is_complete = commands.shape[1:] == (self._segments, self._chambers)
        if not is_complete or len(commands) == 0:
            shape = f"{self._segments}, {self._chambers}"
            raise InputError(
                f"the valves have the shape {np.shape(valves)}, which is not allowed;"
                f" it must be ({shape}) or (slots, {shape}) with at least one slot"
            )
        self.check(commands)
        return Schedule.from_slots(commands.astype(np.int8), span)

    def check(self, states: np.ndarray) -> None:
        """Raise an `InputError` if the valve layout does not support a given state."""
        allowed = LAYOUTS[self.layout]
        possible = states == allowed[0]
        for state in allowed[1:]:
            possible |= states == state
        if not possible.all():
            raise InputError(
                f"valve state {states[~possible][0]} is not supported by layout"
                f" {self.layout}; use one of {allowed}"
            )

    def effective_schedule(self, schedule: Schedule) -> Schedule:
        """Apply the valve delay and stuck valves to a schedule of valve commands."""
        effective = schedule
        if self._delay:
            effective = self._pending.followed_by(schedule).slice(0.0, schedule.span)
        for valve in self.stuck:
            effective = effective.with_stuck_valve(
                valve.since - self._elapsed, valve.segment - 1, valve.side, valve.state
            )
        return effective

    def advance(
        self,
        schedule: Schedule,
        times: np.ndarray,
        *,
        bend: OptionalArray = None,
        bend_rate: OptionalArray = None,
    ) -> Trace:
        """Simulate a schedule and return the states of the chambers at given times.

        Args:
            schedule: valve commands, as returned by `schedule`.
            times: ascending times, measured from the start of the schedule and not
                later than its end, s.
            bend: actual bends at the start of the schedule, shape (segments,), rad, or
                None if they equal the free bends.
            bend_rate: constant rates of the actual bends during the schedule, shape
                (segments,), rad/s.

        Raises:
            DivergedError: a pressure, a free bend or the consumed energy is not finite
                or is implausible.
        """
        self._check_state()
        if schedule.states.dtype != np.int8:
            schedule = schedule._replace(states=schedule.states.astype(np.int8))
        effective = self.effective_schedule(schedule)
        if self._delay:
            joined = self._pending.followed_by(schedule)
            self._pending = joined.slice(schedule.span, joined.span)
        trace = self._simulate(effective, times, bend, bend_rate)
        before = np.concatenate([self.valves[None], effective.states[:-1]])
        self.openings = self.openings + ((effective.states == 1) & (before != 1)).sum(
            axis=0
        )
        self.valves = effective.states[-1]
        self._elapsed += schedule.span
        return trace

    def _check_state(self) -> None:
        if is_plausible(self.pressure, self.bend, self.pneumatic_energy):
            return
        for name, values in (
            ("pressure", self.pressure),
            ("free bend", self.bend),
            ("air drawn", self.pneumatic_energy),
        ):
            wrong = first_implausible(values)
            if wrong is not None:
                reason = f"the {name} is {wrong:g}, a value that no chamber can reach"
                raise DivergedError(f"pneumatics '{self.kind}'", self._elapsed, reason)

    @abstractmethod
    def _simulate(
        self,
        schedule: Schedule,
        times: np.ndarray,
        bend: OptionalArray,
        bend_rate: OptionalArray,
    ) -> Trace:
        """Simulate actual valve states, and update pressures, free bends and energy."""

    def set_supply_pressure(self, supply_pa: float) -> None:
        """Set the supply pressure, which also remains in effect after `reset`.

        Args:
            supply_pa: gauge supply pressure, Pa, not higher than the value given to the
                constructor.

        Raises:
            InputError: the pressure is out of range, or the model has no pressure
                regulator.
        """
        raise InputError(
            f"pneumatics '{self.kind}' has no pressure regulator; use 'lag' or"
            " 'orifice'"
        )

    def describe(self) -> dict[str, object]:
        """Return the settings that are recorded with a run, as JSON values."""
        settings: dict[str, object] = {
            "kind": self.kind,
            "valve_delay_s": self._delay,
        }
        if self.stuck:
            settings["stuck_valves"] = [asdict(valve) for valve in self.stuck]
        return settings


def check_supply(supply_pa: float, max_pa: float) -> None:
    """Raise an `InputError` if a supply pressure (Pa) is not within [0, `max_pa`]."""
    if not 0 <= supply_pa <= max_pa:
        raise InputError(
            f"supply pressure {supply_pa!r} Pa is not allowed; it must be between 0"
            f" and {max_pa:g} Pa, the supply pressure that was given to the"
            " constructor"
        )


def check_not_negative(**values: float) -> None:
    """Raise an `InputError` if a number is negative or not finite."""
    for name, value in values.items():
        if not (math.isfinite(value) and value >= 0):
            raise InputError(
                f"`{name}` {value!r} is not allowed; it must be finite and at least 0"
            )
