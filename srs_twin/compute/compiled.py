"""Numba compilation with a disk cache that detects changes in inlined functions.

By default, Numba generates machine code for every function, and optimises each function
again in all its callers. In this module, the functions called by a kernel are *parts*
of the kernel (`_PartLibrary`), and machine code is generated only for the whole kernel.
Only functions that are called from Python have a Python wrapper and a cache on disk.
"""

# ruff: noqa: SLF001 - caches and code libraries of numba have no public names
from __future__ import annotations

import functools
import hashlib
import inspect
import os
import pickle
import stat
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite.binding as llvm
from numba import njit, typeof, types
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.cpu import CPUContext
from numba.core.typing.context import BaseContext
from numba.extending import lower_builtin, overload, type_callable

from srs_twin.errors import CacheWarning

Function = Callable[..., Any]

# These optimisations may reorder sums, but they preserve infinities and NaN.
_FASTMATH = {"contract", "reassoc", "arcp", "nsz"}
_OPTIONS: Any = {
    "nogil": True,
    "error_model": "numpy",
    "forceinline": True,
    "fastmath": _FASTMATH,
    "no_cfunc_wrapper": True,  # no kernel is called from C
}
# Counting references takes most of the run time of a small kernel. A kernel that
# creates no arrays does not need reference counts.
_NO_REFCOUNTS: Any = {"_nrt": False}
_CONSTANT_TYPES = (bool, int, float, complex, str, type(None))
_warned: list[str] = []
"""Reason for the cache warning that this process has issued, if any."""
_notices: list[Callable[[], None]] = []
"""Function that is called before the first compilation, if any."""


def notify_first_compilation(notice: Callable[[], None]) -> None:
    """Set a function that is called before this process compiles its first kernel."""
    _notices[:] = [notice]


class _PartLibrary(JITCodeLibrary):
    """Library that keeps a kernel part in LLVM intermediate representation."""

    def finalize(self) -> None:
        """Declare the global variables that Numba sets, without generating code."""
        self._raise_if_finalized()
        names = [variable.name for variable in self._final_module.global_variables]
        lines = [
            f"@{name} = common global ptr null"
            for name in names
            if name.startswith("_ZN08NumbaEnv")
        ]
        self._stub = llvm.parse_assembly("\n".join(lines))
        self._codegen._add_module(self._stub)
        self._codegen._engine.finalize_object()
        self._finalized = True

    def _get_module_for_linking(self) -> llvm.ModuleRef:
        self._ensure_finalized()
        if self._shared_module is None:
            module = self._final_module.clone()
            libraries: dict[JITCodeLibrary, None] = {}
            self._collect(libraries)
            for library in list(libraries)[1:]:
                is_part = isinstance(library, _PartLibrary)
                if is_part:
                    code = library._final_module
                else:
                    code = library._get_module_for_linking()
                module.link_in(code, preserve=True)
            for function in module.functions:
                if (
                    not function.is_declaration
                    and function.linkage == llvm.Linkage.external
                ):
                    # Several kernels may contain this function.
                    function.linkage = "linkonce_odr"
            self._shared_module = module
        return self._shared_module

    def _collect(self, libraries: dict[JITCodeLibrary, None]) -> None:
        if self in libraries:
            return
        libraries[self] = None
        for library in self._linking_libraries:
            if isinstance(library, _PartLibrary):
                library._collect(libraries)
            else:
                libraries[library] = None


class _PartCompiler(Compiler):
    """Numba compiler that stores its result in a `_PartLibrary`."""

    def __init__(
        self,
        typing_context: object,
        target_context: CPUContext,
        _: object,
        *rest: object,
    ) -> None:
        library = _PartLibrary(target_context.codegen(), "part")
        super().__init__(typing_context, target_context, library, *rest)  # type: ignore[no-untyped-call]  # numba has no types


# For functions whose arguments are records of arrays, compiling the Python wrapper
# would take longer than compiling the function.
_PART_OPTIONS = _OPTIONS | {
    "no_cpython_wrapper": True,
    "pipeline_class": _PartCompiler,
}


