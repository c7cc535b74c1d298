"""Selection of the cases of parametrised tests that run by default; the others run nightly."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def first_by_default(count: int, values: Iterable[Any]) -> list[Any]:
    """Return the values, marked nightly after the first `count`; a tuple contains several arguments."""
    values = list(values)
    return values[:count] + [_nightly(value) for value in values[count:]]


def _nightly(value: Any) -> Any:
    if hasattr(value, "marks"):
        return pytest.param(
            *value.values, id=value.id, marks=[*value.marks, pytest.mark.nightly]
        )
    if isinstance(value, tuple):
        return pytest.param(*value, marks=pytest.mark.nightly)
    return pytest.param(value, marks=pytest.mark.nightly)


def mark_other_cases(items: Iterable[pytest.Item]) -> None:
    """Mark the cases of tests that `@pytest.mark.default_cases` leaves out as nightly.

    Nightly tests are slow tests as well, so that the default run omits them.

    ``default_cases(4)`` keeps the first and the last case and two between them. Cases
    that differ in kind are chosen by position: ``default_cases(at=[0, 3, 7])``. Cases
    that are slow already are not counted.
    """
    items = list(items)
    families: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("nightly"):
            item.add_marker(pytest.mark.slow)
        if item.get_closest_marker("default_cases") and "slow" not in item.keywords:
            families.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for cases in families.values():
        marker = cases[0].get_closest_marker("default_cases")
        assert marker is not None
        kept = chosen(len(cases), *marker.args, **marker.kwargs)
        for position, item in enumerate(cases):
            if position not in kept:
                item.add_marker(pytest.mark.nightly)
                item.add_marker(pytest.mark.slow)


def chosen(count: int, number: int = 0, at: Iterable[int] = ()) -> set[int]:
    """Return the positions of the cases that run by default.

    Args:
        count: number of cases that were collected.
        number: number of cases to keep, from the first to the last at equal distances.
        at: positions of the cases to keep. All are kept if one of them is missing, as
            when a single case is started by its name.
    """
    positions = set(at)
    if positions:
        return positions if max(positions) < count else set(range(count))
    if number >= count:
        return set(range(count))
    if number == 1:
        return {0}
    return {round(k * (count - 1) / (number - 1)) for k in range(number)}
