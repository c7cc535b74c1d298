"""Size of the package by room: lines of code, modules, and the budget.

    uv run python benchmarks/size.py               # rooms; exit 1 if the package exceeds its budget
    uv run python benchmarks/size.py --modules     # every module

Lines of code are counted in the formatted source, without `# fmt: skip`. Docstrings, comments, imports and
blank lines do not count.
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
LINES, MODULES = 20_000, 210
# Thousands of lines of code; rooms that are not listed have no separate budget.
BUDGETS = {
    **{"errors": 0.1, "io": 0.5, "parallel": 0.15, "robot": 0.6, "trajectory": 0.1, "pneumatics": 0.8},
    **{"sensing": 0.3, "mjcf": 0.6, "planning": 1.4, "plants": 1.6, "control": 1.25, "rollout": 0.3},
    **{"comparison": 0.9, "recordings": 1.4, "identification": 1.9, "scenario": 0.9, "viewing": 2.3},
    **{"experiment": 0.2, "attribution": 0.2, "sweep": 0.9, "reproduction": 1.1, "envs": 0.65},
    **{"doctor": 0.25, "cli": 1.4},
}
_LAYOUT = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)


def code_lines(source: str) -> int:
    """Return the number of lines with code in a source."""
    left_out: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.Import | ast.ImportFrom) or (text and isinstance(node.value.value, str)):
            left_out.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    held: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in (tokenize.COMMENT, *_LAYOUT):
            held.update(range(token.start[0], token.end[0] + 1))
    return len(held - left_out)


def laid_out(package: Path, folder: Path) -> Path:
    """Return a formatted copy of a package."""
    copy = folder / package.name
    shutil.copytree(package, copy, ignore=shutil.ignore_patterns("__pycache__", "_data"))
    for path in copy.rglob("*.py"):
        path.write_text(path.read_text("utf-8").replace("  # fmt: skip", ""), "utf-8")
    config = ("--config", str(ROOT / "pyproject.toml"))
    subprocess.run([sys.executable, "-m", "ruff", "format", "-q", *config, str(copy)], check=True)
    return copy


def main() -> int:
    """Print the table; return 1 if lines or modules exceed the budget."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--modules", action="store_true", help="list every module, longest first in each room"
    )
    options = parser.parse_args()
    rooms: defaultdict[str, dict[str, int]] = defaultdict(dict)
    with tempfile.TemporaryDirectory() as folder:
        copy = laid_out(PACKAGE, Path(folder))
        for path in sorted(copy.rglob("*.py")):
            name = path.relative_to(copy)
            rooms[name.with_suffix("").parts[0]][str(name)] = code_lines(path.read_text("utf-8"))
    for room, modules in rooms.items():
        budget = f"{1000 * BUDGETS[room]:6.0f}" if room in BUDGETS else "     –"
        print(f"{sum(modules.values()):6} of {budget}  {len(modules):3} modules  {room}")
        if options.modules:
            for name, lines in sorted(modules.items(), key=lambda item: -item[1]):
                print(f"{'':24}{lines:5}  {name}")
    lines = sum(sum(modules.values()) for modules in rooms.values())
    count = sum(map(len, rooms.values()))
    print(f"{lines:6} of {LINES:6}  {count:3} of {MODULES} modules  in all")
    return int(lines > LINES or count > MODULES)


if __name__ == "__main__":
    sys.exit(main())
