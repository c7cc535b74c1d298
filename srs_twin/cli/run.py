"""Commands `srs-twin run` and `compare`, which run scenarios."""

from __future__ import annotations

import os
import shlex
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from srs_twin.cli.cases import Case, CaseResult
from srs_twin.cli.console import (
    RunCounter,
    ScenarioProgress,
    interruptible,
    say,
    show_traceback,
)
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    CheckOption,
    JsonOption,
    OneOutOption,
    QuietOption,
    ScenarioArgument,
    StrictOption,
    WorkersOption,
    argument,
    parse_plants,
    print_json,
)
from srs_twin.errors import InputError, SrsError
from srs_twin.extensions import plugins

if TYPE_CHECKING:
    from srs_twin.io.documents import Override
    from srs_twin.scenario.scenario import Scenario

RUNS_FOLDER = Path("runs")


@dataclass(frozen=True)
class ReportOptions:
    """Options for reports and exit codes.

    Options:
        --junit FILE.xml: Write a JUnit XML report of the runs and expectations to this
            file.
    """

    check: CheckOption = False
    strict: StrictOption = False
    junit: str | None = None
    quiet: QuietOption = False
    as_json: JsonOption = False

    @property
    def fails(self) -> frozenset[str]:
        """States of expectations that lead to exit code 1."""
        if self.strict:
            return frozenset({"missed", "expected_failure", "holds", "not_judged"})
        if self.check:
            return frozenset({"missed"})
        return frozenset()


DEFAULT_REPORT = ReportOptions()


def run_case(
    task: tuple[Scenario, Path],
    progress: Callable[[str, float], None] | None = None,
    *,
    plants: Sequence[str] | None = None,
    explain: bool = False,
) -> CaseResult:
    """Run a scenario in this process or in a worker process.

    Args:
        task: scenario and output folder.
        progress: callback that is passed to `PreparedRun.execute`, or None.
        plants: plants to run, by default the plants of the scenario.
        explain: whether to attribute the difference between the plants to assumptions.
    """
    from srs_twin.experiment import prepare

    start = time.perf_counter()
    options: dict[str, Any] = {}
    if explain:
        from srs_twin.attribution import explain as explain_difference

        options["explain"] = explain_difference
    elif plants is not None and len(plants) > 1:
        from srs_twin.attribution import main_cause

        options["main_cause"] = main_cause
    scenario, folder = task
    try:
        result = prepare(scenario, folder, plants=plants).execute(progress, **options)
    except InputError as error:
        return CaseResult(None, (error,), time.perf_counter() - start)
    errors = (*result.diverged, *result.failed_attributions)
    for failure in errors:
        # Trajectories are already stored in files, and sending them from a worker
        # process would be slow.
        failure.trajectory = failure.history = None
    result = replace(result, trajectories={}, diverged=(), failed_attributions=())
    return CaseResult(result, errors, time.perf_counter() - start)


def run_all(
    cases: Sequence[Case],
    report: ReportOptions,
    *,
    out: str | None,
    workers: int | None = None,
    plants: Sequence[str] | None = None,
    explain: bool = False,
    changes: Sequence[Override] = (),
) -> None:
    """Check all scenarios, run the valid ones, and exit with the highest exit code.

    With `--json`, the output for a single scenario is the content of `metrics.json`, or
    `{"scenario": …, "errors": […]}` after a failure. The output for several scenarios
    is `{"runs": […]}`.

    Args:
        cases: scenarios to run, which are loaded if necessary.
        report: options for reports and exit codes.
        out: output folder, with a subfolder for each scenario if there are several
            scenarios or if a folder of scenarios was given.
        workers: number of worker processes, by default one per processor. With one
            worker, the scenarios run in this process.
        plants: plants to run, by default the plants of each scenario.
        explain: whether to attribute the difference between the plants to assumptions.
        changes: overridden fields of the scenarios.

    Raises:
        InputError: the JUnit file or the output folder is not writable.
        typer.Exit: the exit code differs from 0.
    """

    def completed() -> str:
        folders = [
            str(case.folder) for case in cases if case.result and case.result.metrics
        ]
        return f"complete runs: {', '.join(folders) or 'none'}"

    fails = report.fails
    with ExitStack() as stack, interruptible(completed):
        if report.junit is not None:
            from srs_twin.cli.junit import report_path, write_junit

            write = partial(write_junit, report_path(report.junit), cases, fails)
            # Writing the report before the simulation reveals an unusable path and
            # replaces the report of an earlier run.
            write()
            stack.callback(write)
        valid = _load(cases, out, report.quiet, changes, plants)
        function = partial(run_case, plants=plants, explain=explain)
        runs = stack.enter_context(
            closing(_run(valid, function, workers, quiet=report.quiet))
        )
        for case in runs:
            _print_result(case, report, changes)
    if report.as_json:
        documents = [case.document() for case in cases]
        if len(documents) == 1:
            print_json(documents[0])
        else:
            print_json({"runs": documents})
    results = [case.result for case in cases if case.result]
    if fails and not report.quiet:
        _print_tally(results)
    code = max((result.exit_code(fails) for result in results), default=0)
    if code:
        raise typer.Exit(code)


