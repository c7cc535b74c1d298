"""RowStore: rows that are kept as soon as they are finished, whatever happens to the process next.

An SQLite file in the sweep's folder. A row is there or not, never in part; nobody else can write while a
sweep does. Its log is not flushed to the disk at every row: what a process finished before it was killed
stays, only a power cut may take the last rows along, and they are run again.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from srs_twin.errors import InputError
from srs_twin.files import missing_folders, remove_empty, shown
from srs_twin.sweep.task import FAILED, Row

FILE = "rows.sqlite"

# What this program may be made to read: no row of ours is larger.
_LONGEST_BYTES = 1_000_000


Parsed = TypeVar("Parsed")


@dataclass(frozen=True)
class About:
    """Which sweep rows belong to, as plain data of JSON.

    Attributes:
        keys: hash of the keys of all points.
        scenario: the base's document.
        fields: what is varied.
        versions: package → version.
        sources: module that computes rows → hash of its source; none where it was not kept yet.
        files: file that rows read → hash of its contents.
    """

    keys: str
    scenario: dict[str, Any]
    fields: list[str]
    versions: dict[str, Any]
    sources: dict[str, str] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)


_DAMAGE = (sqlite3.Error, UnicodeDecodeError)  # a message of SQLite may quote what is damaged
_ABOUT = TypeAdapter(About)
_ROW = TypeAdapter(tuple[dict[str, Any], float, str | None, int])


class RowStore:
    """The rows of one sweep; a context manager that locks the folder."""

    def __init__(self, folder: Path) -> None:
        """Open or make the file, and the folder.

        Raises:
            InputError: the folder cannot be written, another sweep works in it, or the file is none of ours.
        """
        self._path = folder / FILE
        self._new, self._missing = not os.path.lexists(self._path), missing_folders(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{shown(folder)}: cannot be made ({error.strerror})") from error
        try:
            self._base = sqlite3.connect(self._path, timeout=0, isolation_level=None)
            self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_BYTES)
            # Exclusive first: the log then needs no shared memory, and network drives will do.
            for line in (
                "locking_mode=EXCLUSIVE",
                "journal_mode=WAL",
                "synchronous=NORMAL",
                "trusted_schema=OFF",
            ):
                self._base.execute(f"PRAGMA {line}")
            self._base.execute("BEGIN EXCLUSIVE")
            self._base.execute(
                "CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT NOT NULL)"
            )
            self._base.execute(
                "CREATE TABLE IF NOT EXISTS rows (key TEXT PRIMARY KEY, status TEXT, row TEXT NOT NULL)"
            )
            self._base.execute("COMMIT")
        except _DAMAGE as error:
            raise self._refusal(error) from error

    def __enter__(self) -> RowStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Unlock the folder; a file that this made is not left without a row."""
        # Closing also tidies up; on a full disk there is nothing to tidy with, and every row is safe.
        with contextlib.suppress(sqlite3.Error, OSError):
            empty = self._new and not self._base.execute("SELECT 1 FROM rows LIMIT 1").fetchall()
            self._base.close()
            if empty:
                self._path.unlink()
        remove_empty(self._missing)

    def about(self) -> About | None:
        """Return what `tell` kept, None where it never did.

        Raises:
            InputError: something else stands there.
        """
        found = self._read("SELECT value FROM about WHERE name = 'sweep'")
        return self._parsed(_ABOUT, found[0][0]) if found else None

    def tell(self, about: About) -> None:
        """Keep which sweep the rows belong to."""
        self._write("INSERT OR REPLACE INTO about VALUES ('sweep', ?)", json.dumps(asdict(about)))

    def add(self, row: Row) -> None:
        """Keep a row; one of the same key is replaced."""
        content = json.dumps([row.values, row.wall_s, row.reason, row.exit_code])
        self._write("INSERT OR REPLACE INTO rows VALUES (?, ?, ?)", row.key, row.status, content)

    def rows(self) -> Iterator[Row]:
        """Yield all rows in the order of their keys."""
        for key, status, content in self._read("SELECT key, status, row FROM rows ORDER BY key"):
            values, wall, reason, exit_code = self._parsed(_ROW, content)
            yield Row(key, status, values, wall, reason, exit_code)

    def keys(self, *, failed: bool) -> set[str]:
        """Return the keys of what is there; without failed rows if they are to be tried again."""
        found = self._read("SELECT key FROM rows WHERE ? OR status <> ?", failed, FAILED)
        return {key for (key,) in found}

    def keep(self, keys: Iterable[str]) -> None:
        """Drop all rows but these."""
        kept = set(keys)
        gone = [(key,) for (key,) in self._read("SELECT key FROM rows") if key not in kept]
        with self._guarded():
            self._base.execute("BEGIN")
            self._base.executemany("DELETE FROM rows WHERE key = ?", gone)
            self._base.execute("COMMIT")

    def _parsed(self, kind: TypeAdapter[Parsed], content: Any) -> Parsed:
        try:
            return kind.validate_json(content)
        except ValidationError as error:
            raise InputError(f"{shown(self._path)}: not the rows of a sweep; give another --out") from error

    def _read(self, query: str, *arguments: Any) -> list[Any]:
        with self._guarded():
            return self._base.execute(query, arguments).fetchall()

    def _write(self, query: str, *arguments: Any) -> None:
        with self._guarded():
            self._base.execute(query, arguments)

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except _DAMAGE as error:
            raise self._refusal(error) from error

    def _refusal(self, error: Exception) -> InputError:
        where, code = shown(self._path), getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code == sqlite3.SQLITE_BUSY:
            return InputError(
                f"{where}: another sweep works in this folder; wait for it or give another --out"
            )
        if code in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR):
            return InputError(
                f"{where}: cannot be written ({error}); what was finished is kept, start again to go on"
            )
        if code in (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_ERROR):
            return InputError(f"{where}: not the rows of a sweep ({error}); give another --out")
        return InputError(f"{where}: cannot be used ({error}); give another --out")
