"""How large the package is, room by room: lines of code, modules, and the budget of each room.

    uv run python benchmarks/size.py               # rooms; exit 1 where the package is over its budget
    uv run python benchmarks/size.py --modules     # every module

A line of code is a line as the formatter lays it out (`# fmt: skip` taken away) that
holds code: docstrings, comments, imports and blank lines do not count.
"""

from __future__ import annotations

import argparse
import ast
import io
import shutil
import subprocess
import sys
import tempfile
import tokenize
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "srs_twin"
CORE_LINES = 13_800
EXTENSION_LINES = 14_800
MODULES = 190
CORE_MODULES = 110
# Budgets of rooms in lines of code; each row names the rooms that share one.
CORE = {
    ("errors", "extensions", "io"): 800,
    ("compute",): 350,
    ("robot",): 950,
    ("pneumatics", "sensing"): 1100,
    ("plants",): 3200,
    ("control",): 1000,
    ("trajectory", "rollout"): 400,
    ("comparison",): 1050,
    ("scenario",): 1300,
    ("viewing",): 1800,
    ("experiment", "attribution"): 450,
    ("cli",): 1300,
}
EXTENSIONS = {
    ("planning",): 2500,
    ("recordings",): 2800,
    ("identification",): 2200,
    ("studies",): 2600,
    ("live",): 2000,
    ("envs",): 700,
    ("warp",): 700,
    ("reproduction",): 1000,
}
_LAYOUT = (
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
)


def code_lines(source: str) -> int:
    """Return how many lines of a source hold code."""
    left_out: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.Import | ast.ImportFrom) or (
            text and isinstance(node.value.value, str)
        ):
            left_out.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    held: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in (tokenize.COMMENT, *_LAYOUT):
            held.update(range(token.start[0], token.end[0] + 1))
    return len(held - left_out)


def laid_out(package: Path, folder: Path) -> Path:
    """Return a copy of a package as the formatter lays it out."""
    copy = folder / package.name
    shutil.copytree(
        package, copy, ignore=shutil.ignore_patterns("__pycache__", "_data")
    )
    for path in copy.rglob("*.py"):
        path.write_text(path.read_text("utf-8").replace("  # fmt: skip", ""), "utf-8")
    config = ("--config", str(ROOT / "pyproject.toml"))
    subprocess.run(
        [sys.executable, "-m", "ruff", "format", "-q", *config, str(copy)], check=True
    )
    return copy


def main() -> int:
    """Print the table; return 1 if lines or modules exceed their budget."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--modules", action="store_true", help="every module, longest first in its room"
    )
    options = parser.parse_args()
    modules: defaultdict[str, dict[str, int]] = defaultdict(dict)
    with tempfile.TemporaryDirectory() as folder:
        copy = laid_out(PACKAGE, Path(folder))
        for path in sorted(copy.rglob("*.py")):
            name = path.relative_to(copy)
            modules[name.with_suffix("").parts[0]][str(name)] = code_lines(
                path.read_text("utf-8")
            )
    modules["errors"] |= modules.pop("__init__", {})
    over = False
    for title, budgets, most in (
        ("core", CORE, CORE_LINES),
        ("extensions", EXTENSIONS, EXTENSION_LINES),
    ):
        total = count = 0
        for rooms, budget in budgets.items():
            lines = {name: n for room in rooms for name, n in modules[room].items()}
            total = total + sum(lines.values())
            count = count + len(lines)
            print(
                f"{sum(lines.values()):6} of {budget:6}  {len(lines):3} modules "
                f" {', '.join(rooms)}"
            )
            for name, n in (
                sorted(lines.items(), key=lambda item: -item[1])
                if options.modules
                else ()
            ):
                print(f"{'':24}{n:5}  {name}")
        limit = f" of {CORE_MODULES}" if title == "core" else ""
        print(f"{total:6} of {most:6}  {count:3}{limit} modules  {title}\n")
        over |= total > most or (title == "core" and count > CORE_MODULES)
    every = sum(map(len, modules.values()))
    print(f"{every} of {MODULES} modules in all")
    return int(over or every > MODULES)


if __name__ == "__main__":
    sys.exit(main())
