"""Scorecard: credibility grades of each capability after NASA-STD-7009, with their reasons.

Grades range from 0 (nothing is known) to 4. They are derived from stored results: verdicts of the baseline,
intervals of `srs-twin uncertainty`, and sources of the robots' parameters.

- verification: 2 if all laws of the dissertation are met; 3 if in addition a refined time step changes a
  prediction by less than a fifth of its input uncertainty.
- validation: 2 if three quarters of the headline predictions are met, 1 if fewer, 0 if none. Predictions of
other
  groups (own tolerance, fitted robot, …) are listed but not counted. More than 2 needs own measurements;
  nothing here was validated against hardware.
- input pedigree: fraction of measured robot parameters: 3 for three quarters, 2 for two fifths, 1 for fewer.
- uncertainty: 2 if intervals were propagated from the inputs, otherwise 0.
- robustness: 2 if sensitivities are known, 1 if only trends that could have failed were checked, otherwise 0.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from srs_twin.experiment import INTERVALS
from srs_twin.io.files import data_root
from srs_twin.reproduction.claims import Category, Claim
from srs_twin.reproduction.report import TITLES
from srs_twin.reproduction.verdicts import MET, Baseline
from srs_twin.robot.file import load_robot_file

FACTORS = ("verification", "validation", "input pedigree", "uncertainty", "robustness")
UNVALIDATED = "not validated against hardware"

_CAPABILITIES = {
    "actuators": ("actuator-", "act-step-", "module-static"),
    "curvature sensor": ("sensor-", "algorithm-"),
    "crawling, generation 1": ("gen1-", "friction-"),
    "crawling, generation 2": ("gen2-", "table10"),
    "crawling, generation 3": ("gen3-",),
    "learning and turning, generation 4": ("ilc-", "table8"),
    "control of a module": ("smc-",),
    "planning": ("plan-", "eq33"),
    "following": ("follow-", "experiments", "table9"),
}
_OTHER_GROUPS: dict[Category, str] = {
    "own_tolerance": "own tolerance",
    "fitted_robot": "fitted",
    "tuned_controller": "tuned",
    "chosen_obstacles": "own obstacles",
    "between_models": "models",
}
"""Category of a prediction that is not a headline → its label."""

_MOST = 0.75
"""Smallest fraction that counts as "most"."""

_MANY = 0.4
"""Smallest fraction that counts as "many"."""

_SMALL_NUMERICAL_ERROR = 0.2
"""Numerical error relative to the input uncertainty that counts as small."""


@dataclass(frozen=True)
class Grade:
    """Grade from 0 to 4 and the reason for it."""

    grade: int
    why: str


def scorecard(claims: Sequence[Claim], baseline: Baseline) -> dict[str, dict[str, Grade]]:
    """Return capability → factor → grade."""
    folder = data_root() / INTERVALS
    documents = [json.loads(path.read_text("utf-8")) for path in sorted(folder.glob("*.json"))]
    grades = {}
    for name, prefixes in _CAPABILITIES.items():
        own_claims = [claim for claim in claims if claim.id.startswith(prefixes)]
        robots = sorted({claim.robot for claim in own_claims if claim.robot})
        intervals = [document for document in documents if document["robot"] in robots]
        met = {category: _count_met(own_claims, baseline, category) for category in TITLES}
        grades[name] = {
            "verification": _verification(met["law"], intervals),
            "validation": _validation(met),
            "input pedigree": _pedigree(robots),
            "uncertainty": _uncertainty(intervals),
            "robustness": _robustness(met["shape"], intervals),
        }
    return grades


def _count_met(claims: Sequence[Claim], baseline: Baseline, category: Category) -> tuple[int, int]:
    """Return the number of rows of a category that the twin (or no plant) meets, and the number of rows."""
    verdicts = []
    for claim in claims:
        row = baseline.outcomes.get(claim.id, {})
        outcome = row.get("twin") or row.get("alone")
        if claim.category == category and outcome is not None:
            verdicts.append(outcome.verdict == MET)
    return sum(verdicts), len(verdicts)


def _verification(law: tuple[int, int], intervals: Sequence[Mapping[str, Any]]) -> Grade:
    met, rows = law
    text = f"{met} of {rows} laws met" if rows else "its laws are tests of the program"
    if met < rows:
        return Grade(1, text)
    for document in intervals:
        metric = _target(document)
        if metric["u_num"] is not None and metric["u_num"] < _SMALL_NUMERICAL_ERROR * metric["u_input"]:
            share = 100 * metric["u_num"] / metric["u_input"]
            return Grade(3, f"{text}; time step {share:.0f} % of the input uncertainty")
    return Grade(2, text)


def _validation(counts: Mapping[Category, tuple[int, int]]) -> Grade:
    met, rows = counts["headline"]
    other = ", ".join(
        f"{label} {counts[name][0]} of {counts[name][1]}"
        for name, label in _OTHER_GROUPS.items()
        if counts[name][1]
    )
    text = f"headline {met} of {rows}" if rows else "no headline"
    text += f" (separately: {other})" if other else ""
    grade = 0 if not met else 2 if met >= _MOST * rows else 1
    return Grade(grade, f"{text}; {UNVALIDATED}")


def _pedigree(robots: Sequence[str]) -> Grade:
    records = [record for name in robots for record in load_robot_file(name).records().values()]
    if not records:
        return Grade(0, "no robot")
    measured = sum(record.status == "measured" for record in records)
    share = measured / len(records)
    grade = 3 if share >= _MOST else 2 if share >= _MANY else 1
    return Grade(grade, f"{measured} of {len(records)} numbers measured")


def _uncertainty(intervals: Sequence[Mapping[str, Any]]) -> Grade:
    for document in intervals:
        metric, target = _target(document), document["target"]
        low, high = metric["interval_95"]
        published = metric["published"]
        verdict = "" if published is None else f", published {published:.3g} {metric['verdict']}"
        return Grade(2, f"{document['scenario']}, {target['metric']}: {low:.3g} to {high:.3g}{verdict}")
    return Grade(0, "no intervals")


def _robustness(trends: tuple[int, int], intervals: Sequence[Mapping[str, Any]]) -> Grade:
    text = f"{trends[0]} of {trends[1]} orders and trends met" if trends[1] else "no published trends"
    for document in intervals:
        indices = _target(document)["sensitivity"]
        if indices:
            largest = max(indices, key=lambda name: float(indices[name]["total"]))
            return Grade(2, f"most from {largest}, {100 * indices[largest]['total']:.0f} %; {text}")
    return Grade(1 if trends[1] else 0, text)


def _target(document: Mapping[str, Any]) -> Mapping[str, Any]:
    target = document["target"]
    metric: Mapping[str, Any] = document["plants"][target["plant"]][target["metric"]]
    return metric
