"""The command line: one module a verb, heavy imports inside the commands."""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path

from srs_twin.errors import SrsError

DEBUG = "SRS_TWIN_DEBUG"
INTERRUPTED = 130


def main(argv: list[str] | None = None) -> None:
    """Run `srs-twin` and leave the process with its exit code.

    0 done; 1 an expectation failed under ``--check``; 2 bad input; 3 a simulation diverged; 4 internal
    error; 130 interrupted. Messages go to stderr, results to stdout.

    Args:
        argv: the words after the program's name; None takes those of this process.
    """
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
