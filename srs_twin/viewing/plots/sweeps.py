"""Pictures of a sweep: a metric over two fields, along one, or against another column.

The columns of a sweep's table as pictures need them: numbers, NaN where there is none.

Published values beside a sweep's: what was published, and a table of it with what the plants did.

Planes that pictures of sweeps are drawn on: panels side by side, marks of runs without a value.

A metric over two fields as filled contours: of a regular grid, or of scattered points by triangulation.

What cannot be drawn (all failed, no value anywhere) gives a picture that says so.
"""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Normalize, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from matplotlib.tri import Triangulation

from srs_twin.comparison.metrics import relative_difference
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.files import atomic_write
from srs_twin.viewing.plots.labels import field_label, metric_label
from srs_twin.viewing.plots.style import PUBLISHED_COLOR, finish, style_of

if TYPE_CHECKING:
    import pyarrow as pa


COMPARISON, PLAN = "comparison", "plan"
OWNERS = ("analytical", "twin", COMPARISON, PLAN)
Value = bool | int | float | str
_EXACT = 1e15  # up to where whole numbers, such as seeds, are written out
_SAME = 1e-9  # of the greatest value: what two ways of writing a number may differ by
_ABOUT_ROWS = {"key", "status", "reason", "exit_code", "wall_s"}


@dataclass(frozen=True)
class Values:
    """One column for an axis or a colour.

    Attributes:
        label: what stands at the axis.
        numbers: shape (rows,), NaN where there is none; of text, its place among `names`.
        names: the different texts, sorted; empty for numbers.
    """

    label: str
    numbers: np.ndarray
    names: tuple[str, ...] = ()

    def text(self, number: float) -> str:
        """Return how one of the values is written."""
        if self.names:
            return self.names[int(number)]
        return f"{number:.0f}" if float(number).is_integer() and abs(number) < _EXACT else f"{number:.4g}"

    def number(self, value: Value) -> float:
        """Return which of the `numbers` stands for a value of the field; NaN for a text that no row has."""
        if not self.names:
            return math.nan if isinstance(value, str) else float(value)
        # A column of texts and other things has these as JSON.
        found = [text for text in (str(value), json.dumps(value)) if text in self.names]
        return float(self.names.index(found[0])) if found else math.nan

    def at(self, value: Value) -> np.ndarray:
        """Return which rows have a value of the field, shape (rows,)."""
        number = self.number(value)
        most = float(np.max(np.abs(self.numbers), initial=abs(number), where=np.isfinite(self.numbers)))
        return np.asarray(np.abs(self.numbers - number) <= _SAME * most)


@dataclass(frozen=True)
class SweepTable:
    """The rows of a sweep.

    Attributes:
        columns: name → values, one a row.
    """

    columns: Mapping[str, Sequence[Any]]

    @staticmethod
    def of(table: pa.Table | Mapping[str, Iterable[Any]]) -> SweepTable:
        """Take a table of pyarrow or a mapping of columns."""
        if hasattr(table, "to_pydict"):
            return SweepTable(table.to_pydict())
        return SweepTable({name: np.asarray(column, dtype=object).tolist() for name, column in table.items()})

    @property
    def failed(self) -> np.ndarray:
        """Which rows failed, shape (rows,)."""
        return np.array([status == "failed" for status in self._column("status")], dtype=bool)

    @property
    def fields(self) -> list[str]:
        """The varied fields."""
        prefixes = tuple(f"{owner}." for owner in OWNERS)
        return [name for name in self.columns if name not in _ABOUT_ROWS and not name.startswith(prefixes)]

    def owners(self, metric: str) -> list[str]:
        """Return whose metric it is: plants, the comparison, or a plan that nobody followed.

        Raises:
            UnknownNameError: nobody's.
        """
        found = self.holders(metric)
        if not found:
            named = (name.partition(".") for name in self.columns)
            raise UnknownNameError("metric", metric, {rest for owner, _, rest in named if owner in OWNERS})
        return found

    def holders(self, metric: str) -> list[str]:
        """Return whose metric it is, as `owners` does; empty where it is nobody's."""
        return [owner for owner in OWNERS if self._names(owner, metric)]

    def metric(self, metric: str, owner: str) -> Values:
        """Return an owner's metric; of one that is a list, the mean over it."""
        names = self._names(owner, metric)
        if names == [f"{owner}.{metric}"]:
            return Values(metric_label(metric), _numbers(self.columns[names[0]]))
        parts = np.array([_numbers(self.columns[name]) for name in names])
        return Values(f"{metric_label(metric)}, mean over {len(names)}", parts.mean(axis=0))

    def values(self, name: str, owner: str) -> Values:
        """Return a field, or a metric: the owner's own, else the comparison's.

        Raises:
            UnknownNameError: there is no such column.
        """
        if name in self.fields:
            return _field(name, self.columns[name])
        for each in (owner, COMPARISON):
            if self._names(each, name):
                return self.metric(name, each)
        raise UnknownNameError("column", name, self.fields)

    def others(self, drawn: Iterable[str | None]) -> list[str]:
        """Return the fields that vary too, but are not among those drawn."""
        known = set(drawn)
        return [
            name for name in self.fields if name not in known and len(set(map(str, self.columns[name]))) > 1
        ]

    def _column(self, name: str) -> Sequence[Any]:
        if name not in self.columns:
            raise UnknownNameError("column", name, self.columns)
        return self.columns[name]

    def _names(self, owner: str, metric: str) -> list[str]:
        """Return the column of a metric, or those of its parts where it is a list."""
        name = f"{owner}.{metric}"
        if name in self.columns:
            return [name]
        stem = f"{name}_"
        return [each for each in self.columns if each.startswith(stem) and each[len(stem) :].isdigit()]


