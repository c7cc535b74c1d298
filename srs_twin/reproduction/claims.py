"""Claims of the dissertation, and the runs and rules with which they are checked.

Each number in a table of the dissertation is checked separately.
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import AfterValidator, Field, model_validator

from srs_twin.errors import UnknownNameError
from srs_twin.io.documents import Document, Loc, load_yaml
from srs_twin.io.files import data_root, shipped_names
from srs_twin.io.validation import Model, validate
from srs_twin.reproduction import computations, traces
from srs_twin.scenario.expectation import AllowedRange
from srs_twin.scenario.fields import Section, quantity


def _functions(module: ModuleType) -> dict[str, Callable[..., Any]]:
    functions = dict(inspect.getmembers(module, inspect.isfunction))
    own = (name for name in functions if functions[name].__module__ == module.__name__)
    return {name: functions[name] for name in own if name[0] != "_"}


COMPUTATIONS = _functions(computations)
"""Functions that compute a claim's values without a run (key `computation`).

Each function receives the entries of `set` as arguments, and returns numbers keyed by
``<column>.<metric>``.
"""

TRACES = _functions(traces)
"""Functions that compute the metrics `trace.…` from a trajectory.

Each function returns a number or None.
"""

Plain = bool | int | float | Annotated[str, Field(max_length=200)]
Set = Plain | Annotated[list[float], Field(min_length=1, max_length=100)]
Fields = dict[Annotated[str, Field(max_length=200)], Plain]
Changes = dict[Annotated[str, Field(max_length=200)], Set]
Name = Annotated[str, Field(min_length=1, max_length=200)]
Column = Literal["analytical", "twin", "alone"]
Rule = Literal["near", "below", "above", "ordering"]
Use = Literal["fit", "holdout", "law", "shape"]
Take = Literal["most", "least", "mean", "spread"]
Combine = Literal["value", "ratio", "excess", "difference", "unevenness"]
Tolerance = Literal["dissertation", "measurement", "ours"]
Limitation = Literal[
    "fitted_robot",
    "chosen_parameter",
    "tuned_controller",
    "chosen_obstacles",
    "between_models",
]
Group = Literal["headline", "own_tolerance"] | Limitation
Category = Group | Literal["shape", "by_construction", "law", "fit"]


def _check_answer(text: str) -> str:
    if not text.startswith(("Yes: ", "No: ")):
        raise ValueError("`could_fail` must begin with 'Yes: ' or 'No: '")
    return text


Falsifiability = Annotated[str, Field(max_length=500), AfterValidator(_check_answer)]
"""Sentence that states whether the check of a claim could have failed."""

_BOUND = 1e9
"""Maximum magnitude of a published value."""

CLAIMS_BYTES = 128 * 1024
"""Maximum size of a claims file, bytes. A file with 166 claims takes 72 kB."""


class RunRequest(Section):
    """Runs of a scenario or sweep, or a computation, that a claim requires."""

    scenario: Name | None = None
    """Shipped scenario."""
    sweep: Name | None = None
    """Shipped sweep."""
    computation: Name | None = None
    """Computation that replaces runs."""
    set: Changes = {}
    """Changed fields of the scenario, or arguments of the computation."""
    periods: float | None = quantity(3.0, 1000.0, None)
    """Simulated time in periods."""
    where: Fields = {}
    """Values of the varied fields that select points of the sweep."""

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        if [self.scenario, self.sweep, self.computation].count(None) != 2:
            raise ValueError(
                "give exactly one of the keys `scenario`, `sweep` and `computation`"
            )
        if self.where and self.sweep is None:
            raise ValueError("`where` is allowed only with `sweep`; remove it")
        if self.periods is not None and self.scenario is None:
            raise ValueError("`periods` is allowed only with `scenario`; remove it")
        return self

    @property
    def kind(self) -> str:
        """Kind of the request: "scenario", "sweep" or "computation"."""
        if self.computation is not None:
            return "computation"
        return "scenario" if self.sweep is None else "sweep"

    @property
    def name(self) -> str:
        """Scenario, sweep or computation."""
        return str(getattr(self, self.kind))

    def check_names(self, document: Document, loc: Loc) -> None:
        """Report an unknown scenario, sweep or computation to the document."""
        names = COMPUTATIONS if self.kind == "computation" else shipped_names(self.kind)
        if self.name not in names:
            document.report(
                (*loc, self.kind), str(UnknownNameError(self.kind, self.name, names))
            )


class Measure(RunRequest):
    """Number taken from a run, from the runs of a sweep, or from a computation."""

    metric: Name
    """Metric, `comparison.…`, `trace.…` (computed from the trajectory), or name of a
    computed result.
    """
    take: Take | None = None
    """Aggregation over the points of a sweep."""
    plant: Literal["analytical", "twin"] | None = None
    """Plant whose value is used in all columns."""
    size: bool = False
    """Whether the absolute value is compared."""

    def check_names(self, document: Document, loc: Loc) -> None:
        """Report an unknown scenario, sweep, computation or metric to the document."""
        super().check_names(document, loc)
        prefix, _, trace = self.metric.partition(".")
        if prefix == "trace" and trace not in TRACES:
            document.report(
                (*loc, "metric"), str(UnknownNameError("trace", trace, TRACES))
            )


class Cause(Section):
    """Reason why a plant's results contradict a claim.

    A run with a changed assumption or a section of the documentation demonstrates the
    reason. Otherwise the reason is only presumed.
    """

    says: Name
    """Description of the reason."""
    columns: list[Column] = ["analytical", "twin"]
    """Columns of results that the reason explains."""
    docs: Name | None = None
    """Section of the documentation that demonstrates the reason, for example
    docs/verification.md#why-they-differ."""
    switch: Name | None = None
    """Name of the assumption that is changed."""
    set: Changes = {}
    """Fields of the scenario that change the assumption.

    With these fields, the results must agree with the claim.
    """

    @model_validator(mode="after")
    def _check_evidence(self) -> Self:
        if (self.docs and self.switch) or bool(self.set) != (self.switch is not None):
            raise ValueError(
                "the evidence is incomplete; give `docs`, or `switch` together with"
                " `set`, or neither for a presumed cause"
            )
        return self


