"""Console output of commands, with messages on stderr and tables on stdout."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self

from srs_twin.errors import WriteError
from srs_twin.io.files import data_root, escape_unprintable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID
    from rich.table import Table
    from rich.text import Text

DEBUG = "SRS_TWIN_DEBUG"
"""Environment variable that enables tracebacks."""

INTERRUPTED = 130
"""Exit code of an interrupted command."""


_PAGE = re.compile(r"\bdocs/[\w/-]+\.md(#[\w-]+)?")
_HINT = re.compile(r"(`(?:\w+=\w+ )?)(srs-twin )")


def launcher() -> str:
    """Return the prefix with which `srs-twin` was started, such as "uv run " or ""."""
    if "UV_RUN_RECURSION_DEPTH" in os.environ:  # set by `uv run`
        return "uv run "
    # `uvx` sets only the variable UV, which a user may also set. The Python environment
    # of `uvx` lies in uv's archive folder.
    if "UV" in os.environ and "archive-v" in sys.prefix:
        return "uvx "
    return ""


def as_started(text: str) -> str:
    """Adapt the commands in a message to how the user started the program.

    Commands in backticks get the prefix "uv run " or "uvx " if the user typed it. In an
    installed wheel, names of documentation pages are replaced with commands that print
    the pages.
    """
    if data_root().name == "_data":
        text = _PAGE.sub(r"`srs-twin show \g<0>`", text)
    return _HINT.sub(rf"\1{launcher()}\2", text)


def say(*lines: str, quiet: bool = False) -> None:
    """Print lines on stderr, adapted by `as_started`, unless `quiet` is true."""
    for line in () if quiet else lines:
        print(
            escape_unprintable(as_started(line), keep="\n\t"),
            file=sys.stderr,
            flush=True,
        )


def handle_signals(
    handler: Callable[[int, FrameType | None], object], *signals: int
) -> None:
    """Install a signal handler, except for signals that the parent process ignores."""
    for number in signals:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


_REPEAT_S = 0.5
"""Interval at which an interrupt is repeated if a library discards it, s."""

_received: list[int] = []
"""Signals that interrupted the current command."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    if number != signal.SIGALRM:
        _received.append(number)
        if signal.getsignal(signal.SIGALRM) == _interrupt:
            signal.setitimer(signal.ITIMER_REAL, _REPEAT_S, _REPEAT_S)
    elif sys.exception() is not None:
        return  # the interrupt may be in progress, and clean-up must not be interrupted
    signal.default_int_handler(number, frame)


@contextmanager
def keep_interrupts(*signals: signal.Signals) -> Iterator[None]:
    """Raise KeyboardInterrupt if a `with` block receives one of the signals.

    Libraries may catch this exception or replace it by a different one, for example
    while their modules are imported. The interrupt is therefore repeated every 0.5 s
    while no exception is handled, and raised at the end of the block. Signals that the
    parent process ignores or that have other handlers are not changed.
    """
    before = {
        number: signal.getsignal(number)
        for number in (signal.SIGALRM, *signals)
        if threading.current_thread() is threading.main_thread()
        and signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL)
    }
    for number in before:
        signal.signal(number, _interrupt)
    try:
        yield
        if _received:
            raise KeyboardInterrupt
    except (Exception, SystemExit) as error:
        if isinstance(error, WriteError) or not _received:
            raise
        show_traceback(error)
        raise KeyboardInterrupt from error
    finally:
        if before and _received:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            _received.clear()
        for number, handler in reversed(before.items()):
            signal.signal(number, handler)


@contextmanager
def interruptible(message: Callable[[], str] | str = "") -> Iterator[None]:
    """On Ctrl-C or SIGTERM, print a message and exit with code `INTERRUPTED`."""
    try:
        # CI pipelines cancel jobs with SIGTERM.
        with keep_interrupts(signal.SIGINT, signal.SIGTERM):
            yield
    except KeyboardInterrupt as error:
        text = message if isinstance(message, str) else message()
        say(
            "; ".join(
                filter(None, ["interrupted", text, *getattr(error, "__notes__", ())])
            )
        )
        raise SystemExit(INTERRUPTED) from None


