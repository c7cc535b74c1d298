"""Interactive simulation of the twin in MuJoCo's viewer.

A scenario's controller steers the twin until the user presses a steering key. The arrow
keys change the steering offset (left, right) and the gait frequency (up, down), and the
page keys change the supply pressure. The Home key resets the offset, the space bar
pauses the simulation, and the backspace key restarts the run. The key codes are those
of GLFW.
"""

from __future__ import annotations

import os
import time as wall
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from srs_twin.control.base import Controller
from srs_twin.control.commands import CommandedGait, GaitCommand, GaitLimits
from srs_twin.control.gait import Gait
from srs_twin.errors import InputError
from srs_twin.plants.base import SnakeState
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import FloorLine, added_to
from srs_twin.viewing.plots.signals import goal_ring
from srs_twin.viewing.plots.style import GOAL_COLOR
from srs_twin.viewing.rerun.viewer import lacks_display

SPACE = 32
BACKSPACE = 259
RIGHT = 262
LEFT = 263
DOWN = 264
UP = 265
PAGE_UP = 266
PAGE_DOWN = 267
HOME = 268

_KEY_STEPS = {
    LEFT: ("offset", 16),
    RIGHT: ("offset", -16),
    UP: ("frequency", 10),
    DOWN: ("frequency", -10),
    PAGE_UP: ("pressure", 14),
    PAGE_DOWN: ("pressure", -14),
}
"""Gait parameter changed by each key, and signed number of steps in the full range.

One key press changes the offset by 0.05, the frequency by 0.1 Hz, or the pressure by
about 1 kPa.
"""

MAX_LAG_S = 0.25
"""Maximum lag of the simulation behind real time, s."""


class LiveSnake:
    """Twin steered by a scenario's controller or by keys.

    Attributes:
        scenario: simulated scenario, or None for a robot on an empty floor that is
            steered by keys.
        floor_lines: lines on the floor that show the scenario's goal and the
            controller's current plan.
    """

    state: SnakeState
    floor_lines: list[FloorLine]
    _gait: CommandedGait | None
    _controller: Controller | None

    def __init__(
        self,
        spec: RobotSpec | None = None,
        *,
        scenario: Scenario | None = None,
        modified: str = "",
    ) -> None:
        """Create the twin of a robot or a scenario.

        Without a scenario, all gait parameters start in the middle of their ranges.
        """
        self.scenario = scenario
        self._modified = modified
        if scenario is not None:
            twin = scenario.build_plant("twin")
            assert isinstance(twin, TwinSnake), "`build_plant` returns a TwinSnake"
            self.twin = twin
            limits = GaitLimits.for_robot(self.twin.spec)
            # The pneumatic model cannot exceed the supply pressure of the scenario.
            low, high = (min(limit, scenario.supply_pa) for limit in limits.pressure)
            limits = replace(limits, pressure=(low, high))
            pressure = high
            is_gait = self.twin.layout in Gait.layouts
            self._steerable = is_gait and not scenario.file.bench
        else:
            assert spec is not None, "a robot or a scenario"
            limits = GaitLimits.for_robot(spec)
            self.twin = TwinSnake(spec, supply_pa=limits.pressure[1])
            pressure = sum(limits.pressure) / 2
            self._steerable = True
        self.limits = limits
        self._initial_command = GaitCommand(0.0, sum(limits.frequency) / 2, pressure)
        self._keys: deque[int] = deque()
        self._reset()

    @property
    def finished(self) -> bool:
        """Whether the scenario's controller has finished."""
        return self._controller is not None and self._controller.finished

    def press(self, key: int) -> None:
        """Queue a key press for the next control tick. This method is thread-safe."""
        self._keys.append(key)

    def advance(self) -> SnakeState:
        """Process the queued keys, simulate one control tick and return the state."""
        while self._keys:
            self._handle(self._keys.popleft())
        if self.paused or self.finished:
            return self.state
        if self._controller is not None:
            self.state = self.twin.step(self._controller.step(self.state))
            if self._controller.events():  # the controller may have a new plan
                self._find_floor_lines()
        else:
            assert self._gait is not None, "see _take_over"
            self.state = self.twin.step(
                self._gait.valves(float(self.state.time), self.command)
            )
        return self.state

    def status_lines(self) -> list[tuple[str, str]]:
        """Return the label and the value of each status line in the window."""
        command = self.command
        speed = self.state.com_velocity
        if self._controller is None:
            lines = [
                ("offset (left, right)", f"{command.offset:+.2f}"),
                ("frequency (up, down)", f"{command.frequency:.2f} Hz"),
                ("pressure (page up, page down)", f"{command.pressure / 1e3:.1f} kPa"),
            ]
        else:
            lines = [("controller", self._controller.kind)]
            if self._steerable:
                lines.append(("arrows, page up, page down: steer by keys", ""))
        note = ", finished" if self.finished else ""
        if self.paused:
            note = ", paused"
        lines += [
            ("speed", f"{float((speed**2).sum()) ** 0.5:.3f} m/s"),
            ("time (space: pause)", f"{float(self.state.time):.1f} s{note}"),
            ("home: straight, backspace: restart", ""),
            ("colours of the body", "p+ > p-: purple, p+ < p-: green"),
        ]
        if self.floor_lines:
            names = [line.name.rpartition("/")[-1] for line in self.floor_lines]
            lines.append(("on the floor", ", ".join(names)))
        if self._modified:
            lines.append(("modified", self._modified))
        return lines

    def _reset(self) -> None:
        self.command = self._initial_command
        self.paused = False
        scenario = self.scenario
        self.floor_lines = []
        if scenario is None:
            self.state = self.twin.reset()
            self._take_over()
            return
        begin = scenario.initial_state
        seed = scenario.seed
        twin = self.twin
        if begin is None:
            self.state = twin.reset(pose=scenario.pose, seed=seed)
        else:
            self.state = begin(twin, seed)
        self._gait = None
        self._controller = scenario.build_controller()
        self._controller.reset(twin.spec, twin.tick, seed=seed)
        self._find_floor_lines()

    def _find_floor_lines(self) -> None:
        assert self.scenario is not None, "a scenario is played"
        assert self._controller is not None, "a scenario is played"
        goal = self.scenario.world.goal
        run = Trajectory({}, metadata={"control": self._controller.describe()})
        if pictures := added_to(run):
            self.floor_lines = pictures.floor_lines(run, latest=True)
        elif goal is not None:
            ring = goal_ring(goal.x, goal.y, goal.radius)
            self.floor_lines = [FloorLine("goal", (ring,), GOAL_COLOR, _GOAL_LINE_M)]

    def _take_over(self) -> None:
        twin = self.twin
        self._gait = CommandedGait(
            twin.spec, twin.tick, twin.pneumatics, self._initial_command
        )
        self._controller = None

    def _handle(self, key: int) -> None:
        if key == BACKSPACE:
            self._reset()
        elif key == SPACE:
            self.paused = not self.paused
        elif not self._steerable:
            return
        elif key == HOME and self._gait is not None:
            self.command = replace(self.command, offset=0.0)
        elif key in _KEY_STEPS:
            if self._gait is None:
                self._take_over()
            name, steps = _KEY_STEPS[key]
            low, high = getattr(self.limits, name)
            value = getattr(self.command, name) + (high - low) / steps
            self.command = self.limits.clipped(replace(self.command, **{name: value}))


