"""Section `start` of a scenario, which defines the initial state of the snake.

Pose, motion and pressures are set by keys or taken from an earlier run.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from srs_twin.errors import InputError
from srs_twin.io.files import display_path
from srs_twin.plants.base import Plant, SnakeState
from srs_twin.robot.sourced import to_si
from srs_twin.robot.world import Pose
from srs_twin.scenario.fields import Contradiction, FilePath, Section, quantity
from srs_twin.trajectory import Trajectory

_MAX_SEGMENTS = 64
"""Maximum length of a list with one initial value per segment."""

Speed = Annotated[float, Field(ge=-10.0, le=10.0)]
Bend = Annotated[float, Field(ge=-3.2, le=3.2)]
BendRate = Annotated[float, Field(ge=-100.0, le=100.0)]
Gauge = Annotated[float, Field(ge=0.0, le=1000.0)]
_PER_SEGMENT = ("bend_rad", "bend_rate_rad_s", "pressure_kpa")
_AT_REST = ("velocity_m_s", "yaw_rate_rad_s", *_PER_SEGMENT)


class StartFile(Section):
    """Initial state of the snake, by default straight and at rest."""

    constructors = (Pose,)

    x_m: float = quantity(-1000.0, 1000.0, 0.0)
    """x coordinate of the centre of mass."""
    y_m: float = quantity(-1000.0, 1000.0, 0.0)
    """y coordinate of the centre of mass."""
    heading_rad: float = quantity(-6.3, 6.3, 0.0)
    """Mean heading (counter-clockwise from the x axis)."""
    velocity_m_s: (
        Annotated[tuple[Speed, ...], Field(min_length=2, max_length=2)] | None
    ) = None
    """Velocity [x, y] of the centre of mass in the world frame, m/s, -10 to 10."""
    yaw_rate_rad_s: float | None = quantity(-100.0, 100.0, None)
    """Rate of change of the mean heading."""
    bend_rad: Annotated[tuple[Bend, ...], Field(max_length=_MAX_SEGMENTS)] | None = None
    """Bend of each segment (head first, positive to the left), rad, -3.2 to 3.2."""
    bend_rate_rad_s: (
        Annotated[tuple[BendRate, ...], Field(max_length=_MAX_SEGMENTS)] | None
    ) = None
    """Bend rate of each segment, rad/s, -100 to 100; models that compute the bends
    directly from the pressures ignore this key."""
    pressure_kpa: (
        Annotated[
            tuple[Annotated[tuple[Gauge, ...], Field(min_length=2, max_length=2)], ...],
            Field(max_length=_MAX_SEGMENTS),
        ]
        | None
    ) = None
    """Gauge pressures [+, -] in the two chambers of each segment, kPa, from 0 to the
    supply pressure."""
    run: FilePath | None = Field(
        default=None,
        alias="from",
        title="From",
        description=(
            "Folder of an earlier run; each plant starts in the state that this plant"
            " had at time_s."
        ),
    )
    time_s: float | None = quantity(0.0, 1e6, None)
    """Time of the initial state in the earlier run."""

    def contradictions(self) -> Iterator[Contradiction]:
        """Yield contradictions between the keys of the section."""
        if self.run is None:
            if self.time_s is not None:
                yield Contradiction(
                    ("start", "time_s"),
                    "this key needs an earlier run; set `from`",
                    at_key=True,
                )
            return
        for name in sorted(self.model_fields_set - {"run", "time_s"}):
            text = (
                "the earlier run given by `from` already sets this value; remove this"
                " key or `from`"
            )
            yield Contradiction(("start", name), text, at_key=True)
        if self.time_s is None:
            text = "the time in the earlier run is missing; set `time_s`"
            yield Contradiction(("start", "from"), text, at_key=True)

    @property
    def moves(self) -> bool:
        """Whether the initial state differs from a straight snake at rest."""
        return self.run is not None or any(
            getattr(self, name) is not None for name in _AT_REST
        )

    def initial_state(
        self, segments: int, supply_pa: float, plants: Mapping[str, object]
    ) -> InitialState | None:
        """Return the initial state of each plant, or None for a straight snake at rest.

        Args:
            segments: number of segments.
            supply_pa: gauge supply pressure, which limits the chamber pressures, Pa.
            plants: sections of the simulated plants, keyed by name.

        Raises:
            InputError: a list does not have one entry per segment, a pressure is above
                the supply pressure, or the earlier run does not contain the time.
        """
        if not self.moves:
            return None
        if self.run is not None:
            assert self.time_s is not None, "see contradictions()"
            states = {
                name: _state_at(Path(self.run), name, self.time_s, segments)
                for name in plants
            }
            return InitialState(states)
        for name in _PER_SEGMENT:
            values = getattr(self, name)
            if values is not None and len(values) != segments:
                raise InputError(
                    f"`{name}` has {len(values)} entries, but the robot has {segments}"
                    " segments; give one entry per segment"
                )

        def per_segment(name: str, *shape: int) -> np.ndarray:
            values = getattr(self, name)
            return (
                np.zeros((segments, *shape))
                if values is None
                else to_si(name, np.array(values))
            )

        pressure = per_segment("pressure_kpa", 2)
        if pressure.max() > supply_pa * (1 + 1e-9):
            given = pressure.max() / 1000
            limit = supply_pa / 1000
            raise InputError(
                f"`pressure_kpa` {given:g} is above the supply pressure, which is"
                f" {limit:g} kPa"
            )
        velocity = np.array(self.velocity_m_s or (0.0, 0.0))
        state = _MotionState(
            np.array([self.x_m, self.y_m]),
            velocity,
            self.heading_rad,
            self.yaw_rate_rad_s or 0.0,
            per_segment("bend_rad"),
            per_segment("bend_rate_rad_s"),
            pressure,
        )
        return InitialState(dict.fromkeys(plants, state))


@dataclass(frozen=True, eq=False)
class _MotionState:
    """Pose, motion and pressures of a snake in SI units.

    Attributes:
        com: centre of mass, m, shape (2,).
        com_velocity: velocity of the centre of mass, m/s, shape (2,).
        heading: mean heading, rad.
        yaw_rate: rate of change of the mean heading, rad/s.
        bend: bend angles, rad, shape (segments,).
        bend_rate: bend rates, rad/s, shape (segments,).
        pressure: chamber pressures, gauge, Pa, shape (segments, 2).
    """

    com: np.ndarray
    com_velocity: np.ndarray
    heading: float
    yaw_rate: float
    bend: np.ndarray
    bend_rate: np.ndarray
    pressure: np.ndarray


@dataclass(frozen=True)
class InitialState:
    """Function that sets a plant to a given initial state (`rollout.PlaceFunction`)."""

    states: Mapping[str, _MotionState]

    def __call__(self, plant: Plant, seed: int) -> SnakeState:
        """Reset the plant and set the initial state."""
        moving = self.states[plant.name]
        x, y = map(float, moving.com)
        resting = plant.reset(pose=(x, y, moving.heading), seed=seed)
        fields = {
            name: value for name, value in vars(moving).items() if name != "yaw_rate"
        }
        return plant.set_state(
            replace(resting, **fields), yaw_rate=moving.yaw_rate, seed=seed
        )


def _state_at(folder: Path, plant: str, time: float, segments: int) -> _MotionState:
    """Interpolate a recorded trajectory of a plant at a given time (s)."""
    path = folder / f"{plant}.parquet"
    if not os.path.isfile(path):
        raise InputError(
            f"{display_path(folder)}: the folder contains no trajectory of the {plant}"
            f" plant ({path.name})"
        )
    trajectory = Trajectory.from_parquet(path)
    times = trajectory.time
    if len(times) < 2 or not times[0] - 1e-9 <= time <= times[-1] + 1e-9:
        raise InputError(
            f"`time_s` {time:g} is outside {display_path(path)}, which covers"
            f" {times[0]:g} to {times[-1]:g} s"
        )
    bend = trajectory.stack("bend")
    if bend.shape[1] != segments:
        raise InputError(
            f"{display_path(path)} has {bend.shape[1]} segments, but the robot has"
            f" {segments}; choose a run of a robot with {segments} segments"
        )
    pressure = np.stack(
        [trajectory.stack("pressure_plus"), trajectory.stack("pressure_minus")], axis=-1
    )
    columns = np.column_stack(
        [trajectory.com, trajectory["heading"], bend, pressure.reshape(len(times), -1)]
    )
    k = min(max(int(np.searchsorted(times, time - 1e-9)), 1), len(times) - 1)
    near = slice(max(k - 2, 0), min(k + 2, len(times)))
    # Coefficients 0 and 1 of a polynomial through the neighbouring samples are the
    # value and the rate at the given time.
    fit = np.polynomial.polynomial.polyfit(
        times[near] - time, columns[near], len(times[near]) - 1
    )
    now = fit[0]
    rate = fit[1]
    count = 3 + segments
    return _MotionState(
        now[:2],
        rate[:2],
        float(now[2]),
        float(rate[2]),
        now[3:count],
        rate[3:count],
        np.maximum(now[count:], 0.0).reshape(segments, 2),
    )
