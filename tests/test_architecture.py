"""Who may import whom.

Every import in the sources counts, inside functions and for types too.
"""

from __future__ import annotations

import ast
import re
import runpy
import shutil
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from processes import python

from srs_twin import extensions

pytestmark = pytest.mark.fast

PACKAGE = Path(__file__).parents[1] / "srs_twin"

# From left to right; a room imports only from itself or from rooms to its left.
EXTENSIONS = (
    "warp",
    "planning",
    "recordings",
    "identification",
    "studies",
    "live",
    "envs",
    "reproduction",
)
CORE = (
    "errors",
    "extensions",
    "io",
    "compute",
    "robot",
    "trajectory",
    "pneumatics",
    "sensing",
    "plants",
    "control",
    "rollout",
    "comparison",
    "scenario",
    "viewing",
    "experiment",
    "attribution",
    "cli",
)
ORDER = (*CORE, *EXTENSIONS)
STEP = {name: i for i, name in enumerate(ORDER)}

# Large or replaceable packages, and the only rooms that may import them.
RESERVED = {
    "mujoco": {"plants", "warp", "viewing", "envs", "identification", "cli"},
    "dm_control": {"envs"},
    "gymnasium": {"envs"},
    "rerun": {"viewing"},
    "rerun_bindings": {"viewing"},
    "ray": {"studies"},
    "warp": {"warp"},
    "mujoco_warp": {"warp"},
    "paho": {"live"},
}

SOURCES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def part_of(path: Path) -> str:
    """Return the name in ORDER that a source file belongs to: its folder or its own name."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(
    tree: ast.AST, package: tuple[str, ...] = ("srs_twin",)
) -> Iterator[tuple[int, str]]:
    """Yield (line, dotted name) of everything a source imports.

    Relative names are made absolute. `from a import b` yields both a and a.b.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            stem = ".".join(filter(None, (*base, node.module)))
            yield node.lineno, stem
            yield from ((node.lineno, f"{stem}.{alias.name}") for alias in node.names)


def faults(
    part: str, tree: ast.AST, package: tuple[str, ...] = ("srs_twin",)
) -> set[str]:
    """Return forbidden imports of a source, as 'line: message'."""
    found = set()
    for line, name in imports(tree, package):
        top, other, *_ = (*name.split("."), "")
        rooms = RESERVED.get(top, {part})
        if part not in rooms:
            found.add(f"{line}: {top} belongs to {', '.join(sorted(rooms))} only")
        if top == "srs_twin" and STEP.get(other, -1) > STEP[part]:
            found.add(f"{line}: {part} stands left of {other}")
    return found


def test_imports_only_from_the_left():
    wrong = []
    for path in SOURCES:
        part = part_of(path)
        assert part in STEP, f"{part}: give it a place in ORDER and in the docs"
        package = ("srs_twin", *path.relative_to(PACKAGE).parts[:-1])
        for fault in faults(part, ast.parse(path.read_text("utf-8")), package):
            wrong.append(f"{path.relative_to(PACKAGE)}:{fault}")
    assert wrong == []


def test_importing_the_package_imports_nothing_but_the_registry():
    code = (
        "import sys, srs_twin; print(*sorted(name for name in sys.modules if"
        " name.startswith('srs_twin')))"
    )
    names = python("-c", code).stdout.split()
    assert names == ["srs_twin", "srs_twin.errors", "srs_twin.extensions"]


MAX_MODULES = 140
"""Number of modules of the package that a plain `compare` imports."""

METRICS_AND_PICTURES = ["planning", "planning.metrics", "planning.pictures"]


def test_compare_imports_what_its_scenario_names(tmp_path):
    """Other commands, and sections and controllers of extensions without a key in the file, stay out."""
    code = (
        "import sys\nfrom srs_twin.cli import main\n"
        "try:\n    main(['compare', 'gen2_straight', '--duration', '2', '-q'])\n"
        "finally:\n    print(*(n for n in sys.modules if n.startswith('srs_twin')))\n"
    )
    imported = python("-c", code, cwd=tmp_path).stdout.split()
    names = [name.partition(".")[2] for name in imported]
    extensions_used = {name for name in names if name.partition(".")[0] in EXTENSIONS}
    assert sorted(extensions_used) == METRICS_AND_PICTURES
    assert len(names) <= MAX_MODULES


