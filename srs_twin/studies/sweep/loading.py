"""From a sweep file to a Sweep; everything that is wrong is reported at once, with its place."""

from __future__ import annotations

import copy
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from srs_twin.comparison.metrics import COMPARISON_UNITS, LIST_METRIC_UNITS, METRIC_UNITS, METRICS_LISTED
from srs_twin.errors import InputError, InputFileError, UnknownNameError, did_you_mean, some
from srs_twin.io.documents import Change, Document, Loc, dotted, load_yaml, path_of
from srs_twin.io.files import find, results_name
from srs_twin.io.validation import validate
from srs_twin.planning.metrics import PLANNING_UNITS
from srs_twin.robot.file import load_robot_file
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.scenario.modified import Changes, affects, changed_fields, marked, with_plants
from srs_twin.scenario.plants import PLANTS
from srs_twin.scenario.provenance import NOT_PHYSICS, versions
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.file import RangeFile, SweepFile
from srs_twin.studies.sweep.points import Experiment, Sweep, Value, leaves, sample
from srs_twin.studies.sweep.table import Published, Values


def check_beside(document: Document, file: SweepFile, given: Published) -> None:
    """Report what is wrong with published values.

    Args:
        document: what the problems are reported to.
        file: the sweep.
        given: its published values.
    """
    for field, values in given.at.items():
        if field in file.vary:
            _check_values(document, file, field, values)
        else:
            hint = did_you_mean(field, file.vary) or f"; varied: {some(list(file.vary))}"
            document.report(("beside", "at", field), f"is not varied{hint}", at_key=True)
    columns = list(METRIC_UNITS) if file.metrics is None else [m for m in file.metrics if m in METRIC_UNITS]
    for metric in given.metrics:
        loc = ("beside", "metrics", metric)
        if metric not in METRIC_UNITS:
            document.report(
                loc, str(UnknownNameError("metric", metric, METRIC_UNITS, METRICS_LISTED)), at_key=True
            )
        elif metric not in columns:
            document.report(loc, "is not among the sweep's metrics; add it there", at_key=True)
    _check_lengths(document, given)


def _check_lengths(document: Document, given: Published) -> None:
    first, values = next(iter(given.at.items()))
    for section, lists in (("at", given.at), ("metrics", given.metrics)):
        for name, column in lists.items():
            if len(column) != len(values):
                message = f"has {len(column)} values, but {first} has {len(values)}"
                document.report(("beside", section, name), message)
    if all(len(column) == len(values) for column in given.at.values()):
        places = Counter(zip(*given.at.values(), strict=True))
        twice = [place for place, count in places.items() if count > 1]
        if twice:
            named = ", ".join(f"{n} {v}" for n, v in zip(given.at, twice[0], strict=True))
            document.report(("beside", "at"), f"{named} is given twice")


def _check_values(document: Document, file: SweepFile, field: str, values: Sequence[Any]) -> None:
    """Report texts and truth values that no point has; numbers may lie anywhere, see `not_run`."""
    varied = file.vary[field]
    numbers = isinstance(varied, RangeFile) or any(_is_number(value) for value in varied)
    others = [] if isinstance(varied, RangeFile) else [value for value in varied if not _is_number(value)]
    for i, value in enumerate(values):
        known = numbers if _is_number(value) else value in others
        if not known:
            has = ", ".join(map(str, others[:10])) if others else "numbers"
            document.report(
                ("beside", "at", field, i), f"{field} never is {value!r}; it is varied over {has}"
            )


def not_run(sweep: Sweep) -> tuple[str, ...]:
    """Return a warning for every field with published values at numbers that no point has."""
    found = []
    for field, values in sweep.beside.at.items() if sweep.beside else ():
        column = [row[sweep.fields.index(field)] for row in sweep.values]
        there = Values("", np.unique([float(value) for value in column if _is_number(value)]))
        missing = [value for value in values if _is_number(value) and not there.at(value).any()]
        if missing:
            named = ", ".join(f"{value:g}" for value in missing[:5])
            more = f" and {len(missing) - 5} more" if len(missing) > 5 else ""
            found.append(f"beside: no run has {field} {named}{more}")
    return tuple(found)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def load_sweep(
    name_or_path: str | os.PathLike[str],
    *,
    set: Sequence[Change] = (),
    plants: Sequence[str] | None = None,
) -> Sweep:
    """Load a sweep: a shipped name (fig31) or the path of a sweep file.

    Args:
        name_or_path: of the sweep.
        set: fields of the scenario that are fixed besides those of the file.
        plants: in place of the file's.

    Raises:
        InputError: not found or not readable.
        InputFileError: everything that is wrong with it, one line each.
    """
    path = find("sweep", name_or_path)
    document, name = load_yaml(path), results_name(path)
    written = copy.deepcopy(document.data)
    for change in set:
        document.change(replace(change, loc=("fixed", dotted(change.loc))))
    if plants is not None:
        document.change(Change(f"--plants {','.join(plants)}", ("plants",), list(plants)))
    file = validate(SweepFile, document, document.data)
    scenario, foreign = _scenario(document)
    sweep = None
    if file is not None and scenario is not None:
        sweep = _Loading(document, file, scenario).sweep(name)
    document.finish(foreign)
    assert sweep is not None and scenario is not None, "no problem was reported"
    return _modified(sweep, scenario, written, [change.loc for change in set])


