r"""GoTo and Obstacles: crawl to a goal, on an open floor or among circles.

With d the distance of the centre of mass to the goal, a step gives

$$ r = \frac{d_{k-1} - d_k}{1\,\text{m}} + [\text{goal reached}] - [\text{room left}]
- 0.5\,[\text{touching}]\,\frac{\Delta t}{1\,\text{s}}. $$

The first term is a potential (−d, without discount): it adds up to the way made good and so changes no
order among the policies that reach the goal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.control.base import MAX_READING_RAD, SensorReadings
from srs_twin.control.camera import Camera, CameraFrames
from srs_twin.control.commands import CommandedGait, GaitCommand, GaitLimits
from srs_twin.envs.task import Episode, Signal, Signals, Task, numbered
from srs_twin.errors import InputError
from srs_twin.plants.base import SnakeState
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.random_worlds import random_circles
from srs_twin.robot.world import Bounds, Goal, World

STEP_S = 0.1
GOAL_RADIUS_M = 0.1
CAMERA = Camera(1 / STEP_S, 0.001, 0.005)
"""Noise as in scenario follow_fig57."""
TOUCH_PER_S = 0.5
"""Reward that touching an obstacle costs."""

_PA_PER_KPA = 1e3
_RADII_M = (0.08, 0.12)
_GAP_M = 0.25  # between obstacles: generation 2 sweeps 0.1 m ahead and 0.17 m in its tightest turns
_CLEAR_M = 0.3  # around start and goal


@dataclass(frozen=True)
class Field:
    """Where episodes take place; the snake begins at the origin.

    Attributes:
        room: what the centre of mass must not leave.
        headings: the smallest and largest at the start, rad.
        distances: of the goal, m.
        bearings: of the goal, from the snake's heading, rad.
        obstacles: how many circles lie between.
        strewn: where their centres may lie; None where there are none.
    """

    room: Bounds
    headings: tuple[float, float]
    distances: tuple[float, float]
    bearings: tuple[float, float]
    obstacles: int = 0
    strewn: Bounds | None = None


OPEN = Field(Bounds((-2.5, 2.5), (-2.5, 2.5)), (-math.pi, math.pi), (0.6, 1.5), (-math.pi / 2, math.pi / 2))
_ROOM, _STREWN = Bounds((-0.6, 2.6), (-1.2, 1.2)), Bounds((0.4, 1.6), (-0.6, 0.6))
CIRCLES = Field(_ROOM, (-0.3, 0.3), (2.0, 2.2), (-0.2, 0.2), obstacles=4, strewn=_STREWN)


class CrawlTask(Task):
    """Crawl to a goal (module docstring).

    Attributes:
        place: where.
        limits: of the commands.
    """

    step_s = STEP_S

    def __init__(
        self,
        name: str,
        place: Field,
        *,
        robot: str = "gen2",
        limit_s: float = 30.0,
        camera: Camera = CAMERA,
        **settings: Any,
    ) -> None:
        """Make the task.

        Args:
            name: as registered.
            place: where episodes take place.
            robot: name or path of what crawls.
            limit_s: time limit, s.
            camera: how often and with which noise it sees; a frame a step at least.
            **settings: `fit`, `ranges` and the twin's, as `Task` takes them.

        Raises:
            UnknownNameError: a setting that the twin does not take.
            InputError: a robot, fit, range or time limit that cannot be, or a camera that is too slow.
        """
        super().__init__(robot, limit_s, **settings)
        if camera.rate_hz * STEP_S < 1 - 1e-9:
            raise InputError(
                f"a camera of {camera.rate_hz:g} Hz is too slow for steps of {STEP_S:g} s; "
                f"it must be {1 / STEP_S:g} Hz or more"
            )
        self.name, self.place, self._camera = name, place, camera
        self.solid = place.obstacles > 0
        self.limits = GaitLimits.for_robot(self.robot)
        self.actions = gait_signals(self.limits)
        self.observations = _observations(place, self.robot.segments, self.actions)

    def begin(self, rng: np.random.Generator, last: Episode | None = None) -> CrawlEpisode:
        """See `Task.begin`."""
        spec = self._variation.draw(rng)
        place = self.place
        drawn = (rng.uniform(*ends) for ends in (place.headings, place.distances, place.bearings))
        heading, distance, bearing = map(float, drawn)
        way = heading + bearing
        goal = Goal(distance * math.cos(way), distance * math.sin(way), None, GOAL_RADIUS_M)
        seed = int(rng.integers(2**32))
        world = World(self._obstacles(goal, seed), self.place.room, goal)
        twin = self._twin(spec, last, world, supply_pa=self.limits.pressure[1])
        return CrawlEpisode(self, twin, world, heading, CameraFrames(self._camera, seed), seed)

    def _obstacles(self, goal: Goal, seed: int) -> tuple[Any, ...]:
        if self.place.strewn is None:
            return ()
        clear = ((0.0, 0.0, _CLEAR_M), (goal.x, goal.y, _CLEAR_M))
        return random_circles(
            self.place.obstacles, self.place.strewn, seed, radius=_RADII_M, gap=_GAP_M, clear=clear
        )


class CrawlEpisode(Episode):
    """One try to get to a goal.

    Attributes:
        world: obstacles, room and goal.
    """

    state_attributes = ("_gait", "_frames", "_readings", "_distance")

    def __init__(
        self, task: CrawlTask, twin: TwinSnake, world: World, heading: float, frames: CameraFrames, seed: int
    ) -> None:
        """Lay the snake at the origin."""
        if world.goal is None:
            raise InputError("there is no goal to crawl to; give world.goal")
        self.world, self.goal = world, world.goal
        self._goal = world.goal
        limits = task.limits
        middle = GaitCommand(0.0, *(sum(ends) / 2 for ends in (limits.frequency, limits.pressure)))
        state = twin.reset(pose=(0.0, 0.0, heading), seed=seed)
        self._gait = CommandedGait(twin.spec, twin.tick, twin.pneumatics, middle)
        self._frames, self._readings = frames, SensorReadings(twin.spec.segments)
        self._distance = self._away(state)
        super().__init__(task, twin, state)

    def _placed(self) -> None:
        """See `Episode._placed`."""
        self._frames.restart()
        self._distance = self._away(self.state)

    def _valves(self, action: list[float]) -> np.ndarray:
        offset, frequency, kilopascal = action
        command = GaitCommand(offset, frequency, kilopascal * _PA_PER_KPA)
        return self._gait.valves(float(self.state.time), command)

    def _observed(self) -> list[float]:
        time = float(self.state.time)
        seen = self._frames.capture(self.state)
        assert seen is not None, "the camera has a frame a step"
        self._readings.update(time, self.state.sensed)
        c, s = math.cos(seen.heading), math.sin(seen.heading)

        def ahead_and_left(x: float, y: float) -> tuple[float, float]:
            dx, dy = x - seen.x, y - seen.y
            return c * dx + s * dy, c * dy - s * dx

        angle, command = self._gait.gait.angle(time), self._gait.command
        circles = [(*ahead_and_left(each.x, each.y), each.radius) for each in self.world.obstacles]
        pose = [seen.x, seen.y, c, s, *ahead_and_left(self._goal.x, self._goal.y)]
        wave = [math.cos(angle), math.sin(angle), *self._readings.value]
        given = [command.offset, command.frequency, command.pressure / _PA_PER_KPA]
        return [*pose, *wave, *given, *(number for circle in circles for number in circle)]

    def _judge(self) -> float:
        state, room = self.state, self.world.bounds
        before, self._distance = self._distance, self._away(state)
        reward = before - self._distance
        if self._touching():
            reward -= TOUCH_PER_S * self._task.step_s
        x, y = state.com
        if self._distance <= self._goal.radius:
            self.ending = "goal_reached"
            return reward + 1.0
        if room and not (room.x[0] <= x <= room.x[1] and room.y[0] <= y <= room.y[1]):
            self.ending = "room_left"
            return reward - 1.0
        return reward

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

    def _away(self, state: SnakeState) -> float:
        return math.hypot(self._goal.x - float(state.com[0]), self._goal.y - float(state.com[1]))


def gait_signals(limits: GaitLimits) -> Signals:
    """Return the numbers of a command."""
    low, high = (pressure / _PA_PER_KPA for pressure in limits.pressure)
    return (
        Signal("offset", "1", *limits.offset, "steering offset φ of the gait, positive to the left"),
        Signal(
            "frequency_hz", "Hz", *limits.frequency, "frequency of the gait, whose phase stays continuous"
        ),
        Signal("pressure_kpa", "kPa", low, high, "gauge pressure of the air supply"),
    )


def _observations(place: Field, segments: int, actions: Sequence[Signal]) -> Signals:
    (left, right), (bottom, top) = place.room.x, place.room.y
    across = math.hypot(right - left, top - bottom) + 1.0
    found = [
        Signal("x_m", "m", left - 0.5, right + 0.5, "centre of mass, from the camera"),
        Signal("y_m", "m", bottom - 0.5, top + 0.5, "centre of mass, from the camera"),
        Signal("heading_cos", "1", -1.0, 1.0, "cosine of the heading, from the camera"),
        Signal("heading_sin", "1", -1.0, 1.0, "sine of the heading, from the camera"),
        Signal("goal_ahead_m", "m", -across, across, "goal relative to the snake, along the heading"),
        Signal("goal_left_m", "m", -across, across, "goal relative to the snake, to the left"),
        Signal("gait_cos", "1", -1.0, 1.0, "cosine of the gait phase at the first segment"),
        Signal("gait_sin", "1", -1.0, 1.0, "sine of the gait phase at the first segment"),
    ]
    reach = MAX_READING_RAD
    found += numbered(segments, "bend_#_rad", "rad", -reach, reach, "sensor reading of a segment")
    found += [Signal(each.name, each.unit, each.low, each.high, "last command") for each in actions]
    for k in range(1, place.obstacles + 1):
        found += [
            Signal(
                f"obstacle_{k}_ahead_m",
                "m",
                -across,
                across,
                "centre of a circle relative to the snake, along the heading",
            ),
            Signal(
                f"obstacle_{k}_left_m",
                "m",
                -across,
                across,
                "centre of a circle relative to the snake, to the left",
            ),
            Signal(f"obstacle_{k}_radius_m", "m", *_RADII_M, "radius of the circle"),
        ]
    return tuple(found)