class TableRows(Section):
    """Rule that derives claims from the numbers of a table."""

    at: Name
    """Key under which each row of the table contains the setting."""
    field: Name
    """Field that the sweep varies, with the setting as its value."""
    sweep: Name
    """Sweep with one point per setting."""
    columns: dict[Name, Name]
    """Metric for each column of the table."""
    signed: list[Name] = []
    """Columns whose numbers are printed without a sign. These numbers take the sign of
    `at`. If `at` is 0, absolute values are compared.
    """
    fit: list[Name] = []
    """Columns whose values calibration may use."""
    fit_at: list[float] = []
    """Settings of the rows in which calibration may use the columns of `fit`."""
    could_fail: dict[Name, Falsifiability]
    """Sentence for each column that states whether its claims could have failed."""
    could_fail_fit: Falsifiability
    """Sentence that states whether claims used for calibration could have failed."""
    cause: dict[Name, list[Cause]] = {}
    """Known reasons for missed claims, for each column."""

    @model_validator(mode="after")
    def _check_columns(self) -> Self:
        if self.could_fail.keys() != self.columns.keys():
            raise ValueError(
                "`could_fail` must have a sentence for each key of `columns`, and no"
                " other keys"
            )
        if not self.cause.keys() <= self.columns.keys():
            raise ValueError("`cause` must have only keys of `columns`")
        return self

    def is_fitted(
        self, column: str, at: float, rows: Sequence[Mapping[str, float]]
    ) -> bool:
        """Return whether calibration may use the value of `column` in the row at `at`.

        This is also true if calibration may use an equal value of the same column.
        """
        if column not in self.fit:
            return False
        setting = next(row for row in rows if row[self.at] == at)
        return setting[column] in {
            row[column] for row in rows if row[self.at] in self.fit_at
        }