def _modified(sweep: Sweep, scenario: Scenario, written: Mapping[str, Any], locs: Sequence[Loc]) -> Sweep:
    """Return a sweep with the fields that were set in its title, without the published values they decide.

    Args:
        sweep: as it runs.
        scenario: the unmodified scenario.
        written: plain data of the sweep's file.
        locs: paths of the scenario's fields that were set.
    """
    before = replace(sweep.experiment, base=scenario.document).with_fixed(written.get("fixed") or {})
    found = changed_fields(before, sweep.experiment.base, locs)
    named = written["plants"] if written.get("plants") is not None else list(scenario.plants)
    changes = with_plants(found, named, sweep.experiment.plants)
    if not changes:
        return sweep
    title, beside, warnings = marked(sweep.title, changes), sweep.beside, sweep.warnings
    if beside is not None:
        by = {metric: _deciding(changes, metric) for metric in beside.metrics}
        kept = {metric: values for metric, values in beside.metrics.items() if not by[metric]}
        if left_out := [metric for metric in by if metric not in kept]:
            fields = ", ".join(dict.fromkeys(field for metric in left_out for field in by[metric]))
            text = f"published values of {', '.join(left_out)} are left out, because {fields} was changed"
            beside = beside.model_copy(update={"metrics": kept}) if kept else None
            warnings = (*warnings, f"beside: {text}")
    # sweep.yaml, which is made from it, can be run again.
    document = {key: value for key, value in sweep.document.items() if key != "beside"}
    document |= {"title": title[:200]}
    if beside is not None:
        document |= {"beside": beside.model_dump(mode="json", exclude_none=True)}
    return replace(sweep, title=title, changes=changes, beside=beside, warnings=warnings, document=document)


def _deciding(changes: Changes, metric: str) -> list[str]:
    """Return the changed fields that decide a metric of any plant."""
    return [each["field"] for each in changes if any(affects(each["field"], metric, p) for p in PLANTS)]


def _scenario(document: Document) -> tuple[Scenario | None, tuple[str, ...]]:
    """Return the scenario, and what is wrong with its own file."""
    given = document.get("scenario")
    if not isinstance(given, str):
        return None, ()
    with document.reporting("scenario"):
        try:
            return load_scenario(given), ()
        except InputFileError as error:
            return None, error.lines
    return None, ()


_OF_PLANTS = {
    "periods": "nothing runs where plants is []; take it out",
    "trajectories": "there are none where plants is []",
    "beside": "is of plants, and plants is []; take it out",
}


