"""`srs-twin run` and `compare`: execution of scenarios, in this process or in worker processes."""

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
    JobsOption,
    JsonOption,
    OneOutOption,
    QuietOption,
    ScenarioArgument,
    StrictOption,
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
    """Reports of runs, and the expectations that set the exit code to 1.

    Options:
        --junit FILE.xml: Write a JUnit XML report of runs and expectations.
    """

    check: CheckOption = False
    strict: StrictOption = False
    junit: str | None = None
    quiet: QuietOption = False
    as_json: JsonOption = False

    @property
    def fails(self) -> frozenset[str]:
        """States of expectations (`scenario.expectation.verdict`) that set the exit code to 1."""
        if self.strict:
            return frozenset({"missed", "known", "holds", "not_judged"})
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
    """Run a scenario, in this process or in a worker process.

    Args:
        task: scenario and output folder.
        progress: callback of `PreparedRun.execute`.
        plants: plants to run; default: those of the scenario.
        explain: add the attribution of the difference.
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
        # Drop the trajectories: they are in files, and a worker process should not send
        # them as well.
        failure.trajectory = failure.history = None
    result = replace(result, trajectories={}, diverged=(), failed_attributions=())
    return CaseResult(result, errors, time.perf_counter() - start)


def run_all(
    cases: Sequence[Case],
    report: ReportOptions,
    *,
    out: str | None,
    jobs: int | None = None,
    plants: Sequence[str] | None = None,
    explain: bool = False,
    changes: Sequence[Override] = (),
) -> None:
    """Check all scenarios, then run the valid ones; exit with the highest exit code.

    Results are printed in the order of the scenarios. As JSON they are one document:
    `metrics.json` of a single scenario, `{"runs": […]}` for several, and `{"scenario",
    "errors"}` for a scenario that failed.

    Args:
        cases: scenarios, loaded or not.
        report: reports and exit code.
        out: output folder; several scenarios get one subfolder each.
        jobs: number of worker processes; 1: run sequentially in this process; default:
            one per processor.
        plants: plants to run; default: those of each scenario.
        explain: add the attribution of the difference between the plants.
        changes: overridden fields of each scenario.

    Raises:
        InputError: the JUnit file or the output folder cannot be written; nothing was
            simulated.
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
            # A first write reports an unusable path early and replaces the report of an
            # earlier run.
            write()
            stack.callback(write)
        valid = _load(cases, out, report.quiet, changes, plants)
        function = partial(run_case, plants=plants, explain=explain)
        runs = stack.enter_context(
            closing(_run(valid, function, jobs, quiet=report.quiet))
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
    """Print how many expectations have each verdict, and how many are left out."""
    from srs_twin.scenario.expectation import tally

    verdicts = sum((result.verdicts for result in results), Counter())
    text = f"expectations: {tally(verdicts)}"
    left_out = sum(len(result.metrics.get("left_out", ())) for result in results)
    if left_out:
        text += f", {left_out} left out"
    say(text)


def make_cases(names: Sequence[str]) -> list[Case]:
    """Return one case per scenario, for shipped names, files, and the files of folders in sorted order."""
    from srs_twin.io.files import shipped_names

    sources: list[str] = []
    for name in names:
        # A shipped scenario takes precedence over a folder of the same name. For names
        # that are too long, `isdir` returns False, whereas `glob` raises an error.
        is_folder = name not in shipped_names("scenario") and os.path.isdir(name)
        if is_folder:
            files = sorted(map(str, Path(name).glob("*.yaml")))
        else:
            files = []
        sources += files or [name]
    return [Case(source) for source in dict.fromkeys(sources)]


def _load(
    cases: Sequence[Case],
    out: str | None,
    quiet: bool,
    changes: Sequence[Override],
    plants: Sequence[str] | None,
) -> list[Case]:
    """Load and check all scenarios; print the errors of invalid ones, return the valid ones."""
    from srs_twin.experiment import check_run
    from srs_twin.io.files import check_output_folder
    from srs_twin.scenario.loading import load_scenario

    base = Path(out) if out else RUNS_FOLDER
    folders: set[Path] = set()
    for case in cases:
        with _record_input_errors(case):
            scenario = case.scenario or load_scenario(case.source, set=changes)
            case.scenario = scenario = scenario.run_on(plants)
            if out and len(cases) == 1:
                case.folder = base
            else:
                case.folder = base / scenario.name
            if case.folder in folders:
                raise InputError(
                    f"{case.source}: another scenario is named '{scenario.name}' and"
                    f" uses {case.folder} too"
                )
            folders.add(case.folder)
    valid = [case for case in cases if case.result is None]
    if len(valid) > 1:
        # Report a folder that cannot be written once, not once per scenario.
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
    """Print an input error and record it as the result of the case."""
    try:
        yield
    except InputError as error:
        say(str(error))
        case.result = CaseResult(None, (error,))


def _run(
    cases: Sequence[Case],
    function: Callable[..., CaseResult],
    jobs: int | None,
    *,
    quiet: bool,
) -> Generator[Case, None, None]:
    """Run cases in this process or in workers; yield a case when it and all previous ones are complete."""
    from srs_twin.compute.workers import processor_count, run_tasks

    workers = min(jobs or processor_count(), len(cases))
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
    """Return the error with the name of the scenario in its message."""
    assert isinstance(error, SrsError)
    error.args = (f"{case.name}: {error}",)
    return error


def _print_result(
    case: Case, report: ReportOptions, changes: Sequence[Override]
) -> None:
    """Print the results and errors of a case."""
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
    """Return the command that shows a run, or why the run has no recording."""
    from srs_twin.experiment import RECORDING

    if (folder / RECORDING).is_file():
        return f"`srs-twin view {folder}` shows the run"
    return "no recording was written, because rerun-sdk is not installed"


def _suggest_explanation(
    case: Case, result: CaseResult, changes: Sequence[Override]
) -> None:
    """Print the command that attributes a difference between the plants, if it is unexpected."""
    from srs_twin.cli.table import needs_explanation

    if not needs_explanation(result.metrics):
        return
    words = [case.source]
    for change in changes:
        words += change.label.split(" ", 1)
    for plugin in plugins().values():
        words += ["--plugin", plugin]
    say(
        f"to attribute the difference: `srs-twin compare {shlex.join(words)} --explain`"
    )


def compare(
    scenario: ScenarioArgument,
    out: OneOutOption = None,
    report: ReportOptions = DEFAULT_REPORT,
    explain: bool = False,
    changed: ChangeOptions = NO_CHANGES,
) -> None:
    """Run a scenario on both plants and measure the difference.

    Options:
        --explain: Attribute the difference to modelling assumptions.
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
    jobs: JobsOption = None,
    plants: str | None = None,
    changed: ChangeOptions = NO_CHANGES,
) -> None:
    """Run scenarios on the plants that they select.

    Options:
        scenarios: Shipped scenarios, scenario files, or folders of files.
        --out DIR: Output folder; several scenarios get one subfolder each. [default:
            runs/SCENARIO]
        --plants LIST: Plants to run: analytical, twin or analytical,twin. [default: the
            scenario's]
    """
    run_all(
        make_cases(scenarios),
        report,
        out=out,
        jobs=jobs,
        plants=parse_plants(plants),
        changes=changed.changes(),
    )
