"""How a module follows its reference, and what its valves do meanwhile (Fig. 42, 43, 45, 46)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from srs_twin.trajectory import Trajectory
from srs_twin.viewing.colors import REFERENCE, style_of
from srs_twin.viewing.figures import finish, panels
from srs_twin.viewing.signals import reference_period

_PERIODS_SHOWN = 4


def tracking_plot(trajectories: Mapping[str, Trajectory]) -> Figure:
    """Return the first segment's reference, bends and readings, and each plant's valve states.

    Of a periodic reference the last four periods, else the whole run. A valve state is the text's: 1 where
    the valves drive towards positive bends, −1 towards negative ones, 0 where both hold.
    """
    figure, rows = panels(2.9 + 0.75 * len(trajectories), 1 + len(trajectories))
    above = figure.add_gridspec(
        2, 1, height_ratios=(2.6, 0.75 * len(trajectories)), left=0.083, right=0.978, hspace=0.12,
        top=1 - 0.42 / figure.get_figheight(), bottom=0.5 / figure.get_figheight(),
    )  # fmt: skip
    below = above[1].subgridspec(len(trajectories), 1, hspace=0.18)
    rows[0].set_subplotspec(above[0])
    for k, axes in enumerate(rows[1:]):
        axes.set_subplotspec(below[k])
    first, last = _window(next(iter(trajectories.values())))
    for index, (plant, run) in enumerate(trajectories.items()):
        style, seen = style_of(plant, index), (run.time >= first - 1e-9) & (run.time <= last + 1e-9)
        time = run.time[seen]
        if index == 0:
            rows[0].plot(
                time, run["reference_1"][seen], color=REFERENCE.color, linestyle=REFERENCE.dash,
                linewidth=REFERENCE.width, label=REFERENCE.label, zorder=3,
            )  # fmt: skip
        if run.has("sensed_1"):
            rows[0].plot(time, run["sensed_1"][seen], color=style.color, linewidth=0.4, alpha=0.3)
        rows[0].plot(
            time, run["bend_1"][seen], color=style.color, linestyle=style.dash, linewidth=style.width,
            label=style.label, zorder=style.zorder,
        )  # fmt: skip
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


def _window(run: Trajectory) -> tuple[float, float]:
    """Return begin and end of what is shown, s."""
    first, last = float(run.time[0]), float(run.time[-1])
    period = reference_period(run)
    return (first if period is None else max(first, last - _PERIODS_SHOWN * period)), last
