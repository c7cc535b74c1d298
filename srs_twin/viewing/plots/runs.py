"""Plots of a run: signals over time, learning, tracking, readings, and what the plants differ by.

Plots of a run over time: bends, pressures, speed, differences. Both plants in every one.

Made with matplotlib's object-oriented interface, so that nothing is shared between figures. Lines differ in
colour (safe for the colour-blind), in dash and in width: they can be told apart in grey print.

What a snake under iterative learning learns: amplitudes, targets and duties by period (Fig. 48, 50).

How a module follows its reference, and what its valves do meanwhile (Fig. 42, 43, 45, 46).

What the first segment's sensor reads over what it is bent by (Fig. 13c, 14e).

How far each plant is from the measured robot, over time.

Waterfall: from the analytical model's value to the twin's, one assumption after another.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from srs_twin.comparison.compare import MEASURES, Attribution
from srs_twin.comparison.learning import ChamberPeriods
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
from srs_twin.viewing.plots.style import MINUS_RGB, PLUS_RGB, REFERENCE, STYLES, finish, panels, style_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srs_twin.comparison.compare import Comparison, MeasuredDifference


_MOST_ROWS = 8
_PERIODS_SHOWN = 4


def bend_plot(trajectories: Mapping[str, Trajectory]) -> Figure:
    """Return the bend of every segment over the last gait periods, or the whole run if not periodic."""
    return _by_segment(trajectories, lambda run: run.stack("bend"), "$q_{{{}}}$ (rad)", "Bends")


def pressure_plot(trajectories: Mapping[str, Trajectory]) -> Figure:
    """Return p⁺ − p⁻ of every segment over the same time as `bend_plot`."""
    return _by_segment(
        trajectories,
        lambda run: 1e-3 * pressure_difference(run),
        "segment {}",
        "Pressure differences $p^+ - p^-$ (kPa)",
    )


def speed_plot(trajectories: Mapping[str, Trajectory]) -> Figure:
    """Return the centre of mass speed: along the heading, and averaged over a gait period (thick)."""
    figure, (axes,) = panels(3.0)
    for index, (plant, run) in enumerate(trajectories.items()):
        style = style_of(plant, index)
        period = gait_period(run)
        time, mean = period_speed(run, period) if period else (run.time[:0], run.time[:0])
        momentary = forward_speed(run)
        if len(time):
            axes.plot(run.time, momentary, color=style.color, linewidth=0.7, alpha=0.35)
            axes.plot(
                time,
                mean,
                color=style.color,
                linestyle=style.dash,
                linewidth=2.0,
                zorder=style.zorder,
                label=f"{style.label}, mean of one gait period",
            )
        else:
            axes.plot(
                run.time,
                momentary,
                color=style.color,
                linestyle=style.dash,
                linewidth=style.width,
                label=f"{style.label}, along the heading",
            )
    axes.axhline(0.0, color="0.5", linewidth=0.6)
    axes.set_title(
        "Speed of the centre of mass, forward positive (thin: momentary, along the heading)", fontsize=10
    )
    finish(axes, "speed (m/s)")
    axes.set_xlabel("time (s)")
    axes.legend(loc="best", fontsize=8.5)
    return figure


def error_plot(comparison: Comparison, spec: RobotSpec) -> Figure:
    """Return the difference of shape and of path over time, in mm and in per cent of the body length."""
    figure, (shape, path) = panels(4.0, 2, right=0.75)
    for axes, error, name in (
        (shape, comparison.shape_error, "shape (mm)"),
        (path, comparison.path_error, "CoM distance (mm)"),
    ):
        axes.plot(comparison.time, 1e3 * error, color="0.15", linewidth=1.2)
        axes.set_ylim(0, 1.08e3 * max(float(error.max()), 1e-6))
        finish(axes, name)
        share = axes.secondary_yaxis("right", functions=_per_cent(1e3 * spec.geometry.body_length))
        share.set_ylabel("% of body length")
    shape.set_title(
        "Differences: body shapes (RMS over connectors, CoM frame, zero mean heading) and CoM positions",
        fontsize=10,
    )
    path.set_xlabel("time (s)")
    return figure


def _by_segment(
    trajectories: Mapping[str, Trajectory], signal: Callable[[Trajectory], np.ndarray], label: str, title: str
) -> Figure:
    """Return one panel a segment, head first, at most eight of them spread over the body."""
    signals = {plant: signal(run) for plant, run in trajectories.items()}
    segments = min(values.shape[1] for values in signals.values())
    shown = np.unique(np.linspace(0, segments - 1, min(segments, _MOST_ROWS)).round().astype(int))
    figure, rows = panels(0.9 + 1.1 * len(shown), len(shown), share_y=True)
    first, last, span = _window(trajectories)
    for axes, j in zip(rows, shown, strict=True):
        for index, (plant, run) in enumerate(trajectories.items()):
            style = style_of(plant, index)
            seen = (run.time >= first - 1e-9) & (run.time <= last + 1e-9)
            axes.plot(
                run.time[seen],
                signals[plant][seen, j],
                color=style.color,
                linestyle=style.dash,
                linewidth=style.width,
                label=style.label,
                zorder=style.zorder,
            )
        finish(axes, label.format(j + 1))
    some = "" if len(shown) == segments else f", {len(shown)} of {segments} segments"
    rows[0].set_title(f"{title}, head first{some}{span}", fontsize=10, loc="left")
    handles, names = rows[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="upper right", ncols=len(names), fontsize=8, frameon=False)
    rows[-1].set_xlabel("time (s)")
    rows[-1].set_xlim(first, last if last > first else first + 1.0)
    return figure


def _window(trajectories: Mapping[str, Trajectory]) -> tuple[float, float, str]:
    """Return begin and end of what is shown of a gait, s, and how to say so in a title."""
    first = min(float(run.time[0]) for run in trajectories.values())
    last = max(float(run.time[-1]) for run in trajectories.values())
    periods = [gait_period(run) for run in trajectories.values()]
    longest = max((p for p in periods if p), default=None)
    if longest is None or last - first <= (_PERIODS_SHOWN + 1) * longest:
        return first, last, ""
    return last - _PERIODS_SHOWN * longest, last, f" (last {_PERIODS_SHOWN} gait periods)"


def _per_cent(whole: float) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Return the functions from a value to per cent of a whole, and back."""
    return (lambda value: value * 100 / whole), (lambda share: share * whole / 100)


