"""Progress on stderr: a bar with rate and time left on a terminal, else a line now and then.

Display: how far something is, on stderr: drawn by rich on a terminal, else a line now and then.

How many of many runs are done: a bar on stderr with rate and time left; lines where it is no terminal.

A progress bar on stderr for one scenario; plain lines where that is no terminal.
"""

from __future__ import annotations

import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
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


class Counting(Display):
    """Counts runs."""

    def __init__(self, title: str, total: int, *, quiet: bool = False) -> None:
        super().__init__(title, quiet=quiet)
        self._total = total
        self._done = self._failed = 0
        self._first = 0.0  # s, when the first run was done: workers take a while to start

    def __call__(self, *, failed: bool) -> None:
        """Take note of one more run that is finished."""
        if not self._done:
            self._first = self._elapsed()
        self._done += 1
        self._failed += failed
        self._show()

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Take the bar off the terminal while something else is printed there (`run` prints tables)."""
        if self._drawn is not None:
            self._drawn.stop()
        yield
        if self._drawn is not None:
            self._drawn.start()

    def _rate(self) -> float:
        """Return runs a second since the first was done; before a second is, since the start."""
        if self._done < 2:
            return self._done / max(self._elapsed(), 1e-3)
        return (self._done - 1) / max(self._elapsed() - self._first, 1e-3)

    def _pace(self) -> str:
        failed = f", {self._failed} failed" if self._failed else ""
        return f"{failed}, {self._rate():.3g}/s"

    def _line(self) -> str:
        left = (self._total - self._done) / self._rate()
        return f"{self.title}: {self._done} of {self._total}{self._pace()}, {left:.0f} s left"

    def _draw(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        if self._drawn is None:
            columns = (
                TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
                TextColumn("{task.fields[pace]}"), TimeRemainingColumn(),
            )  # fmt: skip
            self._drawn = Progress(*columns, console=Console(stderr=True), transient=True)
            self._drawn.start()
            self._task = self._drawn.add_task(self.title, total=self._total, pace="")
        self._drawn.update(self._task, completed=self._done, pace=self._pace().lstrip(", "))


class Progress(Display):
    """Shows how far a scenario is; a callback for `run_scenario`. The title stands before the stage."""

    first_line_s = 0.0

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        super().__init__(title, quiet=quiet)
        self._tasks: dict[str, Any] = {}
        self._stage, self._part = "", 0.0

    def __call__(self, stage: str, part: float) -> None:
        """Take note that a part (0 to 1) of a stage is done."""
        self._stage, self._part = stage, part
        self._show()

    def _line(self) -> str:
        return f"{self.title}: {self._stage} {self._part:.0%}"

    def _draw(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        if self._drawn is None:
            columns = (
                TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(),
                TimeRemainingColumn(),
            )  # fmt: skip
            self._drawn = Bar(*columns, console=Console(stderr=True), transient=True)
            self._drawn.start()
        stage = self._stage
        if stage not in self._tasks:
            self._tasks[stage] = self._drawn.add_task(f"{self.title}: {stage}", total=1.0)
        self._drawn.update(self._tasks[stage], completed=self._part)
