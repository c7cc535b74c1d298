"""A twin that a person steers by keys while it crawls, in real time, and MuJoCo's viewer as its window.

Left and right change the offset, up and down the frequency, page up and page down the supply's pressure;
home has it go straight, space holds the time, backspace begins anew. Keys are GLFW's numbers, which MuJoCo's
viewer reports.
"""

from __future__ import annotations

import os
import time as wall
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from srs_twin.control.commands import CommandedGait, GaitCommand, GaitLimits
from srs_twin.errors import InputError
from srs_twin.plants.base import SnakeState
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import RobotSpec
from srs_twin.viewing.rerun.viewer import lacks_display

SPACE, BACKSPACE, HOME = 32, 259, 268
RIGHT, LEFT, DOWN, UP, PAGE_UP, PAGE_DOWN = 262, 263, 264, 265, 266, 267

_CHANGES = {
    LEFT: ("offset", 16),
    RIGHT: ("offset", -16),
    UP: ("frequency", 10),
    DOWN: ("frequency", -10),
    PAGE_UP: ("pressure", 14),
    PAGE_DOWN: ("pressure", -14),
}
"""How many presses lead from one limit to the other, negative downwards: 0.05, 0.1 Hz, about 1 kPa."""

LATEST_S = 0.25
"""Of what the simulation lags behind the clock, no more than this is caught up."""


class LiveSnake:
    """A twin under a person's commands.

    Attributes:
        twin: what crawls.
        state: of it, now.
        limits: of the commands.
        command: the one that holds.
        held: whether time stands still.
    """

    state: SnakeState
    command: GaitCommand
    held: bool
    _gait: CommandedGait

    def __init__(self, spec: RobotSpec, *, modified: str = "") -> None:
        """Lay a robot down, with a gait in the middle of its limits.

        Args:
            spec: the robot.
            modified: its changed fields, which the screen shows.

        Raises:
            InputError: a robot that the twin cannot be made of.
        """
        self.limits = limits = GaitLimits.for_robot(spec)
        self._modified = modified
        self._first = GaitCommand(0.0, *(sum(ends) / 2 for ends in (limits.frequency, limits.pressure)))
        self.twin = TwinSnake(spec, supply_pa=limits.pressure[1])
        self._pressed: deque[int] = deque()
        self._begin()

    def press(self, key: int) -> None:
        """Take a key, from any thread; it takes effect with the next tick. Others than ours are ignored."""
        self._pressed.append(key)

    def advance(self) -> SnakeState:
        """Obey the keys and go on by a tick; return the state.

        Raises:
            DivergedError: as `TwinSnake.step`.
        """
        while self._pressed:
            self._obey(self._pressed.popleft())
        if not self.held:
            self.state = self.twin.step(self._gait.valves(float(self.state.time), self.command))
        return self.state

    def status_lines(self) -> list[tuple[str, str]]:
        """Return what stands on the screen: name and value of each line."""
        command, speed = self.command, self.state.com_velocity
        return [
            ("offset (left, right)", f"{command.offset:+.2f}"),
            ("frequency (up, down)", f"{command.frequency:.2f} Hz"),
            ("pressure (page up, page down)", f"{command.pressure / 1e3:.1f} kPa"),
            ("speed", f"{float((speed**2).sum()) ** 0.5:.3f} m/s"),
            ("time (space holds it)", f"{float(self.state.time):.1f} s{', held' if self.held else ''}"),
            ("home: straight, backspace: anew", ""),
            *([("modified", self._modified)] if self._modified else []),
        ]

    def _begin(self) -> None:
        self.state, self.command, self.held = self.twin.reset(), self._first, False
        self._gait = CommandedGait(self.twin.spec, self.twin.tick, self.twin.pneumatics, self._first)

    def _obey(self, key: int) -> None:
        if key == BACKSPACE:
            self._begin()
        elif key == SPACE:
            self.held = not self.held
        elif key == HOME:
            self.command = replace(self.command, offset=0.0)
        elif key in _CHANGES:
            name, presses = _CHANGES[key]
            low, high = getattr(self.limits, name)
            value = getattr(self.command, name) + (high - low) / presses
            self.command = self.limits.clipped(replace(self.command, **{name: value}))


