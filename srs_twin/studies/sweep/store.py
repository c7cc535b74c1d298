"""Rows that are kept as soon as they are finished, and the table they become.

An SQLite file in the sweep's folder. A row is there or not, never in part; nobody else can write while a
sweep does. Its log is not flushed to the disk at every row: what a process finished before it was killed
stays, only a power cut may take the last rows along, and they are run again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from srs_twin.comparison.metrics import COMPARISON_UNITS
from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write, missing_folders, remove_empty, shown
from srs_twin.studies.sweep.points import Sweep
from srs_twin.studies.sweep.task import FAILED, PLAN, PLAN_TIME, Row

if TYPE_CHECKING:
    import pyarrow as pa


FILE = "rows.sqlite"

# What this program may be made to read: no row of ours is larger.
_LONGEST_BYTES = 1_000_000


Parsed = TypeVar("Parsed")


@dataclass(frozen=True)
class SweepIdentity:
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
# Exclusive first: the log then needs no shared memory, and network drives will do.
_OPENING = (
    "PRAGMA locking_mode=EXCLUSIVE",
    "PRAGMA journal_mode=WAL",
    "PRAGMA synchronous=NORMAL",
    "PRAGMA trusted_schema=OFF",
    "BEGIN EXCLUSIVE",
    "CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT NOT NULL)",
    "CREATE TABLE IF NOT EXISTS rows (key TEXT PRIMARY KEY, status TEXT, row TEXT NOT NULL)",
    "COMMIT",
)
_FULL = "cannot be written ({}); what was finished is kept, start again to go on"
_FOREIGN = "not the rows of a sweep ({}); give another --out"
_REFUSALS = {
    sqlite3.SQLITE_BUSY: "another sweep works in this folder; wait for it or give another --out",
    **dict.fromkeys((sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR), _FULL),
    **dict.fromkeys((sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_ERROR), _FOREIGN),
}
_IDENTITY = TypeAdapter(SweepIdentity)
_ROW = TypeAdapter(tuple[dict[str, Any], float, str | None, int])


class RowStore(contextlib.AbstractContextManager["RowStore"]):
    """The rows of one sweep; a context manager that locks the folder."""

    def __init__(self, folder: Path) -> None:
        """Open or make the file, and the folder.

        Raises:
            InputError: the folder cannot be written, another sweep works in it, or the file is none of ours.
        """
        self._path = folder / FILE
        self._new = not os.path.lexists(self._path)
        try:
            self._missing = missing_folders(folder)
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{shown(folder)}: cannot be made ({error.strerror})") from error
        try:
            self._base = sqlite3.connect(self._path, timeout=0, isolation_level=None)
            self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_BYTES)
            for line in _OPENING:
                self._base.execute(line)
        except _DAMAGE as error:
            raise self._refusal(error) from error

    def __exit__(self, *error: object) -> None:
        """Unlock the folder; a file that this made is not left without a row."""
        # Closing also tidies up; on a full disk there is nothing to tidy with, and every row is safe.
        with contextlib.suppress(sqlite3.Error, OSError):
            empty = self._new and not self._base.execute("SELECT 1 FROM rows LIMIT 1").fetchall()
            self._base.close()
            if empty:
                self._path.unlink()
        remove_empty(self._missing)

    def identity(self) -> SweepIdentity | None:
        """Return what `keep_identity` kept, None where it never did.

        Raises:
            InputError: something else stands there.
        """
        found = self._read("SELECT value FROM about WHERE name = 'sweep'")
        return self._parsed(_IDENTITY, found[0][0]) if found else None

    def keep_identity(self, identity: SweepIdentity) -> None:
        """Keep which sweep the rows belong to."""
        self._write("INSERT OR REPLACE INTO about VALUES ('sweep', ?)", json.dumps(asdict(identity)))

    def add(self, row: Row) -> None:
        """Keep a row and its files; one of the same key is replaced.

        Raises:
            InputError: they cannot be written.
        """
        # The row is what says that a point is done: its files come first.
        for plant, parquet in row.files.items():
            with atomic_write(self.trajectory_file(row.key, plant)) as part:
                part.write_bytes(parquet)
        content = json.dumps([row.values, row.wall_s, row.reason, row.exit_code])
        self._write("INSERT OR REPLACE INTO rows VALUES (?, ?, ?)", row.key, row.status, content)

    def trajectory_file(self, key: str, plant: str) -> Path:
        """Return where the trajectory of a plant is kept."""
        return self._path.parent / "trajectories" / f"{key}.{plant}.parquet"

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
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        text = _REFUSALS.get(code, "cannot be used ({}); give another --out")
        return InputError(f"{shown(self._path)}: {text.format(error)}")


RESULTS = "results.parquet"

_NUMBERS = re.compile(r"(_\d+)?(_period_\d+)?$")

_FIRST_OF_PLANS = ("plan_found", "plan_length_m", "plan_s")
_FIRST = ("com_speed_m_s", "yaw_rate_rad_s", "mean_bend_amplitude_rad", "com_speed_rel", "shape_rms_body")


def table(sweep: Sweep, rows: Sequence[Row]) -> pa.Table:
    """Return one row a point, ordered by key.

    Columns: ``key``, the varied fields by their dotted names, ``status``, ``reason``, ``exit_code``, the
    metrics as ``<plant>.<metric>`` and ``comparison.<metric>``, of what is only planned as
    ``plan.<metric>`` (null where there is none), ``wall_s``.

    Args:
        sweep: whose rows they are.
        rows: in any order.
    """
    import pyarrow as pa

    rows = sorted(rows, key=lambda row: row.key)
    changes = {point.key: point.changes for point in sweep.points}
    columns: dict[str, pa.Array] = {"key": pa.array([row.key for row in rows], pa.string())}
    for name in sweep.fields:
        columns[name] = _column([changes[row.key][name] for row in rows])
    for name, kind in (("status", pa.string()), ("reason", pa.string()), ("exit_code", pa.int8())):
        columns[name] = pa.array([getattr(row, name) for row in rows], kind)
    for metric in _metrics(sweep, rows):
        columns[metric] = pa.array([row.values.get(metric) for row in rows], pa.float64())
    columns["wall_s"] = pa.array([row.wall_s for row in rows], pa.float64())
    about = {"srs_twin.sweep": json.dumps({"title": sweep.title, "versions": dict(sweep.versions)})}
    return pa.table(columns).replace_schema_metadata(about)


def write(path: Path, found: pa.Table) -> None:
    """Write a table as Parquet, whole or not at all.

    Raises:
        InputError: the place cannot be written.
    """
    import pyarrow.parquet as pq

    with atomic_write(path) as part:
        pq.write_table(found, part, compression="zstd")


def digest(rows: Sequence[Row]) -> str:
    """Return the SHA-256 of rows, hex: whatever their order, wall times left out."""
    total = hashlib.sha256()
    for row in sorted(rows, key=lambda row: row.key):
        values = {name: value for name, value in row.values.items() if name != PLAN_TIME}
        content = [row.key, row.status, values, row.reason, row.exit_code]
        total.update(json.dumps(content, sort_keys=True).encode())
    return total.hexdigest()


def spans(found: pa.Table) -> dict[str, tuple[float, float, float]]:
    """Return least, median and most of what people look at first, where there is any."""
    import numpy as np

    spans = {}
    for name in found.column_names:
        owner, _, metric = name.partition(".")
        if metric in (_FIRST_OF_PLANS if owner == PLAN else _FIRST):
            values = found.column(name).drop_null().to_numpy()
            if len(values):
                spans[name] = (float(values.min()), float(np.median(values)), float(values.max()))
    return spans


def shown_metrics(sweep: Sweep) -> tuple[str, ...]:
    """Return the metrics that people are shown first: the file's, else those drawn and in `spans`."""
    if sweep.metrics is not None:
        return sweep.metrics
    published = sweep.beside.metrics if sweep.beside else ()
    first = _FIRST if sweep.experiment.plants else _FIRST_OF_PLANS
    return tuple(dict.fromkeys((*(plot.metric for plot in sweep.plots), *published, *first)))


