"""The columns of a sweep's table as pictures need them: numbers, NaN where there is none."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.errors import UnknownNameError
from srs_twin.viewing.labels import field_label, metric_label

if TYPE_CHECKING:
    import pyarrow as pa

COMPARISON, PLAN = "comparison", "plan"
OWNERS = ("analytical", "twin", COMPARISON, PLAN)
Value = bool | int | float | str
_EXACT = 1e15  # up to where whole numbers, such as seeds, are written out
_SAME = 1e-9  # of the greatest value: what two ways of writing a number may differ by
_ABOUT_ROWS = {"key", "status", "reason", "exit_code", "wall_s"}


@dataclass(frozen=True)
class Values:
    """One column for an axis or a colour.

    Attributes:
        label: what stands at the axis.
        numbers: shape (rows,), NaN where there is none; of text, its place among `names`.
        names: the different texts, sorted; empty for numbers.
    """

    label: str
    numbers: np.ndarray
    names: tuple[str, ...] = ()

    def text(self, number: float) -> str:
        """Return how one of the values is written."""
        if self.names:
            return self.names[int(number)]
        return f"{number:.0f}" if float(number).is_integer() and abs(number) < _EXACT else f"{number:.4g}"

    def number(self, value: Value) -> float:
        """Return which of the `numbers` stands for a value of the field; NaN for a text that no row has."""
        if not self.names:
            return math.nan if isinstance(value, str) else float(value)
        # A column of texts and other things has these as JSON.
        found = [text for text in (str(value), json.dumps(value)) if text in self.names]
        return float(self.names.index(found[0])) if found else math.nan

    def at(self, value: Value) -> np.ndarray:
        """Return which rows have a value of the field, shape (rows,)."""
        number = self.number(value)
        most = float(np.max(np.abs(self.numbers), initial=abs(number), where=np.isfinite(self.numbers)))
        return np.asarray(np.abs(self.numbers - number) <= _SAME * most)


@dataclass(frozen=True)
class SweepTable:
    """The rows of a sweep.

    Attributes:
        columns: name → values, one a row.
    """

    columns: Mapping[str, Sequence[Any]]

    @staticmethod
    def of(table: pa.Table | Mapping[str, Iterable[Any]]) -> SweepTable:
        """Take a table of pyarrow or a mapping of columns."""
        if hasattr(table, "to_pydict"):
            return SweepTable(table.to_pydict())
        return SweepTable({name: np.asarray(column, dtype=object).tolist() for name, column in table.items()})

    @property
    def failed(self) -> np.ndarray:
        """Which rows failed, shape (rows,)."""
        return np.array([status == "failed" for status in self._column("status")], dtype=bool)

    @property
    def fields(self) -> list[str]:
        """The varied fields."""
        prefixes = tuple(f"{owner}." for owner in OWNERS)
        return [name for name in self.columns if name not in _ABOUT_ROWS and not name.startswith(prefixes)]

    def owners(self, metric: str) -> list[str]:
        """Return whose metric it is: plants, the comparison, or a plan that nobody followed.

        Raises:
            UnknownNameError: nobody's.
        """
        found = self.holders(metric)
        if not found:
            named = (name.partition(".") for name in self.columns)
            raise UnknownNameError("metric", metric, {rest for owner, _, rest in named if owner in OWNERS})
        return found

    def holders(self, metric: str) -> list[str]:
        """Return whose metric it is, as `owners` does; empty where it is nobody's."""
        return [owner for owner in OWNERS if self._names(owner, metric)]

    def metric(self, metric: str, owner: str) -> Values:
        """Return an owner's metric; of one that is a list, the mean over it."""
        names = self._names(owner, metric)
        if names == [f"{owner}.{metric}"]:
            return Values(metric_label(metric), _numbers(self.columns[names[0]]))
        parts = np.array([_numbers(self.columns[name]) for name in names])
        return Values(f"{metric_label(metric)}, mean over {len(names)}", parts.mean(axis=0))

    def values(self, name: str, owner: str) -> Values:
        """Return a field, or a metric: the owner's own, else the comparison's.

        Raises:
            UnknownNameError: there is no such column.
        """
        if name in self.fields:
            return _field(name, self.columns[name])
        for each in (owner, COMPARISON):
            if self._names(each, name):
                return self.metric(name, each)
        raise UnknownNameError("column", name, self.fields)

    def others(self, drawn: Iterable[str | None]) -> list[str]:
        """Return the fields that vary too, but are not among those drawn."""
        known = set(drawn)
        return [
            name for name in self.fields if name not in known and len(set(map(str, self.columns[name]))) > 1
        ]

    def _column(self, name: str) -> Sequence[Any]:
        if name not in self.columns:
            raise UnknownNameError("column", name, self.columns)
        return self.columns[name]

    def _names(self, owner: str, metric: str) -> list[str]:
        """Return the column of a metric, or those of its parts where it is a list."""
        name = f"{owner}.{metric}"
        if name in self.columns:
            return [name]
        stem = f"{name}_"
        return [each for each in self.columns if each.startswith(stem) and each[len(stem) :].isdigit()]


def _field(name: str, column: Sequence[Any]) -> Values:
    given = [value for value in column if value is not None]
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in given):
        return Values(field_label(name), _numbers(column))
    texts = ["" if value is None else str(value) for value in column]
    names = tuple(sorted(set(texts)))
    return Values(field_label(name), np.array([names.index(text) for text in texts], dtype=float), names)


def _numbers(column: Sequence[Any]) -> np.ndarray:
    """Return numbers, NaN for what is missing or not finite."""
    numbers = np.array([np.nan if value is None else float(value) for value in column], dtype=float)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def group_means(group: np.ndarray, count: int, values: np.ndarray) -> np.ndarray:
    """Return the mean of the values of each group, NaN where it has none; the order of the rows is no matter.

    Args:
        group: number of each value's group, shape (rows,).
        count: how many groups.
        values: shape (rows,); NaN ones are left out.
    """
    # Sums in an order of their own: that of the rows would show in the last bit.
    order = np.lexsort((values, group))
    order = order[np.isfinite(values[order])]
    sums = np.bincount(group[order], weights=values[order], minlength=count)
    counts = np.bincount(group[order], minlength=count)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
