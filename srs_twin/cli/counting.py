"""How many of many runs are done: a bar on stderr with rate and time left; lines where it is no terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any

from srs_twin.cli.progress import LINE_EVERY_S, PATIENCE_S


class Counting:
    """Counts runs; a context manager."""

    def __init__(self, title: str, total: int, *, quiet: bool = False) -> None:
        self._title, self._total, self._quiet = title, total, quiet
        self._done = self._failed = 0
        self._start = self._told = time.monotonic()
        self._first = self._start  # when the first run was done: workers take a while to start
        self._bar: Any = None

    def __enter__(self) -> Counting:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, *, failed: bool) -> None:
        """Take note of one more run that is finished."""
        now = time.monotonic()
        if not self._done:
            self._first = now
        self._done += 1
        self._failed += failed
        if self._quiet or now - self._start < PATIENCE_S:
            return
        if sys.stderr.isatty():
            self._draw(now)
        elif now - self._told >= LINE_EVERY_S:
            self._told = now
            left = (self._total - self._done) / self._rate(now)
            print(f"{self._title}: {self._done} of {self._total}{self._pace(now)}, {left:.0f} s left",
                  file=sys.stderr, flush=True)  # fmt: skip

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Take the bar off the terminal while something else is printed there (`run` prints tables)."""
        if self._bar is not None:
            self._bar.stop()
        yield
        if self._bar is not None:
            self._bar.start()

    def _rate(self, now: float) -> float:
        """Return runs a second since the first was done; before a second is, since the start."""
        if self._done < 2:
            return self._done / max(now - self._start, 1e-3)
        return (self._done - 1) / max(now - self._first, 1e-3)

    def _pace(self, now: float) -> str:
        failed = f", {self._failed} failed" if self._failed else ""
        return f"{failed}, {self._rate(now):.3g}/s"

    def _draw(self, now: float) -> None:
        # rich costs more to import than a short sweep has time for.
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        if self._bar is None:
            columns = (
                TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
                TextColumn("{task.fields[pace]}"), TimeRemainingColumn(),
            )  # fmt: skip
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=self._total, pace="")
        self._bar.update(self._task, completed=self._done, pace=self._pace(now).lstrip(", "))
