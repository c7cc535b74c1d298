"""Command `srs-twin optimize`, which searches for the best robot or gait."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from srs_twin.cli.console import RunCounter, interruptible, say
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    JsonOption,
    QuietOption,
    argument,
    print_json,
)
from srs_twin.studies.sweep.command import DEFAULT_STUDY, StudyOptions

if TYPE_CHECKING:
    from srs_twin.studies.optimization.loading import OptimizationStudy
    from srs_twin.studies.optimization.result import (
        DesignDocument,
        StudyDocument,
        StudyResult,
    )
    from srs_twin.studies.sweep.task import Row

STUDIES = Path("runs/studies")

_MAX_COLUMNS = 6
"""Maximum number of designs in the printed table."""


def optimize(
    name: Annotated[str, argument("STUDY", shipped=["study"])],
    out: str | None = None,
    options: StudyOptions = DEFAULT_STUDY,
    changed_fields: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find the best robot or gait for the objectives of a study.

    The search combines many runs of the analytical model `compliant` with a few runs of
    the twin. All reported results come from the twin. To resume an interrupted search,
    run the command again with the same output folder.

    Options:
        name: Name of a shipped study, or path of a study file.
        --out DIR: Output folder. [default: runs/studies/STUDY]
    """
    runner = options.make_engine()
    from srs_twin.studies.optimization.loading import load_study
    from srs_twin.studies.optimization.optimize import optimize as run_study

    study = load_study(name, set=changed_fields.changes())
    folder = Path(out) if out else STUDIES / study.name
    best = _BestSoFar(study)
    with (
        interruptible(f"finished runs are kept in {folder}; start again to resume"),
        RunCounter(study.name, 0, quiet=quiet, status=best.text) as counting,
    ):

        def follow(part: str, total: int, row: Row | None) -> None:
            if row is not None:
                best.add(part, row)
            counting.follow(study.name, total, row)

        result = run_study(
            study, out=folder, engine=runner, changed=options.changed, progress=follow
        )
    if as_json:
        print_json(result.document())
    elif not quiet:
        _print_result(result)
    say(f"files in {folder}: {', '.join(result.files)}", quiet=quiet)


class _BestSoFar:
    def __init__(self, study: OptimizationStudy) -> None:
        self._study = study
        self._values = dict[str, float]()

    def add(self, part: str, row: Row) -> None:
        import numpy as np

        from srs_twin.studies.optimization.runs import Run
        from srs_twin.studies.optimization.search import excesses

        run = Run(part, np.zeros(0), row)
        objective = self._study.file.objectives[0]
        value = run.metric(objective.metric)
        best = max if objective.goal == "maximize" else min
        if math.isfinite(value) and (excesses(self._study, [run]) <= 0).all():
            self._values[part] = best(value, self._values.get(part, value))

    def text(self) -> str:
        return ", ".join(f"{part} {value:.4g}" for part, value in self._values.items())


def _print_result(result: StudyResult) -> None:
    from srs_twin.studies.optimization.report import bound_lines, run_counts

    document = result.document()
    _print_designs(result, document)
    for line in bound_lines(document):
        print(line)
    for k, design in enumerate(document["best"][:3], start=1):
        for line in _design_lines(design, k):
            print(f"best/{k}{line}")
    if result.improvement is not None:
        print(
            "one more run of the twin is expected to improve the best result by"
            f" {100 * result.improvement:.2g} %"
        )
    if result.warning:
        print(f"warning: {result.warning}")
    print(run_counts(document))


def _print_designs(result: StudyResult, document: StudyDocument) -> None:
    from srs_twin.identification.fitting import print_table
    from srs_twin.studies.optimization.report import mark_bound
    from srs_twin.viewing.html import cell
    from srs_twin.viewing.plots.labels import field_label, metric_label

    shown = document["best"][:_MAX_COLUMNS]
    lines = []
    for name in result.study.space.variables:
        values = [
            mark_bound(design["variables"][name], name in design["on_bound"])
            for design in shown
        ]
        lines.append((field_label(name), "", *values))
    for name in result.metrics:
        metrics = [document["begun"], *(design["metrics"] for design in shown)]
        lines.append((metric_label(name), *(cell(values[name]) for values in metrics)))
    names = [f"best/{k}" for k in range(1, len(shown) + 1)]
    print_table(("", "initial scenario", *names), lines, left=(0,))
    if len(document["best"]) > _MAX_COLUMNS:
        print(f"{len(document['best'])} designs on the front; study.json has all")


def _design_lines(design: DesignDocument, k: int) -> Iterator[str]:
    from srs_twin.studies.optimization.report import percentage
    from srs_twin.viewing.plots.labels import metric_label

    fraction = design["beats_next"]
    if fraction is not None:
        others = f"{100 * fraction:.0f} % of the random robots"
        yield f" is better than best/{k + 1} for {others}"
    for metric, gain in design["gains"].items():
        text = f": {metric_label(metric)} {percentage(gain['fraction'])}"
        if gain["interval_95"] is not None:
            low, high = map(percentage, gain["interval_95"])
            text += f" (95 %: {low} to {high})"
        yield text
    if not design["keeps_constraints"]:
        yield (
            ": violates the constraints by the least amount; no twin run satisfies them"
        )
    if not design["survives"]:
        yield ": changes by more than 1 % with a finer time step or more hinges"
