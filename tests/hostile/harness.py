"""Parsers of untrusted files: types for their malformed and valid files, and checks that apply to all.

A new parser needs one `Parser` in `parsers.PARSERS`; the tests and
``tools/fuzz.py`` then use it. They check two properties: every malformed file is
rejected with an `InputError` that names file and position, and generated files raise no
other exception.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import eq
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from srs_twin.errors import InputError
from srs_twin.io.files import display_path

MakeFile = Callable[[Path], object]
Contents = st.SearchStrategy[bytes]


@dataclass(frozen=True)
class Malformed:
    """File that must be rejected.

    Attributes:
        name: defect of the file.
        content: bytes of the file, or a function that creates it at a path (a pipe, a
            link, several files).
        message: part of the expected message, with the position if the format has
            positions.
    """

    name: str
    content: bytes | MakeFile
    message: str

    def write(self, path: Path) -> None:
        """Create the file."""
        if isinstance(self.content, bytes):
            path.write_bytes(self.content)
        else:
            self.content(path)


@dataclass(frozen=True)
class Parser:
    """Parser of one kind of file.

    Attributes:
        name: kind of file.
        suffix: suffix of the files.
        good: content of a valid file.
        parse: reads a path; raises only `InputError`.
        malformed: files to reject, in addition to `SPECIAL_FILES`.
        values: strategy for files of the right format with arbitrary values.
        command: command line that reads the file, with {} for its path; empty if there
            is none.
        function: "module:name" of the reading function if there is no command.
        quick: faster version of `parse` for generated files.
        same: comparison of two results of `parse`.
    """

    name: str
    suffix: str
    good: bytes
    parse: Callable[[Path], Any]
    malformed: tuple[Malformed, ...]
    values: Contents
    command: str = ""
    function: str = ""
    quick: Callable[[Path], Any] | None = None
    same: Callable[[Any, Any], bool] = field(default=eq)

    @property
    def all_malformed(self) -> tuple[Malformed, ...]:
        """All files that the parser must reject."""
        return SPECIAL_FILES + self.malformed

    @property
    def generated(self) -> dict[str, Contents]:
        """Strategies for random files, by name."""
        return {
            "damaged": damaged(self.good),
            "values": self.values,
            "bytes": st.binary(max_size=400),
        }

    def path_in(self, folder: Path) -> Path:
        """Return a path for a file of this kind."""
        return folder / f"x{self.suffix}"

    def arguments(self, path: Path) -> list[str]:
        """Return the arguments of the command that reads a path."""
        return [word.format(path) for word in self.command.split()]

    def read_or_reject(self, content: bytes, path: Path) -> str | None:
        """Parse bytes; return None, or the message of an `InputError`.

        Other exceptions are not caught.
        """
        path.write_bytes(content)
        try:
            (self.quick or self.parse)(path)
        except InputError as error:
            message = str(error)
            assert error.exit_code == 2 and message and "Traceback" not in message
            assert path.name in message, f"{message!r} does not name the file"
            return message
        return None


def rejection(parser: Parser, path: Path) -> str:
    """Return the message with which a path is rejected.

    Raises:
        AssertionError: it is accepted, or a line of the message does not begin with the
            file.
    """
    try:
        parser.parse(path)
    except InputError as error:
        message = str(error)
        assert error.exit_code == 2
        check_lines(message, display_path(path))
        return message
    raise AssertionError(f"{path.name} was read")


def check_lines(message: str, name: str) -> None:
    """Check that every line of a message begins with the name of a file."""
    assert all(line.lstrip("'").startswith(name) for line in message.splitlines()), (
        message
    )


def damaged(good: bytes) -> Contents:
    """Return a strategy for a valid file with deletions, insertions, copies and changed bytes."""
    offset = st.integers(0, len(good))
    text = st.text("\t\n :#-?{}[],&*!|>'\"%@`<=~/.0123456789aexyn_\\", max_size=5).map(
        str.encode
    )
    edit = st.one_of(
        st.tuples(offset, st.integers(0, 6), text | st.binary(max_size=5)),
        st.tuples(
            offset,
            st.integers(0, 200),
            st.sampled_from([b"", b"\0", b"1e999", b"-1", b"\xff\xfe"]),
        ),
        st.tuples(
            offset,
            st.just(0),
            st.tuples(offset, offset).map(lambda ends: good[min(ends) : max(ends)]),
        ),
        st.tuples(
            offset, st.just(1), st.integers(0, 255).map(lambda byte: bytes([byte]))
        ),
    )

    def apply(edits: list[tuple[int, int, bytes]]) -> bytes:
        content = good
        for start, length, new in edits:
            content = content[:start] + new + content[start + length :]
        return content

    return st.lists(edit, max_size=4).map(apply)


def link(target: str) -> MakeFile:
    """Return a function that creates a symbolic link."""
    return lambda path: path.symlink_to(target)


def _sparse(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(8 << 30)


# Pipes without a writer and endless devices must not be opened.
SPECIAL_FILES: tuple[Malformed, ...] = (
    Malformed("missing", lambda path: None, "no such file"),
    Malformed("folder", Path.mkdir, "a folder; give one file"),
    Malformed("pipe", os.mkfifo, "not a regular file"),
    Malformed("endless zeros", link("/dev/zero"), "not a regular file"),
    Malformed("endless noise", link("/dev/urandom"), "not a regular file"),
    Malformed("terminal", link("/dev/tty"), "not a regular file"),
    Malformed(
        "link to itself", lambda path: path.symlink_to(path.name), "a broken link"
    ),
    Malformed("link to a missing file", link("nowhere"), "a broken link"),
    Malformed("link to a folder", link("/etc"), "a folder; give one file"),
    Malformed("empty", b"", ""),
    Malformed("one zero byte", b"\0", ""),
    Malformed("sparse file of 8 GB", _sparse, ""),
    Malformed("noise", random.Random(0).randbytes(4096), ""),
    Malformed("PNG file", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(64), ""),
    Malformed("ZIP file", b"PK\x03\x04" + bytes(64), ""),
)
