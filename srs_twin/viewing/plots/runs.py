"""Plots of runs: signals over time, learning, tracking, readings, and what the plants differ by.

Made with matplotlib's object-oriented interface, so that nothing is shared between figures. Lines differ in
colour (safe for the colour-blind), in dash and in width: they can be told apart in grey print.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from srs_twin.comparison.compare import MEASURES
from srs_twin.comparison.learning import PeriodAmplitudes
from srs_twin.comparison.reading import ReadingCurve
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
    finish,
    panels,
    side_by_side,
    style_of,
)

if TYPE_CHECKING:
    from srs_twin.comparison.compare import Attribution, Comparison, MeasuredDifference

Runs = Mapping[str, Trajectory]

_MOST_ROWS = 8
_PERIODS_SHOWN = 4
_MOST_DOTS = 4000
# Signal of a difference from a measured motion, its label, and shown over SI.
_MEASURED = {
    "shape_m": ("shape (mm)", 1e3),
    "path_m": ("CoM path (mm)", 1e3),
    "heading_rad": ("heading (rad)", 1),
}


def bend_plot(trajectories: Runs) -> Figure:
    """Return the bend of every segment over the last gait periods, or the whole run if not periodic."""
    return _by_segment(trajectories, lambda run: run.stack("bend"), "$q_{{{}}}$ (rad)", "Bends")


def pressure_plot(trajectories: Runs) -> Figure:
    """Return p⁺ − p⁻ of every segment over the same time as `bend_plot`."""
    title = "Pressure differences $p^+ - p^-$ (kPa)"
    return _by_segment(trajectories, lambda run: 1e-3 * pressure_difference(run), "segment {}", title)


def speed_plot(trajectories: Runs) -> Figure:
    """Return the centre of mass speed: along the heading, and averaged over a gait period (thick)."""
    figure, (axes,) = panels(3.0)
    for style, run in styled(trajectories):
        period = gait_period(run)
        time, mean = period_speed(run, period) if period else (run.time[:0], run.time[:0])
        momentary = style.line | {"label": f"{style.label}, along the heading"}
        if len(time):
            momentary = {"color": style.color, "linewidth": 0.7, "alpha": 0.35}
        axes.plot(run.time, forward_speed(run), **momentary)
        if len(time):
            thick = style.line | {"label": f"{style.label}, mean of one gait period", "linewidth": 2.0}
            axes.plot(time, mean, **thick, zorder=style.zorder)
    axes.axhline(0.0, color="0.5", linewidth=0.6)
    title = "Speed of the centre of mass, forward positive (thin: momentary, along the heading)"
    finish(axes, "speed (m/s)", "time (s)", title=title)
    axes.legend(loc="best", fontsize=8.5)
    return figure


def error_plot(comparison: Comparison, spec: RobotSpec) -> Figure:
    """Return the difference of shape and of path over time, in mm and in per cent of the body length."""
    figure, (shape, path) = panels(4.0, 2, right=0.75)
    length = 1e3 * spec.geometry.body_length

    to_share, to_length = (lambda mm: mm * 100 / length), (lambda share: share * length / 100)
    for axes, error in ((shape, comparison.shape_error), (path, comparison.path_error)):
        axes.plot(comparison.time, 1e3 * error, color="0.15", linewidth=1.2)
        axes.set_ylim(0, 1.08e3 * max(float(error.max()), 1e-6))
        share = axes.secondary_yaxis("right", functions=(to_share, to_length))
        share.set_ylabel("% of body length")
    title = "Differences: body shapes (RMS over connectors, CoM frame, zero mean heading) and CoM positions"
    finish(shape, "shape (mm)", title=title)
    finish(path, "CoM distance (mm)", "time (s)")
    return figure


def styled(trajectories: Runs) -> list[tuple[Style, Trajectory]]:
    """Return runs with the styles of their plants."""
    return [(style_of(plant, index), run) for index, (plant, run) in enumerate(trajectories.items())]


def _by_segment(
    trajectories: Runs, signal: Callable[[Trajectory], np.ndarray], label: str, title: str
) -> Figure:
    """Return one panel a segment, head first, at most eight of them spread over the body."""
    signals = [signal(run) for run in trajectories.values()]
    segments = min(values.shape[1] for values in signals)
    shown = np.unique(np.linspace(0, segments - 1, min(segments, _MOST_ROWS)).round().astype(int))
    figure, rows = panels(0.9 + 1.1 * len(shown), len(shown), share_y=True)
    first, last, span = _window(trajectories)
    for axes, j in zip(rows, shown, strict=True):
        for (style, run), values in zip(styled(trajectories), signals, strict=True):
            seen = _seen(run, first, last)
            axes.plot(run.time[seen], values[seen, j], **style.line, zorder=style.zorder)
        finish(axes, label.format(j + 1))
    some = "" if len(shown) == segments else f", {len(shown)} of {segments} segments"
    rows[0].set_title(f"{title}, head first{some}{span}", fontsize=10, loc="left")
    _finish_time(figure, rows, first, last)
    return figure


def _seen(run: Trajectory, first: float, last: float) -> np.ndarray:
    return (run.time >= first - 1e-9) & (run.time <= last + 1e-9)


def _finish_time(figure: Figure, rows: Sequence[Axes], first: float, last: float) -> None:
    """Name the lines of the first panel above it, and show a part of the time."""
    handles, names = rows[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="upper right", ncols=len(names), fontsize=8, frameon=False)
    rows[-1].set_xlabel("time (s)")
    rows[-1].set_xlim(first, last if last > first else first + 1.0)


def _window(trajectories: Runs) -> tuple[float, float, str]:
    """Return begin and end of what is shown of a gait, s, and how to say so in a title."""
    first = min(float(run.time[0]) for run in trajectories.values())
    last = max(float(run.time[-1]) for run in trajectories.values())
    longest = max((gait_period(run) or 0.0 for run in trajectories.values()), default=0.0)
    if not longest or last - first <= (_PERIODS_SHOWN + 1) * longest:
        return first, last, ""
    return last - _PERIODS_SHOWN * longest, last, f" (last {_PERIODS_SHOWN} gait periods)"


def learning_plot(trajectories: Runs) -> Figure:
    """Return a row a module, eight at most: amplitudes with their targets on the left, duties on the right.

    The chambers differ in colour, the plants in dash; targets are thin and dotted.
    """
    runs = [(style, PeriodAmplitudes.from_trajectory(run)) for style, run in styled(trajectories)]
    rows = min(_MOST_ROWS, max(run.duty.shape[1] for _, run in runs))
    figure, grid = side_by_side(
        1.35 * rows + 0.95, 2, rows, left=0.75, right=0.2, top=0.45, space=0.18, sharex=True, sharey="col"
    )
    chambers = {"+": PLUS_COLOR, "\u2212": MINUS_COLOR}
    for j, (bends, duties) in enumerate(grid):
        for style, run in runs:
            periods = np.arange(1, len(run.duty) + 1)
            for side, color in enumerate(chambers.values()):
                line = {"color": color, "linestyle": style.dash, "linewidth": 1.4}
                bends.plot(periods, run.amplitude[:, j, side], **line)
                bends.plot(periods, run.target[:, j, side], color=color, linestyle=":", linewidth=0.8)
                duties.plot(periods, run.duty[:, j, side], **line)
        duties.set_ylim(-0.04, 1.04)
        finish(bends, f"segment {j + 1}\n(rad)")
        finish(duties, "duty")
    grid[0, 0].set_title("Amplitudes (dotted: targets)", fontsize=10, loc="left")
    grid[0, 1].set_title("Duties", fontsize=10, loc="left")
    for axes in grid[-1]:
        axes.set_xlabel("period of the chamber")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    keys = [Line2D([], [], color=color, label=f"{side} chamber") for side, color in chambers.items()]
    keys += [Line2D([], [], color="0.4", linestyle=style.dash, label=style.label) for style, _ in runs]
    figure.legend(handles=keys, loc="upper right", ncols=4, fontsize=8, frameon=False)
    return figure


def tracking_plot(trajectories: Runs) -> Figure:
    """Return the first segment's reference, bends and readings, and each plant's valve states.

    Of a periodic reference the last four periods, else the whole run. A valve state is the text's: 1 where
    the valves drive towards positive bends, −1 towards negative ones, 0 where both hold.
    """
    count = len(trajectories)
    figure, (bends, *valves) = panels(2.9 + 0.75 * count, 1 + count, heights=[2.6, *[0.75] * count])
    run = next(iter(trajectories.values()))
    first, last = float(run.time[0]), float(run.time[-1])
    if (period := reference_period(run)) is not None:
        first = max(first, last - _PERIODS_SHOWN * period)
    seen = _seen(run, first, last)
    bends.plot(run.time[seen], run["reference_1"][seen], **REFERENCE.line, zorder=3)
    for (style, run), axes, plant in zip(styled(trajectories), valves, trajectories, strict=True):
        seen = _seen(run, first, last)
        time = run.time[seen]
        if run.has("sensed_1"):
            bends.plot(time, run["sensed_1"][seen], color=style.color, linewidth=0.4, alpha=0.3)
        bends.plot(time, run["bend_1"][seen], **style.line, zorder=style.zorder)
        state = (run["valve_plus_1"] - run["valve_minus_1"])[seen] / 2
        # A sample's valves led there: they held since the one before.
        axes.step(time, state, where="pre", color=style.color, linewidth=0.8)
        axes.set(ylim=(-1.3, 1.3), yticks=[-1, 0, 1])
        finish(axes, f"{plant}\nvalves")
    title = "Bend and reference (thin: as sensed), and valve states"
    finish(bends, "$q_1$ (rad)", title=title, loc="left")
    _finish_time(figure, [bends, *valves], first, last)
    return figure


def reading_plot(trajectories: Runs) -> Figure | None:
    """Return single readings (dots) and their mean at each bend, above it mean reading less bend.

    None where no run has a sensor other than an ideal one.
    """
    found = [(style, run, ReadingCurve.from_trajectory(run)) for style, run in styled(trajectories)]
    drawn = [(style, run, curve) for style, run, curve in found if curve is not None]
    if not drawn:
        return None
    figure, (read, apart) = panels(4.6, 2)
    every = np.concatenate([curve.bend for _, _, curve in drawn])
    ends = np.degrees([every.min(), every.max()]) if len(every) else np.zeros(2)
    read.plot(ends, ends, **REFERENCE.line | {"label": "bend"})
    for style, run, curve in drawn:
        some = slice(None, None, math.ceil(len(run) / _MOST_DOTS))
        dots = np.degrees(run["bend_1"][some]), np.degrees(run["sensed_1"][some])
        read.plot(*dots, ".", color=style.color, markersize=1.5, alpha=0.3)
        read.plot(np.degrees(curve.bend), np.degrees(curve.reading), **style.line)
        apart.plot(np.degrees(curve.bend), np.degrees(curve.reading - curve.bend), **style.line)
    title = "What the first segment's sensor reads (dots: single readings; lines: their means)"
    finish(read, "sensed (°)", title=title, loc="left")
    finish(apart, "mean less bend (°)", "bend (°)")
    read.legend(loc="upper left", fontsize=8, frameon=False)
    return figure


def measured_plot(differences: Mapping[str, MeasuredDifference]) -> Figure | None:
    """Return the residuals of what was measured of shape, path, heading and bends (RMS over segments).

    None where nothing was measured.
    """
    if not differences:
        return None
    signals = {plant: difference.signals() for plant, difference in differences.items()}
    shown = {
        name: drawn for name, drawn in _MEASURED.items() if all(name in each for each in signals.values())
    }
    figure, rows = panels(0.9 + 1.45 * (len(shown) + 1), len(shown) + 1)
    for index, (plant, difference) in enumerate(differences.items()):
        values = [factor * signals[plant][name] for name, (_, factor) in shown.items()]
        for axes, each in zip(rows, [*values, difference.bend_rms], strict=True):
            axes.plot(difference.comparison.time, each, **style_of(plant, index).line)
    for axes, label in zip(rows, [*(label for label, _ in shown.values()), "bends (rad)"], strict=True):
        finish(axes, label)
    distances = "shapes and paths as distances, " if shown else ""
    rows[0].set_title(f"Plant less measured: {distances}bends RMS over segments", fontsize=10)
    rows[0].legend(loc="upper left", fontsize=8, frameon=False)
    rows[-1].set_xlabel("time (s)")
    return figure


_UP, _DOWN, _REST = "#009E73", "#CC79A7", "#8a8f98"
_ROW = 0.23  # height of a bar and its gap, inches


def attribution_plot(attribution: Attribution) -> Figure:
    """Return one panel a measure: what each assumption contributes, as bars from zero, largest first.

    Thin lines show the least and the most of a share over the orders of switching. Below stands what is not
    explained, and the whole difference, which the bars above it add up to.
    """
    # (measures, shares): contribution, least, most.
    found = (np.array([getattr(s, end) for s in attribution.shares]).T for end in ("value", "low", "high"))
    value, low, high = found
    order = np.argsort(-(np.abs(value) / np.abs(value).max(axis=1, keepdims=True).clip(1e-12)).sum(axis=0))
    names = [*(attribution.shares[i].name for i in order), "not explained", "twin − analytical"]
    rows = len(MEASURES) // 2
    height = rows * (_ROW * len(names) + 0.55) + 0.3
    left = 0.35 + 0.07 * max(map(len, names))  # in, of labels of 9.5 pt
    figure, grid = side_by_side(
        height, 2, rows, left=left, right=0.15, top=0.6, bottom=0.3, space=0.13, sharey=True
    )
    caption = "What each assumption contributes; bars above the line add up to the bar below it"
    figure.suptitle(caption, x=0.01, ha="left", fontsize=11)
    for m, (axes, (title, unit)) in enumerate(zip(grid.flat, MEASURES.values(), strict=True)):
        last = [attribution.remainder[m], attribution.gap[m]]
        bars, ends = np.array([*value[m, order], *last]), np.array([low[m, order], high[m, order]])
        scale, prefix = (1e3, "m") if np.abs(bars).max() < 0.1 else (1.0, "")
        colors = [*np.where(bars[:-2] < 0, _DOWN, _UP), _REST, STYLES["twin"].color]
        axes.barh(range(len(bars)), scale * bars, height=0.65, color=colors)
        axes.hlines(range(len(order)), *scale * ends, color="0.2", linewidth=0.9)
        _write_values(axes, scale * bars, scale * np.hstack([ends, [last, last]]))
        axes.axvline(0.0, color="0.3", linewidth=0.8)
        axes.axhline(len(bars) - 1.5, color="0.3", linewidth=0.8)
        finish(axes, "", title=f"{title} ({prefix}{unit})", loc="left")
    grid[0, 0].set_yticks(range(len(names)), names)
    grid[0, 0].invert_yaxis()
    for axes in grid[:, 0]:
        axes.tick_params(axis="y", labelsize=9.5)
    return figure


def _write_values(axes: Axes, bars: np.ndarray, ends: np.ndarray) -> None:
    """Write each value beyond its bar and its thin line, `ends` (2, bars), with room for it."""
    low, high = np.minimum(ends[0], 0.0), np.maximum(ends[1], 0.0)
    span = max(float(high.max() - low.min()), 1e-12)
    digits = max(0, 1 - math.floor(math.log10(span)))
    axes.set_xlim(low.min() - 0.24 * span, high.max() + 0.24 * span)
    for row, bar in enumerate(bars):
        text = f"{bar:+.{digits}f}".replace("-", "−") if round(bar, digits) else "0"
        place, side = (low[row] - 0.02 * span, "right") if bar < 0 else (high[row] + 0.02 * span, "left")
        axes.text(place, row, text, ha=side, va="center", fontsize=9)
