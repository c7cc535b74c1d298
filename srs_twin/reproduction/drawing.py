"""How figures are drawn: mostly by the plots of `viewing`, some that only the dissertation has by ours."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import numpy as np

from srs_twin.comparison.compare import compare
from srs_twin.comparison.learning import is_learning
from srs_twin.reproduction.claims import Measure
from srs_twin.reproduction.figures import Source
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srs_twin.viewing.sweep_beside import Beside

Draw = Callable[[Source, tuple[Measure, ...]], "Figure | None"]
Needs = tuple[Measure, ...]


def bends(source: Source, needs: Needs) -> Figure | None:
    """Draw the bends of all segments over the last periods (Fig. 24 to 26)."""
    from srs_twin.viewing.plots import bend_plot

    return bend_plot(source.runs(needs[0]))


def speed(source: Source, needs: Needs) -> Figure | None:
    """Draw the speed of the centre of mass (Fig. 21, 29)."""
    from srs_twin.viewing.plots import speed_plot

    return speed_plot(source.runs(needs[0]))


def differences(source: Source, needs: Needs) -> Figure | None:
    """Draw the difference of the body shapes over time (Fig. 27, 28)."""
    from srs_twin.viewing.plots import error_plot

    runs = source.runs(needs[0])
    if len(runs) < 2:
        return None
    return error_plot(compare(runs["analytical"], runs["twin"]), source.robot(needs[0]))


def above(source: Source, needs: Needs) -> Figure | None:
    """Draw paths and bodies from above (Fig. 23, 36, 49, 51, 58)."""
    from srs_twin.viewing.plan_view import plan_view

    return plan_view(source.runs(needs[0]), source.robot(needs[0]))


def tracking(source: Source, needs: Needs) -> Figure | None:
    """Draw how a module follows its reference, and its valves (Fig. 42, 43, 45, 46)."""
    from srs_twin.viewing.tracking_plot import tracking_plot

    return tracking_plot(source.runs(needs[0]))


def learning(source: Source, needs: Needs) -> Figure | None:
    """Draw amplitudes, targets and duties by period (Fig. 48, 50)."""
    from srs_twin.viewing.learning_plot import learning_plot

    runs = source.runs(needs[0])
    return learning_plot(runs) if all(map(is_learning, runs.values())) else None


def plan(source: Source, needs: Needs) -> Figure | None:
    """Draw a plan, and what the snakes made of it (Fig. 53, 54, 56, 57, 59 to 61)."""
    from srs_twin.viewing.following_plot import following_plot

    return following_plot(source.runs(needs[0]), source.robot(needs[0]))


def sweep(
    kind: Literal["contour", "line"], x: str, metric: str, y: str | None = None, by: str | None = None,
    beside: Beside | None = None,
) -> Draw:  # fmt: skip
    """Return what draws a metric of a sweep (Fig. 13, 31 to 33, 38, 39, 41, 44)."""

    def made(source: Source, needs: Needs) -> Figure | None:
        from srs_twin.viewing.sweep_plots import PlotRequest, draw

        return draw(PlotRequest(kind, x, metric, y=y, by=by), source.table(needs[0]), beside)

    return made


def tail_angle(source: Source, needs: Needs) -> Figure | None:
    """Draw the heading of the tail over time (Fig. 30)."""
    return _over_time(source, needs, lambda run: run.stack("theta")[:, -1], "tail's heading (rad)")


def readings(source: Source, needs: Needs) -> Figure | None:
    """Draw what the embedded sensors read beside the bends (Fig. 40, 47)."""
    from srs_twin.viewing.colors import style_of
    from srs_twin.viewing.figures import finish, panels

    runs = source.runs(needs[0])
    count = next(iter(runs.values())).stack("bend").shape[1]
    figure, rows = panels(1.2 + 1.3 * count, count, share_y=True)
    for index, (plant, run) in enumerate(runs.items()):
        style, seen = style_of(plant, index), run.time >= run.time[-1] - 2.0
        for j, axes in enumerate(rows):
            axes.plot(
                run.time[seen], run.stack("sensed")[seen, j], color=style.color, linewidth=0.5, alpha=0.4
            )
            axes.plot(
                run.time[seen], run.stack("bend")[seen, j], color=style.color, linestyle=style.dash,
                linewidth=style.width, label=style.label,
            )  # fmt: skip
    for j, axes in enumerate(rows):
        finish(axes, f"$q_{{{j + 1}}}$ (rad)")
    rows[0].set_title("Bends, and what the sensors read (thin)", fontsize=10)
    rows[0].legend(loc="upper right", fontsize=8, frameon=False, ncols=2)
    rows[-1].set_xlabel("time (s)")
    return figure


def step(source: Source, needs: Needs) -> Figure | None:
    """Draw the step to 8 psi beside Eq. 14 with the robot's time constants, the published ones (Fig. 20)."""
    figure = _over_time(source, needs, lambda run: run["bend_1"], "bend (rad)")
    axes, actuator = figure.axes[0], source.robot(needs[0]).actuator
    slow, fast = actuator.tau_fill, actuator.tau_mode
    time = np.linspace(0, 1, 400)
    shape = 1 - (slow * np.exp(-time / slow) - fast * np.exp(-time / fast)) / (slow - fast)
    final = float(source.runs(needs[0])["analytical"]["bend_1"][-1])
    axes.plot(time, final * shape, color="0.2", linestyle=":", linewidth=1.0, label="Eq. 14 (E1, E2)")
    axes.set_xlim(0, 1)
    axes.legend(loc="lower right", fontsize=8, frameon=False)
    return figure


