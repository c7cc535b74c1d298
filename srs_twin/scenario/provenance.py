"""What decides the numbers of a run: scenario, files, sources, versions of packages, arithmetic.

The SHA-256 of all of it is the key under which a result is kept. What only names, shows or judges results is
left out.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin import __version__
from srs_twin.compute.arrays import blas_kernels, one_blas_thread
from srs_twin.extensions import CONTROLLERS, METRICS, SECTIONS, installed, module_of
from srs_twin.scenario.sections import input_files

NOT_PHYSICS = ("name", "title", "expect", "changes")
"""Keys of a scenario that name or judge results."""

_SHOWS = "srs_twin.viewing"
"""What only shows results: no row depends on it."""

_FOR_TYPES = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+.*\n|\n)+", re.M)
_IMPORT = re.compile(r"^\s*(?:from (srs_twin[\w.]*) import (\([^)]*\)|[^\n]*)|import (srs_twin[\w.]*))", re.M)


@cache
def versions() -> dict[str, str]:
    """Return the versions of the packages that decide a run's numbers, of Python, and `arithmetic`."""
    packages = ("mujoco", "dm-control", "numpy", "scipy", "numba")
    return {
        "srs_twin": __version__,
        **{name: metadata.version(name) for name in packages},
        "python": platform.python_version(),
        "arithmetic": arithmetic(),
    }


@cache
def arithmetic() -> str:
    """Return a name of the arithmetic that decides the last digits of results.

    It has three parts: the processor that kernels are compiled for (`NUMBA_CPU_NAME` sets another), the
    kernels of the BLAS libraries of NumPy and SciPy (`OPENBLAS_CORETYPE` sets others), and a digest of the
    processor's features and of values of the C library, NumPy and BLAS, which choose code by the processor.
    """
    from numba.core.registry import cpu_target

    _, processor, features = cpu_target.target_context.codegen().magic_tuple()
    x = np.linspace(-3.0, 3.0, 4001)
    functions = (math.sin, math.cos, math.tan, math.exp, math.atan, math.asinh, math.cbrt)
    values = [[function(each) for each in x.tolist()] for function in functions]
    values += [function(x).tolist() for function in (np.sin, np.cos, np.exp, np.arctan)]
    square = np.cos(np.arange(1600.0) ** 1.5).reshape(40, 40)
    with one_blas_thread():
        values += [(square @ square).tolist(), np.linalg.inv(square).tolist()]
        values += [np.linalg.eigvalsh(square).tolist()]
    digest = hashlib.sha256(repr((features, values)).encode()).hexdigest()[:8]
    return "-".join((processor, *blas_kernels(), digest))


def run_key(document: Mapping[str, Any], plants: Iterable[str], runner: str) -> str:
    """Return the key of a run.

    Args:
        document: plain data of the scenario, as `Scenario.document` holds them.
        plants: which run; none: the scenario is only planned.
        runner: module that runs it, dotted.
    """
    return digest_of(
        scenario={key: value for key, value in document.items() if key not in NOT_PHYSICS},
        plants=list(plants),
        files=list(file_digests(document).values()),
        sources=run_sources(document, runner),
        versions=versions(),
    )


def run_sources(document: Mapping[str, Any], runner: str) -> dict[str, str]:
    """Return module → digest of its source: of the runner, and of what the registry adds to the scenario."""
    sections = {name: entry for name, entry in SECTIONS.items() if document.get(name)}
    used = installed(METRICS) | installed(sections)
    controller = document.get("controller")
    if isinstance(controller, Mapping) and (entry := CONTROLLERS.get(str(controller.get("kind")))):
        used |= installed({"controller": entry})
    modules = [runner, *map(module_of, used.values())]
    return {name: digest for module in modules for name, digest in source_digests(module).items()}


def judged_digest(document: Mapping[str, Any]) -> str:
    """Return a digest of a scenario with its robot and the files that it reads.

    Laws, duration and seed do not count: whether they change a result is seen in its value.
    """
    skipped = (*NOT_PHYSICS, "duration_s", "seed")
    return digest_of(
        scenario={key: value for key, value in document.items() if key not in skipped},
        files=list(file_digests(document).values()),
    )


def digest_of(**parts: Any) -> str:
    """Return the SHA-256 of plain data, hex."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def file_digests(document: Mapping[str, Any]) -> dict[str, str]:
    """Return the files that a run reads besides its document → SHA-256 of their contents, hex.

    A robot is written out in the document; a footprint, a recording and its log stand there by name or path.
    The digest of a file that cannot be read is empty: the run will fail and say so.
    """
    return {path: _sha256(path) for path in _files(document)}


def _files(document: Mapping[str, Any]) -> Iterator[str]:
    start = document.get("start")
    if isinstance(start, Mapping) and start.get("from"):
        yield from (str(Path(start["from"]) / f"{plant}.parquet") for plant in document.get("plants", ()))
    world = document.get("world")
    if isinstance(world, Mapping):
        from srs_twin.scenario.map_file import pictures_of

        yield from (str(world[key]) for key in ("map", "circles") if world.get(key))
        yield from (str(each) for each in (pictures_of(Path(world["map"])) if world.get("map") else ()))
    yield from input_files(document)


def _sha256(path: str) -> str:
    try:
        about = os.stat(path)
        return _sha256_of(path, about.st_mtime_ns, about.st_ctime_ns, about.st_size)
    except (OSError, ValueError):
        return ""


@lru_cache(maxsize=64)
def _sha256_of(path: str, changed_ns: int, moved_ns: int, size: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@cache
def source_digests(module: str) -> dict[str, str]:
    """Return a module of this package and all that it imports → SHA-256 of the source, hex.

    Imports are read from the sources, those inside of functions too, those for type checkers not. Of a
    package that is only passed through, nothing counts.

    Args:
        module: its dotted name.
    """
    return dict(sorted(_closure(module, Path(__file__).resolve().parents[2])))


def _closure(module: str, root: Path) -> Iterator[tuple[str, str]]:
    to_read, seen = [module], set()
    while to_read:
        name = to_read.pop()
        if name in seen or name.startswith(_SHOWS) or (path := _source(root, name)) is None:
            continue
        seen.add(name)
        text = path.read_text("utf-8")
        yield name, hashlib.sha256(text.encode()).hexdigest()
        for package, names, whole in _IMPORT.findall(_FOR_TYPES.sub("", text)):
            to_read.append(package or whole)
            to_read += [f"{package}.{each}" for each in re.findall(r"\w+", names)]


def _source(root: Path, module: str) -> Path | None:
    place = root / module.replace(".", "/")
    return next((path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()), None)
