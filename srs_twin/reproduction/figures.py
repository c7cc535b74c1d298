"""The dissertation's figures drawn again from the runs that are there, in the order of the text.

What stands in the file of figures and lacks its runs is left out; nothing is run for a picture but what
`jobs` names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from pydantic import Field

from srs_twin.comparison.compare import compare
from srs_twin.comparison.learning import is_learning
from srs_twin.errors import UnknownNameError
from srs_twin.io.files import data_root
from srs_twin.planning.pictures import following_plot
from srs_twin.reproduction.claims import COLUMNS, Name, RunRequest, load_list
from srs_twin.reproduction.runs import Job, Store, points_of, sweep_of
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.fields import Section
from srs_twin.scenario.loading import parse_scenario
from srs_twin.studies.sweep.plots import draw
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.from_above import plan_view
from srs_twin.viewing.plots.runs import (
    bend_plot,
    error_plot,
    learning_plot,
    speed_plot,
    styled,
    tracking_plot,
)
from srs_twin.viewing.plots.style import finish, panels


class Picture(Section):
    """One figure, and what is run for it."""

    figure: Name
    """As the text counts it: 31a."""
    caption: Name
    """What is shown, and of which runs."""
    draw: Name
    """Which picture."""
    of: Annotated[list[RunRequest], Field(min_length=1, max_length=10)]
    """What is run for it."""
    metric: Name | None = None
    """Of a sweep: what is drawn, by the sweep's own plot of it."""
    names: list[Name] = []
    """Of the runs, where several are drawn over each other."""


def load_pictures(path: Path | None = None) -> tuple[Picture, ...]:
    """Load a file of figures, the shipped one by default.

    Raises:
        InputError: not readable.
        InputFileError: everything that is wrong with it, one line each.
    """
    place = path or data_root() / "calibration/published/figures.yaml"
    document, pictures = load_list(place, Picture, "figures")
    for i, picture in pictures:
        for k, runs in enumerate(picture.of):
            runs.check_names(document, (i, "of", k))
        if picture.draw not in DRAWINGS:
            document.report((i, "draw"), str(UnknownNameError("picture", picture.draw, DRAWINGS)))
    document.finish()
    return tuple(picture for _, picture in pictures)


def jobs(pictures: tuple[Picture, ...], store: Store) -> list[Job]:
    """Return what pictures need to be run."""
    return [job for picture in pictures for runs in picture.of for job in store.jobs(runs)]


def drawn(pictures: tuple[Picture, ...], store: Store) -> Iterator[tuple[Picture, Figure]]:
    """Yield the pictures whose runs are there, and have what they show."""
    for picture in pictures:
        if all(store.row(job.key) is not None for job in jobs((picture,), store)):
            figure = DRAWINGS[picture.draw](store, picture)
            if figure is not None:
                yield picture, figure


Trajectories = Mapping[str, Trajectory]
Drawing = Callable[[Store, Picture], Figure | None]


def _trajectories(store: Store, runs: RunRequest) -> Trajectories:
    """Return plant → trajectory of a scenario that was run."""
    (job,) = store.jobs(runs)
    found = {plant: store.trajectory(job.key, plant) for plant in COLUMNS[:2]}
    return {plant: run for plant, run in found.items() if run is not None}


def _of_runs(plot: Callable[[Trajectories], Figure]) -> Drawing:
    """Return what draws runs by a plot that needs nothing else."""
    return lambda store, picture: plot(_trajectories(store, picture.of[0]))


def _of_robot(plot: Callable[[Trajectories, RobotSpec], Figure | None]) -> Drawing:
    """Return what draws runs by a plot that needs the robot as well."""

    def drawing(store: Store, picture: Picture) -> Figure | None:
        (job,) = store.jobs(picture.of[0])
        assert job.experiment is not None, "scenarios only"
        return plot(_trajectories(store, picture.of[0]), parse_scenario(job.experiment.base).robot)

    return drawing


def _difference(runs: Trajectories, robot: RobotSpec) -> Figure | None:
    """Draw the difference of the body shapes over time (Fig. 27, 28)."""
    return error_plot(compare(runs["analytical"], runs["twin"]), robot) if len(runs) == 2 else None


def _learning(store: Store, picture: Picture) -> Figure | None:
    """Draw amplitudes, targets and duties by period (Fig. 48, 50)."""
    runs = _trajectories(store, picture.of[0])
    return learning_plot(runs) if all(map(is_learning, runs.values())) else None


