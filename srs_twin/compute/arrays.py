"""Numbers of a simulation: whether they are finite and possible, and records of arrays joined."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from threadpoolctl import ThreadpoolController

from srs_twin.errors import InputError

LARGEST = 1e9
"""Nothing of a snake comes near it in SI units: pressures reach 1e7 Pa, places 1e6 m."""
_BLAS_THREADS = threading.RLock()


def plausible(*quantities: Any) -> bool:
    """Say whether all numbers of some arrays are finite and smaller than `LARGEST`."""
    # The sum of squares tells almost always: half a microsecond an array, and no warning.
    if sum(np.vdot(each, each) for each in quantities) < LARGEST**2:
        return True
    return all(implausible(each) is None for each in quantities)


def implausible(values: Any) -> float | None:
    """Return the first number that is not `plausible`, or None where all are."""
    flat = np.ravel(values)
    wrong = flat[~(np.abs(flat) < LARGEST)]
    return float(wrong[0]) if len(wrong) else None


def check_positive(what: str, value: Any, unit: str = "") -> None:
    """Refuse a number, or an array with one, that is not finite and above 0.

    Args:
        what: its name.
        value: number or array.
        unit: for the message.

    Raises:
        InputError: it is not.
    """
    if not (np.isfinite(value).all() and (np.asarray(value) > 0).all()):
        shown = f"{value!r} {unit}".strip()
        raise InputError(f"{what} {shown} is not allowed; it must be finite and above 0")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS compute in one thread within a `with` block.

    OpenBLAS splits sums between its threads, so the last digits of a product of matrices larger than about
    100 x 100 depend on their number. The number of threads belongs to the process: blocks in several Python
    threads run one after another, so that the first to leave does not end the limit of the others.
    """
    with _BLAS_THREADS, ThreadpoolController().limit(limits=1, user_api="blas"):
        yield


def blas_kernels() -> tuple[str, ...]:
    """Return the names of the kernels of NumPy's and SciPy's BLAS libraries, such as `SkylakeX`, sorted.

    It is empty where no library reports one. Libraries that other packages bring (OpenCV) do not count.
    """
    import scipy.linalg  # noqa: F401  SciPy brings a second BLAS library

    packages = Path(np.__file__).parents[1]
    kernels = set()
    for library in ThreadpoolController().select(user_api="blas").info():
        place = Path(library["filepath"])
        inside = place.relative_to(packages).parts[0] if place.is_relative_to(packages) else ""
        if inside.partition(".")[0] in ("", "numpy", "scipy") and library.get("architecture"):
            kernels.add(library["architecture"])
    return tuple(sorted(kernels))


Record = TypeVar("Record")


def joined(parts: Sequence[Record]) -> Record:
    """Return several records of one kind, one after the other, as one.

    Args:
        parts: one or more; like fields have like shapes but for the samples. One alone is returned itself.
    """
    if len(parts) == 1:
        return parts[0]
    kind: Any = type(parts[0])
    names = kind._fields if issubclass(kind, tuple) else [each.name for each in fields(kind)]
    return kind(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
