"""Display: how far something is, on stderr: drawn by rich on a terminal, else a line now and then."""

from __future__ import annotations

import sys
import time
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Any, Self

from srs_twin.cli import say

PATIENCE_S = 2.0
LINE_EVERY_S = 10.0


class Display(ABC):
    """Shows how far something is that takes longer than two seconds; a context manager.

    Attributes:
        title: of what takes so long.
        first_line_s: when the first line comes at the earliest, s.
    """

    first_line_s = LINE_EVERY_S

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        self.title, self._quiet = title, quiet
        self._start, self._next_line = time.monotonic(), self.first_line_s
        self._drawn: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._drawn is not None:
            self._drawn.stop()

    def _elapsed(self) -> float:
        """Return the time since the start, s."""
        return time.monotonic() - self._start

    def _show(self) -> None:
        """Draw, or say a line, where it is time for it."""
        elapsed = self._elapsed()
        if self._quiet or elapsed < PATIENCE_S:
            return
        if sys.stderr.isatty():
            self._draw()
        elif elapsed >= self._next_line:
            self._next_line = elapsed + LINE_EVERY_S
            say(self._line())

    @abstractmethod
    def _line(self) -> str:
        """Return how far it is."""

    @abstractmethod
    def _draw(self) -> None:
        """Draw how far it is; `_drawn` is what draws, imported here: rich takes as long as a short run."""