def console() -> Console:
    """Return a console on stdout that ignores markup and escapes control characters."""
    import rich.console

    class Plain(rich.console.Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(
                escape_unprintable(text, keep="\n\t"), **options | {"markup": False}
            )

    return Plain(file=sys.stdout, highlight=False, emoji=False)


def new_table(
    *headings: str, left: Collection[int] = (0,), title: str | None = None
) -> Table:
    """Return an empty table whose columns do not wrap.

    Columns with an index in `left` are left-aligned, and others are right-aligned.
    """
    from rich import box
    from rich.table import Table

    table = Table(
        title=title,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
    )
    for i, heading in enumerate(headings):
        justify: Literal["left", "right"] = "left" if i in left else "right"
        table.add_column(heading, justify=justify, no_wrap=True)
    return table


def show_traceback(error: BaseException) -> None:
    """Print the traceback of an error on stderr if SRS_TWIN_DEBUG is set."""
    if os.environ.get(DEBUG, "0") not in ("", "0"):
        say("".join(traceback.format_exception(error)).rstrip())


DISPLAY_DELAY_S = 2.0
"""Time after which the progress of a task is displayed, s."""

LINE_INTERVAL_S = 10.0
"""Time between two progress lines if stderr is not a terminal, s."""


class Display(ABC):
    """Context manager that shows the progress of a task.

    Attributes:
        title: name of the task.
        first_line_s: minimum time before the first progress line, s.
    """

    first_line_s = LINE_INTERVAL_S

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        self.title = title
        self._quiet = quiet
        self._start = time.monotonic()
        self._next_line = self.first_line_s
        self._progress: Progress | None = None
        self._bars: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._progress is not None:
            self._progress.stop()

    def _elapsed(self) -> float:
        return time.monotonic() - self._start

    def _show(self, *, now: bool = False) -> None:
        elapsed = self._elapsed()
        if self._quiet or (elapsed < DISPLAY_DELAY_S and not now):
            return
        if sys.stderr.isatty():
            self._draw()
        elif elapsed >= self._next_line or now:
            self._next_line = elapsed + LINE_INTERVAL_S
            say(self._line())

    @abstractmethod
    def _line(self) -> str:
        """Return the progress as a line of text."""

    @abstractmethod
    def _bar(self) -> tuple[str, float | None, str]:
        """Return the title, completed fraction and status text of the progress bar."""

    def _draw(self) -> None:
        # Importing rich takes as long as a short run.
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        if self._progress is None:
            title_column = TextColumn("{task.description}", markup=False)
            status_column = TextColumn("{task.fields[status]}", markup=False)
            columns = (title_column, BarColumn(), status_column, TimeRemainingColumn())
            self._progress = Progress(
                *columns, console=Console(stderr=True), transient=True
            )
            self._progress.start()
        title, fraction, status = self._bar()
        if title not in self._bars:
            total = None if fraction is None else 1.0
            self._bars[title] = self._progress.add_task(
                title, total=total, status=status
            )
        self._progress.update(self._bars[title], completed=fraction, status=status)


class HasExitCode(Protocol):
    """Result of a run, such as a row of a sweep."""

    @property
    def exit_code(self) -> int:
        """Exit code of the run; 0 means success."""


class RunCounter(Display):
    """Progress display for several runs, called after each completed run."""

    def __init__(
        self,
        title: str,
        total: int,
        *,
        quiet: bool = False,
        status: Callable[[], str] = str,
    ) -> None:
        super().__init__(title, quiet=quiet)
        self.total = total
        self._status = status
        self._done = self._failed = 0
        self._first_done_s = 0.0

    def __call__(self, *, failed: bool) -> None:
        """Count a completed run."""
        if not self._done:
            self._first_done_s = self._elapsed()
        self._done += 1
        self._failed += failed
        self._show()

    def count(self, done: int, total: int) -> None:
        """Count a completed run and set the total number of runs."""
        self.total = total
        self(failed=False)

    def follow(self, title: str, total: int, row: HasExitCode | None) -> None:
        """Count a completed run, or begin a new part of a study if `row` is None."""
        if row is None:
            self.title = title
            self.total = total
            self._done = self._failed = 0
        else:
            self(failed=row.exit_code != 0)

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """Hide the progress bar while a `with` block prints to the terminal."""
        if self._progress is not None:
            self._progress.stop()
        yield
        if self._progress is not None:
            self._progress.start()

    def _rate(self) -> float:
        """Return the rate of completed runs after the start-up of the workers, 1/s."""
        if self._done < 2:
            return self._done / max(self._elapsed(), 1e-3)
        return (self._done - 1) / max(self._elapsed() - self._first_done_s, 1e-3)

    def _rate_text(self) -> str:
        failed = f", {self._failed} failed" if self._failed else ""
        status = f", {text}" if (text := self._status()) else ""
        return f"{failed}, {self._rate():.3g}/s{status}"

    def _line(self) -> str:
        remaining_s = max(self.total - self._done, 0) / self._rate()
        return (
            f"{self.title}: {self._done} of {self.total}{self._rate_text()},"
            f" {remaining_s:.0f} s left"
        )

    def _bar(self) -> tuple[str, float, str]:
        return (
            self.title,
            self._done / self.total,
            f"{self._done}/{self.total}{self._rate_text()}",
        )


class ScenarioProgress(Display):
    """Progress display for one scenario, used as callback of `PreparedRun.execute`."""

    first_line_s = 0.0

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        super().__init__(title, quiet=quiet)
        self._stage = ""
        self._fraction = 0.0
        self._remaining_s: float | None = None

    def __enter__(self) -> Self:
        from srs_twin.compute.compiled import notify_first_compilation

        text = (
            f"{self.title}: compiling the kernels for this machine (once for each kind"
            " of run, about 30 s)"
        )
        notify_first_compilation(lambda: say(text, quiet=self._quiet))
        return super().__enter__()

    def __call__(
        self, stage: str, fraction: float, remaining_s: float | None = None
    ) -> None:
        """Update the completed fraction (0 to 1) of a stage.

        The start of a long stage is displayed immediately.
        """
        is_new = stage != self._stage
        self._stage = stage
        self._fraction = fraction
        self._remaining_s = remaining_s
        is_long = is_new and (remaining_s or 0.0) >= DISPLAY_DELAY_S
        self._show(now=is_long)

    def _status(self) -> str:
        if self._remaining_s is None:
            left = ""
        else:
            left = f", about {self._remaining_s:.0f} s left"
        return f"{self._fraction:.0%}{left}"

    def _line(self) -> str:
        return f"{self.title}: {self._stage} {self._status()}"

    def _bar(self) -> tuple[str, float, str]:
        return f"{self.title}: {self._stage}", self._fraction, self._status()
