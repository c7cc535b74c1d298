"""Plant: what takes valve commands and moves. SnakeState: what can be seen of it at one moment.

`check_plausible` and `check_commands` find divergence that no integrator sees, within a tick: a number that
was wrong before a step need not hurt it, be it a place of 1e15 m, a pressure of infinity that the engine
takes for 0, or a valve state that is no number.
"""

from __future__ import annotations

import reprlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from srs_twin.compute.arrays import LARGEST_PLAUSIBLE, concatenate_records, first_implausible, is_plausible
from srs_twin.errors import DivergedError, InputError, count_steps, format_exact
from srs_twin.io.saved_state import SavedState, Stateful, short_digest
from srs_twin.pneumatics import Pneumatics, Schedule, make_pneumatics
from srs_twin.robot.spec import RobotSpec
from srs_twin.sensing import Sensor, make_sensor

Pose = tuple[float, float, float]
PlantState = SavedState

BASES = ("free", "clamped")
"""How a chain is held: not at all, or at its head, in the air, as on a bench."""


@dataclass(frozen=True)
class SnakeState:
    """One moment of a snake, SI, world frame (z up, yaw counter-clockwise), connectors head first.

    With a leading axis of samples on every field it is a history; `at` picks a moment of it.

    Attributes:
        time: s.
        com: centre of mass, shape (2,), m.
        com_velocity: shape (2,), m/s.
        heading: mean of the connector headings, unwrapped, rad.
        position: connectors, shape (N, 2), m.
        theta: connector headings, unwrapped, shape (N,), rad.
        bend: q_j = θ_j − θ_{j+1}, shape (segments,), rad.
        bend_rate: shape (segments,), rad/s.
        pressure: gauge pressure of the + and − chamber, shape (segments, 2), Pa.
        valves: valve states that led here, shape (segments, 2).
        sensed: what the curvature sensors say of `bend`, shape (segments,), rad.
        contact_force: horizontal floor force on each connector, shape (N, 2), N; momentary in the
            analytical model, the twin's is the mean since the last sample (contacts ripple).
        obstacle_force: horizontal force of all obstacles on each connector and the halves of its segments,
            shape (N, 2), N, the mean since the last sample; 0 on plants that obstacles do not touch.
        torque: net moment of each segment on the connectors it joins (air, spring and damper together),
            shape (segments,), N·m.
        work: that the torques have done since the start, ∫ Σ T_j q̇_j dt, J.
        internal_loss: part of it that segments have dissipated inside, without bending as a whole, J; 0 in
            the analytical models, whose segments have one bend each.
        air: work drawn from the air supply since the start, J, see `Pneumatics.air`.
        qpos: the twin's generalised positions, else empty.
    """

    time: float | np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    heading: float | np.ndarray
    position: np.ndarray
    theta: np.ndarray
    bend: np.ndarray
    bend_rate: np.ndarray
    pressure: np.ndarray
    valves: np.ndarray
    sensed: np.ndarray
    contact_force: np.ndarray
    obstacle_force: np.ndarray
    torque: np.ndarray
    work: float | np.ndarray
    internal_loss: float | np.ndarray
    air: float | np.ndarray
    qpos: np.ndarray

    def at(self, k: int | slice) -> SnakeState:
        """Return moment k of a history, or a part of it."""
        return SnakeState(*(getattr(self, name)[k] for name in _FIELDS))

    @staticmethod
    def history(parts: Sequence[SnakeState]) -> SnakeState:
        """Return the history of these histories, one after the other; a moment counts as one sample."""
        whole = [part if np.ndim(part.time) else part._sample() for part in parts]
        return concatenate_records(whole)

    def _sample(self) -> SnakeState:
        return SnakeState(*(np.asarray(getattr(self, name))[None] for name in _FIELDS))


_FIELDS = tuple(each.name for each in fields(SnakeState))  # asked for every tick


