"""Storage of rows as soon as they are finished, and the table of results.

Rows are in an SQLite file in the sweep's folder. A row is written completely or not at all, and only one
process can write. The log is not flushed to disk after every row: rows of a killed process are kept, but a
power failure may lose the last ones, which are then run again.
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
from srs_twin.io.files import atomic_write, display_path, missing_folders, remove_empty_folders
from srs_twin.studies.sweep.points import Sweep
from srs_twin.studies.sweep.task import FAILED, PLAN, PLAN_TIME, Row

if TYPE_CHECKING:
    import pyarrow as pa


FILE = "rows.sqlite"

_MAX_BYTES = 1_000_000
"""Largest size of a value that is read, as protection against damaged files; rows are smaller."""


Parsed = TypeVar("Parsed")


@dataclass(frozen=True)
class SweepIdentity:
    """Identity of the sweep to which rows belong, as JSON values.

    Attributes:
        keys: hash of the keys of all points.
        scenario: scenario of the experiment.
        fields: varied fields.
        versions: package → version.
        sources: module that computes rows → hash of its source; empty in files of older versions.
        files: file that points read → hash of its contents.
    """

    keys: str
    scenario: dict[str, Any]
    fields: list[str]
    versions: dict[str, Any]
    sources: dict[str, str] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)


_DAMAGE = (sqlite3.Error, UnicodeDecodeError)  # SQLite may quote damaged text in its message

# Set exclusive locking first: the log then needs no shared memory, so network drives work.
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
_DISK_FULL = "cannot be written ({}); finished rows are kept, start again to resume"
_NOT_A_STORE = "not the rows of a sweep ({}); give another --out"
_MESSAGES = {
    sqlite3.SQLITE_BUSY: "another sweep works in this folder; wait for it or give another --out",
    **dict.fromkeys((sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR), _DISK_FULL),
    **dict.fromkeys((sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_ERROR), _NOT_A_STORE),
}
"""SQLite error code → message."""
_IDENTITY = TypeAdapter(SweepIdentity)
_ROW = TypeAdapter(tuple[dict[str, Any], float, str | None, int])


class RowStore(contextlib.AbstractContextManager["RowStore"]):
    """Stored rows of one sweep; a context manager that locks the folder."""

    def __init__(self, folder: Path) -> None:
        """Open or create the file, and the folder.

        Raises:
            InputError: the folder cannot be written, another sweep works in it, or the file is not a store.
        """
        self._path = folder / FILE
        self._is_new = not os.path.lexists(self._path)
        try:
            self._missing = missing_folders(folder)
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{display_path(folder)}: cannot be created ({error.strerror})") from error
        try:
            self._database = sqlite3.connect(self._path, timeout=0, isolation_level=None)
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_BYTES)
            for statement in _OPENING:
                self._database.execute(statement)
        except _DAMAGE as error:
            raise self._input_error(error) from error

    def __exit__(self, *error: object) -> None:
        """Unlock the folder; delete a new file without rows."""
        # Closing copies the log into the database. On a full disk this fails, but the rows are safe in the
        # log.
        with contextlib.suppress(sqlite3.Error, OSError):
            is_empty = self._is_new and not self._database.execute("SELECT 1 FROM rows LIMIT 1").fetchall()
            self._database.close()
            if is_empty:
                self._path.unlink()
        remove_empty_folders(self._missing)

    def identity(self) -> SweepIdentity | None:
        """Return the stored identity; None if there is none.

        Raises:
            InputError: the stored identity is damaged.
        """
        rows = self._read("SELECT value FROM about WHERE name = 'sweep'")
        return self._parse(_IDENTITY, rows[0][0]) if rows else None

    def set_identity(self, identity: SweepIdentity) -> None:
        """Store the identity of the sweep to which the rows belong."""
        self._write("INSERT OR REPLACE INTO about VALUES ('sweep', ?)", json.dumps(asdict(identity)))

    def add(self, row: Row) -> None:
        """Store a row and its files; replace one with the same key.

        Raises:
            InputError: they cannot be written.
        """
        # Write the files first, because the row marks the point as finished.
        for plant, parquet in row.files.items():
            with atomic_write(self.trajectory_file(row.key, plant)) as part:
                part.write_bytes(parquet)
        content = json.dumps([row.values, row.wall_s, row.reason, row.exit_code])
        self._write("INSERT OR REPLACE INTO rows VALUES (?, ?, ?)", row.key, row.status, content)

    def trajectory_file(self, key: str, plant: str) -> Path:
        """Return the path of a stored trajectory."""
        return self._path.parent / "trajectories" / f"{key}.{plant}.parquet"

    def rows(self) -> Iterator[Row]:
        """Yield all rows in the order of their keys."""
        for key, status, content in self._read("SELECT key, status, row FROM rows ORDER BY key"):
            values, wall, reason, exit_code = self._parse(_ROW, content)
            yield Row(key, status, values, wall, reason, exit_code)

    def keys(self, *, failed: bool) -> set[str]:
        """Return the keys of the stored rows, optionally without those of failed runs."""
        rows = self._read("SELECT key FROM rows WHERE ? OR status <> ?", failed, FAILED)
        return {key for (key,) in rows}

    def retain(self, keys: Iterable[str]) -> None:
        """Delete all rows except those with the given keys."""
        kept = set(keys)
        removed = [(key,) for (key,) in self._read("SELECT key FROM rows") if key not in kept]
        with self._errors_translated():
            self._database.execute("BEGIN")
            self._database.executemany("DELETE FROM rows WHERE key = ?", removed)
            self._database.execute("COMMIT")

    def _parse(self, adapter: TypeAdapter[Parsed], content: Any) -> Parsed:
        try:
            return adapter.validate_json(content)
        except ValidationError as error:
            raise InputError(
                f"{display_path(self._path)}: not the rows of a sweep; give another --out"
            ) from error

    def _read(self, query: str, *arguments: Any) -> list[Any]:
        with self._errors_translated():
            return self._database.execute(query, arguments).fetchall()

    def _write(self, query: str, *arguments: Any) -> None:
        with self._errors_translated():
            self._database.execute(query, arguments)

    @contextlib.contextmanager
    def _errors_translated(self) -> Iterator[None]:
        try:
            yield
        except _DAMAGE as error:
            raise self._input_error(error) from error

    def _input_error(self, error: Exception) -> InputError:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        text = _MESSAGES.get(code, "cannot be used ({}); give another --out")
        return InputError(f"{display_path(self._path)}: {text.format(error)}")


RESULTS = "results.parquet"

_NUMBERS = re.compile(r"(_\d+)?(_period_\d+)?$")
"""Suffix of the column name for an element of a list metric."""

_SUMMARY_METRICS = (
    "com_speed_m_s",
    "yaw_rate_rad_s",
    "mean_bend_amplitude_rad",
    "com_speed_rel",
    "shape_rms_body",
)
"""Metrics that are shown first."""

_PLAN_SUMMARY_METRICS = ("plan_found", "plan_length_m", "plan_s")
"""Metrics that are shown first for a sweep that is only planned."""


def result_table(sweep: Sweep, rows: Sequence[Row]) -> pa.Table:
    """Return the results with one row per point, ordered by key.

    Columns: ``key``, the varied fields by their dotted names, ``status``, ``reason``, ``exit_code``, the
    metrics as ``<plant>.<metric>`` and ``comparison.<metric>``, or as ``plan.<metric>`` if the scenario is
    only planned (null if missing), ``wall_s``.

    Args:
        sweep: sweep.
        rows: its rows, in any order.
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
    metadata = json.dumps({"title": sweep.title, "versions": dict(sweep.versions)})
    return pa.table(columns).replace_schema_metadata({"srs_twin.sweep": metadata})


