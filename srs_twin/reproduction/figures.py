"""The dissertation's figures drawn again: which runs each needs, and how it is drawn.

Mostly by the plots of `viewing`; some that only the dissertation has are drawn here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from srs_twin.comparison.compare import compare
from srs_twin.comparison.learning import is_learning
from srs_twin.reproduction.claims import COLUMNS, Measure, Setting, Value
from srs_twin.reproduction.runs import Order, Orders, Store
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario import parse_scenario
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.plan_view import following_plot, plan_view
from srs_twin.viewing.plots.runs import (
    bend_plot,
    error_plot,
    learning_plot,
    speed_plot,
    styled,
    tracking_plot,
)
from srs_twin.viewing.plots.style import finish, panels
from srs_twin.viewing.plots.sweep_table import Plot
from srs_twin.viewing.plots.sweeps import draw

Runs = Mapping[str, Trajectory]


@dataclass(frozen=True)
class StoredRuns:
    """Runs that pictures are drawn from.

    Attributes:
        store: what was run.
        orders: makes the keys.
    """

    store: Store
    orders: Orders

    def has(self, measure: Measure) -> bool:
        """Say whether all runs of a measure are there."""
        return all(self.store.row(order.key) is not None for order in self.orders.of(measure))

    def runs(self, measure: Measure) -> Runs:
        """Return plant → trajectory of a scenario that was run."""
        (order,) = self.orders.of(measure)
        found = {plant: self.store.trajectory(order.key, plant) for plant in COLUMNS[:2]}
        return {plant: run for plant, run in found.items() if run is not None}

    def robot(self, measure: Measure) -> RobotSpec:
        """Return the robot of a scenario that was run."""
        (order,) = self.orders.of(measure)
        assert order.experiment is not None, "scenarios only"
        return parse_scenario(order.experiment.base).robot

    def table(self, measure: Measure) -> dict[str, list[Any]]:
        """Return the columns of a sweep as pictures of sweeps take them."""
        points, orders = self.orders.points(measure), self.orders.of(measure)
        rows = [self.store.row(order.key) for order in orders]
        columns: dict[str, list[Any]] = {"status": ["done" if row else "failed" for row in rows]}
        for name in self.orders.sweep(measure.name).fields:
            columns[name] = [point.changes[name] for point in points]
        for metric in dict.fromkeys(name for row in rows if row for name in row.values):
            columns[metric] = [row.values.get(metric) if row else None for row in rows]
        return columns

    def number(self, measure: Measure, name: str) -> float | None:
        """Return a number that a computation gave."""
        (order,) = self.orders.of(measure)
        row = self.store.row(order.key)
        return None if row is None else row.values.get(name)


@dataclass(frozen=True)
class Picture:
    """One figure.

    Attributes:
        number: as the text counts it: "Fig. 31".
        caption: what is shown, and from which runs.
        needs: measures whose runs it is drawn from.
        draw: makes it; None where the runs lack what it shows.
    """

    number: str
    caption: str
    needs: tuple[Measure, ...]
    draw: Callable[[StoredRuns, tuple[Measure, ...]], Figure | None]


def wanted(pictures: tuple[Picture, ...], orders: Orders) -> list[Order]:
    """Return what pictures need to be run."""
    return [order for picture in pictures for measure in picture.needs for order in orders.of(measure)]


def drawn(pictures: tuple[Picture, ...], source: StoredRuns) -> list[tuple[Picture, Figure]]:
    """Return the pictures whose runs are there."""
    made = []
    for picture in pictures:
        if all(map(source.has, picture.needs)):
            figure = picture.draw(source, picture.needs)
            if figure is not None:
                made.append((picture, figure))
    return made


Draw = Callable[[StoredRuns, tuple[Measure, ...]], "Figure | None"]
Needs = tuple[Measure, ...]


def _of_runs(plot: Callable[[Runs], Figure]) -> Draw:
    """Return what draws runs by a plot that needs nothing else."""
    return lambda source, needs: plot(source.runs(needs[0]))


def _of_robot(plot: Callable[[Runs, RobotSpec], Figure | None]) -> Draw:
    """Return what draws runs by a plot that needs the robot as well."""
    return lambda source, needs: plot(source.runs(needs[0]), source.robot(needs[0]))


bends, speed, tracking = _of_runs(bend_plot), _of_runs(speed_plot), _of_runs(tracking_plot)
above, plan = _of_robot(plan_view), _of_robot(following_plot)


def _differences(runs: Runs, robot: RobotSpec) -> Figure | None:
    """Draw the difference of the body shapes over time (Fig. 27, 28)."""
    return error_plot(compare(runs["analytical"], runs["twin"]), robot) if len(runs) == 2 else None


def _learnt(source: StoredRuns, needs: Needs) -> Figure | None:
    """Draw amplitudes, targets and duties by period (Fig. 48, 50)."""
    runs = source.runs(needs[0])
    return learning_plot(runs) if all(map(is_learning, runs.values())) else None


def sweep(
    kind: Literal["contour", "line"], x: str, metric: str, y: str | None = None, by: str | None = None
) -> Draw:
    """Return what draws a metric of a sweep (Fig. 13, 31 to 33, 38, 39, 41, 44)."""
    plot = Plot(kind=kind, x=x, metric=metric, y=y, by=by)
    return lambda source, needs: draw(plot, source.table(needs[0]))


def _over_time(runs: Runs, value: Callable[[Trajectory], np.ndarray], label: str) -> Figure:
    figure, (axes,) = panels(3.0)
    for style, run in styled(runs):
        axes.plot(run.time, value(run), **style.line)
    finish(axes, label, "time (s)")
    axes.legend(loc="best", fontsize=8, frameon=False)
    return figure


def _tail_angle(runs: Runs) -> Figure:
    """Draw the heading of the tail over time (Fig. 30)."""
    return _over_time(runs, lambda run: run.stack("theta")[:, -1], "tail's heading (rad)")


def _readings(runs: Runs) -> Figure:
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


def _step(runs: Runs, robot: RobotSpec) -> Figure:
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


def _paths(source: StoredRuns, needs: Needs, *, names: tuple[str, ...]) -> Figure:
    """Draw the paths of several runs over each other, each with its name (Fig. 34, 37)."""
    figure, (axes,) = panels(4.5)
    colors = colormaps["viridis"](np.linspace(0.0, 0.9, len(needs)))
    for name, color, measure in zip(names, colors, needs, strict=True):
        for style, run in styled(source.runs(measure)):
            axes.plot(*run.com.T, color=color, linestyle=style.dash, label=f"{name}, {style.label}")
    axes.set_aspect("equal", adjustable="datalim")
    finish(axes, "y (m)", "x (m)", title="Paths of the centre of mass")
    axes.legend(loc="best", fontsize=7, frameon=False)
    return figure


def _success(source: StoredRuns, needs: Needs) -> Figure:
    """Draw the planner's success against the number of obstacles (Fig. 55)."""
    shares = {count: source.number(needs[0], f"alone.count_{count}") for count in range(1, 19)}
    known = {count: share for count, share in shares.items() if share is not None}
    figure, (axes,) = panels(3.2)
    axes.plot([*known], [*known.values()], color="0.2", marker="o", markersize=4)
    axes.set_ylim(0, 1.05)
    title = "The text's greedy search, 50 draws each"
    finish(axes, "share of draws with a path", "obstacles", title=title)
    return figure


