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
"""Environment variable that enables tracebacks."""

INTERRUPTED = 130
"""Exit code of an interrupted command."""


def say(*lines: str, quiet: bool = False) -> None:
    """Print lines on stderr without buffering, control characters escaped; print nothing if `quiet`."""
    for line in () if quiet else lines:
        print(escape_unprintable(line, keep="\n\t"), file=sys.stderr, flush=True)


@contextmanager
def interruptible(message: Callable[[], str] | str) -> Iterator[None]:
    """Exit with `INTERRUPTED` on Ctrl-C, after a message about the saved work."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"interrupted; {message if isinstance(message, str) else message()}")
        raise SystemExit(INTERRUPTED) from None


def console() -> Console:
    """Return a rich console on stdout without markup, control characters escaped."""
    import rich.console

    class Plain(rich.console.Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(escape_unprintable(text, keep="\n\t"), **options | {"markup": False})

    return Plain(file=sys.stdout, highlight=False, emoji=False)


def new_table(*headings: str, left: Collection[int] = (0,), title: str | None = None) -> Table:
    """Return an empty table whose columns do not wrap.

    Args:
        headings: column headings.
        left: indices of the left-aligned columns; all other columns are right-aligned.
        title: heading of the table.
    """
    from rich import box
    from rich.table import Table

    table = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True
    )
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="left" if i in left else "right", no_wrap=True)
    return table


def show_traceback(error: Exception) -> None:
    """Print the traceback of an error on stderr if `DEBUG` is set."""
    if os.environ.get(DEBUG, "0") not in ("", "0"):
        say("".join(traceback.format_exception(error)).rstrip())