@pytest.mark.parametrize(
    ("part", "source", "words"),
    [
        ("robot", "from srs_twin.plants import base", "robot stands left of plants"),
        (
            "robot",
            "def f():\n    import srs_twin.cli.app",
            "2: robot stands left of cli",
        ),
        ("io", "from srs_twin import rollout", "io stands left of rollout"),
        ("errors", "from . import robot", "errors stands left of robot"),
        (
            "experiment",
            "def f():\n    from rerun import blueprint",
            "rerun belongs to viewing only",
        ),
    ],
)
def test_the_rule_catches(part, source, words):
    (fault,) = faults(part, ast.parse(source))
    assert words in fault


def module_name(path: Path) -> str:
    return ".".join(
        path.relative_to(PACKAGE.parent).with_suffix("").parts
    ).removesuffix(".__init__")


def named(path: Path, modules: set[str]) -> set[str]:
    """Return the modules that a source imports: inside functions, for types and by name as well."""
    tree = ast.parse(path.read_text("utf-8"))
    found = {name for _, name in imports(tree)} & modules
    # A package is not imported for itself where one of its modules is named.
    found -= {name.rpartition(".")[0] for name in found}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            function = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if function in ("import_module", "load"):
                found |= {getattr(each, "value", None) for each in node.args} & modules
    return found


def test_no_import_cycles():
    """Imports inside functions and for type checkers count; `extensions` names what it does not import."""
    modules = {module_name(path) for path in SOURCES}
    edges = {
        module_name(path): named(path, modules) - {module_name(path)}
        for path in SOURCES
    }
    tuple(TopologicalSorter(edges).static_order())  # CycleError names a cycle


@pytest.mark.slow
def test_the_core_runs_without_extensions(root, tmp_path):
    """A copy of the package without the folders of the extensions imports and does the main job."""
    hidden = shutil.ignore_patterns("__pycache__", "_data")
    shutil.copytree(PACKAGE, tmp_path / "srs_twin", ignore=hidden)
    for name in EXTENSIONS:
        shutil.rmtree(tmp_path / "srs_twin" / name)
    for name in ("calibration", "models", "scenarios"):
        (tmp_path / name).symlink_to(root / name)
    modules = [module_name(path) for path in SOURCES if part_of(path) in CORE]
    imports_all = (
        f"import importlib; [importlib.import_module(name) for name in {modules}]"
    )
    command = (
        "from srs_twin.cli import main; main(['compare', 'gen2_straight', '--duration',"
        " '2', '-q'])"
    )
    for code in (imports_all, command):
        begin = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); "
        python("-c", begin + code, cwd=tmp_path)
    assert (tmp_path / "runs" / "gen2_straight" / "report.html").is_file()


def test_only_the_registry_names_an_extension():
    named = rf"srs_twin\.({'|'.join(EXTENSIONS)})\b"
    naming = {
        part_of(path) for path in SOURCES if re.search(named, path.read_text("utf-8"))
    }
    assert naming.intersection(CORE) == {"extensions"}


def test_every_entry_of_the_registry_loads():
    tables = [
        table
        for name, table in vars(extensions).items()
        if name.isupper() and type(table) is dict
    ]
    entries = [entry for table in tables for entry in table.values()]
    assert len(entries) > 20
    for entry in entries:
        if "warp" not in entry:  # needs an extra
            assert extensions.load(entry) is not None


@pytest.mark.slow
def test_the_picture_of_the_rooms_is_what_the_imports_draw(root, tmp_path):
    drawn = tmp_path / "rooms.svg"
    program = runpy.run_path(str(root / "docs/rooms.py"))
    program["draw"](program["rooms_of"](program["PACKAGE"]), drawn)
    kept = root / "docs/images/rooms.svg"
    assert drawn.read_text() == kept.read_text(), (
        "`uv run python docs/rooms.py` draws it anew"
    )
