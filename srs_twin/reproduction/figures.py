"""Figures of the dissertation, drawn from finished runs.

A figure is omitted if its runs are missing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from pydantic import Field

from srs_twin.comparison.compare import compare
from srs_twin.errors import UnknownNameError
from srs_twin.io.files import data_root
from srs_twin.planning.pictures import following_plot
from srs_twin.reproduction.claims import COLUMNS, Name, RunRequest, load_list
from srs_twin.reproduction.runs import ReproductionJob, RunStore, points_of, sweep_of
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.fields import Section
from srs_twin.scenario.loading import parse_scenario
from srs_twin.studies.sweep.plots import draw
from srs_twin.studies.sweep.table import SweepTable
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.from_above import plan_view
from srs_twin.viewing.plots.runs import (
    bend_plot,
    error_plot,
    learning_plot,
    runs_with_styles,
    speed_plot,
    tracking_plot,
)
from srs_twin.viewing.plots.style import (
    add_legend,
    finish,
    finish_floor,
    own_settings,
    panels,
)


class FigureEntry(Section):
    """Figure of the dissertation, with the runs from which it is drawn."""

    figure: Name
    """Number of the figure in the dissertation, for example 31a."""
    caption: Name
    draw: Name
    """Kind of drawing, which is a key of `DRAWINGS`."""
    of: Annotated[list[RunRequest], Field(min_length=1, max_length=10)]
    """Runs that the figure shows."""
    metric: Name | None = None
    """Metric that is plotted if the figure shows a sweep."""
    names: list[Name] = []
    """Labels of the runs if the figure shows several runs."""


def load_figures(path: Path | None = None) -> tuple[FigureEntry, ...]:
    """Load figure entries from a file, by default from the shipped file.

    Raises:
        InputError: the file cannot be read.
        InputFileError: the file is invalid. The message lists all problems.
    """
    file = path or data_root() / "calibration/published/figures.yaml"
    document, entries = load_list(file, FigureEntry, "figures")
    for i, entry in entries:
        for k, runs in enumerate(entry.of):
            runs.check_names(document, (i, "of", k))
        if entry.draw not in DRAWINGS:
            document.report(
                (i, "draw"), str(UnknownNameError("picture", entry.draw, DRAWINGS))
            )
    document.raise_problems()
    return tuple(entry for _, entry in entries)


def figure_jobs(
    entries: tuple[FigureEntry, ...], store: RunStore
) -> list[ReproductionJob]:
    """Return the jobs whose results the figures show."""
    return [job for entry in entries for runs in entry.of for job in store.jobs(runs)]


def draw_figures(
    entries: tuple[FigureEntry, ...], store: RunStore
) -> Iterator[tuple[FigureEntry, Figure]]:
    """Yield the figures whose runs are finished and contain the required data."""
    for entry in entries:
        if all(store.row(job.key) is not None for job in figure_jobs((entry,), store)):
            with own_settings():
                figure = DRAWINGS[entry.draw](store, entry)
            if figure is not None:
                yield entry, figure


Trajectories = Mapping[str, Trajectory]
Drawing = Callable[[RunStore, FigureEntry], Figure | None]


def _trajectories(store: RunStore, runs: RunRequest) -> Trajectories:
    (job,) = store.jobs(runs)
    trajectories = {plant: store.trajectory(job.key, plant) for plant in COLUMNS[:2]}
    return {plant: run for plant, run in trajectories.items() if run is not None}


def _from_runs(plot: Callable[[Trajectories], Figure | None]) -> Drawing:
    return lambda store, entry: plot(_trajectories(store, entry.of[0]))


def _from_runs_and_robot(
    plot: Callable[[Trajectories, RobotSpec], Figure | None],
) -> Drawing:
    def drawing(store: RunStore, entry: FigureEntry) -> Figure | None:
        (job,) = store.jobs(entry.of[0])
        assert job.experiment is not None, "only for scenarios"
        return plot(
            _trajectories(store, entry.of[0]), parse_scenario(job.experiment.base).robot
        )

    return drawing


def _difference(runs: Trajectories, robot: RobotSpec) -> Figure | None:
    if len(runs) == 2:
        return error_plot(compare(runs["analytical"], runs["twin"]), robot)
    return None


def _sweep(store: RunStore, entry: FigureEntry) -> Figure:
    (runs,) = entry.of
    sweep = sweep_of(runs.name)
    points = points_of(runs)
    rows = [store.row(job.key) for job in store.jobs(runs)]
    columns: dict[str, list[object]] = {
        "status": ["done" if row else "failed" for row in rows]
    }
    for name in sweep.fields:
        columns[name] = [point.changes[name] for point in points]
    values = [row.values if row else {} for row in rows]
    for metric in dict.fromkeys(name for own in values for name in own):
        columns[metric] = [own.get(metric) for own in values]
    plot = next(plot for plot in sweep.plots if plot.metric == entry.metric)
    return draw(plot, SweepTable(columns))


def _over_time(
    runs: Trajectories, value: Callable[[Trajectory], np.ndarray], label: str
) -> Figure:
    figure, (axes,) = panels(3.0)
    for style, run in runs_with_styles(runs):
        axes.plot(run.time, value(run), **style.line)
    finish(axes, label, "time (s)")
    add_legend(axes)
    return figure


def _tail(runs: Trajectories) -> Figure:
    return _over_time(
        runs, lambda run: run.stack("connector_heading")[:, -1], "tail's heading (rad)"
    )


def _readings(runs: Trajectories) -> Figure:
    count = next(iter(runs.values())).stack("bend").shape[1]
    figure, rows = panels(1.2 + 1.3 * count, count, sharey=True)
    for style, run in runs_with_styles(runs):
        last_seconds = run.time >= run.time[-1] - 2.0
        time = run.time[last_seconds]
        for j, axes in enumerate(rows, start=1):
            readings = run[f"measured_bend_{j}"][last_seconds]
            bends = run[f"bend_{j}"][last_seconds]
            axes.plot(time, readings, color=style.color, linewidth=0.5, alpha=0.4)
            axes.plot(time, bends, **style.line)
            finish(axes, f"$q_{{{j}}}$ (rad)")
    rows[0].set_title("Bends, and sensor readings (thin)", fontsize=10)
    add_legend(rows[0], "upper right", ncols=2)
    rows[-1].set_xlabel("time (s)")
    return figure


def _step(runs: Trajectories, robot: RobotSpec) -> Figure:
    """Draw the response to a pressure step of 8 psi, and Eq. 14 (Fig. 20).

    Eq. 14 is evaluated with the time constants of the robot's actuator.
    """
    figure = _over_time(runs, lambda run: run["bend_1"], "bend (rad)")
    axes = figure.axes[0]
    slow = robot.actuator.tau_fill
    fast = robot.actuator.tau_mode
    time = np.linspace(0, 1, 400)
    decay = slow * np.exp(-time / slow) - fast * np.exp(-time / fast)
    bend = float(runs["analytical"]["bend_1"][-1]) * (1 - decay / (slow - fast))
    axes.plot(time, bend, ":", color="0.2", linewidth=1.0, label="Eq. 14 (E1, E2)")
    axes.set_xlim(0, 1)
    add_legend(axes, "lower right")
    return figure


def _paths(store: RunStore, entry: FigureEntry) -> Figure:
    figure, (axes,) = panels(4.5)
    colors = colormaps["viridis"](np.linspace(0.0, 0.9, len(entry.of)))
    for name, color, runs in zip(entry.names, colors, entry.of, strict=True):
        for style, run in runs_with_styles(_trajectories(store, runs)):
            axes.plot(
                *run.com.T,
                color=color,
                linestyle=style.dash,
                label=f"{name}, {style.label}",
            )
    finish_floor(axes, "Paths of the centre of mass")
    add_legend(axes, fontsize=7)
    return figure


DRAWINGS: Mapping[str, Drawing] = {
    "above": _from_runs_and_robot(plan_view),
    "bends": _from_runs(bend_plot),
    "difference": _from_runs_and_robot(_difference),
    "learning": _from_runs(learning_plot),
    "paths": _paths,
    "plan": _from_runs_and_robot(following_plot),
    "readings": _from_runs(_readings),
    "speed": _from_runs(speed_plot),
    "step": _from_runs_and_robot(_step),
    "sweep": _sweep,
    "tail": _from_runs(_tail),
    "tracking": _from_runs(tracking_plot),
}
"""Drawing functions, keyed by the value of `draw` in figures.yaml."""
