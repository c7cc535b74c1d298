"""Saved states of plants and controllers, stored in files without pickle.

The class attribute `state_attributes` names the attributes that change during a run.
Attributes that are `Stateful` objects are saved recursively. A state includes neither
the constructor arguments nor the arguments of `reset`. A state can be restored only by
an object whose settings equal those of the saved object.

A state file is a NumPy archive that contains the arrays and a JSON document with all
other values. Named tuples, dataclasses and enums of this package are stored with their
class names.

>>> from srs_twin import AnalyticalSnake, Gait, load_robot, rollout
>>> snake = AnalyticalSnake(load_robot("gen2"))
>>> _ = rollout(snake, Gait(2.0), 1.0)
>>> state = snake.save()
>>> there = AnalyticalSnake(load_robot("gen2")).restore(state)
>>> bool((there.com == snake.state.com).all())
True
"""

from __future__ import annotations

import copy
import importlib
import json
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Executor, Future
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from types import FunctionType, GeneratorType, MethodType
from typing import Any, ClassVar, Self, SupportsIndex, cast

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import StrPath, atomic_write, display_path
from srs_twin.io.provenance import Provenance
from srs_twin.io.untrusted import read_arrays

VERSION = 3
"""Version of the state format.

The version increases whenever the format changes or a saved class moves to another
module.
"""

_DOCUMENT = "state"
"""Name of the JSON document in the archive."""

_MAX_DOCUMENT = 16 << 20
"""Maximum length of the JSON document, characters."""

_PACKAGE = __name__.partition(".")[0] + "."


class DeepCopied:
    """Base class of objects whose copies share no state with the original.

    `copy.copy` makes a deep copy, because simulating a shallow copy would also change
    the original.
    """

    def __copy__(self) -> Self:
        return copy.deepcopy(self)

    def __reduce_ex__(self, protocol: SupportsIndex) -> str | tuple[object, ...]:
        """Support `copy` and `pickle`, and refuse attributes that cannot be copied."""
        for name, value in vars(self).items():
            if (kind := _why_not_copyable(value)) is not None:
                raise InputError(
                    f"{type(self).__name__} can be neither copied nor pickled, because"
                    f" its attribute '{name}' is {kind}; use save() and restore()"
                    " instead"
                )
        return super().__reduce_ex__(protocol)


def _why_not_copyable(value: object) -> str | None:
    if isinstance(value, partial):
        return _why_not_copyable(value.func)
    if isinstance(value, MethodType):
        return _why_not_copyable(value.__self__)
    if isinstance(value, FunctionType) and "<" in value.__qualname__:
        return "a lambda or a nested function"
    if isinstance(value, GeneratorType):
        return "a generator"
    if isinstance(value, Future | Executor):
        return "a task that runs in another thread"
    return None


