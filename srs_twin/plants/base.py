"""Common interface of simulated snakes (`Plant`) and their state (`SnakeState`)."""

from __future__ import annotations

import reprlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from srs_twin.compute.arrays import (
    LARGEST_PLAUSIBLE,
    concatenate_records,
    first_implausible,
    is_plausible,
)
from srs_twin.compute.claims import Claimable
from srs_twin.errors import DivergedError, InputError, count_steps, format_exact
from srs_twin.io.provenance import short_digest
from srs_twin.io.saved_state import SavedState, Stateful
from srs_twin.pneumatics import Pneumatics, Schedule, make_pneumatics
from srs_twin.robot.rules import Violation
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World
from srs_twin.sensing import Sensor, make_sensor

Pose = tuple[float, float, float]
PlantState = SavedState

BASES = ("free", "clamped")
"""Ways to support a snake, either "free" on the floor or "clamped" at its head."""

_FLAT = frozenset({"planar", "obstacles", "floor"})
SUPPORTS = {
    "model 'complete'": _FLAT | {"skin"},
    "model 'simplified'": _FLAT,
    "model 'compliant'": _FLAT | {"skin"},
    "model 'quasistatic'": frozenset({"spatial", "skin"}),
    "contact 'loaded'": _FLAT | {"spatial", "skin", "tail", "objects", "steps"},
    "contact 'preloaded'": frozenset({"planar", "spatial", "obstacles"}),
}
"""Features of the robot and the world that each kind of plant supports."""

_TERRAIN = "terrain"
"""Name of the unsupported feature "spatial robot on an uneven or obstructed floor"."""


def refusals(
    option: str, value: str, spec: RobotSpec | None, world: World
) -> Iterator[Violation]:
    """Yield a violation for each robot or world feature that a plant does not support.

    The option "model" of the analytical plant or "contact" of the twin selects the kind
    of plant. Violations due to the robot have this option as their `parameter`.
    Violations due to the world have a section of the world, such as "obstacles", as
    their `parameter`. If `spec` is None, only the world is checked.
    """
    plant = f"{option} '{value}'"
    used = list(_features(option, spec, world))
    needed = {feature for feature, _, _ in used if feature != _TERRAIN}
    own = [
        name
        for name, supported in SUPPORTS.items()
        if name.startswith(option) and needed <= supported
    ]
    # If no value of this option supports all features, the twin with loaded contact
    # does.
    other = f"use {' or '.join(own) or 'the twin'}"
    for feature, parameter, words in used:
        remedy = other
        if feature == _TERRAIN:
            remedy = "use a level floor without obstacles"
        if feature not in SUPPORTS[plant]:
            yield Violation(parameter, f"{plant} does not support {words}; {remedy}")


def _features(
    option: str, spec: RobotSpec | None, world: World
) -> Iterator[tuple[str, str, str]]:
    if spec is not None:
        kind = "spatial" if spec.is_spatial else "planar"
        hint = "with" if spec.is_spatial else "without"
        words = f"the {kind} robot '{spec.name}' ({hint} `chamber.directions_deg`)"
        yield kind, option, words
        if spec.skin is not None:
            yield "skin", option, "a robot with skin"
        if spec.tail is not None:
            yield "tail", option, "a tail on two axles"
        if spec.is_spatial and (world.is_solid or world.uneven):
            words = "with obstacles, objects, steps or a slope"
            yield _TERRAIN, "world", f"the spatial robot '{spec.name}' {words}"
            return
    if world.has_obstacles:
        yield "obstacles", "obstacles", "obstacles"
    if world.objects:
        yield "objects", "objects", "movable objects"
    if world.floor.tilt:
        yield "floor", "floor", "a floor that slopes"
    if world.steps:
        yield "steps", "steps", "a floor with steps"


