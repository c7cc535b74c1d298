"""Published values beside a sweep's: what was published, and a table of it with what the plants did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.summary import relative_difference
from srs_twin.viewing.labels import field_label, metric_label
from srs_twin.viewing.sweep_table import COMPARISON, OWNERS, SweepTable, Value

NONE = "–"


@dataclass(frozen=True)
class Beside:
    """What was published of the metrics of a sweep's plants.

    Attributes:
        source: where: "Table 8".
        at: varied field → its values where something is published; equally many of each field.
        metrics: metric → published values there, None where there is none.
        note: what a reader must know to compare.
    """

    source: str
    at: Mapping[str, Sequence[Value]]
    metrics: Mapping[str, Sequence[float | None]]
    note: str = ""

    @property
    def places(self) -> list[dict[str, Value]]:
        """Where something is published: each time a value of every field."""
        return [dict(zip(self.at, values, strict=True)) for values in zip(*self.at.values(), strict=True)]


@dataclass(frozen=True)
class BesideTable:
    """Published values and those of the plants, as text.

    Attributes:
        source: where they are published.
        note: what a reader must know to compare.
        headings: metric, fields, published, of each plant its value and the difference; runs where a value
            is a mean.
        rows: one a metric and place, in the order of the file.
    """

    source: str
    note: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def beside_table(beside: Beside, rows: SweepTable) -> BesideTable:
    """Return what was published beside what the plants did there; of several runs, their mean.

    Args:
        beside: what was published.
        rows: results of a sweep that varies these fields.
    """
    plants = [o for o in OWNERS if o != COMPARISON and any(o in rows.holders(m) for m in beside.metrics)]
    runs = [_runs(rows, place) for place in beside.places]
    averaged = any(chosen.sum() > 1 for chosen in runs)
    made = []
    for metric, published in beside.metrics.items():
        for place, chosen, value in zip(beside.places, runs, published, strict=True):
            line = [metric_label(metric), *map(_written, place.values()), _written(value)]
            for plant in plants:
                mean = _mean(rows, metric, plant, chosen)
                line += [_written(mean), _difference(value, mean)]
            made.append((*line, *([str(int(chosen.sum()))] if averaged else [])))
    headings = ["metric", *map(field_label, beside.at), "published"]
    headings += [heading for plant in plants for heading in (plant, "difference")]
    return BesideTable(beside.source, beside.note, (*headings, *(["runs"] * averaged)), tuple(made))


def _runs(rows: SweepTable, place: Mapping[str, Value]) -> np.ndarray:
    """Return which runs at a place did not fail, shape (rows,)."""
    chosen = ~rows.failed
    for field, value in place.items():
        chosen = chosen & rows.values(field, "").at(value)
    return chosen


def _mean(rows: SweepTable, metric: str, plant: str, chosen: np.ndarray) -> float | None:
    if plant not in rows.holders(metric):
        return None
    numbers = rows.metric(metric, plant).numbers[chosen]
    known = numbers[np.isfinite(numbers)]
    return float(known.mean()) if len(known) else None


def _difference(published: float | None, value: float | None) -> str:
    return NONE if published is None or value is None else relative_difference(published, value)


def _written(value: Value | None) -> str:
    if value is None:
        return NONE
    return f"{value:.4g}" if isinstance(value, float) else str(value)
