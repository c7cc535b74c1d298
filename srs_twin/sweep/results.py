"""The results of a sweep as one table, and the digest by which two of them are told apart."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.comparison.metrics import COMPARISON_UNITS
from srs_twin.files import atomic_write
from srs_twin.sweep.points import Sweep
from srs_twin.sweep.task import PLAN, PLAN_TIME, Row

if TYPE_CHECKING:
    import pyarrow as pa

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
    for field in sweep.fields:
        columns[field] = _column([changes[row.key][field] for row in rows])
    columns["status"] = pa.array([row.status for row in rows], pa.string())
    columns["reason"] = pa.array([row.reason for row in rows], pa.string())
    columns["exit_code"] = pa.array([row.exit_code for row in rows], pa.int8())
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
