"""Source: a recorded file as bytes within bounds, with its hash, and places in it for messages."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from srs_twin.errors import InputError
from srs_twin.io.files import existing, shown

MAX_BYTES = 256 << 20
"""An hour of ten markers at 120 Hz has half as many."""

MAX_HEADER_BYTES = 4 << 20
"""A take in which thousands of markers came and went has a header of one megabyte."""


@dataclass(frozen=True)
class Source:
    """A file that was read.

    Attributes:
        name: as messages show it.
        path: where it lies.
        data: its bytes.
    """

    name: str
    path: Path
    data: bytes

    @cached_property
    def raw(self) -> bytes:
        """The bytes without a byte order mark."""
        return self.data.removeprefix(b"\xef\xbb\xbf")

    @cached_property
    def sha256(self) -> str:
        """Hash of the file, hexadecimal."""
        return hashlib.sha256(self.data).hexdigest()

    def error(self, what: str, line: int | None = None, column: int | None = None) -> InputError:
        """Return an error that names the place, both counted from 1; a column is a cell's number."""
        place = "".join(f":{number}" for number in (line, column) if number is not None)
        return InputError(f"{self.name}{place}: {what}")

    def head(self, lines: int) -> list[str]:
        """Return up to that many first lines without their ends.

        Raises:
            InputError: they are longer than any header.
        """
        found: list[str] = []
        start = 0
        while len(found) < lines and start < len(self.raw):
            end = self.raw.find(b"\n", start, MAX_HEADER_BYTES)
            if end < 0:
                if len(self.raw) > MAX_HEADER_BYTES:
                    raise self.error(
                        f"the header, or a line, is longer than {MAX_HEADER_BYTES >> 20} MB", len(found) + 1
                    )
                end = len(self.raw)
            found.append(self.raw[start:end].decode("utf-8", "replace").rstrip("\r"))
            start = end + 1
        return found


def read_source(path: str | os.PathLike[str]) -> Source:
    """Read a recorded file.

    Raises:
        InputError: missing, no regular file, not readable, empty, too large, or not UTF-8 text.
    """
    place = existing(Path(path), suffix=".csv")
    name = shown(place)
    try:
        size = place.stat().st_size
        if size > MAX_BYTES:
            raise InputError(
                f"{name}: {size / (1 << 20):.0f} MB; at most {MAX_BYTES >> 20} MB are read (export a shorter "
                "take)"
            )
        raw = place.read_bytes()
    except OSError as error:
        raise InputError(f"{name}: cannot be read ({error.strerror})") from error
    _check_text(name, raw)
    return Source(name, place, raw)


def _check_text(name: str, raw: bytes) -> None:
    if not raw.removeprefix(b"\xef\xbb\xbf").strip():
        raise InputError(f"{name}: empty; a recording has a header and rows of numbers")
    # A byte order mark of UTF-16, or a zero byte anywhere: neither stands in a CSV file.
    zero = raw.find(b"\0")
    if zero >= 0 and not raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{name}: not text (byte {zero + 1} is 0x00); a CSV file is wanted")
    if raw.isascii():
        return
    try:
        raw.decode("utf-8")
    except UnicodeDecodeError as error:
        byte = f"byte {error.start + 1} is 0x{raw[error.start]:02x}"
        raise InputError(f"{name}: not UTF-8 text ({byte}); save it as UTF-8") from error
