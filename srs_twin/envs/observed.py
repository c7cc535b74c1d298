"""Base classes for tasks with a gait, a camera and bend sensors."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

from srs_twin.control.base import MAX_READING_RAD, SensorReadings
from srs_twin.envs.task import Episode, RewardTerm, Signal, Signals, Task
from srs_twin.planning.camera import Camera, CameraFrames
from srs_twin.plants.base import SnakeState
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Bounds, Pose

STEP_S = 0.1
"""Duration of a step, s."""

CAMERA = Camera(1 / STEP_S, 0.001, 0.005)
"""Camera with one frame per step and noise of 1 mm (position) and 5 mrad (heading)."""

COSTS = (
    RewardTerm("time_s", 0.0, "duration of the step"),
    RewardTerm("air_j", 0.0, "energy of the air taken from the supply"),
)
"""Reward terms that all tasks with a camera share."""


class CameraTask(Task):
    """Task in which a camera observes the snake.

    Attributes:
        camera: frame rate and noise of the camera.
    """

    camera: Camera
    step_s = STEP_S


class ObservedEpisode(Episode):
    """Episode of a snake with a gait, a camera and bend sensors."""

    state_attributes: ClassVar[tuple[str, ...]] = (
        "_gait",
        "_frames",
        "_readings",
        "_air",
    )

    def __init__(
        self, task: CameraTask, twin: TwinSnake, state: SnakeState, seed: int
    ) -> None:
        self._frames = CameraFrames(task.camera, seed)
        self._readings = SensorReadings(state.measured_bend.size)
        self._air = float(state.pneumatic_energy)
        super().__init__(task, twin, state)

    def _initialise_from_state(self) -> None:
        self._frames.restart()
        self._air = float(self.state.pneumatic_energy)

    def _observe(self) -> tuple[Pose, dict[str, Sequence[float]]]:
        seen = self._frames.capture(self.state)
        assert seen is not None, "the camera has one frame per step"
        # All lateral bends precede the upward bends.
        bends = self.state.measured_bend.T.ravel()
        self._readings.update(float(self.state.time), bends)
        angle = self._gait_angle()
        return seen, {
            "pose": [seen.x, seen.y, math.cos(seen.heading), math.sin(seen.heading)],
            "gait": [math.cos(angle), math.sin(angle)],
            "bends": self._readings.value.tolist(),
            "command": self._last_command(),
        }

    @abstractmethod
    def _gait_angle(self) -> float:
        """Return the phase angle of the gait at the first segment, rad."""

    @abstractmethod
    def _last_command(self) -> list[float]:
        """Return the last command, with one value per action signal."""

    def _costs(self) -> dict[str, float]:
        before = self._air
        self._air = float(self.state.pneumatic_energy)
        return {"time_s": self._task.step_s, "air_j": self._air - before}

    def _info(self) -> dict[str, object]:
        x, y = map(float, self.state.com)
        return super()._info() | {"com_x_m": x, "com_y_m": y}


def ahead_and_left(seen: Pose, x: float, y: float) -> tuple[float, float]:
    """Transform a point into the frame of an observed pose (x ahead, y left), m."""
    c = math.cos(seen.heading)
    s = math.sin(seen.heading)
    dx = x - seen.x
    dy = y - seen.y
    return c * dx + s * dy, c * dy - s * dx


def place_signals(name: str, far: float, description: str) -> Signals:
    """Return the two signals of a position relative to the observed pose of the snake.

    The signals range from −`far` to `far` (m).
    """
    return (
        Signal(f"{name}_ahead_m", "m", -far, far, f"{description} along the heading"),
        Signal(
            f"{name}_left_m",
            "m",
            -far,
            far,
            f"{description} to the left of the heading",
        ),
    )


def observation_groups(
    bounds: Bounds,
    target: Mapping[str, Signals],
    robot: RobotSpec,
    actions: Iterable[Signal],
) -> dict[str, Signals]:
    """Return the observation signals of a task with a camera, keyed by group name.

    The result includes the groups in `target`, which describe the goal or the object.
    """
    bends = _bend_signals("bend", "a bend", robot)
    if robot.is_spatial:
        bends += _bend_signals("pitch", "a bend upwards", robot)
    return {
        "pose": (
            Signal("x_m", "m", *bounds.x, "x of the centre of mass, from the camera"),
            Signal("y_m", "m", *bounds.y, "y of the centre of mass, from the camera"),
            *_angle_signals("heading", "the mean heading, from the camera"),
        ),
        **target,
        "gait": _angle_signals("gait", "the gait phase at the first segment"),
        "bends": bends,
        "command": tuple(
            replace(action, description="last command") for action in actions
        ),
    }


def _angle_signals(name: str, angle: str) -> Signals:
    return (
        Signal(f"{name}_cos", "1", -1.0, 1.0, f"cosine of {angle}"),
        Signal(f"{name}_sin", "1", -1.0, 1.0, f"sine of {angle}"),
    )


def _bend_signals(name: str, bend: str, robot: RobotSpec) -> Signals:
    largest = MAX_READING_RAD
    text = f"sensor reading of {bend}"
    return tuple(
        Signal(f"{name}_{k}_rad", "rad", -largest, largest, text)
        for k in range(1, robot.segments + 1)
    )
