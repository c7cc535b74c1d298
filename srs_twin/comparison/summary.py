"""What a table says of a run's metrics beside the numbers themselves: differences and published values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

RELATIVE = {
    "com_speed_m_s", "turning_radius_m", "path_length_m", "mean_bend_amplitude_rad", "mechanical_power_w",
    "cost_of_transport", "pneumatic_power_w", "pneumatic_cost_of_transport", "final_bend_rad",
    "rise_time_s", "settling_2_s", "settling_5_s", "ripple_pp_rad", "ripple_rms_rad", "sensed_ripple_pp_rad",
    "steady_rms_rad", "error_rms_rad", "amplitude_rel", "fit_residual_rad", "inlet_openings",
    "outlet_openings", "path_radius_m", "path_speed_m_s", "duty_lowest", "duty_highest", "reading_error_rad",
    "reading_backstep_rad", "reading_range_t", "cross_track_rms_m", "cross_track_max_m", "following_time_s",
}  # fmt: skip
"""Metrics whose difference is given over the analytical value; of others in their own unit."""

_ROUNDING = 1e-9  # of a value: what two ways of adding up may differ by
_NOT_COMPARED = {"wall_s", "realtime_factor"}  # how long a computer took tells the plants nothing


def difference(metrics: Mapping[str, Any], metric: str) -> str:
    """Return twin − analytical in words, over the (signed) analytical value where that is usual.

    Args:
        metrics: what stands in metrics.json.
        metric: name of the metric.

    Returns:
        E.g. "-11.5 %" or "+0.0432"; empty where there is nothing to compare.
    """
    ours, theirs = (metrics["plants"].get(plant, {}).get(metric) for plant in ("analytical", "twin"))
    if metric in _NOT_COMPARED or not isinstance(ours, int | float) or not isinstance(theirs, int | float):
        return ""
    if metric == "com_speed_m_s":
        ours *= (metrics.get("comparison") or {}).get("gap_factor") or 1.0
    return relative_difference(ours, theirs) if metric in RELATIVE else _apart(ours, theirs)


def relative_difference(of: float, value: float) -> str:
    """Return value − of in per cent of `of`: "-11.5 %"; in its own unit where a share says nothing."""
    # A share of nothing, or of the other direction.
    return f"{100 * (value - of) / of:+.1f} %" if of * value > 0 else _apart(of, value)


def _apart(of: float, value: float) -> str:
    return "0" if abs(value - of) <= _ROUNDING * abs(of) else f"{value - of:+.3g}"


def published(expectations: Sequence[Mapping[str, Any]]) -> dict[str, tuple[float, str]]:
    """Return metric → published value and its source, of the expectations that state both."""
    stated = [e for e in expectations if e.get("near") is not None and e.get("source")]
    return {each["metric"]: (each["near"], each["source"]) for each in stated}
