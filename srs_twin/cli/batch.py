"""Runs scenarios, one here or several in worker processes: what `run` and `compare` share.

One scenario of a batch: where it is from, where its files go, and what came of it.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from srs_twin.cli import INTERRUPTED, say, show_traceback
from srs_twin.cli.progress import Counting, Progress
from srs_twin.errors import DivergedError, InputError, SrsError

if TYPE_CHECKING:
    from srs_twin.scenario import Scenario


if TYPE_CHECKING:
    from srs_twin.experiment import Explain, Progress, RunResult
    from srs_twin.scenario import Scenario

    Order = tuple[Scenario, Path]


@dataclass(frozen=True)
class Ended:
    """What came of a scenario, small enough to travel between processes.

    Attributes:
        result: without trajectories; None where bad input or a dead worker left none.
        errors: what stopped it or a part of it.
        wall_s: what it took, s.
    """

    result: RunResult | None
    errors: tuple[SrsError, ...] = ()
    wall_s: float = 0.0

    @property
    def metrics(self) -> Mapping[str, Any]:
        """What stands in metrics.json; empty where the folder does not hold a whole run."""
        return {} if self.result is None else self.result.metrics

    @property
    def verdicts(self) -> Counter[str]:
        """How many expectations came out how; see `scenario.expectation.verdict`."""
        from srs_twin.scenario.expectation import verdict

        return Counter(map(verdict, self.metrics.get("expectations", ())))


@dataclass
class Case:
    """A scenario that somebody asked for.

    Attributes:
        source: as it was given.
        scenario: what it holds; None where it cannot be used.
        folder: where its files go.
        ended: what came of it; None while nothing has.
    """

    source: str
    scenario: Scenario | None = None
    folder: Path = Path()
    ended: Ended | None = None

    @property
    def name(self) -> str:
        """What it is called: the scenario's name, or its file's where there is none."""
        return Path(self.source).stem if self.scenario is None else self.scenario.name

    @property
    def order(self) -> Order:
        """What `simulate` needs to know."""
        assert self.scenario is not None
        return self.scenario, self.folder


def simulate(
    order: Order,
    progress: Progress | None = None,
    *,
    plants: Sequence[str] | None = None,
    explain: bool = False,
) -> Ended:
    """Run a scenario, here or in a worker process.

    Args:
        order: the scenario and the folder for its files.
        progress: as `PreparedRun.execute` takes it.
        plants: which plants; None takes those that the scenario names.
        explain: also say why the plants differ.
    """
    from srs_twin.experiment import prepare

    start = time.perf_counter()
    asked: dict[str, Any] = {"explain": _explainer()} if explain else {}
    result: RunResult | None = None
    errors: tuple[SrsError, ...] = ()
    try:
        scenario, folder = order
        result = prepare(scenario, folder, plants=plants).execute(progress, **asked)
        errors = (*result.diverged, *result.unexplained)
        result = replace(result, trajectories={}, diverged=(), unexplained=())
    except InputError as error:
        errors = (error,)
    return Ended(result, tuple(map(_light, errors)), time.perf_counter() - start)


def _light(error: SrsError) -> SrsError:
    """Drop what an error carries beside its words: the file that it names holds it."""
    if isinstance(error, DivergedError):
        error.trajectory = error.history = None
    return error


def _explainer() -> Explain:
    from srs_twin.attribution import explain

    return explain


EXPECTATION_FAILED = 1
RUNS = Path("runs")

Task = Callable[..., Ended]
Runs = Generator[tuple[Case, Ended], None, None]

OutOption = Annotated[
    str | None,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Folder for the files; of several scenarios, one each in it. [default: runs/SCENARIO]",
    ),
]
OneOutOption = Annotated[
    str | None,
    typer.Option("--out", metavar="DIR", help="Folder for the files. [default: runs/SCENARIO]"),
]
CheckOption = Annotated[bool, typer.Option("--check", help="Exit with 1 when an expectation fails.")]
StrictOption = Annotated[
    bool, typer.Option("--strict", help="--check, which also fails on what is marked `known`, met or missed.")
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="No table and no progress; errors only.")]


def failing(*, check: bool, strict: bool) -> frozenset[str]:
    """Return the verdicts on expectations (`scenario.expectation.verdict`) with which the exit code is 1."""
    return frozenset({"missed", "known", "holds"} if strict else {"missed"} if check else ())


def run_all(
    given: Sequence[str],
    *,
    out: str | None,
    fails: frozenset[str],
    quiet: bool,
    jobs: int | None = None,
    junit: str | None = None,
    plants: Sequence[str] | None = None,
    explain: bool = False,
) -> None:
    """Find what is bad in any scenario, then run the good ones; exit with the highest code.

    What is printed keeps to the order in which the scenarios were given.

    Args:
        given: shipped names, files, folders of files.
        out: where the files go; the folder itself for one scenario, a folder in it for each of several.
        fails: the verdicts that decide the exit code, see `failing`.
        quiet: print errors only.
        jobs: how many scenarios at once, in worker processes; 1: here, one after the other; default one a
            processor.
        junit: a file for what came of each scenario and expectation, as JUnit XML.
        plants: which plants; None takes those that each scenario names.
        explain: also say why the plants differ.

    Raises:
        InputError: the JUnit file or the folder for all cannot be written; nothing was simulated.
        typer.Exit: with the exit code, where it is not 0.
    """
    from srs_twin.cli.junit import report_path, write_junit

    cases = [Case(source) for source in _expand(given)]
    report = None if junit is None else report_path(junit)
    if report is not None:
        # Found out now that it cannot be written; and whatever ends this process, no old report is left.
        write_junit(report, cases, fails)
    try:
        _load_all(cases, out, plants)
        task = partial(simulate, plants=plants, explain=explain)
        code = _run_all(cases, task, jobs, fails=fails, quiet=quiet)
    finally:
        if report is not None:
            write_junit(report, cases, fails)
    if code:
        raise typer.Exit(code)


def run_loaded(scenario: Scenario, folder: Path, *, fails: frozenset[str], quiet: bool) -> None:
    """Run one scenario that is loaded already.

    Args:
        scenario: what to run.
        folder: for its files.
        fails: the verdicts that decide the exit code, see `failing`.
        quiet: print errors only.

    Raises:
        InputError: a plant, a controller or the folder cannot be had; nothing was simulated.
        typer.Exit: with the exit code, where it is not 0.
    """
    from srs_twin.experiment import prepare

    case = Case(scenario.name, scenario, folder)
    prepare(*case.order)
    code = _run_all([case], simulate, 1, fails=fails, quiet=quiet)
    if code:
        raise typer.Exit(code)


def _expand(given: Sequence[str]) -> list[str]:
    """Put the files of a folder in its place, sorted by name; a shipped scenario goes before a folder."""
    from srs_twin.io.files import shipped_names

    found: list[str] = []
    for each in given:
        files = [] if each in shipped_names("scenario") else sorted(map(str, Path(each).glob("*.yaml")))
        found += files or [each]
    return list(dict.fromkeys(found))


def _load_all(cases: Sequence[Case], out: str | None, plants: Sequence[str] | None) -> None:
    """Load every scenario and see that it can run; say what is wrong with the bad ones."""
    from srs_twin.experiment import prepare
    from srs_twin.io.files import open_folder
    from srs_twin.scenario import load_scenario

    base = Path(out) if out else RUNS
    taken: set[Path] = set()
    for case in cases:
        with _ending(case):
            case.scenario = scenario = load_scenario(case.source)
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
            # Built to see that it can be, and again where it runs: plants do not travel between processes.
            prepare(*case.order, plants=plants)


@contextmanager
def _ending(case: Case) -> Iterator[None]:
    """Say what is wrong with a scenario and count it as ended."""
    try:
        yield
    except InputError as error:
        say(str(error))
        case.ended = Ended(None, (error,))


def _run_all(
    cases: Sequence[Case], task: Task, jobs: int | None, *, fails: frozenset[str], quiet: bool
) -> int:
    """Run what has not ended yet; return the exit code."""
    to_do = [case for case in cases if case.ended is None]
    for case in () if quiet else to_do:
        for warning in case.scenario.warnings if case.scenario else ():
            say(f"warning: {warning}")
    from srs_twin.parallel import processors

    workers = min(jobs or processors(), len(to_do))
    run = _run_here(to_do, task, quiet) if workers <= 1 else _run_in_workers(to_do, task, workers, quiet)
    try:
        with closing(run):
            for case, ended in run:
                _report(case, ended, fails=fails, quiet=quiet)
    except KeyboardInterrupt:
        complete = [str(case.folder) for case in to_do if case.ended and case.ended.metrics]
        say(f"interrupted; finished before: {', '.join(complete) or 'nothing'}")
        return INTERRUPTED
    if fails and not quiet:
        from srs_twin.scenario.expectation import tally

        verdicts = sum((case.ended.verdicts for case in to_do if case.ended), Counter())
        say(f"expectations: {tally(verdicts)}")
    return max((_exit_code(case, fails=fails) for case in cases), default=0)


def _run_here(cases: Sequence[Case], task: Task, quiet: bool) -> Runs:
    """Run scenarios in this process, one after the other; yield each when it has ended."""
    for case in cases:
        with Progress(case.name, quiet=quiet) as progress:
            case.ended = ended = task(case.order, progress)
        yield case, ended


def _run_in_workers(cases: Sequence[Case], task: Task, workers: int, quiet: bool) -> Runs:
    """Run scenarios in worker processes; yield each when it and all before it have ended."""
    from srs_twin.parallel import each

    shown = 0
    with (
        Counting("scenarios", len(cases), quiet=quiet) as counting,
        closing(each(task, [case.order for case in cases], workers=workers)) as run,
    ):
        for done in run:
            case = cases[done.number]
            case.ended = done.result or Ended(None, (_named(case, done.error),))
            counting(failed=bool(case.ended.errors))
            with counting.aside():
                while shown < len(cases) and (ended := cases[shown].ended) is not None:
                    yield cases[shown], ended
                    shown += 1


def _named(case: Case, error: Exception | None) -> SrsError:
    """Say in the message which scenario it was."""
    assert isinstance(error, SrsError)
    error.args = (f"{case.name}: {error}",)
    return error


def _report(case: Case, ended: Ended, *, fails: frozenset[str], quiet: bool) -> None:
    """Show what a run gave."""
    from srs_twin.cli.table import asks_why, expectation_lines, show

    if ended.result is not None and ended.metrics:
        if not quiet:
            show(ended.result)
            say(f"files in {case.folder}; `srs-twin view {case.folder}` shows the run")
            if asks_why(ended.metrics):
                say(f"why the plants differ: `srs-twin compare {case.source} --explain`")
        elif fails:
            for line in expectation_lines(ended.metrics, fails | {"holds"}):
                say(line)
    for error in ended.errors:
        show_traceback(error)
        say(str(error))


def _exit_code(case: Case, *, fails: frozenset[str]) -> int:
    if case.ended is None:
        return 0
    codes = [error.exit_code for error in case.ended.errors]
    return max([*codes, EXPECTATION_FAILED if fails & case.ended.verdicts.keys() else 0])