def shown_columns(sweep: Sweep, found: pa.Table) -> pa.Table:
    """Return a table without the metrics that are not `shown_metrics`."""
    metrics, names = set(shown_metrics(sweep)), found.column_names
    about = {*names[: names.index("exit_code") + 1], "wall_s"}
    return found.select([n for n in names if n in about or _NUMBERS.sub("", n.partition(".")[2]) in metrics])


def _metrics(sweep: Sweep, rows: Sequence[Row]) -> list[str]:
    """Return the metrics that become columns, in the order in which runs name them."""
    found = dict.fromkeys(name for row in rows for name in row.values) or _expected(sweep)
    if sweep.metrics is None:
        return list(found)
    return [name for name in found if _NUMBERS.sub("", name.partition(".")[2]) in _stems(sweep.metrics)]


def _expected(sweep: Sweep) -> dict[str, None]:
    """Return the columns that pictures need where no run has come to say which there are."""
    named = (name for plot in sweep.plots for name in (plot.metric, plot.x, plot.by))
    wanted = [name for name in named if name is not None and name not in sweep.fields]
    owners = {
        name: ("comparison",) if name in COMPARISON_UNITS else sweep.experiment.plants or (PLAN,)
        for name in wanted
    }
    return dict.fromkeys(f"{owner}.{name}" for name in wanted for owner in owners[name])


def _stems(metrics: Sequence[str]) -> set[str]:
    """Return what the names of these metrics begin with, numbered elements and chambers included."""
    return {f"{metric}{side}" for metric in metrics for side in ("", "_plus", "_minus")}


def _column(values: Sequence[Any]) -> pa.Array:
    """Return values of a field as one column: all numbers, all true or false, or all text."""
    import pyarrow as pa

    kinds = {type(value) for value in values}
    if kinds <= {bool}:
        return pa.array(values, pa.bool_())
    if kinds <= {int}:
        return pa.array(values, pa.int64())
    if kinds <= {int, float}:
        return pa.array([float(value) for value in values], pa.float64())
    return pa.array([value if isinstance(value, str) else json.dumps(value) for value in values], pa.string())
