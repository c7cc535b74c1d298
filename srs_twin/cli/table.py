"""What a run gave, for the terminal: one short table, then the expectations; 80 columns."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from srs_twin.comparison.summary import difference, published

if TYPE_CHECKING:
    from srs_twin.running import RunResult

# metric of a plant → (heading, unit)
_PLANT_ROWS = {
    "com_speed_m_s": ("CoM speed", "m/s"),
    "yaw_rate_rad_s": ("yaw rate", "rad/s"),
    "turning_radius_m": ("turning radius", "m"),
    "path_length_m": ("path length", "m"),
    "mean_bend_amplitude_rad": ("mean bend amplitude", "rad"),
    "realtime_factor": ("real-time factor", "1"),
}
_COMPARISON_ROWS = {
    "shape_rms_m": ("body shape, RMS", "m"),
    "path_rms_m": ("CoM path, RMS", "m"),
    "bend_rms_rad": ("bends, RMS", "rad"),
}
_NONE = (None, "")


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
    for key, (heading, unit) in _PLANT_ROWS.items():
        values = [each.get(key) for each in plants.values()]
        if all(value is None for value in values):
            continue
        texts = tuple(map(_number, values))
        found.append(Row(heading, unit, texts, difference(plants, key), _number(stated.get(key, _NONE)[0])))
    comparison = metrics["comparison"] or {}
    for key, (heading, unit) in _COMPARISON_ROWS.items():
        if comparison.get(key) is not None:
            blank = ("",) * len(plants)
            text = _number(comparison[key])
            found.append(Row(heading, unit, blank, text, _number(stated.get(key, _NONE)[0])))
    return found


def show(result: RunResult) -> None:
    """Print the table and the expectations of a run to stdout."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    lines = rows(result.metrics)
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


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


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
