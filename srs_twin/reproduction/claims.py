"""Claims of the dissertation, with the runs and rules that check the claims.

Each number in a table of the dissertation is a separate claim.
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
from srs_twin.studies.sweep.points import Plain


def _functions(module: ModuleType) -> dict[str, Callable[..., Any]]:
    return {
        name: function
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__ and name[0] != "_"
    }


COMPUTATIONS = _functions(computations)
"""Functions for the key `computation`, which replace the run of a scenario.

Each function receives the entries of `set` as arguments, and returns numbers keyed by
``<column>.<metric>``.
"""

TRACES = _functions(traces)
"""Functions that compute the metrics ``trace.<name>`` from a trajectory, keyed by name.

A function returns None if the trajectory does not contain the required data.
"""

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
"""Statement on whether a check could have failed, beginning with "Yes: " or "No: "."""

_BOUND = 1e9
"""Maximum absolute value of published values and absolute tolerances."""

CLAIMS_BYTES = 128 * 1024
"""Maximum size of a file with claims or figures, bytes."""


class RunRequest(Section):
    """Request for runs of a scenario or sweep, or for a computation."""

    scenario: Name | None = None
    sweep: Name | None = None
    computation: Name | None = None
    """Name of a function in `COMPUTATIONS`."""
    set: Changes = {}
    """Changed fields of the scenario or sweep, or arguments of the computation."""
    periods: float | None = quantity(3.0, 1000.0, None)
    """Simulated time in gait periods."""
    where: Fields = {}
    """Values of varied fields, which select points of the sweep."""

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
        """Name of the scenario, sweep or computation."""
        return str(getattr(self, self.kind))

    def check_names(self, document: Document, loc: Loc) -> None:
        """Report an unknown scenario, sweep or computation as a file problem."""
        names = COMPUTATIONS if self.kind == "computation" else shipped_names(self.kind)
        if self.name not in names:
            document.report(
                (*loc, self.kind), str(UnknownNameError(self.kind, self.name, names))
            )


class Measure(RunRequest):
    """Number that is taken from runs or from a computation."""

    metric: Name
    """Name of a metric or computed number.

    The prefix ``comparison.`` denotes a metric that compares both plants, and the
    prefix ``trace.`` denotes a function in `TRACES`.
    """
    take: Take | None = None
    """Aggregation of the values at all points of a sweep."""
    plant: Literal["analytical", "twin"] | None = None
    """Plant that provides the value in all columns of results."""
    size: bool = False
    """Whether the absolute values of the results are used."""

    def check_names(self, document: Document, loc: Loc) -> None:
        """Report unknown names, including names of traces, as file problems."""
        super().check_names(document, loc)
        prefix, _, trace = self.metric.partition(".")
        if prefix == "trace" and trace not in TRACES:
            document.report(
                (*loc, "metric"), str(UnknownNameError("trace", trace, TRACES))
            )


class Cause(Section):
    """Reason why results contradict a claim.

    The reason is demonstrated by a section of the documentation or by a run with a
    changed assumption. Without such evidence, the reason is only presumed.
    """

    says: Name
    columns: list[Column] = ["analytical", "twin"]
    """Columns of results to which the reason applies."""
    docs: Name | None = None
    """Section of the documentation that demonstrates the reason, for example
    docs/verification.md#why-they-differ."""
    switch: Name | None = None
    """Name of the changed assumption."""
    set: Changes = {}
    """Scenario fields that change the assumption.

    The reason is demonstrated if the claim is met with these fields.
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
    """Rule that derives claims from the numbers in a table."""

    at: Name
    """Table column that contains the setting of each row, for example the offset."""
    field: Name
    """Scenario field that the sweep sets to the setting of each row."""
    sweep: Name
    """Sweep with one point per setting."""
    columns: dict[Name, Name]
    """Metrics that are compared with the table, keyed by table column."""
    signed: list[Name] = []
    """Table columns in which the dissertation prints numbers without a sign.

    The numbers get the sign of the setting. At a setting of 0, absolute values are
    compared.
    """
    fit: list[Name] = []
    """Table columns whose numbers may be used for calibration."""
    fit_at: list[float] = []
    """Settings at which the table columns in `fit` may be used for calibration."""
    could_fail: dict[Name, Falsifiability]
    """Statement on whether claims could have failed, keyed by table column."""
    could_fail_fit: Falsifiability
    """Statement on whether claims that are used for calibration could have failed."""
    cause: dict[Name, list[Cause]] = {}
    """Known reasons for missed claims, keyed by table column."""

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
        """Return whether a number in the table may be used for calibration.

        Numbers that equal a calibration number in the same column are included.
        """
        if column not in self.fit:
            return False
        setting = next(row for row in rows if row[self.at] == at)
        return setting[column] in {
            row[column] for row in rows if row[self.at] in self.fit_at
        }


class Claim(Section):
    """Statement of the dissertation, and the rule that checks the statement."""

    id: Annotated[str, Field(pattern=r"^[a-z0-9]+([.-][a-z0-9]+)*$", max_length=80)]
    source: Name
    """Section, figure or table of the dissertation, or an erratum."""
    robot: Literal["gen1", "gen2", "gen3", "gen4"] | None = None
    says: Annotated[str, Field(min_length=1, max_length=600)]
    use: Use
    """Use of the claim as calibration data (`fit`), prediction (`holdout`), law (`law`)
    or trend (`shape`).
    """
    could_fail: Falsifiability | None = None
    """Statement on whether the check of the claim could have failed.

    "Yes: …" states which results would contradict the claim, and where the tolerance
    comes from. "No: …" states why no result could contradict the claim.
    """
    tolerance: Tolerance | None = None
    """Origin of a prediction's tolerance.

    The tolerance is stated in the dissertation, derived from the difference between two
    of its values, or chosen by us.
    """
    limitation: Limitation | None = None
    """Reason why the claim is not a headline prediction, regardless of its tolerance.
    """
    value: float | None = quantity(-_BOUND, _BOUND, None, unit="the unit")
    """Published value."""
    unit: Name = "1"
    tol: float | None = quantity(0.0, 100.0, None)
    """Relative tolerance."""
    abs: float | None = quantity(0.0, _BOUND, None, unit="the unit")
    """Absolute tolerance."""
    rule: Rule | None = None
    """Rule that decides whether the claim is met.

    With the rule `ordering`, each measure must exceed the next measure.
    """
    measure: Measure | None = None
    """Measure that is compared with the published value."""
    measures: list[Measure] = []
    """Measures that are combined into one number or compared with each other."""
    combine: Combine = "value"
    """Operation that combines the measures into one number."""
    columns: list[Column] = ["analytical", "twin"]
    """Columns of results in which the claim is judged."""
    quick: bool = False
    """Whether the option `--quick` includes the claim."""
    cause: list[Cause] = []
    """Known reasons why results contradict the claim."""
    table: TableRows | None = None
    """Rule that derives claims from the numbers in `rows`."""
    rows: list[dict[Name, float]] = []
    """Rows of a table, with numbers keyed by column."""
    note: Annotated[str, Field(max_length=1000)] | None = None

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
        """Return whether `name` is the claim's name, or a part of it before a dot."""
        return f"{self.id}.".startswith(f"{name}.")

    @property
    def fitted(self) -> bool:
        """Whether the claim may be used for calibration."""
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
        """Category of the claim, which is the group if the claim is a prediction."""
        if self.group is not None:
            return self.group
        if self.use == "shape" and not self.falsifiable:
            return "by_construction"
        return self.use  # type: ignore[return-value]  # holdouts have a group

    @property
    def all_measures(self) -> list[Measure]:
        """List of all measures of the claim."""
        return [self.measure] if self.measure else self.measures

    def with_switch(self, cause: Cause) -> Claim:
        """Return a copy of the claim with the changed scenario fields of a cause."""
        measures = [
            measure.model_copy(update={"set": {**measure.set, **cause.set}})
            for measure in self.all_measures
        ]
        return self.model_copy(update={"measure": None, "measures": measures})

    @property
    def allowed(self) -> AllowedRange:
        """Range of allowed values, which includes the tolerance."""
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
        """Description of the allowed values."""
        if self.rule == "ordering":
            return "each above the next"
        return self.allowed.text


COLUMNS = get_args(Column)
"""Columns of results, one per plant and "alone" for computations without a plant."""


def claims_file() -> Path:
    """Return the path of the shipped claims file."""
    return data_root() / "calibration/published/claims.yaml"


def load_claims(path: Path | None = None) -> tuple[Claim, ...]:
    """Load claims from a file, by default from the shipped claims file.

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
        Document with the problems found, and the index and section of each valid entry.

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
    """Select claims by name, and list the selected laws first.

    Args:
        claims: all claims.
        only: names of claims, or the parts of names before a dot. An empty tuple
            selects all claims.
        quick: whether to select only quick claims.

    Raises:
        UnknownNameError: a name matches no claim.
    """
    for name in only:
        if not any(claim.is_named(name) for claim in claims):
            ids = [claim.id for claim in claims]
            raise UnknownNameError("claim", name, ids, "docs/reproduction.md")
    selected = [
        claim
        for claim in claims
        if (claim.quick or not quick) and (not only or any(map(claim.is_named, only)))
    ]
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
