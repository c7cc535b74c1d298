"""Film: pictures one after the other into an MP4 file (H.264, which every browser plays)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.files import atomic_write, shown

AddPicture = Callable[[np.ndarray], None]


def encoder() -> Any:
    """Return PyAV, the encoder.

    Raises:
        InputError: it is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise InputError(
            "videos need the encoder PyAV, which is an extra: `uv sync --extra video`, or "
            f"`pip install 'srs-twin[video]'` ({error})"
        ) from error
    return av


@contextmanager
def film(path: Path, *, width: int, height: int, fps: int) -> Iterator[AddPicture]:
    """Give a function that adds a picture; the file is there once the block has ended without an error.

    Args:
        path: of the file, ending in .mp4.
        width: of the pictures, pixels, even.
        height: likewise.
        fps: pictures a second.

    Raises:
        InputError: no encoder, or the file cannot be written.
    """
    av = encoder()
    with atomic_write(path) as part:
        try:
            with av.open(str(part), "w", format="mp4", options={"movflags": "+faststart"}) as container:
                stream = container.add_stream(
                    "libx264", rate=fps, options={"crf": "20", "preset": "veryfast"}
                )
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"

                def add(picture: np.ndarray) -> None:
                    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
                    container.mux(stream.encode(frame))

                yield add
                container.mux(stream.encode(None))
        except av.FFmpegError as error:
            raise InputError(f"{shown(path)}: the video cannot be written ({error})") from error