@dataclass(frozen=True)
class SnakeState:
    """Observable state of a snake at one instant, in SI units and the world frame.

    The z axis points up, and yaw is positive counter-clockwise. Connectors are numbered
    from the head. The same class stores a history, in which every field has a leading
    axis of samples.

    Attributes:
        time: time since the start of the run, s.
        com: position of the centre of mass, shape (2,), m.
        com_velocity: velocity of the centre of mass, shape (2,), m/s.
        heading: mean heading of the connectors, unwrapped, rad.
        position: positions of the connectors, shape (N, 2), m.
        connector_heading: heading of each connector, unwrapped, shape (N,), rad.
        bend: bend q_j = θ_j − θ_{j+1} of each segment, where θ_j is the heading of
            connector j, shape (segments,), rad.
        bend_rate: rate of change of each bend, shape (segments,), rad/s.
        pressure: gauge pressures in the + and − chambers of each segment, shape
            (segments, 2), Pa.
        valves: valve states just before this instant, shape (segments, 2).
        measured_bend: bends measured by the curvature sensors, shape (segments,), rad.
        contact_force: horizontal floor force on each connector, shape (N, 2), N. The
            analytical models report the instantaneous force. The twin reports the mean
            force since the previous sample, because its contact forces fluctuate
            between time steps.
        obstacle_force: horizontal force of obstacles and objects on each connector and
            the adjoining half segments, averaged since the previous sample, shape (N,
            2), N.
        torque: net moment that each segment exerts on the two connectors it joins,
            shape (segments,), N·m. For compliant bends, this moment is k (q_f − q) + c
            (q̇_f − q̇), with free bend q_f, stiffness k and damping c.
        work: work ∫ Σ T_j q̇_f,j dt of the compressed air since the start, with torque
            T_j and free bend q_f,j of segment j, J.
        internal_loss: energy dissipated in the material of the segments since the
            start, J. The planar analytical models report 0.
        pneumatic_energy: pneumatic energy drawn from the supply since the start, J (see
            `Pneumatics.pneumatic_energy`).
        qpos: generalised positions of the twin, shape (nq,). The array is empty for
            other plants.
    """

    time: float | np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    heading: float | np.ndarray
    position: np.ndarray
    connector_heading: np.ndarray
    bend: np.ndarray
    bend_rate: np.ndarray
    pressure: np.ndarray
    valves: np.ndarray
    measured_bend: np.ndarray
    contact_force: np.ndarray
    obstacle_force: np.ndarray
    torque: np.ndarray
    work: float | np.ndarray
    internal_loss: float | np.ndarray
    pneumatic_energy: float | np.ndarray
    qpos: np.ndarray

    def at(self, k: int | slice) -> SnakeState:
        """Return the state at index `k` of a history, or the history in a slice `k`."""
        return type(self)(*(values[k] for values in vars(self).values()))

    def make_read_only(self) -> None:
        """Let any later change of an array in this state raise a `ValueError`."""
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                # A keyword argument would take twice the time.
                value.setflags(False)  # type: ignore[call-arg]

    @staticmethod
    def history(states: Sequence[SnakeState]) -> SnakeState:
        """Concatenate states and histories into one history."""
        return concatenate_records(
            [state if np.ndim(state.time) else state.as_history() for state in states]
        )

    def as_history(self) -> SnakeState:
        """Return the state as a history of one sample."""
        return type(self)(*(np.asarray(value)[None] for value in vars(self).values()))


@dataclass(frozen=True)
class SpatialState(SnakeState):
    """State of a snake whose segments bend in two directions.

    The fields `bend`, `bend_rate`, `measured_bend` and `torque` have shape (segments,
    2). Their columns refer to bending to the left and to bending upwards. The fields
    `pressure` and `valves` have one column per chamber of a segment. The field
    `connector_heading` contains the headings of the connector axes projected onto the
    floor.

    Attributes:
        height: heights of the connectors above the floor, shape (N,), m.
        orientation: unit quaternions of the connector frames, real part first, shape
            (N, 4). In each frame, the x axis points forward and the z axis points up.
        load: vertical floor force on each connector, averaged since the previous
            sample, shape (N,), N.
    """

    height: np.ndarray
    orientation: np.ndarray
    load: np.ndarray


TICK_S = 0.02
"""Default control tick for a robot with a time unit of 1 (`robot.scale`), s."""


