"""Storage of finished rows in an SQLite file.

No row is lost if the process is killed. After a power failure, the last rows may be
missing, because the write-ahead log is not flushed to disk after every row.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from srs_twin.compute.workers import TaskResult
from srs_twin.errors import InputError, WriteError
from srs_twin.io.files import (
    SWEEP_ROWS,
    atomic_write,
    display_path,
    missing_folders,
    remove_empty_folders,
)
from srs_twin.io.provenance import Provenance
from srs_twin.studies.sweep.task import FAILED, PLAN_TIME, Row, failed_row

FILE = SWEEP_ROWS

_MAX_BYTES = 1_000_000
"""Maximum size of a value that is read from the file, bytes."""


Parsed = TypeVar("Parsed")


_DAMAGE = (
    sqlite3.Error,
    UnicodeDecodeError,
)  # Error messages about a damaged file may contain invalid text.

# Exclusive locking is set first, so that the log does not need shared memory, which
# network drives do not support.
_OPENING = (
    "PRAGMA locking_mode=EXCLUSIVE",
    "PRAGMA journal_mode=WAL",
    "PRAGMA synchronous=NORMAL",
    "PRAGMA trusted_schema=OFF",
    "BEGIN EXCLUSIVE",
    "CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT NOT NULL)",
    (
        "CREATE TABLE IF NOT EXISTS rows (key TEXT PRIMARY KEY, status TEXT, row TEXT"
        " NOT NULL)"
    ),
    "COMMIT",
)
_DISK_FULL = (
    "the file cannot be written ({}). Finished rows are kept; start the command"
    " again to resume"
)
_NOT_A_STORE = (
    "the file does not contain the rows of a sweep ({}); give another folder with --out"
)
_MESSAGES = {
    sqlite3.SQLITE_BUSY: (
        "another sweep uses this folder; wait until it ends, or give another folder"
        " with --out"
    ),
    **dict.fromkeys((sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR), _DISK_FULL),
    **dict.fromkeys(
        (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_ERROR),
        _NOT_A_STORE,
    ),
}
_PROVENANCE = TypeAdapter(Provenance)
_ROW = TypeAdapter(tuple[dict[str, Any], float, str | None, int])


class RowStore(contextlib.AbstractContextManager["RowStore"]):
    """Row storage of a sweep, which locks its folder while it is open."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE
        self._is_new = not os.path.lexists(self._path)
        try:
            self._missing = missing_folders(folder)
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{display_path(folder)}: the folder cannot be created"
                f" ({error.strerror})"
            ) from error
        try:
            self.database = sqlite3.connect(self._path, timeout=0, isolation_level=None)
            self.database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_BYTES)
            for statement in _OPENING:
                self.database.execute(statement)
        except _DAMAGE as error:
            raise self._input_error(error) from error

    def __exit__(self, *error: object) -> None:
        """Unlock the folder, and delete a newly created file that contains no rows."""
        # Closing the database copies the log into it. On a full disk, this fails, but
        # the rows remain in the log.
        with contextlib.suppress(sqlite3.Error, OSError):
            is_empty = (
                self._is_new
                and not self.database.execute("SELECT 1 FROM rows LIMIT 1").fetchall()
            )
            self.database.close()
            if is_empty:
                self._path.unlink()
        remove_empty_folders(self._missing)

    def claim(self, now: Provenance, *, changed: bool = False) -> None:
        """Record that the folder belongs to a study.

        Args:
            now: provenance of the study.
            changed: whether to accept rows of a different version of the study.

        Raises:
            InputError: the rows belong to a different version of the study.
        """
        for (text,) in self._read("SELECT value FROM about WHERE name = 'sweep'"):
            before = self._parse(_PROVENANCE, text)
            if before.key == now.key:
                return
            if not changed:
                raise InputError(
                    f"{display_path(self._path.parent)}: the rows in this folder belong"
                    " to another study or to another version of it"
                    f" ({now.difference(before)}). Use --changed to keep the rows"
                    " that still apply and run the others, or give another folder with"
                    " --out"
                )
        self._write("INSERT OR REPLACE INTO about VALUES ('sweep', ?)", now.text)

    def add(self, row: Row) -> None:
        """Store a row and its files, and replace an existing row with the same key."""
        # The files are written first, because the row marks the point as finished.
        for plant, parquet in row.files.items():
            with atomic_write(self.trajectory_file(row.key, plant)) as part:
                part.write_bytes(parquet)
        content = json.dumps([row.values, row.wall_s, row.reason, row.exit_code])
        self._write(
            "INSERT OR REPLACE INTO rows VALUES (?, ?, ?)", row.key, row.status, content
        )

    def collect(
        self,
        finished: Iterator[TaskResult[Row]],
        keys: Sequence[str],
        on_row: Callable[[Row], object] | None = None,
    ) -> None:
        """Store the row of each task as soon as the task finishes.

        If a task raises an error, a failed row is stored.
        """
        with contextlib.closing(finished) as results:  # type: ignore[type-var]
            for done in results:
                row = done.result or failed_row(keys[done.number], done.error)
                self.add(row)
                if on_row is not None:
                    on_row(row)

    def trajectory_file(self, key: str, plant: str) -> Path:
        """Return the path of a stored trajectory."""
        return self._path.parent / "trajectories" / f"{key}.{plant}.parquet"

    def rows(self) -> Iterator[Row]:
        """Yield all rows, sorted by key."""
        for key, status, content in self._read(
            "SELECT key, status, row FROM rows ORDER BY key"
        ):
            values, wall, reason, exit_code = self._parse(_ROW, content)
            yield Row(key, status, values, wall, reason, exit_code)

    def keys(self, *, failed: bool) -> set[str]:
        """Return the keys of the stored rows, optionally including failed rows."""
        rows = self._read("SELECT key FROM rows WHERE ? OR status <> ?", failed, FAILED)
        return {key for (key,) in rows}

    def retain(self, keys: Iterable[str]) -> None:
        """Delete all rows except those with the given keys."""
        kept = set(keys)
        removed = [
            (key,) for (key,) in self._read("SELECT key FROM rows") if key not in kept
        ]
        with self._errors_translated():
            self.database.execute("BEGIN")
            self.database.executemany("DELETE FROM rows WHERE key = ?", removed)
            self.database.execute("COMMIT")

    def _parse(self, adapter: TypeAdapter[Parsed], content: str) -> Parsed:
        try:
            return adapter.validate_json(content)
        except ValidationError as error:
            raise InputError(
                f"{display_path(self._path)}: the file does not contain the rows of a"
                " sweep; give another folder with --out"
            ) from error

    def _read(self, query: str, *arguments: str | bool) -> list[tuple[str, ...]]:
        with self._errors_translated():
            return self.database.execute(query, arguments).fetchall()

    def _write(self, query: str, *arguments: str) -> None:
        with self._errors_translated():
            self.database.execute(query, arguments)

    @contextlib.contextmanager
    def _errors_translated(self) -> Iterator[None]:
        try:
            yield
        except _DAMAGE as error:
            raise self._input_error(error) from error

    def _input_error(self, error: Exception) -> InputError:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        text = _MESSAGES.get(
            code, "the file cannot be used ({}); give another folder with --out"
        )
        kind = WriteError if text == _DISK_FULL else InputError
        return kind(f"{display_path(self._path)}: {text.format(error)}")


def rows_digest(rows: Sequence[Row]) -> str:
    """Return the SHA-256 of rows, which ignores wall times and the row order."""
    digest = hashlib.sha256()
    for row in sorted(rows, key=lambda row: row.key):
        values = {
            name: value for name, value in row.values.items() if name != PLAN_TIME
        }
        content = [row.key, row.status, values, row.reason, row.exit_code]
        digest.update(json.dumps(content, sort_keys=True).encode())
    return digest.hexdigest()