def _run(name: str, changes: Mapping[str, Setting] | None = None) -> Measure:
    return Measure(scenario=name, metric="whole", set=dict(changes or {}))


def _sweep(name: str, **where: Value) -> Measure:
    return Measure(sweep=name, metric="whole", where=where)


_STEP = _run("module_static", {"supply.pressure_kpa": 55.158056, "record_hz": 1000, "duration_s": 2.5})
_GEN1, _HALL4 = _run("gen1_straight"), _run("gen4_straight", {"sensor.kind": "hall"})
_SPREADS = {"gain_spread": 0.1, "tau_spread": 0.1, "bias_spread_rad": 0.05}
_UNEQUAL = _run("gen1_straight", {f"robot.modules.{name}": value for name, value in _SPREADS.items()})
_FAST3 = _run("gen3_straight", {"controller.frequency_hz": 2.0, "sensor.kind": "hall"})
_FREQUENCY, _PRESSURE = "controller.frequency_hz", "supply.pressure_kpa"
_SIMPLIFIED = {"plants.analytical.model": "simplified"}
_MAPS = {
    ("31a", "fig31"): "gen 1 over the whole map, analytical",
    ("31", "fig31_coarse"): "gen 1 over few points, both plants",
    ("32a, c", "fig32"): "gen 2 straight, complete model and twin",
    ("32b", "fig32_simplified"): "gen 2 straight, simplified model",
    ("33a, c", "fig33"): "gen 2 at offset 0.4, complete model and twin",
    ("33b", "fig33_simplified"): "gen 2 at offset 0.4, simplified model",
}
_RADII = {
    ("33d, f", "fig33"): "gen 2 at offset 0.4, complete model and twin",
    ("33e", "fig33_simplified"): "gen 2 at offset 0.4, simplified model",
}
_TRACKED = {
    ("42", "step"): "a step of 25°",
    ("43a", "sine_025hz"): "a sine of 0.25 Hz",
    ("43b", "sine_1hz"): "a sine of 1 Hz",
    ("43c", "sine_4hz"): "a sine of 4 Hz",
    ("43d, 45", "sine_6hz"): "a sine of 6 Hz",
    ("46", "square_2hz"): "a square wave of 2 Hz",
}
_PLANNED = {
    ("53", "plan_fig53"): "The example of the text's planner, and both plants following",
    ("54b", "plan_fig54_3"): "Planned among 3 obstacles",
    ("54c", "plan_fig54_5"): "Planned among 5 obstacles",
    ("54d", "plan_fig54_5_failed"): "The text's search fails among 5 obstacles",
    ("54e", "plan_fig54_8"): "Planned among 8 obstacles",
}
_FOLLOWED = {
    ("56", "follow_fig56"): "A given path is followed",
    ("57", "follow_fig57"): "Planned and followed among four obstacles",
    ("59", "follow_gen4_a"): "Gen 4, goal at 60°",
    ("60", "follow_gen4_b"): "Gen 4, gaps too narrow",
    ("61", "follow_gen4_c"): "Gen 4, an S through gaps",
}
_OFFSETS = (-0.2, -0.1, 0.0, 0.1, 0.2)
_SMC = ("direct", "iterative")
_STUDY = Measure(law="planner_success", metric="whole", set={"planner": "greedy", "draws": 50})


