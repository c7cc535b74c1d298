"""What a reproduction leaves: reproduce.json for machines, reproduce.html and Markdown for people.

The rows in words: how many are met, cells of tables, the Markdown of README and documents.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.io.files import atomic_write
from srs_twin.provenance import versions
from srs_twin.reproduction.claims import COLUMNS, Claim
from srs_twin.reproduction.verdicts import (
    EXPLAINED,
    MET,
    MISSED,
    Baseline,
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


def remembered(claims: Sequence[Claim], baseline: Baseline) -> tuple[Judged, ...]:
    """Return claims with the outcomes of the baseline."""
    return tuple(Judged(claim, baseline.outcomes.get(claim.id, {})) for claim in claims)


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
    sign = {"below": "≤ ", "above": "≥ "}.get(claim.rule, "")
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


def markdown(rows: Sequence[Judged]) -> str:
    """Return the tables of docs/reproduction.md: a section a use, and under it why rows are missed."""
    parts = []
    for use in USES:
        chosen = [row for row in rows if row.claim.use == use]
        lines = [
            f"### {TITLES[use]}",
            "",
            _counted(chosen),
            "",
            "| row | statement | published | analytical | twin |",
            "| --- | --- | --- | --- | --- |",
            *map(_line, chosen),
        ]
        why = list(dict.fromkeys(_reasons(chosen)))
        parts += [
            "\n".join(lines),
            *(["\n".join(["Missed, and why as far as known:", "", *why])] if why else []),
        ]
    return "\n\n".join(parts)


def _counted(rows: Sequence[Judged]) -> str:
    told = []
    for column, name in (("twin", "twin"), ("analytical", "analytical"), ("alone", "without a plant")):
        found = count(rows, column)
        if found["all"]:
            told.append(f"{name} {found[MET]} of {found['all']} met, {found[EXPLAINED]} explained")
    return f"{'; '.join(told)}."


def _line(row: Judged) -> str:
    claim = row.claim
    unit = "" if claim.unit == "1" or claim.value is None else f" {claim.unit}"
    cells = [_marked(row.outcomes.get(name)) for name in ("analytical", "twin")]
    if "alone" in row.outcomes:
        cells = [_marked(row.outcomes["alone"]), ""]
    says = f"{claim.says} ({claim.source})"
    return (
        "| "
        + " | ".join([f"`{claim.id}`", says, f"{published(claim)}{unit}", *cells]).replace("\n", " ")
        + " |"
    )


def _marked(outcome: Outcome | None) -> str:
    if outcome is None:
        return ""
    mark = {MET: "", EXPLAINED: "*", MISSED: "**"}[outcome.verdict]
    return f"{mark}{cell(outcome)}{mark}"


def _reasons(rows: Sequence[Judged]) -> list[str]:
    found: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        for column, outcome in row.outcomes.items():
            if outcome.verdict != MET:
                why = outcome.why or "not known"
                found.setdefault((row.claim.id, f"{outcome.verdict}: {why}"), []).append(column)
    return [f"- `{name}` ({', '.join(columns)}) {why}" for (name, why), columns in found.items()]


def between(page: str, name: str, text: str) -> str:
    """Return a page with a text between its marks of this name.

    Args:
        page: with ``<!-- name: begin -->`` and ``<!-- name: end -->``.
        name: of the marks.
        text: what is to stand there.
    """
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, _, rest = page.partition(begin)
    _, _, after = rest.partition(end)
    return f"{before}{begin}\n{text}\n{end}{after}"


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
        figures=[picture(figure, f"{each.number}: {each.caption}") for each, figure in figures],
        versions=Table(["package", "version"], list(versions().items())),
    )
    with atomic_write(path) as part:
        part.write_text(content, "utf-8")


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
