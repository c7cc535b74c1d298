"""Output of commands: messages on stderr, tables on stdout."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from srs_twin.io.files import escape_unprintable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

DEBUG = "SRS_TWIN_DEBUG"
"""Environment variable that shows tracebacks."""

INTERRUPTED = 130
"""Exit code of an interrupted command."""


def say(*lines: str, quiet: bool = False) -> None:
    """Print lines to stderr at once, with control characters escaped; print nothing if `quiet`."""
    for line in () if quiet else lines:
        print(escape_unprintable(line, keep="\n\t"), file=sys.stderr, flush=True)


@contextmanager
def interruptible(words: Callable[[], str] | str) -> Iterator[None]:
    """End an interrupted command with a message about the work that is kept."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"interrupted; {words if isinstance(words, str) else words()}")
        raise SystemExit(INTERRUPTED) from None


def console() -> Console:
    """Return rich's console on stdout without markup, with control characters escaped."""
    import rich.console

    class Plain(rich.console.Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(escape_unprintable(text, keep="\n\t"), **options | {"markup": False})

    return Plain(file=sys.stdout, highlight=False, emoji=False)


def new_table(*headings: str, left: Collection[int] = (0,), title: str | None = None) -> Table:
    """Return an empty table whose columns do not wrap; those in `left` are left-aligned, others right."""
    from rich import box
    from rich.table import Table

    made = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for i, heading in enumerate(headings):
        made.add_column(heading, justify="left" if i in left else "right", no_wrap=True)
    return made


def show_traceback(error: Exception) -> None:
    """Print an error's traceback to stderr if `DEBUG` is set."""
    if os.environ.get(DEBUG, "0") not in ("", "0"):
        say("".join(traceback.format_exception(error)).rstrip())
