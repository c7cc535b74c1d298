"""Pictures of a sweep: a metric over two fields, along one, or against another column.

What cannot be drawn (all failed, no value anywhere) gives a picture that says so.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from srs_twin.errors import InputError
from srs_twin.files import atomic_write
from srs_twin.viewing.colors import PUBLISHED_COLOR, style_of
from srs_twin.viewing.figures import finish
from srs_twin.viewing.labels import field_label
from srs_twin.viewing.sweep_beside import Beside
from srs_twin.viewing.sweep_contour import draw_contours
from srs_twin.viewing.sweep_panels import (
    color_bar,
    column_panels,
    legend_above,
    mark_rows,
    name_ticks,
    say,
    span,
)
from srs_twin.viewing.sweep_table import COMPARISON, PLAN, SweepTable, Values, group_means

if TYPE_CHECKING:
    import pyarrow as pa

FORMATS = (".png", ".svg")
_MOST_LINES = 12
_MARKERS = {"analytical": "s", "twin": "o", COMPARISON: "D", PLAN: "o"}
_NO_PLANT_COLOR = "#222222"


@dataclass(frozen=True)
class PlotRequest:
    """A picture that is wanted.

    Attributes:
        kind: "contour" (metric over x and y), "line" (along x) or "scatter" (against x).
        x: varied field; of a scatter also a metric.
        metric: what is drawn, of each plant that has it, or of the comparison.
        y: varied field, contour only.
        by: varied field, of a scatter also a metric, that colours lines or points.
        plants: whose; empty: of all that have it.
        title: empty: made from what is drawn.
    """

    kind: Literal["contour", "line", "scatter"]
    x: str
    metric: str
    y: str | None = None
    by: str | None = None
    plants: tuple[str, ...] = ()
    title: str = ""

    def __post_init__(self) -> None:
        if (self.y is None) == (self.kind == "contour"):
            raise InputError(
                "a contour needs y" if self.y is None else f"y belongs to contour, not to {self.kind}"
            )
        if self.by is not None and self.kind == "contour":
            raise InputError("by belongs to line and scatter, not to contour")


def draw(
    request: PlotRequest, table: pa.Table | Mapping[str, Iterable[Any]], beside: Beside | None = None
) -> Figure:
    """Return the picture.

    Args:
        request: what is wanted.
        table: results of a sweep, a row a point: varied fields by their dotted path, `status`, metrics as
            ``<plant>.<metric>`` and ``comparison.<metric>``. The order of the rows changes nothing.
        beside: published values; a line has those of its metric along x, with a marker of their own.

    Raises:
        InputError: there is no such column.
    """
    rows = SweepTable.of(table)
    owners = [o for o in rows.owners(request.metric) if o in (request.plants or (o,)) or o == COMPARISON]
    # A metric of the plants is theirs; the comparison's stands alone.
    owners = [owner for owner in owners if owner != COMPARISON] or owners
    if not owners:
        raise InputError(f"{request.metric}: none of {', '.join(request.plants)} has it")
    if request.kind == "line":
        figure = _line(request, rows, owners, beside)
    else:
        figure = (_contour if request.kind == "contour" else _scatter)(request, rows, owners)
    figure.suptitle(_title(request, rows, owners), x=0.01, ha="left", fontsize=10)
    return figure


def save(figure: Figure, path: str | Path) -> None:
    """Write a picture as PNG or SVG, by the suffix, whole or not at all; equal ones give equal bytes.

    Raises:
        InputError: another suffix, or the place cannot be written.
    """
    target = Path(path)
    if target.suffix not in FORMATS:
        raise InputError(f"{target.name}: pictures are written as {' or '.join(FORMATS)}")
    about = {"Software": None} if target.suffix == ".png" else {"Date": None}
    with atomic_write(target) as part, rc_context({"svg.hashsalt": "srs-twin", "svg.fonttype": "none"}):
        figure.savefig(part, format=target.suffix[1:], dpi=130, metadata=about)


def _title(request: PlotRequest, rows: SweepTable, owners: list[str]) -> str:
    """Return the title, and below it what the picture leaves out."""
    metric = rows.metric(request.metric, owners[0]).label.partition(" (")[0]
    drawn = [request.x, *([request.y] if request.y else [])]
    names = [rows.values(name, owners[0]).label.partition(" (")[0] for name in drawn]
    notes = []
    if request.kind != "scatter":
        others = rows.others((*drawn, request.by))
        notes = [f"each value the mean over {', '.join(map(field_label, others))}"] if others else []
    failed = int(rows.failed.sum())
    notes += [f"{failed} of {len(rows.failed)} runs failed"] if failed else []
    lacking = sum(
        int((np.isnan(rows.metric(request.metric, owner).numbers) & ~rows.failed).sum()) for owner in owners
    )
    notes += [f"{lacking} values missing"] if lacking else []
    known = np.concatenate([rows.metric(request.metric, owner).numbers for owner in owners])
    different = np.unique(known[np.isfinite(known)])
    notes += [f"every value is {different[0]:.4g}"] if len(different) == 1 else []
    against = "against" if request.kind == "scatter" else "over"
    title = request.title or f"{metric[:1].upper()}{metric[1:]} {against} {' and '.join(names)}"
    return "\n".join([title, *([f"({'; '.join(notes)})"] if notes else [])])


def _contour(request: PlotRequest, rows: SweepTable, owners: list[str]) -> Figure:
    figure, panels = column_panels(len(owners), key=True)
    x, y = rows.values(request.x, owners[0]), rows.values(str(request.y), owners[0])
    values = [rows.metric(request.metric, owner) for owner in owners]
    draw_contours(figure, panels, x, y, values, rows.failed)
    for axes, owner in zip(panels, owners, strict=True):
        axes.set_title(_name(owner), fontsize=9, loc="left")
        axes.set_xlabel(x.label, fontsize=9)
        name_ticks(axes.xaxis, x)
    finish(panels[0], y.label)
    name_ticks(panels[0].yaxis, y)
    return figure


def _line(request: PlotRequest, rows: SweepTable, owners: list[str], beside: Beside | None) -> Figure:
    """Draw a line a value of `by` (its colour) and owner (its dash and marker), and published values."""
    figure, (axes,) = column_panels(1, key=request.by is not None)
    x = rows.values(request.x, owners[0])
    by = rows.values(request.by, owners[0]) if request.by else Values("", np.zeros(len(rows.failed)))
    groups = np.unique(by.numbers[np.isfinite(by.numbers)])
    few = len(groups) <= _MOST_LINES
    colors = _colors(groups, by, few=few) if request.by else {}
    drawn = 0
    for owner in owners:
        values = rows.metric(request.metric, owner)
        for i, group in enumerate(groups):
            # Smaller and smaller, for lines of names that lie upon each other.
            size = (3.5 if few else 2.0) + (2.0 * (len(groups) - 1 - i) if by.names and few else 0.0)
            place, height = _means(x.numbers, values.numbers, by.numbers == group)
            drawn += int(np.isfinite(height).sum())
            axes.plot(
                place, height, color=colors.get(group, _color(owner)), linestyle=_dash(owner),
                linewidth=1.3 if few else 0.9, marker=_MARKERS[owner], markersize=size,
            )  # fmt: skip
    _finish_plane(axes, x, rows.metric(request.metric, owners[0]), rows.failed, drawn=drawn)
    # Lines of plans are told apart by what they vary over alone.
    samples = [_sample(owner, plain=bool(request.by)) for owner in owners if owner != PLAN]
    if beside is not None and request.x in beside.at and request.metric in beside.metrics:
        samples.append(_draw_published(axes, beside, request, x, by, colors if few else {}))
    legend_above(axes, samples)
    if request.by:
        _name_groups(figure, axes, by, groups, colors)
    return figure


def _name_groups(
    figure: Figure, axes: Axes, by: Values, groups: np.ndarray, colors: Mapping[float, str]
) -> None:
    """Say which colour is which value of `by`: a legend of few, a colour bar of many."""
    if len(groups) > _MOST_LINES:
        color_bar(figure, Normalize(*span([by])), "viridis", by)
        return
    handles = [Line2D([], [], color=colors[group], label=by.text(group)) for group in groups]
    axes.legend(
        handles=handles, title=textwrap.fill(by.label, 18), title_fontsize=8, fontsize=8, frameon=False,
        loc="upper left", bbox_to_anchor=(1.0, 1.0), alignment="left",
    )  # fmt: skip


def _draw_published(
    axes: Axes, beside: Beside, request: PlotRequest, x: Values, by: Values, colors: Mapping[float, str]
) -> Line2D:
    """Mark the published values of a metric along x, in the colour of their line where it is known.

    Returns:
        What the legend shows of them.
    """
    style: dict[str, Any] = {"linestyle": "none", "marker": "*", "markersize": 10, "markeredgecolor": "white"}
    groups = beside.at.get(request.by, ()) if request.by else ()
    for i, (place, value) in enumerate(
        zip(beside.at[request.x], beside.metrics[request.metric], strict=True)
    ):
        color = colors.get(by.number(groups[i])) if groups else None
        if value is not None:
            axes.plot(
                x.number(place), value, color=color or PUBLISHED_COLOR, markeredgewidth=0.6, zorder=5, **style
            )
    # A dollar would begin a formula.
    label = f"published, {beside.source}".replace("$", r"\$")
    return Line2D([], [], color=PUBLISHED_COLOR, label=label, **style)


def _scatter(request: PlotRequest, rows: SweepTable, owners: list[str]) -> Figure:
    figure, (axes,) = column_panels(1, key=request.by is not None)
    given = [rows.values(request.by, owner) for owner in owners] if request.by else []
    low, high = span(given)
    shades = np.concatenate([each.numbers for each in given]) if given else np.zeros(0)
    groups = np.unique(shades[np.isfinite(shades)])
    few = len(groups) <= _MOST_LINES
    colors = _colors(groups, given[0], few=few) if given and few else {}
    drawn = 0
    for i, owner in enumerate(owners):
        x, values = rows.values(request.x, owner), rows.metric(request.metric, owner)
        shade = given[i].numbers if request.by else np.zeros(len(values.numbers))
        there = np.isfinite(x.numbers) & np.isfinite(values.numbers) & np.isfinite(shade)
        order = np.flatnonzero(there)[np.lexsort((values.numbers[there], x.numbers[there], shade[there]))]
        color: dict[str, Any] = {"color": _color(owner)}
        if request.by and few:
            color = {"c": [colors[each] for each in shade[order]]}
        elif request.by:
            color = {"c": shade[order], "cmap": "viridis", "vmin": low, "vmax": high}
        axes.scatter(
            x.numbers[order], values.numbers[order], s=16, marker=_MARKERS[owner], alpha=0.85,
            linewidths=0, **color,
        )  # fmt: skip
        drawn += len(order)
    x = rows.values(request.x, owners[0])
    _finish_plane(axes, x, rows.metric(request.metric, owners[0]), rows.failed, drawn=drawn)
    legend_above(axes, [_sample(owner, line=False, plain=bool(given)) for owner in owners if owner != PLAN])
    if given and few:
        _name_groups(figure, axes, given[0], groups, colors)
    elif given:
        color_bar(figure, Normalize(low, high), "viridis", given[0])
    return figure


def _means(x: np.ndarray, values: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the different x of the chosen rows, and the mean of their values; NaN where there is none."""
    there = chosen & np.isfinite(x)
    places, which = np.unique(x[there], return_inverse=True)
    return places, group_means(which.reshape(-1), len(places), values[there])


