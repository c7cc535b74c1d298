"""Checks of what a sweep file says was published: fields that vary, metrics that it has, lists that agree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from srs_twin.comparison.metrics import METRIC_UNITS, METRICS_LISTED
from srs_twin.documents import Document
from srs_twin.errors import UnknownNameError, did_you_mean, some
from srs_twin.sweep.file import BesideFile, RangeFile, SweepFile
from srs_twin.sweep.points import Sweep
from srs_twin.viewing.sweep_table import Values


def check_beside(document: Document, file: SweepFile, given: BesideFile) -> None:
    """Report what is wrong with published values.

    Args:
        document: what the problems are reported to.
        file: the sweep.
        given: its published values.
    """
    for field, values in given.at.items():
        if field in file.vary:
            _check_values(document, file, field, values)
        else:
            hint = did_you_mean(field, file.vary) or f"; varied: {some(list(file.vary))}"
            document.report(("beside", "at", field), f"is not varied{hint}", at_key=True)
    columns = list(METRIC_UNITS) if file.metrics is None else [m for m in file.metrics if m in METRIC_UNITS]
    for metric in given.metrics:
        loc = ("beside", "metrics", metric)
        if metric not in METRIC_UNITS:
            document.report(
                loc, str(UnknownNameError("metric", metric, METRIC_UNITS, METRICS_LISTED)), at_key=True
            )
        elif metric not in columns:
            document.report(loc, "is not among the sweep's metrics; add it there", at_key=True)
    _check_lengths(document, given)


def _check_lengths(document: Document, given: BesideFile) -> None:
    first, values = next(iter(given.at.items()))
    for section, lists in (("at", given.at), ("metrics", given.metrics)):
        for name, column in lists.items():
            if len(column) != len(values):
                message = f"has {len(column)} values, but {first} has {len(values)}"
                document.report(("beside", section, name), message)
    if all(len(column) == len(values) for column in given.at.values()):
        places = Counter(zip(*given.at.values(), strict=True))
        twice = [place for place, count in places.items() if count > 1]
        if twice:
            named = ", ".join(f"{n} {v}" for n, v in zip(given.at, twice[0], strict=True))
            document.report(("beside", "at"), f"{named} is given twice")


def _check_values(document: Document, file: SweepFile, field: str, values: Sequence[Any]) -> None:
    """Report texts and truth values that no point has; numbers may lie anywhere, see `not_run`."""
    varied = file.vary[field]
    numbers = isinstance(varied, RangeFile) or any(_is_number(value) for value in varied)
    others = [] if isinstance(varied, RangeFile) else [value for value in varied if not _is_number(value)]
    for i, value in enumerate(values):
        known = numbers if _is_number(value) else value in others
        if not known:
            has = ", ".join(map(str, others[:10])) if others else "numbers"
            document.report(
                ("beside", "at", field, i), f"{field} never is {value!r}; it is varied over {has}"
            )


def not_run(sweep: Sweep) -> tuple[str, ...]:
    """Return a warning for every field with published values at numbers that no point has."""
    found = []
    for field, values in sweep.beside.at.items() if sweep.beside else ():
        column = [row[sweep.fields.index(field)] for row in sweep.values]
        there = Values("", np.unique([float(value) for value in column if _is_number(value)]))
        missing = [value for value in values if _is_number(value) and not there.at(value).any()]
        if missing:
            named = ", ".join(f"{value:g}" for value in missing[:5])
            more = f" and {len(missing) - 5} more" if len(missing) > 5 else ""
            found.append(f"beside: no run has {field} {named}{more}")
    return tuple(found)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
