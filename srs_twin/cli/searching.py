"""How far a fit's search is, on stderr: one line on a terminal, a line now and then where it is none."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any

from srs_twin.cli.progress import LINE_EVERY_S, PATIENCE_S


class Searching:
    """Tells how often the model was run and how well it fits so far; a context manager and a `Watch`."""

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        self._title, self._quiet = title, quiet
        self._start = self._told = time.monotonic()
        self._status: Any = None

    def __enter__(self) -> Searching:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._status is not None:
            self._status.stop()

    def __call__(self, runs: int, least: float) -> None:
        """Take note of one more run of the model; `least` is the best weighted RMS so far."""
        now = time.monotonic()
        if self._quiet or now - self._start < PATIENCE_S:
            return
        text = f"{self._title}: {runs} runs of the model, weighted residuals {least:.3g} RMS at best"
        if sys.stderr.isatty():
            self._draw(text)
        elif now - self._told >= LINE_EVERY_S:
            self._told = now
            print(text, file=sys.stderr, flush=True)

    def _draw(self, text: str) -> None:
        # rich costs more to import than a short fit takes.
        from rich.console import Console
        from rich.markup import escape

        if self._status is None:
            self._status = Console(stderr=True).status(escape(text))
            self._status.start()
        self._status.update(escape(text))
