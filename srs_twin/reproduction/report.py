"""What a reproduction leaves: reproduce.json for machines, reproduce.html for people."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.files import atomic_write
from srs_twin.provenance import versions
from srs_twin.reproduction.baseline import outcomes_document
from srs_twin.reproduction.outcomes import EXPLAINED, MET, MISSED, Judged, Outcome
from srs_twin.reproduction.summary import TITLES, USES, cell, count, percent, published, summary_line
from srs_twin.viewing.html import Markup, element, folded, page, picture, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srs_twin.reproduction.figures import Picture


_TITLE = "The dissertation, reproduced"
_HEADINGS = ("row", "statement", "published", "allowed", "analytical", "error", "twin", "error", "why")
_READING = (
    "Each row is one statement of the dissertation, judged for each plant by itself. A tolerance is ours, "
    "not the text's. Met: the value is allowed. Explained: it is not met, and the cause is shown, by a "
    "switch of an assumption with which it is, or by a section of the documents. Missed: not met, the cause "
    "not known, or thought to be known and not shown.",
    "Rows that may be used to calibrate are no predictions and are counted apart. An error is that from the "
    "published value, over it. Of an ordering each value is to be above the next. Rows that need no plant "
    "(plans, tables, the robot's numbers) stand in the first column.",
    "In the pictures the analytical model is dashed and the twin solid; bends and yaw rates are positive to "
    "the left, speeds forward.",
)


def write_json(path: Path, rows: Sequence[Judged], changes: Sequence[str]) -> None:
    """Write rows and outcomes, whole or not at all.

    Args:
        path: the file; an earlier one is replaced.
        rows: judged.
        changes: verdicts that are not those of the baseline, in words.

    Raises:
        InputError: the place cannot be written.
    """
    outcomes = outcomes_document(rows)
    document = {
        "summary": {
            column: {use: count(rows, column, (use,)) for use in USES}
            for column in ("analytical", "twin", "alone")
        },
        "changed_from_baseline": list(changes),
        "rows": [_row(row, outcomes[row.claim.id]) for row in rows],
        "versions": versions(),
    }
    with atomic_write(path) as part:
        part.write_text(json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n", "utf-8")


def _row(row: Judged, outcomes: Any) -> dict[str, Any]:
    claim = row.claim
    return {
        "id": claim.id,
        "source": claim.source,
        "robot": claim.robot,
        "says": claim.says,
        "use": claim.use,
        "fitted": claim.use == "fit",
        "rule": claim.rule,
        "value": claim.value,
        "unit": claim.unit,
        "allowed": claim.allowed,
        "outcomes": outcomes,
    }


def write_html(
    path: Path, rows: Sequence[Judged], figures: Sequence[tuple[Picture, Figure]], changes: Sequence[str]
) -> None:
    """Write the page, whole or not at all; it needs nothing from outside itself.

    Args:
        path: the file; an earlier one is replaced.
        rows: judged.
        figures: drawn again, in the order of the text.
        changes: verdicts that are not those of the baseline, in words.

    Raises:
        InputError: the place cannot be written.
    """
    parts = [
        element("h1", _TITLE),
        element("p", summary_line(rows), cls="sub"),
        *(
            [element("h2", "Changed from the baseline"), *(element("p", each) for each in changes)]
            if changes
            else []
        ),
        *(part for use in USES for part in _section(use, [row for row in rows if row.claim.use == use])),
        element("h2", "How to read this"),
        *(element("p", sentence) for sentence in _READING),
        *([element("h2", "Figures, drawn again")] if figures else []),
        *(picture(figure, f"{each.number}: {each.caption}") for each, figure in figures),
        folded("Versions", table(["package", "version"], [list(pair) for pair in versions().items()])),
    ]
    with atomic_write(path) as part:
        part.write_text(page(_TITLE, *parts, broad=True), "utf-8")


def _section(use: str, rows: Sequence[Judged]) -> list[Markup]:
    if not rows:
        return []
    return [element("h2", TITLES[use]), table(_HEADINGS, map(_cells, rows), numbers=range(2, 8))]


def _cells(row: Judged) -> list[str]:
    claim, found = row.claim, row.outcomes
    unit = "" if claim.unit == "1" or claim.value is None else f" {claim.unit}"
    first, second = found.get("analytical") or found.get("alone"), found.get("twin")
    why = dict.fromkeys(outcome.why for outcome in found.values() if outcome.why)
    return [
        claim.id, f"{claim.says} ({claim.source})", f"{published(claim)}{unit}", claim.allowed,
        _colored(first), percent(claim, first), _colored(second), percent(claim, second), "; ".join(why),
    ]  # fmt: skip


def _colored(outcome: Outcome | None) -> Markup | str:
    if outcome is None:
        return ""
    words = {MET: "", EXPLAINED: " (explained)", MISSED: " (missed)"}[outcome.verdict]
    return element("span", cell(outcome) + words, cls="met" if outcome.verdict == MET else "missed")
