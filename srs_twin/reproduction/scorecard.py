"""Scorecard: how far each capability is to be trusted, graded after NASA-STD-7009, with the figure behind it.

Grades are 0 (nothing is known) to 4, and come from what is kept: verdicts of the baseline, intervals of
`srs-twin uncertainty`, sources of the robots' numbers.

- verification: all laws of the dissertation met, 2; and a refined time step changes a prediction by less than
  a fifth of what the inputs do, 3.
- validation: headline predictions met, three quarters or more, 2; fewer, 1; none met or none there, 0.
  Predictions of other groups (tolerance of ours, fitted robot, …) are named and count for nothing. More than
  2 needs measurements of one's own: nothing here was validated against hardware.
- input pedigree: share of the robot's numbers that were measured: three quarters, 3; two fifths, 2; fewer, 1.
- uncertainty: intervals propagated from the inputs, 2; none, 0.
- robustness: sensitivities known, 2; only trends that could have failed checked, 1; neither, 0.
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
_APART: dict[Category, str] = {
    "own_tolerance": "own tolerance",
    "fitted_robot": "fitted",
    "tuned_controller": "tuned",
    "chosen_obstacles": "own obstacles",
    "between_models": "models",
}
_MOST, _MANY, _SMALL = 0.75, 0.4, 0.2


@dataclass(frozen=True)
class Grade:
    """A grade, 0 to 4, and the figure behind it."""

    grade: int
    why: str


def scorecard(claims: Sequence[Claim], baseline: Baseline) -> dict[str, dict[str, Grade]]:
    """Return capability → factor → grade."""
    kept = [json.loads(path.read_text("utf-8")) for path in sorted((data_root() / INTERVALS).glob("*.json"))]
    found = {}
    for name, beginnings in _CAPABILITIES.items():
        own = [claim for claim in claims if claim.id.startswith(beginnings)]
        robots = sorted({claim.robot for claim in own if claim.robot})
        intervals = [each for each in kept if each["robot"] in robots]
        met = {name: _met(own, baseline, name) for name in TITLES}
        found[name] = {
            "verification": _verification(met["law"], intervals),
            "validation": _validation(met),
            "input pedigree": _pedigree(robots),
            "uncertainty": _uncertainty(intervals),
            "robustness": _robustness(met["shape"], intervals),
        }
    return found


def _met(claims: Sequence[Claim], baseline: Baseline, category: Category) -> tuple[int, int]:
    """Return how many rows of a category the twin meets, or the program without a plant, and of how many."""
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
        spread = _target(document)
        if spread["u_num"] is not None and spread["u_num"] < _SMALL * spread["u_input"]:
            share = 100 * spread["u_num"] / spread["u_input"]
            return Grade(3, f"{text}; time step {share:.0f} % of the inputs' spread")
    return Grade(2, text)


def _validation(counts: Mapping[Category, tuple[int, int]]) -> Grade:
    met, rows = counts["headline"]
    apart = ", ".join(
        f"{words} {counts[name][0]} of {counts[name][1]}" for name, words in _APART.items() if counts[name][1]
    )
    text = f"headline {met} of {rows}" if rows else "no headline"
    text += f" (apart: {apart})" if apart else ""
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
        spread, target = _target(document), document["target"]
        low, high = spread["interval_95"]
        stated = spread["published"]
        verdict = "" if stated is None else f", published {stated:.3g} {spread['verdict']}"
        return Grade(2, f"{document['scenario']}, {target['metric']}: {low:.3g} to {high:.3g}{verdict}")
    return Grade(0, "no intervals")


def _robustness(trends: tuple[int, int], intervals: Sequence[Mapping[str, Any]]) -> Grade:
    text = f"{trends[0]} of {trends[1]} orders and trends met" if trends[1] else "no published trends"
    for document in intervals:
        indices = _target(document)["sensitivity"]
        if indices:
            most = max(indices, key=lambda name: float(indices[name]["total"]))
            return Grade(2, f"most from {most}, {100 * indices[most]['total']:.0f} %; {text}")
    return Grade(1 if trends[1] else 0, text)


def _target(document: Mapping[str, Any]) -> Mapping[str, Any]:
    found: Mapping[str, Any] = document["plants"][document["target"]["plant"]][document["target"]["metric"]]
    return found
