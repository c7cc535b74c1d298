"""What numba compiles, compiled by Warp: the same functions, and records with an axis of worlds.

Warp wants the types of arguments, its own functions by their names, and single precision. A function that
keeps to what both compilers know is given a copy that has them; tolerances are those of single precision.
"""

from __future__ import annotations

import inspect
import linecache
from collections.abc import Callable, Mapping, Sequence
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
import warp as wp

_TOLERANCES = {"_CLOSE": 1e-6, "_LEAST": 1e-15}
"""Of the rim's speed, and of a residual's square, (kg·m/s)²."""


def ported(functions: Sequence[Callable[..., Any]], **more: Any) -> dict[str, Any]:
    """Return Warp functions of these, by their names.

    Args:
        functions: as numba has them; each before those that call it.
        **more: what stands for other names in them.
    """
    space: dict[str, Any] = _TOLERANCES | more
    for function in functions:
        plain = getattr(function, "py_func", function)
        copy = FunctionType(plain.__code__, {**plain.__globals__, **space}, plain.__name__)
        copy.__module__, copy.__qualname__ = plain.__module__, f"ported_{plain.__name__}"
        copy.__annotations__ = dict.fromkeys(inspect.signature(plain).parameters, Any)
        space[plain.__name__] = wp.func(copy)
    return space


class Ported(NamedTuple):
    """A record for Warp.

    Attributes:
        one: type of one world's, as the functions take it.
        each: type of all worlds'; its fields have an axis of worlds first.
        world: Warp function of each and a number that returns one.
    """

    one: Any
    each: Any
    world: Any


def record(example: Any, without: Sequence[str] = ()) -> Ported:
    """Return what stands for a named tuple of arrays and numbers, by an example of one world's.

    Args:
        example: one world's.
        without: fields that are not needed.
    """
    kind = type(example)
    names = [name for name in example._fields if name not in without]
    shapes = {name: _typed(getattr(example, name)) for name in names}
    one, each = (
        wp.struct(type(f"{kind.__name__}{what}", (), {"__annotations__": fields, "__module__": __name__}))
        for what, fields in (
            ("One", {name: wp.array(dtype=t, ndim=d) if d else t for name, (t, d) in shapes.items()}),
            ("Each", {name: wp.array(dtype=t, ndim=d + 1) for name, (t, d) in shapes.items()}),
        )
    )
    lines = [f"def world_{kind.__name__}(each: Each, i: int):", "    one = One()"]
    lines += [f"    one.{name} = each.{name}[i]" for name in names] + ["    return one"]
    return Ported(one, each, _of_source("\n".join(lines) + "\n", {"One": one, "Each": each}))


def stacked(kind: Ported, examples: Sequence[Any], device: Any) -> Any:
    """Return the named tuples of some worlds on a device, as one record."""
    found = kind.each()
    for name in examples[0]._fields:
        values = [getattr(each, name) for each in examples]
        rows = np.stack([np.asarray(value) for value in values])
        setattr(found, name, wp.array(rows, dtype=_typed(values[0])[0], device=device))
    return found


def _typed(value: Any) -> tuple[type, int]:
    """Return the type of a field's numbers, and how many axes it has."""
    array = np.asarray(value)
    return (float if array.dtype.kind == "f" else int), array.ndim


def _of_source(source: str, space: Mapping[str, Any]) -> Any:
    """Return the Warp function of a text, which Warp wants to read."""
    name = source[4 : source.index("(")]
    file = f"<{__name__}.{name}>"
    linecache.cache[file] = len(source), None, source.splitlines(keepends=True), file
    found: dict[str, Any] = dict(space)
    exec(compile(source, file, "exec"), found)
    found[name].__module__ = __name__
    return wp.func(found[name])
