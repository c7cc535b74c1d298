"""Tables of actions, observations and rewards in docs/environments.md, generated from the tasks.

    uv run python docs/environment_tables.py docs/environments.md

replaces the tables between their markers; a test checks that they are up to date.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path

from srs_twin.envs import TASKS, make_task
from srs_twin.envs.task import Signals
from srs_twin.io.files import atomic_write


def tables() -> str:
    """Return the tables of steps and limits, of actions and of observations."""
    tasks = {name: make_task(name) for name in TASKS}
    rows = ["| environment | step, s | time limit, s |", "|---|---|---|"]
    rows += [
        f"| `SRSTwin/{name}-v0` | {task.step_s:g} | {task.limit_s:g} |"
        for name, task in tasks.items()
    ]
    actions = {name: task.actions for name, task in tasks.items()}
    observations = {}
    groups = {}
    for name, task in tasks.items():
        for group, signals in task.groups.items():
            groups |= {signal.name: group for signal in signals}
        commands = {signal.name for signal in task.actions}
        observations[name] = tuple(
            each for each in task.observations if each.name not in commands
        )
    return "\n\n".join(
        [
            "\n".join(rows),
            _table("action", actions),
            _table("observation", observations, groups),
        ]
    )


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


def _table(
    kind: str, signals: Mapping[str, Signals], groups: Mapping[str, str] | None = None
) -> str:
    """Return the table of the signals of all tasks.

    Signals that differ in a number share a row, and tasks with equal bounds a range.

    Args:
        kind: heading of the first column.
        signals: signals of each task.
        groups: group of each signal, for an additional column.
    """
    meanings: dict[tuple[str, str, str, str], dict[str, list[str]]] = {}
    pairs = [(task, each) for task, given in signals.items() for each in given]
    for task, signal in pairs:
        number = re.search(r"_(\d+)", signal.name)
        text = signal.description
        if number:
            text = re.sub(rf"\b{number[1]}\b", "N", text)
        name = re.sub(r"_\d+", "_N", signal.name)
        group = f" `{groups[signal.name]}` |" if groups else ""
        ranges = meanings.setdefault((name, group, signal.unit, text), {})
        tasks = ranges.setdefault(f"{signal.low:.4g} to {signal.high:.4g}", [])
        if task not in tasks:
            tasks.append(task)
    rows = [f"| {kind} | unit | meaning | range |", "|---|---|---|---|"]
    if groups:
        rows = [f"| {kind} | group | unit | meaning | range |", "|---|---|---|---|---|"]
    for (name, group, unit, text), ranges in meanings.items():
        cell = "; ".join(
            f"{', '.join(tasks)}: {bounds}" for bounds, tasks in ranges.items()
        )
        rows.append(f"| `{name}` |{group} {unit} | {text} | {cell} |")
    return "\n".join(rows)


def main(path: str) -> None:
    """Replace the tables of a page."""
    page = Path(path)
    with atomic_write(page) as temporary:
        Path(temporary).write_text(update_tables(page.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main(sys.argv[1])
