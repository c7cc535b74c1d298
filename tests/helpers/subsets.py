"""Parameter lists of which the default run uses the first few, and `-m slow` the rest."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def first_by_default(count: int, values: Iterable[Any]) -> list[Any]:
    """Return the values, marked slow after the first `count`; a tuple contains several arguments."""
    values = list(values)
    return values[:count] + [_slow(value) for value in values[count:]]


def _slow(value: Any) -> Any:
    if hasattr(value, "marks"):
        return pytest.param(
            *value.values, id=value.id, marks=[*value.marks, pytest.mark.slow]
        )
    if isinstance(value, tuple):
        return pytest.param(*value, marks=pytest.mark.slow)
    return pytest.param(value, marks=pytest.mark.slow)
