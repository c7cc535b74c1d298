"""Console output of `srs-twin reproduce`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from srs_twin.cli.options import print_json
from srs_twin.identification.fitting import print_table
from srs_twin.reproduction.claims import load_claims
from srs_twin.reproduction.others import load_predicted_quantities
from srs_twin.reproduction.report import (
    FACTORS,
    TITLES,
    UNVALIDATED,
    by_category,
    error_text,
    number_text,
    outcome_text,
    published_text,
    scorecard,
    summary_line,
    verdict_text,
)
from srs_twin.reproduction.verdicts import ClaimOutcome, JudgedClaim, load_baseline
from srs_twin.studies.uncertainty.metric_uncertainty import MIN_BOUNDING_SAMPLES

_FORMAT = "{:<30} {:>9} {:>11} {:>11} {:>6}  {}"


def print_scorecard(*, as_json: bool) -> None:
    """Print the credibility grades of all capabilities."""
    grades = scorecard(load_claims(), load_baseline())
    if as_json:
        print_json(
            {
                name: {factor: asdict(grade) for factor, grade in row.items()}
                for name, row in grades.items()
            }
        )
        return
    for name, row in grades.items():
        lines = (
            (
                factor,
                str(row[factor].grade),
                row[factor].why.removesuffix(f"; {UNVALIDATED}"),
            )
            for factor in FACTORS
        )
        print_table((name, "grade", "because"), lines, left=(0, 2))
    print(f"Grades 0 to 4 after NASA-STD-7009. Everything here is {UNVALIDATED}.")


def print_others(*, as_json: bool) -> None:
    """Print the predicted and published motion of robots from other laboratories."""
    rows = load_predicted_quantities()
    if as_json:
        print_json({"robots": [row.document() for row in rows]})
        return
    compared = [row for row in rows if row.published is not None]
    lines: list[tuple[str, ...]] = []
    notes: dict[str, str] = {}
    for row in compared:
        published = row.published
        assert published is not None
        lines.append((row.robot, row.quantity, *row.predicted.cells(published)))
        if row.recomputed:
            lines.append(("  recomputed", "", *row.recomputed.cells(published)))
        note = (
            f"{row.robot}: predicted in commit {row.prediction_commit or '(none)'},"
            f" compared in commit {row.comparison_commit or '(none)'}"
        )
        if published.known:
            note += ", published values known before"
        if published.of == "simulation":
            note += ", published values simulated by its builders"
        notes[row.robot] = note
    print_table(
        ("robot", "quantity", "95 % interval", "published", "result"),
        lines,
        left=(0, 1, 4),
    )
    print("\n".join(notes.values()))
    print(
        f"undecided: fewer than {MIN_BOUNDING_SAMPLES} robots, or too close to an end"
        " (docs/reproduction.md#robots-that-others-built)"
    )
    print(
        f"{len(rows) - len(compared)} predicted quantities without a published value:"
        " --json"
    )


def print_rows(rows: Sequence[JudgedClaim]) -> None:
    """Print one line per claim, grouped by category, and a summary."""
    print(_FORMAT.format("row", "published", "analytical", "twin", "error", "verdict"))
    for name, category_rows in by_category(rows).items():
        if category_rows:
            print(f"\n{TITLES[name]}")
        for row in category_rows:
            twin = row.outcomes.get("twin")
            first = row.outcomes.get("analytical") or row.outcomes.get("alone")
            published = published_text(row.claim)
            error = error_text(row.claim, twin or first)
            verdict = verdict_text(row) + (" (fitted)" if name == "fit" else "")
            print(
                _FORMAT.format(
                    row.claim.id,
                    published,
                    _short_text(first),
                    _short_text(twin),
                    error,
                    verdict,
                )
            )
    print(f"\n{summary_line(rows)}")


def _short_text(outcome: ClaimOutcome | None) -> str:
    """Return an outcome as text, shortening a long ordering to its end values."""
    if outcome is None:
        return ""
    text = outcome_text(outcome)
    if len(text) <= 11:
        return text
    first, last = (f"{float(number_text(outcome.values[k])):.2g}" for k in (0, -1))
    return f"{first}…{last}"
