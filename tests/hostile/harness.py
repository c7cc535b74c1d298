"""Every parser of files from outside, what must not get past it, and what it must read back.

A new parser joins with one `Parser` in `parsers.PARSERS`: the tests here and ``benchmarks/fuzz.py`` go over
all of them. Three things are shown of each: every malformed file is refused with one `InputError` that
names the file and the place, generated files raise nothing else, and what it writes it reads back.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from srs_twin.errors import InputError
from srs_twin.io.files import shown

Make = Callable[[Path], None]
Generated = st.SearchStrategy[bytes]


@dataclass(frozen=True)
class Malformed:
    """A file that has to be refused.

    Attributes:
        name: what is wrong with it.
        content: its bytes, or what makes it at a path (a pipe, a link, files beside it).
        says: words of the message, with the place where the format has places.
    """

    name: str
    content: bytes | Make
    says: str

    def write(self, path: Path) -> None:
        """Put the file there."""
        if isinstance(self.content, bytes):
            path.write_bytes(self.content)
        else:
            self.content(path)


@dataclass(frozen=True)
class Identity:
    """What a parser reads back as it was.

    Attributes:
        things: what it may be given to write.
        write: makes a file's bytes of one.
    """

    things: st.SearchStrategy[Any]
    write: Callable[[Any], bytes]


@dataclass(frozen=True)
class Parser:
    """What reads one kind of file.

    Attributes:
        name: of the kind.
        suffix: of its files.
        good: a file that it reads.
        parse: reads a path; raises `InputError` for what it refuses, and nothing else.
        malformed: files that it refuses, besides `PLACES`.
        values: files of the right format with arbitrary values anywhere.
        command: words of the command line that read it, {} for the file; None: no command does.
        function: where there is no command, "module:name" of what reads a path.
        quick: as `parse`, for thousands of generated files.
        identity: what it reads back, where we write such files.
        same: whether two of what it returns are the same.
    """

    name: str
    suffix: str
    good: bytes
    parse: Callable[[Path], Any]
    malformed: tuple[Malformed, ...]
    values: Generated
    command: tuple[str, ...] | None = None
    function: str = ""
    quick: Callable[[Path], Any] | None = None
    identity: Identity | None = None
    same: Callable[[Any, Any], bool] = field(default=lambda one, other: bool(one == other))

    @property
    def refused(self) -> tuple[Malformed, ...]:
        """All files that it has to refuse, wherever they come from."""
        return PLACES + self.malformed

    def words(self, path: Path) -> list[str]:
        """Return the command line that reads a path."""
        return [word.format(path) for word in self.command or ()]

    def survives(self, content: bytes, path: Path) -> str | None:
        """Let it read bytes; return the message with which it refuses them, None where it does not.

        Whatever is raised besides `InputError` goes through.
        """
        path.write_bytes(content)
        try:
            (self.quick or self.parse)(path)
        except InputError as error:
            said = str(error)
            assert error.exit_code == 2 and said and "Traceback" not in said
            assert path.name in said, f"{said!r} does not name the file"
            return said
        return None

    @property
    def generated(self) -> dict[str, Generated]:
        """Ways to make files nobody thought of."""
        return {"damaged": damaged(self.good), "values": self.values, "bytes": st.binary(max_size=400)}


def refusal(parser: Parser, path: Path) -> str:
    """Return the message with which a path is refused.

    Raises:
        AssertionError: it is not refused, or the message does not begin with the file.
    """
    try:
        parser.parse(path)
    except InputError as error:
        said = str(error)
        assert error.exit_code == 2
        assert all(line.lstrip("'").startswith(shown(path)) for line in said.splitlines()), said
        return said
    raise AssertionError(f"{path.name} was read")


def damaged(good: bytes) -> Generated:
    """Return a good file with pieces cut out, put in, doubled, moved and bits turned."""
    places = st.integers(0, len(good))
    text = st.text("\t\n :#-?{}[],&*!|>'\"%@`<=~/.0123456789aexyn_\\", max_size=5).map(str.encode)
    edit = st.one_of(
        st.tuples(places, st.integers(0, 6), text | st.binary(max_size=5)),
        st.tuples(places, st.integers(0, 200), st.sampled_from([b"", b"\0", b"1e999", b"-1", b"\xff\xfe"])),
        st.tuples(
            places, st.just(0), st.tuples(places, places).map(lambda ends: good[min(ends) : max(ends)])
        ),
        st.tuples(places, st.just(1), st.integers(0, 255).map(lambda byte: bytes([byte]))),
    )

    def apply(edits: list[tuple[int, int, bytes]]) -> bytes:
        content = good
        for start, length, new in edits:
            content = content[:start] + new + content[start + length :]
        return content

    return st.lists(edit, max_size=4).map(apply)


def _link(target: str) -> Make:
    return lambda path: path.symlink_to(target)


def _sparse(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(8 << 30)


# A pipe that nobody writes to, and devices that never end, must not even be opened.
PLACES: tuple[Malformed, ...] = (
    Malformed("missing", lambda path: None, "no such file"),
    Malformed("folder", Path.mkdir, "a folder; give one file"),
    Malformed("pipe", os.mkfifo, "not a regular file"),
    Malformed("endless zeros", _link("/dev/zero"), "not a regular file"),
    Malformed("endless noise", _link("/dev/urandom"), "not a regular file"),
    Malformed("terminal", _link("/dev/tty"), "not a regular file"),
    Malformed("link to itself", lambda path: path.symlink_to(path.name), "a link that leads to no file"),
    Malformed("link to nothing", _link("nowhere"), "a link that leads to no file"),
    Malformed("link to a folder", _link("/etc"), "a folder; give one file"),
    Malformed("empty", b"", ""),
    Malformed("one zero byte", b"\0", ""),
    Malformed("eight gigabytes of holes", _sparse, ""),
    Malformed("noise", random.Random(0).randbytes(4096), ""),
    Malformed("a picture", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(64), ""),
    Malformed("a zip file", b"PK\x03\x04" + bytes(64), ""),
)  # fmt: skip
