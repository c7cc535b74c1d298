"""Function `optimize`, which searches for the best robot or gait."""

from __future__ import annotations

from dataclasses import replace

from srs_twin.io.arguments import checked
from srs_twin.io.documents import Overrides
from srs_twin.io.files import StrPath, folder_or_temporary
from srs_twin.studies.optimization.loading import OptimizationStudy, load_study
from srs_twin.studies.optimization.result import StudyResult
from srs_twin.studies.optimization.runs import StudyRuns
from srs_twin.studies.optimization.search import MAX_REPORTED, search
from srs_twin.studies.sweep.execution import Engine, Progress, make_engine, quiet
from srs_twin.studies.sweep.task import Row


@checked
def optimize(
    study: StrPath | OptimizationStudy,
    *,
    out: StrPath | None = None,
    set: Overrides = (),
    engine: str | Engine = "local",
    workers: int | None = None,
    changed: bool = False,
    progress: Progress = quiet,
) -> StudyResult:
    """Search for the best robot or gait.

    An interrupted search resumes if the function is called again with the same output
    folder.

    Args:
        study: name of a shipped study, path of a study file, or a loaded study.
        out: output folder, or None to write no files.
        set: values of scenario fields, as described in `load_study`.
        engine: name of the execution engine ("local", "ray" or "warp"), or an engine
            object.
        workers: number of parallel runs, or None for one per processor.
        changed: whether the folder may contain runs of a different version of the
            study.
        progress: callback for progress reports (see `execution.Progress`).

    Raises:
        InputError: the study is not valid, the engine is not available, or the folder
            cannot be used.
    """
    loaded = load_study(study, set=set)
    budget = loaded.file.budget
    total = budget.twin + (budget.compliant if "compliant" in loaded.experiments else 0)
    # The additional runs simulate the initial scenario with nominal and random robots,
    # and each reported design with two refinements and random robots.
    total += 1 + MAX_REPORTED * (2 + budget.uncertain) + budget.uncertain
    progress(loaded.name, total, None)

    def on_row(part: str, row: Row) -> None:
        progress(part, total, row)

    with folder_or_temporary(out) as folder:
        with StudyRuns(
            loaded, folder, make_engine(engine, workers), on_row, changed=changed
        ) as runs:
            result = StudyResult.evaluate(loaded, search(loaded, runs), runs)
        if out is None:
            return result
        # A top-level import of Matplotlib would delay the start of the search.
        from srs_twin.studies.optimization.report import write_result

        return replace(result, files=write_result(result, folder))
