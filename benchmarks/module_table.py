"""Table of docs/module.md with all values of Chapter 4 from the dissertation and from both benches.

    uv run python benchmarks/module_table.py              # run the scenarios module_…, 20 draws with the leak
    uv run python benchmarks/module_table.py --from-json  # only write the table from docs/module.json

The results are written to docs/module.json, and the table between two marks in
docs/module.md. Tests verify that the table agrees with these results, and that the
shipped scenarios still give them. Values in bold miss their criterion. `difference` is
the largest difference of the benches in a row, relative to the analytical value.

`--leak` prints the effect of the sensor noise on a module at rest with a leak.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from common import leak
from common.grid import table

from srs_twin import load_scenario
from srs_twin.experiment import run_scenario
from srs_twin.io.files import atomic_write, shipped_names

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from module_lines import LINES, PLANTS

DOCS = Path(__file__).parents[1] / "docs"
FIGURES = DOCS / "module.json"
PAGE = DOCS / "module.md"
BEGIN = "<!-- module: begin -->"
END = "<!-- module: end -->"


def measured(name: str) -> dict[str, dict[str, float]]:
    """Run a shipped scenario; return its metrics by plant and name, without run times."""
    with tempfile.TemporaryDirectory() as folder:
        plants = run_scenario(load_scenario(name), Path(folder)).metrics["plants"]
    return {plant: scalar_metrics(result) for plant, result in plants.items()}


def scalar_metrics(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return the scalar metrics, without run times."""
    return {
        name: value
        for name, value in metrics.items()
        if isinstance(value, int | float) and name not in ("wall_s", "realtime_factor")
    }


def figures(draws: int) -> dict[str, Any]:
    """Run all scenarios and draws; return the content of docs/module.json."""
    names = [name for name in shipped_names("scenario") if name.startswith("module_")]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        scenarios = dict(zip(names, pool.map(measured, names), strict=True))
        by_controller: dict[str, Any] = {}
        for kind in ("direct", "iterative"):
            result = leak.draws(pool, kind, "as shipped", draws)
            by_controller[kind] = {
                plant: {
                    name: {
                        "mean": float(values.mean()),
                        "deviation": float(values.std(ddof=1)),
                    }
                    for name, values in metrics.items()
                }
                for plant, metrics in result.items()
            }
    return {
        "scenarios": scenarios,
        "leak": {"draws": draws, "angles": "degrees", "of": by_controller},
    }


def report(result: Mapping[str, Any]) -> str:
    """Return the table."""
    head = ["quantity", "dissertation", *PLANTS, "difference", "scenario"]
    return table(head, [line.cells(result) for line in LINES])


def placed(page: str, lines: str) -> str:
    """Return the page with the table between its marks."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{lines}\n{END}{after}"


def main() -> None:
    """Write both files."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument(
        "--from-json",
        action="store_true",
        help="only write the table, from docs/module.json",
    )
    arguments.add_argument(
        "--draws",
        type=int,
        default=20,
        help="number of draws of the sensor noise with a leak",
    )
    arguments.add_argument(
        "--leak",
        action="store_true",
        help="only print the effect of the sensor noise on a module with a leak",
    )
    options = arguments.parse_args()
    if options.leak:
        leak.tables(options.draws)
        return
    if not options.from_json:
        with atomic_write(FIGURES) as part:
            Path(part).write_text(
                json.dumps(figures(options.draws), indent=1) + "\n", "utf-8"
            )
    lines = report(json.loads(FIGURES.read_text("utf-8")))
    print(lines)
    page = placed(PAGE.read_text("utf-8"), lines)
    with atomic_write(PAGE) as part:
        Path(part).write_text(page, "utf-8")


if __name__ == "__main__":
    main()