def _field(name: str, column: Sequence[Any]) -> Values:
    given = [value for value in column if value is not None]
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in given):
        return Values(field_label(name), _numbers(column))
    texts = ["" if value is None else str(value) for value in column]
    names = tuple(sorted(set(texts)))
    return Values(field_label(name), np.array([names.index(text) for text in texts], dtype=float), names)


def _numbers(column: Sequence[Any]) -> np.ndarray:
    """Return numbers, NaN for what is missing or not finite."""
    numbers = np.array([np.nan if value is None else float(value) for value in column], dtype=float)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def group_means(group: np.ndarray, count: int, values: np.ndarray) -> np.ndarray:
    """Return the mean of the values of each group, NaN where it has none; the order of the rows is no matter.

    Args:
        group: number of each value's group, shape (rows,).
        count: how many groups.
        values: shape (rows,); NaN ones are left out.
    """
    # Sums in an order of their own: that of the rows would show in the last bit.
    order = np.lexsort((values, group))
    order = order[np.isfinite(values[order])]
    sums = np.bincount(group[order], weights=values[order], minlength=count)
    counts = np.bincount(group[order], minlength=count)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


NONE = "–"


@dataclass(frozen=True)
class Beside:
    """What was published of the metrics of a sweep's plants.

    Attributes:
        source: where: "Table 8".
        at: varied field → its values where something is published; equally many of each field.
        metrics: metric → published values there, None where there is none.
        note: what a reader must know to compare.
    """

    source: str
    at: Mapping[str, Sequence[Value]]
    metrics: Mapping[str, Sequence[float | None]]
    note: str = ""

    @property
    def places(self) -> list[dict[str, Value]]:
        """Where something is published: each time a value of every field."""
        return [dict(zip(self.at, values, strict=True)) for values in zip(*self.at.values(), strict=True)]


@dataclass(frozen=True)
class BesideTable:
    """Published values and those of the plants, as text.

    Attributes:
        source: where they are published.
        note: what a reader must know to compare.
        headings: metric, fields, published, of each plant its value and the difference; runs where a value
            is a mean.
        rows: one a metric and place, in the order of the file.
    """

    source: str
    note: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def beside_table(beside: Beside, rows: SweepTable) -> BesideTable:
    """Return what was published beside what the plants did there; of several runs, their mean.

    Args:
        beside: what was published.
        rows: results of a sweep that varies these fields.
    """
    plants = [o for o in OWNERS if o != COMPARISON and any(o in rows.holders(m) for m in beside.metrics)]
    runs = [_runs(rows, place) for place in beside.places]
    averaged = any(chosen.sum() > 1 for chosen in runs)
    made = []
    for metric, published in beside.metrics.items():
        for place, chosen, value in zip(beside.places, runs, published, strict=True):
            line = [metric_label(metric), *map(_written, place.values()), _written(value)]
            for plant in plants:
                mean = _mean(rows, metric, plant, chosen)
                line += [_written(mean), _difference(value, mean)]
            made.append((*line, *([str(int(chosen.sum()))] if averaged else [])))
    headings = ["metric", *map(field_label, beside.at), "published"]
    headings += [heading for plant in plants for heading in (plant, "difference")]
    return BesideTable(beside.source, beside.note, (*headings, *(["runs"] * averaged)), tuple(made))


