"""Loading of sweep files, which reports all problems in a file at once."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from srs_twin.comparison.metrics import (
    COMPARISON_UNITS,
    LIST_METRIC_UNITS,
    METRICS_LISTED,
    check_plugin_metrics,
    metric_units,
)
from srs_twin.errors import (
    InputError,
    InputFileError,
    UnknownNameError,
    did_you_mean,
    format_names,
)
from srs_twin.extensions import SECTIONS
from srs_twin.io.documents import (
    Document,
    Loc,
    Override,
    Overrides,
    format_path,
    load_yaml,
    parse_path,
)
from srs_twin.io.files import StrPath, find_file, results_name
from srs_twin.io.validation import accepts_only_integers, validate
from srs_twin.planning.metrics import PLANNING_UNITS
from srs_twin.robot.file import load_robot_file
from srs_twin.scenario.expectation import COMPARISON
from srs_twin.scenario.fields import path_fields
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.scenario.modified import (
    changed_fields,
    marked,
    with_plants,
)
from srs_twin.scenario.parts import scenario_model
from srs_twin.scenario.plants import PLANTS
from srs_twin.scenario.provenance import NOT_PHYSICS
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.points import (
    Experiment,
    RangeFile,
    Sweep,
    SweepFile,
    Value,
    leaf_names,
    sample,
)


def load_sweep(
    sweep: StrPath | Sweep,
    *,
    set: Overrides = (),
    plants: Sequence[str] | None = None,
) -> Sweep:
    """Load a shipped sweep by name (fig31), or a sweep file by path.

    Args:
        sweep: name or path of the sweep, or a loaded sweep, which is returned
            unchanged.
        set: values of scenario fields, keyed by dotted path, which extend or replace
            the fixed fields in the file.
        plants: plants to simulate, or None for the plants in the file.
    """
    if isinstance(sweep, Sweep):
        refuse_changes("sweep", set, plants)
        return sweep
    path = find_file("sweep", sweep)
    overrides = Override.list_of(set)
    document = load_yaml(path)
    written = copy.deepcopy(document.data)
    for change in overrides:
        document.apply(replace(change, loc=("fixed", format_path(change.loc))))
    if plants is not None:
        document.apply(
            Override(f"--plants {','.join(plants)}", ("plants",), list(plants))
        )
    complete = locate_files(document)
    file = validate(SweepFile, document, document.data)
    scenario, scenario_errors = base_scenario(document)
    loaded = None
    if complete and file is not None and scenario is not None:
        loaded = _Loader(document, file, scenario).sweep(results_name(path))
    document.raise_problems(scenario_errors)
    assert loaded is not None and scenario is not None, (
        "a document without problems gives a sweep"
    )
    return _with_changes(
        loaded, scenario, written, [change.loc for change in overrides]
    )


def _with_changes(
    sweep: Sweep, scenario: Scenario, written: Mapping[str, Any], locs: Sequence[Loc]
) -> Sweep:
    plants = written.get("plants")
    if plants is None:
        plants = list(scenario.plants)
    changes = with_plants(
        changed_base(sweep.experiment, scenario, written, locs),
        plants,
        sweep.experiment.plants,
    )
    if not changes:
        return sweep
    title = marked(sweep.title, changes)
    # `load_sweep` must accept the written document, so its title is shortened.
    document = {**sweep.document, "title": title[:200]}
    return replace(sweep, title=title, changes=changes, document=document)


def changed_base(
    experiment: Experiment,
    scenario: Scenario,
    written: Mapping[str, object],
    locs: Iterable[Loc],
) -> list[dict[str, object]]:
    """Return the fields in which an experiment differs from its file."""
    fixed = written.get("fixed")
    original = replace(experiment, base=scenario.document)
    before = original.with_fixed(fixed if isinstance(fixed, dict) else {})
    return changed_fields(before, experiment.base, locs)


def problems_at(
    points: Iterable[tuple[Loc, Experiment, Mapping[str, Value]]],
) -> Iterator[tuple[Loc, str]]:
    """Yield each distinct problem of the changed scenarios, with its location.

    Each entry of `points` contains a location in the file, an experiment and the fields
    to change.
    """
    reported: set[str] = set()
    for loc, experiment, changes in points:
        try:
            parse_scenario(experiment.document(changes), name="")
        except InputFileError as error:
            new = [line for line in dict.fromkeys(error.lines) if line not in reported]
            reported.update(new)
            yield from ((loc, line.removeprefix(": ")) for line in new)


def with_suggestion(problem: str, field: str, known: Iterable[str]) -> str:
    """Suggest a similar known name in a message that lists the allowed keys."""
    before, is_list, _ = problem.partition("; allowed: ")
    suggestion = did_you_mean(field, known)
    if is_list and suggestion and before.endswith("unknown key"):
        return before + suggestion
    return problem


def locate_files(document: Document) -> bool:
    """Resolve file paths in a sweep or study, and return whether all files exist."""
    before = len(document.problems)
    document.locate(("scenario",), "scenario")
    kinds = {format_path(loc): kind for loc, kind in path_fields(SECTIONS).items()}
    for section in ("fixed", "vary"):
        block = document.get(section)
        for field, value in block.items() if isinstance(block, Mapping) else ():
            if (kind := kinds.get(field)) is None:
                continue
            document.locate((section, field), kind)
            for i in range(len(value)) if isinstance(value, list) else ():
                document.locate((section, field, i), kind)
    return len(document.problems) == before


def refuse_changes(kind: str, *changes: object) -> None:
    """Raise an `InputError` if changes are given for a loaded sweep or study."""
    if any(changes):
        raise InputError(
            f"a loaded {kind} cannot be changed; give its name or path instead"
        )


def base_scenario(document: Document) -> tuple[Scenario | None, tuple[str, ...]]:
    """Return the scenario of a sweep or study, and the problems of its file."""
    name = document.get("scenario")
    if not isinstance(name, str):
        return None, ()
    with document.report_errors("scenario"):
        try:
            scenario = load_scenario(name)
        except InputFileError as error:
            return None, error.lines
        check_plugin_metrics()
        return scenario, ()
    return None, ()


class _Loader:
    def __init__(self, document: Document, file: SweepFile, scenario: Scenario) -> None:
        self._document = document
        self._file = file
        plants = scenario.plants if file.plants is None else file.plants
        self._plants = tuple(p for p in PLANTS if p in plants)
        self._scenario = dict(scenario.document)
        settings = self._scenario["plants"]
        # A scenario that is only planned keeps its plants, because a scenario without
        # plants is invalid.
        self._scenario["plants"] = {
            plant: settings.get(plant, {}) for plant in self._plants or scenario.plants
        }
        self._scenario["expect"] = self._expectations()
        self._warnings = scenario.warnings

    def sweep(self, name: str) -> Sweep | None:
        """Return the sweep, or None after reporting problems."""
        file = self._file
        before = len(self._document.problems)
        self._check_names()
        self._check_planning()
        values = None
        experiment = Experiment(
            self._scenario,
            self._plants,
            file.periods,
            self._robots(),
            file.trajectories,
        )
        with self._document.report_errors("vary"):
            integer_fields = self._integer_fields(experiment)
            values = sample(file.vary, file.sampling, integer_fields)
        contradictory = len(self._document.problems) > before
        known_metrics = self._check_metrics()
        reported = len(self._document.problems)
        if values is None or contradictory:
            return None
        base = experiment.with_fixed(file.fixed)
        if changes := changed_fields(
            self._scenario,
            base,
            map(parse_path, file.fixed),
            self._scenario.get("changes", ()),
        ):
            base["changes"] = changes
        sweep = Sweep(
            name=name,
            title=file.title or name,
            experiment=replace(experiment, base=base),
            fields=tuple(file.vary),
            values=tuple(values),
            metrics=None if file.metrics is None else tuple(file.metrics),
            plots=tuple(file.plots),
            document=self._document.data,
            warnings=self._warnings,
        )
        for loc, problem in problems_at(self._test_points(sweep)):
            self._report_problem(loc, problem)
        # A plot may be right if a field that it names is misspelt in `vary`.
        if len(self._document.problems) == reported:
            self._check_plots(known_metrics)
        if len(self._document.problems) > before:
            return None
        return sweep

    def _integer_fields(self, experiment: Experiment) -> list[str]:
        vary = self._file.vary
        first = {
            field: values.start if isinstance(values, RangeFile) else values[0]
            for field, values in vary.items()
        }
        # The fields may belong to sections that the base scenario does not contain.
        data = experiment.with_fixed({**self._file.fixed, **first})
        model = scenario_model(Document("", data))
        return [
            field
            for field in vary
            if accepts_only_integers(model, parse_path(field), data)
        ]

    def _expectations(self) -> list[object]:
        """Return the expectations about plants that run."""
        subjects = {*self._scenario["plants"]}
        if len(subjects) == len(PLANTS):
            subjects.add(COMPARISON)
        return [
            entry
            for entry in self._scenario["expect"]
            if entry.get("plant", COMPARISON) in subjects
        ]

    @property
    def _fields(self) -> list[tuple[str, str]]:
        varied = [("vary", field) for field in self._file.vary]
        return varied + [("fixed", field) for field in self._file.fixed]

    def _check_names(self) -> None:
        idle = set(PLANTS) - set(self._plants)
        for section, field in self._fields:
            own_plant = parse_path(field)[1:2]
            if field.partition(".")[0] in NOT_PHYSICS:
                text = (
                    "this field only names or judges the results and has no effect on"
                    " the simulation; remove it"
                )
            elif field == "duration_s" and self._file.periods is not None:
                text = "`periods` also sets the duration; remove one of them"
            elif section == "fixed" and field in self._file.vary:
                text = "this field is also varied; remove it here or under `vary`"
            elif field.startswith("plants.") and idle.intersection(own_plant):
                text = (
                    f"the plant `{own_plant[0]}` does not run here; add it to `plants`"
                )
            else:
                continue
            self._document.report((section, field), text, at_key=True)

    def _check_planning(self) -> None:
        if self._plants:
            return
        if "planner" not in self._scenario:
            text = (
                "no plant is named and the scenario has no planner, so there is"
                " nothing to do; name a plant"
            )
            self._document.report(("plants",), text)
        for key in ("periods", "trajectories"):
            if getattr(self._file, key):
                text = (
                    "this key has no effect, because no plant runs with `plants:"
                    " []`; remove it"
                )
                self._document.report((key,), text, at_key=True)

    def _check_metrics(self) -> list[str]:
        """Report unknown metrics, and return the known metrics."""
        known = [*PLANNING_UNITS]
        if self._plants:
            known = [*metric_units(), *LIST_METRIC_UNITS]
        if len(self._plants) == len(PLANTS):
            known += COMPARISON_UNITS
        for i, metric in enumerate(self._file.metrics or ()):
            self._check_metric(("metrics", i), metric, known)
        return known

    def _check_plots(self, known: list[str]) -> None:
        plotted = self._file.metrics
        # A plot may also be right if its metric is misspelt in `metrics`.
        if plotted is None or not {*plotted} <= {*known}:
            plotted = known
        for i, plot in enumerate(self._file.plots):
            self._check_metric(("plots", i, "metric"), plot.metric, plotted)
            allowed = {*self._file.vary}
            if plot.kind == "scatter":
                allowed.update(plotted)
            for key, field in (("x", plot.x), ("by", plot.by)):
                if field is not None and field not in allowed:
                    self._document.report(("plots", i, key), self._not_varied(field))

    def _not_varied(self, field: str) -> str:
        varied = list(self._file.vary)
        hint = did_you_mean(field, varied) or f"; varied: {format_names(varied)}"
        return f"the field '{field}' is not varied{hint}"

    def _check_metric(self, loc: Loc, metric: str, known: list[str]) -> None:
        if metric in known:
            return
        text = str(UnknownNameError("metric", metric, known, METRICS_LISTED))
        if metric in COMPARISON_UNITS and len(self._plants) == 1:
            text = (
                f"the metric `{metric}` compares both plants, but only"
                f" {self._plants[0]} runs here; add the other plant to `plants`"
            )
        self._document.report(loc, text)

    def _robots(self) -> dict[str, object]:
        robots: dict[str, object] = {}
        varied = self._file.vary.get("robot")
        names: list[tuple[str, object]] = [("fixed", self._file.fixed.get("robot"))]
        if isinstance(varied, list):
            names += [("vary", value) for value in varied]
        for section, name in names:
            try:
                if isinstance(name, str):
                    robots[name] = load_robot_file(name).model_dump(mode="json")
            except InputError as error:
                self._document.report((section, "robot"), str(error), at_key=True)
        return robots

    def _test_points(
        self, sweep: Sweep
    ) -> Iterator[tuple[Loc, Experiment, Mapping[str, Value]]]:
        """Yield a point per varied value, with other fields at their first values."""
        experiment = sweep.experiment
        rows = [dict(zip(sweep.fields, row, strict=True)) for row in sweep.values]
        if self._file.sampling.kind == "list":
            yield from ((("vary",), experiment, row) for row in rows)
            return
        first = rows[0]
        yield ("vary",), experiment, first
        for field, varied in self._file.vary.items():
            values: Iterable[tuple[str | int, Value]] = ()
            if isinstance(varied, RangeFile):
                column = [row[field] for row in rows]
                numbers = [value for value in column if not isinstance(value, str)]
                values = {"from": min(numbers), "to": max(numbers)}.items()
            else:
                values = enumerate(varied)
            for key, value in values:
                yield ("vary", field, key), experiment, {**first, field: value}

    def _report_problem(self, loc: Loc, text: str) -> None:
        path, _, message = text.partition(": ")
        for section, field in self._fields:
            if path == field or path.startswith((f"{field}.", f"{field}[")):
                if loc[:2] != (section, field):
                    loc = section, field
                message = with_suggestion(message, field, leaf_names(self._scenario))
                is_key = message.startswith("unknown key")
                self._document.report(loc, message, at_key=is_key)
                return
        self._document.report(loc[:2], text)