_SIDES = ("+", "\u2212")
_COLORS = tuple("#{:02x}{:02x}{:02x}".format(*rgb) for rgb in (PLUS_RGB, MINUS_RGB))
_LEARNING_PLOT_MOST_ROWS = 8
_HEIGHT, _WIDTH, _MARGIN = 1.35, 9.0, 0.95


def learning_plot(trajectories: Mapping[str, Trajectory]) -> Figure:
    """Return a row a module, eight at most: amplitudes with their targets on the left, duties on the right.

    The chambers differ in colour, the plants in dash; targets are thin and dotted.
    """
    runs = {plant: ChamberPeriods.of(run) for plant, run in trajectories.items()}
    rows = min(_LEARNING_PLOT_MOST_ROWS, max(run.duty.shape[1] for run in runs.values()))
    height = _HEIGHT * rows + _MARGIN
    figure = Figure(figsize=(_WIDTH, height))
    panels = figure.subplots(
        rows,
        2,
        sharex=True,
        sharey="col",
        squeeze=False,
        gridspec_kw={
            "left": 0.083,
            "right": 0.978,
            "top": 1 - 0.45 / height,
            "bottom": 0.5 / height,
            "hspace": 0.18,
            "wspace": 0.18,
        },
    )
    for j, (bends, duties) in enumerate(panels):
        for index, (plant, run) in enumerate(runs.items()):
            dash = style_of(plant, index).dash
            for side, color in enumerate(_COLORS):
                _line(bends, run.amplitude[:, j, side], color, dash, 1.4)
                _line(bends, run.target[:, j, side], color, ":", 0.8)
                _line(duties, run.duty[:, j, side], color, dash, 1.4)
        duties.set_ylim(-0.04, 1.04)
        finish(bends, f"segment {j + 1}\n(rad)")
        finish(duties, "duty")
    panels[0, 0].set_title("Amplitudes (dotted: targets)", fontsize=10, loc="left")
    panels[0, 1].set_title("Duties", fontsize=10, loc="left")
    for axes in panels[-1]:
        axes.set_xlabel("period of the chamber")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(handles=_keys(trajectories), loc="upper right", ncols=4, fontsize=8, frameon=False)
    return figure


def _line(axes: Axes, values: np.ndarray, color: str, dash: str, width: float) -> None:
    axes.plot(np.arange(1, len(values) + 1), values, color=color, linestyle=dash, linewidth=width)


def _keys(trajectories: Mapping[str, Trajectory]) -> list[Line2D]:
    chambers = [
        Line2D([], [], color=color, label=f"{side} chamber")
        for side, color in zip(_SIDES, _COLORS, strict=True)
    ]
    styles = [style_of(plant, index) for index, plant in enumerate(trajectories)]
    return chambers + [Line2D([], [], color="0.4", linestyle=each.dash, label=each.label) for each in styles]


_TRACKING_PLOT_PERIODS_SHOWN = 4


