"""Start of a scenario: where the snake is at first and how it moves, told by keys or by an earlier run."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from srs_twin.errors import InputError
from srs_twin.io.files import display_path
from srs_twin.plants.base import Plant, SnakeState
from srs_twin.robot.sourced import to_si
from srs_twin.robot.world import Pose
from srs_twin.scenario.fields import FilePath, Section, quantity
from srs_twin.trajectory import Trajectory

_MOST = 64
Speed = Annotated[float, Field(ge=-10.0, le=10.0)]
Bend = Annotated[float, Field(ge=-3.2, le=3.2)]
BendRate = Annotated[float, Field(ge=-100.0, le=100.0)]
Gauge = Annotated[float, Field(ge=0.0, le=1000.0)]
_PER_SEGMENT = ("bend_rad", "bend_rate_rad_s", "pressure_kpa")
_AT_REST = ("velocity_m_s", "yaw_rate_rad_s", *_PER_SEGMENT)


class StartFile(Section):
    """Where the snake is at first and how it moves: straight and at rest where nothing else is said."""

    constructors = (Pose,)

    x_m: float = quantity(-1000.0, 1000.0, 0.0)
    """x of the centre of mass."""
    y_m: float = quantity(-1000.0, 1000.0, 0.0)
    """y of the centre of mass."""
    heading_rad: float = quantity(-6.3, 6.3, 0.0)
    """Mean heading, counter-clockwise from x."""
    velocity_m_s: Annotated[tuple[Speed, ...], Field(min_length=2, max_length=2)] | None = None
    """[x, y] of the centre of mass in the world, m/s, -10 to 10."""
    yaw_rate_rad_s: float | None = quantity(-100.0, 100.0, None)
    """Rate of the mean heading."""
    bend_rad: Annotated[tuple[Bend, ...], Field(max_length=_MOST)] | None = None
    """Of each segment, head first, positive to the left, rad, -3.2 to 3.2."""
    bend_rate_rad_s: Annotated[tuple[BendRate, ...], Field(max_length=_MOST)] | None = None
    """Of each segment, rad/s; where the bends are what the chambers give they have their own."""
    pressure_kpa: (
        Annotated[
            tuple[Annotated[tuple[Gauge, ...], Field(min_length=2, max_length=2)], ...],
            Field(max_length=_MOST),
        ]
        | None
    ) = None
    """[+, -] chamber of each segment, gauge, kPa, 0 to the supply's."""
    run: FilePath | None = Field(
        default=None,
        alias="from",
        title="From",
        description="Folder of a run: each plant begins as its own record was.",
    )
    time_s: float | None = quantity(0.0, 1e6, None)
    """When in that run."""

    def contradictions(self) -> Iterator[tuple[tuple[str, ...], str]]:
        """Yield path and message of keys that contradict each other."""
        if self.run is None:
            if self.time_s is not None:
                yield ("time_s",), "a time in a run; name the run with from"
            return
        for name in sorted(self.model_fields_set - {"run", "time_s"}):
            yield (name,), "the run in from says so; take one of them out"
        if self.time_s is None:
            yield ("from",), "say when in that run: time_s"

    @property
    def moves(self) -> bool:
        """Whether the snake is not straight and at rest."""
        return self.run is not None or any(getattr(self, name) is not None for name in _AT_REST)

    def begin(self, segments: int, supply_pa: float, plants: Mapping[str, Any]) -> FirstState | None:
        """Return the first state of each plant; None: straight and at rest.

        Args:
            segments: of the robot.
            supply_pa: gauge, Pa; no chamber has more.
            plants: that run, by name.

        Raises:
            InputError: as many numbers as another robot has segments, pressures above the supply's, or a run
                that does not have such a moment.
        """
        if not self.moves:
            return None
        if self.run is not None:
            assert self.time_s is not None, "checked"
            states = {name: _recorded(Path(self.run), name, self.time_s, segments) for name in plants}
            return FirstState(states)
        for name in _PER_SEGMENT:
            given = getattr(self, name)
            if given is not None and len(given) != segments:
                raise InputError(f"{name} has {len(given)} entries; the robot has {segments} segments")

        def per_segment(name: str, *shape: int) -> np.ndarray:
            given = getattr(self, name)
            return np.zeros((segments, *shape)) if given is None else to_si(name, np.array(given))

        pressure = per_segment("pressure_kpa", 2)
        if pressure.max() > supply_pa * (1 + 1e-9):
            text = f"pressure_kpa {pressure.max() / 1000:g} is above the supply's {supply_pa / 1000:g} kPa"
            raise InputError(text)
        velocity = np.array(self.velocity_m_s or (0.0, 0.0))
        place = np.array([self.x_m, self.y_m]), velocity, self.heading_rad, self.yaw_rate_rad_s or 0.0
        state = _Moving(*place, per_segment("bend_rad"), per_segment("bend_rate_rad_s"), pressure)
        return FirstState(dict.fromkeys(plants, state))


@dataclass(frozen=True, eq=False)
class _Moving:
    """A physical state, SI; rates and pressures are its own."""

    com: np.ndarray
    com_velocity: np.ndarray
    heading: float
    yaw_rate: float
    bend: np.ndarray
    bend_rate: np.ndarray
    pressure: np.ndarray


@dataclass(frozen=True)
class FirstState:
    """Brings plants into their first states, see `rollout.Begin`.

    Attributes:
        states: of each plant.
    """

    states: Mapping[str, _Moving]

    def __call__(self, plant: Plant, seed: int) -> SnakeState:
        """Place a plant."""
        moving = self.states[plant.name]
        x, y = map(float, moving.com)
        resting = plant.reset(pose=(x, y, moving.heading), seed=seed)
        snake = replace(
            resting, com=moving.com, com_velocity=moving.com_velocity, heading=moving.heading,
            bend=moving.bend, bend_rate=moving.bend_rate, pressure=moving.pressure,
        )  # fmt: skip
        return plant.place(snake, yaw_rate=moving.yaw_rate, seed=seed)


def _recorded(folder: Path, plant: str, time: float, segments: int) -> _Moving:
    """Return what a plant's record says of a time; what moves by differences of its neighbours."""
    path = folder / f"{plant}.parquet"
    if not os.path.isfile(path):
        raise InputError(f"{display_path(folder)} holds no record of the {plant} plant ({path.name})")
    record = Trajectory.from_parquet(path)
    times = record.time
    if len(times) < 2 or not times[0] - 1e-9 <= time <= times[-1] + 1e-9:
        raise InputError(
            f"time_s {time:g} is outside of {display_path(path)}, {times[0]:g} to {times[-1]:g} s"
        )
    bend = record.stack("bend")
    if bend.shape[1] != segments:
        raise InputError(f"{display_path(path)} is of {bend.shape[1]} segments; the robot has {segments}")
    pressure = np.stack([record.stack("pressure_plus"), record.stack("pressure_minus")], axis=-1)
    columns = np.column_stack([record.com, record["heading"], bend, pressure.reshape(len(times), -1)])
    k = min(max(int(np.searchsorted(times, time - 1e-9)), 1), len(times) - 1)
    near = slice(max(k - 2, 0), min(k + 2, len(times)))
    # A parabola or cubic through the samples around it: values, and what they change by.
    fit = np.polynomial.polynomial.polyfit(times[near] - time, columns[near], len(times[near]) - 1)
    now, rate = fit[0], fit[1]
    count = 3 + segments
    return _Moving(
        now[:2], rate[:2], float(now[2]), float(rate[2]), now[3:count], rate[3:count],
        np.maximum(now[count:], 0.0).reshape(segments, 2),
    )  # fmt: skip
