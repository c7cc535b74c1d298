"""`srs-twin optimize`: which robot and gait are best, by many cheap runs and few of the twin."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from srs_twin.cli.console import interruptible, say
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    JsonOption,
    QuietOption,
    argument,
    jobs_option,
    option,
    print_json,
)
from srs_twin.cli.progress import RunCounter

if TYPE_CHECKING:
    from srs_twin.studies.optimization.answer import Answer
    from srs_twin.studies.optimization.loading import Study
    from srs_twin.studies.sweep.task import Row

STUDIES = Path("runs/studies")
_COLUMNS = 6


def optimize(
    given: Annotated[str, argument("STUDY", shipped=["study"])],
    out: Annotated[str | None, option("--out DIR")] = None,
    engine: Annotated[str, option("--engine NAME")] = "local",
    workers: Annotated[int | None, jobs_option("--workers N")] = None,
    address: Annotated[str | None, option("--address HOST:PORT")] = None,
    changed: Annotated[bool, option("--changed")] = False,
    changed_fields: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find the best robot or gait for a question in a file.

    Searches the analytical model compliant, and corrects it by few runs of the twin; every result is the
    twin's. What an earlier start left in the folder is kept, and it goes on from there.

    Options:
        given: A shipped study or a file.
        out: Folder of results. [default: runs/studies/STUDY]
        engine: Who runs the designs: local, ray or warp.
        address: Of a Ray cluster, or the device of warp, as cuda:0. [default: this machine's]
        changed: Go on in a folder of another version; keep what still belongs.
    """
    from srs_twin.studies.sweep.command import chosen_engine

    runner = chosen_engine(engine, workers, address)
    from srs_twin.studies.optimization.answer import Answer
    from srs_twin.studies.optimization.loading import load_study
    from srs_twin.studies.optimization.runs import Runs
    from srs_twin.studies.optimization.search import TOLD, search

    study = load_study(given, set=changed_fields.changes())
    folder = Path(out) if out else STUDIES / study.name
    budget = study.file.budget
    total = budget.twin + (budget.compliant if "compliant" in study.experiments else 0)
    total += 1 + TOLD * (2 + budget.uncertain) + budget.uncertain  # of what the best are worth
    best = _Best(study)
    with RunCounter(study.name, total, quiet=quiet, status=best.text) as counting:

        def told(part: str, row: Row) -> None:
            best.take(part, row)
            counting(failed=row.exit_code != 0)

        with interruptible(f"what was run is kept in {folder}, start again to go on"):
            with Runs(study, folder, runner, told, changed=changed) as runs:
                answer = Answer.of(study, search(study, runs), runs)
            # Here: matplotlib's import would delay the search.
            from srs_twin.studies.optimization.report import write_answer

            files = write_answer(answer, folder)
    if as_json:
        print_json(answer.document())
    elif not quiet:
        _show(answer)
    say(f"files in {folder}: {', '.join(files)}", quiet=quiet)


class _Best:
    """The best result so far of the first objective that keeps the constraints, for the line of progress."""

    def __init__(self, study: Study) -> None:
        self._study, self._values = study, dict[str, float]()

    def take(self, part: str, row: Row) -> None:
        """Take a run that has finished."""
        import numpy as np

        from srs_twin.studies.optimization.runs import Run
        from srs_twin.studies.optimization.search import excesses

        run, objective = Run(part, np.zeros(0), row), self._study.file.objectives[0]
        value, best = run.metric(objective.metric), max if objective.goal == "maximize" else min
        if value == value and not (excesses(self._study, [run]) > 0).any():
            self._values[part] = best(value, self._values.get(part, value))

    def text(self) -> str:
        """Return it in words."""
        return ", ".join(f"{part} {value:.4g}" for part, value in self._values.items())


def _show(answer: Answer) -> None:
    """Print the best designs, and what the page says of them."""
    from srs_twin.identification.fitting import print_table
    from srs_twin.studies.optimization.report import bound_lines, marked, share_text
    from srs_twin.viewing.plots.labels import field_label, metric_label

    study, told = answer.study, answer.document()
    shown = told["best"][:_COLUMNS]
    lines = []
    for name in study.space.variables:
        values = [marked(each["variables"][name], name in each["on_bound"]) for each in shown]
        lines.append((field_label(name), "", *values))
    for name in answer.metrics:
        results = [told["begun"][name], *(each["metrics"][name] for each in shown)]
        lines.append((metric_label(name), *("–" if value is None else f"{value:.4g}" for value in results)))
    print_table(("", "as it stands", *(f"best/{k + 1}" for k in range(len(shown)))), lines, left=(0,))
    if len(told["best"]) > _COLUMNS:
        print(f"{len(told['best'])} designs on the front; study.json has all")
    for line in bound_lines(answer):
        print(line)
    for k, each in enumerate(told["best"][:3]):
        if (share := each["beats_next"]) is not None:
            print(f"best/{k + 1} is better than best/{k + 2} for {100 * share:.0f} % of the drawn robots")
        for metric, gain in each["gains"].items():
            ends = gain["interval_95"]
            sure = "" if ends is None else f" (95 %: {share_text(ends[0])} to {share_text(ends[1])})"
            print(f"best/{k + 1}: {metric_label(metric)} {share_text(gain['share'])}{sure}")
        if not each["keeps_constraints"]:
            print(
                f"best/{k + 1}: it misses the constraints, as every run of the twin did; it misses them least"
            )
        if not each["survives"]:
            print(f"best/{k + 1}: more than 1 % changes as the twin is refined")
    counts = ", ".join(f"{count} runs of {part}" for part, count in told["evaluations"].items())
    print(counts)
