"""How far something is that takes longer than two seconds, on stderr: a bar on a terminal, else lines."""

from __future__ import annotations

import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Self

from srs_twin.cli.console import say

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
        self._bars: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
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
        """Return how far it is, in words."""

    @abstractmethod
    def _bar(self) -> tuple[str, float | None, str]:
        """Return what a bar is of, how much is done (0 to 1; None: nobody knows), and the words beside it."""

    def _draw(self) -> None:
        """Draw the bar; rich is imported here, because that takes as long as a short run."""
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        if self._drawn is None:
            title, beside = (
                TextColumn(f"{{task.{key}}}", markup=False) for key in ("description", "fields[words]")
            )
            columns = (title, BarColumn(), beside, TimeRemainingColumn())
            self._drawn = Progress(*columns, console=Console(stderr=True), transient=True)
            self._drawn.start()
        text, part, words = self._bar()
        if text not in self._bars:
            total = None if part is None else 1.0
            self._bars[text] = self._drawn.add_task(text, total=total, words=words)
        self._drawn.update(self._bars[text], completed=part, words=words)


class Counting(Display):
    """Counts runs.

    Attributes:
        total: how many there are.
    """

    def __init__(
        self, title: str, total: int, *, quiet: bool = False, beside: Callable[[], str] = str
    ) -> None:
        super().__init__(title, quiet=quiet)
        self.total, self._beside = total, beside
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
        beside = f", {said}" if (said := self._beside()) else ""
        return f"{failed}, {self._rate():.3g}/s{beside}"

    def _line(self) -> str:
        left = max(self.total - self._done, 0) / self._rate()
        return f"{self.title}: {self._done} of {self.total}{self._pace()}, {left:.0f} s left"

    def _bar(self) -> tuple[str, float, str]:
        return self.title, self._done / self.total, f"{self._done}/{self.total}{self._pace()}"


class ScenarioProgress(Display):
    """Shows how far a scenario is; a callback for `run_scenario`. The title stands before the stage."""

    first_line_s = 0.0

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        super().__init__(title, quiet=quiet)
        self._stage, self._part = "", 0.0

    def __enter__(self) -> Self:
        from srs_twin.compute.compiled import notify_first_compilation

        text = f"{self.title}: compiling the kernels for this machine, once; about half a minute"
        notify_first_compilation(lambda: say(text, quiet=self._quiet))
        return super().__enter__()

    def __call__(self, stage: str, part: float) -> None:
        """Take note that a part (0 to 1) of a stage is done."""
        self._stage, self._part = stage, part
        self._show()

    def _line(self) -> str:
        return f"{self.title}: {self._stage} {self._part:.0%}"

    def _bar(self) -> tuple[str, float, str]:
        return f"{self.title}: {self._stage}", self._part, f"{self._part:.0%}"
