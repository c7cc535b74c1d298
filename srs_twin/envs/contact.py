"""Tasks Pegs and Grasp, in which a snake crawls among pegs or drags an object.

In the task Pegs, the snake crawls to a goal among pegs. The friction of its skin is
isotropic, so the snake hardly moves without pegs. Among pegs, almost every gait moves
the snake. The goal may be in any direction, so the snake must be steered to reach it.

In the task Grasp, a cylinder stands to the left or to the right of the body. The snake
must crawl forward until the cylinder is beside its tail. Then the snake must curl its
tail around the cylinder and drag the cylinder. The phase lag of the gait sets the
length of the body waves. A snake with short waves passes the cylinder almost without
contact. Long waves push the cylinder, but are faster, so they suit the drag.

The cylinder is gripped if two of its contact forces on the tail are nearly opposite.
The cylinder is held if it has been gripped for the last `HELD_S` seconds without
slipping. Motion of the cylinder is rewarded only while it is gripped, so pushing the
cylinder away earns nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Unpack

import numpy as np

from srs_twin.control.gait import Gait
from srs_twin.control.grasp import check_hold, hold_with
from srs_twin.envs.crawling import Arena, CrawlEpisode, CrawlKeywords, CrawlTask
from srs_twin.envs.observed import (
    CAMERA,
    COSTS,
    CameraTask,
    ObservedEpisode,
    ahead_and_left,
    observation_groups,
    place_signals,
)
from srs_twin.envs.task import Episode, RewardTerm, Signal, Signals, TaskKeywords
from srs_twin.envs.variation import Robot
from srs_twin.planning.camera import Camera
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import GRAVITY
from srs_twin.robot.world import Bounds, Circle, Goal, MovableObject, World, peg_field

_SKIN = {
    "law": "ellipse",
    "points_per_segment": 3,
    "forward": 0.3,
    "backward": 0.3,
    "transverse": 0.3,
}
ISOTROPIC_SKIN = {"base": "skin_example", "contact": _SKIN}
"""Robot with isotropic skin friction, as in the scenario `pegs_skin`."""

_GOAL_DISTANCES_M = (0.8, 1.0)
"""Minimum and maximum distance between the start and the goal, m."""

# Grid spacing, radius, maximum random displacement and friction coefficient of the pegs
# are taken from the scenario `pegs_skin`.
_PITCH_M = 0.13

_RADIUS_M = 0.02

_JITTER_M = 0.005

_FRICTION = 0.2

_ROWS = 18
"""Number of peg rows, which is even so that the snake starts between two rows."""

_COLUMNS = 18

_SEEN_PEGS = 4
"""Number of nearest pegs that the agent observes."""

_FAR_M = 3.0
"""Maximum absolute value of observed coordinates, m."""

_ROOM = Bounds((-1.5, 1.5), (-1.5, 1.5))
"""Room of the task Pegs."""


class PegsEpisode(CrawlEpisode):
    """Episode of the task Pegs."""

    collisions_end = False

    def _measure(self) -> dict[str, Sequence[float]]:
        values = super()._measure()
        posts = np.reshape(values["obstacles"], (-1, 3))
        nearest = np.argsort(np.hypot(posts[:, 0], posts[:, 1]), kind="stable")[
            :_SEEN_PEGS
        ]
        return values | {"pegs": posts[nearest, :2].ravel().tolist()}


class PegsTask(CrawlTask):
    """Task in which a snake crawls to a goal among pegs."""

    episode_class = PegsEpisode

    def __init__(
        self,
        *,
        robot: Robot = ISOTROPIC_SKIN,
        limit_s: float = 12.0,
        **settings: Unpack[CrawlKeywords],
    ) -> None:
        """Create the task with a default of 3 hinges per segment.

        See `CrawlTask` for the arguments and errors.
        """
        arena = Arena(
            _ROOM,
            (0.0, 0.0),
            _GOAL_DISTANCES_M,
            (-math.pi, math.pi),
            1,
            friction=_FRICTION,
        )
        defaults: CrawlKeywords = {"hinges_per_segment": 3}
        super().__init__(
            "Pegs", arena, robot=robot, limit_s=limit_s, **(defaults | settings)
        )

    def _observation_groups(self) -> dict[str, Signals]:
        groups = super()._observation_groups()
        del groups["obstacles"]
        pegs: list[Signal] = []
        for k in range(1, _SEEN_PEGS + 1):
            text = f"position of peg {k}, in order of distance,"
            pegs += place_signals(f"peg_{k}", _FAR_M, text)
        return groups | {"pegs": tuple(pegs)}

    def _draw_obstacles(self, goal: Goal, seed: int) -> tuple[Circle, ...]:
        first = (-(_COLUMNS - 1) / 2 * _PITCH_M, 0.0)
        return peg_field(
            _PITCH_M, _RADIUS_M, _ROWS, _COLUMNS, first, seed, jitter=_JITTER_M
        )


CHAIN = {"base": "gen2", "geometry": {"connectors": 13}}
"""Robot with twelve modules."""

MAX_PHASE_STEP_RAD = 2 * math.pi / 3
"""Maximum phase lag per module of the gait, rad.

