"""compiled: numba's njit with a cache that knows every source that a kernel may have inlined."""

from __future__ import annotations

import functools
import hashlib
import pickle
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache

from srs_twin.errors import CacheWarning

# The order of sums may change, never what becomes of infinities and NaN.
_ARITHMETIC = {"contract", "reassoc", "arcp", "nsz"}
# What kernels are made of: the planner's of its own sources, all others of the models'.
_PLANNING = ("compiled.py", "planning")
_MODELS = ("spec.py", "shape.py", "friction.py", "compiled.py", "pneumatics", "plants")
_warned = False


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function on its first call, free of the interpreter's lock, and keep the machine code.

    numba keeps one file of machine code a function and drops it when the function's own source file has
    changed. What the function inlined from other files it does not look at: a corrected friction law would
    go on unused in the kernels. So the stamp that decides is that of all sources kernels are made of.
    Where nothing can be kept, every process compiles for itself, with one `CacheWarning`.
    """
    options: Any = {"nogil": True, "error_model": "numpy", "forceinline": True}
    dispatcher: Any = njit(fastmath=_ARITHMETIC, **options)(function)
    planner = function.__module__.startswith("srs_twin.planning.")
    try:
        dispatcher._cache = _Cache(function, _stamp(_PLANNING if planner else _MODELS))
    except RuntimeError:  # numba knows no folder that it may write
        _warn("no folder for it can be written")
    kernel: Callable[..., Any] = dispatcher
    return kernel


class _Cache(FunctionCache):
    """numba's cache of one function, which does without its folder where that fails."""

    def __init__(self, function: Callable[..., Any], stamp: str) -> None:
        super().__init__(function)
        self._cache_file._source_stamp = stamp

    @contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:
        """Go on without what cannot be loaded or saved; numba's own lets these errors through."""
        try:
            yield
        except OSError as error:
            _warn(f"{self._cache_path}: {error.strerror}")
        except (EOFError, pickle.UnpicklingError):
            _warn(f"{self._cache_path}: a damaged file; remove the folder")


def _warn(why: str) -> None:
    """Warn once a process: the next kernel would fail for the same reason."""
    global _warned
    if not _warned:
        _warned = True
        said = f"machine code cannot be kept, every start compiles anew ({why})"
        remedy = "set NUMBA_CACHE_DIR to a folder that can be written"
        warnings.warn(f"{said}; {remedy}", CacheWarning, stacklevel=1)


@functools.cache
def _stamp(sources: tuple[str, ...]) -> str:
    """Return what changes with the contents of any source that kernels are made of.

    Contents, not times: a fresh checkout of the same sources may use what an earlier one compiled.
    """
    root, total = Path(__file__).parent, hashlib.sha256()
    for path in sorted(path for name in sources for path in _python(root / name)):
        total.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return total.hexdigest()


def _python(path: Path) -> list[Path]:
    return list(path.glob("*.py")) if path.is_dir() else [path] if path.is_file() else []
