"""Numba compilation with a disk cache that detects changes in inlined functions."""

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

from numba import njit, typeof
from numba.core.caching import FunctionCache
from numba.extending import overload

from srs_twin.errors import CacheWarning

Function = Callable[..., Any]

# Allowed optimisations: they may change the order of sums, but not the treatment of infinities and NaN.
_FASTMATH = {"contract", "reassoc", "arcp", "nsz"}
_OPTIONS: Any = {
    "nogil": True,
    "error_model": "numpy",
    "forceinline": True,
    "fastmath": _FASTMATH,
    "no_cfunc_wrapper": True,  # no kernel is called from C
}
# Disable reference counts, which take most of a small kernel's time; a kernel that creates no arrays does not
# need them.
_NO_REFCOUNTS: Any = {"_nrt": False}
_NO_WRAPPER: Any = {"no_cpython_wrapper": True}
_CONSTANT_TYPES = (bool, int, float, complex, str, type(None))
_warned = False
_notices: list[Callable[[], None]] = []
"""At most one function, which is called before the first compilation."""


def notify_first_compilation(notice: Callable[[], None]) -> None:
    """Call a function once, before this process compiles a kernel for the first time."""
    _notices[:] = [notice]


def compiled(function: Function) -> Function:
    """Compile a function that creates no arrays, on its first call, and cache the machine code on disk.

    The kernel runs without the interpreter's lock.

    Numba's own cache is valid as long as the source file of the function is unchanged. It does not detect
    changes in inlined functions from other files, such as a corrected friction law. Here the cache is valid
    as long as a digest of the bytecode of the function, of every kernel that it calls and of their constants
    is unchanged. Without a writable cache folder every process compiles its kernels, with one `CacheWarning`.
    """
    return _with_cache(njit(**_OPTIONS, **_NO_REFCOUNTS)(function), function)


def allocating(function: Function) -> Function:
    """Compile a function that creates arrays; otherwise as `compiled`."""
    return _with_cache(njit(**_OPTIONS)(function), function)


def kernel_only(function: Function) -> Function:
    """Compile a function that only kernels call, without a wrapper for calls from Python.

    The wrapper of a function with records of arrays as arguments takes longer to compile than the function.
    """
    return _with_cache(njit(**_OPTIONS, **_NO_REFCOUNTS, **_NO_WRAPPER)(function), function)


def compiled_if(condition: Callable[..., bool], otherwise: float | None = None) -> Function:
    """Return a decorator that compiles a function of four arguments, as `kernel_only`, where it is needed.

    Args:
        condition: decides on the numba type of the first argument. If false, the call is compiled to nothing.
        otherwise: number that such a call returns.
    """

    def decorate(function: Function) -> Function:
        kernel = kernel_only(function)

        def call(a, b, c, d):  # type: ignore[no-untyped-def]
            return kernel(a, b, c, d) if condition(typeof(a)) else otherwise

        @overload(call, jit_options={"forceinline": True, **_NO_REFCOUNTS, **_NO_WRAPPER})
        def choose(a, b, c, d):  # type: ignore[no-untyped-def]
            if condition(a):
                return lambda a, b, c, d: kernel(a, b, c, d)
            return lambda a, b, c, d: otherwise

        call.py_func = function  # type: ignore[attr-defined]  # for the digest of callers, and for Warp
        return call

    return decorate


def _with_cache(dispatcher: Any, function: Function) -> Function:
    """Attach a cache to a dispatcher."""
    try:
        dispatcher._cache = _Cache(function)
    except RuntimeError:  # numba found no writable folder
        _warn("no cache folder is writable")
    kernel: Function = dispatcher
    return kernel