def _runs(rows: SweepTable, place: Mapping[str, Value]) -> np.ndarray:
    """Return which runs at a place did not fail, shape (rows,)."""
    chosen = ~rows.failed
    for field, value in place.items():
        chosen = chosen & rows.values(field, "").at(value)
    return chosen


def _mean(rows: SweepTable, metric: str, plant: str, chosen: np.ndarray) -> float | None:
    if plant not in rows.holders(metric):
        return None
    numbers = rows.metric(metric, plant).numbers[chosen]
    known = numbers[np.isfinite(numbers)]
    return float(known.mean()) if len(known) else None


def _difference(published: float | None, value: float | None) -> str:
    return NONE if published is None or value is None else relative_difference(published, value)


def _written(value: Value | None) -> str:
    if value is None:
        return NONE
    return f"{value:.4g}" if isinstance(value, float) else str(value)


_WIDTH, _HEIGHT = 9.0, 4.2
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.75, 0.25, 0.75, 0.5
_KEY = 1.3  # right margin with a colour bar or a legend in it
# Colours of marks: neither a plant's nor one of the scales of values.
_MARKS = {"failed": ("x", "#CC3311"), "no value": ("o", "0.35")}


def column_panels(columns: int, *, key: bool) -> tuple[Figure, list[Axes]]:
    """Return a figure of the report's width and its panels side by side, with common axes.

    Args:
        columns: number of panels.
        key: whether room is left on the right for what colours mean.
    """
    figure = Figure(figsize=(_WIDTH, _HEIGHT))
    margins = {
        "left": _LEFT / _WIDTH,
        "right": 1 - (_KEY if key else _RIGHT) / _WIDTH,
        "top": 1 - _TOP / _HEIGHT,
        "bottom": _BOTTOM / _HEIGHT,
        "wspace": 0.08,
    }
    made = figure.subplots(1, columns, sharex=True, sharey=True, squeeze=False, gridspec_kw=margins)
    for axes in made[0]:
        axes.tick_params(labelsize=8)
    return figure, list(made[0])


def color_bar(
    figure: Figure, norm: Normalize, cmap: str, values: Values, ticks: Sequence[float] | None = None
) -> None:
    """Draw the bar that says which colour means what, in the room on the right."""
    bottom = _BOTTOM / _HEIGHT
    place = (1 - (_KEY - 0.12) / _WIDTH, bottom, 0.16 / _WIDTH, 1 - _TOP / _HEIGHT - bottom)
    bar = figure.colorbar(ScalarMappable(norm, cmap), cax=figure.add_axes(place, label="colors"), ticks=ticks)
    bar.set_label(values.label, fontsize=9)
    bar.ax.tick_params(labelsize=8)
    if values.names:
        bar.set_ticks(range(len(values.names)), labels=list(values.names))


def legend_above(axes: Axes, handles: Sequence[Line2D] = ()) -> None:
    """Lay a legend above the plane on the right, where it covers nothing: handles, then what was marked."""
    marked, _ = axes.get_legend_handles_labels()
    shown = [*handles, *(each for each in marked if isinstance(each, Line2D))]
    if shown:
        axes.add_artist(
            axes.legend(
                handles=shown,
                fontsize=8,
                ncols=len(shown),
                loc="lower right",
                bbox_to_anchor=(1.0, 0.99),
                frameon=False,
                borderaxespad=0.2,
                handletextpad=0.4,
                columnspacing=1.2,
                handlelength=2.8,
            )
        )


