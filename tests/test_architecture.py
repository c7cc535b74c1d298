"""Who may import whom. Every import in the sources counts, inside functions and for types too."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "srs_twin"

# From left to right; a module imports only from its own step or from steps to its left.
ORDER = (
    ("errors", "compiled", "plausible", "records", "threads", "process_server", "processes"),
    ("files", "folders", "documents", "validation", "parquet"),
    ("modules", "sourced", "published", "modules_file", "spec", "robots", "robot_file", "world"),
    ("trajectory",),
    ("shape", "friction", "pneumatics", "sensing"),
    (
        "planning",
        "mjcf_numerics",
        "mjcf_classes",
        "mjcf_obstacles",
        "mjcf_surroundings",
        "mjcf_wheels",
        "mjcf",
        "mjcf_export",
        "mjcf_scan",
        "mjcf_check",
    ),
    ("plants", "control"),
    ("rollout", "rollouts"),
    ("comparison",),
    ("identification", "scenario", "provenance"),
    ("viewing",),
    ("running", "finished"),
    ("doctor",),
    ("attribution", "sweep", "envs"),
    ("reproduction",),
    ("cli",),
)
STEP = {name: i for i, names in enumerate(ORDER) for name in names}

# What is heavy or swaps out one day, and the only parts of the package that may know of it.
RESERVED = {
    "mujoco": {
        "mjcf",
        "mjcf_classes",
        "mjcf_obstacles",
        "mjcf_surroundings",
        "mjcf_wheels",
        "mjcf_export",
        "mjcf_check",
        "plants",
        "envs",
        "viewing",
        "identification",
    },
    "dm_control": {"mjcf", "plants", "envs", "viewing", "identification"},
    "gymnasium": {"envs"},
    "rerun": {"viewing"},
    "ray": {"sweep"},
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


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_only_from_the_left(path):
    part = part_of(path)
    assert part in STEP, f"{part}: give it a place in ORDER and in the docs"
    package = ("srs_twin", *path.relative_to(PACKAGE).parts[:-1])
    assert faults(part, ast.parse(path.read_text("utf-8")), package) == []


def test_the_package_itself_imports_none_of_its_parts():
    tree = ast.parse((PACKAGE / "__init__.py").read_text("utf-8"))
    assert [name for _, name in imports(tree) if name.startswith("srs_twin")] == []


@pytest.mark.parametrize(
    ("part", "source", "words"),
    [
        ("spec", "from srs_twin.plants import base", "spec stands left of plants"),
        ("spec", "def f():\n    import srs_twin.cli.app", "2: spec stands left of cli"),
        ("files", "from srs_twin import rollout", "files stands left of rollout"),
        ("errors", "from . import spec", "errors stands left of spec"),
        ("scenario", "import mujoco.viewer", "mujoco belongs to envs, identification"),
        ("running", "def f():\n    from rerun import blueprint", "rerun belongs to viewing only"),
    ],
)
def test_the_rule_catches(part, source, words):
    (fault,) = faults(part, ast.parse(source))
    assert words in fault


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def loads(path: Path) -> set[str]:
    """Return the modules of the package that importing a source executes."""
    found = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


def test_no_import_cycles():
    """Siblings of one step may import each other, but never in a circle."""
    edges = {module_name(path): loads(path) for path in SOURCES}
    done: set[str] = set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert module not in trail, " → ".join((*trail, module))
        if module in done:
            return
        for other in edges[module] & edges.keys():
            visit(other, (*trail, module))
        done.add(module)

    for module in edges:
        visit(module, ())
