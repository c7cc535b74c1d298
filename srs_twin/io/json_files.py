"""Strict and bounded reader of JSON from outside.

Python's own reader accepts ``NaN`` and ``Infinity``, which are not JSON, takes ``1e999`` for infinity, keeps
the last of two equal keys and exhausts its stack on deep nesting.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from srs_twin.errors import InputError
from srs_twin.io.files import decoded, existing, shown

MAX_DEPTH = 64
"""Results are nested less than ten deep."""
MAX_JSON_BYTES = 64 << 20
"""A reproduction of all claims has 1 MB."""


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        InputError: missing, not a regular file, not readable, too large, or not JSON.
    """
    try:
        with existing(path, suffix=".json").open("rb") as stream:
            raw = stream.read(MAX_JSON_BYTES + 1)
    except OSError as error:
        raise InputError(f"{shown(path)}: cannot be read ({error.strerror})") from error
    if len(raw) > MAX_JSON_BYTES:
        raise InputError(f"{shown(path)}: larger than {MAX_JSON_BYTES >> 20} MB")
    return parse_json(decoded(raw, shown(path)), shown(path))


def parse_json(text: str, name: str) -> Any:
    """Return the data of JSON text.

    Args:
        text: of a file.
        name: of the file, for messages.

    Raises:
        InputError: not JSON, a number out of range, a key given twice, or nested too deep.
    """
    try:
        data = json.loads(
            text, parse_constant=_refuse, parse_float=_number, parse_int=_integer, object_pairs_hook=_object
        )
    except json.JSONDecodeError as error:
        place = f"{name}:{error.lineno}:{error.colno}"
        raise InputError(f"{place}: not JSON: {error.msg}") from error
    except ValueError as error:
        raise InputError(f"{name}: {error}") from error
    except RecursionError:
        raise InputError(f"{name}: nested more than {MAX_DEPTH} deep") from None
    if _depth(data) > MAX_DEPTH:
        raise InputError(f"{name}: nested more than {MAX_DEPTH} deep")
    return data


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is not JSON")


def _number(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{text[:40]} is out of range")
    return value


def _integer(text: str) -> int | float:
    # Python refuses integers of thousands of digits; shorter ones may still be too large for a float.
    return int(text) if len(text) < 19 else _number(text)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"key {twice[:80]!r} is given twice")
    return found


def _depth(data: Any) -> int:
    """Return how deep lists and objects are nested, at most one more than is allowed."""
    layer, depth = [data], 0
    while layer and depth <= MAX_DEPTH:
        layer = [inner for each in layer for inner in _inside(each)]
        depth += 1
    return depth


def _inside(value: Any) -> Iterator[Any]:
    if isinstance(value, dict):
        yield from value.values()
    elif isinstance(value, list):
        yield from value
