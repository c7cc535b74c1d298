"""Command `srs-twin uncertainty`, which computes prediction intervals of metrics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from srs_twin.cli.console import RunCounter, interruptible, say
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    JsonOption,
    OptionRange,
    QuietOption,
    ScenarioArgument,
    parse_plants,
    print_json,
)
from srs_twin.studies.sweep.command import DEFAULT_STUDY, StudyOptions

if TYPE_CHECKING:
    from srs_twin.studies.uncertainty.propagation import Propagation

STUDIES = Path("runs/uncertainty")

_MAX_MEASUREMENTS = 3

_NOTHING = 5e-4
"""Magnitude below which a value is printed as 0, in the unit of the metric."""


def uncertainty(
    scenario: ScenarioArgument,
    out: str | None = None,
    plants: str | None = None,
    samples: Annotated[int, OptionRange(16, 65536)] = 2048,
    twin: Annotated[int, OptionRange(16, 65536)] = 64,
    exclude: list[str] | None = None,
    model_form: list[str] | None = None,
    options: StudyOptions = DEFAULT_STUDY,
    write: bool = False,
    changes: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compute prediction intervals of a scenario's metrics.

    The command propagates the uncertainty of the robot parameters to every metric. It
    also ranks the parameters by influence and suggests the next measurements. To resume
    an interrupted study, run the command again with the same output folder.

    Options:
        --out DIR: Output folder. [default: runs/uncertainty/SCENARIO]
        --plants LIST: Models to simulate: analytical, twin, or both as analytical,twin.
            [default: the models named in the scenario]
        --samples N: Number of robots with randomly drawn parameters.
        --twin N: Number of twin runs if the compliant model simulates all samples.
        --exclude NAME: Parameter to keep at its value in the robot file, for example
            friction.drag_n. Can be repeated.
        --model-form FIELD=A,B: Scenario field with equally likely values, for example
            pneumatics.kind=lag,orifice. Can be repeated.
        --write: Also write the intervals to calibration/intervals, so that scenario
            expectations can use them.
    """
    runner = options.make_engine()
    from srs_twin.scenario.loading import load_scenario
    from srs_twin.studies.uncertainty import propagation

    loaded = load_scenario(scenario, set=changes.changes())
    if write:
        propagation.check_can_be_kept(loaded)
    folder = Path(out) if out else STUDIES / loaded.name
    with (
        interruptible(f"finished runs are kept in {folder}; start again to resume"),
        RunCounter(loaded.name, 0, quiet=quiet) as counting,
    ):
        result = propagation.uncertainty(
            loaded,
            out=folder,
            plants=parse_plants(plants),
            samples=samples,
            twin=twin,
            exclude=exclude or (),
            choices=_parse_choices(model_form or ()),
            engine=runner,
            changed=options.changed,
            progress=lambda part, *row: counting.follow(f"{loaded.name}, {part}", *row),
        )
    if as_json:
        print_json(result.document())
    elif not quiet:
        _print_result(result)
    say(*(f"warning: {text}" for text in result.warnings), quiet=quiet)
    if result.warnings:
        say("more --samples or --twin reduce these errors", quiet=quiet)
    if write:
        say(f"kept in {result.keep()}", quiet=quiet)
    say(f"files in {folder}: {', '.join(propagation.FILES)}", quiet=quiet)


def _parse_choices(options: Sequence[str]) -> dict[str, tuple[Any, ...]]:
    from srs_twin.io.documents import Override

    choices = {}
    for text in options:
        name, _, values = text.partition("=")
        choices[name] = tuple(
            Override.parse(f"--model-form {text}", name, value).value
            for value in values.split(",")
        )
    return choices


def _short(value: float) -> str:
    if abs(value) < _NOTHING:
        return "0"
    return f"{value:.3g}"


def _error_text(error: float) -> str:
    if abs(error) < _NOTHING / 10:
        return "0"
    return f"{error:.2g}"


def _print_result(result: Propagation) -> None:
    from srs_twin.viewing.plots.labels import metric_label

    study = result.study
    is_judged = [_print_plant(result, plant) for plant in result.plants]
    print("± at 95 %: standard errors of the two ends of the 95 % interval")
    if any(is_judged):
        print(
            "published: within or outside the 95 % interval; undecided within two"
            " standard errors of an end"
        )
    runs = ", ".join(f"{count} runs of {part}" for part, count in study.runs.items())
    quantities = f"{len(study.priors.parameters)} uncertain numbers"
    forms = len(study.discrete_choices)
    if forms:
        fields = ", ".join(study.discrete_choices)
        quantities += f" and {forms} model form{'s' * (forms > 1)} ({fields})"
    print(f"{quantities} of {study.scenario.robot.name}; {runs}")
    failed = [f"{count} of {part}" for part, count in result.failed.items() if count]
    if failed:
        print(f"without a result: {', '.join(failed)}")
    for name, (low, high) in (result.segments or {}).items():
        varied = name.replace("_", " ")
        print(
            f"with {varied} at the file's values and at the ends of the 95 % intervals,"
            f" the twin crawls at {low:.3g} to {high:.3g} m/s"
        )
    plant, metric = result.target
    measurements = result.measure_next()
    if not measurements:
        print(f"no measurement is recommended: {_no_measurement_reason(result)}")
    for measured in measurements[:_MAX_MEASUREMENTS]:
        print(
            f"measuring {measured.parameter} to ±10 % would narrow the {plant}'s"
            f" {metric_label(metric)} from {measured.width_now:.3g} to"
            f" {measured.width:.3g}"
        )


def _no_measurement_reason(result: Propagation) -> str:
    plant, metric = result.target
    uncertainty = result.plants[plant][metric]
    if not result.study.priors.independent:
        return "the effect of a single parameter is not defined if some are correlated"
    if uncertainty.indices is None:
        return "the metric does not vary"
    return (
        f"the order of the parameters is not resolved with {uncertainty.count} samples"
    )


def _print_plant(result: Propagation, plant: str) -> bool:
    from srs_twin.comparison.metrics import metric_units
    from srs_twin.identification.fitting import print_table
    from srs_twin.studies.uncertainty.metric_uncertainty import RANGES, count_text
    from srs_twin.viewing.plots.labels import metric_label

    uncertainties = result.plants[plant]
    rows = []
    usual = uncertainties.get(result.target[1])
    usual_count = count_text(usual.count, usual.runs) if usual else ""
    for metric, uncertainty in uncertainties.items():
        if metric not in metric_units():
            continue
        name = metric_label(metric)
        count = count_text(uncertainty.count, uncertainty.runs)
        if count != usual_count:
            name += f", {count}"
        published = ""
        if uncertainty.published is not None and uncertainty.verdict is not None:
            published = f"{_short(uncertainty.published)} {uncertainty.verdict.value}"
        ends = [uncertainty.interval(fraction) for fraction in RANGES]
        rows.append(
            (
                name,
                _short(uncertainty.value),
                *(f"{_short(low)}–{_short(high)}" for low, high in ends),
                ", ".join(map(_error_text, uncertainty.errors[2:])),
                published,
            )
        )
    headings = (
        f"{plant}, {usual_count}",
        "value",
        "50 %",
        "95 %",
        "± at 95 %",
        "published",
    )
    print_table(headings, rows, left=(0,))
    return any(entry.verdict for entry in uncertainties.values())