def _finish_plane(axes: Axes, x: Values, values: Values, failed: np.ndarray, *, drawn: int) -> None:
    """Name the axes, and mark on the lower edge where runs failed."""
    finish(axes, values.label)
    axes.set_xlabel(x.label, fontsize=9)
    name_ticks(axes.xaxis, x)
    where = np.unique(x.numbers[failed & np.isfinite(x.numbers)])
    mark_rows(axes, where, np.full(len(where), 0.025), "failed", across=True)
    if not drawn:
        say(axes, failed)


def _colors(groups: np.ndarray, by: Values, *, few: bool) -> dict[float, str]:
    """Return a colour a group: evenly apart where a legend tells them, else along the colour bar."""
    shares = np.linspace(0.0, 0.92, len(groups)) if few else Normalize(*span([by]))(groups)
    return dict(zip(groups.tolist(), map(to_hex, colormaps["viridis"](shares)), strict=True))


def _sample(owner: str, *, line: bool = True, plain: bool = False) -> Line2D:
    """Return what the legend shows of an owner."""
    dash = _dash(owner) if line else "none"
    color = "0.3" if plain else _color(owner)
    return Line2D(
        [], [], color=color, linestyle=dash, marker=_MARKERS[owner], markersize=4, label=_name(owner)
    )


def _name(owner: str) -> str:
    return "twin − analytical" if owner == COMPARISON else style_of(owner).label


def _color(owner: str) -> str:
    return _NO_PLANT_COLOR if owner in (COMPARISON, PLAN) else style_of(owner).color


def _dash(owner: str) -> Literal["-", "--", "-.", ":"]:
    return "-" if owner == PLAN else style_of(owner).dash
