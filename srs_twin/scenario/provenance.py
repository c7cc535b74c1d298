"""Provenance of a run, which identifies everything that affects the results.

The provenance consists of the scenario, the input files, the source code, the package
versions and the processor arithmetic. Names, viewers and expectations are excluded.
"""

from __future__ import annotations

import ast
import hashlib
import math
import os
import platform
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache, lru_cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin import __version__
from srs_twin.compute.arrays import blas_kernels, one_blas_thread
from srs_twin.extensions import (
    CONTROLLERS,
    FORMATS,
    METRICS,
    SECTIONS,
    installed,
    module_of,
    owners,
    plugins,
    registered,
)
from srs_twin.io.provenance import Provenance
from srs_twin.scenario.fields import input_files
from srs_twin.scenario.parts import PARTS

NOT_PHYSICS = ("name", "title", "expect", "changes")
"""Scenario keys that name or judge results and do not affect a run."""

WORDS = ("title", "source", "status", "expected_failure", "reason")
"""Keys at any depth whose text explains a value and does not affect a run."""

_VIEWING = "srs_twin.viewing"
"""Package that only displays results and is therefore not part of the provenance."""

_TWO_WORDS = re.compile(r"[A-Za-z]{2,},? [A-Za-z]{2,}")

_TYPE_CHECKING_BLOCK = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+.*\n|\n)+", re.M)
_IMPORT = re.compile(
    r"^\s*(?:from (srs_twin[\w.]*) import (\([^)]*\)|[^\n]*)|import (srs_twin[\w.]*))",
    re.M,
)


@cache
def versions() -> dict[str, str]:
    """Return the package versions and the processor arithmetic that affect results."""
    packages = ("mujoco", "numpy", "scipy", "numba")
    return {
        "srs_twin": __version__,
        **{name: metadata.version(name) for name in packages},
        "python": platform.python_version(),
        "arithmetic": arithmetic(),
    }


@cache
def arithmetic() -> str:
    """Name the processor arithmetic, which affects the last digits of results.

    The first part of the name is the processor for which kernels are compiled
    (`NUMBA_CPU_NAME`). The second part names the BLAS kernels of NumPy and SciPy
    (`OPENBLAS_CORETYPE`). The third part is a digest of the processor features and of
    values computed by the C library, NumPy and BLAS, which run different code on
    different processors.
    """
    from numba.core.registry import cpu_target

    _, processor, features = cpu_target.target_context.codegen().magic_tuple()
    x = np.linspace(-3.0, 3.0, 4001)
    functions = (
        math.sin,
        math.cos,
        math.tan,
        math.exp,
        math.atan,
        math.asinh,
        math.cbrt,
    )
    values = [[function(value) for value in x.tolist()] for function in functions]
    values += [function(x).tolist() for function in (np.sin, np.cos, np.exp, np.arctan)]
    square = np.cos(np.arange(1600.0) ** 1.5).reshape(40, 40)
    with one_blas_thread():
        values += [(square @ square).tolist(), np.linalg.inv(square).tolist()]
        values += [np.linalg.eigvalsh(square).tolist()]
    digest = hashlib.sha256(repr((features, values)).encode()).hexdigest()[:8]
    return "-".join((processor, *blas_kernels(), digest))


def run_provenance(
    document: Mapping[str, object], plants: Iterable[str], runner: str
) -> Provenance:
    """Return the provenance of a run.

    Args:
        document: resolved scenario as plain data.
        plants: names of the simulated plants, empty if only a plan is computed.
        runner: dotted name of the module that runs the scenario.
    """
    scenario = {key: value for key, value in document.items() if key not in NOT_PHYSICS}
    return Provenance(
        {"scenario": scenario, "plants": list(plants)},
        files=file_digests(document),
        sources=run_sources(document, runner),
        versions=versions(),
    )


def run_sources(document: Mapping[str, object], runner: str) -> dict[str, str]:
    """Return the source digests of runner, extensions and plug-ins, keyed by module."""
    sections = {name: entry for name, entry in SECTIONS.items() if document.get(name)}
    used = installed(METRICS) | installed(sections)
    formats = {}
    if sections:  # extension sections may read recorded files
        used |= installed(FORMATS)
        formats = registered("format")
    controller = document.get("controller")
    if isinstance(controller, Mapping) and (
        entry := CONTROLLERS.get(str(controller.get("kind")))
    ):
        used |= installed({"controller": entry})
    modules = [runner, *map(module_of, used.values())]
    digests = {
        name: digest
        for module in modules
        for name, digest in source_digests(module).items()
    }
    outside = {*plugins(), *map(module_of, formats.values()), *_named_parts(document)}
    return digests | _plugin_digests(outside)


def _named_parts(document: Mapping[str, Any]) -> Iterator[str]:
    for key, kind in PARTS.items():
        name = (document.get(key) or {}).get("kind")
        if name is not None and name not in kind.known:
            entry = name if ":" in name else registered(key).get(name, "")
            yield module_of(entry)


