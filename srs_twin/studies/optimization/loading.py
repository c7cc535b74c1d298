"""From a study file to a Study; everything that is wrong is reported at once, with its place."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from srs_twin.comparison.metrics import METRIC_UNITS, METRICS_LISTED
from srs_twin.errors import InputError, InputFileError, UnknownNameError, did_you_mean
from srs_twin.io.documents import Change, Document, Loc, dotted, load_yaml
from srs_twin.io.files import find, results_name
from srs_twin.io.validation import validate
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.scenario.modified import Changes, changed_fields, marked
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.optimization.file import SEGMENTS, StudyFile
from srs_twin.studies.optimization.space import Space
from srs_twin.studies.sweep.points import Experiment, leaves
from srs_twin.studies.uncertainty.study import compliant_partner


@dataclass(frozen=True)
class Study:
    """A question that can be answered.

    Attributes:
        name: of the folder of results.
        file: what was asked.
        scenario: that is changed.
        space: of designs.
        experiments: "compliant" (where that can run the scenario) and "twin" → what they run.
        document: plain data of the file.
        changes: fields that differ from the study's file; `title` names them.
    """

    name: str
    file: StudyFile
    scenario: Scenario
    space: Space
    experiments: Mapping[str, Experiment]
    document: Mapping[str, Any] = field(repr=False)
    changes: Changes = ()

    @property
    def title(self) -> str:
        """One line for people."""
        return marked(self.file.title or self.name, self.changes)


def load_study(name_or_path: str | os.PathLike[str], *, set: Sequence[Change] = ()) -> Study:
    """Load a study: a shipped name (gen2_speed) or the path of a study file.

    Args:
        name_or_path: of the study.
        set: fields of the scenario that are fixed besides those of the file; `seed` is the study's.

    Raises:
        InputError: not found or not readable.
        InputFileError: everything that is wrong with it, one line each.
    """
    path = find("study", name_or_path)
    document = load_yaml(path)
    written = copy.deepcopy(document.data)
    for change in set:
        whose = change.loc if change.loc == ("seed",) else ("fixed", dotted(change.loc))
        document.change(replace(change, loc=whose))
    file = validate(StudyFile, document, document.data)
    scenario: Scenario | None = None
    foreign: tuple[str, ...] = ()
    if file is not None:
        with document.reporting("scenario"):
            try:
                scenario = load_scenario(file.scenario)
            except InputFileError as error:
                foreign = error.lines
    study = None
    if file is not None and scenario is not None:
        _check_metrics(document, file)
        study = _study(results_name(path), document, file, scenario)
        _check_ends(document, study)
    document.finish(foreign)
    assert study is not None, "no problem was reported"
    return replace(study, changes=_changes(study, written, [change.loc for change in set]))


def _changes(study: Study, written: Mapping[str, Any], locs: Sequence[Loc]) -> Changes:
    """Return the fields that were set, those of the scenario and the study's seed."""
    after = study.experiments["twin"]
    before = replace(after, base=study.scenario.document).with_fixed(written.get("fixed") or {})
    found = changed_fields(before, after.base, [loc for loc in locs if loc != ("seed",)])
    seed: dict[str, Any] = {"seed": 0, **written}
    return found + changed_fields(seed, study.document, [loc for loc in locs if loc == ("seed",)])


def _study(name: str, document: Document, file: StudyFile, scenario: Scenario) -> Study:
    settings = scenario.document["plants"].get("twin", {})
    base: Any = {**scenario.document, "plants": {"twin": settings}, "expect": []}
    base = Experiment(base, ("twin",)).with_fixed(file.fixed)
    experiments = {"twin": Experiment(base, ("twin",))}
    partner = None
    try:
        partner = compliant_partner(parse_scenario(base, name=scenario.name))
    except InputError as error:
        document.report(("fixed",), str(error))
    if partner is not None:
        experiments = {"compliant": Experiment(partner, ("analytical",)), **experiments}
    return Study(name, file, scenario, Space(file.variables, base["robot"]), experiments, document.data)


def _check_metrics(document: Document, file: StudyFile) -> None:
    for section in ("objectives", "constraints"):
        for i, each in enumerate(getattr(file, section)):
            if each.metric not in METRIC_UNITS:
                text = str(UnknownNameError("metric", each.metric, METRIC_UNITS, METRICS_LISTED))
                document.report((section, i, "metric"), text)


def _check_ends(document: Document, study: Study) -> None:
    """Let the scenario's own checks see the least and the largest value of each variable."""
    size, said = study.space.size, set[str]()
    for i, name in enumerate(study.file.variables):
        for end, share in (("low", 0.0), ("high", 1.0)):
            shares = np.full(size, 0.5)
            shares[i] = share
            for part in study.experiments.values():
                try:
                    parse_scenario(part.document(study.space.changes(shares)), name="")
                except InputFileError as error:
                    for line in dict.fromkeys(error.lines):
                        text = line.removeprefix(": ")
                        if text in said:
                            continue
                        said.add(text)
                        unknown = "unknown key" in text and "did you mean" not in text
                        hint = did_you_mean(name, [SEGMENTS, *leaves(part.base)]) if unknown else ""
                        document.report(("variables", name, end), text + hint)
