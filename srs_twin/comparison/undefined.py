"""Reasons why metrics of a run are undefined.

A metric may be undefined because the run lacks data, such as whole gait periods, a
reference or a recording. Expectations about such a metric cannot be judged. In other
cases, the missing value is itself a result of the run. For example, a straight path has
no turning radius.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.contacts import CONTACT_UNITS, OBJECT_UNITS
from srs_twin.comparison.gait import SPATIAL_UNITS, GaitWindow
from srs_twin.comparison.learning import LAST_PERIODS, LEARNING_UNITS, is_learning
from srs_twin.comparison.metrics import MEASURED_UNITS, PlantMetrics, RunMetrics
from srs_twin.comparison.sampling import metric_groups
from srs_twin.comparison.tracking import READING_UNITS, TRACKING_UNITS, ReadingCurve
from srs_twin.trajectory import Trajectory

_ENERGY = {
    "mechanical_power_w": "work",
    "internal_power_w": "internal_loss",
    "cost_of_transport": "work",
    "pneumatic_power_w": "pneumatic_energy",
    "pneumatic_cost_of_transport": "pneumatic_energy",
}
_OF_A_GAIT = {
    "com_speed_m_s",
    "yaw_rate_rad_s",
    "turning_radius_m",
    "mean_bend_amplitude_rad",
    *_ENERGY,
}
_OF_TWO_GAITS = {
    "com_speed_rel",
    "yaw_rate_abs",
    "measured_com_speed_rel",
    "measured_yaw_rate_abs",
}
_REACHED = {"rise_time_s", "settling_2_s", "settling_5_s"}
_SINE = {
    "amplitude_rel",
    "amplitude_spread_rel",
    "phase_lag_rad",
    "phase_lag_spread_rad",
    "fit_residual_rad",
}
_OPENINGS = {"inlet_openings", "outlet_openings"}
_ABSENT = {
    **dict.fromkeys(SPATIAL_UNITS, "the robot bends in one plane"),
    **dict.fromkeys(OBJECT_UNITS, "the world has no movable objects"),
    **dict.fromkeys(CONTACT_UNITS, "the world has no obstacles"),
    "final_bend_rad": "only a run on a bench without a reference has this metric",
}
"""Reasons why some metrics are undefined for a robot or world, keyed by metric."""


@dataclass(frozen=True)
class Undefined:
    """Reason why a metric of a run is undefined.

    Attributes:
        reason: text that explains why the metric is undefined.
        beyond: lower bound on the value, in the unit of the metric, or −inf. For
            example, if a bend does not settle before the end of a run, the settling
            time is longer than the time from the step to the end.
    """

    reason: str
    beyond: float = -math.inf


def why_undefined(
    metric: str,
    subject: str,
    metrics: RunMetrics,
    runs: Mapping[str, Trajectory],
) -> Undefined | None:
    """Return the reason why a metric of a run is undefined.

    The reason is None if the metric has a value, or if the missing value is itself a
    result of the run.

    Args:
        metric: name of the metric.
        subject: plant to which the metric belongs, or "comparison".
        metrics: metrics of the run, with the entries ``plants`` and ``comparison``.
        runs: trajectories of the plants and of the recording, keyed by name.
    """
    owners = metrics["plants"] | {"comparison": metrics["comparison"]}
    values = owners.get(subject) or {}
    if values.get(metric) is not None:
        return None
    if metric in _OF_TWO_GAITS | _OF_A_GAIT:
        needed = {subject}
        if subject == "comparison":
            needed = {"analytical", "twin"}
        elif metric in MEASURED_UNITS:
            needed.add("measured")
        named = [run for name, run in runs.items() if name in needed]
        return _of(_not_measured(metric, runs) or _no_gait(metric, named))
    run = runs.get(subject)
    if run is None:
        return None
    if metric in TRACKING_UNITS:
        return _tracking(metric, values, run)
    if metric in LEARNING_UNITS:
        return _learning(metric, values, run)
    return _of(_not_measured(metric, runs) or _other(metric, run))


def _of(reason: str) -> Undefined | None:
    if reason:
        return Undefined(reason)
    return None


def _no_gait(metric: str, runs: Iterable[Trajectory]) -> str:
    """Return the reason why one of the runs has no gait metrics.

    The reason is empty if the run ended early, because an early end is itself a result.
    """
    for run in runs:
        if reason := GaitWindow.missing_reason(run):
            if run.metadata.get("ended_by"):
                return ""
            return reason
        if (column := _ENERGY.get(metric)) and not run.has(column):
            return f"the run does not record {column}"
    return ""


def _not_measured(metric: str, runs: Mapping[str, Trajectory]) -> str:
    if metric not in MEASURED_UNITS:
        return ""
    if (measured := runs.get("measured")) is None:
        return "no recording of the robot is replayed"
    if measured.metadata.get("bends_only") and metric != "measured_bend_rms_rad":
        return "only bends were recorded"
    clamped = any(run.metadata.get("base") == "clamped" for run in runs.values())
    if clamped and metric in _OF_TWO_GAITS:
        return "the robot was clamped at its head"
    return ""


def _tracking(
    metric: str, values: Mapping[str, object], run: Trajectory
) -> Undefined | None:
    if values.get("error_rms_rad") is None:
        return Undefined("the run follows no reference")
    if metric in _REACHED and values.get("overshoot_rel") is not None:
        changes = np.flatnonzero(np.diff(run["reference_1"])) + 1
        passed = float(run.time[-1] - run.time[changes[0] if len(changes) else 0])
        return Undefined(
            f"the level is not reached within {passed:.4g} s after the step", passed
        )
    if metric in _SINE:
        return Undefined(
            "the run does not contain enough whole periods of a sine reference"
        )
    if metric in _OPENINGS:
        return Undefined("the run does not record the openings of these valves")
    if metric == "measured_ripple_pp_rad" and values.get("ripple_pp_rad") is not None:
        return Undefined("the run has no sensor")
    return Undefined("the reference is not a single step")


def _learning(metric: str, values: PlantMetrics, run: Trajectory) -> Undefined | None:
    if not is_learning(run):
        return Undefined("the run has no iterative learning")
    periods = len(values.get("duty") or ())
    turns = values.get("heading_drift_rad") is not None
    is_curved = values.get("path_curvature_per_m") is not None
    has_errors = values.get("amplitude_error_end_rad") is not None
    if metric == "periods_to_converge" and has_errors:
        return Undefined(
            f"the amplitudes have not converged within {periods} periods", periods
        )
    if not metric.startswith(("path_", "extent_", "heading_")):
        return Undefined(
            f"the metric is undefined for the {periods} learning periods of the run"
        )
    if turns and not is_curved:
        return None
    if is_curved and metric.startswith("path_radius"):
        return None
    if not turns:
        return Undefined(f"the run has fewer than {LAST_PERIODS} whole periods")
    return Undefined(
        "before the duties change, no two whole periods have a curved path"
    )


def _other(metric: str, run: Trajectory) -> str:
    for group in metric_groups():
        if metric in group.units:
            return group.why_undefined(metric, run)
    if metric in SPATIAL_UNITS and run.has("z"):
        return _no_gait(metric, [run])
    if metric in READING_UNITS:
        return _no_reading(metric, run)
    return _ABSENT.get(metric, "")


def _no_reading(metric: str, run: Trajectory) -> str:
    if ReadingCurve.from_trajectory(run) is None:
        return "the run has no sensor, or an ideal sensor"
    return "the sensor has no Hall element" if metric == "reading_range_t" else ""