def write_table(path: Path, results: pa.Table) -> None:
    """Write a table as a Parquet file atomically.

    Raises:
        InputError: the path cannot be written.
    """
    import pyarrow.parquet as pq

    with atomic_write(path) as part:
        pq.write_table(results, part, compression="zstd")


def rows_digest(rows: Sequence[Row]) -> str:
    """Return the SHA-256 of rows, hexadecimal, independent of their order and without wall times."""
    digest = hashlib.sha256()
    for row in sorted(rows, key=lambda row: row.key):
        values = {name: value for name, value in row.values.items() if name != PLAN_TIME}
        content = [row.key, row.status, values, row.reason, row.exit_code]
        digest.update(json.dumps(content, sort_keys=True).encode())
    return digest.hexdigest()


def metric_ranges(results: pa.Table) -> dict[str, tuple[float, float, float]]:
    """Return (minimum, median, maximum) of the summary metrics that are present."""
    import numpy as np

    ranges = {}
    for name in results.column_names:
        owner, _, metric = name.partition(".")
        if metric in (_PLAN_SUMMARY_METRICS if owner == PLAN else _SUMMARY_METRICS):
            values = results.column(name).drop_null().to_numpy()
            if len(values):
                ranges[name] = (float(values.min()), float(np.median(values)), float(values.max()))
    return ranges


