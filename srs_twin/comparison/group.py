"""Groups of metrics that extensions add."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from srs_twin.comparison.sampling import units_of
from srs_twin.extensions import METRICS, objects
from srs_twin.trajectory import Trajectory


def _no_reason(metric: str, trajectory: Trajectory) -> str:
    return ""


@dataclass(frozen=True)
class MetricGroup:
    """Metrics of one topic. Each is one number per run, and its name ends in its unit.

    Attributes:
        meanings: metric → meaning in one line.
        measure: returns the values of a run by metric, None where a metric is undefined.
        why_undefined: returns the reason why a metric has no value; empty if this is the outcome of the run.
        relative: metrics whose difference between the plants is also shown in per cent.
        main: metric that only runs of this topic have; `short_table` is then the whole short table of such a
            run. If empty, `short_table` is appended to the short table of every run.
        short_table: metrics of the short table.
        yes_no: metrics that are 1 or 0, shown as yes or no.
    """

    meanings: Mapping[str, str]
    measure: Callable[[Trajectory], dict[str, Any]]
    why_undefined: Callable[[str, Trajectory], str] = _no_reason
    relative: frozenset[str] = frozenset()
    main: str = ""
    short_table: tuple[str, ...] = ()
    yes_no: frozenset[str] = frozenset()

    @property
    def units(self) -> dict[str, str]:
        """Metric → unit, as its name states."""
        return units_of(" ".join(self.meanings))


@cache
def metric_groups() -> tuple[MetricGroup, ...]:
    """Return the groups of the installed extensions."""
    return tuple(group for _, group in objects(METRICS))