class Window(Protocol):
    """What shows a snake to a person."""

    def is_open(self) -> bool:
        """Say whether it has not been closed."""

    def show(self, snake: LiveSnake) -> None:
        """Show the snake as it is now."""


def steer(
    snake: LiveSnake,
    window: Window,
    *,
    clock: Callable[[], float] = wall.perf_counter,
    sleep: Callable[[float], None] = wall.sleep,
) -> None:
    """Let a snake crawl in a window, a second a second, until the window is closed.

    What has fallen behind the clock, since a picture took long, is caught up without pictures.

    Args:
        snake: what crawls.
        window: where it is shown, once a tick where there is time for it.
        clock: tells the time, s.
        sleep: waits, s.

    Raises:
        DivergedError: as `LiveSnake.advance`.
    """
    tick, due = snake.twin.tick, clock()
    unseen = 0.0
    while window.is_open():
        snake.advance()
        due = max(due + tick, clock() - LATEST_S)
        unseen += tick
        if due >= clock() or unseen >= LATEST_S:
            window.show(snake)
            unseen = 0.0
        ahead = due - clock()
        if ahead > 0:
            sleep(ahead)


_LENGTHS = 4.0
_AZIMUTH, _ELEVATION = 90.0, -35.0


class MujocoWindow:
    """Shows a snake and hands keys on to it; a context manager."""

    def __init__(self, snake: LiveSnake) -> None:
        """Open the window.

        Raises:
            InputError: there is no display, or the viewer cannot be opened on it.
        """
        refuse_without_display()
        import mujoco
        import mujoco.viewer

        from srs_twin.viewing.mujoco.stage import Skins

        physics = snake.twin.physics
        model, data = physics.model.ptr, physics.data.ptr
        try:
            self._viewer = mujoco.viewer.launch_passive(
                model, data, key_callback=snake.press, show_left_ui=False, show_right_ui=False
            )
        except RuntimeError as error:
            raise InputError(f"MuJoCo's viewer cannot be opened here: {error}") from error
        self._skins = Skins(model, snake.twin.spec.segments)
        camera = self._viewer.cam
        camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        camera.trackbodyid = model.body("connector_1").rootid[0]
        camera.distance = _LENGTHS * snake.twin.spec.geometry.body_length
        camera.azimuth, camera.elevation = _AZIMUTH, _ELEVATION

    def __enter__(self) -> MujocoWindow:
        return self

    def __exit__(self, *error: object) -> None:
        self._viewer.close()

    def is_open(self) -> bool:
        """See `Window.is_open`."""
        return bool(self._viewer.is_running())

    def show(self, snake: LiveSnake) -> None:
        """See `Window.show`."""
        names, values = ("\n".join(column) for column in zip(*snake.status_lines(), strict=True))
        self._skins.show(snake.state.pressure, snake.twin.spec.supply.nominal)
        self._viewer.set_texts((None, None, names, values))
        self._viewer.sync()


def refuse_without_display() -> None:
    """Refuse to open a window where there is no display.

    Raises:
        InputError: there is none, or it does not answer.
    """
    if lacks_display():
        raise InputError(
            "there is no display to steer a snake on (neither DISPLAY nor WAYLAND_DISPLAY is set); on a "
            "machine with a screen this opens MuJoCo's viewer, and `srs-twin run SCENARIO` needs none"
        )
    import warnings

    import glfw

    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        usable = glfw.init()
    if not usable:
        said = str(heard[-1].message) if heard else "GLFW cannot be used"
        shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        raise InputError(f"the display {shown} does not answer ({said}); DISPLAY must name one that does")