def _one(number: str, caption: str, need: Measure, draws: Draw) -> Picture:
    return Picture(f"Fig. {number}", caption, (need,), draws)


def _maps(named: Mapping[tuple[str, str], str], what: str, metric: str) -> list[Picture]:
    """Return contours of a metric over frequency and pressure."""
    draws = sweep("contour", _FREQUENCY, metric, y=_PRESSURE)
    return [
        _one(number, f"{what} of {runs} (sweep {name})", _sweep(name), draws)
        for (number, name), runs in named.items()
    ]


def _plans(named: Mapping[tuple[str, str], str]) -> list[Picture]:
    return [_one(number, caption, _run(name), plan) for (number, name), caption in named.items()]


_SPEEDS = sweep("line", _FREQUENCY, "com_speed_m_s", by="controller.offset")
_YAW_RATES = sweep("line", _FREQUENCY, "yaw_rate_rad_s", by="controller.offset")
_OVER_REFERENCE = partial(sweep, "line", "controller.reference.frequency_hz")
PICTURES: tuple[Picture, ...] = (
    _one("20", "The actuator's step to 8 psi", _STEP, _of_robot(_step)),
    _one("21, 29", "Speed of gen 1", _GEN1, speed),
    _one("24", "Bends of gen 1 with modules that differ", _UNEQUAL, bends),
    _one("25, 26", "Bends of gen 1 with equal modules", _GEN1, bends),
    _one("27, 28", "Difference of the bodies, gen 1", _GEN1, _of_robot(_differences)),
    _one("30", "Heading of gen 1's tail", _GEN1, _of_runs(_tail_angle)),
    *_maps(_MAPS, "Speed", "com_speed_m_s"),
    *_maps(_RADII, "Turning radius", "turning_radius_m"),
    Picture(
        "Fig. 34",
        "Gen 2, offset 0.4, 2 Hz, 54 kPa: both models and the twin",
        (_run("gen2_turn", {_PRESSURE: 54.0}), _run("gen2_turn", {_PRESSURE: 54.0, **_SIMPLIFIED})),
        partial(_paths, names=("complete", "simplified")),
    ),
    _one("36", "Gen 3 at offset 0.2, 0.9 Hz, from above", _run("gen3_turn"), above),
    Picture(
        "Fig. 37",
        "Gen 3, 0.9 Hz, five offsets",
        tuple(_run("gen3_turn", {"controller.offset": offset}) for offset in _OFFSETS),
        partial(_paths, names=tuple(f"offset {offset:g}" for offset in _OFFSETS)),
    ),
    _one("38", "Speed of gen 3 over frequency (sweep fig38)", _sweep("fig38"), _SPEEDS),
    _one("39", "Yaw rate of gen 3 over frequency (sweep fig39)", _sweep("fig39"), _YAW_RATES),
    _one("40", "Gen 3 at 2 Hz: bends, and the Hall sensors' readings", _FAST3, _of_runs(_readings)),
    _one(
        "41",
        "Static bend over pressure (sweep fig41)",
        _sweep("fig41"),
        sweep("line", _PRESSURE, "final_bend_rad", by="controller.plus"),
    ),
    *(
        _one(number, f"One module, {what}, {kind} SMC", _run(f"module_{name}_{kind}"), tracking)
        for (number, name), what in _TRACKED.items()
        for kind in _SMC
    ),
    *(
        _one(f"44{panel}", f"Closed loop over frequency, {kind} SMC", _sweep(f"fig44_{kind}", seed=0), draws)
        for panel, draws in (("a", _OVER_REFERENCE("amplitude_rel")), ("b", _OVER_REFERENCE("phase_lag_rad")))
        for kind in _SMC
    ),
    _one("47", "Gen 4 in the open loop: bends, and the sensors' readings", _HALL4, _of_runs(_readings)),
    _one("48", "Learning to go straight: what is learnt", _run("ilc_straight"), _learnt),
    _one("49", "Learning to go straight: the path", _run("ilc_straight"), above),
    _one("50", "Learning to go a curve: what is learnt", _run("ilc_curve"), _learnt),
    _one("51", "Learning to go a curve: the path", _run("ilc_curve"), above),
    *_plans(_PLANNED),
    _one("55", "Success of the text's search over obstacles", _STUDY, _success),
    *_plans(_FOLLOWED),
    _one("58", "What gen 4 sweeps on a curve", _run("ilc_curve"), above),
)
"""In the order of the text."""
