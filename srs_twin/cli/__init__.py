"""The command line: one module a verb, heavy imports inside the commands."""

from __future__ import annotations

import errno
import io
import os
import sys
import warnings
from typing import TYPE_CHECKING, Any, TextIO

from srs_twin.cli.console import INTERRUPTED, say, show_traceback
from srs_twin.errors import (
    CacheWarning,
    EngineWarning,
    InputError,
    SessionWarning,
    SrsError,
    TaskFailedError,
)
from srs_twin.io.files import check_printable

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_PYTHONS_WORDS = warnings.formatwarning

# Refusals of a path that no check of ours can foresee everywhere: a name too long, a full or read-only disk,
# missing permission, a broken medium. A file that is missing or of another kind stays an internal error.
_OF_THE_MACHINE = frozenset(
    {
        errno.ENAMETOOLONG,
        errno.EROFS,
        errno.ENOSPC,
        errno.EDQUOT,
        errno.EACCES,
        errno.EPERM,
        errno.ELOOP,
        errno.EIO,
    }
)


def main(argv: list[str] | None = None) -> None:
    """Run `srs-twin` and leave the process with its exit code.

    0 done; 1 an expectation failed under ``--check``; 2 bad input; 3 a simulation diverged; 4 internal
    error; 130 interrupted. Messages go to stderr, results to stdout; where nobody reads them any more
    (``| head -1``), the work goes on and the exit code is that of its results.

    Args:
        argv: the words after the program's name; None takes those of this process.
    """
    sys.stdout, sys.stderr = _guarded(sys.stdout), _guarded(sys.stderr)
    warnings.formatwarning = _worded  # type: ignore[assignment]
    try:
        for word in sys.argv[1:] if argv is None else argv:
            check_printable(word)
        _refuse_removed_folder()
        from srs_twin.cli.app import command

        try:
            command()(args=argv, prog_name="srs-twin")
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()  # now, while an error can still be said and decides the exit code
    except SrsError as error:
        show_traceback(error)
        say(str(error))
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except Exception as error:  # the outermost edge: what nobody foresaw becomes one line and exit code 4
        if _interrupted(error):
            sys.exit(INTERRUPTED)
        show_traceback(error)
        if isinstance(error, OSError) and error.filename and error.errno in _OF_THE_MACHINE:
            say(f"{os.fsdecode(error.filename)}: cannot be used ({error.strerror})")
            sys.exit(InputError.exit_code)
        say(f"srs-twin: {TaskFailedError(error)}; `srs-twin --debug …` shows the traceback")
        sys.exit(SrsError.exit_code)


def _refuse_removed_folder() -> None:
    """Refuse a current folder that was removed: relative paths mean nothing there.

    Raises:
        InputError: the current folder cannot be found.
    """
    try:
        os.getcwd()
    except OSError as error:
        raise InputError(
            f"the current folder cannot be used ({error.strerror}): was it removed? Change to another one"
        ) from error


class _StandardStream(io.FileIO):
    """Where a standard stream of the process leads: once it cannot be written, to the null device.

    A pipe whose reader leaves is no error; the disk behind it may be full, which is.
    """

    def write(self, data: ReadableBuffer, /) -> int:
        """Write bytes; return how many were taken.

        Raises:
            InputError: they cannot be written.
        """
        if not memoryview(data).nbytes:
            return 0  # a library finds out what kind of stream this is
        try:
            return super().write(data)
        except OSError as error:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            # The descriptor itself: what libraries, child processes and the interpreter's end write to it
            # goes there as well.
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            if isinstance(error, BrokenPipeError):
                return super().write(data)
            name = "stdout" if self.fileno() == 1 else "stderr"
            raise InputError(f"{name}: cannot be written ({error.strerror})") from error


def _guarded(stream: TextIO) -> TextIO:
    """Return a standard stream of the process on a `_StandardStream`; any other, and none, as it is."""
    if not isinstance(stream, io.TextIOWrapper) or stream not in (sys.__stdout__, sys.__stderr__):
        return stream
    stream.flush()
    file: Any = _StandardStream(stream.fileno(), "wb", closefd=False)
    kept = ("encoding", "errors", "line_buffering", "write_through")
    options = {name: getattr(stream, name) for name in kept}
    return io.TextIOWrapper(file if stream.write_through else io.BufferedWriter(file), **options)


def _worded(message: Any, kind: type[Warning], *place: Any) -> str:
    """Return a warning as it is printed: where in the code is of no use where the machine is meant."""
    return (
        f"warning: {message}\n"
        if kind in (CacheWarning, EngineWarning, SessionWarning)
        else _PYTHONS_WORDS(message, kind, *place)
    )


def _interrupted(error: BaseException | None) -> bool:
    """Say whether an interrupt is behind an error: modules in C that are just loading make one of it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