def steer(
    snake: LiveSnake,
    window: MujocoWindow,
    *,
    clock: Callable[[], float] = wall.perf_counter,
    sleep: Callable[[float], None] = wall.sleep,
) -> None:
    """Simulate and draw a snake in real time until the window is closed.

    If drawing is too slow, frames are skipped until the simulation has caught up with
    real time. Both `clock` and `sleep` use seconds.
    """
    tick = snake.twin.tick
    due = clock()
    undrawn = 0.0  # simulated time since the last drawn frame, s
    while window.is_open():
        snake.advance()
        due = max(due + tick, clock() - MAX_LAG_S)
        undrawn += tick
        if due >= clock() or undrawn >= MAX_LAG_S:
            window.show(snake)
            undrawn = 0.0
        remaining = due - clock()
        if remaining > 0:
            sleep(remaining)


_DISTANCE_LENGTHS = 4.0
"""Camera distance, in body lengths."""

_GOAL_LINE_M = 0.002
"""Half-width of the line around the goal, m."""

_AZIMUTH_DEG = 90.0
_ELEVATION_DEG = -35.0


class MujocoWindow:
    """MuJoCo viewer window for displaying and steering a snake."""

    def __init__(self, snake: LiveSnake) -> None:
        require_display()
        import mujoco
        import mujoco.viewer

        from srs_twin.viewing.mujoco.stage import Skins, make_obstacles_translucent

        physics = snake.twin.physics
        model = physics.model
        data = physics.data
        try:
            self._viewer = mujoco.viewer.launch_passive(
                model,
                data,
                key_callback=snake.press,
                show_left_ui=False,
                show_right_ui=False,
            )
        except RuntimeError as error:
            raise InputError(f"MuJoCo's viewer cannot be opened: {error}") from error
        self._skins = Skins(model, snake.twin.spec.segments)
        make_obstacles_translucent(model)
        self._drawn: list[FloorLine] = []
        camera = self._viewer.cam
        camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        camera.trackbodyid = model.body("connector_1").rootid[0]
        camera.distance = _DISTANCE_LENGTHS * snake.twin.spec.geometry.body_length
        camera.azimuth = _AZIMUTH_DEG
        camera.elevation = _ELEVATION_DEG

    def __enter__(self) -> MujocoWindow:
        return self

    def __exit__(self, *error: object) -> None:
        self._viewer.close()

    def is_open(self) -> bool:
        """Return whether the window is open."""
        return bool(self._viewer.is_running())

    def show(self, snake: LiveSnake) -> None:
        """Draw the current state of a snake."""
        names, values = (
            "\n".join(column) for column in zip(*snake.status_lines(), strict=True)
        )
        self._skins.show(snake.state.pressure, snake.twin.spec.supply.nominal)
        self._viewer.set_texts((None, None, names, values))
        self._draw_floor_lines(snake.floor_lines)
        self._viewer.sync()

    def _draw_floor_lines(self, lines: list[FloorLine]) -> None:
        from srs_twin.viewing.mujoco.stage import add_line

        scene = self._viewer.user_scn
        if lines is self._drawn or scene is None:
            return
        with self._viewer.lock():
            scene.ngeom = 0
            self._drawn = lines
            for line in lines:
                for strip in line.strips:
                    add_line(scene, strip, line.color, line.radius)


def require_display() -> None:
    """Raise an `InputError` if no window can be opened."""
    if lacks_display():
        raise InputError(
            "no display was found: neither DISPLAY nor WAYLAND_DISPLAY is set; run"
            " this command on a machine with a screen, or use `srs-twin run SCENARIO`,"
            " which needs no display"
        )
    import warnings

    import glfw

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        usable = glfw.init()
    if not usable:
        reason = "GLFW cannot be used"
        if caught:
            reason = str(caught[-1].message)
        display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        raise InputError(
            f"the display {display} does not respond ({reason}); set DISPLAY to a"
            " display that responds"
        )
