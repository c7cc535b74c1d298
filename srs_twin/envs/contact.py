"""Pegs and Grasp: crawl out of a field of posts, and drag an object with the tail.

Pegs: the skin of the snake has the same friction in every direction, so that it hardly moves without posts.
The episode ends at a given distance from its start, in any direction. Grasp: the tail of a chain of modules
has to curl around a cylinder and drag it. Both rewards use potentials, as in `crawling`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from srs_twin.control.base import MAX_READING_RAD, SensorReadings
from srs_twin.control.gait import Gait
from srs_twin.control.grasp import check_hold, hold_with
from srs_twin.envs.crawling import CAMERA, STEP_S, Arena, CrawlEpisode, CrawlTask
from srs_twin.envs.task import Episode, RewardTerm, Robot, Signal, Signals, Task, numbered_signals
from srs_twin.planning.camera import Camera, CameraFrames
from srs_twin.plants.base import SnakeState
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import GRAVITY
from srs_twin.robot.world import Bounds, Goal, MovableObject, World, peg_field

_SKIN = {"law": "ellipse", "points_per_segment": 3, "forward": 0.3, "backward": 0.3, "transverse": 0.3}
ISOTROPIC_SKIN = {"base": "skin_example", "contact": _SKIN}
"""Robot of the scenario pegs_skin."""

FIELD_RADIUS_M = 0.5
"""Distance from the start at which the field counts as crossed, m."""

_PITCH_M, _RADIUS_M, _JITTER_M, _FRICTION = 0.13, 0.02, 0.005, 0.2  # as in pegs_skin
_ROWS, _COLUMNS = 10, 12
_SEEN_PEGS = 4
"""Number of posts in an observation."""

_ROOM = Bounds((-1.5, 1.5), (-1.5, 1.5))


class PegsTask(CrawlTask):
    """Task of crawling out of a field of posts (module docstring)."""

    # Among posts, contact is no failure.
    reward_terms = tuple(
        replace(term, weight=0.0) if term.name == "touching_s" else term for term in CrawlTask.reward_terms
    )

    def __init__(
        self,
        *,
        robot: Robot = ISOTROPIC_SKIN,
        limit_s: float = 15.0,
        camera: Camera = CAMERA,
        **settings: Any,
    ) -> None:
        """Create the task; arguments and errors as in `CrawlTask`, with 3 hinges per segment."""
        arena = Arena(_ROOM, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), obstacles=1)
        settings = {"hinges_per_segment": 3, **settings}
        super().__init__("Pegs", arena, robot=robot, limit_s=limit_s, camera=camera, **settings)

    def _set_observations(self, groups: Any) -> None:
        kept = {name: signals for name, signals in groups.items() if name not in ("goal", "obstacles")}
        far, pegs = 3.0, []
        for k in range(1, _SEEN_PEGS + 1):
            text = f"position of the post with rank {k} by distance"
            pegs += [
                Signal(f"peg_{k}_ahead_m", "m", -far, far, f"{text}, along the heading"),
                Signal(f"peg_{k}_left_m", "m", -far, far, f"{text}, to the left of the heading"),
            ]
        super()._set_observations(kept | {"pegs": tuple(pegs)})

    def begin(self, rng: np.random.Generator, last: Episode | None = None) -> PegsEpisode:
        """See `Task.begin`."""
        spec, seed = self._variation.draw(rng), int(rng.integers(2**32))
        # Even numbers of rows and columns put the snake in the middle between two rows.
        first = (-(_COLUMNS - 1) / 2 * _PITCH_M, 0.0)
        pegs = peg_field(_PITCH_M, _RADIUS_M, _ROWS, _COLUMNS, first, seed, jitter=_JITTER_M)
        world = World(pegs, _ROOM, Goal(0.0, 0.0, None, FIELD_RADIUS_M), friction=_FRICTION)
        twin = self._twin(spec, last, world, supply_pa=self.limits.pressure[1])
        return PegsEpisode(self, twin, world, 0.0, CameraFrames(self._camera, seed), seed)


class PegsEpisode(CrawlEpisode):
    """Episode of crawling out of a field; the goal is the circle around the start."""

    def _measure(self) -> list[float]:
        values = super()._measure()
        posts = np.reshape(values[-3 * len(self.world.obstacles) :], (-1, 3))
        nearest = posts[np.argsort(np.hypot(posts[:, 0], posts[:, 1]), kind="stable")[:_SEEN_PEGS], :2]
        # Without the position of the goal, which follows that of the camera.
        return [*values[:4], *values[6 : -3 * len(posts)], *map(float, nearest.ravel())]

    def _goal_distance(self, state: SnakeState) -> float:
        """Return the distance to the circle, m."""
        return self._goal.radius - super()._goal_distance(state)

    def _has_arrived(self, distance: float) -> bool:
        return distance <= 0


CHAIN = {"base": "gen2", "geometry": {"connectors": 13}, "gait": {"phase_step_rad": math.pi / 4}}
"""Robot of the scenario grasp_cylinder: twelve modules, of which eight crawl with one wave."""

HOLD = 4
"""Number of holding modules, at the tail."""

DRAG_M = 0.3
"""Distance by which the object must move, m."""

GRASP_FREQUENCY_HZ = 2.0
"""Gait frequency of the crawling modules, Hz."""

_LOST_M = 0.25
"""Distance of the object from the middle of the holding modules beyond which it is lost, m. It begins within
0.1 m, and a tail that curls to the wrong side stays within this distance."""

_PULSES = 5
"""Pulses of the holding modules in a step; a slower carrier would push the object away."""
_SLOTS = 100
"""Slots of a step with constant valves."""

# Ranges of the objects as in docs/objects.md.
_OBJECT_RADII_M, _MASSES_KG, _LOADS_N = (0.020, 0.030), (0.02, 0.10), (0.05, 0.25)
_BEHIND_M, _GAPS_M = (0.12, 0.16), (0.002, 0.015)


class GraspTask(Task):
    """Task of dragging a cylinder with the tail (module docstring)."""

    name, step_s = "Grasp", STEP_S
    has_obstacles = True
    reward_terms = (
        RewardTerm("progress_m", 1.0, "increase of the distance of the object from its start"),
        RewardTerm("dragged", 1.0, f"1 in the step in which this distance reaches {DRAG_M:g} m"),
        RewardTerm("object_lost", -1.0, "1 in the step in which the object has left the tail"),
        RewardTerm("time_s", 0.0, "duration of the step"),
        RewardTerm("air_j", 0.0, "energy of the air taken from the supply"),
    )

    def __init__(
        self, *, robot: Robot = CHAIN, limit_s: float = 12.0, camera: Camera = CAMERA, **settings: Any
    ) -> None:
        """Create the task.

        Args:
            robot: name, path or keys of a robot with at least six modules.
            limit_s: time limit, s.
            camera: noise of the camera.
            **settings: see `Task`.

        Raises:
            UnknownNameError: the twin does not have a setting of that name.
            InputError: the robot, fit, range or time limit is invalid.
        """
        super().__init__(robot, limit_s, **settings)
        check_hold(HOLD, self.robot)
        self._camera = camera
        self.actions = (
            Signal("grip", "1", -1.0, 1.0, "duty of the holding modules; positive values bend to the left"),
            Signal("drive", "1", 0.0, 1.0, "the other modules use the gait above 0.5, otherwise they vent"),
            Signal("offset", "1", -0.4, 0.4, "steering offset φ of the gait, positive to the left"),
        )
        self._set_observations(_grasp_groups(self.robot.segments, self.actions))

    def begin(self, rng: np.random.Generator, last: Episode | None = None) -> GraspEpisode:
        """See `Task.begin`."""
        spec, seed = self._variation.draw(rng), int(rng.integers(2**32))
        ranges = (_OBJECT_RADII_M, _MASSES_KG, _LOADS_N, _BEHIND_M, _GAPS_M)
        radius, mass, load, behind, gap = (float(rng.uniform(*limits)) for limits in ranges)
        side, geometry = (1 if rng.random() < 0.5 else -1), spec.geometry
        front = geometry.body_length / 2 - (geometry.segments - HOLD) * geometry.pitch
        y = side * (geometry.width / 2 + gap + radius)
        item = MovableObject((radius,), mass, load / (mass * GRAVITY), front - behind, y)
        twin = self._twin(spec, last, World(objects=(item,)))
        return GraspEpisode(self, twin, item, CameraFrames(self._camera, seed), seed)


class GraspEpisode(Episode):
    """Episode of dragging an object."""

    state_attributes: ClassVar[tuple[str, ...]] = (
        "_gait", "_frames", "_readings", "_command", "_driven", "_moved", "_air"
    )  # fmt: skip

    def __init__(
        self, task: GraspTask, twin: TwinSnake, item: MovableObject, frames: CameraFrames, seed: int
    ) -> None:
        """Place the straight snake at the origin."""
        state = twin.reset(seed=seed)
        self._item, self._frames, self._readings = item, frames, SensorReadings(twin.spec.segments)
        self._gait = Gait(GRASP_FREQUENCY_HZ)
        self._gait.reset(twin.spec, twin.tick)
        self._command, self._driven, self._moved, self._air = [0.0, 0.0, 0.0], 0.0, 0.0, float(state.air)
        super().__init__(task, twin, state)

    def _initialise_from_state(self) -> None:
        """See `Episode._initialise_from_state`."""
        self._frames.restart()
        self._moved, self._air = self._distance_moved(), float(self.state.air)

    def _valves(self, action: list[float]) -> np.ndarray:
        grip, drive, self._gait.offset = self._command = action
        if drive > 0.5:
            valves = np.asarray(self._gait.valves_at(self._driven))
            self._driven += self._task.step_s
        else:
            valves = np.full((self.twin.spec.segments, 2), -1, dtype=np.int8)
        if valves.ndim == 2:
            valves = np.repeat(valves[None], _SLOTS, axis=0)
        hold_with(valves, HOLD, grip, _PULSES)
        return valves

    def _object_place(self) -> tuple[float, float]:
        # The object is the last tree of the twin: x, y and heading.
        x, y, _ = self.twin.physics.data.qpos[-3:]
        return float(x), float(y)

    def _distance_moved(self) -> float:
        x, y = self._object_place()
        return math.hypot(x - self._item.x, y - self._item.y)

    def _measure(self) -> list[float]:
        time = float(self.state.time)
        seen = self._frames.capture(self.state)
        assert seen is not None, "the camera has one frame per step"
        self._readings.update(time, self.state.sensed)
        c, s = math.cos(seen.heading), math.sin(seen.heading)
        x, y = self._object_place()
        dx, dy = x - seen.x, y - seen.y
        angle = self._gait.angle(self._driven)
        place = [c * dx + s * dy, c * dy - s * dx, self._item.size[0]]
        return [
            *(seen.x, seen.y, c, s), *place, math.cos(angle), math.sin(angle), *self._readings.value,
            *self._command,
        ]  # fmt: skip

    def _reward_values(self) -> dict[str, float]:
        moved, air = self._distance_moved(), float(self.state.air)
        before, self._moved = self._moved, moved
        air_before, self._air = self._air, air
        middle = np.asarray(self.state.position)[-HOLD - 1 :].mean(axis=0)
        if moved >= DRAG_M:
            self.ending = "dragged"
        elif np.hypot(*(np.array(self._object_place()) - middle)) > _LOST_M:
            self.ending = "object_lost"
        return {
            "progress_m": moved - before,
            "dragged": float(self.ending == "dragged"),
            "object_lost": float(self.ending == "object_lost"),
            "time_s": self._task.step_s,
            "air_j": air - air_before,
        }

    def _info(self) -> dict[str, Any]:
        x, y = self._object_place()
        return super()._info() | {
            "com_x_m": float(self.state.com[0]),
            "com_y_m": float(self.state.com[1]),
            "object_x_m": x,
            "object_y_m": y,
            "object_moved_m": self._moved,
        }


def _grasp_groups(segments: int, actions: Signals) -> dict[str, Signals]:
    far, largest = 3.0, MAX_READING_RAD
    return {
        "pose": (
            Signal("x_m", "m", -far, far, "x of the centre of mass, from the camera"),
            Signal("y_m", "m", -far, far, "y of the centre of mass, from the camera"),
            Signal("heading_cos", "1", -1.0, 1.0, "cosine of the mean heading, from the camera"),
            Signal("heading_sin", "1", -1.0, 1.0, "sine of the mean heading, from the camera"),
        ),
        "object": (
            Signal("object_ahead_m", "m", -far, far, "position of the object along the heading"),
            Signal("object_left_m", "m", -far, far, "position of the object to the left of the heading"),
            Signal("object_radius_m", "m", *_OBJECT_RADII_M, "radius of the object"),
        ),
        "gait": (
            Signal("gait_cos", "1", -1.0, 1.0, "cosine of the gait phase at the first segment"),
            Signal("gait_sin", "1", -1.0, 1.0, "sine of the gait phase at the first segment"),
        ),
        "bends": tuple(
            numbered_signals(segments, "bend_#_rad", "rad", -largest, largest, "sensor reading of a bend")
        ),
        "command": tuple(replace(action, description="last command") for action in actions),
    }