def _sweep(store: Store, picture: Picture) -> Figure:
    """Draw a metric as the sweep's own file does (Fig. 31 to 33, 38, 39, 41, 44)."""
    (runs,) = picture.of
    sweep, points = sweep_of(runs.name), points_of(runs)
    rows = [store.row(job.key) for job in store.jobs(runs)]
    columns: dict[str, list[Any]] = {"status": ["done" if row else "failed" for row in rows]}
    columns |= {name: [point.changes[name] for point in points] for name in sweep.fields}
    for metric in dict.fromkeys(name for row in rows if row for name in row.values):
        columns[metric] = [row.values.get(metric) if row else None for row in rows]
    return draw(next(plot for plot in sweep.plots if plot.metric == picture.metric), columns)


def _over_time(runs: Trajectories, value: Callable[[Trajectory], np.ndarray], label: str) -> Figure:
    figure, (axes,) = panels(3.0)
    for style, run in styled(runs):
        axes.plot(run.time, value(run), **style.line)
    finish(axes, label, "time (s)")
    axes.legend(loc="best", fontsize=8, frameon=False)
    return figure


def _tail(runs: Trajectories) -> Figure:
    """Draw the heading of the tail over time (Fig. 30)."""
    return _over_time(runs, lambda run: run.stack("theta")[:, -1], "tail's heading (rad)")


def _readings(runs: Trajectories) -> Figure:
    """Draw what the embedded sensors read beside the bends (Fig. 40, 47)."""
    count = next(iter(runs.values())).stack("bend").shape[1]
    figure, rows = panels(1.2 + 1.3 * count, count, share_y=True)
    for style, run in styled(runs):
        seen = run.time >= run.time[-1] - 2.0
        for j, axes in enumerate(rows, start=1):
            axes.plot(run.time[seen], run[f"sensed_{j}"][seen], color=style.color, linewidth=0.5, alpha=0.4)
            axes.plot(run.time[seen], run[f"bend_{j}"][seen], **style.line)
            finish(axes, f"$q_{{{j}}}$ (rad)")
    rows[0].set_title("Bends, and what the sensors read (thin)", fontsize=10)
    rows[0].legend(loc="upper right", fontsize=8, frameon=False, ncols=2)
    rows[-1].set_xlabel("time (s)")
    return figure


def _step(runs: Trajectories, robot: RobotSpec) -> Figure:
    """Draw the step to 8 psi beside Eq. 14 with the robot's time constants, the published ones (Fig. 20)."""
    figure = _over_time(runs, lambda run: run["bend_1"], "bend (rad)")
    axes, slow, fast = figure.axes[0], robot.actuator.tau_fill, robot.actuator.tau_mode
    time = np.linspace(0, 1, 400)
    shape = 1 - (slow * np.exp(-time / slow) - fast * np.exp(-time / fast)) / (slow - fast)
    final = float(runs["analytical"]["bend_1"][-1])
    axes.plot(time, final * shape, color="0.2", linestyle=":", linewidth=1.0, label="Eq. 14 (E1, E2)")
    axes.set_xlim(0, 1)
    axes.legend(loc="lower right", fontsize=8, frameon=False)
    return figure


def _paths(store: Store, picture: Picture) -> Figure:
    """Draw the paths of several runs over each other, each with its name (Fig. 34, 37)."""
    figure, (axes,) = panels(4.5)
    colors = colormaps["viridis"](np.linspace(0.0, 0.9, len(picture.of)))
    for name, color, runs in zip(picture.names, colors, picture.of, strict=True):
        for style, run in styled(_trajectories(store, runs)):
            axes.plot(*run.com.T, color=color, linestyle=style.dash, label=f"{name}, {style.label}")
    axes.set_aspect("equal", adjustable="datalim")
    finish(axes, "y (m)", "x (m)", title="Paths of the centre of mass")
    axes.legend(loc="best", fontsize=7, frameon=False)
    return figure


def _success(store: Store, picture: Picture) -> Figure:
    """Draw the planner's success against the number of obstacles (Fig. 55)."""
    (job,) = store.jobs(picture.of[0])
    row = store.row(job.key)
    shares = {count: row.values.get(f"alone.count_{count}") for count in range(1, 19)} if row else {}
    known = {count: share for count, share in shares.items() if share is not None}
    figure, (axes,) = panels(3.2)
    axes.plot([*known], [*known.values()], color="0.2", marker="o", markersize=4)
    axes.set_ylim(0, 1.05)
    title = "The text's greedy search, 50 draws each"
    finish(axes, "share of draws with a path", "obstacles", title=title)
    return figure


DRAWINGS: Mapping[str, Drawing] = {
    "above": _of_robot(plan_view),
    "bends": _of_runs(bend_plot),
    "difference": _of_robot(_difference),
    "learning": _learning,
    "paths": _paths,
    "plan": _of_robot(following_plot),
    "readings": _of_runs(_readings),
    "speed": _of_runs(speed_plot),
    "step": _of_robot(_step),
    "success": _success,
    "sweep": _sweep,
    "tail": _of_runs(_tail),
    "tracking": _of_runs(tracking_plot),
}
"""What figures.yaml names as `draw`."""
