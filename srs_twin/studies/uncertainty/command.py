"""`srs-twin uncertainty`: how sure a scenario's predictions are, and what to measure next."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from srs_twin.cli.console import interruptible, say
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    JsonOption,
    QuietOption,
    ScenarioArgument,
    at_once,
    option,
    plants_of,
    print_json,
)
from srs_twin.cli.progress import Counting
from srs_twin.errors import InputError

if TYPE_CHECKING:
    from srs_twin.studies.sweep.task import Row
    from srs_twin.studies.uncertainty.propagation import Propagation
    from srs_twin.studies.uncertainty.spreads import Spread

STUDIES = Path("runs/uncertainty")
_NEXT = 3
_NOTHING = 5e-4


def uncertainty(
    scenario: ScenarioArgument,
    out: Annotated[str | None, option("--out DIR")] = None,
    plants: Annotated[str | None, option("--plants LIST")] = None,
    samples: Annotated[int, option("--samples N", min=16, max=65536)] = 2048,
    twin: Annotated[int, option("--twin N", min=16, max=65536)] = 64,
    without: Annotated[list[str] | None, option("--without NAME")] = None,
    form: Annotated[list[str] | None, option("--form FIELD=A,B")] = None,
    engine: Annotated[str, option("--engine NAME")] = "local",
    workers: Annotated[int | None, at_once("--workers N")] = None,
    write: Annotated[bool, option("--write")] = False,
    changed: Annotated[bool, option("--changed")] = False,
    changes: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Say how sure predictions are, and what to measure next.

    Propagates what is uncertain of the robot's numbers, as its file says, to every metric of a scenario.
    What an earlier start left in the folder is kept, and it goes on from there.

    Options:
        out: Output folder. [default: runs/uncertainty/SCENARIO]
        plants: analytical, twin or both. [default: the scenario's]
        samples: Number of robots drawn from the distributions.
        twin: Number of samples that the twin runs where the model compliant runs all of them.
        without: Number that keeps its value, as friction.drag_n; repeatable.
        engine: Engine for the runs: local, ray, or warp (twins on an accelerator).
        changed: Resume in the folder of an earlier version; keep the rows that still apply.
        form: Values of a field that are equally likely, as pneumatics.kind=lag,orifice; repeatable.
        write: Keep the intervals in calibration/intervals, where expectations find them.
    """
    from srs_twin.studies.sweep.command import chosen_engine

    runner = chosen_engine(engine, workers, None)
    from srs_twin.experiment import INTERVALS
    from srs_twin.io.files import open_folder
    from srs_twin.robot.file import RobotFile
    from srs_twin.robot.priors import Priors
    from srs_twin.scenario.loading import load_scenario
    from srs_twin.studies.uncertainty.propagation import propagate
    from srs_twin.studies.uncertainty.study import Study

    found = load_scenario(scenario, set=changes.changes())
    if write and found.left_out:
        fields = ", ".join(dict.fromkeys(field for each in found.left_out for field in each["because"]))
        raise InputError(f"--write keeps intervals of unmodified scenarios, but {fields} was changed")
    priors = Priors.of(RobotFile.model_validate(found.document["robot"]), without=without or ())
    chosen = tuple(plants_of(plants) or found.plants)
    study = Study(
        found,
        priors,
        chosen,
        samples=samples,
        costly=min(twin, samples),
        seed=found.seed,
        forms=_forms(form or ()),
    )
    folder = Path(out) if out else STUDIES / found.name
    if write:
        open_folder(INTERVALS, (f"{found.name}.json",), option="")

    @contextmanager
    def counting(part: str, count: int) -> Iterator[Callable[[Row], Any]]:
        with Counting(f"{found.name}, {part}", count, quiet=quiet) as shown:
            yield lambda row: shown(failed=row.exit_code != 0)

    with interruptible(f"what was run is kept in {folder}, start again to go on"):
        result = propagate(study, folder, runner, counting, changed=changed)
        files = result.write(folder)
    if as_json:
        print_json(result.document())
    elif not quiet:
        _show(result)
    _warn(result, quiet=quiet)
    if write:
        say(f"kept in {result.keep()}", quiet=quiet)
    say(f"files in {folder}: {', '.join(files)}", quiet=quiet)


