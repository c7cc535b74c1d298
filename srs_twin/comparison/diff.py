"""Comparison of two sets of results, such as results from two commits or machines.

Two numbers are equal if |a − b| ≤ max(abs, rel · max(|a|, |b|)), where `abs` and `rel`
are tolerances. Other values, such as verdicts, must be identical. A number that is
contained in only one set counts as a difference. Two single runs are compared even if
their scenarios have different names. Wall times are not compared.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.arguments import checked
from srs_twin.io.files import METRICS, StrPath, display_path, require_file
from srs_twin.io.untrusted import parse_json, read_json, read_table
from srs_twin.io.validation import StrictModel, load_model

if TYPE_CHECKING:
    import pyarrow

REL = 1e-6
"""Default relative tolerance, which allows for differences between processor types."""
ABS = 1e-9
"""Default absolute tolerance, in the unit of the number."""

_FILES = (METRICS, "results.parquet", "reproduce.json")
_WALL_TIMES = {"wall_s", "realtime_factor", "plan_s"}
_OWNER = re.compile(r"^(analytical|twin|measured|comparison|plan)\.")
_NUMBERED = re.compile(r"(_(plus|minus))?(_\d+)?(_period_\d+)?(\[\d+\])*$")

Leaf = bool | int | float | str | None
ValueKey = tuple[str, str]
"""Name of a scenario, sweep point or reproduction row, and name of a metric."""


class Tolerance(StrictModel):
    """Allowed difference between two numbers."""

    rel: Annotated[
        float,
        Field(
            ge=0,
            le=1,
            description="Relative tolerance as a fraction of the larger of the two numbers.",
        ),
    ] = REL
    abs: Annotated[
        float,
        Field(
            ge=0, le=1e9, description="Absolute tolerance in the unit of the number."
        ),
    ] = ABS

    def allows(self, a: Leaf, b: Leaf) -> bool:
        """Return whether two values are equal within the tolerance."""
        if _is_number(a) and _is_number(b):
            if math.isnan(a) and math.isnan(b):  # type: ignore[arg-type]
                return True  # The number is undefined in both sets.
            return math.isclose(a, b, rel_tol=self.rel, abs_tol=self.abs)  # type: ignore[arg-type]
        return a == b and _is_number(a) == _is_number(b)


class Tolerances(Tolerance):
    """Default tolerances and tolerances for individual metrics, loaded from a file."""

    metrics: Annotated[
        dict[str, Tolerance],
        Field(description="Tolerance of each metric, named with or without its plant."),
    ] = {}

    def for_metric(self, metric: str) -> Tolerance:
        """Return the tolerance for a metric.

        The tolerance is looked up under each of the `tolerance_names` in turn. If there
        is no entry, the default tolerance applies.
        """
        names = (name for name in tolerance_names(metric) if name in self.metrics)
        return next(map(self.metrics.__getitem__, names), self)


def load_tolerances(path: StrPath) -> Tolerances:
    """Load a tolerances file.

    Raises:
        InputError: the file does not exist or cannot be read.
        InputFileError: the contents are invalid. The message lists all errors.
    """
    return load_model(Tolerances, require_file(Path(path)))


@dataclass(frozen=True)
class ChangedValue:
    """Value that differs between two sets of results."""

    where: str
    metric: str
    a: Leaf
    b: Leaf

    @property
    def rel(self) -> float | None:
        """Relative change (b − a)/|a|, or None if it is not finite."""
        if not (_is_number(self.a) and _is_number(self.b)) or self.a == 0:
            return None
        change = (self.b - self.a) / abs(self.a)  # type: ignore[operator, arg-type]
        if math.isfinite(change):
            return change
        return None


@dataclass(frozen=True)
class Results:
    """Flat table with the results of one or more runs, and versions of the packages."""

    values: Mapping[ValueKey, Leaf]
    versions: Mapping[str, str]


@dataclass(frozen=True)
class Difference:
    """Differences between two sets of results A and B.

    Attributes:
        moved: values that differ.
        same: number of equal values.
        wheres: names of the compared scenarios, sweep points and reproduction rows.
        versions: pairs of different package versions, keyed by package.
    """

    moved: tuple[ChangedValue, ...]
    same: int
    wheres: tuple[str, ...]
    versions: Mapping[str, tuple[str, str]]

    def document(self) -> dict[str, object]:
        """Return JSON data, with non-finite numbers as strings such as "NaN"."""
        moved = [asdict(change) | {"rel": change.rel} for change in self.moved]
        return {
            "moved": [
                {key: _json_value(value) for key, value in row.items()} for row in moved
            ],
            "same": self.same,
        }


def _json_value(value: object) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        return json.dumps(value)
    return value


@checked
def diff(
    a: StrPath | Results,
    b: StrPath | Results,
    tolerances: Tolerances | None = None,
) -> Difference:
    """Compare two sets of results, as `srs-twin diff` does.

    Args:
        a: reference results, or a path that `read_results` accepts.
        b: results to compare with the reference, or a path that `read_results` accepts.
        tolerances: allowed differences, or None for the defaults.

    Raises:
        InputError: there are no results, or a file does not contain results.
        UnknownNameError: a tolerance names a metric that neither set contains.
    """
    a, b = (
        given if isinstance(given, Results) else read_results(given) for given in (a, b)
    )
    allowed = tolerances or Tolerances()
    before = a.values
    after = b.values
    wheres = [{where for where, _ in values} for values in (before, after)]
    if all(len(names) == 1 for names in wheres):
        (where,) = wheres[0]
        after = {(where, metric): value for (_, metric), value in after.items()}
    keys = list(dict.fromkeys((*before, *after)))
    known = {name for _, metric in keys for name in tolerance_names(metric)}
    for name in allowed.metrics:
        if name not in known:
            raise UnknownNameError("metric of a tolerance", name, known)
    pairs = [ChangedValue(*key, before.get(key), after.get(key)) for key in keys]
    moved = [
        pair
        for pair in pairs
        if not allowed.for_metric(pair.metric).allows(pair.a, pair.b)
    ]
    return Difference(
        tuple(moved),
        len(keys) - len(moved),
        tuple(dict.fromkeys(where for where, _ in keys)),
        {
            name: (version, b.versions[name])
            for name, version in a.versions.items()
            if b.versions.get(name, version) != version
        },
    )


def tolerance_names(metric: str) -> tuple[str, str, str]:
    """Return a metric name, the name without plant, and the name without numbers."""
    without_plant = _OWNER.sub("", metric)
    return metric, without_plant, _NUMBERED.sub("", without_plant)


def read_results(path: StrPath) -> Results:
    """Read results that `run`, `compare`, `replay`, `sweep` or `reproduce` wrote.

    Args:
        path: path of metrics.json, results.parquet or reproduce.json, or of a folder
            that is searched recursively.

    Raises:
        InputError: the results are missing or invalid.
    """
    source = Path(path)
    if not os.path.isdir(source):
        return _read(require_file(source, suffix=".json"), "")
    files = sorted(_result_files(source))
    if not files:
        raise InputError(
            f"{display_path(source)}: the folder contains no results; give a folder"
            f" with files such as {', '.join(_FILES)}"
        )
    values: dict[ValueKey, Leaf] = {}
    versions: dict[str, str] = {}
    for file in files:
        folder = file.parent.relative_to(source).as_posix()
        results = _read(file, "" if folder == "." else folder)
        values |= results.values
        versions |= results.versions
    return Results(values, versions)


def _result_files(folder: Path) -> Iterator[Path]:
    """Yield all result files below a folder, without following links to folders."""
    pending = [os.fspath(folder)]
    # Recursion could exhaust the stack in deeply nested folders.
    while pending:
        current = pending.pop()
        try:
            entries = list(os.scandir(current))
        except OSError as error:
            if current == os.fspath(folder):
                raise InputError(
                    f"{display_path(folder)}: cannot be read ({error.strerror})"
                ) from error
            continue
        # Hidden folders may contain incomplete files from an interrupted process.
        entries = [entry for entry in entries if not entry.name.startswith(".")]
        pending += [
            entry.path for entry in entries if entry.is_dir(follow_symlinks=False)
        ]
        yield from (
            Path(entry.path)
            for entry in entries
            if entry.name in _FILES and entry.is_file()
        )


def _read(path: Path, folder: str) -> Results:
    try:
        read = _read_sweep if path.suffix == ".parquet" else _read_document
        read_values, versions = read(path)
        values = {
            ("/".join(filter(None, (folder, where))), metric): value
            for (where, metric), value in read_values
            if _OWNER.sub("", metric) not in _WALL_TIMES
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{display_path(path)}: the file does not contain results of `run`,"
            " `compare`, `replay`, `sweep` or `reproduce`"
        ) from error
    return Results(values, versions)


def _read_document(path: Path) -> tuple[list[tuple[ValueKey, Leaf]], dict[str, str]]:
    document = read_json(path)
    versions = dict(document["versions"])
    if "rows" not in document:
        where = str(document["scenario"])
        sections = {**document["plants"], "comparison": document["comparison"]}
        found = list(_leaves(sections, ""))
        for i, expectation in enumerate(document["expectations"]):
            met: Leaf = bool(expectation["met"])
            if expectation.get("state") == "not_judged":
                met = "not judged"
            found.append((f"expectations[{i}].met", met))
        return [((where, metric), value) for metric, value in found], versions
    return [
        ((f"{row['id']}, {column}", name), outcome[name])
        for row in document["rows"]
        for column, outcome in row["outcomes"].items()
        for name in ("verdict", "value")
    ], versions


def _leaves(value: Any, name: str) -> Iterator[tuple[str, Leaf]]:
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _leaves(item, f"{name}[{i}]")
    else:
        yield name, value


def _read_sweep(path: Path) -> tuple[list[tuple[ValueKey, Leaf]], dict[str, str]]:
    def check(schema: pyarrow.Schema) -> None:
        if b"srs_twin.sweep" not in (schema.metadata or {}):
            raise ValueError("the Parquet file was not written by a sweep")

    try:
        table = read_table(path, "the results of a sweep", check)
    except InputError as error:
        raise ValueError("the file was not written by a sweep") from error
    metadata = parse_json(
        table.schema.metadata[b"srs_twin.sweep"].decode(), display_path(path)
    )
    names = table.column_names
    fields = names[1 : names.index("status")]
    metrics = ["status", *names[names.index("exit_code") + 1 :]]
    values = [
        ((", ".join(f"{field}={row[field]}" for field in fields), metric), row[metric])
        for row in table.to_pylist()
        for metric in metrics
    ]
    return values, dict(metadata["versions"])


def _is_number(value: Leaf) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
