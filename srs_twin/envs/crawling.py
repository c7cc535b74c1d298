"""Tasks GoTo, Obstacles and Crawl3D, in which a snake crawls to a goal.

In the task Obstacles, two rows of circular obstacles divide the room, and each row has
a gate at a random position. Contact with an obstacle ends the episode. Otherwise, a
policy that does not observe the obstacles could find the gates by touch.

The reward of a step is the weighted sum of the terms in `CrawlTask.reward_terms`. By
default, the reward is the decrease in the distance to the goal (m). Reaching the goal
adds 1, and leaving the room or touching an obstacle subtracts 1. The decrease in the
distance is a potential-based shaping term without discount. The sum of this term over
an episode is the total decrease in the distance, so shaping does not change the ranking
of policies that reach the goal.

In the task Crawl3D, a spatial robot crawls on an open floor. The agent also commands
the pitch wave of the gait (`control.gait`), so the robot can undulate, sidewind to
either side or crawl rectilinearly. With a pitch fraction of 0, the gait has no pitch
wave.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Unpack

import numpy as np

from srs_twin.control.commands import MAX_OFFSET, CommandedGait, GaitCommand, GaitLimits
from srs_twin.control.gait import PitchWave
from srs_twin.envs.observed import (
    CAMERA,
    COSTS,
    STEP_S,
    CameraTask,
    ObservedEpisode,
    ahead_and_left,
    observation_groups,
    place_signals,
)
from srs_twin.envs.task import (
    Episode,
    RewardTerm,
    Signal,
    Signals,
    TaskKeywords,
    abbreviate,
    as_finite_array,
)
from srs_twin.envs.variation import Robot
from srs_twin.errors import InputError
from srs_twin.io.arguments import checked
from srs_twin.io.provenance import short_digest
from srs_twin.planning.camera import Camera
from srs_twin.planning.collision import obstacle_at
from srs_twin.plants.base import SnakeState
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.world import OBSTACLE_FRICTION, Bounds, Circle, Goal, World

GOAL_RADIUS_M = 0.1
"""Distance between the goal and the centre of mass below which the goal counts as
reached, m.
"""

_PA_PER_KPA = 1e3

_RADII_M = (0.12, 0.14)

_SITES = 6
"""Number of obstacle sites in a row, one of which is left free as the gate."""

_SPACING_M = 0.30
"""Distance between neighbouring obstacle sites in a row, m.

With this spacing, the gate is 0.32 to 0.36 m wide, and the other gaps are at most
0.06 m wide. A robot of generation 2 sweeps a width of 0.1 m on a straight path and
0.17 m in tight turns.
"""

_SHIFT_M = 0.05
"""Maximum random displacement of a row of obstacles along y, m."""

_MARGIN_M = 0.5
"""Distance by which observed positions may lie outside the room after the last step or
because of camera noise, m.
"""


@dataclass(frozen=True)
class Arena:
    """Room of a task, with the ranges of the initial heading and the goal position.

    Attributes:
        room: bounds that the centre of mass must not leave.
        headings: minimum and maximum initial heading, rad.
        distances: minimum and maximum distance between the goal and the origin, where
            the snake starts, m.
        bearings: minimum and maximum bearing of the goal relative to the initial
            heading, rad.
        obstacles: number of circular obstacles.
        rows: x coordinate of each row of obstacles, m.
        friction: friction coefficient between the obstacles and the body.
    """

    room: Bounds
    headings: tuple[float, float]
    distances: tuple[float, float]
    bearings: tuple[float, float]
    obstacles: int = 0
    rows: tuple[float, ...] = ()
    friction: float = OBSTACLE_FRICTION


OPEN = Arena(
    room=Bounds((-2.5, 2.5), (-2.5, 2.5)),
    headings=(-math.pi, math.pi),
    distances=(0.6, 1.5),
    bearings=(-math.pi / 2, math.pi / 2),
)
"""Arena of the task GoTo, which contains no obstacles."""

_ROWS_M = (0.9, 1.9)

CIRCLES = Arena(
    room=Bounds((-0.6, 3.0), (-0.6, 0.6)),
    headings=(-0.1, 0.1),
    distances=(2.5, 2.7),
    bearings=(-0.1, 0.1),
    obstacles=len(_ROWS_M) * (_SITES - 1),
    rows=_ROWS_M,
)
"""Arena of the task Obstacles, which contains two rows of obstacles."""

FLOOR = Arena(
    room=Bounds((-2.0, 2.0), (-2.0, 2.0)),
    headings=(-math.pi, math.pi),
    distances=(0.4, 1.0),
    bearings=(-math.pi, math.pi),
)
"""Arena of the task Crawl3D, which contains no obstacles.

