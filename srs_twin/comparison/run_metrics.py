"""Types of the entries in metrics.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NotRequired, TypedDict

PlantMetrics = dict[str, Any]
"""Value of each metric, which is a number, a boolean, a list, or None if undefined."""


class PartMetrics(TypedDict, total=False):
    """Metrics of a part of a run.

    Attributes:
        plants: metrics of each plant, keyed by plant name.
        end_s: end of the part, s. The entry is absent if the part is the whole run.
    """

    plants: dict[str, PlantMetrics]
    end_s: float


class StoredIntervals(TypedDict, total=False):
    """Uncertainty intervals that `experiment.stored_intervals` has found."""

    stale: str | None
    file: str
    renew: str
    plants: Mapping[str, Mapping[str, object]]
    segments: Mapping[str, Sequence[float]] | None


class MainCause(TypedDict):
    """Effect of compliant bends, computed by `attribution.main_cause`.

    Attributes:
        name: name of the assumption.
        window_s: duration of the part without contact, s. The entry is absent if the
            effects cover the whole run.
    """

    name: str
    com_speed_m_s: float
    yaw_rate_rad_s: float
    window_s: NotRequired[float]


class RunMetrics(PartMetrics, total=False):
    """Content of metrics.json. Entries that do not apply to a run are absent.

    Attributes:
        comparison: differences between the plants, or None if only one plant ran.
        events: faults, contacts and early ends of each run, keyed by plant name.
        changes: changed fields of the scenario (`scenario.modified.Changes`).
        ignores_obstacles: plants that ignore the obstacles in the scenario.
        before_contact: speeds and yaw rates before the first contact.
        body_overlap_m: size of the largest overlap of body parts, keyed by plant name.
        residuals: differences from the recording, keyed by plant name.
        attribution: result of `Attribution.document`.
        cause: result of `attribution.main_cause`.
        preset: preset of the twin.
        expectations: results of the expectations (`expectation.ExpectationRow`).
        left_out: expectations that changed fields invalidate.
        versions: versions of the packages, keyed by package name.
    """

    scenario: str
    robot: str
    comparison: PlantMetrics | None
    events: Mapping[str, Sequence[Mapping[str, object]]]
    changes: Sequence[Mapping[str, object]]
    ignores_obstacles: Sequence[str]
    before_contact: PartMetrics
    body_overlap_m: Mapping[str, float]
    residuals: Mapping[str, object]
    attribution: Mapping[str, Any]
    cause: MainCause
    preset: str
    intervals: StoredIntervals
    expectations: list[Any]
    left_out: Sequence[Mapping[str, object]]
    versions: Mapping[str, str]
