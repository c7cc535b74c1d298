"""What a run gave, for the terminal: one short table, then the expectations; 80 columns."""

from __future__ import annotations

import textwrap
from collections.abc import Container, Mapping
from typing import TYPE_CHECKING, Any

from srs_twin.cli.console import console, new_table
from srs_twin.comparison.compare import MEASURES
from srs_twin.comparison.metrics import chosen, headline, published, result_rows
from srs_twin.scenario.expectation import result_text, verdict
from srs_twin.scenario.modified import left_out_line, marked
from srs_twin.viewing.plots.labels import metric_label

if TYPE_CHECKING:
    from rich.table import Table

    from srs_twin.experiment import RunResult

# What is said where the words of a metric's name alone would not do.
_HEADINGS = {
    "amplitude_error_end_rel": "amplitude error, end",
    "path_speed_m_s": "speed at the end",
    "path_curvature_before_per_m": "curvature before",
    "path_curvature_per_m": "curvature at the end",
    "rise_time_s": "rise, 10 to 90 %",
    "settling_5_s": "settled within 5 %",
    "settling_2_s": "settled within 2 %",
    "steady_error_rad": "mean error at rest",
    "steady_rms_rad": "RMS error at rest",
    "ripple_pp_rad": "ripple, peak-peak",
    "fit_residual_rad": "from a sine, RMS",
    "reading_r_squared": "reading: R² of a line",
    "reading_backstep_rad": "reading: turns back",
    "reading_range_t": "reading: field range",
    "cross_track_rms_m": "cross-track, RMS",
    "cross_track_max_m": "cross-track, largest",
    "inside_share": "inside the footprint",
    "inside_50mm_share": "inside 50 mm",
    "replans": "new plans",
}
WORDS = {"met": "met", "missed": "MISSED", "known": "known", "holds": "HOLDS", "not_judged": "not judged"}
"""Verdict on an expectation → how a line begins."""

_EXPLAINABLE = {"com_speed_rel", "yaw_rate_abs"}
"""Differences of the plants that `compare --explain` takes apart."""


def rows(metrics: Mapping[str, Any]) -> list[list[str]]:
    """Choose and format the lines of the table: metric, unit, a value a plant, difference, published.

    Args:
        metrics: what stands in metrics.json.
    """
    plants, stated = metrics["plants"], published(metrics["expectations"])
    found = [
        [_heading(name), unit, *texts, apart, _number(stated.get(name, (None,))[0])]
        for name, unit, texts, apart in result_rows(metrics, chosen(plants), _number)
    ]
    if (factor := (metrics["comparison"] or {}).get("gap_factor", 1.0)) != 1.0:
        nothing = [""] * (len(plants) + 1)
        found.insert(1, ["… by the gap factor", "1", f"× {factor:.4g}", *nothing])
    return found


def _heading(metric: str) -> str:
    """Return 'CoM speed' for com_speed_m_s: the unit has a column of its own."""
    return _HEADINGS.get(metric) or metric_label(metric).partition(" (")[0]


def show(result: RunResult) -> None:
    """Print the table and the expectations of a run to stdout."""
    terminal = console()
    print(*textwrap.wrap(headline(result.metrics), terminal.width), "", sep="\n")
    lines, plants = rows(result.metrics), result.metrics["plants"]
    needless = {"difference": len(plants) < 2, "published": not any(line[-1] for line in lines)}
    headings = ["metric", "unit", *plants, "difference", "published"]
    kept = [k for k, heading in enumerate(headings) if not needless.get(heading)]
    shown = new_table(
        *(headings[k] for k in kept), left=(0, 1), title=marked(result.name, result.metrics["changes"])
    )
    for line in lines:
        shown.add_row(*(line[k] for k in kept))
    terminal.print(shown)
    if "attribution" in result.metrics:
        terminal.print(_why(result.metrics["attribution"]))
    left_out = left_out_line(result.metrics["left_out"])
    for text in [*event_lines(result.metrics), *expectation_lines(result.metrics), *left_out]:
        for part in textwrap.wrap(text, terminal.width, subsequent_indent=" " * 7, break_long_words=False):
            print(part)


def _why(attribution: Mapping[str, Any]) -> Table:
    """Return the table of what each assumption contributes to the gap."""
    headings = ["\n".join(MEASURES[measure]) for measure in attribution["measures"]]
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
    missed = {each["metric"] for each in metrics["expectations"] if verdict(each) in ("missed", "known")}
    return bool(missed & _EXPLAINABLE) and "attribution" not in metrics


def _expectation(each: Mapping[str, Any]) -> str:
    source = f" ({each['source']})" if each.get("source") else ""
    why = [f"; {key}: {each[key]}" for key in ("reason", "known") if each.get(key)]
    return f"{WORDS[verdict(each)]:6} {each['of']} {each['metric']} {result_text(each)}{source}{''.join(why)}"
