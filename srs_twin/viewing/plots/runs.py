"""Plots of runs and of the differences between plants.

Lines differ in colour, dash pattern and width, so that they can be distinguished by
colour-blind readers and in greyscale prints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from srs_twin.comparison.compare import MEASURES
from srs_twin.comparison.learning import PeriodAmplitudes, is_learning
from srs_twin.comparison.tracking import ReadingCurve
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.signals import (
    forward_speed,
    gait_period,
    period_speed,
    pressure_difference,
    reference_period,
)
from srs_twin.viewing.plots.style import (
    MINUS_COLOR,
    PLUS_COLOR,
    REFERENCE,
    STYLES,
    Style,
    add_legend,
    drawing,
    finish,
    panels,
    set_title,
    side_by_side,
    style_of,
)

if TYPE_CHECKING:
    from srs_twin.comparison.compare import (
        AssumptionShare,
        Attribution,
        Comparison,
        MeasuredDifference,
    )

Runs = Mapping[str, Trajectory]

_MAX_ROWS = 8
"""Maximum number of panels, each of which shows one segment."""

_PERIODS_SHOWN = 4
"""Number of gait or reference periods shown for a long run."""

_MAX_DOTS = 4000
"""Maximum number of sensor readings drawn as dots for each run."""

# Axis label and unit conversion factor of each difference from the measured robot.
_MEASURED_SIGNALS = {
    "shape_m": ("shape (mm)", 1e3),
    "path_m": ("CoM path (mm)", 1e3),
    "heading_rad": ("heading (rad)", 1),
}


@drawing
def bend_plot(trajectories: Runs) -> Figure:
    """Plot the bend of each segment.

    For long runs of a gait, the plot shows the last gait periods, otherwise the whole
    run.
    """
    return _by_segment(
        trajectories, lambda run: run.stack("bend"), "$q_{{{}}}$ (rad)", "Bends"
    )


@drawing
def pressure_plot(trajectories: Runs) -> Figure:
    """Plot the pressure difference p⁺ − p⁻ of each segment."""
    title = "Pressure differences $p^+ - p^-$ (kPa)"
    return _by_segment(
        trajectories, lambda run: 1e-3 * pressure_difference(run), "segment {}", title
    )


@drawing
def speed_plot(trajectories: Runs) -> Figure:
    """Plot instantaneous and period-averaged forward speeds of the centre of mass."""
    figure, (axes,) = panels(3.0)
    for style, run in runs_with_styles(trajectories):
        period = gait_period(run)
        time = run.time[:0]
        mean = time
        if period:
            time, mean = period_speed(run, period)
        speed = forward_speed(run)
        if not len(time):
            label = f"{style.label}, along the heading"
            axes.plot(run.time, speed, **style.line | {"label": label})
            continue
        axes.plot(run.time, speed, color=style.color, linewidth=0.7, alpha=0.35)
        label = f"{style.label}, mean of one gait period"
        thick = style.line | {"label": label, "linewidth": 2.0}
        axes.plot(time, mean, **thick, zorder=style.zorder)
    axes.axhline(0.0, color="0.5", linewidth=0.6)
    title = (
        "Speed of the centre of mass, forward positive (thin: instantaneous, along the"
        " heading)"
    )
    finish(axes, "speed (m/s)", "time (s)", title=title)
    axes.legend(loc="best", fontsize=8.5)
    return figure


@drawing
def error_plot(comparison: Comparison, spec: RobotSpec) -> Figure:
    """Plot shape and path differences between plants, in mm and % of body length."""
    figure, (shape, path) = panels(4.0, 2, right=0.75)
    length = 1e3 * spec.geometry.body_length
    conversions = (
        (lambda mm: mm * 100 / length),
        (lambda percent: percent * length / 100),
    )
    for axes, error in ((shape, comparison.shape_error), (path, comparison.path_error)):
        axes.plot(comparison.time, 1e3 * error, color="0.15", linewidth=1.2)
        axes.set_ylim(0, 1.08e3 * max(float(error.max()), 1e-6))
        percent_axis = axes.secondary_yaxis("right", functions=conversions)
        percent_axis.set_ylabel("% of body length")
    title = (
        "Differences: body shapes (RMS over connectors, CoM frame, zero mean heading)"
        " and CoM positions"
    )
    finish(shape, "shape (mm)", title=title)
    finish(path, "CoM distance (mm)", "time (s)")
    return figure


def runs_with_styles(trajectories: Runs) -> list[tuple[Style, Trajectory]]:
    """Return the line style and the trajectory of each run."""
    return [
        (style_of(plant, index), run)
        for index, (plant, run) in enumerate(trajectories.items())
    ]


def _by_segment(
    trajectories: Runs,
    signal: Callable[[Trajectory], np.ndarray],
    label: str,
    title: str,
) -> Figure:
    signals = [signal(run) for run in trajectories.values()]
    segments = min(values.shape[1] for values in signals)
    count = min(segments, _MAX_ROWS)
    plotted = np.unique(np.linspace(0, segments - 1, count).round().astype(int))
    figure, rows = panels(0.9 + 1.1 * len(plotted), len(plotted), sharey=True)
    window = _common_window(trajectories)
    for axes, j in zip(rows, plotted, strict=True):
        for (style, run), values in zip(
            runs_with_styles(trajectories), signals, strict=True
        ):
            shown = window.contains(run)
            axes.plot(
                run.time[shown], values[shown, j], **style.line, zorder=style.zorder
            )
        finish(axes, label.format(j + 1))
    selection = ""
    if len(plotted) < segments:
        selection = f", {len(plotted)} of {segments} segments"
    set_title(rows[0], f"{title}, head first{selection}{window.remark}", "left")
    _finish_time(figure, rows, window)
    return figure


class _Window(NamedTuple):
    first: float
    last: float
    remark: str = ""

    def contains(self, run: Trajectory) -> np.ndarray:
        return (run.time >= self.first - 1e-9) & (run.time <= self.last + 1e-9)


def _finish_time(figure: Figure, rows: Sequence[Axes], window: _Window) -> None:
    handles, labels = rows[0].get_legend_handles_labels()
    add_legend(figure, "upper right", handles=handles, labels=labels, ncols=len(labels))
    rows[-1].set_xlabel("time (s)")
    last = window.last if window.last > window.first else window.first + 1.0
    rows[-1].set_xlim(window.first, last)


def _common_window(trajectories: Runs) -> _Window:
    """Return the time range of the last few gait periods that all runs contain."""
    first = min(float(run.time[0]) for run in trajectories.values())
    ends = [float(run.time[-1]) for run in trajectories.values()]
    period = max(gait_period(run) or 0.0 for run in trajectories.values())
    if not period or max(ends) - first <= (_PERIODS_SHOWN + 1) * period:
        return _Window(first, max(ends))
    last = max(min(ends), first + _PERIODS_SHOWN * period)
    remark = f" (last {_PERIODS_SHOWN} gait periods)"
    if last < max(ends):
        remark = f" ({_PERIODS_SHOWN} gait periods before the first end)"
    return _Window(last - _PERIODS_SHOWN * period, last, remark)


@drawing
def learning_plot(trajectories: Runs) -> Figure | None:
    """Plot bend amplitudes and valve duty cycles, one row per module.

    The left column shows the amplitudes with dotted targets, and the right column shows
    the duty cycles. Colours distinguish the chambers, and dash patterns distinguish the
    plants. If a controller does not learn, the result is None.
    """
    if not all(map(is_learning, trajectories.values())):
        return None
    runs = [
        (style, PeriodAmplitudes.from_trajectory(run))
        for style, run in runs_with_styles(trajectories)
    ]
    rows = min(_MAX_ROWS, max(run.duty.shape[1] for _, run in runs))
    figure, grid = side_by_side(
        1.35 * rows + 0.95,
        2,
        rows,
        left=0.75,
        right=0.2,
        top=0.45,
        space=0.18,
        sharex=True,
        sharey="col",
    )
    for j, (bends, duties) in enumerate(grid):
        for style, run in runs:
            _plot_learning(bends, duties, style, run, j)
        duties.set_ylim(-0.04, 1.04)
        finish(bends, f"segment {j + 1}\n(rad)")
        finish(duties, "duty")
    set_title(grid[0, 0], "Amplitudes (dotted: targets)", "left")
    set_title(grid[0, 1], "Duties", "left")
    for axes in grid[-1]:
        axes.set_xlabel("period of the chamber")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    handles = [
        Line2D([], [], color=color, label=f"{side} chamber")
        for side, color in _CHAMBERS.items()
    ]
    handles += [
        Line2D([], [], color="0.4", linestyle=style.dash, label=style.label)
        for style, _ in runs
    ]
    add_legend(figure, "upper right", handles=handles, ncols=4)
    return figure


_CHAMBERS = {"+": PLUS_COLOR, "\u2212": MINUS_COLOR}


def _plot_learning(
    bends: Axes, duties: Axes, style: Style, run: PeriodAmplitudes, j: int
) -> None:
    periods = np.arange(1, len(run.duty) + 1)
    for side, color in enumerate(_CHAMBERS.values()):
        line: dict[str, Any] = {
            "color": color,
            "linestyle": style.dash,
            "linewidth": 1.4,
        }
        bends.plot(periods, run.amplitude[:, j, side], **line)
        bends.plot(periods, run.target[:, j, side], ":", color=color, linewidth=0.8)
        duties.plot(periods, run.duty[:, j, side], **line)


@drawing
def tracking_plot(trajectories: Runs) -> Figure:
    """Plot reference, bend, sensor readings and valve states of the first segment.

    If the reference is periodic, the plot shows the last four periods, otherwise the
    whole run. As in the dissertation, a valve state of 1 drives the bend in the
    positive direction, and −1 in the negative direction.
    """
    count = len(trajectories)
    figure, (bends, *valves) = panels(
        2.9 + 0.75 * count, 1 + count, height_ratios=[2.6, *[0.75] * count]
    )
    run = next(iter(trajectories.values()))
    first = float(run.time[0])
    last = float(run.time[-1])
    if (period := reference_period(run)) is not None:
        first = max(first, last - _PERIODS_SHOWN * period)
    window = _Window(first, last)
    shown = window.contains(run)
    bends.plot(run.time[shown], run["reference_1"][shown], **REFERENCE.line, zorder=3)
    for (style, run), axes, plant in zip(
        runs_with_styles(trajectories), valves, trajectories, strict=True
    ):
        shown = window.contains(run)
        time = run.time[shown]
        if run.has("measured_bend_1"):
            measured_bend = run["measured_bend_1"][shown]
            bends.plot(time, measured_bend, color=style.color, linewidth=0.4, alpha=0.3)
        bends.plot(time, run["bend_1"][shown], **style.line, zorder=style.zorder)
        state = (run["valve_plus_1"] - run["valve_minus_1"])[shown] / 2
        # A sample contains the valve states of the preceding interval.
        axes.step(time, state, where="pre", color=style.color, linewidth=0.8)
        axes.set(ylim=(-1.3, 1.3), yticks=[-1, 0, 1])
        finish(axes, f"{plant}\nvalves")
    title = "Bend and reference (thin: sensor reading), and valve states"
    finish(bends, "$q_1$ (rad)", title=title, loc="left")
    _finish_time(figure, [bends, *valves], window)
    return figure


@drawing
def reading_plot(trajectories: Runs) -> Figure | None:
    """Plot readings and mean errors of the first segment's sensor against the bend.

    If all sensors are ideal, the result is None.
    """
    curves = [
        (style, run, curve)
        for style, run in runs_with_styles(trajectories)
        if (curve := ReadingCurve.from_trajectory(run)) is not None
    ]
    if not curves:
        return None
    figure, (readings, errors) = panels(4.6, 2)
    bends = np.concatenate([curve.bend for _, _, curve in curves])
    ends = np.zeros(2)
    if len(bends):
        ends = np.degrees([bends.min(), bends.max()])
    readings.plot(ends, ends, **REFERENCE.line | {"label": "bend"})
    for style, run, curve in curves:
        subset = slice(None, None, math.ceil(len(run) / _MAX_DOTS))
        dots = np.degrees([run["bend_1"][subset], run["measured_bend_1"][subset]])
        readings.plot(*dots, ".", color=style.color, markersize=1.5, alpha=0.3)
        bend = np.degrees(curve.bend)
        readings.plot(bend, np.degrees(curve.reading), **style.line)
        errors.plot(bend, np.degrees(curve.reading - curve.bend), **style.line)
    title = "Sensor reading of the first segment (dots: single readings; lines: means)"
    finish(readings, "sensed (°)", title=title, loc="left")
    finish(errors, "mean − bend (°)", "bend (°)")
    add_legend(readings, "upper left")
    return figure


@drawing
def measured_plot(differences: Mapping[str, MeasuredDifference]) -> Figure | None:
    """Plot differences from the measured shape, path, heading and bends.

    If there are no measurements, the result is None.
    """
    if not differences:
        return None
    signals = {plant: difference.signals() for plant, difference in differences.items()}
    available = set.intersection(*(set(signal) for signal in signals.values()))
    plotted = {
        name: entry for name, entry in _MEASURED_SIGNALS.items() if name in available
    }
    figure, rows = panels(0.9 + 1.45 * (len(plotted) + 1), len(plotted) + 1)
    for index, (plant, difference) in enumerate(differences.items()):
        values = [
            factor * signals[plant][name] for name, (_, factor) in plotted.items()
        ]
        for axes, value in zip(rows, [*values, difference.bend_rms], strict=True):
            axes.plot(difference.comparison.time, value, **style_of(plant, index).line)
    labels = [*(label for label, _ in plotted.values()), "bends (rad)"]
    for axes, label in zip(rows, labels, strict=True):
        finish(axes, label)
    distances = "shapes and paths as distances, " if plotted else ""
    set_title(rows[0], f"Plant − measured: {distances}bends RMS over segments")
    add_legend(rows[0], "upper left")
    rows[-1].set_xlabel("time (s)")
    return figure


_POSITIVE_COLOR = "#009E73"
_NEGATIVE_COLOR = "#CC79A7"
_REMAINDER_COLOR = "#8a8f98"
_BAR_PITCH = 0.23
"""Spacing between the centres of neighbouring bars, inches."""
_PANEL_GAP = 0.7
"""Vertical gap between two panels for tick labels and a heading, inches."""


@drawing
def attribution_plot(attribution: Attribution) -> Figure:
    """Plot the contribution of each assumption to the difference between the plants.

    A contribution may depend on the order in which assumptions are replaced, and a thin
    line shows the range over all orders. The last two bars show the unexplained
    remainder and the total difference.
    """
    shares = _by_size(attribution.shares)
    names = [*(share.name for share in shares), "not explained", "twin − analytical"]
    rows = len(MEASURES) // 2
    height = rows * (_BAR_PITCH * len(names) + _PANEL_GAP) + 0.3
    left = 0.35 + 0.07 * max(map(len, names))  # inches, for a font size of 9.5 pt
    figure, grid = side_by_side(
        height,
        2,
        rows,
        left=left,
        right=0.15,
        top=0.6,
        bottom=0.3,
        space=0.17,
        sharey=True,
    )
    caption = (
        "Contribution of each assumption; the bars above the line add up to the bar"
        " below it"
    )
    figure.suptitle(caption, x=0.01, ha="left", fontsize=11)
    values = [(share.value, share.low, share.high) for share in shares]
    values += [(total,) * 3 for total in (attribution.remainder, attribution.gap)]
    # The axes of the transposed array are measures, (value, low, high) and bars.
    for axes, (title, unit), bounds in zip(
        grid.flat, MEASURES.values(), np.array(values).T, strict=True
    ):
        bars, low, high = bounds
        scale = 1.0
        prefix = ""
        if np.abs(bars).max() < 0.1:
            scale = 1e3
            prefix = "m"
        _plot_contributions(axes, scale * bars, scale * low, scale * high)
        finish(axes, "", title=f"{title} ({prefix}{unit})", loc="left")
    grid[0, 0].set_yticks(range(len(names)), names)
    grid[0, 0].invert_yaxis()
    for axes in grid[:, 0]:
        axes.tick_params(axis="y", labelsize=9.5)
    return figure


def _by_size(shares: Sequence[AssumptionShare]) -> list[AssumptionShare]:
    """Sort assumptions by the sum of their normalised contributions."""
    value = np.abs([share.value for share in shares])
    size = (value / value.max(axis=0).clip(1e-12)).sum(axis=1)
    return [shares[i] for i in np.argsort(-size)]


def _plot_contributions(
    axes: Axes, bars: np.ndarray, low: np.ndarray, high: np.ndarray
) -> None:
    colors = [
        *np.where(bars[:-2] < 0, _NEGATIVE_COLOR, _POSITIVE_COLOR),
        _REMAINDER_COLOR,
        STYLES["twin"].color,
    ]
    axes.barh(range(len(bars)), bars, height=0.65, color=colors)
    rows = range(len(bars) - 2)
    axes.hlines(rows, low[:-2], high[:-2], color="0.2", linewidth=0.9)
    _write_values(axes, bars, low, high)
    axes.axvline(0.0, color="0.3", linewidth=0.8)
    axes.axhline(len(bars) - 1.5, color="0.3", linewidth=0.8)


def _write_values(
    axes: Axes, bars: np.ndarray, low: np.ndarray, high: np.ndarray
) -> None:
    low = np.minimum(low, 0.0)
    high = np.maximum(high, 0.0)
    span = max(float(high.max() - low.min()), 1e-12)
    digits = max(0, 1 - math.floor(math.log10(span)))
    axes.set_xlim(low.min() - 0.24 * span, high.max() + 0.24 * span)
    for row, bar in enumerate(bars):
        text = "0"
        if round(bar, digits):
            text = f"{bar:+.{digits}f}".replace("-", "−")
        x = high[row] + 0.02 * span
        side = "left"
        if bar < 0:
            x = low[row] - 0.02 * span
            side = "right"
        axes.text(x, row, text, ha=side, va="center", fontsize=9)
