"""What a run gave, for the terminal: one short table, then the expectations; 80 columns."""

from __future__ import annotations

import textwrap
from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from srs_twin.cli import console, new_table
from srs_twin.comparison.metrics import difference, published
from srs_twin.scenario.expectation import verdict

if TYPE_CHECKING:
    from rich.table import Table

    from srs_twin.experiment import RunResult

_MEASURED_ROWS = {
    "measured_shape_rms_m": ("shape, from measured", "m"),
    "measured_path_rms_m": ("path, from measured", "m"),
    "measured_bend_rms_rad": ("bends, from measured", "rad"),
    "measured_heading_rms_rad": ("heading, from measured", "rad"),
}
# metric of a plant → (heading, unit)
_PLANT_ROWS = {
    "com_speed_m_s": ("CoM speed", "m/s"),
    "yaw_rate_rad_s": ("yaw rate", "rad/s"),
    "turning_radius_m": ("turning radius", "m"),
    "path_length_m": ("path length", "m"),
    "mean_bend_amplitude_rad": ("mean bend amplitude", "rad"),
    "periods_to_converge": ("periods to converge", "1"),
    "amplitude_error_end_rel": ("amplitude error, end", "1"),
    "path_speed_m_s": ("speed at the end", "m/s"),
    "path_curvature_before_per_m": ("curvature before", "1/m"),
    "path_curvature_per_m": ("curvature at the end", "1/m"),
    "mechanical_power_w": ("mechanical power", "W"),
    "cost_of_transport": ("cost of transport", "1"),
    "pneumatic_power_w": ("power of the air", "W"),
    **_MEASURED_ROWS,
    "realtime_factor": ("real-time factor", "1"),
}
# The same of a run whose bends follow a reference, or of one on a bench.
_BENCH_ROWS = {
    "final_bend_rad": ("bend at the end", "rad"),
    **_MEASURED_ROWS,
    "rise_time_s": ("rise, 10 to 90 %", "s"),
    "overshoot_rel": ("overshoot", "1"),
    "settling_5_s": ("settled within 5 %", "s"),
    "settling_2_s": ("settled within 2 %", "s"),
    "steady_error_rad": ("mean error at rest", "rad"),
    "steady_rms_rad": ("RMS error at rest", "rad"),
    "ripple_pp_rad": ("ripple, peak-peak", "rad"),
    "error_rms_rad": ("error, RMS", "rad"),
    "amplitude_rel": ("amplitude, relative", "1"),
    "phase_lag_rad": ("phase lag", "rad"),
    "fit_residual_rad": ("beside sine, RMS", "rad"),
    "inlet_openings": ("openings, inlet", "1"),
    "outlet_openings": ("openings, outlet", "1"),
    "reading_r_squared": ("reading: R² of a line", "1"),
    "reading_error_rad": ("reading: worst error", "rad"),
    "reading_backstep_rad": ("reading: turns back", "rad"),
    "reading_range_t": ("reading: field range", "T"),
    "realtime_factor": ("real-time factor", "1"),
}
# The same of a run that followed a plan.
_PLAN_ROWS = {
    "plan_found": ("plan found", "1"),
    "plan_length_m": ("length of the plan", "m"),
    "goal_reached": ("goal reached", "1"),
    "arrival_error_m": ("distance from the goal", "m"),
    "arrival_heading_error_rad": ("heading beside goal's", "rad"),
    "cross_track_rms_m": ("cross-track, RMS", "m"),
    "cross_track_max_m": ("cross-track, largest", "m"),
    "inside_share": ("inside the footprint", "1"),
    "inside_50mm_share": ("inside 50 mm", "1"),
    "contacts": ("contacts", "1"),
    "clearance_m": ("clearance", "m"),
    "following_time_s": ("time taken", "s"),
    "replans": ("new plans", "1"),
    "com_speed_m_s": ("CoM speed", "m/s"),
    "realtime_factor": ("real-time factor", "1"),
}
_COMPARISON_ROWS = {
    "shape_rms_m": ("body shape, RMS", "m"),
    "path_rms_m": ("CoM path, RMS", "m"),
    "bend_rms_rad": ("bends, RMS", "rad"),
}
_WHY_HEADINGS = {
    "com_speed_m_s": ("CoM speed", "m/s"),
    "yaw_rate_rad_s": ("yaw rate", "rad/s"),
    "mean_bend_amplitude_rad": ("amplitude", "rad"),
    "shape_rms_m": ("shape", "m"),
}
_NONE = (None, "")
WORDS = {"met": "met", "missed": "MISSED", "known": "known", "holds": "HOLDS"}
"""Verdict on an expectation → how a line begins."""

_EXPLAINABLE = {"com_speed_rel", "yaw_rate_abs"}
"""Differences of the plants that `compare --explain` takes apart."""


