"""Who may import whom.

Every import in the sources counts, inside functions and for types too.
"""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

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
    *(
        "errors",
        "extensions",
        "io",
        "compute",
        "robot",
        "trajectory",
        "pneumatics",
        "sensing",
        "plants",
    ),
    *(
        "control",
        "rollout",
        "comparison",
        "scenario",
        "viewing",
        "experiment",
        "attribution",
        "cli",
    ),
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
    """Yield (line, dotted name) of everything a source imports; relative names are made absolute."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = list(package[: len(package) - node.level + 1]) if node.level else []
            stem = ".".join(base + ([node.module] if node.module else []))
            # `from srs_twin import errors` names the part only in what it imports.
            if stem == "srs_twin":
                yield from (
                    (node.lineno, f"srs_twin.{alias.name}") for alias in node.names
                )
            else:
                yield node.lineno, stem


def faults(
    part: str, tree: ast.AST, package: tuple[str, ...] = ("srs_twin",)
) -> list[str]:
    """Return forbidden imports of a source, as 'line: message'."""
    found = []
    for line, name in imports(tree, package):
        top, _, rest = name.partition(".")
        if top in RESERVED and part not in RESERVED[top]:
            found.append(
                f"{line}: {top} belongs to {', '.join(sorted(RESERVED[top]))} only"
            )
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


def test_importing_the_package_imports_nothing_but_the_registry():
    code = (
        "import sys, srs_twin; print(*sorted(name for name in sys.modules if"
        " name.startswith('srs_twin')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["srs_twin", "srs_twin.errors", "srs_twin.extensions"]


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
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    names = [name.partition(".")[2] for name in done.stdout.split()]
    extensions_used = {name for name in names if name.partition(".")[0] in EXTENSIONS}
    assert sorted(extensions_used) == METRICS_AND_PICTURES
    assert len(names) <= MAX_MODULES


@pytest.mark.default_cases(2)
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
            "scenario",
            "import mujoco.viewer",
            "mujoco belongs to cli, envs, identification",
        ),
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
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inner & modules or {node.module}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Call) and getattr(
            node.func, "attr", getattr(node.func, "id", "")
        ) in (
            "import_module",
            "load",
        ):
            found |= {
                each.value for each in node.args if isinstance(each, ast.Constant)
            }
    return found & modules


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
        script = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {code}"
        done = subprocess.run(
            [sys.executable, "-c", script],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "runs" / "gen2_straight" / "report.html").is_file()


def test_only_the_registry_names_an_extension():
    named = rf"srs_twin\.({'|'.join(EXTENSIONS)})\b"
    core = [
        path
        for path in SOURCES
        if part_of(path) in CORE and path.name != "extensions.py"
    ]
    assert [
        path.name for path in core if re.search(named, path.read_text("utf-8"))
    ] == []


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
    program = root / "docs" / "rooms.py"
    code = f"import runpy, pathlib; d = runpy.run_path({str(program)!r}); "
    code += (
        "d['draw'](d['rooms_of'](d['PACKAGE']),"
        f" pathlib.Path({str(tmp_path / 'rooms.svg')!r}))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    drawn = tmp_path / "rooms.svg"
    kept = root / "docs" / "images" / "rooms.svg"
    assert drawn.read_text() == kept.read_text(), (
        "`uv run python docs/rooms.py` draws it anew"
    )
