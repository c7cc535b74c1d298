"""What decides what comes next: taken from plants and controllers, given back, kept in files without pickles.

A class names the attributes that change while it runs (`memory`); those of its parts that remember are taken
with them. What a constructor or `reset` settles is not memory: it must be the same where a state is restored.

A file is a NumPy archive: the arrays, and the rest as JSON, in which a named tuple or a dataclass of this
package stands by its name.

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
import hashlib
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
from typing import Any, ClassVar, Self, cast

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write, shown

# Raised when the form of a state or the module of a class in it changes: such files are refused.
VERSION = 2
_TREE = "state"
_MOST_BYTES = 256 << 20  # unpacked
_PACKAGE = __name__.partition(".")[0] + "."


def names(*given: str) -> tuple[str, ...]:
    """Return the names of a class's `memory`."""
    return given


class CopiedWhole:
    """Base of classes whose objects share no state with their copies.

    `copy.copy` makes a deep copy: a shallow one would step the chambers and bodies of the original. A copy,
    or an object that was pickled and loaded, continues with the same bits as the original.
    """

    def __copy__(self) -> Self:
        return copy.deepcopy(self)

    def __reduce_ex__(self, protocol: Any) -> str | tuple[Any, ...]:
        """Return the class and the attributes, for `copy` and `pickle`.

        Raises:
            InputError: an attribute can be neither copied nor pickled.
        """
        for name, value in vars(self).items():
            if (kind := _unique(value)) is not None:
                raise InputError(
                    f"{type(self).__name__} can be neither copied nor pickled, because its attribute "
                    f"'{name}' is {kind}; use save() and restore() instead"
                )
        return super().__reduce_ex__(protocol)


def _unique(value: Any) -> str | None:
    """Return why a value can be neither copied nor pickled; None where no reason is known.

    A copy of a function that is defined inside another one would share that one's variables.
    """
    if isinstance(value, partial):
        return _unique(value.func)
    if isinstance(value, MethodType):
        return _unique(value.__self__)
    if isinstance(value, FunctionType) and "<" in value.__qualname__:
        return "a function without a name in its module"
    if isinstance(value, GeneratorType):
        return "a generator"
    return "a task of another thread" if isinstance(value, Future | Executor) else None


class Remembers(CopiedWhole):
    """What has a memory.

    Attributes:
        memory: names of the attributes that change while it runs; those of the classes above count as well.
    """

    memory: ClassVar[tuple[str, ...]] = names()

    def remembered(self) -> dict[str, Any]:
        """Return the memory, name → value; of parts that remember their memory, name → value."""
        return {name: _taken(getattr(self, name)) for name in self._names()}

    def recall(self, memory: Mapping[str, Any]) -> None:
        """Take a memory that `remembered` returned, here or elsewhere.

        Raises:
            InputError: the memory is incomplete; nothing of it has been taken then.
        """
        missing = [name for name in self._names() if name not in memory]
        if missing:
            raise InputError(
                f"{type(self).__name__}: the state is incomplete; it has no {', '.join(missing)}"
            )
        for name in self._names():
            part = getattr(self, name, None)
            if isinstance(part, Remembers):
                part.recall(memory[name])
            else:
                setattr(self, name, copy.deepcopy(memory[name]))

    def check_memory(self, base: type, what: str) -> None:
        """Refuse what does not say what it remembers, or has nothing yet.

        Args:
            base: a class above, whose own memory does not count.
            what: it is, for the message.

        Raises:
            InputError: no class below `base` has a `memory`, or it was never reset.
        """
        below = [each for each in type(self).__mro__ if issubclass(each, base) and each is not base]
        if not any("memory" in vars(each) for each in below):
            raise InputError(f"{what} does not say what it remembers (`memory`), so it cannot be saved")
        if not all(hasattr(self, name) for name in self._names()):
            raise InputError(f"{what} has no state before its first reset")

    @classmethod
    def _names(cls) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for each in cls.__mro__ for name in vars(each).get("memory", ())))


def _taken(value: Any) -> Any:
    return value.remembered() if isinstance(value, Remembers) else copy.deepcopy(value)


