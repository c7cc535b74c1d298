"""Result of a run on a terminal of 80 columns: a table of metrics, events and expectations."""

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

# Labels of metrics whose names are not clear by themselves.
_LABELS = {
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
    "reading_backstep_rad": "reading: backstep",
    "reading_range_t": "reading: field range",
    "cross_track_rms_m": "cross-track, RMS",
    "cross_track_max_m": "cross-track, largest",
    "inside_share": "inside the footprint",
    "inside_50mm_share": "inside 50 mm",
    "replans": "new plans",
}
STATE_LABELS = {
    "met": "met",
    "missed": "MISSED",
    "known": "known",
    "holds": "HOLDS",
    "not_judged": "not judged",
}
"""State of an expectation → label at the beginning of its line."""

_EXPLAINABLE = {"com_speed_rel", "yaw_rate_abs"}
"""Differences that `compare --explain` attributes to assumptions."""

_ZERO = 5e-6
"""Absolute value below which a difference is printed as 0; the same for m, m/s, rad and rad/s."""


def rows(metrics: Mapping[str, Any]) -> list[list[str]]:
    """Return the rows of the table: metric, unit, one value per plant, difference, published value.

    Args:
        metrics: content of `metrics.json`.
    """
    plants, published_values = metrics["plants"], published(metrics["expectations"])
    lines = [
        [_label(name), unit, *texts, difference, _number(published_values.get(name, (None,))[0])]
        for name, unit, texts, difference in result_rows(metrics, chosen(plants), _number)
    ]
    if (factor := (metrics["comparison"] or {}).get("gap_factor", 1.0)) != 1.0:
        empty = [""] * (len(plants) + 1)
        lines.insert(1, ["… by the gap factor", "1", f"× {factor:.4g}", *empty])
    return lines


def _label(metric: str) -> str:
    """Return the label of a metric without its unit, e.g. 'CoM speed' for `com_speed_m_s`."""
    return _LABELS.get(metric) or metric_label(metric).partition(" (")[0]


def show(result: RunResult) -> None:
    """Print the table, the events and the expectations of a run on stdout."""
    terminal = console()
    print(*textwrap.wrap(headline(result.metrics), terminal.width), "", sep="\n")
    lines, plants = rows(result.metrics), result.metrics["plants"]
    omitted = {"difference": len(plants) < 2, "published": not any(line[-1] for line in lines)}
    headings = ["metric", "unit", *plants, "difference", "published"]
    columns = [k for k, heading in enumerate(headings) if not omitted.get(heading)]
    title = marked(result.name, result.metrics["changes"])
    table = new_table(*(headings[k] for k in columns), left=(0, 1), title=title)
    for line in lines:
        table.add_row(*(line[k] for k in columns))
    terminal.print(table)
    if "attribution" in result.metrics:
        terminal.print(_attribution_table(result.metrics["attribution"]))
    left_out = left_out_line(result.metrics["left_out"])
    for text in [*event_lines(result.metrics), *expectation_lines(result.metrics), *left_out]:
        for wrapped in textwrap.wrap(text, terminal.width, subsequent_indent=" " * 7, break_long_words=False):
            print(wrapped)


def _attribution_table(attribution: Mapping[str, Any]) -> Table:
    """Return the table of the contributions of the assumptions to the difference."""
    headings = ["\n".join(MEASURES[measure]) for measure in attribution["measures"]]
    title = "attribution: twin − analytical, and the contribution of each assumption"
    table = new_table("assumption", *headings, title=title)
    for share in attribution["shares"]:
        table.add_row(share["name"], *map(_signed, share["value"]))
    table.add_row("not explained", *map(_signed, attribution["remainder"]), end_section=True)
    table.add_row("difference", *map(_signed, attribution["gap"]))
    table.add_row("matched (stiff bends)", *map(_signed, attribution["matched"]))
    return table


def _signed(value: float) -> str:
    return f"{value:+.2g}" if abs(value) >= _ZERO else "0"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def event_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Return one line per event."""
    return [
        f"{event['kind']:6} {plant} at {event['time']:.4g} s: {event['text']}"
        for plant, events in metrics.get("events", {}).items()
        for event in events
    ]


def expectation_lines(metrics: Mapping[str, Any], verdicts: Container[str] = STATE_LABELS) -> list[str]:
    """Return one line per expectation in these states: value, allowed range and source."""
    return [_expectation_line(row) for row in metrics["expectations"] if verdict(row) in verdicts]


def needs_explanation(metrics: Mapping[str, Any]) -> bool:
    """Return whether the plants differ more than expected and the attribution is missing."""
    missed = {row["metric"] for row in metrics["expectations"] if verdict(row) in ("missed", "known")}
    return bool(missed & _EXPLAINABLE) and "attribution" not in metrics


def _expectation_line(row: Mapping[str, Any]) -> str:
    source = f" ({row['source']})" if row.get("source") else ""
    remarks = "".join(f"; {key}: {row[key]}" for key in ("reason", "known") if row.get(key))
    return f"{STATE_LABELS[verdict(row)]:6} {row['of']} {row['metric']} {result_text(row)}{source}{remarks}"
