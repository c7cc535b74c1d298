"""Runs scenarios, one here or several in worker processes: what `run`, `compare` and `replay` share."""

from __future__ import annotations

import os
import shlex
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from srs_twin.cli.cases import Case, CaseResult
from srs_twin.cli.console import interruptible, say, show_traceback
from srs_twin.cli.options import print_json
from srs_twin.cli.progress import Counting, ScenarioProgress
from srs_twin.errors import InputError, SrsError

if TYPE_CHECKING:
    from srs_twin.io.documents import Change
    from srs_twin.scenario.scenario import Scenario

RUNS = Path("runs")


def simulate(
    order: tuple[Scenario, Path],
    progress: Callable[[str, float], None] | None = None,
    *,
    plants: Sequence[str] | None = None,
    explain: bool = False,
) -> CaseResult:
    """Run a scenario, here or in a worker process.

    Args:
        order: the scenario and the folder for its files.
        progress: as `PreparedRun.execute` takes it.
        plants: which plants; None takes those that the scenario names.
        explain: also say why the plants differ.
    """
    from srs_twin.experiment import prepare

    start = time.perf_counter()
    asked: dict[str, Any] = {}
    if explain:
        from srs_twin.attribution import explain as explanation

        asked["explain"] = explanation
    elif plants is not None and len(plants) > 1:
        from srs_twin.attribution import main_cause

        asked["main_cause"] = main_cause
    scenario, folder = order
    try:
        result = prepare(scenario, folder, plants=plants).execute(progress, **asked)
    except InputError as error:
        return CaseResult(None, (error,), time.perf_counter() - start)
    errors = (*result.diverged, *result.failed_attributions)
    for each in errors:
        each.trajectory = each.history = None  # the file that it names holds them
    result = replace(result, trajectories={}, diverged=(), failed_attributions=())
    return CaseResult(result, errors, time.perf_counter() - start)


def failing(*, check: bool, strict: bool) -> frozenset[str]:
    """Return the verdicts on expectations (`scenario.expectation.verdict`) with which the exit code is 1."""
    return frozenset({"missed", "known", "holds", "not_judged"} if strict else {"missed"} if check else ())


def run_all(
    cases: Sequence[Case],
    *,
    out: str | None,
    fails: frozenset[str],
    quiet: bool,
    jobs: int | None = None,
    junit: str | None = None,
    plants: Sequence[str] | None = None,
    explain: bool = False,
    changes: Sequence[Change] = (),
    as_json: bool = False,
) -> None:
    """Find what is bad in any scenario, then run the good ones; exit with the highest code.

    What is printed keeps to the order in which the scenarios were given.

    Args:
        cases: the scenarios, loaded or not.
        out: where the files go; the folder itself for one scenario, a folder in it for each of several.
        fails: the verdicts that decide the exit code, see `failing`.
        quiet: print errors only.
        jobs: how many scenarios at once, in worker processes; 1: here, one after the other; None: one a
            processor.
        junit: a file for what came of each scenario and expectation, as JUnit XML.
        plants: which plants; None takes those that each scenario names.
        explain: also say why the plants differ.
        changes: of fields of each scenario.
        as_json: print what came of them as one document: of one scenario its metrics.json, of several
            `{"runs": […]}`; of what failed `{"scenario", "errors"}`.

    Raises:
        InputError: the JUnit file or the folder for all cannot be written; nothing was simulated.
        typer.Exit: with the exit code, where it is not 0.
    """
    from srs_twin.cli.junit import report_path, write_junit

    def finished() -> str:
        complete = [str(case.folder) for case in cases if case.ended and case.ended.metrics]
        return f"finished before: {', '.join(complete) or 'nothing'}"

    with ExitStack() as ends, interruptible(finished):
        if junit is not None:
            write = partial(write_junit, report_path(junit), cases, fails)
            # Found out now that it cannot be written; and whatever ends this process, no old report is left.
            write()
            ends.callback(write)
        to_do = _load(cases, out, quiet, changes, plants)
        with closing(_run(to_do, partial(simulate, plants=plants, explain=explain), jobs, quiet)) as run:
            for case in run:
                _report(case, fails=fails, quiet=quiet, as_json=as_json, changes=changes)
    if as_json:
        found = [case.document() for case in cases]
        print_json(found[0] if len(found) == 1 else {"runs": found})
    if fails and not quiet:
        from srs_twin.scenario.expectation import tally

        verdicts = sum((case.ended.verdicts for case in to_do if case.ended), Counter())
        left_out = sum(len(case.ended.metrics.get("left_out", ())) for case in to_do if case.ended)
        say(f"expectations: {tally(verdicts)}{f', {left_out} left out' if left_out else ''}")
    if code := max((case.ended.exit_code(fails) for case in cases if case.ended), default=0):
        raise typer.Exit(code)


