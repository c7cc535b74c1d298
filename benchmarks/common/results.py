"""Stored results of the studies, benchmarks/results/NAME.json."""

from __future__ import annotations

import json
import re
import subprocess
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from common.studies import BENCHMARKS

from srs_twin.io.files import atomic_write
from srs_twin.scenario.provenance import arithmetic, versions

FOLDER = BENCHMARKS / "results"

TOLERANCE = 0.005
"""Largest difference of a reproduced number, relative to the largest number of its column."""

_NUMBER = re.compile(r"[-+−]?(?:\d[\d,]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_STRINGS = re.compile(r'\[\s+(?:"(?:[^"\\]|\\.)*",\s+)*"(?:[^"\\]|\\.)*"\s+\]')
"""List of strings over several lines of JSON."""

_RULE = re.compile(r"^\|[\s:|-]+\|$")


@dataclass(frozen=True)
class Table:
    """Table that a study printed.

    Attributes:
        title: last line of text above the table.
        columns: headings.
        rows: cells as printed.
    """

    title: str
    columns: list[str]
    rows: list[list[str]]


@dataclass(frozen=True)
class Stamp:
    """Time and place of a run.

    Attributes:
        commit: commit of the checkout, with `+` if tracked files were changed.
        date: day, ISO 8601.
        processor: name of the arithmetic (`provenance.arithmetic`).
        versions: versions of the packages that decide results.
    """

    commit: str
    date: str
    processor: str
    versions: dict[str, str]


@dataclass(frozen=True)
class Confirmation:
    """Reduced run that reproduced the result after a change of the code.

    Attributes:
        stamp: time and place of the run.
        largest_difference: largest difference of a number, relative to the largest
            number of its column.
    """

    stamp: Stamp
    largest_difference: float


@dataclass
class Result:
    """Stored result of a study.

    Attributes:
        study: name of the study.
        title: title of the study.
        stamp: time and place of the run.
        seeds: random seeds.
        arguments: arguments of the script.
        minutes: duration of the run.
        tables: tables of the default size.
        text: other printed lines.
        reduced_arguments: arguments for the reduced size.
        reduced: tables of the reduced size from the same code; empty if the default
            size is not reduced.
        digests: digests of what decides the result, by name.
        confirmed: later runs that reproduced the result.
    """

    study: str
    title: str
    stamp: Stamp
    seeds: str
    arguments: list[str]
    minutes: float
    tables: list[Table]
    text: list[str]
    reduced_arguments: list[str]
    reduced: list[Table]
    digests: dict[str, str]
    confirmed: list[Confirmation] = field(default_factory=list)


def stamp() -> Stamp:
    """Return time and place of a run that ends now."""
    commit = _git("rev-parse", "--short=8", "HEAD")
    # Results of other studies and their tables, written a moment ago, do not affect this one.
    tracked = ("status", "--porcelain", "--untracked-files=no")
    if _git(*tracked, "--", ":/", ":!results", ":!/docs"):
        commit += "+"
    day = datetime.now(UTC).date().isoformat()
    return Stamp(commit, day, arithmetic(), versions())


def _git(*words: str) -> str:
    done = subprocess.run(
        ["git", *words], cwd=BENCHMARKS, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def path_of(name: str, folder: Path | None = None) -> Path:
    """Return the file of the result of a study."""
    return (folder or FOLDER) / f"{name}.json"


def save_result(result: Result, folder: Path | None = None) -> None:
    """Write the result of a study."""
    path = path_of(result.study, folder)
    path.parent.mkdir(exist_ok=True)
    text = json.dumps(asdict(result), indent=1, ensure_ascii=False)
    # One line per row of a table, so that a change of one row changes one line.
    text = _STRINGS.sub(lambda found: re.sub(r"\n\s*", " ", found[0]), text)
    with atomic_write(path) as part:
        Path(part).write_text(text + "\n", "utf-8")


def load_result(name: str, folder: Path | None = None) -> Result | None:
    """Return the stored result of a study, or None if there is none."""
    path = path_of(name, folder)
    if not path.is_file():
        return None
    data: dict[str, Any] = json.loads(path.read_text("utf-8"))
    for key in ("tables", "reduced"):
        data[key] = [Table(**item) for item in data[key]]
    data["stamp"] = Stamp(**data["stamp"])
    data["confirmed"] = [
        Confirmation(Stamp(**item["stamp"]), item["largest_difference"])
        for item in data["confirmed"]
    ]
    return Result(**data)


def parse_output(text: str) -> tuple[list[Table], list[str]]:
    r"""Return the Markdown tables and the other lines of what a study printed.

    >>> tables, rest = parse_output("gen2\n| f | v |\n|---|---|\n| 1 | 88 |\nend")
    >>> tables, rest
    ([Table(title='gen2', columns=['f', 'v'], rows=[['1', '88']])], ['gen2', 'end'])
    """
    tables: list[Table] = []
    rest: list[str] = []
    is_open = False
    lines = text.splitlines()
    for k, line in enumerate(lines):
        if not line.startswith("|"):
            is_open = False
            if line.strip():
                rest.append(line)
        elif _RULE.match(line):
            continue
        elif is_open:
            tables[-1].rows.append(_cells(line))
        elif k + 1 < len(lines) and _RULE.match(lines[k + 1]):
            tables.append(Table(rest[-1] if rest else "", _cells(line), []))
            is_open = True
        else:
            rest.append(line)
    return tables, rest


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def difference(stored: list[Table], computed: list[Table]) -> float:
    """Return the largest difference of a number, relative to the largest of its column.

    A number whose last printed digit changes by one counts as equal. The difference is
    infinite if the tables differ in their words or their shape.
    """
    if [_shape(table) for table in stored] != [_shape(table) for table in computed]:
        return float("inf")
    largest = 0.0
    for old, new in zip(stored, computed, strict=True):
        for a, b in zip(
            zip(*old.rows, strict=True), zip(*new.rows, strict=True), strict=True
        ):
            largest = max(largest, _column_difference(a, b))
    return largest


def _shape(table: Table) -> tuple[list[str], list[list[str]]]:
    return table.columns, [
        [_NUMBER.sub("#", cell) for cell in row] for row in table.rows
    ]


def _column_difference(old: tuple[str, ...], new: tuple[str, ...]) -> float:
    numbers = [_numbers(cell) for cell in old]
    scale = max((abs(value) for cell in numbers for value, _ in cell), default=0.0)
    largest = 0.0
    for cell, other in zip(numbers, map(_numbers, new), strict=True):
        for (value, digit), (changed, _) in zip(cell, other, strict=True):
            if abs(value - changed) > 1.001 * digit:
                largest = max(largest, abs(value - changed) / (scale or 1.0))
    return largest


def _numbers(cell: str) -> list[tuple[float, float]]:
    """Return the numbers of a cell and the steps of their last digits."""
    found = []
    for text in _NUMBER.findall(cell):
        plain = text.replace("−", "-").replace(",", "")
        mantissa, _, exponent = plain.lower().partition("e")
        decimals = len(mantissa.partition(".")[2])
        found.append((float(plain), 10.0 ** (int(exponent or 0) - decimals)))
    return found