class _Cache(FunctionCache):
    """Cache of one function that is disabled if its folder cannot be used.

    The cache files are pickles, which can execute code. A folder that other users can write to is not used.
    """

    def load_overload(self, sig: object, target_context: object) -> Any:
        """Return the cached machine code for a signature, or None.

        The digest is computed here, at the first call, because all names that the function uses exist then.
        """
        self._cache_file._source_stamp = _source_stamp(self._py_func)
        if (reason := _why_unsafe(Path(self._cache_path))) is not None:
            _warn(reason, "that only you can write to")
            self.disable()
        overload = super().load_overload(sig, target_context)
        if overload is None and _notices:
            _notices.pop()()
        return overload

    @contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:
        """Continue without the cache after errors that numba would raise."""
        try:
            yield
        except OSError as error:
            _warn(f"{self._cache_path}: {error.strerror}")
        except (ReferenceError, AttributeError, ModuleNotFoundError):
            # The index refers to a kernel that was an argument in another process, or to a function that has
            # since been removed; start a new index.
            self._cache_file.flush()
        except (EOFError, pickle.UnpicklingError, ImportError):
            _warn(f"{self._cache_path}: a damaged file; remove the folder")


def _why_unsafe(folder: Path) -> str | None:
    """Return the reason that other users can write to a folder; None if they cannot or it does not exist."""
    if not hasattr(os, "getuid"):
        return None
    for path in (folder, folder.parent):
        try:
            status = path.stat()
        except OSError:
            continue
        if status.st_uid not in (os.getuid(), 0):
            return f"{path} belongs to another user"
        # In a folder with the sticky bit, such as /tmp, only the owner can replace a file.
        sticky = path != folder and status.st_mode & stat.S_ISVTX
        if status.st_mode & stat.S_IWOTH and not sticky:
            return f"{path} can be written by all users"
    return None


def _warn(reason: str, requirement: str = "that you can write to") -> None:
    """Warn once per process, because further kernels would fail for the same reason."""
    global _warned
    if not _warned:
        _warned = True
        problem = f"compiled kernels cannot be cached, so every start compiles them again ({reason})"
        remedy = f"set NUMBA_CACHE_DIR to a folder {requirement}"
        warnings.warn(f"{problem}; {remedy}", CacheWarning, stacklevel=1)


@functools.cache
def _source_stamp(function: FunctionType) -> str:
    """Return a digest of the computation of a function; comments and docstrings do not change it."""
    digest = hashlib.sha256(f"{function.__module__} {sorted(_FASTMATH)} {sorted(_NO_REFCOUNTS)}".encode())
    for text in _code_parts(function.__code__, function.__globals__, set()):
        digest.update(text.encode() + b"\0")
    return digest.hexdigest()


def _code_parts(code: CodeType, names: Mapping[str, object], seen: set[CodeType]) -> Iterator[str]:
    """Yield the bytecode of a function and the values of its names, recursively for called functions."""
    if code in seen:
        return
    seen.add(code)
    yield f"{code.co_code!r} {code.co_names} {code.co_varnames} {code.co_argcount}"
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code_parts(constant, names, seen)
        elif not isinstance(constant, str):  # strings are docstrings
            yield repr(constant)
    for name in code.co_names:
        value = names.get(name)
        if isinstance(value, ModuleType) and value.__name__.startswith("srs_twin"):
            yield from _value_parts(name, [vars(value).get(attribute) for attribute in code.co_names], seen)
        else:
            yield from _value_parts(name, [value], seen)


def _value_parts(name: str, values: Iterable[object], seen: set[CodeType]) -> Iterator[str]:
    """Yield the values of a name as text; for functions the same as `_code_parts`."""
    for value in values:
        function = getattr(value, "py_func", value)
        if isinstance(function, FunctionType):
            yield f"{function.__module__}.{function.__qualname__}"  # machine code contains this name
            yield from _code_parts(function.__code__, function.__globals__, seen)
        elif isinstance(value, tuple):
            yield from _value_parts(name, value, seen)
        elif isinstance(value, _CONSTANT_TYPES):
            yield f"{name} {value!r}"
        elif isinstance(value, type):
            yield f"{value.__qualname__} {getattr(value, '_fields', ())}"