The goal may be in any direction, because a sidewinding robot does not travel along its
heading.
"""

SPATIAL_FREQUENCIES_HZ = (0.25, 1.0)
"""Minimum and maximum gait frequency of spatial robots, Hz.

At 1 Hz, the inertia of lifted segments is no longer negligible (docs/spatial.md).
"""

SPATIAL_RELATIVE_PRESSURES = (0.25, 0.6)
"""Minimum and maximum supply pressure of spatial robots, relative to the nominal supply
pressure.

For `spatial_example`, these pressures are 12 and 29 kPa, which bend each segment by 0.4
and 0.9 rad.
"""


class CrawlEpisode(ObservedEpisode):
    """Episode in which the snake crawls to a goal.

    Attributes:
        world: obstacles, room and goal.
        collisions_end: whether the episode ends when the body touches an obstacle.
    """

    state_attributes: ClassVar[tuple[str, ...]] = ("_distance", "_offset")

    goal: Goal
    collisions_end: ClassVar[bool] = True

    def __init__(
        self, task: CrawlTask, twin: TwinSnake, world: World, heading: float, seed: int
    ) -> None:
        """Start with the snake at the origin of the world, which must have a goal."""
        assert world.goal is not None, "the task sets a goal"
        self.world = world
        self.goal = world.goal
        limits = task.limits
        mean_command = GaitCommand(
            0.0, sum(limits.frequency) / 2, sum(limits.pressure) / 2
        )
        state = twin.reset(pose=(0.0, 0.0, heading), seed=seed)
        self._gait = CommandedGait(twin.spec, twin.tick, twin.pneumatics, mean_command)
        self._distance = self._goal_distance(state)
        self._offset = 0.0
        super().__init__(task, twin, state, seed)

    def identity(self) -> dict[str, object]:
        """See `Episode.identity`.

        The identity also contains the goal and a digest of the current world, because a
        reused twin still has the goal of an earlier episode.
        """
        goal = [self.goal.x, self.goal.y]
        return super().identity() | {"goal": goal, "world": short_digest(self.world)}

    def set_goal(self, place: object) -> None:
        """See `Episode.set_goal`."""
        given = as_finite_array(place, (2,))
        if given is None:
            raise InputError(
                f"the option `goal` {abbreviate(place)} is not allowed; give x and y"
                " in m"
            )
        x, y = given.tolist()
        name = f"the option `goal` ({x:g}, {y:g}) is not allowed"
        goal = Goal(x, y, None, GOAL_RADIUS_M)
        if hit := obstacle_at(self.world, x, y):
            relation = "outside" if hit.startswith("the bounds") else "inside"
            raise InputError(f"{name}, because it is {relation} {hit}")
        self.goal = goal
        self.world = replace(self.world, goal=goal)
        self._initialise_from_state()
        if self._distance <= goal.radius:
            raise InputError(
                f"{name}, because the snake is already within {goal.radius:g} m of it"
            )
        self._set_first(self._observation())

    def _initialise_from_state(self) -> None:
        super()._initialise_from_state()
        self._distance = self._goal_distance(self.state)

    def _valves(self, action: list[float]) -> np.ndarray:
        command, pitch = self._command(action)
        return self._gait.valves(float(self.state.time), command, pitch)

    def _command(self, action: list[float]) -> tuple[GaitCommand, PitchWave | None]:
        offset, frequency, pressure_kpa = action
        return GaitCommand(offset, frequency, pressure_kpa * _PA_PER_KPA), None

    def _last_command(self) -> list[float]:
        command = self._gait.command
        return [command.offset, command.frequency, command.pressure / _PA_PER_KPA]

    def _gait_angle(self) -> float:
        return self._gait.gait.angle(float(self.state.time))

    def _measure(self) -> dict[str, Sequence[float]]:
        seen, values = self._observe()
        values["goal"] = ahead_and_left(seen, self.goal.x, self.goal.y)
        values["obstacles"] = [
            number
            for item in self.world.obstacles
            for number in (*ahead_and_left(seen, item.x, item.y), item.radius)
        ]
        return values

    def _reward_values(self) -> dict[str, float]:
        before = self._distance
        self._distance = self._goal_distance(self.state)
        offset_before = self._offset
        self._offset = self._gait.command.offset
        if self._distance <= self.goal.radius:
            self.ending = "goal_reached"
        elif self.collisions_end and self._touching():
            self.ending = "collided"
        elif not self._is_in_room():
            self.ending = "room_left"
        return {
            "progress_m": before - self._distance,
            "touching_s": self._task.step_s * self._touching(),
            "goal_reached": float(self.ending == "goal_reached"),
            "collided": float(self.ending == "collided"),
            "room_left": float(self.ending == "room_left"),
            "offset_change": abs(self._offset - offset_before),
            **self._costs(),
        }

    def _info(self) -> dict[str, object]:
        return super()._info() | {
            "heading_rad": float(self.state.heading),
            "goal_x_m": self.goal.x,
            "goal_y_m": self.goal.y,
            "goal_distance_m": self._distance,
            "touching": self._touching(),
        }

    def _is_in_room(self) -> bool:
        room = self.world.bounds
        assert room is not None, "an arena has a room"
        x, y = self.state.com
        return bool(room.x[0] <= x <= room.x[1] and room.y[0] <= y <= room.y[1])

    def _touching(self) -> bool:
        return bool((np.abs(self.state.obstacle_force) > 0).any())

    def _goal_distance(self, state: SnakeState) -> float:
        x, y = map(float, state.com)
        return math.hypot(self.goal.x - x, self.goal.y - y)


class SpatialCrawlEpisode(CrawlEpisode):
    """Episode in which a spatial robot crawls to a goal."""

    state_attributes = ("_pitch",)

    _pitch = (0.0, 0.0)
    """Pitch fraction and phase lag (rad) of the last commanded pitch wave."""

    def _command(self, action: list[float]) -> tuple[GaitCommand, PitchWave | None]:
        fraction, lag = self._pitch = action[3], action[4]
        return super()._command(action[:3])[0], PitchWave(fraction, lag)

    def _last_command(self) -> list[float]:
        return [*super()._last_command(), *self._pitch]


class CrawlKeywords(TaskKeywords, total=False):
    """Keyword arguments of `CrawlTask` except the robot and the time limit."""

    camera: Camera


class TimedCrawlKeywords(CrawlKeywords, total=False):
    """Keyword arguments of `CrawlTask` except the robot."""

    limit_s: float


class AnyTaskKeywords(TimedCrawlKeywords, total=False):
    """Keyword arguments that at least one task accepts."""

    robot: Robot


class CrawlTask(CameraTask):
    """Task in which a snake crawls to a goal.

    Attributes:
        arena: room, and ranges of the initial heading and the goal position.
        limits: limits of the gait commands.
        episode_class: class of the task's episodes.
    """

    episode_class: ClassVar[type[CrawlEpisode]] = CrawlEpisode
    reward_terms: ClassVar[tuple[RewardTerm, ...]] = (
        RewardTerm(
            "progress_m",
            1.0,
            "decrease of the distance from the centre of mass to the goal",
        ),
        RewardTerm("touching_s", 0.0, "time in contact with an obstacle"),
        RewardTerm("goal_reached", 1.0, "1 in the step that reaches the goal"),
        RewardTerm(
            "collided", -1.0, "1 in the step that touches an obstacle, except in Pegs"
        ),
        RewardTerm("room_left", -1.0, "1 in the step that leaves the room"),
        *COSTS,
        RewardTerm("offset_change", 0.0, "absolute change of the steering offset"),
    )

    @checked
    def __init__(
        self,
        name: str,
        arena: Arena,
        *,
        robot: Robot = "gen2",
        limit_s: float = 30.0,
        camera: Camera = CAMERA,
        **settings: Unpack[TaskKeywords],
    ) -> None:
        """Create the task.

        Args:
            name: registered name of the task.
            arena: room, and ranges of the initial heading and the goal position.
            robot: robot, specified as in `Task`.
            limit_s: time limit, s.
            camera: frame rate and noise of the camera. At least one frame per step is
                required.
            **settings: further arguments of `Task`.

        Raises:
            UnknownNameError: a setting of the twin has an unknown name.
            InputError: the robot, fit, range or time limit is invalid, or the camera is
                too slow.
        """
        super().__init__(robot, limit_s, **settings)
        if camera.rate_hz * STEP_S < 1 - 1e-9:
            raise InputError(
                f"a camera of {camera.rate_hz:g} Hz is too slow for steps of"
                f" {STEP_S:g} s; use a camera of {1 / STEP_S:g} Hz or more"
            )
        self.name = name
        self.arena = arena
        self.camera = camera
        self.has_obstacles = arena.obstacles > 0
        self.limits = self._gait_limits()
        self.actions = self._action_signals()
        self._set_observations(self._observation_groups())

    def begin(
        self, rng: np.random.Generator, last: Episode | None = None
    ) -> CrawlEpisode:
        """See `Task.begin`."""
        spec = self._variation.draw(rng)
        world, heading, seed = self._draw_world(rng)
        twin = self._twin(spec, last, world, supply_pa=self.limits.pressure[1])
        return self.episode_class(self, twin, world, heading, seed)

    def _draw_world(self, rng: np.random.Generator) -> tuple[World, float, int]:
        arena = self.arena
        heading = float(rng.uniform(*arena.headings))
        distance = float(rng.uniform(*arena.distances))
        direction = heading + float(rng.uniform(*arena.bearings))
        x = distance * math.cos(direction)
        y = distance * math.sin(direction)
        goal = Goal(x, y, None, GOAL_RADIUS_M)
        seed = int(rng.integers(2**32))
        world = World(
            self._draw_obstacles(goal, seed), arena.room, goal, friction=arena.friction
        )
        return world, heading, seed

    def _draw_obstacles(self, goal: Goal, seed: int) -> tuple[Circle, ...]:
        rng = np.random.default_rng(seed)
        circles = []
        for x in self.arena.rows:
            gate = rng.integers(1, _SITES - 1)
            shift = rng.uniform(-_SHIFT_M, _SHIFT_M)
            for site in set(range(_SITES)) - {int(gate)}:
                y = (site - (_SITES - 1) / 2) * _SPACING_M + shift
                circles.append(Circle(x, float(y), float(rng.uniform(*_RADII_M))))
        return tuple(circles)

    def _gait_limits(self) -> GaitLimits:
        return GaitLimits.for_robot(self.robot)

    def _action_signals(self) -> Signals:
        limits = self.limits
        low, high = (pressure / _PA_PER_KPA for pressure in limits.pressure)
        return (
            Signal(
                "offset",
                "1",
                *limits.offset,
                "steering offset φ of the gait, positive to the left",
            ),
            Signal(
                "frequency_hz",
                "Hz",
                *limits.frequency,
                "gait frequency; the phase stays continuous",
            ),
            Signal(
                "pressure_kpa", "kPa", low, high, "gauge pressure of the air supply"
            ),
        )

    def _observation_groups(self) -> dict[str, Signals]:
        room = self.arena.room
        far = math.hypot(room.x[1] - room.x[0], room.y[1] - room.y[0]) + 1.0
        seen = Bounds(
            (room.x[0] - _MARGIN_M, room.x[1] + _MARGIN_M),
            (room.y[0] - _MARGIN_M, room.y[1] + _MARGIN_M),
        )
        goal = place_signals("goal", far, "position of the goal")
        groups = observation_groups(seen, {"goal": goal}, self.robot, self.actions)
        circles: list[Signal] = []
        for k in range(1, self.arena.obstacles + 1):
            name = f"obstacle_{k}"
            circles += place_signals(name, far, f"position of circle {k}")
            radius = f"radius of circle {k}"
            circles.append(Signal(f"{name}_radius_m", "m", *_RADII_M, radius))
        if circles:
            groups["obstacles"] = tuple(circles)
        return groups


class SpatialCrawlTask(CrawlTask):
    """Task in which a spatial robot crawls to a goal."""

    spatial = True
    episode_class = SpatialCrawlEpisode

    def __init__(
        self,
        *,
        robot: str = "spatial_example",
        **settings: Unpack[TimedCrawlKeywords],
    ) -> None:
        """Create the task with the arguments of `CrawlTask`.

        Raises:
            InputError: the robot is planar, or an argument is invalid.
        """
        super().__init__("Crawl3D", FLOOR, robot=robot, **settings)

    def _gait_limits(self) -> GaitLimits:
        low, high = (
            ratio * self.robot.supply.nominal for ratio in SPATIAL_RELATIVE_PRESSURES
        )
        return GaitLimits(
            (-MAX_OFFSET, MAX_OFFSET), SPATIAL_FREQUENCIES_HZ, (low, high)
        )

    def _action_signals(self) -> Signals:
        lag = "lag of the pitch wave; π/2 is sidewinding to the right"
        return (
            *super()._action_signals(),
            Signal(
                "pitch_fraction",
                "1",
                0.0,
                1.0,
                "pitch amplitude as a fraction of the sum of both amplitudes",
            ),
            Signal("pitch_lag_rad", "rad", -math.pi, math.pi, lag),
        )
