"""What a reproduction leaves: reproduce.json for machines, reproduce.html for people, rows in words."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.io.files import write_text
from srs_twin.provenance import versions
from srs_twin.reproduction.claims import COLUMNS, Claim
from srs_twin.reproduction.verdicts import (
    EXPLAINED,
    MET,
    MISSED,
    Judged,
    Outcome,
    outcomes_document,
)
from srs_twin.viewing.html.page import Table, colored, picture, render

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srs_twin.reproduction.figures import Picture


USES = ("law", "holdout", "shape", "fit")
"""In the order in which they are told; what may be fitted last, for it is no prediction."""

TITLES = {
    "law": "Laws",
    "holdout": "Predictions (never used to calibrate)",
    "shape": "Orders and trends",
    "fit": "May be used to calibrate: no predictions",
}

_NOTHING = "–"


def count(rows: Sequence[Judged], column: str, uses: Sequence[str] = USES) -> dict[str, int]:
    """Return how many rows of a column are "met", "explained" and "missed", and "all" of them."""
    verdicts = [
        row.outcomes[column].verdict for row in rows if row.claim.use in uses and column in row.outcomes
    ]
    return {name: verdicts.count(name) for name in (MET, EXPLAINED, MISSED)} | {"all": len(verdicts)}


def summary_line(rows: Sequence[Judged]) -> str:
    """Return in one line how many rows each plant meets, predictions and fitted rows apart."""
    names = {"twin": "the twin meets", "analytical": "the analytical model", "alone": "without a plant"}
    words = {"law": "laws", "holdout": "predictions", "shape": "orders and trends"}
    parts = []
    for column, name in names.items():
        counts = {use: count(rows, column, (use,)) for use in USES}
        told = [
            f"{counts[use][MET]} of {counts[use]['all']} {words[use]}" for use in words if counts[use]["all"]
        ]
        fitted = counts["fit"]
        if fitted["all"]:
            told.append(f"(apart: {fitted[MET]} of {fitted['all']} that may be fitted)")
        if told:
            parts.append(f"{name} {', '.join(told).replace(', (', ' (')}")
    return f"Of {len(rows)} rows {'; '.join(parts)}."


def published(claim: Claim) -> str:
    """Return the published value, or the rule of a row that has none."""
    if claim.value is None:
        return "order"
    sign = {"below": "≤ ", "above": "≥ "}.get(str(claim.rule), "")
    return f"{sign}{short(claim.value)}"


def cell(outcome: Outcome | None) -> str:
    """Return what came out, as text: one number, or those of an ordering; a dash where there is none."""
    if outcome is None:
        return _NOTHING
    if math.isfinite(outcome.value):
        return short(outcome.value)
    known = [value for value in outcome.values if math.isfinite(value)]
    if len(known) < len(outcome.values) or not known:
        return _NOTHING
    return " > ".join(map(short, known)) if outcome.verdict == MET else ", ".join(map(short, known))


def short(value: float) -> str:
    """Return a number with three significant digits; whole ones in full."""
    if value == 0:
        return "0"
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e6 else f"{value:.3g}"


def percent(claim: Claim, outcome: Outcome | None) -> str:
    """Return the relative error as text, empty where there is none, or where only a bound is published."""
    if outcome is None or claim.rule != "near" or not math.isfinite(outcome.error):
        return ""
    whole = round(100 * outcome.error)
    return f"{whole:+d} %" if whole else "0 %"


def verdict(row: Judged) -> str:
    """Return the verdict of a row in one word, or one for each plant where they differ."""
    found = [row.outcomes[name].verdict for name in COLUMNS if name in row.outcomes]
    return found[0] if len(set(found)) == 1 else ", ".join(found) or _NOTHING


_HEADINGS = ("row", "statement", "published", "allowed", "analytical", "error", "twin", "error", "why")


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
    write_text(path, json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _row(row: Judged, outcomes: Any) -> dict[str, Any]:
    claim = row.claim
    names = "id source robot says use fitted rule value unit allowed".split()
    return {name: getattr(claim, name) for name in names} | {"outcomes": outcomes}


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
    sections = {
        TITLES[use]: Table(_HEADINGS, [_cells(row) for row in rows if row.claim.use == use], range(2, 8))
        for use in USES
    }
    content = render(
        "reproduction/report.html",
        title="The dissertation, reproduced",
        subtitle=summary_line(rows),
        changes=changes,
        sections=sections,
        figures=[picture(figure, f"Fig. {each.figure}: {each.caption}") for each, figure in figures],
        versions=Table(["package", "version"], list(versions().items())),
    )
    write_text(path, content)


def _cells(row: Judged) -> list[str]:
    claim, found = row.claim, row.outcomes
    unit = "" if claim.unit == "1" or claim.value is None else f" {claim.unit}"
    first, second = found.get("analytical") or found.get("alone"), found.get("twin")
    why = dict.fromkeys(outcome.why for outcome in found.values() if outcome.why)
    return [
        claim.id,
        f"{claim.says} ({claim.source})",
        f"{published(claim)}{unit}",
        claim.allowed,
        _colored(first),
        percent(claim, first),
        _colored(second),
        percent(claim, second),
        "; ".join(why),
    ]


def _colored(outcome: Outcome | None) -> str:
    if outcome is None:
        return ""
    words = {MET: "", EXPLAINED: " (explained)", MISSED: " (missed)"}[outcome.verdict]
    return colored(cell(outcome) + words, "met" if outcome.verdict == MET else "missed")