def _print_tally(results: Sequence[CaseResult]) -> None:
    from srs_twin.scenario.expectation import tally

    verdicts = sum((result.verdicts for result in results), Counter())
    text = f"expectations: {tally(verdicts)}"
    left_out = sum(len(result.metrics.get("left_out", ())) for result in results)
    if left_out:
        text += f", {left_out} left out"
    say(text)


def make_cases(names: Sequence[str]) -> list[Case]:
    """Return one case per scenario, given scenario names, files or folders."""
    from srs_twin.io.files import shipped_names

    in_folder: dict[str, bool] = {}
    for name in names:
        # A shipped scenario takes precedence over a folder of the same name. For a name
        # that is too long, `isdir` returns False, whereas `glob` would raise an error.
        is_folder = name not in shipped_names("scenario") and os.path.isdir(name)
        files: list[str] = []
        if is_folder:
            files = sorted(map(str, Path(name).glob("*.yaml")))
        for source in files or [name]:
            in_folder.setdefault(source, bool(files))
    return [Case(source, in_folder=within) for source, within in in_folder.items()]


def _load(
    cases: Sequence[Case],
    out: str | None,
    quiet: bool,
    changes: Sequence[Override],
    plants: Sequence[str] | None,
) -> list[Case]:
    """Load and check scenarios, print errors and return the valid cases."""
    from srs_twin.experiment import check_run
    from srs_twin.io.files import check_output_folder
    from srs_twin.scenario.loading import load_scenario

    base = Path(out) if out else RUNS_FOLDER
    folders: set[Path] = set()
    for case in cases:
        with _record_input_errors(case):
            scenario = case.scenario or load_scenario(case.source, set=changes)
            case.scenario = scenario = scenario.run_on(plants)
            if out and len(cases) == 1 and not case.in_folder:
                case.folder = base
            else:
                case.folder = base / scenario.name
            if case.folder in folders:
                raise InputError(
                    f"{case.source}: another scenario is also named"
                    f" '{scenario.name}' and would be written to the same folder"
                    f" {case.folder}; rename one of the scenarios"
                )
            folders.add(case.folder)
    valid = [case for case in cases if case.result is None]
    if len(valid) > 1:
        # An unusable folder is reported once instead of for every scenario.
        check_output_folder(base)
    for case in valid:
        with _record_input_errors(case):
            assert case.scenario is not None
            check_run(case.scenario, case.folder)
    valid = [case for case in valid if case.result is None]
    for case in valid:
        assert case.scenario is not None
        say(*(f"warning: {warning}" for warning in case.scenario.warnings), quiet=quiet)
    return valid


@contextmanager
def _record_input_errors(case: Case) -> Iterator[None]:
    try:
        yield
    except InputError as error:
        say(str(error))
        case.result = CaseResult(None, (error,))