def tracking_plot(trajectories: Mapping[str, Trajectory]) -> Figure:
    """Return the first segment's reference, bends and readings, and each plant's valve states.

    Of a periodic reference the last four periods, else the whole run. A valve state is the text's: 1 where
    the valves drive towards positive bends, −1 towards negative ones, 0 where both hold.
    """
    figure, rows = panels(2.9 + 0.75 * len(trajectories), 1 + len(trajectories))
    above = figure.add_gridspec(
        2,
        1,
        height_ratios=(2.6, 0.75 * len(trajectories)),
        left=0.083,
        right=0.978,
        hspace=0.12,
        top=1 - 0.42 / figure.get_figheight(),
        bottom=0.5 / figure.get_figheight(),
    )
    below = above[1].subgridspec(len(trajectories), 1, hspace=0.18)
    rows[0].set_subplotspec(above[0])
    for k, axes in enumerate(rows[1:]):
        axes.set_subplotspec(below[k])
    first, last = _tracking_plot_window(next(iter(trajectories.values())))
    for index, (plant, run) in enumerate(trajectories.items()):
        style, seen = style_of(plant, index), (run.time >= first - 1e-9) & (run.time <= last + 1e-9)
        time = run.time[seen]
        if index == 0:
            rows[0].plot(
                time,
                run["reference_1"][seen],
                color=REFERENCE.color,
                linestyle=REFERENCE.dash,
                linewidth=REFERENCE.width,
                label=REFERENCE.label,
                zorder=3,
            )
        if run.has("sensed_1"):
            rows[0].plot(time, run["sensed_1"][seen], color=style.color, linewidth=0.4, alpha=0.3)
        rows[0].plot(
            time,
            run["bend_1"][seen],
            color=style.color,
            linestyle=style.dash,
            linewidth=style.width,
            label=style.label,
            zorder=style.zorder,
        )
        _valves(rows[1 + index], run, seen, style.color)
        finish(rows[1 + index], f"{plant}\nvalves")
    finish(rows[0], "$q_1$ (rad)")
    rows[0].set_title("Bend and reference (thin: as sensed), and valve states", fontsize=10, loc="left")
    handles, names = rows[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="upper right", ncols=len(names), fontsize=8, frameon=False)
    rows[-1].set_xlabel("time (s)")
    rows[-1].set_xlim(first, last if last > first else first + 1.0)
    return figure


def _valves(axes: Axes, run: Trajectory, seen: np.ndarray, color: str) -> None:
    state = (run["valve_plus_1"] - run["valve_minus_1"])[seen] / 2
    # A sample's valves led there: they held since the one before.
    axes.step(run.time[seen], state, where="pre", color=color, linewidth=0.8)
    axes.set_ylim(-1.3, 1.3)
    axes.set_yticks([-1, 0, 1])


def _tracking_plot_window(run: Trajectory) -> tuple[float, float]:
    """Return begin and end of what is shown, s."""
    first, last = float(run.time[0]), float(run.time[-1])
    period = reference_period(run)
    return (first if period is None else max(first, last - _TRACKING_PLOT_PERIODS_SHOWN * period)), last


_MOST_DOTS = 4000


def reading_plot(trajectories: Mapping[str, Trajectory]) -> Figure | None:
    """Return single readings (dots) and their mean at each bend, above it mean reading less bend.

    None where no run has a sensor other than an ideal one.
    """
    curves = {plant: ReadingCurve.of(run) for plant, run in trajectories.items()}
    drawn = {plant: curve for plant, curve in curves.items() if curve is not None}
    if not drawn:
        return None
    figure, (read, apart) = panels(4.6, 2)
    every = np.concatenate([curve.bend for curve in drawn.values()])
    ends = np.degrees([every.min(), every.max()]) if len(every) else np.zeros(2)
    read.plot(
        ends, ends, color=REFERENCE.color, linewidth=REFERENCE.width, linestyle=REFERENCE.dash, label="bend"
    )
    for index, (plant, curve) in enumerate(drawn.items()):
        style, run = style_of(plant, index), trajectories[plant]
        some = slice(None, None, math.ceil(len(run) / _MOST_DOTS))
        read.plot(
            np.degrees(run["bend_1"][some]),
            np.degrees(run["sensed_1"][some]),
            ".",
            color=style.color,
            markersize=1.5,
            alpha=0.3,
        )
        for axes, values in ((read, curve.reading), (apart, curve.reading - curve.bend)):
            axes.plot(
                np.degrees(curve.bend),
                np.degrees(values),
                color=style.color,
                linestyle=style.dash,
                linewidth=style.width,
                label=style.label,
            )
    finish(read, "sensed (°)")
    finish(apart, "mean less bend (°)")
    read.set_title(
        "What the first segment's sensor reads (dots: single readings; lines: their means)",
        fontsize=10,
        loc="left",
    )
    handles, names = read.get_legend_handles_labels()
    read.legend(handles, names, loc="upper left", fontsize=8, frameon=False)
    apart.set_xlabel("bend (°)")
    return figure