class Plant(Stateful, ABC):
    """A snake that obeys valve commands, analytical or in MuJoCo.

    Attributes:
        name: "analytical" or "twin".
        spec: the robot.
        tick: control tick, s; a multiple of the plant's time step.
        stretch: how much of a script it likes to follow at a time, s.
        layout: its valves, one of `pneumatics.valves.LAYOUTS`.
        state: the last moment that it returned; only of plants that can be saved.
    """

    name: str
    spec: RobotSpec
    tick: float
    stretch: float = 1.0
    layout: str = "3/2"
    state: SnakeState
    touches: bool = False
    """Whether there is anything that it can run into."""
    metered: bool = True
    """Whether it knows what air its chambers draw and how often they open; a trajectory says neither else."""
    has_internal_loss: bool = False
    """Whether segments can dissipate energy without bending as a whole; else no such column is recorded."""

    @property
    def sample_step(self) -> float | None:
        """Unit of the intervals between samples within a tick, s; None: any interval is allowed."""
        return self.tick if type(self).advance is Plant.advance else None

    @abstractmethod
    def reset(self, *, pose: Pose = (0.0, 0.0, 0.0), seed: int = 0) -> SnakeState:
        """Lay the snake straight, at rest, chambers empty.

        Args:
            pose: centre of mass x, y (m) and mean heading (rad).
            seed: for whatever is random in the plant (sensor noise).
        """

    def save(self) -> PlantState:
        """Return all that decides what comes next, for `restore` here or in another process.

        Raises:
            InputError: a plant that does not say what it remembers (`memory`).
        """
        self.check_saveable(Plant, f"plant '{self.name}'")
        return PlantState(self.identity(), self.state_dict())

    def restore(self, state: PlantState) -> SnakeState:
        """Go on from a saved state, with the same bits as the plant that it was taken from.

        Returns:
            The moment at which it was taken.

        Raises:
            InputError: a state of another plant or robot.
        """
        state.check(f"plant '{self.name}'", self.identity())
        self.load_state_dict(state.content)
        return self.state

    def place(self, snake: SnakeState, *, yaw_rate: float = 0.0, seed: int = 0) -> SnakeState:
        """Begin at time 0 from a physical state, which another plant may have been in.

        Args:
            snake: of it `com`, `com_velocity`, `heading`, `bend`, `bend_rate` and `pressure` count. Where the
                bends are what the chambers give (`complete`, `simplified`), their rates are, too.
            yaw_rate: of the mean heading, rad/s.
            seed: as in `reset`.

        Raises:
            InputError: a state that this plant cannot be in, or a plant that begins at rest only.
        """
        raise InputError(f"plant '{self.name}' begins straight and at rest only")

    def identity(self) -> dict[str, Any]:
        """Return what a saved state must share with the plant, JSON values."""
        return {**self.describe(), "robot_digest": short_digest(self.spec)}

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if cls.step is Plant.step and cls.advance is Plant.advance:
            raise TypeError(f"{cls.__name__} must say how it moves: override step or advance")

    def step(self, valves: np.ndarray) -> SnakeState:
        """Advance one tick.

        Args:
            valves: int8 of shape (segments, 2), +1 fill, 0 hold, −1 vent, columns + and − chamber; or
                (slots, segments, 2): equal parts of the tick, in order.

        Raises:
            InputError: as in `advance`.
            DivergedError: as in `advance`.
        """
        return self.advance(valves, 1)[-1]

    def advance(self, valves: np.ndarray, samples: int) -> list[SnakeState]:
        """Advance one tick and return that many equally spaced states, the last at its end.

        A plant overrides this, or `step` alone when it cannot look inside a tick.

        Args:
            valves: see `step`.
            samples: 1 or more; tick / samples must be a multiple of the time step.

        Raises:
            InputError: a wrong shape, a state other than −1, 0, +1, or more samples than the plant can give.
            DivergedError: the state is no longer finite and plausible.
        """
        if samples != 1:
            raise InputError(
                f"plant '{self.name}' gives one sample a tick, not {samples}; "
                f"record_hz {format_exact(1 / self.tick)} or a whole fraction of it would do"
            )
        return [self.step(valves)]

    def play(self, schedule: Schedule, samples: int) -> SnakeState | None:
        """Follow a schedule that no feedback changes; None from a plant that knows only ticks.

        Args:
            schedule: valve states over a whole number of ticks.
            samples: how many equally spaced samples to return, the last at its end.

        Returns:
            Their history.

        Raises:
            InputError: states that the valves cannot take.
            DivergedError: as in `advance`; its `history` holds the samples before.
        """
        return None

    def openings(self) -> np.ndarray:
        """Return how often each chamber's inlet has opened since `reset`, shape (segments, 2)."""
        return np.zeros((self.spec.segments, 2), dtype=int)

    def describe(self) -> dict[str, Any]:
        """Return the settings worth recording beside a trajectory (JSON values)."""
        return {"plant": self.name, "robot": self.spec.name, "tick_s": self.tick}