class Claim(Section):
    """Statement of the dissertation and the rule that checks it."""

    id: Annotated[str, Field(pattern=r"^[a-z0-9]+([.-][a-z0-9]+)*$", max_length=80)]
    """Name of the claim."""
    source: Name
    """Section, figure or table of the dissertation, or erratum."""
    robot: Literal["gen1", "gen2", "gen3", "gen4"] | None = None
    """Generation of the robot."""
    says: Annotated[str, Field(min_length=1, max_length=600)]
    """Text of the claim."""
    use: Use
    """Use of the claim: `fit`, `holdout`, `law` or `shape`."""
    could_fail: Falsifiability | None = None
    """Whether the check of the claim could have failed. "Yes: …" describes which
    results would contradict the claim, and where the tolerance comes from. "No: …"
    states why no result could contradict the claim.
    """
    tolerance: Tolerance | None = None
    """Origin of the tolerance of a prediction.

    The tolerance is stated in the dissertation, follows from its measurement error, or
    was chosen by us.
    """
    limitation: Limitation | None = None
    """Reason why the claim is not a headline prediction, regardless of its tolerance.
    """
    value: float | None = quantity(-_BOUND, _BOUND, None, unit="the unit")
    """Published value."""
    unit: Name = "1"
    """Unit of the value."""
    tol: float | None = quantity(0.0, 100.0, None)
    """Relative tolerance."""
    abs: float | None = quantity(0.0, _BOUND, None, unit="the unit")
    """Absolute tolerance."""
    rule: Rule | None = None
    """Rule: `near`, `below`, `above`, or `ordering` (each measure exceeds the next
    measure).
    """
    measure: Measure | None = None
    """Measure that is compared with the value."""
    measures: list[Measure] = []
    """Measures that are combined into one number or compared with each other."""
    combine: Combine = "value"
    """Combination of the measures into one number."""
    columns: list[Column] = ["analytical", "twin"]
    """Columns of results that are compared with the claim."""
    quick: bool = False
    """Whether the option `--quick` includes the claim."""
    cause: list[Cause] = []
    """Known reasons why the results contradict the claim."""
    table: TableRows | None = None
    """Rule that derives claims from the numbers in `rows`."""
    rows: list[dict[Name, float]] = []
    """Numbers of a table."""
    note: Annotated[str, Field(max_length=1000)] | None = None
    """Note for readers."""

    @model_validator(mode="after")
    def _check_evidence(self) -> Self:
        if (self.could_fail is None) == (self.table is None):
            raise ValueError(
                "`could_fail` must be given either here ('Yes: …' or 'No: …') or, for"
                " a table, in `table`"
            )
        if (self.tolerance is None) == (self.use == "holdout"):
            raise ValueError(
                "`tolerance` is required for each holdout and not allowed for other"
                " uses"
            )
        if self.limitation is not None and self.use != "holdout":
            raise ValueError("`limitation` is allowed only for a holdout; remove it")
        if self.group == "headline" and not self.falsifiable:
            raise ValueError(
                "a headline prediction must be able to fail, so `could_fail` must"
                " begin with 'Yes: '"
            )
        return self

    @model_validator(mode="after")
    def _check_rule(self) -> Claim:
        if self.table is not None:
            if not self.rows or self.tol is None or self.rule is not None:
                raise ValueError(
                    "a table needs `rows` and `tol`, and must have no `rule`, because"
                    " its rows always have the rule near"
                )
            return self
        if self.rule is None:
            raise ValueError(
                "`rule` is missing; it must be near, below, above or ordering"
            )
        if (self.measure is None) == (not self.measures):
            raise ValueError("give either `measure` or `measures`")
        if self.rule == "ordering":
            if (
                len(self.measures) < 2
                or self.value is not None
                or self.combine != "value"
            ):
                raise ValueError(
                    "the rule ordering needs two or more `measures`, and neither"
                    " `value` nor `combine`"
                )
            return self
        if self.value is None:
            raise ValueError(f"the rule {self.rule} needs a `value`")
        if self.measures and (self.combine == "value" or len(self.measures) != 2):
            raise ValueError(
                "two `measures` need `combine`, which must be ratio, excess,"
                " difference or unevenness"
            )
        if self.rule == "near" and (self.tol is None) == (self.abs is None):
            raise ValueError("the rule near needs either `tol` or `abs`")
        return self

    def is_named(self, name: str) -> bool:
        """Return whether `name` is the claim's name or its beginning up to a dot."""
        return f"{self.id}.".startswith(f"{name}.")

    @property
    def fitted(self) -> bool:
        """Whether calibration may use the claim, which is then not a prediction."""
        return self.use == "fit"

    @property
    def falsifiable(self) -> bool:
        """Whether the check of the claim could have failed."""
        return self.could_fail is None or self.could_fail.startswith("Yes")

    @property
    def group(self) -> Group | None:
        """Group of a prediction, or None if the claim is not a prediction."""
        if self.use != "holdout":
            return None
        if self.limitation is not None:
            return self.limitation
        return "own_tolerance" if self.tolerance == "ours" else "headline"

    @property
    def category(self) -> Category:
        """Group if the claim is a prediction, otherwise the use of the claim."""
        if self.group is not None:
            return self.group
        if self.use == "shape" and not self.falsifiable:
            return "by_construction"
        return self.use  # type: ignore[return-value]  # holdouts have a group

    @property
    def all_measures(self) -> list[Measure]:
        """All measures of the claim, in a list."""
        return [self.measure] if self.measure else self.measures

    def with_switch(self, cause: Cause) -> Claim:
        """Return the claim with the scenario changes that `cause` specifies."""
        measures = [
            measure.model_copy(update={"set": {**measure.set, **cause.set}})
            for measure in self.all_measures
        ]
        return self.model_copy(update={"measure": None, "measures": measures})

    @property
    def allowed(self) -> AllowedRange:
        """Range of allowed values. A tolerance extends a one-sided bound."""
        if self.value is None:
            return AllowedRange()
        near = AllowedRange.near(self.value, self.tol, self.abs)
        if self.rule == "below":
            return AllowedRange(high=near.high)
        if self.rule == "above":
            return AllowedRange(low=near.low)
        return near

    @property
    def allowed_text(self) -> str:
        """Text that describes the allowed values."""
        if self.rule == "ordering":
            return "each above the next"
        return self.allowed.text


