"""Translation of numba kernels and their records for Warp.

Warp needs argument types, the Warp versions of called functions under their names, and
single precision. A function that uses only the common subset of both compilers is
copied with these; its tolerances are replaced by those of single precision. A record, a
named tuple of arrays and numbers, becomes a Warp struct of one world and one of all
worlds.
"""

from __future__ import annotations

import inspect
import linecache
from collections.abc import Callable, Mapping, Sequence
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from srs_twin.plants.twin import friction_solve, stick_slip
from srs_twin.pneumatics import chambers, lag

_TOLERANCES = {
    "_RIM_TOLERANCE": 1e-6,  # relative, of the rim speed (`stick_slip`)
    "_ABSOLUTE_TOLERANCE": (
        1e-15
    ),  # (kg·m/s)², of the squared residual (`friction_solve`)
}
"""Module constants in the translated functions → their values in single precision."""


def as_warp_functions(
    functions: Sequence[Callable[..., Any]], **translated: Any
) -> dict[str, Any]:
    """Return the Warp versions of functions by name, with those given as `translated`.

    Args:
        functions: functions compiled by numba, callees before their callers.
        **translated: Warp functions that the functions call, by name.
    """
    namespace: dict[str, Any] = _TOLERANCES | translated
    for function in functions:
        plain = getattr(function, "py_func", function)
        copy = FunctionType(
            plain.__code__, {**plain.__globals__, **namespace}, plain.__name__
        )
        copy.__module__ = plain.__module__
        copy.__qualname__ = f"warp_{plain.__name__}"
        copy.__annotations__ = dict.fromkeys(inspect.signature(plain).parameters, Any)
        namespace[plain.__name__] = wp.func(copy)
    return namespace


_FRICTION_SOLVE = (
    "_clear",
    "_add_product",
    "dot",
    "point_jacobian",
    "_locate_wheels",
    "_read_normal_forces",
    "_spatial_velocities",
    "_project",
    "_generalised_forces",
    "_contact_velocity",
    "_friction_load",
    "_evaluation_fraction",
    "_friction_law",
    "_evaluate_residual",
    "_assemble",
    "_line_search",
    "_newton",
    "apply_stored_friction",
    "set_mid_velocity",
    "solve_friction",
    "store_friction",
)
"""Functions of `friction_solve`, ordered so that callees come before their callers."""

_OBJECT_FUNCTIONS = (
    "apply_object_friction",
    "locate_objects",
    "add_object_impulses",
    "add_object_slopes",
    "couple_objects",
)
"""Functions of the friction solve that do nothing without movable objects."""


def _no_objects(engine, sparsity, work, h):  # type: ignore[no-untyped-def]
    """Do nothing."""
    return


def warp_functions() -> dict[str, Any]:
    """Return the Warp versions of the chamber laws, friction laws and friction solve, by name."""
    laws: list[Any] = [
        stick_slip.stick_slip_friction,
        stick_slip.skin_friction,
        stick_slip.rolling_friction,
    ]
    functions = as_warp_functions([*laws, chambers.volume, chambers._log_cosh])
    chamber_laws: list[Any] = [
        chambers.apply_bend_law,
        lag.advance_segment,
        lag.filling_content,
    ]
    functions = as_warp_functions(chamber_laws, **functions)
    linear_algebra = [
        friction_solve._factor,
        friction_solve._substitute,
        friction_solve.solve_direction_portably,
    ]
    functions = as_warp_functions(linear_algebra, **functions)
    functions |= dict.fromkeys(
        _OBJECT_FUNCTIONS, as_warp_functions([_no_objects])["_no_objects"]
    )
    # The CPU version calls the engine's C functions.
    functions["_solve_direction"] = functions["solve_direction_portably"]
    return as_warp_functions(
        [getattr(friction_solve, name) for name in _FRICTION_SOLVE], **functions
    )


class WarpStruct(NamedTuple):
    """Warp versions of a record.

    Attributes:
        single: struct of one world, the argument of translated functions.
        batched: struct of all worlds; its fields have a leading axis of worlds.
        select: Warp function that maps a batched struct and an index to the struct of
            that world.
    """

    single: Any
    batched: Any
    select: Any


def warp_struct(example: Any, without: Sequence[str] = ()) -> WarpStruct:
    """Return the Warp versions of a record.

    Args:
        example: record of one world, a named tuple.
        without: fields that are left out.
    """
    kind = type(example)
    names = [name for name in example._fields if name not in without]
    shapes = {name: _type_and_ndim(getattr(example, name)) for name in names}
    single, batched = (
        wp.struct(
            type(
                f"{kind.__name__}{suffix}",
                (),
                {"__annotations__": fields, "__module__": __name__},
            )
        )
        for suffix, fields in (
            (
                "Single",
                {
                    name: wp.array(dtype=t, ndim=d) if d else t
                    for name, (t, d) in shapes.items()
                },
            ),
            (
                "Batched",
                {
                    name: wp.array(dtype=t, ndim=d + 1)
                    for name, (t, d) in shapes.items()
                },
            ),
        )
    )
    lines = [
        f"def select_{kind.__name__}(batched: Batched, i: int):",
        "    single = Single()",
    ]
    lines += [f"    single.{name} = batched.{name}[i]" for name in names] + [
        "    return single"
    ]
    source = "\n".join(lines) + "\n"
    return WarpStruct(
        single,
        batched,
        _function_from_source(source, {"Single": single, "Batched": batched}),
    )


def stack_records(struct: WarpStruct, records: Sequence[Any], device: Any) -> Any:
    """Return the records of several worlds as one batched struct on a device."""
    batched = struct.batched()
    for name in records[0]._fields:
        values = [getattr(record, name) for record in records]
        rows = np.stack([np.asarray(value) for value in values])
        setattr(
            batched,
            name,
            wp.array(rows, dtype=_type_and_ndim(values[0])[0], device=device),
        )
    return batched


def _type_and_ndim(value: Any) -> tuple[type, int]:
    """Return the scalar type of a field and its number of axes."""
    array = np.asarray(value)
    return (float if array.dtype.kind == "f" else int), array.ndim


def _function_from_source(source: str, namespace: Mapping[str, Any]) -> Any:
    """Return the Warp function with the given source, which Warp reads through `linecache`."""
    name = source[4 : source.index("(")]
    file = f"<{__name__}.{name}>"
    linecache.cache[file] = len(source), None, source.splitlines(keepends=True), file
    definitions: dict[str, Any] = dict(namespace)
    exec(compile(source, file, "exec"), definitions)
    definitions[name].__module__ = __name__
    return wp.func(definitions[name])
