"""MuJoCo's passive viewer as a window for a snake that a person steers."""

from __future__ import annotations

import os
import sys
from types import TracebackType

from srs_twin.errors import InputError
from srs_twin.viewing.live import LiveSnake

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

        physics = snake.twin.physics
        model, data = physics.model.ptr, physics.data.ptr
        try:
            self._viewer = mujoco.viewer.launch_passive(
                model, data, key_callback=snake.press, show_left_ui=False, show_right_ui=False
            )
        except RuntimeError as error:
            raise InputError(f"MuJoCo's viewer cannot be opened here: {error}") from error
        camera = self._viewer.cam
        camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        camera.trackbodyid = model.body("connector_1").rootid[0]
        camera.distance = _LENGTHS * snake.twin.spec.geometry.body_length
        camera.azimuth, camera.elevation = _AZIMUTH, _ELEVATION

    def __enter__(self) -> MujocoWindow:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._viewer.close()

    def is_open(self) -> bool:
        """See `Window.is_open`."""
        return bool(self._viewer.is_running())

    def show(self, snake: LiveSnake) -> None:
        """See `Window.show`."""
        names, values = ("\n".join(column) for column in zip(*snake.told(), strict=True))
        self._viewer.set_texts((None, None, names, values))
        self._viewer.sync()


def refuse_without_display() -> None:
    """Refuse to open a window where there is no display.

    Raises:
        InputError: there is none, or it does not answer.
    """
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
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