def paths(*names: str) -> Draw:
    """Return what draws the paths of several runs over each other (Fig. 34, 37).

    Args:
        names: of the runs, in the order of the measures.
    """

    def made(source: Source, needs: Needs) -> Figure | None:
        from matplotlib import colormaps

        from srs_twin.viewing.colors import style_of
        from srs_twin.viewing.figures import finish, panels

        figure, (axes,) = panels(4.5)
        colors = colormaps["viridis"](np.linspace(0.0, 0.9, len(needs)))
        for name, color, measure in zip(names, colors, needs, strict=True):
            for index, (plant, run) in enumerate(source.runs(measure).items()):
                style = style_of(plant, index)
                axes.plot(*run.com.T, color=color, linestyle=style.dash, label=f"{name}, {style.label}")
        axes.set_aspect("equal", adjustable="datalim")
        finish(axes, "y (m)")
        axes.set_xlabel("x (m)")
        axes.set_title("Paths of the centre of mass", fontsize=10)
        axes.legend(loc="best", fontsize=7, frameon=False)
        return figure

    return made


def success(source: Source, needs: Needs) -> Figure | None:
    """Draw the planner's success against the number of obstacles (Fig. 55)."""
    from srs_twin.viewing.figures import finish, panels

    counts = range(1, 19)
    shares = [source.number(needs[0], f"alone.count_{count}") for count in counts]
    known = [(count, share) for count, share in zip(counts, shares, strict=True) if share is not None]
    figure, (axes,) = panels(3.2)
    axes.plot(*zip(*known, strict=True), color="0.2", marker="o", markersize=4)
    axes.set_ylim(0, 1.05)
    finish(axes, "share of draws with a path")
    axes.set_xlabel("obstacles")
    axes.set_title("The text's greedy search, 50 draws each", fontsize=10)
    return figure


def _over_time(source: Source, needs: Needs, value: Callable[[Trajectory], np.ndarray], label: str) -> Figure:
    from srs_twin.viewing.colors import style_of
    from srs_twin.viewing.figures import finish, panels

    figure, (axes,) = panels(3.0)
    for index, (plant, run) in enumerate(source.runs(needs[0]).items()):
        style = style_of(plant, index)
        axes.plot(
            run.time,
            value(run),
            color=style.color,
            linestyle=style.dash,
            linewidth=style.width,
            label=style.label,
        )
    finish(axes, label)
    axes.set_xlabel("time (s)")
    axes.legend(loc="best", fontsize=8, frameon=False)
    return figure