_LABELS = {
    "shape_m": ("shape (mm)", 1e3),
    "path_m": ("CoM path (mm)", 1e3),
    "heading_rad": ("heading (rad)", 1),
}


def measured_plot(differences: Mapping[str, MeasuredDifference]) -> Figure:
    """Return the residuals of what was measured of shape, path, heading and bends (RMS over segments)."""
    signals = {plant: difference.signals() for plant, difference in differences.items()}
    shown = [name for name in _LABELS if all(name in each for each in signals.values())]
    labels = [*(_LABELS[name][0] for name in shown), "bends (rad)"]
    figure, rows = panels(0.9 + 1.45 * len(labels), len(labels))
    for index, (plant, difference) in enumerate(differences.items()):
        style = style_of(plant, index)
        values = [*(_LABELS[name][1] * signals[plant][name] for name in shown), difference.bend_rms]
        for axes, each in zip(rows, values, strict=True):
            axes.plot(
                difference.comparison.time,
                each,
                color=style.color,
                linestyle=style.dash,
                linewidth=style.width,
                label=style.label,
            )
    for axes, label in zip(rows, labels, strict=True):
        finish(axes, label)
    distances = "shapes and paths as distances, " if shown else ""
    rows[0].set_title(f"Plant less measured: {distances}bends RMS over segments", fontsize=10)
    rows[0].legend(loc="upper left", fontsize=8, frameon=False)
    rows[-1].set_xlabel("time (s)")
    return figure


_UP, _DOWN, _REST = "#009E73", "#CC79A7", "#8a8f98"
_LONGEST_NAME = 2.05  # inches


def waterfall(attribution: Attribution) -> Figure:
    """Return one panel a measure; rows are the assumptions, as the shares are listed.

    Bars run from what was reached before to what is reached with one more assumption; thin lines show the
    least and the most of a share over the orders of switching.
    """
    names = [share.name for share in attribution.shares]
    rows = ["analytical", *names, "not explained", "twin"]
    height = 0.75 + 0.24 * len(rows)
    figure = Figure(figsize=(9.0, height))
    panels = figure.subplots(
        1,
        len(MEASURES),
        sharey=True,
        gridspec_kw={
            "left": _LONGEST_NAME / 9.0,
            "right": 0.985,
            "top": 1 - 0.35 / height,
            "bottom": 0.42 / height,
            "wspace": 0.1,
        },
    )
    for m, (axes, (title, unit)) in enumerate(zip(panels, MEASURES.values(), strict=True)):
        _panel(axes, attribution, m, len(rows))
        axes.set_title(title, fontsize=9)
        axes.set_xlabel(unit, fontsize=8)
    panels[0].set_yticks(range(len(rows)), rows, fontsize=8)
    panels[0].invert_yaxis()
    return figure


def _panel(axes: Axes, attribution: Attribution, m: int, rows: int) -> None:
    """Draw measure m."""
    reached = attribution.reference[m]
    # Of a distance there is none to begin with; its bars add up to what lies between the plants.
    levels = [reached]
    axes.barh(0, reached, height=0.6, color=STYLES["analytical"].color)
    parts = [(share.value[m], share.low[m], share.high[m]) for share in attribution.shares]
    parts.append((attribution.remainder[m],) * 3)
    for row, (value, low, high) in enumerate(parts, start=1):
        last = row == rows - 2
        color = _REST if last else _UP if value >= 0 else _DOWN
        axes.barh(row, value, left=reached, height=0.6, color=color, hatch="//" if last else None)
        axes.plot([reached + low, reached + high], [row, row], color="0.2", linewidth=0.8)
        axes.plot([reached + value] * 2, [row - 0.3, row + 1.3], color="0.5", linewidth=0.5)
        reached += value
        levels.append(reached)
    axes.barh(rows - 1, reached, height=0.6, color=STYLES["twin"].color)
    _zoom(axes, levels)
    axes.grid(True, axis="x", linewidth=0.4, alpha=0.5)
    axes.tick_params(labelsize=7)
    axes.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3), useMathText=True)
    axes.xaxis.get_offset_text().set_fontsize(7)


def _zoom(axes: Axes, levels: list[float]) -> None:
    """Show the range in which the steps happen, with zero only where it is not far off."""
    low, high = min(levels), max(levels)
    span = max(high - low, 1e-3 * max(abs(low), abs(high)), 1e-9)
    low, high = low - 0.35 * span, high + 0.35 * span
    axes.set_xlim(
        min(low, 0.0) if min(levels) < span else low, max(high, 0.0) if max(levels) > -span else high
    )