COLUMNS = get_args(Column)
"""Result columns: the plants, and "alone" for computations without a plant."""


def claims_file() -> Path:
    """Return the path of `claims.yaml` in the package data."""
    return data_root() / "calibration/published/claims.yaml"


def load_claims(path: Path | None = None) -> tuple[Claim, ...]:
    """Load the claims of a claims file.

    Raises:
        InputError: the file cannot be read.
        InputFileError: the file is invalid. The message lists all problems.
    """
    document, claims = load_list(path or claims_file(), Claim, "claims")
    rows: list[Claim] = []
    for i, claim in claims:
        for k, measure in enumerate(claim.all_measures):
            measure.check_names(
                document, (i, "measure") if claim.measure else (i, "measures", k)
            )
        rows += _rows(claim)
    for name, count in Counter(row.id for row in rows).items():
        if count > 1:
            document.report((), f"the row {name} is listed {count} times; list it once")
    document.raise_problems()
    return tuple(rows)


def load_list(
    path: Path, model: type[Model], label: str
) -> tuple[Document, list[tuple[int, Model]]]:
    """Read a list of sections from a YAML file.

    Returns:
        Document with its problems, and index and section of each valid entry.

    Raises:
        InputError: the file cannot be read.
    """
    document = load_yaml(path, limit=CLAIMS_BYTES)
    entries = document.data if isinstance(document.data, list) else []
    if not entries:
        document.report((), f"must be a list of {label}")
    sections = [
        (i, validate(model, document, entry, prefix=(i,)))
        for i, entry in enumerate(entries)
    ]
    return document, [(i, section) for i, section in sections if section is not None]


def select_claims(
    claims: tuple[Claim, ...], only: tuple[str, ...], *, quick: bool
) -> tuple[Claim, ...]:
    """Select claims by name or by the beginning of the name. Laws come first.

    Args:
        claims: all claims.
        only: names, or beginnings of names that end before a dot. An empty tuple
            selects all claims.
        quick: whether to select only quick claims.

    Raises:
        UnknownNameError: no claim has such a name.
    """
    selected = [claim for claim in claims if claim.quick or not quick]
    if only:
        for name in only:
            if not any(claim.is_named(name) for claim in claims):
                ids = [claim.id for claim in claims]
                raise UnknownNameError("claim", name, ids, "docs/reproduction.md")
        selected = [c for c in selected if any(map(c.is_named, only))]
    return tuple(sorted(selected, key=lambda claim: claim.use != "law"))


def _rows(claim: Claim) -> Iterator[Claim]:
    table = claim.table
    if table is None:
        yield claim
        return
    for row in claim.rows:
        at = row[table.at]
        for column, metric in table.columns.items():
            value = row[column]
            is_signed = column in table.signed
            if is_signed and at < 0:
                value = -value
            unit = "m/s" if metric.endswith("_m_s") else "m"
            changes: dict[str, object] = {
                "id": f"{claim.id}.{column}.{_setting_name(at)}",
                "says": f"{column} {value:g} {unit} at {table.at} {at:g}",
                "cause": table.cause.get(column, []),
                "could_fail": table.could_fail[column],
                "rule": "near",
                "value": value,
                "unit": unit,
                "measure": Measure(
                    sweep=table.sweep,
                    metric=metric,
                    where={table.field: at},
                    size=is_signed and at == 0,
                ),
                "table": None,
                "rows": [],
            }
            if table.is_fitted(column, at, claim.rows):
                changes |= {"use": "fit", "tolerance": None, "limitation": None}
                changes["could_fail"] = table.could_fail_fit
            yield claim.model_copy(update=changes)


def _setting_name(at: float) -> str:
    """Return a setting as part of a claim name, e.g. p03 for 0.3 or m03 for −0.3."""
    sign = "m" if at < 0 else "p"
    return f"{sign}{abs(at):g}".replace(".", "") if at else "0"
