"""compiled: numba's njit with a cache that knows everything that a kernel may have inlined."""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
import stat
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache

from srs_twin.errors import CacheWarning

# The order of sums may change, never what becomes of infinities and NaN.
_ARITHMETIC = {"contract", "reassoc", "arcp", "nsz"}
_OPTIONS: Any = {"nogil": True, "error_model": "numpy", "forceinline": True, "fastmath": _ARITHMETIC}
# What makes no arrays need not count who holds those it is given, which takes most of a small kernel's time.
_BORROWED: Any = {"_nrt": False}
_BARE: Any = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_CONSTANTS = (bool, int, float, complex, str, type(None))
_warned = False
_told: list[Callable[[], None]] = []


def tell_once(notice: Callable[[], None]) -> None:
    """Call a notice when a kernel of this process has to be compiled; the first time only."""
    _told[:] = [notice]


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that makes no arrays, on its first call; keep the machine code.

    It runs free of the interpreter's lock.

    numba keeps one file of machine code a function and drops it when the function's own source file has
    changed, by a comment too. What the function inlined from other files it does not look at: a corrected
    friction law would go on unused in the kernels. So the stamp that decides is that of what the function
    computes: its bytecode, that of every kernel it calls, and the constants they use.
    Where nothing can be kept, every process compiles for itself, with one `CacheWarning`.
    """
    return _kept(njit(**_OPTIONS, **_BORROWED)(function), function)


def allocating(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that makes arrays; else as `compiled`."""
    return _kept(njit(**_OPTIONS)(function), function)


def inside(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that only kernels call: without what Python would need to call it.

    For one that takes records of arrays that takes longer to compile than the function itself.
    """
    return _kept(njit(**_OPTIONS, **_BORROWED, **_BARE)(function), function)


def _kept(dispatcher: Any, function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a dispatcher its cache."""
    try:
        dispatcher._cache = _Cache(function)
    except RuntimeError:  # numba knows no folder that it may write
        _warn("no folder for it can be written")
    kernel: Callable[..., Any] = dispatcher
    return kernel


class _Cache(FunctionCache):
    """numba's cache of one function, which does without its folder where that fails.

    Its files are pickles, and loading one executes code: a folder that other users can write is not used.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load machine code for a signature, of just this computation; None where there is none.

        Only now, at the first call, is everything there that the function refers to.
        """
        self._cache_file._source_stamp = _stamp(self._py_func)
        if (why := _unsafe(Path(self._cache_path))) is not None:
            _warn(why, "that only you can write")
            self.disable()
        found = super().load_overload(sig, target_context)
        if found is None and _told:
            _told.pop()()
        return found

    @contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:
        """Go on without what cannot be loaded or saved; numba's own lets these errors through."""
        try:
            yield
        except OSError as error:
            _warn(f"{self._cache_path}: {error.strerror}")
        except ReferenceError:
            # The index names a kernel that was an argument in another process; it cannot be extended.
            self._cache_file.flush()
        except (EOFError, pickle.UnpicklingError, ImportError, AttributeError):
            _warn(f"{self._cache_path}: a damaged file; remove the folder")


def _unsafe(folder: Path) -> str | None:
    """Return why other users can put files into a folder; None where they cannot, or it does not exist."""
    if not hasattr(os, "getuid"):
        return None
    for path in (folder, folder.parent):
        try:
            found = path.stat()
        except OSError:
            continue
        if found.st_uid not in (os.getuid(), 0):
            return f"{path} belongs to another user"
        # In a folder with the sticky bit, such as /tmp, only the owner can replace a file.
        sticky = path != folder and found.st_mode & stat.S_ISVTX
        if found.st_mode & stat.S_IWOTH and not sticky:
            return f"{path} can be written by all users"
    return None


def _warn(why: str, wanted: str = "that can be written") -> None:
    """Warn once a process: the next kernel would fail for the same reason."""
    global _warned
    if not _warned:
        _warned = True
        said = f"machine code cannot be kept, every start compiles anew ({why})"
        remedy = f"set NUMBA_CACHE_DIR to a folder {wanted}"
        warnings.warn(f"{said}; {remedy}", CacheWarning, stacklevel=1)


@functools.cache
def _stamp(function: Any) -> str:
    """Return what changes with anything that decides what a function computes, but with no comment."""
    total = hashlib.sha256(f"{function.__module__} {sorted(_ARITHMETIC)} {sorted(_BORROWED)}".encode())
    for part in _meaning(function.__code__, function.__globals__, set()):
        total.update(part.encode() + b"\0")
    return total.hexdigest()


def _meaning(code: CodeType, names: Mapping[str, Any], seen: set[CodeType]) -> Iterator[str]:
    """Yield the bytecode of a function, what its names stand for, and so on for the functions it calls."""
    if code in seen:
        return
    seen.add(code)
    yield f"{code.co_code!r} {code.co_names} {code.co_varnames} {code.co_argcount}"
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _meaning(constant, names, seen)
        elif not isinstance(constant, str):  # the docstring
            yield repr(constant)
    for name in code.co_names:
        value = names.get(name)
        if isinstance(value, ModuleType) and value.__name__.startswith("srs_twin"):
            yield from _of_values(name, [vars(value).get(each) for each in code.co_names], seen)
        else:
            yield from _of_values(name, [value], seen)


def _of_values(name: str, values: Iterable[Any], seen: set[CodeType]) -> Iterator[str]:
    """Yield what the values of a name stand for, as `_meaning` does."""
    for value in values:
        function = getattr(value, "py_func", value)
        if isinstance(function, FunctionType):
            yield f"{function.__module__}.{function.__qualname__}"  # machine code names where it is from
            yield from _meaning(function.__code__, function.__globals__, seen)
        elif isinstance(value, tuple):
            yield from _of_values(name, value, seen)
        elif isinstance(value, _CONSTANTS):
            yield f"{name} {value!r}"
        elif isinstance(value, type):
            yield f"{value.__qualname__} {getattr(value, '_fields', ())}"
