"""What both plants cost, as ratios to what else could be run, from one run on one machine.

    uv run --group benchmarks python benchmarks/speed.py [--quick] [--only a b] [--json FILE]

(a) analytical against LSODA, (b) twin against a bare mj_step loop, (c) both against PyElastica's continuum
snake, (d) cost by segments, (e) two threads. Medians of five rounds in which all sides take turns; in
brackets the least and the most of the rounds. The first run also compiles PyElastica's kernels, which takes
most of a minute more.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import against_elastica
import against_lsoda
import against_mj_step
import scaling
from grid import table
from timing import ROUNDS, Result, machine

BENCHMARKS: dict[str, Callable[[bool], Result]] = {
    "a": against_lsoda.run,
    "b": against_mj_step.run,
    "c": against_elastica.run,
    "d": scaling.by_segments,
    "e": scaling.by_threads,
}


def main() -> None:
    """Print one table a benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="smaller runs, under a minute in all")
    parser.add_argument("--only", nargs="+", choices=BENCHMARKS, default=list(BENCHMARKS), help="which")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything here as well")
    arguments = parser.parse_args()
    found: dict[str, Any] = {"machine": machine(), "rounds": ROUNDS, "quick": arguments.quick}
    print(f"{found['machine']['cpu']}, {found['machine']['cpus']} processors")
    for name in arguments.only:
        begun = time.perf_counter()
        try:
            result = BENCHMARKS[name](arguments.quick)
        except ModuleNotFoundError as error:
            if error.name != "elastica":
                raise
            print(f"\n({name}) left out: {against_elastica.NEEDS}", file=sys.stderr)
            continue
        print(f"\n{result.title}\n\n{table(result.head, result.rows)}\n", flush=True)
        print(*result.remarks, f"[{time.perf_counter() - begun:.0f} s]", sep="\n", flush=True)
        found[name] = {"title": result.title, **result.values}
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
