"""Translation of Numba functions and their records to Warp.

Warp functions need annotated arguments, and can only call other Warp functions. Each
Numba function is therefore copied with annotations, translated callees and tolerances
for single precision. A record is a named tuple of arrays, numbers and further records.
Each record is translated to a struct of one world and a struct of all worlds.
"""

from __future__ import annotations

import inspect
import linecache
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from srs_twin.plants.twin import friction_solve, stick_slip

_TOLERANCES = {
    "_RIM_TOLERANCE": 1e-6,  # Relative tolerance of the rim speed (`stick_slip`).
    # Tolerance of the squared residual (`friction_solve`), (kg·m/s)².
    "_ABSOLUTE_TOLERANCE": 1e-15,
}
"""Values of module constants for single precision, keyed by name."""


def as_warp_functions(
    functions: Iterable[Callable[..., object]], **translated: wp.Function
) -> dict[str, wp.Function]:
    """Translate functions and their callees, and return Warp functions keyed by name.

    Args:
        functions: functions to translate, which may be compiled by Numba.
        **translated: Warp functions that replace callees, keyed by name.
    """
    namespace: dict[str, Any] = _TOLERANCES | {"Traction": _TRACTION} | translated
    for function in functions:
        _translate(function, namespace)
    return namespace


def _translate(function: Any, namespace: dict[str, Any]) -> None:
    """Add the Warp versions of a function and of its callees to a namespace."""
    plain = getattr(function, "py_func", function)
    for name in plain.__code__.co_names:
        callee = plain.__globals__.get(name)
        is_function = isinstance(getattr(callee, "py_func", callee), FunctionType)
        if is_function and name not in namespace:
            _translate(callee, namespace)
    copy = FunctionType(
        plain.__code__, {**plain.__globals__, **namespace}, plain.__name__
    )
    copy.__module__ = plain.__module__
    copy.__qualname__ = f"warp_{plain.__name__}"
    copy.__annotations__ = dict.fromkeys(inspect.signature(plain).parameters, Any)
    namespace[plain.__name__] = wp.func(copy)


_OBJECT_FUNCTIONS = (
    "apply_object_friction",
    "locate_objects",
    "add_object_impulses",
    "add_object_jacobian",
    "couple_objects",
)
"""Functions for movable objects, which the device engine does not support."""


def _no_objects(engine, sparsity, workspace, h):  # type: ignore[no-untyped-def]
    return


def warp_functions() -> dict[str, wp.Function]:
    """Return the Warp versions of the friction functions, keyed by name."""
    no_objects = as_warp_functions([_no_objects])["_no_objects"]
    functions = as_warp_functions(
        [friction_solve.solve_direction_portably],
        **dict.fromkeys(_OBJECT_FUNCTIONS, no_objects),
    )
    # The CPU version calls C functions of MuJoCo, which Warp cannot call.
    functions["_solve_direction"] = functions["solve_direction_portably"]
    step = (
        friction_solve.apply_stored_friction,
        friction_solve.set_mid_velocity,
        friction_solve.solve_friction,
        friction_solve.store_friction,
    )
    return as_warp_functions(step, **functions)


class WarpStruct(NamedTuple):
    """Types of the Warp structs for a record.

    Attributes:
        single: struct of one world, which is an argument of translated functions.
        batched: struct of all worlds, whose fields have a leading axis of worlds.
        select: Warp function that returns the single struct of the world with a given
            index in a batched struct.
        inner: Warp structs for the fields that are records, keyed by field name.
    """

    single: Any
    batched: Any
    select: wp.Function
    inner: Mapping[str, WarpStruct]


def warp_struct(example: Any, without: Sequence[str] = ()) -> WarpStruct:
    """Create the Warp structs for a record.

    Args:
        example: record of one world, which defines the types and array dimensions.
        without: names of fields that the structs omit.
    """
    kind = type(example).__name__
    inner: dict[str, WarpStruct] = {}
    single: dict[str, object] = {}
    batched: dict[str, object] = {}
    lines = [
        f"def select_{kind}(batched: Batched, i: int):",
        "    single = Single()",
    ]
    for name in example._fields:
        value = getattr(example, name)
        if name in without:
            continue
        if hasattr(value, "_fields"):
            inner[name] = warp_struct(value)
            single[name] = inner[name].single
            batched[name] = inner[name].batched
            lines.append(f"    single.{name} = select_{name}(batched.{name}, i)")
            continue
        scalar, axes = _type_and_ndim(value)
        single[name] = wp.array(dtype=scalar, ndim=axes) if axes else scalar
        batched[name] = wp.array(dtype=scalar, ndim=axes + 1)
        lines.append(f"    single.{name} = batched.{name}[i]")
    lines.append("    return single")
    names = {f"select_{name}": part.select for name, part in inner.items()}
    names["Single"] = _struct(f"{kind}Single", single)
    names["Batched"] = _struct(f"{kind}Batched", batched)
    select = _function_from_source("\n".join(lines) + "\n", names)
    return WarpStruct(names["Single"], names["Batched"], select, inner)


def _struct(name: str, fields: Mapping[str, object]) -> Any:
    members = {"__annotations__": dict(fields), "__module__": __name__}
    return wp.struct(type(name, (), members))


_TRACTION = _struct("Traction", dict.fromkeys(stick_slip.Traction._fields, float))


def stack_records(struct: WarpStruct, records: Sequence[Any], device: wp.Device) -> Any:
    """Stack the records of several worlds in one batched struct on a device."""
    batched = struct.batched()
    for name in records[0]._fields:
        values = [getattr(record, name) for record in records]
        if name in struct.inner:
            stacked = stack_records(struct.inner[name], values, device)
        else:
            rows = np.stack([np.asarray(value) for value in values])
            scalar, _ = _type_and_ndim(values[0])
            stacked = wp.array(rows, dtype=scalar, device=device)
        setattr(batched, name, stacked)
    return batched


def single_record(struct: WarpStruct, record: Any) -> Any:
    """Convert a record of integers and integer arrays to the struct of one world."""
    single = struct.single()
    for name, value in record._asdict().items():
        is_array = isinstance(value, np.ndarray)
        setattr(single, name, wp.array(value, dtype=int) if is_array else value)
    return single


def _type_and_ndim(value: ArrayLike) -> tuple[type, int]:
    array = np.asarray(value)
    return (float if array.dtype.kind == "f" else int), array.ndim


def _function_from_source(source: str, namespace: Mapping[str, object]) -> wp.Function:
    name = source[4 : source.index("(")]
    file = f"<{__name__}.{name}>"
    linecache.cache[file] = len(source), None, source.splitlines(keepends=True), file
    definitions = dict(namespace)
    exec(compile(source, file, "exec"), definitions)
    definitions[name].__module__ = __name__
    return wp.func(definitions[name])