def _plugin_digests(modules: Iterable[str]) -> dict[str, str]:
    digests: dict[str, str] = {}
    for package in {module.partition(".")[0] for module in modules} - {"", "__main__"}:
        spec = find_spec(package)
        digests[package] = file_digest(str(spec and spec.origin))
        for folder in map(Path, (spec and spec.submodule_search_locations) or ()):
            files = {
                path.relative_to(folder.parent): str(path)
                for path in folder.rglob("*.py")
            }
            digests |= {str(name): file_digest(path) for name, path in files.items()}
        if package in owners():
            digests[f"{package}, version"] = owners()[package].version
    return digests


def judged_provenance(document: Mapping[str, object]) -> Provenance:
    """Return the provenance that decides whether stored intervals are valid.

    The provenance consists of the scenario and the input files. Code, duration and seed
    are excluded, because changes to them show in the results. Explanatory texts are
    excluded, so that intervals remain valid if a text is reworded.
    """
    skipped = (*NOT_PHYSICS, "duration_s", "seed")
    judged = {key: value for key, value in document.items() if key not in skipped}
    return Provenance({"scenario": _without_words(judged)}, file_digests(document))


def _without_words(data: object) -> object:
    if isinstance(data, Mapping):
        return {
            key: _without_words(value)
            for key, value in data.items()
            if key not in WORDS
        }
    if isinstance(data, list | tuple):
        return [_without_words(item) for item in data]
    return data


def file_digests(document: Mapping[str, object]) -> dict[str, str]:
    """Return the hexadecimal SHA-256 of all input files of a run, keyed by path.

    Input files are earlier trajectories, maps, lists of circles and the files that
    extension sections read. The robot file is excluded, because the scenario document
    contains the robot. The digest of an unreadable file is empty.
    """
    return {path: file_digest(path) for path in _files(document)}


def _files(document: Mapping[str, Any]) -> Iterator[str]:
    start = document.get("start")
    if isinstance(start, Mapping) and start.get("from"):
        yield from (
            str(Path(start["from"]) / f"{plant}.parquet")
            for plant in document.get("plants", ())
        )
    world = document.get("world")
    if isinstance(world, Mapping):
        from srs_twin.scenario.map_file import pictures_of

        yield from (str(world[key]) for key in ("map", "circles") if world.get(key))
        if world.get("map"):
            yield from map(str, pictures_of(Path(world["map"])))
    yield from input_files(document)


def file_digest(path: str) -> str:
    """Return the hexadecimal SHA-256 of a file, or "" if the file is unreadable."""
    try:
        status = os.stat(path)
        return _sha256_of(path, status.st_mtime_ns, status.st_ctime_ns, status.st_size)
    except (OSError, ValueError):
        return ""


@lru_cache(maxsize=4096)
def _sha256_of(path: str, modified_ns: int, status_changed_ns: int, size: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@cache
def source_digests(module: str) -> dict[str, str]:
    """Return the hexadecimal SHA-256 of a module and its imports, keyed by module name.

    Only imports from this package are followed. Imports inside functions are included,
    but imports for type checkers are not. The ``__init__`` module of a subpackage is
    included only if the subpackage itself is imported.
    """
    return {
        name: hashlib.sha256(text.encode()).hexdigest()
        for name, text in sorted(_closure([module]))
    }


def code_digests(modules: Iterable[str]) -> dict[str, str]:
    """Return the hexadecimal SHA-256 of modules and their imports, ignoring wording.

    Unlike the digests of `source_digests`, these digests change only if results may
    change (see `code_digest`).

    Args:
        modules: dotted names of the modules.
    """
    return {name: code_digest(text) for name, text in sorted(_closure(modules))}


@cache
def code_digest(text: str) -> str:
    """Return the hexadecimal SHA-256 of Python code, ignoring wording.

    The digest does not depend on comments, docstrings, layout or strings that contain
    two successive words, such as messages and headings.
    """
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [part.value for part in node.values if _is_string(part)]  # type: ignore[attr-defined]
            if _is_wording("".join(parts)):
                node.values = []
        elif _is_string(node) and _is_wording(node.value):  # type: ignore[attr-defined]
            node.value = ""  # type: ignore[attr-defined]
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [item for item in body if not _is_text(item)] or [ast.Pass()]  # type: ignore[attr-defined]
    return hashlib.sha256(ast.unparse(tree).encode()).hexdigest()


def _is_wording(text: str) -> bool:
    return _TWO_WORDS.search(" ".join(text.split())) is not None


def _is_string(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and _is_string(node.value)


def _closure(modules: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield the name and source text of each module and of all its imports."""
    root = Path(__file__).resolve().parents[2]
    to_read = list(modules)
    seen = set()
    while to_read:
        name = to_read.pop()
        if (
            name in seen
            or name.startswith(_VIEWING)
            or (path := _source(root, name)) is None
        ):
            continue
        seen.add(name)
        text = path.read_text("utf-8")
        yield name, text
        for package, names, whole in _IMPORT.findall(
            _TYPE_CHECKING_BLOCK.sub("", text)
        ):
            to_read.append(package or whole)
            to_read += [f"{package}.{name}" for name in re.findall(r"\w+", names)]


def _source(root: Path, module: str) -> Path | None:
    place = root / module.replace(".", "/")
    return next(
        (
            path
            for path in (place.with_suffix(".py"), place / "__init__.py")
            if path.is_file()
        ),
        None,
    )
