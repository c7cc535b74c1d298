"""How many of many runs are done: a bar on stderr with rate and time left; lines where that is no terminal."""

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
        self._done += 1
        self._failed += failed
        now = time.monotonic()
        if self._quiet or now - self._start < PATIENCE_S:
            return
        if sys.stderr.isatty():
            self._draw()
        elif now - self._told >= LINE_EVERY_S or self._told == self._start:
            self._told = now
            print(self._line(now), file=sys.stderr, flush=True)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Take the bar off the terminal while something else is printed there."""
        if self._bar is not None:
            self._bar.stop()
        yield
        if self._bar is not None:
            self._bar.start()

    def _line(self, now: float) -> str:
        rate = self._done / (now - self._start)
        left = (self._total - self._done) / rate
        failed = f", {self._failed} failed" if self._failed else ""
        return f"{self._title}: {self._done} of {self._total}{failed}, {rate:.3g}/s, {left:.0f} s left"

    def _draw(self) -> None:
        # rich costs more to import than a short sweep has time for.
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        if self._bar is None:
            columns = (
                TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"), TimeRemainingColumn(),
            )  # fmt: skip
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=self._total, rate="")
        rate = self._done / (time.monotonic() - self._start)
        failed = f" {self._failed} failed" if self._failed else ""
        self._bar.update(self._task, completed=self._done, rate=f"{rate:.3g}/s{failed}")
