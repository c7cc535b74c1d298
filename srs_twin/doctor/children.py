"""Child processes that try things out, all at once, within one time limit; none outlives it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import IO, Any

from srs_twin.errors import InputError

_FAREWELL_S = 5.0


@dataclass(frozen=True)
class Question:
    """What a child is to try.

    Attributes:
        words: name of a probe in `probes` and its arguments.
        env: variables that it gets besides those of this process.
    """

    words: tuple[str, ...]
    env: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Answer:
    """What came of it.

    Attributes:
        code: exit code, below 0 the signal that ended it; None: it was ended at the time limit.
        said: the JSON objects it printed, later ones over earlier ones.
        complaint: the first error it wrote, or how it ended; empty where all went well.
    """

    code: int | None
    said: Mapping[str, Any] = field(default_factory=dict)
    complaint: str = ""

    @property
    def well(self) -> bool:
        """Whether it came to its end without an error."""
        return self.code == 0


@dataclass(frozen=True)
class _Child:
    process: subprocess.Popen[bytes]
    out: IO[bytes]
    errors: IO[bytes]


def ask(questions: Mapping[str, Question], *, limit_s: float) -> dict[str, Answer]:
    """Try all of it at once; return the answers under the same names.

    However this ends, also by Ctrl-C, no child and nothing that a child started is left.

    Args:
        questions: what to try.
        limit_s: most that all of it together may take, s.

    Raises:
        InputError: there is no room for temporary files.
    """
    answers = {}
    with ExitStack() as stack:
        try:
            room = stack.enter_context(tempfile.TemporaryDirectory(prefix="srs-twin-doctor-"))
        except OSError as error:
            raise InputError(
                f"cannot write temporary files ({error.strerror}); set TMPDIR to a folder that can be written"
            ) from error
        children = {name: _start(question, room, stack) for name, question in questions.items()}
        deadline = time.monotonic() + limit_s
        for name, child in children.items():
            try:
                child.process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                answers[name] = Answer(None, complaint=f"no answer within {limit_s:g} s")
            else:
                answers[name] = _answer(child)
    return answers


def _start(question: Question, room: str, stack: ExitStack) -> _Child:
    """Start a child in a group of its own, in a folder that goes away; the stack ends the whole group."""
    out, errors = (stack.enter_context(tempfile.TemporaryFile()) for _ in range(2))
    process = subprocess.Popen(
        [sys.executable, "-m", "srs_twin.doctor.probes", *question.words],
        cwd=room, env={**os.environ, **question.env}, stdin=subprocess.DEVNULL,
        stdout=out, stderr=errors, start_new_session=True,
    )  # fmt: skip
    stack.callback(_end, process)
    return _Child(process, out, errors)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a child with all it started; where it ended by itself, what it may have left."""
    try:
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    except (ProcessLookupError, PermissionError):
        pass  # nobody is left in the group; macOS says PermissionError of one that has only just ended
    process.wait(_FAREWELL_S)


def _answer(child: _Child) -> Answer:
    code = child.process.returncode
    said: dict[str, Any] = {}
    for line in _text(child.out):
        said |= _object(line)
    complaint = "" if code == 0 else first_error(_text(child.errors)) or _end_in_words(code)
    return Answer(code, said, complaint)


def _text(stream: IO[bytes]) -> list[str]:
    stream.seek(0)
    return stream.read().decode("utf-8", "replace").splitlines()


def _object(line: str) -> dict[str, Any]:
    """Return the JSON object of a line; libraries print other things there too."""
    try:
        value = json.loads(line)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def first_error(lines: Sequence[str]) -> str:
    """Return what Python says of its first error, else the last line; empty where nothing was said.

    Later errors are mostly the first one's consequences, and those in destructors come last.
    """
    lines = [line for line in lines if line.strip()]
    starts = [i for i, line in enumerate(lines) if line.startswith("Traceback (most recent call last)")]
    if starts:
        after = (line for line in lines[starts[0] + 1 :] if not line.startswith(" "))
        return next(after, lines[-1]).strip()
    return lines[-1].strip() if lines else ""


def _end_in_words(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"ended by signal {-code}"