With this phase lag, a crawling snake swings to the side by about 25 mm.
"""

_MIN_PHASE_STEP_RAD = math.pi / 3
"""Minimum phase lag per module of the gait, rad."""

HOLD = 4
"""Number of holding modules, which are the rearmost modules of the snake."""

DRAG_M = 0.3
"""Distance by which the object must be dragged to complete the task, m."""

HELD_S = 2.0
"""Time for which the object must be held to complete the task, s."""

_OPPOSITE_RAD = 2 * math.pi / 3
"""Angle between two contact forces above which the forces count as opposite, rad."""

_TOUCH_N = 0.02
"""Mean force in a step above which a connector counts as touching the object, N."""

_SLIP_M = 0.02
"""Maximum change in the distance between a held object and each rear connector, m."""

GRASP_FREQUENCY_HZ = 3.0
"""Gait frequency of the crawling modules, Hz."""

TIMESTEP_S = 0.002
"""Time step of the twin in the task Grasp, s (docs/objects.md)."""

_LOST_M = 0.2
"""Distance between the object and the nearest connector above which the object counts
as lost, m.

At the start, the distance is below 0.1 m.
"""

_PULSES = 5
"""Number of fill pulses per step in the holding modules.

With fewer pulses, the curling tail would push the object away.
"""
_SLOTS = 100
"""Number of time slots per step, in each of which the valve states are constant."""

# The radius and mass of the object, and its friction force on the floor, have the same
# ranges as in docs/objects.md.
_OBJECT_RADII_M = (0.020, 0.030)

_MASSES_KG = (0.02, 0.10)

_LOADS_N = (0.05, 0.25)

_AHEAD_M = (-0.1, 0.3)
"""Minimum and maximum position of the object relative to the front of the tail,
positive ahead, m.

The tail can grasp an object that is 0.06 to 0.14 m behind the front of the tail.
"""

_GAPS_M = (0.025, 0.04)
"""Minimum and maximum gap between the object and the straight body, m.

