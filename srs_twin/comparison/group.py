"""Groups of metrics that extensions add."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from srs_twin.extensions import METRICS, objects
from srs_twin.trajectory import Trajectory


@dataclass(frozen=True)
class MetricGroup:
    """Metrics of one topic.

    Attributes:
        units: metric → unit; each metric is one number.
        measure: returns the values of a run by metric, None where a metric is undefined.
        why_undefined: returns the reason why a metric has no value; empty if this is the outcome of the run.
        relative: metrics whose difference between the plants is also shown in per cent.
        main: metric that only runs of this topic have; it selects `short_table`.
        short_table: metrics of the short table of such a run.
        yes_no: metrics that are 1 or 0, shown as yes or no.
    """

    units: Mapping[str, str]
    measure: Callable[[Trajectory], dict[str, Any]]
    why_undefined: Callable[[str, Trajectory], str]
    relative: frozenset[str]
    main: str
    short_table: tuple[str, ...]
    yes_no: frozenset[str] = frozenset()


@cache
def metric_groups() -> tuple[MetricGroup, ...]:
    """Return the groups of the installed extensions."""
    return tuple(group for _, group in objects(METRICS))
