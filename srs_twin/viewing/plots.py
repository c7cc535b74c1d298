"""Plots of a run over time: bends, pressures, speed, differences. Both plants in every one.

Made with matplotlib's object-oriented interface, so that nothing is shared between figures. Lines differ in
colour (safe for the colour-blind), in dash and in width: they can be told apart in grey print.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from srs_twin.spec import RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.colors import style_of
from srs_twin.viewing.figures import finish, panels
from srs_twin.viewing.signals import forward_speed, gait_period, period_speed, pressure_difference

if TYPE_CHECKING:
    from srs_twin.comparison.compare import Comparison

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
                time, mean, color=style.color, linestyle=style.dash, linewidth=2.0, zorder=style.zorder,
                label=f"{style.label}, mean of one gait period",
            )  # fmt: skip
        else:
            axes.plot(
                run.time, momentary, color=style.color, linestyle=style.dash, linewidth=style.width,
                label=f"{style.label}, along the heading",
            )  # fmt: skip
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
                run.time[seen], signals[plant][seen, j],
                color=style.color, linestyle=style.dash, linewidth=style.width, label=style.label,
                zorder=style.zorder,
            )  # fmt: skip
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