def shown_metrics(sweep: Sweep) -> tuple[str, ...]:
    """Return the metrics of reports: those of the file, otherwise plotted, published and summary metrics."""
    if sweep.metrics is not None:
        return sweep.metrics
    published = sweep.beside.metrics if sweep.beside else ()
    summary = _SUMMARY_METRICS if sweep.experiment.plants else _PLAN_SUMMARY_METRICS
    return tuple(dict.fromkeys((*(plot.metric for plot in sweep.plots), *published, *summary)))


def shown_columns(sweep: Sweep, results: pa.Table) -> pa.Table:
    """Return a table with only those metrics that are `shown_metrics`."""
    metrics, names = set(shown_metrics(sweep)), results.column_names
    other = {*names[: names.index("exit_code") + 1], "wall_s"}
    return results.select(
        [n for n in names if n in other or _NUMBERS.sub("", n.partition(".")[2]) in metrics]
    )


def _metrics(sweep: Sweep, rows: Sequence[Row]) -> list[str]:
    """Return the metrics that become columns, in their order in the rows."""
    names = dict.fromkeys(name for row in rows for name in row.values) or _plotted_columns(sweep)
    if sweep.metrics is None:
        return list(names)
    stems = _stems(sweep.metrics)
    return [name for name in names if _NUMBERS.sub("", name.partition(".")[2]) in stems]


def _plotted_columns(sweep: Sweep) -> dict[str, None]:
    """Return the columns that plots need, for a table without any results."""
    plotted = (name for plot in sweep.plots for name in (plot.metric, plot.x, plot.by))
    metrics = [name for name in plotted if name is not None and name not in sweep.fields]
    owners = {
        name: ("comparison",) if name in COMPARISON_UNITS else sweep.experiment.plants or (PLAN,)
        for name in metrics
    }
    return dict.fromkeys(f"{owner}.{name}" for name in metrics for owner in owners[name])


def _stems(metrics: Sequence[str]) -> set[str]:
    """Return the column names of metrics without element numbers, including those of the two chambers."""
    return {f"{metric}{side}" for metric in metrics for side in ("", "_plus", "_minus")}


def _column(values: Sequence[Any]) -> pa.Array:
    """Return the values of a field as one column of booleans, integers, floats or texts."""
    import pyarrow as pa

    types = {type(value) for value in values}
    if types <= {bool}:
        return pa.array(values, pa.bool_())
    if types <= {int}:
        return pa.array(values, pa.int64())
    if types <= {int, float}:
        return pa.array([float(value) for value in values], pa.float64())
    return pa.array([value if isinstance(value, str) else json.dumps(value) for value in values], pa.string())
