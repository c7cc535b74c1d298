"""How many of many runs are done: a bar on stderr with rate and time left; lines where it is no terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from srs_twin.cli.display import Display


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