@dataclass(frozen=True, eq=False)
class SavedState:
    """All that decides what comes next of a plant or a controller; it can be pickled, and written to a file.

    Attributes:
        of: what it belongs to, JSON values: a state is restored only where they are the same.
        content: its memory.
        version: of the form of `content`.
    """

    of: Mapping[str, Any]
    content: Mapping[str, Any]
    version: int = VERSION

    def check(self, what: str, own: Mapping[str, Any]) -> None:
        """Refuse a state that belongs to something else.

        Args:
            what: is to be restored, for messages.
            own: what it says of itself, as `of`.

        Raises:
            InputError: the states' settings differ, or another version.
        """
        _check_version(what, self.version)
        there, here = (json.loads(json.dumps(each)) for each in (self.of, own))
        differ = [key for key in sorted(there.keys() | here.keys()) if there.get(key) != here.get(key)]
        if differ:
            said = ", ".join(f"{key} {there.get(key)!r} instead of {here.get(key)!r}" for key in differ[:3])
            more = f", and {len(differ) - 3} more" if len(differ) > 3 else ""
            raise InputError(f"{what}: the state belongs to something else: {said}{more}")

    def write(self, path: Path) -> None:
        """Write it to a file, whole or not at all.

        Raises:
            InputError: the file cannot be written.
        """
        arrays: dict[str, np.ndarray] = {}
        document = {"version": self.version, "of": self.of, "content": _encoded(self.content, arrays)}
        tree = np.array(json.dumps(document))
        with atomic_write(path) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **{_TREE: tree}, **arrays)

    @staticmethod
    def read(path: Path) -> SavedState:
        """Read a file.

        Raises:
            InputError: it cannot be read, or holds no state.
        """
        try:
            with np.load(path, allow_pickle=False) as archive:
                unpacked = sum(each.file_size for each in archive.zip.infolist())
                if unpacked > _MOST_BYTES:
                    raise ValueError(f"{unpacked} bytes, unpacked; at most {_MOST_BYTES} are read")
                document = json.loads(str(archive[_TREE]))
                _check_version(shown(path), document["version"])
                content = _decoded(document["content"], archive)
                return SavedState(document["of"], content, document["version"])
        except InputError:
            raise
        except OSError as error:
            raise InputError(f"{shown(path)}: cannot be read: {error.strerror or error}") from error
        except Exception as error:  # whatever a damaged archive makes its readers raise
            raise InputError(f"{shown(path)} holds no state: {type(error).__name__}: {error}") from error


def _check_version(what: str, version: Any) -> None:
    if version != VERSION:
        raise InputError(f"{what}: saved state of version {version}; this program reads version {VERSION}")


def fingerprint(*things: Any) -> str:
    """Return a short digest of things by their `repr`."""
    return hashlib.sha256(repr(things).encode()).hexdigest()[:16]


def _encoded(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return a value as JSON; arrays are added to `arrays` and stand there by name."""
    if isinstance(value, np.ndarray):
        name = f"array_{len(arrays)}"
        arrays[name] = value
        return {"@": "array", "name": name}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum):
        return {"@": _named(type(value)), "value": value.value}
    if is_dataclass(value):
        parts = {each.name: getattr(value, each.name) for each in fields(value)}
        return {"@": _named(type(value)), "parts": _encoded(parts, arrays)}
    if isinstance(value, Mapping):
        return {"@": "dict", "items": [[str(key), _encoded(each, arrays)] for key, each in value.items()]}
    if isinstance(value, tuple | list | deque):
        kind = _named(type(value)) if hasattr(value, "_fields") else type(value).__name__
        return {"@": kind, "items": [_encoded(each, arrays) for each in value]}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a {type(value).__name__} has no place in a file")


def _decoded(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if not isinstance(value, dict):
        return value
    kind = value["@"]
    if kind == "array":
        return arrays[value["name"]]
    if kind == "dict":
        return {key: _decoded(each, arrays) for key, each in value["items"]}
    if kind in ("tuple", "list", "deque"):
        return {"tuple": tuple, "list": list, "deque": deque}[kind](
            _decoded(each, arrays) for each in value["items"]
        )
    known = _class(kind)
    if issubclass(known, Enum):
        return known(value["value"])
    if is_dataclass(known):
        return known(**_decoded(value["parts"], arrays))
    return known(*(_decoded(each, arrays) for each in value["items"]))


def _named(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _class(name: str) -> type:
    """Return a value's class: data of this package, nothing else."""
    module, _, kind = name.partition(":")
    found = getattr(importlib.import_module(module), kind) if module.startswith(_PACKAGE) else None
    named = isinstance(found, type) and (issubclass(found, Enum) or hasattr(found, "_fields"))
    if not (named or is_dataclass(found)):
        raise ValueError(f"{name} is no data of this program")
    return cast(type, found)
