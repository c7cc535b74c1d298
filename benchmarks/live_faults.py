"""Faults that the live twin detects, how fast, and its false alarms.

    uv run python benchmarks/live_faults.py [--seeds 12] [--first 6000] [--hours 1]
    [--rows FILE]

Conditions are those of `live_runs.CONDITIONS`: supplies that droop and wander, robots
that differ from their file, other gaits, poor sensors; `--condition NAME` (repeatable)
picks some. A fault is observable from the time at which noiseless readings of a robot
without it would differ by three times the noise; it is in time within a gait period of
that. Two faults look alike as long as the chambers alternate (one that never vents
bends as if the other one never filled) and may be named together. Hours without a fault
are shared equally among the conditions.

FILE has one line of JSON per finished run. Runs that it contains are not repeated, so a
study can be interrupted, and files of several machines can be joined.
SRS_LIVE_RECORDINGS=FOLDER keeps the messages.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
from common.grid import table

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from live_runs import CONDITIONS, NAMES, alarms, isolated

from srs_twin.compute.workers import processor_count

STILL = ("standing", "held bends", "stop and go")
"""Conditions in which faults need not show within a period: false alarms only."""
RUN_S = 120.0
"""Duration of a run without a fault, s."""
SLOW_LEAK = "leak:{j}{side}=slow"
Order = tuple[str, int, str]
"""Kind of run ("faults" or "alarms"), seed and condition."""


def run(order: Order) -> dict[str, Any]:
    """Return the outcome of one order."""
    what, seed, condition = order
    row: dict[str, Any] = {"what": what, "seed": seed, "condition": condition}
    if what == "faults":
        return row | {"rows": isolated((seed, condition, tuple(NAMES)))}
    return row | {"rows": alarms((seed, RUN_S, condition)), "seconds": RUN_S}


def planned(
    conditions: Sequence[str], first: int, seeds: int, hours: float
) -> list[Order]:
    """Return all orders; any beginning of the list has about as many runs of each condition."""
    walking = [name for name in conditions if name not in STILL]
    orders: list[Order] = [
        ("faults", first + k, name) for k in range(seeds) for name in walking
    ]
    runs = round(hours * 3600 / RUN_S / len(conditions))
    return orders + [
        ("alarms", first + 100 + runs * i + k, name)
        for k in range(runs)
        for i, name in enumerate(conditions)
    ]


def missing(
    orders: Iterable[Order], file: Path | None, task: Callable[[Any], Any]
) -> Iterator[Any]:
    """Yield the results of a file, then those of the orders that it lacks, which are added to it."""
    if file and file.exists():
        lines = file.read_text("utf-8").splitlines()
    else:
        lines = []
    known = [json.loads(line) for line in lines]
    yield from known
    there = {(row["what"], row["seed"], row["condition"]) for row in known}
    with ProcessPoolExecutor(processor_count()) as pool:
        waiting = [pool.submit(task, order) for order in orders if order not in there]
        for done in as_completed(waiting):
            if file:
                with file.open("a", encoding="utf-8") as out:
                    out.write(json.dumps(done.result(), default=float) + "\n")
            yield done.result()


def summary(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the cells of some faults: in time, named, alone, delay, faults of other parts."""
    fractions = [
        f"{sum(row[what] for row in rows)} of {len(rows)}"
        for what in ("in_time", "among", "right")
    ]
    since = [row["at"] - row["observable"] for row in rows if row["among"]]
    after = f"{np.median(since):.2f}" if since else "–"
    return [*fractions, after, str(sum(len(row["others"]) for row in rows))]


def report(done: Sequence[dict[str, Any]]) -> None:
    """Print tables by condition and by fault, all misses, and the false alarms."""
    faults = [row for each in done if each["what"] == "faults" for row in each["rows"]]
    heads = ["in time", "named", "alone", "after, median, s", "other parts"]
    for key, names in (("condition", list(CONDITIONS)), ("fault", list(NAMES))):
        lines = []
        for name in names:
            mine = [row for row in faults if row[key] == name]
            for slow in (False, True) if key == "condition" else (None,):
                some = [
                    row
                    for row in mine
                    if slow is None or (row["fault"] == SLOW_LEAK) == slow
                ]
                if some:
                    label = name.replace("{j}", "j").replace(
                        "{side}", "±"
                    ) + ", slow leaks" * bool(slow)
                    lines.append([label, *summary(some)])
        print(table([key, *heads], lines), flush=True)
    for row in faults:
        if not row["in_time"] or row["others"]:
            print(
                f"{row['condition']}, {row['seed']}, {row['fault']}:"
                f" {row['named'] or 'nothing'} at {row['at']:.2f} s, observable"
                f" {row['observable']:.2f} s; other parts: {row['others']}"
            )
    sound = [each for each in done if each["what"] == "alarms"]
    count = sum(len(each["rows"]) for each in sound)
    print(
        f"{count} false alarms in {sum(each['seconds'] for each in sound) / 3600:.2f}"
        " hours without a fault"
    )
    for each in sound:
        for name in each["rows"]:
            print(f"  {each['condition']}, seed {each['seed']}: {name}")


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument(
        "--seeds", type=int, default=12, help="robots per kind of fault and condition"
    )
    words.add_argument("--first", type=int, default=6000, help="first seed")
    words.add_argument(
        "--hours",
        type=float,
        default=1.0,
        help="hours without a fault, of all conditions",
    )
    words.add_argument(
        "--condition", action="append", choices=CONDITIONS, help="default: all"
    )
    words.add_argument(
        "--rows", type=Path, metavar="FILE", help="file of finished runs, JSON lines"
    )
    given = words.parse_args()
    orders = planned(
        given.condition or list(CONDITIONS), given.first, given.seeds, given.hours
    )
    report(list(missing(orders, given.rows, run)))


if __name__ == "__main__":
    main()
