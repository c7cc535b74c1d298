"""How far a fit's search is, on stderr: one line on a terminal, a line now and then where it is none."""

from __future__ import annotations

from srs_twin.cli.display import Display


class Searching(Display):
    """Tells how often the model was run and how well it fits so far; a `Watch`."""

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        super().__init__(title, quiet=quiet)
        self._runs, self._least = 0, 0.0

    def __call__(self, runs: int, least: float) -> None:
        """Take note of one more run of the model; `least` is the best weighted RMS so far."""
        self._runs, self._least = runs, least
        self._show()

    def _line(self) -> str:
        return (
            f"{self.title}: {self._runs} runs of the model, weighted residuals {self._least:.3g} RMS at best"
        )

    def _draw(self) -> None:
        from rich.console import Console
        from rich.markup import escape

        text = escape(self._line())
        if self._drawn is None:
            self._drawn = Console(stderr=True).status(text)
            self._drawn.start()
        self._drawn.update(text)