def name_ticks(axis: Axis, values: Values) -> None:
    """Write texts at the ticks of an axis that stands for texts, and whole numbers where it counts."""
    known = values.numbers[np.isfinite(values.numbers)]
    if values.names:
        axis.set_ticks(range(len(values.names)), labels=values.names)
    elif known.size and np.array_equal(known, np.round(known)):
        axis.set_major_locator(MaxNLocator(integer=True))


def mark_rows(axes: Axes, x: np.ndarray, y: np.ndarray, what: str, *, across: bool = False) -> None:
    """Mark runs without a value, named in the legend.

    Args:
        axes: where.
        x: positions, in data.
        y: positions, in data.
        what: "failed" or "no value".
        across: y is a share of the height instead.
    """
    if len(x):
        marker, color = _MARKS[what]
        transform = axes.get_xaxis_transform() if across else axes.transData
        axes.plot(
            x,
            y,
            linestyle="none",
            marker=marker,
            color=color,
            markersize=4.5,
            markeredgewidth=1.1,
            markerfacecolor="none",
            transform=transform,
            clip_on=not across,
            label=what,
            zorder=4,
        )


def say(axes: Axes, failed: np.ndarray) -> None:
    """Say in the plane that there is nothing to draw, and why."""
    rows, bad = len(failed), int(failed.sum())
    if not rows:
        text = "there are no runs"
    elif bad == rows:
        text = "the run failed" if rows == 1 else f"all {rows} runs failed"
    else:
        text = f"no value in {rows - bad} runs" + (f", {bad} failed" if bad else "")
    axes.text(0.5, 0.5, f"nothing to draw: {text}", transform=axes.transAxes, ha="center", fontsize=10)


def span(all_values: Sequence[Values]) -> tuple[float, float]:
    """Return the least and the greatest of all numbers; 0 and 1 where there is none, apart in any case."""
    known = [values.numbers[np.isfinite(values.numbers)] for values in all_values]
    numbers = np.concatenate([*known, np.zeros(0)])
    if not len(numbers):
        return 0.0, 1.0
    low, high = float(numbers.min()), float(numbers.max())
    if high - low > 1e-9 * max(abs(low), abs(high)):
        return low, high
    room = 0.5 * abs(low) or 0.5
    return low - room, high + room


_LEVELS = 14
_BOTH_SIGNS = 0.1  # of the greatest value: how far a value lies beyond zero for zero to be the middle colour
_FLATTEST = 1e-3  # least sine of a triangle's corners; flatter ones say nothing of the plane
_MOST_DOTS = 400