class Stateful(DeepCopied):
    """Base class of objects with a state that can be saved and restored.

    Attributes:
        state_attributes: names of the attributes that change during a run, in addition
            to those of the base classes.
    """

    state_attributes: ClassVar[tuple[str, ...]] = ()

    def state_dict(self) -> dict[str, object]:
        """Return a copy of the state, keyed by attribute name."""
        return {name: _copy_state(getattr(self, name)) for name in self._state_names()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        missing = [name for name in self._state_names() if name not in state]
        if missing:
            raise InputError(
                f"{type(self).__name__}: the state is incomplete, because it has no"
                f" {', '.join(missing)}"
            )
        for name in self._state_names():
            check_kind(
                f"{type(self).__name__}.{name}", state[name], getattr(self, name, None)
            )
        for name in self._state_names():
            value = getattr(self, name, None)
            if isinstance(value, Stateful):
                value.load_state_dict(state[name])
            else:
                setattr(self, name, copy.deepcopy(state[name]))

    def check_saveable(self, base: type, label: str) -> None:
        """Check that the class defines its state and that the object has been reset."""
        subclasses = [
            cls
            for cls in type(self).__mro__
            if issubclass(cls, base) and cls is not base
        ]
        if not any("state_attributes" in vars(cls) for cls in subclasses):
            raise InputError(
                f"{label} cannot be saved, because its class does not define"
                " `state_attributes`"
            )
        if not all(hasattr(self, name) for name in self._state_names()):
            raise InputError(
                f"{label} has no state before its first reset; reset it first"
            )

    @classmethod
    def _state_names(cls) -> tuple[str, ...]:
        names = (
            name
            for base in cls.__mro__
            for name in vars(base).get("state_attributes", ())
        )
        return tuple(dict.fromkeys(names))


def check_kind(label: str, saved: object, present: object) -> None:
    """Check that a saved value fits the present array or nested state."""
    if isinstance(present, np.ndarray):
        if not isinstance(saved, np.ndarray) or saved.ndim != present.ndim:
            raise InputError(
                f"{label}: the saved value must be an array with {present.ndim}"
                " dimensions"
            )
    elif isinstance(present, Stateful) and not isinstance(saved, Mapping):
        raise InputError(f"{label}: the saved value must be a nested state")


def _copy_state(value: object) -> object:
    if isinstance(value, Stateful):
        return value.state_dict()
    return copy.deepcopy(value)


@dataclass(frozen=True, eq=False)
class SavedState:
    """State of a plant or controller that determines all later states.

    A state can be pickled or written to a file.

    Attributes:
        owner: settings of the saved object as JSON values. Only an object with equal
            settings can restore the state.
        content: saved values, keyed by attribute name.
        version: version of the format of `content`.
    """

    owner: Mapping[str, object]
    content: Mapping[str, Any]
    version: int = VERSION

    def check(self, label: str, owner: Mapping[str, object]) -> None:
        """Check that an object can restore this state.

        Args:
            label: name of the object in error messages.
            owner: settings of the object.

        Raises:
            InputError: the settings differ, or the state has another format version.
        """
        _check_version(label, self.version)
        saved = Provenance(dict(self.owner))
        if difference := Provenance(dict(owner)).difference(saved):
            raise InputError(
                f"{label}: the saved state has other settings: {difference}"
            )

    def write(self, path: StrPath) -> None:
        """Write the state to a file atomically.

        Raises:
            InputError: the file cannot be written.
        """
        arrays: dict[str, np.ndarray] = {}
        document = {
            "version": self.version,
            "of": self.owner,
            "content": _encode(self.content, arrays),
        }
        text = np.array(json.dumps(document))
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **{_DOCUMENT: text}, **arrays)

    @staticmethod
    def read(path: StrPath) -> SavedState:
        """Read a state from a file.

        Raises:
            InputError: the file cannot be read or is not a saved state.
        """
        path = Path(path)
        arrays = read_arrays(path, "saved state")
        try:
            text = str(arrays[_DOCUMENT])
            if len(text) > _MAX_DOCUMENT:
                raise ValueError(
                    f"the settings have {len(text)} characters, but at most"
                    f" {_MAX_DOCUMENT} are allowed"
                )
            document = json.loads(text)
            _check_version(display_path(path), document["version"])
            content = _decode(document["content"], arrays)
            if not (isinstance(document["of"], dict) and isinstance(content, dict)):
                raise ValueError("the settings and the content must be mappings")
            return SavedState(document["of"], content, document["version"])
        except (InputError, MemoryError):
            raise
        except Exception as error:  # a constructor may raise any kind of error
            reason = f"{type(error).__name__}: {error}"
            raise InputError(
                f"{display_path(path)}: the file is not a saved state ({reason})"
            ) from error


def _check_version(label: str, version: object) -> None:
    if version != VERSION:
        raise InputError(
            f"{label}: the saved state has version {version}, but this program reads"
            f" only version {VERSION}"
        )


def _encode(value: object, arrays: dict[str, np.ndarray]) -> object:
    """Convert a value to JSON data, and move its arrays to `arrays`."""
    if isinstance(value, np.ndarray):
        name = f"array_{len(arrays)}"
        arrays[name] = value
        return {"@": "array", "name": name}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum):
        return {"@": _class_name(type(value)), "value": value.value}
    if is_dataclass(value):
        attributes = {field.name: getattr(value, field.name) for field in fields(value)}
        return {"@": _class_name(type(value)), "parts": _encode(attributes, arrays)}
    if isinstance(value, Mapping):
        return {
            "@": "dict",
            "items": [[str(key), _encode(item, arrays)] for key, item in value.items()],
        }
    if isinstance(value, tuple | list | deque):
        kind = type(value).__name__
        if hasattr(value, "_fields"):
            kind = _class_name(type(value))
        return {"@": kind, "items": [_encode(item, arrays) for item in value]}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(
        f"a value of type {type(value).__name__} cannot be written to a saved state"
    )


def _decode(value: object, arrays: Mapping[str, np.ndarray]) -> Any:
    if not isinstance(value, dict):
        return value
    kind = value["@"]
    if kind == "array":
        return arrays[value["name"]]
    if kind == "dict":
        return {key: _decode(item, arrays) for key, item in value["items"]}
    if kind in ("tuple", "list", "deque"):
        return {"tuple": tuple, "list": list, "deque": deque}[kind](
            _decode(item, arrays) for item in value["items"]
        )
    cls = _find_class(kind)
    if issubclass(cls, Enum):
        return cls(value["value"])
    if is_dataclass(cls):
        return cls(**_decode(value["parts"], arrays))
    return cls(*(_decode(item, arrays) for item in value["items"]))


def _class_name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _find_class(name: str) -> type:
    """Return a dataclass, named tuple or enum of this package by its name.

    Classes of other packages are refused, because their constructors could execute
    arbitrary code.
    """
    module, _, kind = name.partition(":")
    cls = None
    if module.startswith(_PACKAGE):
        cls = getattr(importlib.import_module(module), kind)
    is_record = isinstance(cls, type) and (
        issubclass(cls, Enum) or hasattr(cls, "_fields")
    )
    if not (is_record or is_dataclass(cls)):
        raise ValueError(f"'{name}' is not a data class of this program")
    return cast(type, cls)
