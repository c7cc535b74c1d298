"""What a table says of a run's metrics beside the numbers themselves: differences and published values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

RELATIVE = {
    "com_speed_m_s", "turning_radius_m", "path_length_m", "mean_bend_amplitude_rad", "mechanical_power_w",
    "cost_of_transport", "pneumatic_power_w", "pneumatic_cost_of_transport",
}  # fmt: skip
"""Metrics whose difference is given over the analytical value; of others in their own unit."""

_TURNING_RAD_S = 0.01  # below it a snake goes straight, and a share of its yaw rate means nothing
_ROUNDING = 1e-9  # of a value: what two ways of adding up may differ by
_NOT_COMPARED = {"wall_s", "realtime_factor"}  # how long a computer took tells the plants nothing


def difference(plants: Mapping[str, Mapping[str, Any]], metric: str) -> str:
    """Return twin − analytical in words, over the (signed) analytical value where that is usual.

    Args:
        plants: plant → metric → value, as in metrics.json.
        metric: name of the metric.

    Returns:
        E.g. "-11.5 %" or "+0.0432"; empty where there is nothing to compare.
    """
    ours, theirs = (plants.get(plant, {}).get(metric) for plant in ("analytical", "twin"))
    if metric in _NOT_COMPARED or not isinstance(ours, int | float) or not isinstance(theirs, int | float):
        return ""
    apart = "0" if abs(theirs - ours) <= _ROUNDING * abs(ours) else f"{theirs - ours:+.3g}"
    # A share of nothing, or of the other direction, says nothing.
    share = f"{100 * (theirs - ours) / ours:+.1f} %" if ours * theirs > 0 else ""
    if metric in RELATIVE:
        return share or apart
    if metric == "yaw_rate_rad_s" and abs(ours) > _TURNING_RAD_S:
        return f"{apart} ({share})" if share else apart
    return apart


def published(expectations: Sequence[Mapping[str, Any]]) -> dict[str, tuple[float, str]]:
    """Return metric → published value and its source, of the expectations that state both."""
    stated = [e for e in expectations if e.get("near") is not None and e.get("source")]
    return {each["metric"]: (each["near"], each["source"]) for each in stated}
