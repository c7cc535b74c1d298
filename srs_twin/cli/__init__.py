"""Command line: one module per command; commands import their dependencies when they run."""

from __future__ import annotations

import atexit
import errno
import gc
import io
import os
import sys
import warnings
from typing import TYPE_CHECKING, Any, TextIO

from srs_twin.cli.console import INTERRUPTED, as_started, launcher, say, show_traceback
from srs_twin.errors import (
    CacheWarning,
    EngineWarning,
    InputError,
    SessionWarning,
    SrsError,
    TaskFailedError,
    UnitWarning,
)
from srs_twin.io.files import check_printable

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_GC_THRESHOLD = 200_000
"""Number of new objects between collections of garbage.

With Python's default of 700, collections take a sixth of the processor time of
`compare`; with this number, memory grows by 3 %."""

_PYTHON_FORMATWARNING = warnings.formatwarning

# File errors that no earlier check can exclude: a name that is too long, a full or
# read-only disk, missing permission, a defective medium. A missing file, or a folder in
# place of a file, remains an internal error.
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
    """Run `srs-twin` and exit the process with its exit code.

    Exit codes: 0 success; 1 an expectation failed under ``--check``; 2 invalid input; 3
    a simulation diverged; 4 internal error; 130 interrupted. Messages are printed on
    stderr, results on stdout. A pipe that its reader closes (``| head -1``) neither
    stops the command nor changes the exit code.

    Args:
        argv: arguments after the program name; default: those of this process.
    """
    sys.stdout = _without_broken_pipes(sys.stdout)
    sys.stderr = _without_broken_pipes(sys.stderr)
    gc.set_threshold(_GC_THRESHOLD)
    # Without objects to collect, the interpreter ends 0.7 s earlier; the system frees
    # their memory anyway.
    atexit.register(gc.freeze)
    warnings.formatwarning = _format_warning  # type: ignore[assignment]
    try:
        arguments = sys.argv[1:] if argv is None else argv
        for argument in arguments:
            check_printable(argument)
        _check_current_folder()
        from srs_twin.cli.app import command

        try:
            # Shells complete the installed program, which has no launcher.
            completes = any(argument.endswith("-completion") for argument in arguments)
            started = "srs-twin" if completes else f"{launcher()}srs-twin"
            named = next((each for each in arguments if each != "--debug"), "")
            command(named)(
                args=argv, prog_name=started, complete_var="_SRS_TWIN_COMPLETE"
            )
        finally:
            if sys.stdout is not None:
                # Here an error can still be reported and determine the exit code.
                sys.stdout.flush()
    except SrsError as error:
        show_traceback(error)
        say(str(error))
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except Exception as error:  # unexpected: one line and exit code 4
        if _is_interrupt(error):
            sys.exit(INTERRUPTED)
        show_traceback(error)
        code = errno.errorcode.get(getattr(error, "errno", None) or 0)
        if (
            isinstance(error, OSError)
            and error.filename
            and code in _FILE_SYSTEM_ERRORS
        ):
            say(f"{os.fsdecode(error.filename)}: cannot be used ({error.strerror})")
            sys.exit(InputError.exit_code)
        say(
            f"srs-twin: {TaskFailedError(error)}; `srs-twin --debug …` shows the"
            " traceback"
        )
        sys.exit(SrsError.exit_code)


def _check_current_folder() -> None:
    """Check that the current folder exists; relative paths depend on it.

    Raises:
        InputError: the current folder was removed.
    """
    try:
        os.getcwd()
    except OSError as error:
        raise InputError(
            f"cannot use the current folder ({error.strerror}); it may have been"
            " removed: change to another folder"
        ) from error


class _StandardStream(io.FileIO):
    """Standard stream that is redirected to the null device after a failed write.

    A pipe closed by its reader is not an error; a full disk is.
    """

    def write(self, data: ReadableBuffer, /) -> int:
        """Write bytes; return the number of bytes written.

        Raises:
            InputError: the write failed.
        """
        if not memoryview(data).nbytes:
            return 0  # libraries write nothing to test whether the stream is binary
        try:
            return super().write(data)
        except OSError as error:
            null = os.open(os.devnull, os.O_WRONLY)
            # Replace the descriptor itself, so that later writes by libraries, child
            # processes and the interpreter's shutdown also succeed.
            os.dup2(null, self.fileno())
            os.close(null)
            if isinstance(error, BrokenPipeError):
                return super().write(data)
            name = "stdout" if self.fileno() == 1 else "stderr"
            raise InputError(f"{name}: cannot be written ({error.strerror})") from error


def _without_broken_pipes(stream: TextIO) -> TextIO:
    """Wrap a standard stream of the process in a `_StandardStream`; return any other stream unchanged."""
    if not isinstance(stream, io.TextIOWrapper) or stream not in (
        sys.__stdout__,
        sys.__stderr__,
    ):
        return stream
    stream.flush()
    file: Any = _StandardStream(stream.fileno(), "wb", closefd=False)
    if not stream.write_through:
        file = io.BufferedWriter(file)
    options = {
        name: getattr(stream, name)
        for name in ("encoding", "errors", "line_buffering", "write_through")
    }
    return io.TextIOWrapper(file, **options)


def _format_warning(message: Any, category: type[Warning], *location: Any) -> str:
    """Format a warning; warnings about the machine omit the location in the code."""
    if category in (CacheWarning, EngineWarning, SessionWarning, UnitWarning):
        return as_started(f"warning: {message}\n")
    return _PYTHON_FORMATWARNING(message, category, *location)


def _is_interrupt(error: BaseException | None) -> bool:
    """Return whether an interrupt caused an error; C extensions may convert one during their import."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