class PneumaticPlant(Plant):
    """A plant with the package's chambers and sensors; a subclass says how its bodies follow a schedule.

    Attributes:
        pneumatics: its chambers.
        sensor: of its bends.
        seed: of its noise.
    """

    state_attributes: ClassVar[tuple[str, ...]] = ("_ticks", "seed", "pneumatics", "state")

    pneumatics: Pneumatics
    sensor: Sensor
    seed: int

    def _equip(
        self, pneumatics: str | Pneumatics, supply_pa: float | None, layout: str, sensor: str | Sensor
    ) -> float:
        """Make the robot's chambers and sensors; return the supply pressure, Pa."""
        supply = self.spec.supply.nominal if supply_pa is None else supply_pa
        self.pneumatics = make_pneumatics(pneumatics, self.spec, supply_pa=supply, layout=layout)
        self.layout, self.sensor = self.pneumatics.layout, make_sensor(sensor, self.spec)
        self.metered = self.pneumatics.metered
        self._supply = supply
        return supply

    def identity(self) -> dict[str, Any]:
        """See `Plant.identity`; stuck valves may come and go."""
        own = super().identity()
        chambers = {key: value for key, value in own["pneumatics"].items() if key != "stuck_valves"}
        return own | {"pneumatics": chambers, "supply_pa": self._supply}

    def advance(self, valves: np.ndarray, samples: int) -> list[SnakeState]:
        """Advance one tick; see `Plant.advance`."""
        history = self._follow(self.pneumatics.schedule(valves, self.tick), 1, samples)
        moments = [history.at(k) for k in range(samples)]
        self.state = moments[-1]
        return moments

    def play(self, schedule: Schedule, samples: int) -> SnakeState:
        """Follow a schedule; see `Plant.play`."""
        self.pneumatics.check(schedule.states)
        ticks = count_steps("schedule", schedule.span, "tick", self.tick)
        history = self._follow(schedule, ticks, samples)
        self.state = history.at(-1)
        return history

    def openings(self) -> np.ndarray:
        """Return how often each chamber's inlet has opened, shape (segments, 2)."""
        return self.pneumatics.openings

    def describe(self) -> dict[str, Any]:
        """Return the settings worth recording."""
        air = {"pneumatics": self.pneumatics.describe(), "layout": self.layout}
        return super().describe() | air | {"sensor": self.sensor.describe()}

    @abstractmethod
    def _follow(self, schedule: Schedule, ticks: int, samples: int) -> SnakeState:
        """Follow a schedule of possible valve states over so many ticks; return so many samples."""


def check_moment(snake: SnakeState, yaw_rate: float, segments: int) -> None:
    """Refuse a state that no snake with so many segments can begin in, before anything has moved.

    Args:
        snake: see `Plant.place`.
        yaw_rate: rad/s.
        segments: of the plant.

    Raises:
        InputError: a value has another shape, or is not a finite number; or `snake` is a history.
    """
    shapes = {"com": (2,), "com_velocity": (2,), "heading": (), "bend": (segments,)}
    shapes |= {"bend_rate": (segments,), "pressure": (segments, 2)}
    values = {name: getattr(snake, name) for name in shapes} | {"yaw_rate": yaw_rate}
    for name, value in values.items():
        array, shape = np.asarray(value), shapes.get(name, ())
        if array.dtype.kind not in "iuf" or array.shape != shape or not np.isfinite(array).all():
            wanted = f"finite numbers of shape {shape}" if shape else "a finite number"
            raise InputError(f"{name} {reprlib.repr(array.tolist())} is not allowed; it must be {wanted}")


_STATES = np.iinfo(np.int8)


def check_plausible(plant: str, state: SnakeState) -> SnakeState:
    """Return a moment or a history that is plausible.

    Args:
        plant: the plant's name.
        state: what it says of itself.

    Raises:
        DivergedError: it is not plausible; the error's `history` holds the samples before.
    """
    # The other fields follow from these. Single numbers apart: to numpy each costs as much as an array.
    singles: tuple[Any, ...] = (state.heading, state.work, state.air)
    moment = not isinstance(state.time, np.ndarray)
    fine = all(abs(each) < LARGEST_PLAUSIBLE for each in singles) if moment else is_plausible(*singles)
    if fine and is_plausible(state.com, state.bend, state.pressure):
        return state
    history = SnakeState.history([state])
    for k, time in enumerate(np.asarray(history.time)):
        for each in fields(history):
            wrong = first_implausible(getattr(history, each.name)[k])
            if wrong is not None:
                before = history.at(slice(k)) if k else None
                what = f"{each.name} is {wrong:g}, which no snake reaches"
                raise DivergedError(plant, float(time), what, history=before)
    return state


def check_before(plant: str, time: float, *state: Any) -> None:
    """Refuse to go on from a state that no snake has.

    Args:
        plant: the plant's name.
        time: of the end of the next step, s.
        state: numbers and arrays.

    Raises:
        DivergedError: it is not plausible.
    """
    if not is_plausible(*state):
        wrong = first_implausible(np.concatenate([np.ravel(each) for each in state]))
        what = f"its state held {wrong:g} before the step, which no snake reaches"
        raise DivergedError(plant, time, what)


def check_commands(who: str, time: float, valves: Any) -> None:
    """Tell commands that have diverged from those that are merely wrong, which the chambers refuse.

    Args:
        who: gives the commands.
        time: of the tick for which they are, s.
        valves: as commanded, any shape.

    Raises:
        DivergedError: a valve state that is not a number, infinite, or too large for int8.
    """
    states = np.asarray(valves)
    if states.dtype == np.int8 or states.dtype.kind not in "fiu":
        return
    wild = states[~((states >= _STATES.min) & (states <= _STATES.max))]
    if wild.size:
        raise DivergedError(who, time, f"it commands the valve state {wild.flat[0]:g}")