def _run(
    cases: Sequence[Case],
    function: Callable[..., CaseResult],
    workers: int | None,
    *,
    quiet: bool,
) -> Generator[Case, None, None]:
    """Run cases and yield completed cases in the given order."""
    from srs_twin.compute.workers import processor_count, run_tasks

    workers = min(workers or processor_count(), len(cases))
    tasks = [(case.scenario, case.folder) for case in cases]
    if workers <= 1:
        for case, task in zip(cases, tasks, strict=True):
            with ScenarioProgress(case.name, quiet=quiet) as progress:
                case.result = function(task, progress)
            yield case
        return
    yielded = 0
    with (
        RunCounter("scenarios", len(cases), quiet=quiet) as counter,
        closing(run_tasks(function, tasks, workers=workers)) as results,
    ):
        for done in results:
            case = cases[done.number]
            case.result = done.result or CaseResult(
                None, (_add_name(case, done.error),)
            )
            counter(failed=bool(case.result.errors))
            with counter.hidden():
                while yielded < len(cases) and cases[yielded].result is not None:
                    yield cases[yielded]
                    yielded += 1


def _add_name(case: Case, error: Exception | None) -> SrsError:
    assert isinstance(error, SrsError)
    error.args = (f"{case.name}: {error}",)
    return error


def _print_result(
    case: Case, report: ReportOptions, changes: Sequence[Override]
) -> None:
    from srs_twin.cli.table import expectation_lines, show

    result = case.result
    assert result is not None, "the case is complete"
    if result.run is not None and result.metrics:
        if not report.quiet:
            if not report.as_json:
                show(result.run)
            say(f"files in {case.folder}; {_viewing_hint(case.folder)}")
            _suggest_explanation(case, result, changes)
        elif report.fails and not report.as_json:
            shown = report.fails | {"holds", "not_judged"}
            say(*expectation_lines(result.metrics, shown))
    for error in result.errors:
        show_traceback(error)
        say(str(error))


def _viewing_hint(folder: Path) -> str:
    from srs_twin.experiment import RECORDING

    if (folder / RECORDING).is_file():
        return f"`srs-twin view {shlex.quote(str(folder))}` shows the run"
    return "no recording was written, because rerun-sdk is not installed"


def _suggest_explanation(
    case: Case, result: CaseResult, changes: Sequence[Override]
) -> None:
    from srs_twin.cli.table import needs_explanation

    if not needs_explanation(result.metrics):
        return
    words = [case.source]
    for change in changes:
        words += change.label.split(" ", 1)
    for plugin in plugins().values():
        words += ["--plugin", plugin]
    say(
        f"to find the causes of the difference: `srs-twin compare {shlex.join(words)}"
        " --explain`"
    )


def compare(
    scenario: ScenarioArgument,
    out: OneOutOption = None,
    report: ReportOptions = DEFAULT_REPORT,
    explain: bool = False,
    changed: ChangeOptions = NO_CHANGES,
) -> None:
    """Simulate a scenario with both models and compare the results.

    Options:
        --explain: Also compute the contribution of each modelling assumption to the
            difference between the models.
    """
    run_all(
        make_cases([scenario]),
        report,
        out=out,
        plants=("analytical", "twin"),
        explain=explain,
        changes=changed.changes(),
    )


def run(
    scenarios: Annotated[list[str], argument("SCENARIO", shipped=["scenario"])],
    out: str | None = None,
    report: ReportOptions = DEFAULT_REPORT,
    workers: WorkersOption = None,
    plants: str | None = None,
    changed: ChangeOptions = NO_CHANGES,
) -> None:
    """Simulate one or more scenarios.

    Options:
        scenarios: Names of shipped scenarios, paths of scenario files, or folders that
            contain scenario files.
        --out DIR: Output folder. Several scenarios, or scenarios in a given folder, are
            written to subfolders. [default: runs/SCENARIO]
        --plants LIST: Models to simulate: analytical, twin, or both as analytical,twin.
            [default: the models named in the scenario]
    """
    run_all(
        make_cases(scenarios),
        report,
        out=out,
        workers=workers,
        plants=parse_plants(plants),
        changes=changed.changes(),
    )
