"""Reports of a reproduction: reproduce.json, reproduce.html, and rows as text."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.io.files import write_text
from srs_twin.reproduction.claims import COLUMNS, Category, Claim
from srs_twin.reproduction.verdicts import (
    EXPLAINED,
    MET,
    MISSED,
    Judged,
    Outcome,
    outcomes_document,
)
from srs_twin.scenario.provenance import versions
from srs_twin.viewing.html.page import Table, colored, picture, render

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srs_twin.reproduction.figures import Picture


USES = ("law", "holdout", "shape", "fit")
"""Uses in the order of the summary in reproduce.json."""

TITLES: dict[Category, str] = {
    "headline": "Headline predictions",
    "own_tolerance": "Predictions with our tolerance",
    "fitted_robot": "Predictions by a robot fitted to the same table",
    "tuned_controller": "Predictions by a controller tuned for the quantity",
    "chosen_obstacles": "Predictions with our obstacles or paths",
    "between_models": "Twin compared with the analytical model",
    "shape": "Orders and trends",
    "by_construction": "Orders and trends that could not fail",
    "law": "Laws",
    "fit": "Calibration data, not predictions",
}
"""Category → heading, in the order of the page: headline first, rows that may be fitted last."""

MEANINGS: dict[Category, str] = {
    "headline": (
        "Published quantities of robots that were not fitted to the same table. The tolerance is the "
        "dissertation's: a bound, or the difference between two values that it states for one quantity."
    ),
    "own_tolerance": "The dissertation states no tolerance; the tolerance is ours.",
    "fitted_robot": (
        "The robot was fitted to Table 8 at offsets 0 and ±0.3. A line through these three rows meets all "
        "predicted speeds and edges and three of four radii, so these rows are weak evidence for the model."
    ),
    "tuned_controller": (
        "The search for the gains of the controllers minimised overshoot and valve openings, with settling "
        "within 0.25 s and a lag of at most 0.5 rad. Rows that follow from these criteria are no evidence."
    ),
    "chosen_obstacles": "The obstacles and paths of the figures are not available; ours are simulated.",
    "between_models": "The published comparison is between model and robot, ours between our two models.",
    "shape": "Orders and trends that the simulation could have missed.",
    "by_construction": "These rows follow from symmetry or from our assumptions, so they are no evidence.",
    "law": "Laws are true by construction or theory; they test the program.",
    "fit": "Robots were calibrated with these values, or may be.",
}
"""Category → description of its rows."""

_NOTHING = "–"


def count(rows: Sequence[Judged], column: str, uses: Sequence[str] = USES) -> dict[str, int]:
    """Return how many rows of a column are "met", "explained" and "missed", and "all" of them."""
    verdicts = [
        row.outcomes[column].verdict for row in rows if row.claim.use in uses and column in row.outcomes
    ]
    return {name: verdicts.count(name) for name in (MET, EXPLAINED, MISSED)} | {"all": len(verdicts)}


def by_category(rows: Sequence[Judged]) -> dict[Category, list[Judged]]:
    """Return category → its rows, in the order of the page, including categories without rows."""
    return {name: [row for row in rows if row.claim.category == name] for name in TITLES}


def summary_line(rows: Sequence[Judged]) -> str:
    """Return in one line how many rows each plant meets, with headline predictions first."""
    names = {"twin": "the twin meets", "analytical": "the analytical model", "alone": "without a plant"}
    words = {
        "headline predictions": [row for row in rows if row.claim.group == "headline"],
        "other predictions": [row for row in rows if row.claim.group not in (None, "headline")],
        "orders and trends": by_category(rows)["shape"],
        "laws": by_category(rows)["law"],
    }
    parts = []
    for column, name in names.items():
        counts = {word: count(some, column) for word, some in words.items()}
        told = [f"{each[MET]} of {each['all']} {word}" for word, each in counts.items() if each["all"]]
        fitted = count(rows, column, ("fit",))
        if fitted["all"]:
            told.append(f"(separately: {fitted[MET]} of {fitted['all']} rows for calibration)")
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


_HEADINGS = (
    "row", "statement", "published", "allowed", "analytical", "error", "twin", "error",
    "could it have failed?", "cause of a miss",
)  # fmt: skip


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
        "groups": {
            column: {name: count(some, column) for name, some in by_category(rows).items()}
            for column in ("analytical", "twin", "alone")
        },
        "changed_from_baseline": list(changes),
        "rows": [_row(row, outcomes[row.claim.id]) for row in rows],
        "versions": versions(),
    }
    write_text(path, json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _row(row: Judged, outcomes: Any) -> dict[str, Any]:
    claim = row.claim
    names = "id source robot says use group could_fail tolerance fitted rule value unit allowed".split()
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
        TITLES[name]: Table(_HEADINGS, [_cells(row) for row in some], range(2, 8), note=MEANINGS[name])
        for name, some in by_category(rows).items()
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
        claim.could_fail or "",
        "; ".join(why),
    ]


def _colored(outcome: Outcome | None) -> str:
    if outcome is None:
        return ""
    words = {MET: "", EXPLAINED: " (explained)", MISSED: " (missed)"}[outcome.verdict]
    return colored(cell(outcome) + words, "met" if outcome.verdict == MET else "missed")
