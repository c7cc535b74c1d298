"""A progress bar on stderr for what takes longer than two seconds; plain lines where that is no terminal."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any

PATIENCE_S = 2.0
LINE_EVERY_S = 10.0


class Progress:
    """Shows how far a scenario is; a context manager, and a callback for `run_scenario`.

    Attributes:
        title: what stands in front of the plant's name.
    """

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        self.title = title
        self._quiet = quiet
        self._start = self._last_line = time.monotonic()
        self._bar: Any = None
        self._tasks: dict[str, Any] = {}

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, stage: str, part: float) -> None:
        """Take note that a part (0 to 1) of a stage is done."""
        now = time.monotonic()
        if self._quiet or now - self._start < PATIENCE_S:
            return
        if sys.stderr.isatty():
            self._draw(stage, part)
        elif now - self._last_line >= LINE_EVERY_S or self._last_line == self._start:
            self._last_line = now
            print(f"{self.title}: {stage} {part:.0%}", file=sys.stderr, flush=True)

    def _draw(self, stage: str, part: float) -> None:
        # rich costs more to import than a short run has time for.
        from rich.console import Console
        from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        if self._bar is None:
            columns = (
                TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(),
                TimeRemainingColumn(),
            )  # fmt: skip
            self._bar = Bar(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
        if stage not in self._tasks:
            self._tasks[stage] = self._bar.add_task(f"{self.title}: {stage}", total=1.0)
        self._bar.update(self._tasks[stage], completed=part)