@dataclass(frozen=True)
class Points:
    """The points of a plane, a row each, in order of y, then x.

    Attributes:
        x: shape (points,).
        y: shape (points,).
        z: mean of the values there, NaN where there is none, shape (points,).
        failed: whether every run there failed, shape (points,).
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    failed: np.ndarray

    @staticmethod
    def of(x: np.ndarray, y: np.ndarray, z: np.ndarray, failed: np.ndarray) -> Points:
        """Put rows at the same place together."""
        there = np.isfinite(x) & np.isfinite(y)
        places, which = np.unique(np.stack([y[there], x[there]], axis=-1), axis=0, return_inverse=True)
        which = which.reshape(-1)
        all_failed = group_means(which, len(places), failed[there].astype(float)) == 1.0
        return Points(places[:, 1], places[:, 0], group_means(which, len(places), z[there]), all_failed)

    @property
    def known(self) -> np.ndarray:
        """Which points have a value."""
        return np.isfinite(self.z)

    @property
    def grid(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """x, y and values (y, x) of a full grid of two by two or more; None where they are no such grid."""
        columns, rows = np.unique(self.x), np.unique(self.y)
        if min(len(columns), len(rows)) < 2 or len(columns) * len(rows) != len(self.z):
            return None
        return columns, rows, np.ma.masked_invalid(self.z.reshape(len(rows), len(columns)))


def draw_contours(
    figure: Figure,
    panels: Sequence[Axes],
    x: Values,
    y: Values,
    values: Sequence[Values],
    failed: np.ndarray,
) -> None:
    """Draw one panel a plant, all with the same colours.

    Args:
        figure: gets the colour bar.
        panels: one an entry of `values`.
        x: field along x.
        y: field along y.
        values: metric of each plant.
        failed: which runs failed, shape (rows,).
    """
    points = [Points.of(x.numbers, y.numbers, each.numbers, failed) for each in values]
    levels, cmap = _scale([p.z for p in points])
    for axes, each in zip(panels, points, strict=True):
        if not each.known.any():
            say(axes, failed)
        else:
            _fill(axes, each, levels, cmap)
        for what, which in (("failed", each.failed), ("no value", ~each.known & ~each.failed)):
            mark_rows(axes, each.x[which], each.y[which], what)
        for limits, ends in ((axes.set_xlim, span([x])), (axes.set_ylim, span([y]))):
            room = 0.03 * (ends[1] - ends[0])
            limits(ends[0] - room, ends[1] + room)
        legend_above(axes)
    if any(each.known.any() for each in points):
        color_bar(figure, BoundaryNorm(levels, 256), cmap, values[0], levels[::2].tolist())


def _fill(axes: Axes, points: Points, levels: np.ndarray, cmap: str) -> None:
    """Fill the plane between the points; where they span none, colour the points themselves."""
    grid, known = points.grid, points.known
    style: dict[str, Any] = {"levels": levels, "cmap": cmap}
    thin: dict[str, Any] = {"levels": levels, "colors": "k", "linewidths": 0.3, "alpha": 0.5}
    mesh = None if grid else _mesh(points.x[known], points.y[known])
    dots: dict[str, Any] = {"s": 3.0, "color": "0.25", "linewidths": 0.0}
    if grid is not None and _has_cell(grid[2]):
        axes.contourf(*grid, **style)
        axes.contour(*grid, **thin)
    elif mesh is not None:
        axes.tricontourf(mesh, points.z[known], **style)
        axes.tricontour(mesh, points.z[known], **thin)
    else:
        dots = {"s": 45.0, "c": points.z[known], "cmap": cmap, "vmin": levels[0], "vmax": levels[-1]}
    if "c" in dots or known.sum() <= _MOST_DOTS:
        axes.scatter(points.x[known], points.y[known], zorder=3, **dots)


def _has_cell(values: np.ndarray) -> bool:
    """Whether at least one cell of a grid has a value at all four corners."""
    there = ~np.ma.getmaskarray(values)
    return bool((there[1:, 1:] & there[1:, :-1] & there[:-1, 1:] & there[:-1, :-1]).any())


def _mesh(x: np.ndarray, y: np.ndarray) -> Triangulation | None:
    """Return triangles between points, None where they span no plane."""
    if len(x) < 3:
        return None
    # Fields have units of their own: as they lie on the paper.
    u, v = (((each - each.min()) / (np.ptp(each) or 1.0)) for each in (x, y))
    try:
        corners = Triangulation(u, v).triangles
    except (RuntimeError, ValueError):
        return None  # all on a line
    sides = np.stack([u[corners], v[corners]], axis=-1)
    first, second = sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]
    area = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    longest = np.max(
        [np.sum((sides[:, i] - sides[:, j]) ** 2, axis=-1) for i, j in ((0, 1), (1, 2), (2, 0))], axis=0
    )
    flat = area < _FLATTEST * longest
    return None if flat.all() else Triangulation(x, y, corners, mask=flat)


def _scale(values: Sequence[np.ndarray]) -> tuple[np.ndarray, str]:
    """Return levels common to all panels and the colours: about zero where there are both signs."""
    low, high = span([Values("", each) for each in values])
    most = max(abs(low), abs(high))
    if low < 0 < high and min(-low, high) > _BOTH_SIGNS * most:
        return np.asarray(MaxNLocator(_LEVELS, symmetric=True).tick_values(-most, most)), "RdBu_r"
    return np.asarray(MaxNLocator(_LEVELS).tick_values(low, high)), "viridis"


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
                place,
                height,
                color=colors.get(group, _color(owner)),
                linestyle=_dash(owner),
                linewidth=1.3 if few else 0.9,
                marker=_MARKERS[owner],
                markersize=size,
            )
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
        handles=handles,
        title=textwrap.fill(by.label, 18),
        title_fontsize=8,
        fontsize=8,
        frameon=False,
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        alignment="left",
    )


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
            x.numbers[order],
            values.numbers[order],
            s=16,
            marker=_MARKERS[owner],
            alpha=0.85,
            linewidths=0,
            **color,
        )
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
