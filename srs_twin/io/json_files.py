"""Strict reader of untrusted JSON with limits on size and depth.

The reader of the standard library accepts ``NaN`` and ``Infinity``, which are not JSON, reads ``1e999`` as
infinity, keeps the last of two equal keys, and exhausts its stack on deep nesting.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from srs_twin.errors import InputError
from srs_twin.io.files import decode_text, display_path, require_file

MAX_DEPTH = 64
"""Largest depth of nested lists and objects; results have fewer than ten levels."""

MAX_JSON_BYTES = 64 << 20
"""Largest size of a file; a reproduction of all claims has 1 MB."""


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        InputError: the file is missing, not a regular file, not readable, too large, or not JSON.
    """
    try:
        with require_file(path, suffix=".json").open("rb") as stream:
            raw = stream.read(MAX_JSON_BYTES + 1)
    except OSError as error:
        raise InputError(f"{display_path(path)}: cannot be read ({error.strerror})") from error
    if len(raw) > MAX_JSON_BYTES:
        raise InputError(f"{display_path(path)}: larger than {MAX_JSON_BYTES >> 20} MB")
    return parse_json(decode_text(raw, display_path(path)), display_path(path))


def parse_json(text: str, name: str) -> Any:
    """Return the data of JSON text.

    Args:
        text: text of a file.
        name: name of the file in messages.

    Raises:
        InputError: invalid JSON, nesting beyond the limit, a number out of range, or a repeated key.
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
    # Python rejects integers with thousands of digits; shorter ones may still be too large for a float.
    return int(text) if len(text) < 19 else _number(text)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        names = [name for name, _ in pairs]
        duplicate = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"key {duplicate[:80]!r} is given twice")
    return mapping


def _depth(data: Any) -> int:
    """Return the depth of nested lists and objects, at most one more than is allowed."""
    layer, depth = [data], 0
    while layer and depth <= MAX_DEPTH:
        layer = [inner for value in layer for inner in _children(value)]
        depth += 1
    return depth


def _children(value: Any) -> Iterator[Any]:
    if isinstance(value, dict):
        yield from value.values()
    elif isinstance(value, list):
        yield from value
