"""Two sets of results, number by number: what moved from one commit, machine or setting to another.

A number has moved where |a − b| > max(abs, rel · max(|a|, |b|)); anything else (a verdict, a status, a number
that one side does not have) where it is not equal. Two runs are compared whatever their scenarios are
called. Wall times are left out.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.files import existing, shown
from srs_twin.io.json_files import parse_json, read_json
from srs_twin.io.parquet import read_table
from srs_twin.io.validation import Strict, load_model

REL, ABS = 1e-6, 1e-9
"""What two processor targets may differ by; docs/sweeps.md has what they were measured to."""

_FILES = ("metrics.json", "results.parquet", "reproduce.json")
_WALL_TIMES = {"wall_s", "realtime_factor", "plan_s"}
_OWNER = re.compile(r"^(analytical|twin|measured|comparison|plan)\.")
_NUMBERED = re.compile(r"(_(plus|minus))?(_\d+)?(_period_\d+)?(\[\d+\])*$")

Leaf = bool | int | float | str | None
Place = tuple[str, str]


class Tolerance(Strict):
    """By how much a number may differ."""

    rel: Annotated[float, Field(ge=0, le=1, description="Over the larger of the two.")] = REL
    abs: Annotated[float, Field(ge=0, le=1e9, description="In the number's unit.")] = ABS

    def allows(self, a: Leaf, b: Leaf) -> bool:
        """Say whether two values count as the same."""
        if _is_number(a) and _is_number(b):
            if math.isnan(a) and math.isnan(b):  # type: ignore[arg-type]
                return True  # neither has a number
            return math.isclose(a, b, rel_tol=self.rel, abs_tol=self.abs)  # type: ignore[arg-type]
        return a == b and _is_number(a) == _is_number(b)


class Tolerances(Tolerance):
    """A file of tolerances: those of all metrics, and of some by name."""

    metrics: Annotated[
        dict[str, Tolerance], Field(description="Metric, with or without its plant → its own.")
    ] = {}

    def of(self, metric: str) -> Tolerance:
        """Return what holds for a metric: of its own name, of it without its plant, or of all."""
        return next((self.metrics[name] for name in names_of(metric) if name in self.metrics), self)


def load_tolerances(path: str | os.PathLike[str]) -> Tolerances:
    """Load a file of tolerances.

    Raises:
        InputError: not found or not readable.
        InputFileError: everything that is wrong with it.
    """
    return load_model(Tolerances, existing(Path(path)))


@dataclass(frozen=True)
class Moved:
    """A value that is not the same.

    Attributes:
        where: scenario, point of a sweep, or row of the reproduction.
        metric: with its plant in front.
        a: value in the reference, None where there is none.
        b: the other.
    """

    where: str
    metric: str
    a: Leaf
    b: Leaf

    @property
    def rel(self) -> float | None:
        """(b − a)/|a|; None where one is no finite number, or a is 0."""
        if not (_is_number(self.a) and _is_number(self.b)) or self.a == 0:
            return None
        change = (self.b - self.a) / abs(self.a)  # type: ignore[operator, arg-type]
        return change if math.isfinite(change) else None


@dataclass(frozen=True)
class Results:
    """What a command left, flat.

    Attributes:
        values: (where, metric) → value.
        versions: package → version of what made them.
    """

    values: Mapping[Place, Leaf]
    versions: Mapping[str, str]


@dataclass(frozen=True)
class Difference:
    """What became of each value.

    Attributes:
        moved: in the order of A, what only B has behind it.
        same: how many values count as the same.
        wheres: all places, in order.
        versions: package → those of A and B where they differ.
    """

    moved: tuple[Moved, ...]
    same: int
    wheres: tuple[str, ...]
    versions: Mapping[str, tuple[str | None, str | None]]

    def document(self) -> dict[str, Any]:
        """Return plain data for JSON, where numbers that JSON does not have are "NaN" and "Infinity"."""
        moved = [asdict(each) | {"rel": each.rel} for each in self.moved]
        return {"moved": [{key: _plain(value) for key, value in each.items()} for each in moved],
                "same": self.same}  # fmt: skip


def _plain(value: Any) -> Any:
    if not isinstance(value, float) or math.isfinite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def diff(a: Results, b: Results, tolerances: Tolerances | None = None) -> Difference:
    """Compare two sets of results.

    Args:
        a: the reference.
        b: what is held against it.
        tolerances: default those of two processor targets.

    Raises:
        UnknownNameError: a tolerance for a metric that neither has.
    """
    allowed, before, after = tolerances or Tolerances(), a.values, b.values
    one, other = ({where for where, _ in values} for values in (before, after))
    if len(one) == len(other) == 1:  # two runs are compared whatever they are called
        (where,) = one
        after = {(where, metric): value for (_, metric), value in after.items()}
    places = list(dict.fromkeys((*before, *after)))
    known = {name for _, metric in places for name in names_of(metric)}
    for name in allowed.metrics:
        if name not in known:
            raise UnknownNameError("metric of a tolerance", name, known)
    pairs = [Moved(*place, before.get(place), after.get(place)) for place in places]
    moved = [each for each in pairs if not allowed.of(each.metric).allows(each.a, each.b)]
    packages = dict.fromkeys((*a.versions, *b.versions))
    versions = {name: (a.versions.get(name), b.versions.get(name)) for name in packages}
    return Difference(
        tuple(moved),
        len(places) - len(moved),
        tuple(dict.fromkeys(where for where, _ in places)),
        {name: pair for name, pair in versions.items() if pair[0] != pair[1]},
    )


def names_of(metric: str) -> tuple[str, str, str]:
    """Return the names that a tolerance may give a metric: whole, without its plant, without numbers."""
    plain = _OWNER.sub("", metric)
    return metric, plain, _NUMBERED.sub("", plain)


def read_results(path: str | os.PathLike[str]) -> Results:
    """Read what `run`, `compare`, `replay`, `sweep` or `reproduce` left.

    Args:
        path: metrics.json, results.parquet or reproduce.json, or a folder: all of these in and below it.

    Raises:
        InputError: there is none, or it is something else.
    """
    given = Path(path)
    if not os.path.isdir(given):
        return _read(existing(given, suffix=".json"), "")
    files = sorted(_files(given))
    if not files:
        raise InputError(f"{shown(given)}: holds no results ({', '.join(_FILES)})")
    values: dict[Place, Leaf] = {}
    versions: dict[str, str] = {}
    for file in files:
        folder = file.parent.relative_to(given).as_posix()
        found = _read(file, "" if folder == "." else folder)
        values |= found.values
        versions |= found.versions
    return Results(values, versions)


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files of results in and below a folder; links to folders are not followed.

    Raises:
        InputError: the folder itself cannot be listed.
    """
    waiting = [os.fspath(folder)]
    while waiting:  # no recursion: folders may be nested deeper than the stack
        here = waiting.pop()
        try:
            entries = list(os.scandir(here))
        except OSError as error:
            if here == os.fspath(folder):
                raise InputError(f"{shown(folder)}: cannot be read ({error.strerror})") from error
            continue
        # A hidden folder may hold files that a killed process left.
        entries = [each for each in entries if not each.name.startswith(".")]
        waiting += [each.path for each in entries if each.is_dir(follow_symlinks=False)]
        yield from (Path(each.path) for each in entries if each.name in _FILES and each.is_file())