class Plant(Claimable, Stateful, ABC):
    """Abstract base class of simulated snakes that are driven by valve commands.

    Attributes:
        name: short name of the plant, "analytical" or "twin".
        tick: control tick, a multiple of the plant's time step, s.
        max_chunk_s: recommended maximum duration of a schedule passed to `play`, s.
        layout: valve layout, one of `pneumatics.valves.LAYOUTS`.
        state: latest returned state. Plants that cannot be saved do not have this
            attribute.
    """

    name: str
    spec: RobotSpec
    tick: float
    max_chunk_s: float = 1.0
    layout: str = "3/2"
    state: SnakeState
    world: World | None = None
    """Surroundings of the snake, or None for a level floor without obstacles."""
    has_contact: bool = False
    """Whether the contact forces of obstacles and objects are recorded."""
    objects: int = 0
    """Number of movable objects.

    The last entries of `qpos` are the x and y coordinates (m) and the heading (rad) of
    each object.
    """
    measures_air: bool = True
    """Whether pneumatic energy and valve openings are recorded."""
    has_internal_loss: bool = False
    """Whether the energy dissipated in the material of the segments is recorded."""

    @property
    def sample_step(self) -> float | None:
        """Smallest allowed interval between samples, s.

        Longer intervals must be multiples of the smallest interval. The value None
        means that any interval is allowed.
        """
        if type(self).advance is Plant.advance:
            return self.tick
        return None

    @abstractmethod
    def reset(self, *, pose: Pose = (0.0, 0.0, 0.0), seed: int = 0) -> SnakeState:
        """Reset the snake to a straight shape at rest with empty chambers.

        Args:
            pose: x and y coordinates of the centre of mass (m), and mean heading (rad).
            seed: random seed of the plant, for sensor noise.
        """

    def save(self) -> PlantState:
        """Return the complete state of the plant, which can be restored in any process.

        Raises:
            InputError: the class of the plant does not define `state_attributes`.
        """
        self.check_saveable(Plant, f"plant '{self.name}'")
        return PlantState(self.identity(), self.state_dict())

    def restore(self, state: PlantState) -> SnakeState:
        """Continue from a saved state.

        The results of `step` are bit-identical to those of the original run. Those of
        `play` may differ in the last digits, because it rounds the switching times in
        each chunk.

        Raises:
            InputError: the saved state belongs to another plant or robot.
        """
        state.check(f"plant '{self.name}'", self.identity())
        self.load_state_dict(state.content)
        return self.state

    def set_state(
        self, snake: SnakeState, *, yaw_rate: float = 0.0, seed: int = 0
    ) -> SnakeState:
        """Start at time 0 from a physical state, which may come from another plant.

        Args:
            snake: initial state, of which the fields `com`, `com_velocity`, `heading`,
                `bend`, `bend_rate` and `pressure` are used. The models `complete` and
                `simplified` compute the bend rates from the pressures.
            yaw_rate: rate of the mean heading, rad/s.
            seed: random seed of the plant, for sensor noise.

        Raises:
            InputError: the plant cannot start from this state, or can only start at
                rest.
        """
        raise InputError(f"plant '{self.name}' can only start straight and at rest")

    def identity(self) -> dict[str, object]:
        """Return the settings that a saved state must share, as JSON values."""
        return {**self.describe(), "robot_digest": short_digest(self.spec)}

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if cls.step is Plant.step and cls.advance is Plant.advance:
            raise TypeError(f"{cls.__name__} must override step or advance")

    def step(self, valves: np.ndarray) -> SnakeState:
        """Advance the simulation by one control tick.

        Args:
            valves: valve states of type int8, where +1 fills a chamber, 0 holds its air
                and −1 vents it. The shape is (segments, 2), with columns for the + and
                − chambers. An array of shape (slots, segments, 2) divides the tick into
                time slots of equal length.

        Raises:
            InputError: the shape of `valves` is wrong, or a valve state is not allowed.
            DivergedError: the state has become infinite, NaN or implausibly large.
        """
        return self.advance(valves, 1)[-1]

    def advance(self, valves: np.ndarray, samples: int) -> list[SnakeState]:
        """Advance by one control tick and return equally spaced states within the tick.

        The last state is at the end of the tick. Subclasses that cannot sample within a
        tick override `step` instead.

        Args:
            valves: valve states as in `step`.
            samples: number of returned states, at least 1. The interval tick / samples
                must be a multiple of the time step.

        Raises:
            InputError: the shape of `valves` is wrong, a valve state is not allowed, or
                the plant cannot provide so many samples.
            DivergedError: the state has become infinite, NaN or implausibly large.
        """
        if samples != 1:
            raise InputError(
                f"plant '{self.name}' provides one sample per tick, but {samples} are"
                f" requested; `record_hz` must be {format_exact(1 / self.tick)}"
                " divided by a whole number"
            )
        return [self.step(valves)]

    def play(self, schedule: Schedule, samples: int) -> SnakeState | None:
        """Run a schedule of valve commands without feedback.

        Args:
            schedule: valve states for a whole number of control ticks.
            samples: number of equally spaced samples. The last sample is at the end of
                the schedule.

        Returns:
            History of the samples, or None if the plant can only advance tick by tick.

        Raises:
            InputError: the valve layout does not allow a commanded state.
            DivergedError: the state has become infinite, NaN or implausibly large. The
                attribute `history` of the error holds the samples before the
                divergence.
        """
        return None

    def openings(self) -> np.ndarray:
        """Return how often each inlet valve has opened since `reset`.

        The array has the shape (segments, chambers per segment).
        """
        return np.zeros((self.spec.segments, self.spec.chambers), dtype=int)

    def describe(self) -> dict[str, object]:
        """Return the settings that are stored with a recorded run, as JSON values."""
        return {"plant": self.name, "robot": self.spec.name, "tick_s": self.tick}


