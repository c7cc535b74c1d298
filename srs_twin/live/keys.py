"""Keys of a terminal that control a session: p pauses, g continues, v vents, s stops."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from srs_twin.live.messages import GO, PAUSE, STOP, VENT

KEYS = {"p": PAUSE, "g": GO, "v": VENT, "s": STOP}


@contextmanager
def typed_words(terminal: TextIO | None = None) -> Iterator[Callable[[], list[str]]]:
    """Yield a function that returns the control words (of `WORDS`) typed since its last call.

    Within the block, keys take effect without Enter; afterwards the terminal is restored. Without a terminal,
    and in the background, no keys are read.

    Args:
        terminal: default standard input.
    """
    stream = sys.stdin if terminal is None else terminal
    if stream is None or stream.closed or not stream.isatty() or not _in_foreground(stream.fileno()):
        yield list
        return
    handle = stream.fileno()
    before = termios.tcgetattr(handle)
    tty.setcbreak(handle)

    def words() -> list[str]:
        if not _in_foreground(handle) or not select.select([handle], [], [], 0)[0]:
            return []
        with suppress(OSError):  # the terminal was closed
            return [
                KEYS[key] for key in os.read(handle, 1024).decode("ascii", "replace").lower() if key in KEYS
            ]
        return []

    try:
        yield words
    finally:
        with suppress(termios.error):
            termios.tcsetattr(handle, termios.TCSADRAIN, before)


def _in_foreground(handle: int) -> bool:
    """Return whether the process may read from its terminal; in the background reading would stop it."""
    try:
        return os.tcgetpgrp(handle) == os.getpgrp()
    except OSError:  # not the controlling terminal
        return True