@dataclass(frozen=True)
class Row:
    """One line of the table, numbers already as text; '' where there is none."""

    heading: str
    unit: str
    plants: tuple[str, ...]
    difference: str = ""
    published: str = ""


def rows(metrics: Mapping[str, Any]) -> list[Row]:
    """Choose and format the lines of the table.

    Args:
        metrics: what stands in metrics.json.
    """
    plants, stated = metrics["plants"], published(metrics["expectations"])
    found = []
    for key, (heading, unit) in _rows_of(plants).items():
        values = [each.get(key) for each in plants.values()]
        if all(value is None for value in values):
            continue
        texts = tuple(map(_number, values))
        found.append(Row(heading, unit, texts, difference(metrics, key), _number(stated.get(key, _NONE)[0])))
    comparison = metrics["comparison"] or {}
    if comparison.get("gap_factor", 1.0) != 1.0:
        text = f"× {comparison['gap_factor']:.4g}"
        found.insert(1, Row("… by the gap factor", "1", (text, *[""] * (len(plants) - 1))))
    for key, (heading, unit) in _COMPARISON_ROWS.items():
        if comparison.get(key) is not None:
            blank = ("",) * len(plants)
            text = _number(comparison[key])
            found.append(Row(heading, unit, blank, text, _number(stated.get(key, _NONE)[0])))
    return found


def _rows_of(plants: Mapping[str, Mapping[str, Any]]) -> Mapping[str, tuple[str, str]]:
    if any(each.get("plan_found") is not None for each in plants.values()):
        return _PLAN_ROWS
    return _BENCH_ROWS if _followed_or_held(plants) else _PLANT_ROWS


def _followed_or_held(plants: Mapping[str, Mapping[str, Any]]) -> bool:
    """Say whether the bends followed a reference, or hung on a bench without one."""
    said = [each.get(key) for each in plants.values() for key in ("error_rms_rad", "final_bend_rad")]
    return any(value is not None for value in said)


def show(result: RunResult) -> None:
    """Print the table and the expectations of a run to stdout."""
    lines = rows(result.metrics)
    headings = list(result.metrics["plants"])
    if len(headings) > 1:
        headings.append("difference")
    if any(line.published for line in lines):
        headings.append("published")
    shown = new_table("metric", "unit", *headings, left=2, title=result.name)
    for line in lines:
        cells = [*line.plants]
        cells += [line.difference] if "difference" in headings else []
        cells += [line.published] if "published" in headings else []
        shown.add_row(line.heading, line.unit, *cells)
    terminal = console()
    terminal.print(shown)
    if "attribution" in result.metrics:
        terminal.print(_why(result.metrics["attribution"]))
    for text in [*event_lines(result.metrics), *expectation_lines(result.metrics)]:
        for part in textwrap.wrap(text, terminal.width, subsequent_indent=" " * 7, break_long_words=False):
            print(part)


def _why(attribution: Mapping[str, Any]) -> Table:
    """Return the table of what each assumption contributes to the gap."""
    headings = ["\n".join(_WHY_HEADINGS[measure]) for measure in attribution["measures"]]
    title = "why they differ: twin − analytical, and the share of each assumption"
    shown = new_table("assumption", *headings, title=title)
    for share in attribution["shares"]:
        shown.add_row(share["name"], *map(_signed, share["value"]))
    shown.add_row("not explained", *map(_signed, attribution["remainder"]), end_section=True)
    shown.add_row("gap", *map(_signed, attribution["gap"]))
    shown.add_row("matched (stiff bends)", *map(_signed, attribution["matched"]))
    return shown


def _signed(value: float) -> str:
    return f"{value:+.2g}" if abs(value) >= 5e-6 else "0"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def event_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Return a line for each event that a person should know of."""
    events = [(plant, each) for plant, listed in metrics.get("events", {}).items() for each in listed]
    return [f"{each['kind']:6} {plant} at {each['time']:.4g} s: {each['text']}" for plant, each in events]


def expectation_lines(metrics: Mapping[str, Any], verdicts: Container[str] = WORDS) -> list[str]:
    """Return a line for each expectation of these verdicts: what came out, what is allowed, says who."""
    return [_expectation(each) for each in metrics["expectations"] if verdict(each) in verdicts]


def asks_why(metrics: Mapping[str, Any]) -> bool:
    """Say whether the plants differ by more than was expected, and nobody has said why yet."""
    missed = {each["metric"] for each in metrics["expectations"] if not each["met"]}
    return bool(missed & _EXPLAINABLE) and "attribution" not in metrics


def _expectation(each: Mapping[str, Any]) -> str:
    source = f" ({each['source']})" if each.get("source") else ""
    known = f"; known: {each['known']}" if each.get("known") else ""
    value = _number(each["value"]) or "none"
    said = f"{each['of']} {each['metric']} = {value}, allowed {each['allowed']}"
    return f"{WORDS[verdict(each)]:6} {said}{source}{known}"