class _Loading:
    """Checks a sweep against its scenario and puts it together."""

    def __init__(self, document: Document, file: SweepFile, scenario: Scenario) -> None:
        self._document, self._file = document, file
        named = scenario.plants if file.plants is None else file.plants
        self._plants = tuple(p for p in PLANTS if p in named)
        self._scenario = dict(scenario.document)
        settings = self._scenario["plants"]
        # Where nothing runs, the scenario still is what its file says.
        self._scenario["plants"] = {
            plant: settings.get(plant, {}) for plant in self._plants or scenario.plants
        }
        self._warnings = scenario.warnings

    def sweep(self, name: str) -> Sweep | None:
        """Return the sweep, or None after reporting what is wrong with it."""
        file, before = self._file, len(self._document.problems)
        self._check_names()
        self._check_planning()
        self._check_metrics()
        if file.beside is not None:
            check_beside(self._document, file, file.beside)
        values, robots = None, self._robots()
        with self._document.reporting("vary"):
            values = sample(file.vary, file.sampling)
        if values is None or len(self._document.problems) > before:
            return None
        experiment = Experiment(self._scenario, self._plants, file.periods, robots, file.trajectories)
        base = experiment.with_fixed(file.fixed)
        if changes := changed_fields(
            self._scenario, base, map(path_of, file.fixed), self._scenario.get("changes", ())
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
            versions=versions(),
            document=self._document.data,
            warnings=self._warnings,
            beside=file.beside,
        )
        sweep = replace(sweep, warnings=(*sweep.warnings, *not_run(sweep)))
        self._check_values(sweep)
        return None if len(self._document.problems) > before else sweep

    def _check_names(self) -> None:
        idle = set(PLANTS) - set(self._plants)
        for section in ("fixed", "vary"):
            for field in getattr(self._file, section):
                if field.partition(".")[0] in NOT_PHYSICS:
                    self._report(
                        section, field, "says how results are named or judged, not what is simulated"
                    )
                elif field == "duration_s" and self._file.periods is not None:
                    self._report(section, field, "periods says how long a run is; take one of them out")
                elif section == "fixed" and field in self._file.vary:
                    self._report(section, field, "is varied as well; take one of them out")
                first, *path = path_of(field)
                if first == "plants" and idle.intersection(path[:1]):
                    self._report(section, field, f"{path[0]} does not run here; add it to plants")

    def _check_planning(self) -> None:
        """Where nothing runs there must be a plan."""
        if self._plants:
            return
        if "planner" not in self._scenario:
            text = "none, but the scenario has no planner: there is nothing to do"
            self._document.report(("plants",), text)
        for key, text in _OF_PLANTS.items():
            if getattr(self._file, key):
                self._document.report((key,), text, at_key=True)

    def _check_metrics(self) -> None:
        known = [*METRIC_UNITS, *LIST_METRIC_UNITS, *(COMPARISON_UNITS if len(self._plants) == 2 else ())]
        known = known if self._plants else list(PLANNING_UNITS)
        for i, metric in enumerate(self._file.metrics or ()):
            self._check_metric(("metrics", i), metric, known)
        for i, plot in enumerate(self._file.plots):
            drawn = known if self._file.metrics is None else list(self._file.metrics)
            self._check_metric(("plots", i, "metric"), plot.metric, drawn)
            for key in ("x", "y", "by"):
                field = getattr(plot, key)
                if field is None or field in self._file.vary or (plot.kind == "scatter" and field in drawn):
                    continue
                hint = did_you_mean(field, self._file.vary) or f"; varied: {some(list(self._file.vary))}"
                self._document.report(("plots", i, key), f"'{field}' is not varied{hint}")

    def _check_metric(self, loc: tuple[str | int, ...], metric: str, known: list[str]) -> None:
        if metric in known:
            return
        if metric in COMPARISON_UNITS and len(self._plants) == 1:
            self._document.report(loc, f"{metric} compares both plants; only {self._plants[0]} runs here")
        else:
            self._document.report(loc, str(UnknownNameError("metric", metric, known, METRICS_LISTED)))

    def _robots(self) -> dict[str, Any]:
        """Return the robots that are named, so that the key of a point knows what is in their files."""
        found = {}
        values = self._file.vary.get("robot", ())
        varied = () if isinstance(values, RangeFile) else values
        given = [("fixed", self._file.fixed.get("robot")), *(("vary", value) for value in varied)]
        for section, name in given:
            try:
                if isinstance(name, str):
                    found[name] = load_robot_file(name).model_dump(mode="json")
            except InputError as error:
                self._report(section, "robot", str(error))
        return found

    def _check_values(self, sweep: Sweep) -> None:
        """Let the scenario's own checks see fixed values, and varied ones each beside the others' first."""
        first = dict(zip(sweep.fields, sweep.values[0], strict=True))
        seen: set[str] = set()
        for loc, changes in self._probes(sweep, first):
            try:
                parse_scenario(sweep.experiment.document(changes), name="")
            except InputFileError as error:
                # What is wrong with every point is said once, where it was written.
                for line in dict.fromkeys(error.lines):
                    if line not in seen:
                        self._blame(loc, line.removeprefix(": "))
                seen.update(error.lines)

    def _probes(
        self, sweep: Sweep, first: Mapping[str, Value]
    ) -> Iterator[tuple[tuple[str | int, ...], Mapping[str, Value]]]:
        """Yield where values stand and the changes of a point that has them."""
        if self._file.sampling.kind == "list":
            for row in sweep.values:
                yield ("vary",), dict(zip(sweep.fields, row, strict=True))
            return
        yield ("vary",), first
        for j, (field, given) in enumerate(self._file.vary.items()):
            if isinstance(given, RangeFile):
                column = [row[j] for row in sweep.values if not isinstance(row[j], str)]
                ends = {"from": min(column), "to": max(column)}
                for end, value in ends.items():
                    yield ("vary", field, end), {**first, field: value}
            else:
                for i, value in enumerate(given):
                    yield ("vary", field, i), {**first, field: value}

    def _blame(self, loc: tuple[str | int, ...], text: str) -> None:
        """Report a problem of a point where its field stands in the file."""
        place, _, message = text.partition(": ")
        for section in ("vary", "fixed"):
            for field in getattr(self._file, section):
                if place == field or place.startswith((f"{field}.", f"{field}[")):
                    where = loc if loc[:2] == (section, field) else (section, field)
                    unknown = message.startswith("unknown key")
                    elsewhere = unknown and "did you mean" not in message
                    hint = did_you_mean(field, leaves(self._scenario)) if elsewhere else ""
                    self._document.report(where, message + hint, at_key=unknown)
                    return
        self._document.report(loc[:2], text)

    def _report(self, section: str, field: str, message: str) -> None:
        self._document.report((section, field), message, at_key=True)
