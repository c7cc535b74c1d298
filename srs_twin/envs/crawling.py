"""GoTo and Obstacles: crawl to a goal, on an open floor or among circular obstacles.

The reward of a step is the sum of the terms `CrawlTask.reward_terms`, each with its weight. By default it is
the decrease of the distance to the goal in m, plus 1 at the goal, minus 1 outside the room, minus 0.5 per
second of contact. The first term is potential-based shaping with the potential −distance and no discount:
its sum is the distance gained, so it does not change the ranking of policies that reach the goal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from srs_twin.control.base import MAX_READING_RAD, SensorReadings
from srs_twin.control.commands import CommandedGait, GaitCommand, GaitLimits
from srs_twin.control.gait import PitchWave
from srs_twin.envs.task import Episode, RewardTerm, Robot, Signal, Signals, Task, numbered_signals
from srs_twin.errors import InputError
from srs_twin.planning.camera import Camera, CameraFrames
from srs_twin.plants.base import SnakeState
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Bounds, Goal, World, random_circles

STEP_S = 0.1
"""Duration of a step, s."""

GOAL_RADIUS_M = 0.1
"""Distance from the centre of mass to the goal at which it is reached, m."""

CAMERA = Camera(1 / STEP_S, 0.001, 0.005)
"""Camera with one frame per step and the noise of scenario follow_fig57 (1 mm, 5 mrad)."""

_PA_PER_KPA = 1e3

_RADII_M = (0.08, 0.12)
"""Smallest and largest radius of an obstacle, m."""

_GAP_M = 0.25
"""Smallest gap between obstacles, m: generation 2 sweeps 0.1 m when straight, 0.17 m in tight turns."""

_CLEAR_M = 0.3
"""Radius around start and goal without obstacles, m."""


@dataclass(frozen=True)
class Arena:
    """Floor of an episode and the distributions of start and goal; the snake starts at the origin.

    Attributes:
        room: bounds that the centre of mass must not leave.
        headings: smallest and largest initial heading, rad.
        distances: smallest and largest distance of the goal, m.
        bearings: smallest and largest bearing of the goal relative to the heading, rad.
        obstacles: number of circles.
        obstacle_area: area of the obstacles' centres; None without obstacles.
    """

    room: Bounds
    headings: tuple[float, float]
    distances: tuple[float, float]
    bearings: tuple[float, float]
    obstacles: int = 0
    obstacle_area: Bounds | None = None


OPEN = Arena(
    room=Bounds((-2.5, 2.5), (-2.5, 2.5)),
    headings=(-math.pi, math.pi),
    distances=(0.6, 1.5),
    bearings=(-math.pi / 2, math.pi / 2),
)
"""Open floor of task GoTo."""

CIRCLES = Arena(
    room=Bounds((-0.6, 2.6), (-1.2, 1.2)),
    headings=(-0.3, 0.3),
    distances=(2.0, 2.2),
    bearings=(-0.2, 0.2),
    obstacles=4,
    obstacle_area=Bounds((0.4, 1.6), (-0.6, 0.6)),
)
"""Floor of task Obstacles: four circles between start and goal."""


class CrawlTask(Task):
    """Task of crawling to a goal (module docstring).

    Attributes:
        arena: floor, and distributions of start and goal.
        limits: bounds of the gait commands.
    """

    step_s = STEP_S
    reward_terms: ClassVar[tuple[RewardTerm, ...]] = (
        RewardTerm("progress_m", 1.0, "decrease of the distance from the centre of mass to the goal"),
        RewardTerm("touching_s", -0.5, "time in contact with an obstacle"),
        RewardTerm("goal_reached", 1.0, "1 in the step that reaches the goal"),
        RewardTerm("room_left", -1.0, "1 in the step that leaves the room"),
        RewardTerm("time_s", 0.0, "duration of the step"),
        RewardTerm("air_j", 0.0, "energy of the air taken from the supply"),
        RewardTerm("offset_change", 0.0, "absolute change of the steering offset"),
    )

    def __init__(
        self,
        name: str,
        arena: Arena,
        *,
        robot: Robot = "gen2",
        limit_s: float = 30.0,
        camera: Camera = CAMERA,
        **settings: Any,
    ) -> None:
        """Create the task.

        Args:
            name: name of the task, as registered.
            arena: floor, and distributions of start and goal.
            robot: name, path or keys of the robot.
            limit_s: time limit, s.
            camera: frame rate and noise of the camera; at least one frame per step.
            **settings: `fit`, `ranges`, `rewards`, `observations`, `action_range` and settings of the twin,
                see `Task`.

        Raises:
            UnknownNameError: the twin does not have a setting of that name.
            InputError: the robot, fit, range or time limit is invalid, or the camera is too slow.
        """
        super().__init__(robot, limit_s, **settings)
        if camera.rate_hz * STEP_S < 1 - 1e-9:
            raise InputError(
                f"a camera of {camera.rate_hz:g} Hz is too slow for steps of {STEP_S:g} s; "
                f"it must be {1 / STEP_S:g} Hz or more"
            )
        self.name, self.arena, self._camera = name, arena, camera
        self.has_obstacles = arena.obstacles > 0
        self.limits = self._gait_limits()
        self.actions = self._action_signals()
        self._set_observations(_observation_groups(arena, self.robot, self.actions))

    def begin(self, rng: np.random.Generator, last: Episode | None = None) -> CrawlEpisode:
        """See `Task.begin`."""
        spec = self._variation.draw(rng)
        arena = self.arena
        draws = (rng.uniform(*limits) for limits in (arena.headings, arena.distances, arena.bearings))
        heading, distance, bearing = map(float, draws)
        direction = heading + bearing
        goal = Goal(distance * math.cos(direction), distance * math.sin(direction), None, GOAL_RADIUS_M)
        seed = int(rng.integers(2**32))
        world = World(self._obstacles(goal, seed), self.arena.room, goal)
        twin = self._twin(spec, last, world, supply_pa=self.limits.pressure[1])
        return self._episode_class(self, twin, world, heading, CameraFrames(self._camera, seed), seed)

    def _gait_limits(self) -> GaitLimits:
        """Return the bounds of offset, frequency and pressure."""
        return GaitLimits.for_robot(self.robot)

    def _action_signals(self) -> Signals:
        """Return the components of an action."""
        return gait_signals(self.limits)

    @property
    def _episode_class(self) -> type[CrawlEpisode]:
        return CrawlEpisode

    def _obstacles(self, goal: Goal, seed: int) -> tuple[Any, ...]:
        area = self.arena.obstacle_area
        if area is None:
            return ()
        clear = ((0.0, 0.0, _CLEAR_M), (goal.x, goal.y, _CLEAR_M))
        return random_circles(self.arena.obstacles, area, seed, radius=_RADII_M, gap=_GAP_M, clear=clear)


class CrawlEpisode(Episode):
    """Episode of crawling to a goal.

    Attributes:
        world: obstacles, room and goal.
    """

    state_attributes: ClassVar[tuple[str, ...]] = (
        "_gait", "_frames", "_readings", "_distance", "_air", "_offset",
    )  # fmt: skip

    def __init__(
        self, task: CrawlTask, twin: TwinSnake, world: World, heading: float, frames: CameraFrames, seed: int
    ) -> None:
        """Place the snake at the origin."""
        if world.goal is None:
            raise InputError("there is no goal to crawl to; give world.goal")
        self.world, self.goal = world, world.goal
        self._goal = world.goal
        limits = task.limits
        mean_command = GaitCommand(0.0, *(sum(pair) / 2 for pair in (limits.frequency, limits.pressure)))
        state = twin.reset(pose=(0.0, 0.0, heading), seed=seed)
        self._gait = CommandedGait(twin.spec, twin.tick, twin.pneumatics, mean_command)
        self._frames, self._readings = frames, SensorReadings(state.sensed.size)
        self._distance, self._air, self._offset = self._goal_distance(state), float(state.air), 0.0
        super().__init__(task, twin, state)

    def _initialise_from_state(self) -> None:
        """See `Episode._initialise_from_state`."""
        self._frames.restart()
        self._distance, self._air = self._goal_distance(self.state), float(self.state.air)

    def _valves(self, action: list[float]) -> np.ndarray:
        command, pitch = self._command(action)
        return self._gait.valves(float(self.state.time), command, pitch)

    def _command(self, action: list[float]) -> tuple[GaitCommand, PitchWave | None]:
        """Return the gait parameters of an action."""
        offset, frequency, pressure_kpa = action
        return GaitCommand(offset, frequency, pressure_kpa * _PA_PER_KPA), None

    def _last_command(self) -> list[float]:
        """Return the observations of the last command."""
        command = self._gait.command
        return [command.offset, command.frequency, command.pressure / _PA_PER_KPA]

    def _measure(self) -> list[float]:
        time = float(self.state.time)
        seen = self._frames.capture(self.state)
        assert seen is not None, "the camera has one frame per step"
        self._readings.update(time, self.state.sensed.T.ravel())  # to the left, then upwards
        c, s = math.cos(seen.heading), math.sin(seen.heading)

        def ahead_and_left(x: float, y: float) -> tuple[float, float]:
            dx, dy = x - seen.x, y - seen.y
            return c * dx + s * dy, c * dy - s * dx

        angle = self._gait.gait.angle(time)
        circles = [(*ahead_and_left(circle.x, circle.y), circle.radius) for circle in self.world.obstacles]
        pose = [seen.x, seen.y, c, s, *ahead_and_left(self._goal.x, self._goal.y)]
        gait_and_bends = [math.cos(angle), math.sin(angle), *self._readings.value]
        obstacles = [number for circle in circles for number in circle]
        return [*pose, *gait_and_bends, *self._last_command(), *obstacles]

    def _reward_values(self) -> dict[str, float]:
        state, room, step_s = self.state, self.world.bounds, self._task.step_s
        distance, air, offset = self._goal_distance(state), float(state.air), self._gait.command.offset
        before, self._distance = self._distance, distance
        air_before, self._air = self._air, air
        offset_before, self._offset = self._offset, offset
        x, y = state.com
        if self._has_arrived(distance):
            self.ending = "goal_reached"
        elif room and not (room.x[0] <= x <= room.x[1] and room.y[0] <= y <= room.y[1]):
            self.ending = "room_left"
        return {
            "progress_m": before - distance,
            "touching_s": step_s * self._touching(),
            "goal_reached": float(self.ending == "goal_reached"),
            "room_left": float(self.ending == "room_left"),
            "time_s": step_s,
            "air_j": air - air_before,
            "offset_change": abs(offset - offset_before),
        }

    def _info(self) -> dict[str, Any]:
        x, y = map(float, self.state.com)
        return super()._info() | {
            "com_x_m": x,
            "com_y_m": y,
            "heading_rad": float(self.state.heading),
            "goal_x_m": self._goal.x,
            "goal_y_m": self._goal.y,
            "goal_distance_m": self._distance,
            "touching": self._touching(),
        }

    def _touching(self) -> bool:
        return bool(np.any(self.state.obstacle_force))

    def _has_arrived(self, distance: float) -> bool:
        """Return whether the episode ends at a distance from the goal (m)."""
        return distance <= self._goal.radius

    def _goal_distance(self, state: SnakeState) -> float:
        return math.hypot(self._goal.x - float(state.com[0]), self._goal.y - float(state.com[1]))


def gait_signals(limits: GaitLimits) -> Signals:
    """Return the action signals of a gait command."""
    low, high = (pressure / _PA_PER_KPA for pressure in limits.pressure)
    return (
        Signal("offset", "1", *limits.offset, "steering offset φ of the gait, positive to the left"),
        Signal("frequency_hz", "Hz", *limits.frequency, "gait frequency; the phase stays continuous"),
        Signal("pressure_kpa", "kPa", low, high, "gauge pressure of the air supply"),
    )


def _observation_groups(arena: Arena, spec: RobotSpec, actions: Sequence[Signal]) -> dict[str, Signals]:
    (left, right), (bottom, top) = arena.room.x, arena.room.y
    margin = 0.5  # margin, m: a step may end outside the room, and the camera has noise
    farthest = math.hypot(right - left, top - bottom) + 1.0
    pose = (
        Signal("x_m", "m", left - margin, right + margin, "x of the centre of mass, from the camera"),
        Signal("y_m", "m", bottom - margin, top + margin, "y of the centre of mass, from the camera"),
        Signal("heading_cos", "1", -1.0, 1.0, "cosine of the mean heading, from the camera"),
        Signal("heading_sin", "1", -1.0, 1.0, "sine of the mean heading, from the camera"),
    )
    goal = (
        Signal("goal_ahead_m", "m", -farthest, farthest, "position of the goal along the heading"),
        Signal("goal_left_m", "m", -farthest, farthest, "position of the goal to the left of the heading"),
    )
    gait = (
        Signal("gait_cos", "1", -1.0, 1.0, "cosine of the gait phase at the first segment"),
        Signal("gait_sin", "1", -1.0, 1.0, "sine of the gait phase at the first segment"),
    )
    largest = MAX_READING_RAD
    bends = [
        signal
        for name, text in (("bend_#_rad", "a bend"), ("pitch_#_rad", "a bend upwards"))[: 1 + spec.is_spatial]
        for signal in numbered_signals(
            spec.segments, name, "rad", -largest, largest, f"sensor reading of {text}"
        )
    ]
    command = (replace(action, description="last command") for action in actions)
    groups = {"pose": pose, "goal": goal, "gait": gait, "bends": tuple(bends), "command": tuple(command)}
    circles: list[Signal] = []
    for k in range(1, arena.obstacles + 1):
        ahead, left_of = f"obstacle_{k}_ahead_m", f"obstacle_{k}_left_m"
        where = f"position of circle {k}"
        circles += [
            Signal(ahead, "m", -farthest, farthest, f"{where} along the heading"),
            Signal(left_of, "m", -farthest, farthest, f"{where} to the left of the heading"),
            Signal(f"obstacle_{k}_radius_m", "m", *_RADII_M, f"radius of circle {k}"),
        ]
    return groups | ({"obstacles": tuple(circles)} if circles else {})
