"""Digests of the code and the files that decide the result of a study.

The code consists of the script, the helper modules of benchmarks/ and tests/, and the
modules of the package that these import, directly or through other modules. Comments,
docstrings and layout do not count. Shipped robots and scenarios count if a script or a
helper has their names as texts, together with the modules that a scenario uses through
the registry.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import yaml
from common.studies import BENCHMARKS

import srs_twin
from srs_twin import load_robot, load_scenario
from srs_twin.io.files import shipped_names
from srs_twin.scenario.provenance import (
    code_digest,
    code_digests,
    judged_provenance,
    run_sources,
)

HELPERS = (
    BENCHMARKS,
    *(BENCHMARKS.parent / "tests" / name for name in ("helpers", "live", "hostile")),
)
"""Folders from which scripts import modules that are not part of the package."""

LENGTH = 12
"""Hexadecimal digits of a stored digest."""

_HOMES: dict[str, str] = vars(srs_twin)["_homes"]


def digests(script: Path, inputs: Iterable[str] = ()) -> dict[str, str]:
    """Return the digests of all that decides the result of a study, by name.

    Args:
        script: script of the study.
        inputs: patterns of YAML files, relative to the checkout, whose content counts.
    """
    result: dict[str, str] = {}
    modules: set[str] = set()
    texts: set[str] = set()
    for path in _local(script):
        source = path.read_text("utf-8")
        result[path.relative_to(BENCHMARKS.parent).as_posix()] = code_digest(source)
        tree = ast.parse(source)
        modules |= set(_package_modules(tree))
        texts |= {
            node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
    for name in texts & set(shipped_names("scenario")):
        document = load_scenario(name).document
        modules |= run_sources(document, "srs_twin.experiment").keys()
        result[f"scenario {name}"] = judged_provenance(document).key
    for name in texts & set(shipped_names("robot")):
        text = repr(load_robot(name))
        result[f"robot {name}"] = hashlib.sha256(text.encode()).hexdigest()
    for path in (path for item in inputs for path in BENCHMARKS.parent.glob(item)):
        data = json.dumps(yaml.safe_load(path.read_text("utf-8")), default=str)
        place = path.relative_to(BENCHMARKS.parent).as_posix()
        result[place] = hashlib.sha256(data.encode()).hexdigest()
    # The __init__ of the package has only the version and lazy imports.
    modules.discard("srs_twin")
    result |= code_digests(modules)
    result.pop("srs_twin", None)
    return {name: result[name][:LENGTH] for name in sorted(result)}


def _imports(tree: ast.Module) -> Iterator[str]:
    """Yield the dotted names of imported modules, and of names that may be modules."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _local(script: Path) -> Iterator[Path]:
    """Yield a script and the helper modules that it imports, directly or not."""
    to_read = [script]
    seen: set[Path] = set()
    while to_read:
        path = to_read.pop()
        if path in seen:
            continue
        seen.add(path)
        yield path
        for name in _imports(ast.parse(path.read_text("utf-8"))):
            places = (f / f"{name.replace('.', '/')}.py" for f in HELPERS)
            to_read += [place for place in places if place.is_file()]


def _package_modules(tree: ast.Module) -> Iterator[str]:
    """Yield the modules of the package that code imports, also by the names that it exports."""
    for name in _imports(tree):
        if name == "srs_twin" or name.startswith("srs_twin."):
            yield _HOMES.get(name.removeprefix("srs_twin."), name)