def _forms(given: Sequence[str]) -> dict[str, tuple[Any, ...]]:
    from srs_twin.io.documents import Change

    found = {}
    for text in given:
        name, _, values = text.partition("=")
        found[name] = tuple(Change.of(f"--form {text}", name, value).value for value in values.split(","))
    return found


def _short(value: float) -> str:
    return "0" if abs(value) < _NOTHING else f"{value:.3g}"


def _rough(error: float) -> str:
    """Return a standard error with two digits."""
    return "0" if abs(error) < _NOTHING / 10 else f"{error:.2g}"


def _counted(spread: Spread) -> str:
    """Return the number of samples, and of runs where a surrogate predicted the rest."""
    return f"{spread.count} samples" + (f", {spread.runs} runs" if spread.runs < spread.count else "")


def _show(result: Propagation) -> None:
    """Print the intervals of the usual metrics, their limits, and what to measure."""
    from srs_twin.comparison.metrics import METRIC_UNITS
    from srs_twin.identification.fitting import print_table
    from srs_twin.studies.uncertainty.remarks import outside_marks
    from srs_twin.viewing.plots.labels import metric_label

    study, marks = result.study, ""
    for plant, spreads in result.plants.items():
        lines, usual = [], _counted(spreads[result.target[1]]) if result.target[1] in spreads else ""
        for metric, spread in spreads.items():
            if metric in METRIC_UNITS:
                ends = [spread.interval(name) for name in ("interval_50", "interval_95")]
                cells = (f"{_short(low)}–{_short(high)}" for low, high in ends)
                value = _short(spread.value)
                mark = "" if value in map(_short, ends[0]) else outside_marks(spread)
                marks = max(marks, mark)
                count = _counted(spread)
                label = metric_label(metric) + ("" if count == usual else f", {count}")
                errors = ", ".join(map(_rough, spread.errors[2:]))
                verdict = spread.verdict
                stated = "" if spread.published is None else _short(spread.published)
                stated += "" if verdict is None else f" {verdict.value}"
                lines.append((label, value + mark, *cells, errors, stated))
        print_table(
            (f"{plant}, {usual}", "value", "50 %", "95 %", "± at 95 %", "published"), lines, left=(0,)
        )
    print("± at 95 %: standard errors of the two ends of the 95 % interval")
    if any(spread.verdict for spreads in result.plants.values() for spread in spreads.values()):
        print(
            "published: within or outside the 95 % interval; undecided within two standard errors of an end"
        )
    if marks:
        print("* outside its 50 % interval, ** outside its 95 % interval")
    runs = ", ".join(f"{count} runs of {part}" for part, count in study.parts.items())
    print(f"{len(study.priors.each)} uncertain numbers of {study.scenario.robot.name}; {runs}")
    lost = {part: count for part, count in result.failed.items() if count}
    if lost:
        print("without a result: " + ", ".join(f"{count} of {part}" for part, count in lost.items()))
    for text in result.limits["remarks"]:
        print(text)
    plant, metric = result.target
    for each in result.measure_next()[:_NEXT]:
        print(
            f"measuring {each['parameter']} to ±10 % would narrow the {plant}'s {metric_label(metric)} "
            f"from {each['width_now']:.3g} to {each['width']:.3g}"
        )


def _warn(result: Propagation, *, quiet: bool) -> None:
    """Say on stderr which errors are too large, and what to do."""
    limits = result.limits
    say(*(f"warning: {text}" for text in limits["warnings"]), quiet=quiet)
    if limits["remedy"]:
        options = " ".join(f"--{name} {count}" for name, count in limits["remedy"].items())
        say(f"`{options}` should be enough", quiet=quiet)
