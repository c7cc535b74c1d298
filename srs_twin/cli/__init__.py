"""Command line of srs_twin.

Commands import their dependencies when they run, so that `--help` is fast.
"""

from __future__ import annotations

import atexit
import errno
import gc
import io
import os
import signal
import sys
import warnings
from typing import TYPE_CHECKING, TextIO

from srs_twin.cli.console import (
    INTERRUPTED,
    as_started,
    keep_interrupts,
    launcher,
    say,
    show_traceback,
)
from srs_twin.errors import (
    RENAMED,
    InputError,
    RenamedWarning,
    SrsError,
    TaskFailedError,
    WriteError,
)
from srs_twin.io.files import check_printable

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_GC_THRESHOLD = 200_000
"""Number of new objects after which Python collects garbage.

With Python's default of 700, `compare` spends a sixth of its time on garbage
collection. The threshold of 200,000 increases memory use by 3 %.
"""

_PYTHON_FORMATWARNING = warnings.formatwarning

# These file system errors are reported as invalid input, because earlier checks cannot
# exclude them. The error for a missing file is not listed, because it would indicate a
# bug.
_FILE_SYSTEM_ERRORS = [
    "ENAMETOOLONG",
    "EROFS",
    "ENOSPC",
    "EDQUOT",
    "EACCES",
    "EPERM",
    "ELOOP",
    "EIO",
]


def main(argv: list[str] | None = None) -> None:
    """Run `srs-twin` and exit with the exit code of the command.

    The exit codes are 0 (success), 1 (an expectation failed under ``--check``), 2
    (invalid input or an error in a plug-in), 3 (a simulation diverged), 4 (internal
    error) and 130 (interrupted). If stdout is a pipe that the reader closes early (``|
    head -1``), the command continues and the exit code is unaffected.

    Args:
        argv: arguments without the program name, by default from `sys.argv`.
    """
    sys.stdout = _without_broken_pipes(sys.stdout)
    sys.stderr = _without_broken_pipes(sys.stderr)
    gc.set_threshold(_GC_THRESHOLD)
    # Skipping the final garbage collection saves 0.7 s at exit.
    atexit.register(gc.freeze)
    warnings.formatwarning = _format_warning
    try:
        arguments = sys.argv[1:] if argv is None else argv
        for argument in arguments:
            check_printable(argument)
        arguments = [_with_current_option(argument) for argument in arguments]
        _check_current_folder()
        # Shell completion works only for the installed program, not for `uv run`.
        completes = any(argument.endswith("-completion") for argument in arguments)
        started = "srs-twin" if completes else f"{launcher()}srs-twin"
        named = next((each for each in arguments if each != "--debug"), "")
        try:
            with keep_interrupts(signal.SIGINT):
                from srs_twin.cli.app import command

                command(named)(
                    args=arguments, prog_name=started, complete_var="_SRS_TWIN_COMPLETE"
                )
        finally:
            if sys.stdout is not None:
                # An error in this flush can be reported, unlike an error in the flush
                # of the interpreter at exit.
                sys.stdout.flush()
    except SrsError as error:
        show_traceback(error)
        say(str(error))
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except Exception as error:  # report an unexpected error on one line
        show_traceback(error)
        if (
            isinstance(error, OSError)
            and error.filename
            and errno.errorcode.get(error.errno or 0, "") in _FILE_SYSTEM_ERRORS
        ):
            say(
                f"{os.fsdecode(error.filename)}: the file cannot be used"
                f" ({error.strerror})"
            )
            sys.exit(InputError.exit_code)
        failed = TaskFailedError(error)
        say(f"srs-twin: {failed}; `srs-twin --debug …` shows the traceback")
        sys.exit(failed.exit_code)


def _with_current_option(argument: str) -> str:
    option, equals, value = argument.partition("=")
    if not option.startswith("--") or option not in RENAMED:
        return argument
    warnings.warn(f"{option} is now called {RENAMED[option]}", RenamedWarning, 2)
    return RENAMED[option] + equals + value


def _check_current_folder() -> None:
    try:
        os.getcwd()
    except OSError as error:
        raise InputError(
            f"the current folder cannot be used ({error.strerror}); if the folder was"
            " removed, change to another folder"
        ) from error


class _StandardStream(io.FileIO):
    """Standard stream that is redirected to the null device if a write fails.

    Writes to a closed pipe are ignored. Any other failure, such as a full disk, raises
    a `WriteError`.
    """

    def write(self, data: ReadableBuffer, /) -> int:
        if not memoryview(data).nbytes:
            return 0  # libraries write an empty bytes object to test for binary mode
        try:
            return super().write(data)
        except OSError as error:
            null = os.open(os.devnull, os.O_WRONLY)
            # Replacing the file descriptor lets later writes succeed, including writes
            # by libraries, by child processes and at interpreter shutdown.
            os.dup2(null, self.fileno())
            os.close(null)
            if isinstance(error, BrokenPipeError):
                return super().write(data)
            name = "stdout" if self.fileno() == 1 else "stderr"
            raise WriteError(
                f"{name}: the output cannot be written ({error.strerror})"
            ) from error


def _without_broken_pipes(stream: TextIO) -> TextIO:
    if not isinstance(stream, io.TextIOWrapper) or stream not in (
        sys.__stdout__,
        sys.__stderr__,
    ):
        return stream
    stream.flush()
    file: io.FileIO | io.BufferedWriter = _StandardStream(
        stream.fileno(), "wb", closefd=False
    )
    if not stream.write_through:
        file = io.BufferedWriter(file)
    options = {
        name: getattr(stream, name)
        for name in ("encoding", "errors", "line_buffering", "write_through")
    }
    return io.TextIOWrapper(file, **options)


def _format_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    if category.__module__ == RenamedWarning.__module__:  # a warning of this package
        return as_started(f"warning: {message}\n")
    return _PYTHON_FORMATWARNING(message, category, filename, lineno, line)
