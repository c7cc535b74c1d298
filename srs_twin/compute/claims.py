"""Claims of plants, controllers, batches and environments, which serve one thread at a time.

Such an object changes while it runs. A second thread would continue from half a step, or crash the engine.
`rollout` therefore claims its plant and its controller until it ends, and a method in `claiming_methods`
claims its object while it runs. A thread may claim again what it has claimed, and so may tasks of `Workers`
that it waits for. After the end of a claim, any other thread may use the object.

Claims are stored outside the objects, so that copies and pickles have none.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from threading import get_ident
from types import FunctionType
from typing import Any, ClassVar

from srs_twin.errors import InputError
from srs_twin.io.saved_state import DeepCopied

CALLERS: ContextVar[tuple[int, ...]] = ContextVar("CALLERS", default=())
"""Threads that wait for the current task, which may use what they have claimed."""

_HOLDERS: dict[int, int] = {}
"""Identity of each claimed object → the thread that has claimed it."""

if hasattr(os, "register_at_fork"):
    # The other threads of the parent do not exist in the child.
    os.register_at_fork(after_in_child=_HOLDERS.clear)


class Claimable(DeepCopied):
    """Base class of objects that one thread uses at a time.

    Attributes:
        claiming_methods: names of the methods, also of subclasses, that claim the object while they run.
    """

    claiming_methods: ClassVar[tuple[str, ...]] = (
        *("reset", "step", "advance", "play", "place", "save", "restore", "render"),
        "__reduce_ex__",
    )

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for name in cls.claiming_methods:
            method = getattr(cls, name, None)
            if isinstance(method, FunctionType) and method.__code__ is not _CLAIMING:
                setattr(cls, name, _claiming(method))


def _claiming(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method that claims its object while it runs.

    An interrupt may arrive after any call. The claim is therefore made inside the block that ends it, and
    that block makes no call before the claim has ended. A context manager would be slower.
    """

    @wraps(method)
    def claiming(self: object, *arguments: Any, **options: Any) -> Any:
        key = id(self)
        if _is_claimed_here(key):
            return method(self, *arguments, **options)
        thread = get_ident()
        try:
            if _HOLDERS.setdefault(key, thread) != thread:
                raise _in_use(self)
            return method(self, *arguments, **options)
        finally:
            if key in _HOLDERS and _HOLDERS[key] == thread:
                del _HOLDERS[key]

    return claiming


_CLAIMING = _claiming(id).__code__
"""Code of all methods that `_claiming` returns."""


@contextmanager
def claim(*objects: object) -> Iterator[None]:
    """Claim objects and their claimable attributes within a `with` block.

    Raises:
        InputError: another thread has claimed one of them.
    """
    thread = get_ident()
    # Lists of the attributes, because another thread may add one.
    parts = [part for item in objects for part in list(vars(item).values()) if isinstance(part, Claimable)]
    free = {id(part): part for part in (*objects, *parts) if not _is_claimed_here(id(part))}
    try:
        for key, part in free.items():
            if _HOLDERS.setdefault(key, thread) != thread:
                raise _in_use(part)
        yield
    finally:
        for key in free:
            if key in _HOLDERS and _HOLDERS[key] == thread:
                del _HOLDERS[key]


def _is_claimed_here(key: int) -> bool:
    holder = _HOLDERS.get(key)
    return holder == get_ident() or holder in CALLERS.get()


def _in_use(claimed: object) -> InputError:
    return InputError(
        f"this {type(claimed).__name__} is in use by another thread; build another one for this thread. "
        "run_many runs several jobs on threads, each with its own plant and controller"
    )
