"""Who may import whom. Every import in the sources counts, inside functions and for types too."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

pytestmark = pytest.mark.fast

PACKAGE = Path(__file__).parents[1] / "srs_twin"

# From left to right; a room imports only from itself or from rooms to its left.
ORDER = (
    *(
        "errors",
        "extensions",
        "compiled",
        "arrays",
        "io",
        "memory",
        "parallel",
        "robot",
        "geometry",
        "friction",
        "friction_held",
        "world",
        "trajectory",
    ),
    *("pneumatics", "sensing", "mjcf", "planning", "plants", "control", "rollout", "comparison"),
    *(
        "recordings",
        "identification",
        "scenario",
        "provenance",
        "live",
        "viewing",
        "experiment",
        "attribution",
        "sweep",
        "uncertainty",
        "optimization",
    ),
    *("reproduction", "envs", "doctor", "cli"),
)
STEP = {name: i for i, name in enumerate(ORDER)}

# What is heavy or swaps out one day, and the only parts of the package that may know of it.
RESERVED = {
    "mujoco": {"mjcf", "plants", "envs", "viewing", "identification"},
    "dm_control": {"mjcf", "plants", "envs", "viewing", "identification"},
    "gymnasium": {"envs"},
    "rerun": {"viewing"},
    "ray": {"sweep"},
    "warp": {"plants"},
    "mujoco_warp": {"plants"},
    "paho": {"live"},
}

SOURCES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def part_of(path: Path) -> str:
    """Return the name in ORDER that a source file belongs to: its folder or its own name."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(tree: ast.AST, package: tuple[str, ...] = ("srs_twin",)) -> Iterator[tuple[int, str]]:
    """Yield (line, dotted name) of everything a source imports; relative names are made absolute."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = list(package[: len(package) - node.level + 1]) if node.level else []
            stem = ".".join(base + ([node.module] if node.module else []))
            # `from srs_twin import errors` names the part only in what it imports.
            if stem == "srs_twin":
                yield from ((node.lineno, f"srs_twin.{alias.name}") for alias in node.names)
            else:
                yield node.lineno, stem


def faults(part: str, tree: ast.AST, package: tuple[str, ...] = ("srs_twin",)) -> list[str]:
    """Return what a source of a part imports against the rules, as 'line: what'."""
    found = []
    for line, name in imports(tree, package):
        top, _, rest = name.partition(".")
        if top in RESERVED and part not in RESERVED[top]:
            found.append(f"{line}: {top} belongs to {', '.join(sorted(RESERVED[top]))} only")
        if top == "srs_twin":
            other = rest.partition(".")[0]
            if other in STEP and STEP[other] > STEP[part]:
                found.append(f"{line}: {part} stands left of {other}")
    return found


def test_imports_only_from_the_left():
    wrong = []
    for path in SOURCES:
        part = part_of(path)
        assert part in STEP, f"{part}: give it a place in ORDER and in the docs"
        package = ("srs_twin", *path.relative_to(PACKAGE).parts[:-1])
        found = faults(part, ast.parse(path.read_text("utf-8")), package)
        wrong += [f"{path.relative_to(PACKAGE)}:{fault}" for fault in found]
    assert wrong == []


def test_the_package_itself_imports_none_of_its_parts():
    tree = ast.parse((PACKAGE / "__init__.py").read_text("utf-8"))
    assert [name for _, name in imports(tree) if name.startswith("srs_twin")] == []


@pytest.mark.parametrize(
    ("part", "source", "words"),
    [
        ("robot", "from srs_twin.plants import base", "robot stands left of plants"),
        ("robot", "def f():\n    import srs_twin.cli.app", "2: robot stands left of cli"),
        ("io", "from srs_twin import rollout", "io stands left of rollout"),
        ("errors", "from . import robot", "errors stands left of robot"),
        ("scenario", "import mujoco.viewer", "mujoco belongs to envs, identification"),
        ("experiment", "def f():\n    from rerun import blueprint", "rerun belongs to viewing only"),
    ],
)
def test_the_rule_catches(part, source, words):
    (fault,) = faults(part, ast.parse(source))
    assert words in fault


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def named(path: Path, modules: set[str]) -> set[str]:
    """Return the modules that a source imports: inside functions, for types and by name as well."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inner & modules or {node.module}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in (
            "import_module",
            "load",
        ):
            found |= {each.value for each in node.args if isinstance(each, ast.Constant)}
    return found & modules


_KNOWN = [{"srs_twin.scenario.controllers", "srs_twin.scenario.file", "srs_twin.scenario.scenario"}]
"""Cycles by types alone, which the registry of scenario sections will end."""


def test_no_import_cycles():
    """Imports inside functions and for type checkers count; `extensions` names what it does not import."""
    modules = {module_name(path) for path in SOURCES}
    edges = {module_name(path): named(path, modules) - {module_name(path)} for path in SOURCES}
    sorter = TopologicalSorter(edges)
    while True:
        try:
            tuple(sorter.static_order())
            return
        except CycleError as error:
            cycle = set(error.args[1])
            assert cycle in [known & cycle for known in _KNOWN], " → ".join(error.args[1])
            for module in cycle:
                edges[module] -= cycle
            sorter = TopologicalSorter(edges)


def test_the_picture_of_the_rooms_is_what_the_imports_draw(root, tmp_path):
    program = root / "docs" / "rooms.py"
    code = f"import runpy, pathlib; d = runpy.run_path({str(program)!r}); "
    code += f"d['draw'](d['rooms_of'](d['PACKAGE']), pathlib.Path({str(tmp_path / 'rooms.svg')!r}))"
    subprocess.run([sys.executable, "-c", code], check=True)
    drawn, kept = tmp_path / "rooms.svg", root / "docs" / "images" / "rooms.svg"
    assert drawn.read_text() == kept.read_text(), "`uv run python docs/rooms.py` draws it anew"