class PneumaticPlant(Plant):
    """Base class of plants with air chambers and curvature sensors."""

    state_attributes: ClassVar[tuple[str, ...]] = (
        "_ticks",
        "seed",
        "pneumatics",
        "state",
    )

    pneumatics: Pneumatics
    sensor: Sensor
    seed: int

    def _make_pneumatics_and_sensor(
        self,
        pneumatics: str | Pneumatics,
        supply_pa: float | None,
        layout: str,
        sensor: str | Sensor,
    ) -> None:
        if supply_pa is None:
            self._supply = self.spec.supply.nominal
        else:
            self._supply = _checked_supply(supply_pa, self.spec)
        self.pneumatics = make_pneumatics(
            pneumatics, self.spec, supply_pa=self._supply, layout=layout
        )
        self.layout = self.pneumatics.layout
        self.sensor = make_sensor(sensor, self.spec)
        self.measures_air = self.pneumatics.measures_air

    @property
    def supply_pa(self) -> float:
        """Gauge supply pressure with which the plant was built, Pa."""
        return self._supply

    @property
    def has_coupled_air(self) -> bool:
        """Whether the pressures depend on the actual bends."""
        return self.pneumatics.depends_on_bend

    def identity(self) -> dict[str, object]:
        """Return the settings as in `Plant.identity`, but without stuck valves."""
        settings = super().identity()
        chambers = dict(self.pneumatics.describe())
        chambers.pop("stuck_valves", None)
        return settings | {"pneumatics": chambers, "supply_pa": self._supply}

    def advance(self, valves: np.ndarray, samples: int) -> list[SnakeState]:
        """See `Plant.advance`."""
        _check_samples(samples)
        history = self._simulate(
            self.pneumatics.schedule(valves, self.tick), 1, samples
        )
        states = [history.at(k) for k in range(samples)]
        self.state = states[-1]
        return states

    def play(self, schedule: Schedule, samples: int) -> SnakeState:
        """See `Plant.play`."""
        _check_samples(samples)
        self.pneumatics.check(schedule.states)
        ticks = count_steps("schedule", schedule.span, "tick", self.tick)
        history = self._simulate(schedule, ticks, samples)
        self.state = history.at(-1)
        return history

    def openings(self) -> np.ndarray:
        """See `Plant.openings`."""
        return self.pneumatics.openings

    def describe(self) -> dict[str, object]:
        """See `Plant.describe`."""
        air = {"pneumatics": self.pneumatics.describe(), "layout": self.layout}
        return super().describe() | air | {"sensor": self.sensor.describe()}

    @abstractmethod
    def _simulate(self, schedule: Schedule, ticks: int, samples: int) -> SnakeState:
        """Simulate a schedule of valid valve states and return the history."""


def _check_samples(samples: int) -> None:
    if samples < 1:
        raise InputError(f"`samples` {samples} is not allowed; it must be 1 or more")


_PA_PER_UNIT = {"kPa": 1e3, "bar": 1e5, "psi": 6894.76}
"""Values in Pa of pressure units that users may confuse with Pa."""

_LEAST_SUPPLY_FRACTION = 0.01
"""Smallest allowed supply pressure above 0, as a fraction of the nominal pressure."""