def cases_of(given: Sequence[str]) -> list[Case]:
    """Return a case for each scenario: shipped names, files, and the files of folders, sorted by name."""
    from srs_twin.io.files import shipped_names

    found: list[str] = []
    for each in given:
        # A shipped scenario goes before a folder of its name.
        # `isdir` says no of a name that is too long, where `glob` raises.
        folder = each not in shipped_names("scenario") and os.path.isdir(each)
        files = sorted(map(str, Path(each).glob("*.yaml"))) if folder else []
        found += files or [each]
    return [Case(each) for each in dict.fromkeys(found)]


def _load(
    cases: Sequence[Case],
    out: str | None,
    quiet: bool,
    changes: Sequence[Change],
    plants: Sequence[str] | None,
) -> list[Case]:
    """Load every scenario and see that it can run; say what is wrong with the bad ones, return the others."""
    from srs_twin.experiment import check_run
    from srs_twin.io.files import open_folder
    from srs_twin.scenario.loading import load_scenario

    base = Path(out) if out else RUNS
    taken: set[Path] = set()
    for case in cases:
        with _ending(case):
            scenario = case.scenario or load_scenario(case.source, set=changes)
            case.scenario = scenario = scenario.run_on(plants)
            case.folder = base if out and len(cases) == 1 else base / scenario.name
            if case.folder in taken:
                raise InputError(
                    f"{case.source}: another '{scenario.name}' is given, and both write to {case.folder}"
                )
            taken.add(case.folder)
    good = [case for case in cases if case.ended is None]
    if len(good) > 1:
        # One word on a place where nothing can be written, not one for each scenario.
        open_folder(base)
    for case in good:
        with _ending(case):
            assert case.scenario is not None
            check_run(case.scenario, case.folder)
    good = [case for case in good if case.ended is None]
    for case in good:
        assert case.scenario is not None
        say(*(f"warning: {each}" for each in case.scenario.warnings), quiet=quiet)
    return good


@contextmanager
def _ending(case: Case) -> Iterator[None]:
    """Say what is wrong with a scenario and count it as ended."""
    try:
        yield
    except InputError as error:
        say(str(error))
        case.ended = CaseResult(None, (error,))


Finished = Generator[Case, None, None]


def _run(cases: Sequence[Case], task: Callable[..., CaseResult], jobs: int | None, quiet: bool) -> Finished:
    """Run scenarios here or in worker processes; yield each when it and all before it have ended."""
    from srs_twin.compute.workers import each, processors

    workers, orders = min(jobs or processors(), len(cases)), [(case.scenario, case.folder) for case in cases]
    if workers <= 1:
        for case, order in zip(cases, orders, strict=True):
            with ScenarioProgress(case.name, quiet=quiet) as progress:
                case.ended = task(order, progress)
            yield case
        return
    shown = 0
    with (
        Counting("scenarios", len(cases), quiet=quiet) as counting,
        closing(each(task, orders, workers=workers)) as run,
    ):
        for done in run:
            case = cases[done.number]
            case.ended = done.result or CaseResult(None, (_named(case, done.error),))
            counting(failed=bool(case.ended.errors))
            with counting.aside():
                while shown < len(cases) and cases[shown].ended is not None:
                    yield cases[shown]
                    shown += 1


def _named(case: Case, error: Exception | None) -> SrsError:
    """Say in the message which scenario it was."""
    assert isinstance(error, SrsError)
    error.args = (f"{case.name}: {error}",)
    return error


def _report(
    case: Case, *, fails: frozenset[str], quiet: bool, as_json: bool, changes: Sequence[Change]
) -> None:
    """Show what a run gave."""
    from srs_twin.cli.table import asks_why, expectation_lines, show

    ended = case.ended
    assert ended is not None, "it has ended"
    if ended.result is not None and ended.metrics:
        if not quiet:
            if not as_json:
                show(ended.result)
            say(f"files in {case.folder}; `srs-twin view {case.folder}` shows the run")
            if asks_why(ended.metrics):
                words = shlex.join(
                    [case.source, *(word for each in changes for word in each.words.split(" ", 1))]
                )
                say(f"why the plants differ: `srs-twin compare {words} --explain`")
        elif fails and not as_json:
            for line in expectation_lines(ended.metrics, fails | {"holds", "not_judged"}):
                say(line)
    for error in ended.errors:
        show_traceback(error)
        say(str(error))
