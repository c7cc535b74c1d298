"""Reports of a reproduction as JSON, HTML and text, and a scorecard.

The scorecard grades the credibility of each capability according to NASA-STD-7009 and
states the reason for each grade. Grades range from 0 (nothing is known) to 4. They are
computed from the verdicts of the baseline, the intervals of `srs-twin uncertainty`, and
the sources of the robot parameters.

- Verification has grade 1 if a law of the dissertation is missed, and otherwise grade 2
  or 3. Grade 3 requires that a smaller time step changes a prediction by less than a
  fifth of the prediction's input uncertainty.
- Validation has grade 2 if at least three quarters of the headline predictions are met,
  grade 1 if fewer are met, and grade 0 if none is met. Other predictions are listed,
  but do not affect the grade. A higher grade would require validation against our own
  hardware measurements.
- Input pedigree has grade 3 if at least three quarters of the robot parameters are
  measured, grade 2 for at least two fifths, and grade 1 for a smaller fraction.
- Uncertainty has grade 2 if input uncertainties were propagated to the results, and
  otherwise grade 0.
- Robustness has grade 2 if sensitivities are known, grade 1 if only orders and trends
  were checked, and otherwise grade 0. Checks that could not have failed are ignored.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from srs_twin.experiment import INTERVALS
from srs_twin.io.files import data_root, write_text
from srs_twin.reproduction.claims import COLUMNS, Category, Claim
from srs_twin.reproduction.verdicts import (
    EXPLAINED,
    MET,
    MISSED,
    Baseline,
    ClaimOutcome,
    JudgedClaim,
    outcomes_document,
)
from srs_twin.robot.file import load_robot_file
from srs_twin.scenario.provenance import versions
from srs_twin.viewing.html import Table, colored, picture, render

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srs_twin.reproduction.figures import FigureEntry
    from srs_twin.studies.uncertainty.metric_uncertainty import (
        MetricDocument,
        UncertaintyDocument,
    )

FACTORS = ("verification", "validation", "input pedigree", "uncertainty", "robustness")
UNVALIDATED = "not validated against hardware"

CAPABILITIES = {
    "actuators": ("actuator-", "act-step-", "module-static"),
    "curvature sensor": ("sensor-", "algorithm-"),
    "crawling, generation 1": ("gen1-", "friction-"),
    "crawling, generation 2": ("gen2-", "table10"),
    "crawling, generation 3": ("gen3-",),
    "learning and turning, generation 4": ("ilc-", "table8"),
    "control of a module": ("smc-",),
    "planning": ("plan-", "eq33"),
    "following": ("follow-", "experiments", "table9"),
    "future work": ("wish.",),
}
_OTHER_GROUPS: dict[Category, str] = {
    "own_tolerance": "own tolerance",
    "fitted_robot": "fitted",
    "chosen_parameter": "chosen",
    "tuned_controller": "tuned",
    "chosen_obstacles": "own obstacles",
    "between_models": "models",
}
"""Short labels for the categories of predictions that are not headline predictions."""

_MOST = 0.75
"""Minimum fraction for grade 2 of validation and for grade 3 of input pedigree."""

_MANY = 0.4
"""Minimum fraction for grade 2 of input pedigree."""

_SMALL_NUMERICAL_ERROR = 0.2
"""Maximum ratio of numerical error to input uncertainty for grade 3 of verification."""


@dataclass(frozen=True)
class Grade:
    """Credibility grade (0 to 4) and the reason for the grade."""

    grade: int
    why: str


def scorecard(
    claims: Sequence[Claim], baseline: Baseline
) -> dict[str, dict[str, Grade]]:
    """Return the credibility grades, keyed by capability and factor."""
    folder = data_root() / INTERVALS
    documents = [
        json.loads(path.read_text("utf-8")) for path in sorted(folder.glob("*.json"))
    ]
    grades = {}
    for name, prefixes in CAPABILITIES.items():
        own_claims = [claim for claim in claims if claim.id.startswith(prefixes)]
        robots = sorted({claim.robot for claim in own_claims if claim.robot})
        intervals = [document for document in documents if document["robot"] in robots]
        met = {
            category: _count_met(own_claims, baseline, category) for category in TITLES
        }
        grades[name] = {
            "verification": verification_grade(met["law"], intervals),
            "validation": _validation(met),
            "input pedigree": _pedigree(robots),
            "uncertainty": _uncertainty(intervals),
            "robustness": _robustness(met["shape"], intervals),
        }
    return grades


def _count_met(
    claims: Sequence[Claim], baseline: Baseline, category: Category
) -> tuple[int, int]:
    verdicts = []
    for claim in claims:
        row = baseline.outcomes.get(claim.id, {})
        outcome = row.get("twin") or row.get("alone")
        if claim.category == category and outcome is not None:
            verdicts.append(outcome.verdict == MET)
    return sum(verdicts), len(verdicts)


def verification_grade(
    law_counts: tuple[int, int], intervals: Sequence[UncertaintyDocument]
) -> Grade:
    """Return the verification grade.

    Args:
        law_counts: number of met laws, and number of all laws.
        intervals: results of `srs-twin uncertainty`.
    """
    met, rows = law_counts
    text = "its laws are tests of the program"
    if rows:
        text = f"{met} of {rows} laws met"
    if met < rows:
        return Grade(1, text)
    for metric in map(_target, intervals):
        error = metric["u_num"]
        spread = metric["u_input"]
        if error is not None and error < _SMALL_NUMERICAL_ERROR * spread:
            fraction = (
                f"time step {100 * error / spread:.0f} % of the input uncertainty"
            )
            return Grade(3, f"{text}; {fraction}")
    return Grade(2, text)


def _validation(counts: Mapping[Category, tuple[int, int]]) -> Grade:
    met, rows = counts["headline"]
    text = f"headline {met} of {rows}" if rows else "no headline"
    others = [
        f"{label} {counts[name][0]} of {counts[name][1]}"
        for name, label in _OTHER_GROUPS.items()
        if counts[name][1]
    ]
    if others:
        text += f" (separately: {', '.join(others)})"
    grade = 0
    if met:
        grade = 2 if met >= _MOST * rows else 1
    return Grade(grade, f"{text}; {UNVALIDATED}")


def _pedigree(robots: Sequence[str]) -> Grade:
    records = [
        record for name in robots for record in load_robot_file(name).records().values()
    ]
    if not records:
        return Grade(0, "no robot")
    measured = sum(record.status == "measured" for record in records)
    fraction = measured / len(records)
    grade = 1 + (fraction >= _MANY) + (fraction >= _MOST)
    return Grade(grade, f"{measured} of {len(records)} parameters measured")


def _uncertainty(intervals: Sequence[UncertaintyDocument]) -> Grade:
    if not intervals:
        return Grade(0, "no intervals")
    document = intervals[0]
    metric = _target(document)
    low, high = metric["interval_95"]
    name = document["target"]["metric"]
    text = f"{document['scenario']}, {name}: {low:.3g} to {high:.3g}"
    if metric["published"] is not None:
        text += f", published {metric['published']:.3g} {metric['verdict']}"
    return Grade(2, text)


def _robustness(
    trends: tuple[int, int], intervals: Sequence[UncertaintyDocument]
) -> Grade:
    met, rows = trends
    text = f"{met} of {rows} orders and trends met" if rows else "no published trends"
    for metric in map(_target, intervals):
        totals = {
            name: float(index["total"])
            for name, index in (metric["sensitivity"] or {}).items()
        }
        if totals:
            largest = max(totals, key=totals.__getitem__)
            fraction = 100 * totals[largest]
            return Grade(2, f"most from {largest}, {fraction:.0f} %; {text}")
    return Grade(1 if rows else 0, text)


def _target(document: UncertaintyDocument) -> MetricDocument:
    target = document["target"]
    return document["plants"][target["plant"]][target["metric"]]


USES = ("law", "holdout", "shape", "fit")
"""Uses of claims, in the order of the summary in reproduce.json."""

TITLES: dict[Category, str] = {
    "headline": "Headline predictions",
    "own_tolerance": "Predictions with our tolerance",
    "fitted_robot": "Predictions by a robot fitted to the same table",
    "chosen_parameter": "Predictions with a parameter chosen in view of the value",
    "tuned_controller": "Predictions by a controller tuned for the quantity",
    "chosen_obstacles": "Predictions with our obstacles or paths",
    "between_models": "Twin compared with the analytical model",
    "shape": "Orders and trends",
    "by_construction": "Orders and trends that could not fail",
    "law": "Laws",
    "fit": "Calibration data, not predictions",
}
"""Headings of the categories, in the order in which reports list the categories."""

MEANINGS: dict[Category, str] = {
    "headline": (
        "Published quantities of robots that were not fitted to the same table. The"
        " tolerance is the dissertation's: a bound, or the difference between two"
        " values that it states for one quantity."
    ),
    "own_tolerance": "The dissertation states no tolerance; the tolerance is ours.",
    "fitted_robot": (
        "The robot was fitted to Table 8 at offsets 0 and ±0.3. A line through these"
        " three rows meets all predicted speeds and edges and three of four radii, so"
        " these rows are weak evidence for the model."
    ),
    "chosen_parameter": (
        "The time constants of generation 1 were chosen with its speed in view."
    ),
    "tuned_controller": (
        "The search for the gains of the controllers minimised rise time and overshoot."
        " For direct SMC, it also minimised valve openings, with settling within 0.25 s"
        " and a lag of at most 0.5 rad. Rows that follow from these criteria are no"
        " evidence."
    ),
    "chosen_obstacles": (
        "The obstacles and paths of the figures are not available; ours are simulated."
    ),
    "between_models": (
        "The published comparison is between model and robot, ours between our two"
        " models."
    ),
    "shape": "Orders and trends that the simulation could have missed.",
    "by_construction": (
        "These rows follow from symmetry or from our assumptions, so they are no"
        " evidence."
    ),
    "law": "Laws are true by construction or theory; they test the program.",
    "fit": "Robots were, or may be, calibrated with these values.",
}
"""Description of the claims in each category."""

_NOTHING = "–"


def count_verdicts(
    rows: Sequence[JudgedClaim], column: str, uses: Sequence[str] = USES
) -> dict[str, int]:
    """Return the number of claims in a column, by verdict and in total ("all")."""
    verdicts = [
        row.outcomes[column].verdict
        for row in rows
        if row.claim.use in uses and column in row.outcomes
    ]
    counts = {name: verdicts.count(name) for name in (MET, EXPLAINED, MISSED)}
    return {**counts, "all": len(verdicts)}


def by_category(rows: Sequence[JudgedClaim]) -> dict[Category, list[JudgedClaim]]:
    """Group claims by category."""
    return {
        name: [row for row in rows if row.claim.category == name] for name in TITLES
    }


def summary_line(rows: Sequence[JudgedClaim]) -> str:
    """Return a sentence that states how many claims each plant meets."""
    columns = {
        "twin": "the twin meets",
        "analytical": "the analytical model",
        "alone": "without a plant",
    }
    categories = by_category(rows)
    groups = {
        "headline predictions": categories["headline"],
        "other predictions": [
            row for name in _OTHER_GROUPS for row in categories[name]
        ],
        "orders and trends": categories["shape"],
        "laws": categories["law"],
    }
    sentences = []
    for column, name in columns.items():
        texts = []
        for label, group in groups.items():
            count = count_verdicts(group, column)
            if count["all"]:
                texts.append(f"{count[MET]} of {count['all']} {label}")
        text = f"{name} {', '.join(texts)}".rstrip()
        fitted = count_verdicts(rows, column, ("fit",))
        if fitted["all"]:
            count_text = f"{fitted[MET]} of {fitted['all']} rows for calibration"
            text += f" (separately: {count_text})"
        if texts or fitted["all"]:
            sentences.append(text)
    return f"Of {len(rows)} rows {'; '.join(sentences)}."


def published_text(claim: Claim) -> str:
    """Return the published value of a claim as text, or "order" for an ordering."""
    if claim.value is None:
        return "order"
    sign = {"below": "≤ ", "above": "≥ "}.get(str(claim.rule), "")
    return f"{sign}{number_text(claim.value)}"


def outcome_text(outcome: ClaimOutcome | None) -> str:
    """Return the value of an outcome as text, or the values of an ordering."""
    if outcome is None:
        return _NOTHING
    if math.isfinite(outcome.value):
        return number_text(outcome.value)
    known = [value for value in outcome.values if math.isfinite(value)]
    if len(known) < len(outcome.values) or not known:
        return _NOTHING
    return (" > " if outcome.verdict == MET else ", ").join(map(number_text, known))


def number_text(value: float) -> str:
    """Return a number with three significant digits, or an integer with all digits."""
    if value == 0:
        return "0"
    if float(value).is_integer() and abs(value) < 1e6:
        return str(int(value))
    return f"{value:.3g}"


def error_text(claim: Claim, outcome: ClaimOutcome | None) -> str:
    """Return the relative error in per cent as text.

    The text is empty if the error is undefined or the rule is not `near`.
    """
    if outcome is None or claim.rule != "near" or not math.isfinite(outcome.error):
        return ""
    rounded = round(100 * outcome.error)
    return f"{rounded:+d} %" if rounded else "0 %"


def verdict_text(row: JudgedClaim) -> str:
    """Return the verdict on a claim, or one verdict per column if verdicts differ."""
    verdicts = [row.outcomes[name].verdict for name in COLUMNS if name in row.outcomes]
    if len(set(verdicts)) == 1:
        return verdicts[0]
    return ", ".join(verdicts) or _NOTHING


_STORED_FIELDS = (
    "id",
    "source",
    "robot",
    "says",
    "use",
    "group",
    "could_fail",
    "tolerance",
    "fitted",
    "rule",
    "value",
    "unit",
)
"""Fields of a claim that reproduce.json contains."""

_HEADINGS = (
    "row",
    "statement",
    "published",
    "allowed",
    "analytical",
    "error",
    "twin",
    "error",
    "could it have failed?",
    "cause of a miss",
)


def write_json(path: Path, rows: Sequence[JudgedClaim], changes: Sequence[str]) -> None:
    """Write the claims and their outcomes to a JSON file atomically.

    Raises:
        InputError: the file cannot be written.
    """
    outcomes = outcomes_document(rows)
    document = {
        "summary": {
            column: {use: count_verdicts(rows, column, (use,)) for use in USES}
            for column in COLUMNS
        },
        "groups": {
            column: {
                name: count_verdicts(group, column)
                for name, group in by_category(rows).items()
            }
            for column in COLUMNS
        },
        "changed_from_baseline": list(changes),
        "rows": [_row(row, outcomes[row.claim.id]) for row in rows],
        "versions": versions(),
    }
    write_text(
        path, json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    )


def _row(row: JudgedClaim, outcomes: object) -> dict[str, object]:
    claim = row.claim
    stored = {name: getattr(claim, name) for name in _STORED_FIELDS}
    return stored | {"allowed": claim.allowed_text, "outcomes": outcomes}


def write_html(
    path: Path,
    rows: Sequence[JudgedClaim],
    figures: Sequence[tuple[FigureEntry, Figure]],
    changes: Sequence[str],
) -> None:
    """Write the report as a self-contained HTML page atomically.

    Raises:
        InputError: the file cannot be written.
    """
    sections = {
        TITLES[name]: Table(
            _HEADINGS, [_cells(row) for row in group], range(2, 8), note=MEANINGS[name]
        )
        for name, group in by_category(rows).items()
    }
    content = render(
        "reproduction/report.html",
        title="The dissertation, reproduced",
        subtitle=summary_line(rows),
        changes=changes,
        sections=sections,
        figures=[
            picture(figure, f"Fig. {entry.figure}: {entry.caption}")
            for entry, figure in figures
        ],
        versions=Table(["package", "version"], list(versions().items())),
    )
    write_text(path, content)


def _cells(row: JudgedClaim) -> list[str]:
    claim = row.claim
    outcomes = row.outcomes
    published = published_text(claim)
    if claim.unit != "1" and claim.value is not None:
        published += f" {claim.unit}"
    first = outcomes.get("analytical") or outcomes.get("alone")
    second = outcomes.get("twin")
    reasons = dict.fromkeys(outcome.why for outcome in outcomes.values() if outcome.why)
    return [
        claim.id,
        f"{claim.says} ({claim.source})",
        published,
        claim.allowed_text,
        _colored_outcome(first),
        error_text(claim, first),
        _colored_outcome(second),
        error_text(claim, second),
        claim.could_fail or "",
        "; ".join(reasons),
    ]


def _colored_outcome(outcome: ClaimOutcome | None) -> str:
    if outcome is None:
        return ""
    note = {MET: "", EXPLAINED: " (explained)", MISSED: " (missed)"}[outcome.verdict]
    style = "met" if outcome.verdict == MET else "missed"
    return colored(outcome_text(outcome) + note, style)
