"""The command line: one module a verb, heavy imports inside the commands."""

from __future__ import annotations

import io
import os
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from srs_twin.errors import SrsError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

DEBUG = "SRS_TWIN_DEBUG"
INTERRUPTED = 130


def main(argv: list[str] | None = None) -> None:
    """Run `srs-twin` and leave the process with its exit code.

    0 done; 1 an expectation failed under ``--check``; 2 bad input; 3 a simulation diverged; 4 internal
    error; 130 interrupted. Messages go to stderr, results to stdout; where nobody reads them any more
    (``| head -1``), the work goes on and the exit code is that of its results.

    Args:
        argv: the words after the program's name; None takes those of this process.
    """
    sys.stdout, sys.stderr = _unread_allowed(sys.stdout), _unread_allowed(sys.stderr)
    try:
        from srs_twin.cli.app import command

        command()(args=argv, prog_name="srs-twin")
    except SrsError as error:
        show_traceback(error)
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except Exception as error:  # the outermost edge: what nobody foresaw becomes one line and exit code 4
        if _interrupted(error):
            sys.exit(INTERRUPTED)
        show_traceback(error)
        print(_internal(error), file=sys.stderr)
        sys.exit(SrsError.exit_code)


class _StandardStream(io.FileIO):
    """Where a standard stream of the process leads: a pipe whose reader leaves becomes the null device."""

    def write(self, data: ReadableBuffer, /) -> int:
        """Write bytes; return how many were taken."""
        try:
            return super().write(data)
        except BrokenPipeError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            # The descriptor itself: what libraries and child processes write to it ends there as well.
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            return super().write(data)


def _unread_allowed(stream: TextIO) -> TextIO:
    """Return a standard stream as one that may lose its reader; any other as it is."""
    if not isinstance(stream, io.TextIOWrapper) or stream not in (sys.__stdout__, sys.__stderr__):
        return stream
    stream.flush()
    file: Any = _StandardStream(stream.fileno(), "wb", closefd=False)
    return io.TextIOWrapper(
        file if stream.write_through else io.BufferedWriter(file),
        encoding=stream.encoding, errors=stream.errors, line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )  # fmt: skip


def say(*lines: str, quiet: bool = False) -> None:
    """Say something on stderr at once, unless the command is to be quiet."""
    for line in () if quiet else lines:
        print(line, file=sys.stderr, flush=True)


def show_traceback(error: Exception) -> None:
    """Print an error's traceback to stderr where somebody asked for it."""
    if os.environ.get(DEBUG, "0") not in ("", "0"):
        traceback.print_exception(error)


def _interrupted(error: BaseException | None) -> bool:
    """Say whether an interrupt is behind an error: modules in C that are just loading make one of it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _internal(error: Exception) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{Path(last.filename).name}:{last.lineno}"
    said = " ".join(str(error).split())
    return (
        f"srs-twin: internal error: {type(error).__name__}: {said} ({where}). "
        "This is a fault of srs-twin, not of your files: please report it as CONTRIBUTING.md says; "
        "`srs-twin --debug …` shows the traceback"
    )
