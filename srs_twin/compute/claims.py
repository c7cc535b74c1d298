"""Exclusive use of an object by one thread at a time.

The state of plants, controllers, batches and environments changes during a simulation.
A second thread could continue from an incomplete time step, or crash the physics
engine. The function `rollout` therefore claims its plant and its controller until it
returns. Each method listed in `claiming_methods` claims its object during a call. A
thread may claim an object several times.

Claims are stored outside the objects, so that copies of a claimed object are not
claimed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from threading import get_ident
from types import FunctionType
from typing import ClassVar

from srs_twin.errors import InputError
from srs_twin.io.saved_state import DeepCopied

_HOLDERS: dict[int, int] = {}
"""Identifier of the thread that has claimed each object, keyed by object `id`."""

if hasattr(os, "register_at_fork"):
    # After a fork, the threads that hold claims in the parent process do not exist in
    # the child process.
    os.register_at_fork(after_in_child=_HOLDERS.clear)


class Claimable(DeepCopied):
    """Base class of objects that only one thread may use at a time."""

    claiming_methods: ClassVar[tuple[str, ...]] = (
        *("reset", "step", "advance", "play", "place", "save", "restore", "render"),
        "__reduce_ex__",
    )

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        for name in cls.claiming_methods:
            method = getattr(cls, name, None)
            if isinstance(method, FunctionType) and method.__code__ is not _CLAIMING:
                setattr(cls, name, _claiming(method))


def _claiming(method: Callable[..., object]) -> Callable[..., object]:
    """Return a method that claims its object with less overhead than `claim`."""

    @wraps(method)
    def claiming(self: object, *arguments: object, **options: object) -> object:
        key = id(self)
        thread = get_ident()
        if _HOLDERS.get(key) == thread:
            return method(self, *arguments, **options)
        # An interrupt may arrive after any function call. The object is therefore
        # claimed inside the `try` block, and the `finally` block releases the object
        # without calling a function.
        try:
            _acquire(self, thread)
            return method(self, *arguments, **options)
        finally:
            if key in _HOLDERS and _HOLDERS[key] == thread:
                del _HOLDERS[key]

    return claiming


_CLAIMING = _claiming(id).__code__
"""Code object that all methods returned by `_claiming` share."""


@contextmanager
def claim(item: object) -> Iterator[None]:
    """Claim an object for the current thread within a `with` block."""
    key = id(item)
    thread = get_ident()
    ours = _HOLDERS.get(key) == thread
    try:
        _acquire(item, thread)
        yield
    finally:
        if not ours and key in _HOLDERS and _HOLDERS[key] == thread:
            del _HOLDERS[key]


def _acquire(item: object, thread: int) -> None:
    if _HOLDERS.setdefault(id(item), thread) != thread:
        raise InputError(
            f"this {type(item).__name__} is in use by another thread; create a separate"
            " object for this thread. `run_many` runs several jobs on threads, each"
            " with its own plant and controller"
        )
