"""compiled: numba's njit with a cache that knows every source that a kernel may have inlined."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

# The order of sums may change, never what becomes of infinities and NaN.
_ARITHMETIC = {"contract", "reassoc", "arcp", "nsz"}
# What kernels are made of: the planner's of its own sources, all others of the models'.
_PLANNING = ("compiled.py", "planning")
_MODELS = ("spec.py", "shape.py", "friction.py", "compiled.py", "pneumatics", "plants")


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function on its first call, free of the interpreter's lock, and keep the machine code.

    numba keeps one file of machine code a function and drops it when the function's own source file has
    changed. What the function inlined from other files it does not look at: a corrected friction law would
    go on unused in the kernels. So the stamp that decides is that of all sources kernels are made of.
    """
    options: Any = {"cache": True, "nogil": True, "error_model": "numpy", "forceinline": True}
    dispatcher: Any = njit(fastmath=_ARITHMETIC, **options)(function)
    planner = function.__module__.startswith("srs_twin.planning.")
    dispatcher._cache._cache_file._source_stamp = _stamp(_PLANNING if planner else _MODELS)
    kernel: Callable[..., Any] = dispatcher
    return kernel


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
