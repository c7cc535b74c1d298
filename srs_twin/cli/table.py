"""Printed metrics, events and expectations of a run."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Container, Mapping
from typing import TYPE_CHECKING, Any

from srs_twin.cli.console import as_started, console, new_table
from srs_twin.comparison.compare import MEASURES
from srs_twin.comparison.contacts import CONTACT_EVENTS
from srs_twin.comparison.metrics import chosen, headline, published, result_rows, tidy
from srs_twin.scenario.expectation import remarks, result_text, tally, verdict
from srs_twin.scenario.modified import left_out_line, marked
from srs_twin.viewing.plots.labels import metric_title

if TYPE_CHECKING:
    from rich.table import Table

    from srs_twin.comparison.metrics import RunMetrics
    from srs_twin.experiment import RunResult
    from srs_twin.scenario.expectation import ExpectationRow

STATE_LABELS = {
    "met": "met",
    "missed": "MISSED",
    "expected_failure": "expected",
    "holds": "HOLDS",
    "not_judged": "not judged",
}
"""Label of each expectation state at the start of a printed line."""

_EXPLAINABLE = {"com_speed_rel", "yaw_rate_abs"}
"""Difference metrics that `compare --explain` attributes to assumptions."""

_ZERO = 5e-5
"""Threshold below which a difference is printed as 0, in m, m/s, rad or rad/s."""


def rows(metrics: RunMetrics) -> list[list[str]]:
    """Return the rows of the metrics table.

    The columns contain the metric, the unit, the value for each plant, the difference,
    the difference in per cent, and the published value.
    """
    plants = metrics["plants"]
    published_values = published(metrics["expectations"])
    lines = [
        [
            metric_title(row.metric),
            row.unit,
            *row.values,
            row.difference,
            row.per_cent,
            _number(tidy(row.metric, published_values.get(row.metric, (None,))[0])),
        ]
        for row in result_rows(metrics, chosen(plants), _number)
    ]
    if (factor := (metrics["comparison"] or {}).get("gap_factor", 1.0)) != 1.0:
        empty = [""] * (len(plants) + 2)
        lines.insert(1, ["… by the gap factor", "", f"× {factor:.4g}", *empty])
    return lines


def show(result: RunResult) -> None:
    """Print metrics, events and expectations of a run on stdout."""
    terminal = console()
    print(*textwrap.wrap(headline(result.metrics), terminal.width), "", sep="\n")
    lines = rows(result.metrics)
    plants = result.metrics["plants"]
    headings = ["metric", "unit", *plants, "difference", "%", "published"]
    columns = [
        k
        for k, _ in enumerate(headings)
        if k <= len(plants) + 1 or any(line[k] for line in lines)
    ]
    title = marked(result.name, result.metrics["changes"])
    table = new_table(*(headings[k] for k in columns), left=(0, 1), title=title)
    table.columns[0].no_wrap = False
    for line in lines:
        table.add_row(*(line[k] for k in columns))
    terminal.print(table)
    if "attribution" in result.metrics:
        terminal.print(_attribution_table(result.metrics["attribution"]))
    left_out = left_out_line(result.metrics["left_out"])
    checked = result.metrics["expectations"]
    heading = []
    if checked:
        counted = tally(Counter(map(verdict, checked)))
        heading = [f"expectations of the scenario: {counted}"]
    for text in [
        *event_lines(result.metrics),
        *heading,
        *expectation_lines(result.metrics),
        *left_out,
    ]:
        hint = as_started(text)
        for wrapped in textwrap.wrap(
            hint, terminal.width, subsequent_indent=" " * 7, break_long_words=False
        ):
            print(wrapped)


def _attribution_table(attribution: Mapping[str, Any]) -> Table:
    """Return a table of contributions, with ranges over all switching orders."""
    measures = [MEASURES[measure] for measure in attribution["measures"]]
    # Multi-line headings leave space for the names of the assumptions.
    headings = [title.replace(" ", "\n", 1) + f"\n{unit}" for title, unit in measures]
    title = "attribution: twin − analytical, and the contribution of each assumption"
    if (window := attribution["window_s"]) is not None:
        title += f"\n(first {window:g} s of the runs)"
    table = new_table("assumption", *headings, title=title)
    for share in attribution["shares"]:
        table.add_row(share["name"], *map(_signed, share["value"]))
        if share["low"] != share["high"]:
            table.add_row("  lowest, any order", *map(_signed, share["low"]))
            table.add_row("  highest, any order", *map(_signed, share["high"]))
    table.add_row(
        "not explained", *map(_signed, attribution["remainder"]), end_section=True
    )
    table.add_row("difference", *map(_signed, attribution["gap"]))
    table.add_row("matched (stiff bends)", *map(_signed, attribution["matched"]))
    for name, change in attribution["damping"].items():
        table.add_row(f"change with a {name}", *map(_signed, change))
    return table


def _signed(value: float) -> str:
    if abs(value) >= _ZERO:
        return f"{value:+.4f}"
    return "0"


def _number(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return f"{value:.4g}"


def event_lines(metrics: RunMetrics) -> list[str]:
    """Return one line of text for each event, except for contacts."""
    return [
        f"{event['kind']:6} {plant} at {event['time']:.4g} s: {event['text']}"
        for plant, events in metrics.get("events", {}).items()
        for event in events
        # Contacts may be numerous, and are summarised in the headline and the table.
        if event["kind"] not in CONTACT_EVENTS
    ]


def expectation_lines(
    metrics: RunMetrics, verdicts: Container[str] = STATE_LABELS
) -> list[str]:
    """Return one line of text for each expectation whose state is in `verdicts`."""
    return [
        _expectation_line(row)
        for row in metrics["expectations"]
        if verdict(row) in verdicts
    ]


def needs_explanation(metrics: RunMetrics) -> bool:
    """Return whether the plants differ unexpectedly and the cause is unknown."""
    missed = {
        row["metric"]
        for row in metrics["expectations"]
        if verdict(row) in ("missed", "expected_failure")
    }
    return bool(missed & _EXPLAINABLE) and "attribution" not in metrics


def _expectation_line(row: ExpectationRow) -> str:
    source = f" ({row['source']})" if row.get("source") else ""
    further = "".join(f"; {key}: {text}" for key, text in remarks(row).items())
    return (
        f"{STATE_LABELS[verdict(row)]:6} {row['of']} {row['metric']}"
        f" {result_text(row)}{source}{further}"
    )