class Kernel:
    """Compiled function that Python and other kernels can call.

    Attributes:
        entry: Numba dispatcher for calls from Python.
        part: Numba dispatcher for calls from other kernels.
        py_func: original Python function.
    """

    def __init__(self, function: Function, options: Mapping[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self.entry = _with_cache(njit(**_OPTIONS, **options)(function), function)
        self.part = njit(**_PART_OPTIONS, **options)(function)

    def __call__(self, *arguments: object) -> Any:
        """Call the function from Python."""
        return self.entry(*arguments)

    @property
    def _numba_type_(self) -> Any:
        """Numba type of the kernel inside other kernels."""
        return self.part._numba_type_


def compiled(function: Function) -> Kernel:
    """Compile a function that creates no arrays, and cache its machine code on disk.

    The function is compiled on its first call, and releases the global interpreter lock
    while it runs.

    Numba's own cache does not detect changes in inlined functions from other files. The
    cache used here is therefore keyed by a digest of the bytecode and constants of the
    function and its callees. If no cache folder is writable, every process compiles its
    kernels and issues one `CacheWarning`.
    """
    return Kernel(function, _NO_REFCOUNTS)


def allocating(function: Function) -> Kernel:
    """Compile a function that creates arrays, with a disk cache as in `compiled`."""
    return Kernel(function, {})


def kernel_only(function: Function) -> Function:
    """Compile a function that is called only by kernels."""
    part: Function = njit(**_PART_OPTIONS, **_NO_REFCOUNTS)(function)
    return part


def inlined(function: Function) -> Function:
    """Compile a function that is copied into the calling kernels before optimisation.

    The order of sums then does not depend on how a kernel is divided into functions.
    """
    part: Function = njit(**_PART_OPTIONS, **_NO_REFCOUNTS, inline="always")(function)
    return part


# These functions return no arrays, so they need no reference counts.
overload_part: Function = functools.partial(
    overload, jit_options=_PART_OPTIONS | _NO_REFCOUNTS
)
"""Decorator like `numba.extending.overload`, for functions called only by kernels."""


def is_given(kind: types.Type) -> bool:
    """Return whether an argument of this Numba type is not None."""
    return not isinstance(kind, types.NoneType)


def compiled_if(condition: Callable[[Any], bool], otherwise: object = None) -> Function:
    """Return a decorator like `kernel_only` that skips calls if a condition is false.

    The condition is evaluated for the Numba type of the first argument. If it is false,
    the call generates no code and returns `otherwise`.
    """

    def decorate(function: Function) -> Function:
        kernel: Any = kernel_only(function)

        def call(*arguments: object) -> None:
            raise NotImplementedError(
                f"{function.__name__} must be called from a kernel"
            )

        @type_callable(call)
        def infer(context: BaseContext) -> Function:
            def result(*arguments: types.Type) -> types.Type:
                kind: types.Type = typeof(otherwise)
                if condition(arguments[0]):
                    kind = context.resolve_function_type(
                        kernel._numba_type_, arguments, {}
                    ).return_type
                return kind

            result.pysig = inspect.signature(function)  # type: ignore[attr-defined]  # names of the arguments
            return result

        def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            if not condition(signature.args[0]):
                return context.get_constant_generic(
                    builder, signature.return_type, otherwise
                )
            called = context.typing_context.resolve_function_type(
                kernel._numba_type_, signature.args, {}
            )
            return context.get_function(kernel._numba_type_, called)(builder, values)

        lower_builtin(call, types.VarArg(types.Any))(lower)
        call.py_func = function  # type: ignore[attr-defined]  # for the digest of callers, and for Warp
        return call

    return decorate


def _with_cache(dispatcher: Any, function: Function) -> Function:
    try:
        dispatcher._cache = _Cache(function)
    except RuntimeError:  # Numba found no writable folder
        _warn("no writable cache folder exists")
    kernel: Function = dispatcher
    return kernel


class _Cache(FunctionCache):
    """Disk cache of one function.

    The cache is disabled if other users can write to its folder, because cache files
    are pickles, which can execute code.
    """

    def load_overload(self, sig: object, target_context: object) -> object:
        # The digest is computed here, because all names that the function uses are
        # defined when the function is called for the first time.
        self._cache_file._source_stamp = _source_stamp(self._py_func)
        if (reason := _why_unsafe(Path(self._cache_path))) is not None:
            _warn(reason, "that only you can write to")
            self.disable()
        overload = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]  # numba has no types
        if overload is None and _notices:
            _notices.pop()()
        return overload

    @contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:
        """Ignore errors of the cache, so that the compilation continues without it."""
        try:
            yield
        except OSError as error:
            _warn(f"{self._cache_path}: {error.strerror}")
        except (ReferenceError, AttributeError, ModuleNotFoundError):
            # The cache index refers to a kernel from another process, or to a function
            # that no longer exists. It is replaced by an empty index.
            self._cache_file.flush()
        except (EOFError, pickle.UnpicklingError, ImportError):
            _warn(f"a file in {self._cache_path} is damaged; remove this folder")


def _why_unsafe(folder: Path) -> str | None:
    """Return why other users can write to a folder, or None if they cannot."""
    if not hasattr(os, "getuid"):
        return None
    for path in (folder, folder.parent):
        try:
            status = path.stat()
        except OSError:
            continue
        if status.st_uid not in (os.getuid(), 0):
            return f"{path} belongs to another user"
        # In a folder with the sticky bit, such as /tmp, users can only replace their
        # own files.
        sticky = path != folder and status.st_mode & stat.S_ISVTX
        if status.st_mode & stat.S_IWOTH and not sticky:
            return f"{path} is writable by all users"
        if (
            status.st_mode & stat.S_IWGRP
            and not sticky
            and not _is_own_group(status.st_gid)
        ):
            return f"{path} is writable by its group (to change this, use chmod g-w)"
    return None


def _is_own_group(number: int) -> bool:
    """Return whether a group contains only the current user."""
    import grp
    import pwd

    try:
        user = pwd.getpwuid(os.getuid()).pw_name
        group = grp.getgrgid(number)
    except KeyError:
        return False
    return group.gr_name == user and set(group.gr_mem) <= {user}


def _warn(reason: str, requirement: str = "that you can write to") -> None:
    """Issue one warning per process, because all kernels fail for the same reason."""
    if _warned:
        return
    _warned.append(reason)
    warnings.warn(
        "compiled kernels cannot be cached, so every start compiles them again"
        f" ({reason}); set the environment variable NUMBA_CACHE_DIR to a folder"
        f" {requirement}",
        CacheWarning,
        stacklevel=1,
    )


@functools.cache
def _source_stamp(function: FunctionType) -> str:
    """Return a digest of a function that ignores comments and docstrings."""
    digest = hashlib.sha256(
        f"{function.__module__} {sorted(_FASTMATH)} {sorted(_NO_REFCOUNTS)}".encode()
    )
    for text in _code_parts(function.__code__, function.__globals__, set()):
        digest.update(text.encode() + b"\0")
    return digest.hexdigest()


def _code_parts(
    code: CodeType, names: Mapping[str, object], seen: set[CodeType]
) -> Iterator[str]:
    """Yield the bytecode and constants of a function and all functions it calls."""
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
            yield from _value_parts(
                name, [vars(value).get(attribute) for attribute in code.co_names], seen
            )
        else:
            yield from _value_parts(name, [value], seen)


def _value_parts(
    name: str, values: Iterable[object], seen: set[CodeType]
) -> Iterator[str]:
    for value in values:
        function = getattr(value, "py_func", value)
        if isinstance(function, FunctionType):
            yield (  # the machine code contains this name
                f"{function.__module__}.{function.__qualname__}"
            )
            yield from _code_parts(function.__code__, function.__globals__, seen)
        elif isinstance(value, tuple):
            yield from _value_parts(name, value, seen)
        elif isinstance(value, _CONSTANT_TYPES):
            yield f"{name} {value!r}"
        elif isinstance(value, type):
            yield f"{value.__qualname__} {getattr(value, '_fields', ())}"
