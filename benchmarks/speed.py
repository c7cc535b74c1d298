"""Cost of both plants relative to other programs, in one run on one machine.

    uv run --group benchmarks python benchmarks/speed.py [--quick] [--only a b] [--json
    FILE]

(a) analytical and LSODA, (b) twin and a bare mj_step loop, (c) both plants and the
continuum snake of PyElastica, (d) cost by segments, (e) two threads. The values are
medians of five rounds in which all contenders are timed in turns; the range over the
rounds is in brackets. The first run also compiles the kernels of PyElastica, which
takes most of a minute.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from common import against_elastica, against_lsoda, against_mj_step, scaling
from common.grid import table
from common.timing import ROUNDS, Result, machine

BENCHMARKS: dict[str, Callable[[bool], Result]] = {
    "a": against_lsoda.run,
    "b": against_mj_step.run,
    "c": against_elastica.run,
    "d": scaling.by_segments,
    "e": scaling.by_threads,
}


def main() -> None:
    """Print one table per benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--quick", action="store_true", help="smaller runs, under a minute in all"
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=BENCHMARKS,
        default=list(BENCHMARKS),
        help="benchmarks to run",
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="also write all values to this file"
    )
    arguments = parser.parse_args()
    results: dict[str, Any] = {
        "machine": machine(),
        "rounds": ROUNDS,
        "quick": arguments.quick,
    }
    print(f"{results['machine']['cpu']}, {results['machine']['cpus']} processors")
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
        print(
            *result.remarks,
            f"[{time.perf_counter() - begun:.0f} s]",
            sep="\n",
            flush=True,
        )
        results[name] = {"title": result.title, **result.values}
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
