"""Type checks for the arguments of public functions.

The types are checked once per call of a public function, not in every time step. Error
messages use the same terms as the command line.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cache, wraps
from inspect import signature
from types import UnionType
from typing import (
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from srs_twin.errors import InputError

Function = TypeVar("Function", bound=Callable[..., object])

_CONVERSIONS: Mapping[object, str] = {float: "__float__", int: "__index__"}
"""Special methods that convert objects such as NumPy scalars to numbers, keyed by
number type."""

_DESCRIPTIONS = {
    "float": "a number",
    "int": "a whole number",
    "str": "a text",
    "NoneType": "None",
    "PathLike": "a path",
    "Callable": "a function",
    "Mapping": "a mapping",
    "Sequence": "a list",
    "Iterable": "a list",
    "Job": "a Job(plant, controller, duration)",
    "RobotSpec": "a RobotSpec, such as load_robot('gen2')",
    "Plant": "a Plant, such as TwinSnake(load_robot('gen2'))",
    "Controller": "a Controller, such as Gait(2.0)",
    "Trajectory": "a Trajectory, which rollout returns",
    "Scenario": "a Scenario, such as load_scenario('gen2_straight')",
    "Pose": "a Pose, such as Pose(0, 0, 0)",
    "Footprint": "a Footprint, such as load_footprint('gen2_gait')",
    "Problem": "a Problem; plan_scenario plans a scenario",
}
"""Descriptions of types in messages, keyed by type name."""


def checked(function: Function) -> Function:
    """Decorate a function so that it checks the types of its arguments."""
    names = tuple(signature(function).parameters)
    owner = function.__qualname__.removesuffix(".__init__")

    @wraps(function)
    def call(*arguments: object, **keywords: object) -> object:
        check_types(
            owner, function, dict(zip(names, arguments, strict=False)) | keywords
        )
        return function(*arguments, **keywords)

    return cast(Function, call)


def check_types(
    owner: str, annotated: Callable[..., object], values: Mapping[str, object]
) -> None:
    """Check values against the type annotations of a function or class."""
    kinds = _kinds(annotated)
    for name, value in values.items():
        if name in kinds and not _accepts(kinds[name], value):
            allowed = _described(kinds[name])
            raise InputError(
                f"{owner}: {name} {_shown(value)} is not allowed; it must be {allowed}"
            )


@cache
def _kinds(annotated: Callable[..., object]) -> dict[str, object]:
    return get_type_hints(annotated)


def _accepts(kind: object, value: object) -> bool:
    """Return whether a value fits a type, without checking the elements of mappings."""
    origin = get_origin(kind) or kind
    parts = get_args(kind)
    if origin in (Any, object):
        return True
    if origin in (Union, UnionType):
        return any(_accepts(part, value) for part in parts)
    if origin in _CONVERSIONS:
        return hasattr(value, _CONVERSIONS[origin])
    if isinstance(value, str):
        return origin in (str, Literal)
    if origin in (Iterable, Sequence, tuple):
        if not isinstance(value, Collection) or isinstance(value, Mapping):
            return origin is Iterable and isinstance(value, Iterable)
        fits = origin is not tuple or Ellipsis in parts or len(value) == len(parts)
        return fits and all(_accepts(parts[0], element) for element in value)
    return isinstance(origin, type) and isinstance(value, origin)


def _shown(value: object) -> str:
    if isinstance(value, type):
        return f"the class {value.__name__}"
    kind = type(value)
    if kind.__module__ == "builtins":
        return reprlib.repr(value)
    return f"of type {kind.__name__}"


def _described(kind: Any) -> str:
    origin = get_origin(kind) or kind
    parts = get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(map(_described, parts)))
    if origin is tuple:
        return f"{len(parts)} numbers"
    if origin is Literal:
        return _DESCRIPTIONS["str"]
    words = _DESCRIPTIONS.get(origin.__name__, f"a {origin.__name__}")
    if origin in (Iterable, Sequence):
        return f"{words}, each {_described(parts[0])}"
    return words
