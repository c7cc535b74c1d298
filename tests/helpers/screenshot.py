"""Screenshots of a recording in the Rerun viewer, without a screen or browser.

Needs a Vulkan driver; the software one will do (Debian: `apt-get install
mesa-vulkan-drivers`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

from srs_twin.errors import InputError
from srs_twin.viewing.rerun.blueprint import TIMELINE
from srs_twin.viewing.rerun.viewer import (
    HOST,
    Rerun,
    free_port,
    output_lines,
    running_rerun,
    verify_recording,
)

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient


_START_S = 20.0
_SETTLE_S = 30.0


def screenshots(
    recording: str | Path,
    times: Sequence[float],
    *,
    scene_only: bool = False,
    size: tuple[int, int] = (1600, 900),
) -> list[bytes]:
    """Return one PNG a time.

    Args:
        recording: a file of `write_recording`.
        times: simulated times, s.
        scene_only: the 3-D view alone, without plots and controls.
        size: of the viewer's window, pixels.

    Raises:
        InputError: not a whole recording; or the viewer cannot draw here, with what to
            install.
    """
    verify_recording(recording)
    with _headless_viewer(size) as client:
        client.open(str(Path(recording).resolve()))
        view = None
        if scene_only:
            view = next(
                v.view_id for v in client.get_state().views if v.view_class == "3D"
            )
        pictures = []
        for moment in times:
            client.set_time(TIMELINE, duration=float(moment), play_state="paused")
            pictures.append(_settled(client, view))
    return pictures


def _settled(client: ViewerClient, view: str | None) -> bytes:
    """Return the view once two pictures in a row are equal: before, things still load or fade."""
    deadline = time.monotonic() + _SETTLE_S
    before = client.take_screenshot(view)
    while time.monotonic() < deadline:
        now = client.take_screenshot(view)
        if now == before:
            return now
        before = now
    raise InputError(
        f"the viewer's picture did not come to rest within {_SETTLE_S:g} s"
    )


@contextmanager
def _headless_viewer(size: tuple[int, int]) -> Iterator[ViewerClient]:
    """Start a viewer without a window and end it with all its processes.

    `ViewerClient.spawn` would do, but it listens on every network interface and prints
    its stack traces.
    """
    port = free_port()
    window = (
        "--headless",
        "--window-size",
        f"{size[0]}x{size[1]}",
        "--hide-welcome-screen",
    )
    with running_rerun("--port", str(port), *window) as (viewer, output):
        yield _connected(viewer, port, output)


def _connected(viewer: Rerun, port: int, output: IO[bytes]) -> ViewerClient:
    from rerun.experimental import ViewerClient

    deadline = time.monotonic() + _START_S
    while viewer.poll() is None and time.monotonic() < deadline:
        try:
            client = ViewerClient.connect(f"rerun+http://{HOST}:{port}/proxy")
            client.take_screenshot()
            return client
        except (ConnectionError, RuntimeError):
            time.sleep(0.1)
    words = output_lines(output)
    if any("render context" in line or "graphics adapter" in line for line in words):
        raise InputError(
            "no Vulkan driver to draw a picture with; install one (Debian: apt-get"
            " install mesa-vulkan-drivers), or use the pictures made with matplotlib"
            " (report.html)"
        )
    raise InputError(f"the Rerun viewer did not start: {words[-1]}")
