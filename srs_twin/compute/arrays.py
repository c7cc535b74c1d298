"""Utilities for array checks, array concatenation and BLAS settings."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import ThreadpoolController

from srs_twin.errors import InputError

Array = NDArray[np.float64]

LARGEST_PLAUSIBLE = 1e9
"""Maximum plausible magnitude of any quantity in SI units, above the largest pressures
(1e7 Pa) and positions (1e6 m) of a snake."""

_BLAS_LOCK = threading.RLock()


def is_plausible(*quantities: float | np.ndarray) -> bool:
    """Return whether the magnitudes of all elements are below `LARGEST_PLAUSIBLE`."""
    # In almost all cases, the sum of squares is sufficient and takes half a microsecond
    # per array, without warnings.
    if sum(np.vdot(values, values) for values in quantities) < LARGEST_PLAUSIBLE**2:
        return True
    return all(first_implausible(values) is None for values in quantities)


def first_implausible(values: ArrayLike) -> float | None:
    """Return the first implausible element, or None if all elements are plausible."""
    flat = np.ravel(values)
    wrong = flat[~(np.abs(flat) < LARGEST_PLAUSIBLE)]
    if len(wrong):
        return float(wrong[0])
    return None


def check_positive(name: str, value: ArrayLike, unit: str = "") -> None:
    """Check that a number, or every element of an array, is finite and above 0.

    The error message contains the name and the unit.
    """
    if not (np.isfinite(value).all() and (np.asarray(value) > 0).all()):
        shown = f"{value!r} {unit}".strip()
        raise InputError(
            f"{name} {shown} is not allowed; it must be finite and above 0"
        )


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread in a `with` block, so that results are reproducible.

    OpenBLAS splits sums between its threads, which changes the last digits of matrix
    products for matrices larger than about 100 × 100. The limit applies to the whole
    process, so a lock admits only one Python thread at a time to such a block.
    """
    with _BLAS_LOCK, ThreadpoolController().limit(limits=1, user_api="blas"):
        yield


def blas_kernels() -> tuple[str, ...]:
    """Return the names of the BLAS kernels of NumPy and SciPy, such as `SkylakeX`."""
    import scipy.linalg  # noqa: F401  loads SciPy's own BLAS library

    packages = Path(np.__file__).parents[1]
    kernels = set()
    for library in ThreadpoolController().select(user_api="blas").info():
        path = Path(library["filepath"])
        if path.is_relative_to(packages):
            package = path.relative_to(packages).parts[0]
        else:
            package = ""
        if package.partition(".")[0] in ("", "numpy", "scipy") and library.get(
            "architecture"
        ):
            kernels.add(library["architecture"])
    return tuple(sorted(kernels))


Record = TypeVar("Record")


def concatenate_records(records: Sequence[Record]) -> Record:
    """Concatenate named tuples or dataclasses of arrays along the first axis (samples).

    A single record is returned without a copy.
    """
    if len(records) == 1:
        return records[0]
    kind: Any = type(records[0])
    rows: Any = records
    if not issubclass(kind, tuple):
        rows = [vars(record).values() for record in records]
    whole: Record = kind(*map(np.concatenate, zip(*rows, strict=True)))
    return whole
