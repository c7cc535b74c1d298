"""Tables 1 to 10 of the dissertation as data, from calibration/published/table*.yaml.

There are five kinds of tables: symbols with meanings, parameters with values,
algorithms, runs of a robot, and generations. Values have the unit in their key,
together with the printed text. Errata refer to calibration/README.md.

>>> from published_tables import published_runs
>>> [run.radius_m for run in published_runs() if abs(run.offset) == 0.2]
[1.2532, 0.8445]
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, RootModel

from srs_twin.io.documents import Loc, load_yaml
from srs_twin.io.files import find_file
from srs_twin.io.validation import StrictModel, validate
from srs_twin.robot.sourced import bounded, split_unit

TABLES = tuple(f"table{number}" for number in range(1, 11))
"""Names of the tables."""

Key = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", min_length=1, max_length=60)]
Text = Annotated[str, Field(min_length=1, max_length=300)]
Long = Annotated[str, Field(min_length=1, max_length=1000)]
Number = Annotated[float, bounded(-1e6, 1e6)]
Edge = Annotated[float, bounded(-10.0, 10.0)]
Erratum = Annotated[
    str, Field(pattern=r"^E([1-9]|[12][0-9])$", min_length=2, max_length=3)
]
Errata = Annotated[list[Erratum], Field(max_length=29)]


class _Head(StrictModel):
    """Fields of all tables."""

    name: str = Field(
        pattern=r"^table([1-9]|10)$",
        min_length=6,
        max_length=7,
        description="table1 to table10.",
    )
    title: Text = Field(description="Caption, as printed.")
    section: str = Field(
        pattern=r"^[1-6](\.[1-9]){0,2}$",
        min_length=1,
        max_length=5,
        description="Section number.",
    )
    page: Annotated[int, bounded(1, 200)] = Field(
        description="Page number in the dissertation."
    )
    robot: Key | None = Field(None, description="Robot of the values; none: any robot.")
    errata: Errata = Field(
        description="Errata of the table, E1 to E29 of calibration/README.md."
    )
    note: Long | None = Field(
        None, description="Further statements of the dissertation."
    )


class Symbol(StrictModel):
    """One symbol."""

    symbol: Text = Field(description="As printed.")
    meaning: Text = Field(description="Meaning, as printed.")
    size: Text | None = Field(None, description="Size of a vector.")


class SymbolTable(_Head):
    """Meanings of symbols (Tables 1 and 7)."""

    kind: Literal["symbols"] = Field(description="Kind of table.")
    symbols: Annotated[list[Symbol], Field(min_length=1, max_length=100)] = Field(
        description="In order."
    )


class PublishedValue(StrictModel):
    """One number of a table."""

    value: Number = Field(description="Value with corrected errata.")
    unit: Text = Field(
        description="The unit, the same as in the key; '1' for a pure number."
    )
    symbol: Text = Field(description="As printed.")
    printed: Text = Field(description="The number and its unit as printed.")
    errata: Errata = Field([], description="Errata of this value.")


class ParameterTable(_Head):
    """Parameters of a robot or of an algorithm (Tables 2, 5, 6 and 9)."""

    kind: Literal["parameters"] = Field(description="Kind of table.")
    values: Annotated[
        dict[Text, PublishedValue], Field(min_length=1, max_length=100)
    ] = Field(description="By name.")

    def __getitem__(self, key: str) -> float:
        """Return a value by its key, in the unit that the key names."""
        return self.values[key].value


class AlgorithmTable(_Head):
    """An algorithm (Tables 3 and 4)."""

    kind: Literal["algorithm"] = Field(description="Kind of table.")
    requires: Annotated[list[Text], Field(min_length=1, max_length=20)] = Field(
        description="Inputs."
    )
    steps: Annotated[list[Text], Field(min_length=1, max_length=100)] = Field(
        description="In order."
    )


class PublishedRun(StrictModel):
    """One run of Table 8, signs as printed."""

    offset: Annotated[float, bounded(-1.0, 1.0)] = Field(
        description="Phase offset, positive to the left."
    )
    speed_m_s: Annotated[float, bounded(0.0, 10.0)] = Field(
        description="Linear velocity, m/s."
    )
    left_m: Edge = Field(description="Left edge of the bounding box, m, negative.")
    right_m: Edge = Field(description="Right edge, m.")
    radius_m: Annotated[float, bounded(1e-3, 1e3)] = Field(
        description="Radius of the path, m, without a sign."
    )


class RunTable(_Head):
    """Runs of a robot at several offsets (Table 8)."""

    kind: Literal["runs"] = Field(description="Kind of table.")
    frequency_hz: Annotated[float, bounded(0.01, 100.0)] = Field(
        description="Frequency of the gait, Hz."
    )
    rows: Annotated[list[PublishedRun], Field(min_length=1, max_length=100)] = Field(
        description="In order."
    )


class Generation(StrictModel):
    """One generation of the robot."""

    robot: Key = Field(description="Name of the robot in this project.")
    year: Annotated[int, bounded(1900, 2100)] = Field(description="As printed.")
    top_speed_mm_s: Annotated[float, bounded(0.0, 1e4)] | None = Field(
        None, description="Where printed."
    )
    advantages: Annotated[list[Text], Field(max_length=20)] = Field(
        description="As printed."
    )
    disadvantages: Annotated[list[Text], Field(max_length=20)] = Field(
        description="As printed."
    )


class GenerationTable(_Head):
    """Comparison of generations (Table 10)."""

    kind: Literal["generations"] = Field(description="Kind of table.")
    generations: Annotated[list[Generation], Field(min_length=1, max_length=20)] = (
        Field(description="In order.")
    )


Table = SymbolTable | ParameterTable | AlgorithmTable | RunTable | GenerationTable


class _TableFile(RootModel[Annotated[Table, Field(discriminator="kind")]]):
    """A table of any kind."""


def load_table(name_or_path: str | os.PathLike[str]) -> Table:
    """Load and check a published table: a name (table8) or a path.

    Raises:
        InputError: not found or not readable.
        InputFileError: everything that is wrong with it.
    """
    path = find_file("table", name_or_path)
    document = load_yaml(path)
    file = validate(_TableFile, document, document.data)
    for loc, message in _contradictions(file.root) if file else ():
        document.report(loc, message)
    document.raise_problems()
    assert file is not None, "a table without a problem was checked"
    return file.root


def published_runs() -> tuple[PublishedRun, ...]:
    """Return the rows of Table 8, in its order."""
    table = load_table("table8")
    assert isinstance(table, RunTable), "the shipped Table 8 has runs"
    return tuple(table.rows)


def _contradictions(table: Table) -> Iterator[tuple[Loc, str]]:
    """Yield path and message of each inconsistency."""
    if isinstance(table, ParameterTable):
        for key, entry in table.values.items():
            if entry.unit != (unit := split_unit(key)[1]):
                yield (
                    ("values", key, "unit"),
                    f"must be {unit} as in the key, not {entry.unit}",
                )
            for erratum in set(entry.errata) - set(table.errata):
                yield (
                    ("values", key, "errata"),
                    f"{erratum} is not among the table's errata",
                )
    if isinstance(table, RunTable):
        for k, row in enumerate(table.rows):
            if not row.left_m < 0 < row.right_m:
                yield (
                    ("rows", k),
                    "the left edge must be negative and the right one positive",
                )
        for offset, count in Counter(row.offset for row in table.rows).items():
            if count > 1:
                yield ("rows",), f"offset {offset:g} stands here {count} times"
