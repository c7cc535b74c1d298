"""A progress bar on stderr for one scenario; plain lines where that is no terminal."""

from __future__ import annotations

from typing import Any

from srs_twin.cli.display import Display


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