def _read(path: Path, folder: str) -> Results:
    """Read one file; its folder stands before each place."""
    try:
        found, versions = _sweep(path) if path.suffix == ".parquet" else _document(path)
        values = {
            ("/".join(filter(None, (folder, where))), metric): value
            for (where, metric), value in found
            if _OWNER.sub("", metric) not in _WALL_TIMES
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{shown(path)}: not the results of a run, a sweep or a reproduction") from error
    return Results(values, versions)


def _document(path: Path) -> tuple[list[tuple[Place, Leaf]], dict[str, str]]:
    given = read_json(path)
    versions = dict(given["versions"])
    if "rows" not in given:
        where, parts = str(given["scenario"]), {**given["plants"], "comparison": given["comparison"]}
        values = [((where, metric), value) for metric, value in _leaves(parts, "")]
        met = [
            (
                f"expectations[{i}].met",
                "not judged" if each.get("state") == "not_judged" else bool(each["met"]),
            )
            for i, each in enumerate(given["expectations"])
        ]
        return values + [((where, metric), value) for metric, value in met], versions
    return [
        ((f"{row['id']}, {column}", name), outcome[name])
        for row in given["rows"]
        for column, outcome in row["outcomes"].items()
        for name in ("verdict", "value")
    ], versions


def _leaves(value: Any, name: str) -> Iterator[tuple[str, Leaf]]:
    """Yield the numbers of metrics by their dotted names."""
    if isinstance(value, Mapping):
        for key, each in value.items():
            yield from _leaves(each, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for i, each in enumerate(value):
            yield from _leaves(each, f"{name}[{i}]")
    else:
        yield name, value


def _sweep(path: Path) -> tuple[list[tuple[Place, Leaf]], dict[str, str]]:
    def check(schema: Any) -> None:
        if b"srs_twin.sweep" not in (schema.metadata or {}):
            raise ValueError("a Parquet file of something else")

    try:
        table = read_table(path, "the results of a sweep", check)
    except InputError as error:
        raise ValueError("no results of a sweep") from error
    about = parse_json(table.schema.metadata[b"srs_twin.sweep"].decode(), shown(path))
    names = table.column_names
    fields = names[1 : names.index("status")]
    metrics = ["status", *names[names.index("exit_code") + 1 :]]
    values = [
        ((", ".join(f"{field}={row[field]}" for field in fields), metric), row[metric])
        for row in table.to_pylist()
        for metric in metrics
    ]
    return values, dict(about["versions"])


def _is_number(value: Leaf) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
