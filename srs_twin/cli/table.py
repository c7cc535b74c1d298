"""What a run gave, for the terminal: one short table, then the expectations; 80 columns."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from srs_twin.running import RunResult

# metric of a plant → (heading, unit, whether the difference is relative to the analytical model)
_PLANT_ROWS = {
    "com_speed_m_s": ("CoM speed", "m/s", True),
    "yaw_rate_rad_s": ("yaw rate", "rad/s", False),
    "turning_radius_m": ("turning radius", "m", True),
    "path_length_m": ("path length", "m", True),
    "mean_bend_amplitude_rad": ("mean bend amplitude", "rad", True),
    "realtime_factor": ("real-time factor", "1", False),
}
_COMPARISON_ROWS = {
    "shape_rms_m": ("body shape, RMS", "m"),
    "path_rms_m": ("CoM path, RMS", "m"),
    "bend_rms_rad": ("bends, RMS", "rad"),
}


@dataclass(frozen=True)
class Row:
    """One line of the table, numbers already as text; '' where there is none."""

    heading: str
    unit: str
    plants: tuple[str, ...]
    difference: str = ""
    published: str = ""


def rows(metrics: Mapping[str, Any], published: Mapping[str, float]) -> list[Row]:
    """Choose and format the lines of the table.

    Args:
        metrics: what stands in metrics.json.
        published: metric → the published value, where an expectation with a source gives one.
    """
    plants = metrics["plants"]
    found = []
    for key, (heading, unit, relative) in _PLANT_ROWS.items():
        values = [each.get(key) for each in plants.values()]
        if all(value is None for value in values):
            continue
        difference = "" if key == "realtime_factor" else _difference(plants, key, relative)
        found.append(Row(heading, unit, tuple(map(_number, values)), difference, _number(published.get(key))))
    comparison = metrics["comparison"] or {}
    for key, (heading, unit) in _COMPARISON_ROWS.items():
        if comparison.get(key) is not None:
            blank = ("",) * len(plants)
            found.append(Row(heading, unit, blank, _number(comparison[key]), _number(published.get(key))))
    return found


def show(result: RunResult) -> None:
    """Print the table and the expectations of a run to stdout."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    lines = rows(result.metrics, published_values(result.metrics))
    table = Table(title=result.name, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("metric", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    headings = list(result.metrics["plants"])
    if len(headings) > 1:
        headings.append("difference")
    if any(line.published for line in lines):
        headings.append("published")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for line in lines:
        cells = [*line.plants]
        cells += [line.difference] if "difference" in headings else []
        cells += [line.published] if "published" in headings else []
        table.add_row(line.heading, line.unit, *cells)
    console = Console(file=sys.stdout, highlight=False)
    console.print(table)
    for text in expectation_lines(result.metrics):
        for part in textwrap.wrap(text, console.width, subsequent_indent=" " * 7, break_long_words=False):
            print(part)


def _difference(plants: Mapping[str, Mapping[str, Any]], key: str, relative: bool) -> str:
    """Format twin − analytical, over the analytical value where `relative`."""
    ours, theirs = (plants.get(kind, {}).get(key) for kind in ("analytical", "twin"))
    if ours is None or theirs is None:
        return ""
    if not relative:
        return f"{theirs - ours:+.3g}"
    return f"{100 * (theirs - ours) / ours:+.1f} %" if ours else ""


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def published_values(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return metric → the value that an expectation with a source states."""
    stated = [e for e in metrics["expectations"] if e.get("near") is not None and e.get("source")]
    return {each["metric"]: each["near"] for each in stated}


def expectation_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Return a line for each expectation: met or missed, what came out, what is allowed, says who."""
    return [_expectation(each) for each in metrics["expectations"]]


def missed_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Return the lines of the expectations that were missed."""
    return [_expectation(each) for each in metrics["expectations"] if not each["met"]]


def _expectation(each: Mapping[str, Any]) -> str:
    verdict = "met   " if each["met"] else "MISSED"
    source = f" ({each['source']})" if each.get("source") else ""
    value = _number(each["value"]) or "none"
    return f"{verdict} {each['of']} {each['metric']} = {value}, allowed {each['allowed']}{source}"
