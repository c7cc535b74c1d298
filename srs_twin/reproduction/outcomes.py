"""What came of a row in a column: its number from the runs, and the verdict by the row's rule."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from srs_twin.reproduction.claims import Claim, Measure, Setting
from srs_twin.reproduction.execution import Store
from srs_twin.reproduction.runs import Order, Orders
from srs_twin.reproduction.traces import TRACES

MET, EXPLAINED, MISSED = "met", "explained", "missed"
VERDICTS = (MET, EXPLAINED, MISSED)

_NOTHING = 1e-12
"""Numbers below are none to divide by."""


@dataclass(frozen=True)
class Outcome:
    """What came of a row in one column.

    Attributes:
        verdict: "met"; "missed"; "explained", which is missed with a cause that is shown, and not met.
        values: of the measures, in the row's unit; NaN where there is none.
        value: what is held against the published one; NaN of an ordering, and where there is none.
        error: (value − published)/|published|; NaN where there is no such number.
        why: the cause, or why there is no value; empty where nothing is known.
    """

    verdict: str
    values: tuple[float, ...]
    value: float
    error: float
    why: str = ""


@dataclass(frozen=True)
class Judged:
    """A row and what came of it.

    Attributes:
        claim: the row.
        outcomes: column → what came of it there.
    """

    claim: Claim
    outcomes: Mapping[str, Outcome] = field(default_factory=dict)


class Bench:
    """Reads numbers out of the runs that are there, and holds them against rows."""

    def __init__(self, store: Store, orders: Orders) -> None:
        self._store, self._orders = store, orders

    def outcome(self, claim: Claim, column: str, changes: Mapping[str, Setting] | None = None) -> Outcome:
        """Return what came of a row in a column.

        Args:
            claim: the row.
            column: "analytical", "twin" or "alone".
            changes: fields of the scenarios that are otherwise.
        """
        values = tuple(self._number(measure, column, changes) for measure in claim.measures)
        if any(math.isnan(value) for value in values):
            return Outcome(MISSED, values, math.nan, math.nan, self._reason(claim, changes))
        if claim.rule == "ordering":
            met = all(a > b for a, b in zip(values, values[1:], strict=False))
            return Outcome(MET if met else MISSED, values, math.nan, math.nan)
        value = combined(claim.combine, values)
        assert claim.value is not None, "checked by the file's model"
        error = (value - claim.value) / abs(claim.value) if claim.value else math.nan
        met = claim.low <= value <= claim.high
        return Outcome(MET if met else MISSED, values, value, error)

    def _number(self, measure: Measure, column: str, changes: Mapping[str, Setting] | None) -> float:
        owner = measure.plant or column
        orders = self._orders.of(measure, changes)
        values = np.array([self._of(order, owner, measure.metric) for order in orders])
        if measure.size:
            values = np.abs(values)
        if not len(values) or (measure.take is None and len(values) > 1):
            return math.nan
        return float(taken(measure.take, values))

    def _of(self, order: Order, owner: str, metric: str) -> float:
        row = self._store.row(order.key)
        if row is None:
            return math.nan
        kind, _, name = metric.partition(".")
        if kind == "trace":
            trajectory = self._store.trajectory(order.key, owner)
            found = None if trajectory is None else TRACES[name](trajectory)
        else:
            found = row.values.get(metric if kind == "comparison" else f"{owner}.{metric}")
        return math.nan if found is None else float(found)

    def _reason(self, claim: Claim, changes: Mapping[str, Setting] | None) -> str:
        """Say why there is no number."""
        orders = [order for measure in claim.measures for order in self._orders.of(measure, changes)]
        failed = [self._store.failure(order.key) for order in orders]
        said = next((reason for reason in failed if reason), "")
        return f"no value: {said}" if said else "no value: there is no such number in the run"


def combined(how: str, values: tuple[float, ...]) -> float:
    """Return one number of one measure or two; NaN where it would divide by nothing.

    Args:
        how: "value", "ratio" a/b, "excess" a/b − 1, "difference" a − b, or "unevenness" |a + b|/|a|.
        values: of the measures.
    """
    a, b = values[0], values[-1]
    if how == "difference":
        return a - b
    if how == "unevenness":
        return abs(a + b) / abs(a) if abs(a) > _NOTHING else math.nan
    if how in ("ratio", "excess"):
        ratio = a / b if abs(b) > _NOTHING else math.nan
        return ratio - 1 if how == "excess" else ratio
    return a


def taken(how: str | None, values: np.ndarray) -> float:
    """Return what is taken of the values of several runs; NaN as soon as one of them has none."""
    if how == "most":
        return float(values.max())
    if how == "least":
        return float(values.min())
    if how == "spread":
        return float(np.ptp(values) / abs(values.mean())) if abs(values.mean()) > _NOTHING else math.nan
    return float(values.mean())