At smaller gaps, even short waves push the object. At gaps of 0.045 m and more, the tail
often misses the object.
"""


class GraspTask(CameraTask):
    """Task in which a snake approaches, grasps and drags a cylinder with its tail."""

    name = "Grasp"
    has_obstacles = True
    reward_terms = (
        RewardTerm(
            "progress_m",
            1.0,
            "increase of the object's distance from its start while gripped",
        ),
        RewardTerm(
            "dragged",
            1.0,
            f"1 in the step in which the object, held for {HELD_S:g} s, has moved by"
            f" {DRAG_M:g} m",
        ),
        RewardTerm(
            "object_lost", -1.0, "1 in the step in which the snake has left the object"
        ),
        *COSTS,
    )

    def __init__(
        self,
        *,
        robot: Robot = CHAIN,
        limit_s: float = 12.0,
        camera: Camera = CAMERA,
        **settings: Unpack[TaskKeywords],
    ) -> None:
        """Create the task.

        Args:
            robot: robot with at least six modules, specified as in `Task`.
            limit_s: time limit, s.
            camera: frame rate and noise of the camera.
            **settings: further arguments of `Task`.

        Raises:
            UnknownNameError: a setting of the twin has an unknown name.
            InputError: the robot, fit, range or time limit is invalid.
        """
        defaults: TaskKeywords = {"timestep": TIMESTEP_S}
        super().__init__(robot, limit_s, **(defaults | settings))
        check_hold(HOLD, self.robot)
        self.camera = camera
        self.actions = (
            Signal(
                "grip",
                "1",
                -1.0,
                1.0,
                "duty of the holding modules; positive values bend to the left",
            ),
            Signal(
                "drive",
                "1",
                0.0,
                1.0,
                "above 0.5, the crawling modules run the gait; otherwise they vent",
            ),
            Signal(
                "offset",
                "1",
                -0.4,
                0.4,
                "steering offset φ of the gait, positive to the left",
            ),
            Signal(
                "phase_lag_rad",
                "rad",
                _MIN_PHASE_STEP_RAD,
                MAX_PHASE_STEP_RAD,
                "phase lag of the gait per module; a large phase lag makes short waves",
            ),
        )
        radius = Signal(
            "object_radius_m", "m", *_OBJECT_RADII_M, "radius of the object"
        )
        item = (*place_signals("object", _FAR_M, "position of the object"), radius)
        bounds = Bounds((-_FAR_M, _FAR_M), (-_FAR_M, _FAR_M))
        groups = observation_groups(bounds, {"object": item}, self.robot, self.actions)
        self._set_observations(groups)

    def begin(
        self, rng: np.random.Generator, last: Episode | None = None
    ) -> GraspEpisode:
        """See `Task.begin`."""
        spec = self._variation.draw(rng)
        seed = int(rng.integers(2**32))
        radius = float(rng.uniform(*_OBJECT_RADII_M))
        mass = float(rng.uniform(*_MASSES_KG))
        load = float(rng.uniform(*_LOADS_N))
        ahead = float(rng.uniform(*_AHEAD_M))
        gap = float(rng.uniform(*_GAPS_M))
        side = 1 if rng.random() < 0.5 else -1
        geometry = spec.geometry
        front = geometry.body_length / 2 - (geometry.segments - HOLD) * geometry.pitch
        y = side * (geometry.width / 2 + gap + radius)
        item = MovableObject((radius,), mass, load / (mass * GRAVITY), front + ahead, y)
        twin = self._twin(spec, last, World(objects=(item,)))
        return GraspEpisode(self, twin, item, seed)


class GraspEpisode(ObservedEpisode):
    """Episode of the task Grasp."""

    state_attributes: ClassVar[tuple[str, ...]] = (
        "_command",
        "_driven",
        "_moved",
        "_grips",
    )

    def __init__(
        self, task: GraspTask, twin: TwinSnake, item: MovableObject, seed: int
    ) -> None:
        """Start the episode with a straight snake at the origin."""
        state = twin.reset(seed=seed)
        self._item = item
        self._gait = Gait(GRASP_FREQUENCY_HZ)
        self._gait.reset(twin.spec, twin.tick)
        self._command = [0.0, 0.0, 0.0, _MIN_PHASE_STEP_RAD]
        self._driven = 0.0
        self._moved = 0.0
        self._grips: list[np.ndarray] = []
        super().__init__(task, twin, state, seed)

    def _initialise_from_state(self) -> None:
        super()._initialise_from_state()
        self._moved = self._distance_moved()
        self._grips = []

    def _valves(self, action: list[float]) -> np.ndarray:
        self._command = action
        grip, drive, self._gait.offset, phase_lag = action
        self._gait.set_phase_step(phase_lag)
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
        # The last three joint coordinates are the x, y and heading of the object.
        x, y, _ = self.twin.physics.data.qpos[-3:]
        return float(x), float(y)

    def _distance_moved(self) -> float:
        x, y = self._object_place()
        return math.hypot(x - self._item.x, y - self._item.y)

    def _gait_angle(self) -> float:
        return self._gait.angle(self._driven)

    def _last_command(self) -> list[float]:
        return self._command

    def _measure(self) -> dict[str, Sequence[float]]:
        seen, values = self._observe()
        return values | {
            "object": [*ahead_and_left(seen, *self._object_place()), self._item.size[0]]
        }

    def _is_gripped(self) -> bool:
        forces = np.asarray(self.state.obstacle_force)[-HOLD - 1 :]
        directions = [
            np.arctan2(y, x) for x, y in forces if math.hypot(x, y) > _TOUCH_N
        ]
        turns = np.subtract.outer(directions, directions)
        return bool((np.cos(turns) <= math.cos(_OPPOSITE_RAD)).any())

    def _is_held(self) -> bool:
        steps = round(HELD_S / self._task.step_s)
        return len(self._grips) >= steps and bool(
            (np.ptp(self._grips[-steps:], axis=0) <= _SLIP_M).all()
        )

    def _reward_values(self) -> dict[str, float]:
        before = self._moved
        self._moved = self._distance_moved()
        gripped = self._is_gripped()
        connectors = np.asarray(self.state.position)
        distances = np.hypot(*(connectors - self._object_place()).T)
        # The last distances describe the position of the object relative to the tail.
        self._grips = [*self._grips, distances[-HOLD:]] if gripped else []
        if self._moved >= DRAG_M and self._is_held():
            self.ending = "dragged"
        elif distances.min() > _LOST_M:
            self.ending = "object_lost"
        return {
            "progress_m": gripped * (self._moved - before),
            "dragged": float(self.ending == "dragged"),
            "object_lost": float(self.ending == "object_lost"),
            **self._costs(),
        }

    def _info(self) -> dict[str, object]:
        x, y = self._object_place()
        return super()._info() | {
            "object_x_m": x,
            "object_y_m": y,
            "object_moved_m": self._moved,
            "held": self._is_held(),
        }
