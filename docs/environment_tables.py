"""Tables of actions, observations and rewards in docs/environments.md, generated from the tasks.

    uv run python docs/environment_tables.py docs/environments.md

replaces the tables between their markers; a test checks that they are up to date.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from pathlib import Path

from srs_twin.envs import TASKS, make_task
from srs_twin.envs.task import Signal
from srs_twin.io.files import atomic_write


def tables() -> str:
    """Return the tables of all tasks."""
    sections = []
    for name in TASKS:
        task = make_task(name)
        commands = {signal.name for signal in task.actions}
        measured = [each for each in task.observations if each.name not in commands]
        sections.append(
            f"### SRSTwin/{name}-v0\n\n"
            f"A step takes {task.step_s:g} s; an episode is truncated after"
            f" {task.limit_s:g} s.\n\n"
            f"{_table('action', task.actions)}\n\n{_table('observation', measured)}"
        )
    return "\n\n".join(sections)


def rewards() -> str:
    """Return the table of the reward terms of all tasks."""
    rows = ["| task | term | weight | value |", "|---|---|---|---|"]
    terms: dict[tuple[str, float, str], list[str]] = {}
    for name in TASKS:
        for term in make_task(name).reward_terms:
            terms.setdefault((term.name, term.weight, term.description), []).append(
                f"`{name}`"
            )
    rows += [
        f"| {', '.join(tasks)} | `{t}` | {weight:g} | {text} |"
        for (t, weight, text), tasks in terms.items()
    ]
    return "\n".join(rows)


def update_tables(page: str) -> str:
    """Return a page with the current tables between its markers."""
    for name, text in (("signals", tables()), ("rewards", rewards())):
        begin = f"<!-- {name}: begin -->"
        end = f"<!-- {name}: end -->"
        before, _, rest = page.partition(begin)
        page = f"{before}{begin}\n{text}\n{end}{rest.partition(end)[2]}"
    return page


def _table(kind: str, signals: Iterable[Signal]) -> str:
    """Return the table of signals; numbered signals of one kind share a row."""
    numbered: dict[tuple[str, ...], int] = {}
    for signal in signals:
        number = re.search(r"_(\d+)", signal.name)
        text = signal.description
        if number:
            text = re.sub(rf"\b{number[1]}\b", "N", text)
        row = (
            re.sub(r"_\d+", "_N", signal.name),
            signal.unit,
            f"{signal.low:.4g}",
            f"{signal.high:.4g}",
            text,
        )
        numbered[row] = numbered.get(row, 0) + 1
    rows = [f"| {kind} | unit | minimum | maximum | meaning |", "|---|---|---|---|---|"]
    for (name, *cells), count in numbered.items():
        numbers = f", N = 1…{count}" if count > 1 else ""
        rows.append(f"| `{name}`{numbers} | {' | '.join(cells)} |")
    return "\n".join(rows)


def main(path: str) -> None:
    """Replace the tables of a page."""
    page = Path(path)
    with atomic_write(page) as temporary:
        Path(temporary).write_text(update_tables(page.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main(sys.argv[1])
