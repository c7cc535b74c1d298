"""Tables of studies in the pages of docs/, with the date and the commit of the run.

A page has markers where a table belongs; `theory 2` is the second table of `theory`. A
marker without a number holds only a line about the last run. Pages use it beside tables
of larger runs, and where the printed tables are too wide:

    <!-- study theory 2: begin -->
    <!-- study theory 2: end -->
"""

from __future__ import annotations

import re
from pathlib import Path

from common.grid import table
from common.results import FOLDER, Result, load_result, path_of
from common.studies import BENCHMARKS

from srs_twin.io.files import atomic_write

DOCS = BENCHMARKS.parent / "docs"

_BLOCK = re.compile(
    r"(?P<begin><!-- study (?P<name>\w+)(?: (?P<number>\d+))?: begin -->\n)"
    r".*?"
    r"(?P<end><!-- study (?P=name)(?: (?P=number))?: end -->)",
    re.S,
)


def _run(result: Result) -> str:
    """Return when, from which commit and with which seeds a study was run."""
    stamp = result.stamp
    words = [stamp.date, f"commit {stamp.commit}", f"{result.minutes:.1f} min"]
    if result.seeds != "none":
        words.append(f"seeds {result.seeds}")
    if result.confirmed:
        last = result.confirmed[-1].stamp
        words.append(f"confirmed {last.date} at commit {last.commit}")
    return ", ".join(words)


def rendered(text: str, folder: Path = FOLDER) -> str:
    """Return a page with the tables of all stored results between their markers.

    Blocks of studies without a stored result stay as they are.

    Args:
        text: text of the page.
        folder: folder of the results.

    Raises:
        ValueError: a marker asks for a table that the result does not have.
    """

    def block(found: re.Match[str]) -> str:
        result = load_result(found["name"], folder)
        if result is None:
            return found[0]
        if found["number"]:
            line = f"*Study `{result.study}`: {_run(result)}.*"
            parts = [_table(result, int(found["number"])), line]
        else:
            file = path_of(result.study).relative_to(BENCHMARKS.parent)
            parts = [
                f"*Last run of the study `{result.study}` at its default size:"
                f" {_run(result)}; its tables are in `{file.as_posix()}`.*"
            ]
        return f"{found['begin']}\n" + "\n\n".join(parts) + f"\n\n{found['end']}"

    return _BLOCK.sub(block, text)


def _table(result: Result, number: int) -> str:
    if not 1 <= number <= len(result.tables):
        raise ValueError(
            f"`{result.study}` has {len(result.tables)} tables, not {number}"
        )
    stored = result.tables[number - 1]
    return table(stored.columns, stored.rows)


def update_pages(folder: Path = DOCS) -> list[Path]:
    """Write the stored results into the pages, and return the pages that changed."""
    changed = []
    for path in sorted(folder.glob("*.md")):
        text = path.read_text("utf-8")
        new = rendered(text)
        if new != text:
            with atomic_write(path) as part:
                Path(part).write_text(new, "utf-8")
            changed.append(path)
    return changed