def _checked_supply(supply_pa: float, spec: RobotSpec) -> float:
    nominal = spec.supply.nominal
    if not 0 <= supply_pa < np.inf:
        raise InputError(
            f"`supply_pa` {supply_pa!r} is not allowed; it must be a finite pressure"
            " of at least 0 Pa"
        )
    if 0 < supply_pa < _LEAST_SUPPLY_FRACTION * nominal:
        # The message suggests the unit in which the number is closest to the nominal
        # pressure.
        unit = min(
            _PA_PER_UNIT,
            key=lambda unit: abs(np.log(supply_pa * _PA_PER_UNIT[unit] / nominal)),
        )
        raise InputError(
            f"`supply_pa` is in Pa, so {supply_pa:g} means {supply_pa / 1e3:g} kPa,"
            f" but {spec.name} needs about {nominal:g} Pa; did you mean"
            f" {supply_pa * _PA_PER_UNIT[unit]:g} ({supply_pa:g} {unit})?"
        )
    return supply_pa


def check_initial_state(snake: SnakeState, yaw_rate: float, segments: int) -> None:
    """Check that a snake can start from a given state and yaw rate (rad/s).

    Raises:
        InputError: a field has the wrong shape or a value that is not finite, or
            `snake` is a history.
    """
    shapes: dict[str, tuple[int, ...]] = {
        "com": (2,),
        "com_velocity": (2,),
        "heading": (),
        "bend": (segments,),
        "bend_rate": (segments,),
        "pressure": (segments, 2),
        "yaw_rate": (),
    }
    values = vars(snake) | {"yaw_rate": yaw_rate}
    for name, shape in shapes.items():
        array = np.asarray(values[name])
        if (
            array.dtype.kind not in "iuf"
            or array.shape != shape
            or not np.isfinite(array).all()
        ):
            if shape:
                allowed = f"finite numbers of shape {shape}"
            else:
                allowed = "a finite number"
            raise InputError(
                f"{name} {reprlib.repr(array.tolist())} is not allowed; it must be"
                f" {allowed}"
            )


_VALVE_STATE_RANGE = np.iinfo(np.int8)


def check_plausible(plant: str, state: SnakeState) -> SnakeState:
    """Return the given state or history if all its values are finite and plausible.

    Raises:
        DivergedError: a value is infinite, NaN or implausibly large. The attribute
            `history` of the error holds the earlier samples.
    """
    # All other fields are computed from the fields that are checked here. Scalars are
    # compared in Python, because a NumPy function takes as long for a scalar as for an
    # array.
    scalars: tuple[Any, ...] = (
        state.heading,
        state.work,
        state.pneumatic_energy,
    )
    if isinstance(state.time, np.ndarray):
        scalars_plausible = is_plausible(*scalars)
    else:
        scalars_plausible = all(abs(value) < LARGEST_PLAUSIBLE for value in scalars)
    if scalars_plausible and is_plausible(state.com, state.bend, state.pressure):
        return state
    history = SnakeState.history([state])
    for k, time in enumerate(np.asarray(history.time)):
        for name, values in vars(history).items():
            wrong = first_implausible(values[k])
            if wrong is not None:
                before = history.at(slice(k)) if k else None
                reason = f"`{name}` is {wrong:g}, a value that no snake can reach"
                raise DivergedError(plant, float(time), reason, history=before)
    return state


def check_before_step(plant: str, time: float, *state: float | np.ndarray) -> None:
    """Check that all values of a state are plausible before a time step.

    A time step may hide a value that has diverged. For example, MuJoCo replaces an
    infinite pressure by 0. The argument `time` is the end of the step, s.

    Raises:
        DivergedError: a value is infinite, NaN or implausibly large.
    """
    if not is_plausible(*state):
        wrong = first_implausible(np.hstack(state))
        reason = (
            f"the state before the step contains {wrong:g}, a value that no snake"
            " can reach"
        )
        raise DivergedError(plant, time, reason)


def check_commands(source: str, time: float, valves: object) -> None:
    """Check that valve commands are numbers in the range of int8.

    The argument `time` is the start of the control tick, s.

    Raises:
        InputError: the commands are not an array.
        DivergedError: a valve state is NaN, infinite or outside the range of int8.
    """
    try:
        states = np.asarray(valves)
    except ValueError as error:
        raise InputError(
            f"the valves {reprlib.repr(valves)} are not allowed; they must be an array"
            " of numbers"
        ) from error
    if states.dtype == np.int8 or states.dtype.kind not in "fiu":
        return
    diverged = states[
        ~((states >= _VALVE_STATE_RANGE.min) & (states <= _VALVE_STATE_RANGE.max))
    ]
    if diverged.size:
        raise DivergedError(
            source,
            time,
            f"the commanded value {diverged.flat[0]:g} is no valve state",
        )
