"""The dissertation's figures drawn again: which runs each needs, and how it is drawn.

How figures are drawn: mostly by the plots of `viewing`, some that only the dissertation has by ours.

PICTURES: which figures of the dissertation are drawn again, from which runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from srs_twin.comparison.compare import compare
from srs_twin.comparison.learning import is_learning
from srs_twin.reproduction.claims import COLUMNS, Measure, Setting, Value
from srs_twin.reproduction.runs import Order, Orders, Store
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srs_twin.viewing.plots.sweep_table import Published


Runs = Mapping[str, Trajectory]


@dataclass(frozen=True)
class Source:
    """What pictures are drawn from.

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
        from srs_twin.scenario import parse_scenario

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
    draw: Callable[[Source, tuple[Measure, ...]], Figure | None]


def wanted(pictures: tuple[Picture, ...], orders: Orders) -> list[Order]:
    """Return what pictures need to be run."""
    return [order for picture in pictures for measure in picture.needs for order in orders.of(measure)]


def drawn(pictures: tuple[Picture, ...], source: Source) -> list[tuple[Picture, Figure]]:
    """Return the pictures whose runs are there."""
    made = []
    for picture in pictures:
        if all(map(source.has, picture.needs)):
            figure = picture.draw(source, picture.needs)
            if figure is not None:
                made.append((picture, figure))
    return made


Draw = Callable[[Source, tuple[Measure, ...]], "Figure | None"]
Needs = tuple[Measure, ...]


def bends(source: Source, needs: Needs) -> Figure | None:
    """Draw the bends of all segments over the last periods (Fig. 24 to 26)."""
    from srs_twin.viewing.plots.runs import bend_plot

    return bend_plot(source.runs(needs[0]))


def speed(source: Source, needs: Needs) -> Figure | None:
    """Draw the speed of the centre of mass (Fig. 21, 29)."""
    from srs_twin.viewing.plots.runs import speed_plot

    return speed_plot(source.runs(needs[0]))


def differences(source: Source, needs: Needs) -> Figure | None:
    """Draw the difference of the body shapes over time (Fig. 27, 28)."""
    from srs_twin.viewing.plots.runs import error_plot

    runs = source.runs(needs[0])
    if len(runs) < 2:
        return None
    return error_plot(compare(runs["analytical"], runs["twin"]), source.robot(needs[0]))


def above(source: Source, needs: Needs) -> Figure | None:
    """Draw paths and bodies from above (Fig. 23, 36, 49, 51, 58)."""
    from srs_twin.viewing.plots.plan_view import plan_view

    return plan_view(source.runs(needs[0]), source.robot(needs[0]))


def tracking(source: Source, needs: Needs) -> Figure | None:
    """Draw how a module follows its reference, and its valves (Fig. 42, 43, 45, 46)."""
    from srs_twin.viewing.plots.runs import tracking_plot

    return tracking_plot(source.runs(needs[0]))


def learning(source: Source, needs: Needs) -> Figure | None:
    """Draw amplitudes, targets and duties by period (Fig. 48, 50)."""
    from srs_twin.viewing.plots.runs import learning_plot

    runs = source.runs(needs[0])
    return learning_plot(runs) if all(map(is_learning, runs.values())) else None


def plan(source: Source, needs: Needs) -> Figure | None:
    """Draw a plan, and what the snakes made of it (Fig. 53, 54, 56, 57, 59 to 61)."""
    from srs_twin.viewing.plots.plan_view import following_plot

    return following_plot(source.runs(needs[0]), source.robot(needs[0]))


def sweep(
    kind: Literal["contour", "line"],
    x: str,
    metric: str,
    y: str | None = None,
    by: str | None = None,
    beside: Published | None = None,
) -> Draw:
    """Return what draws a metric of a sweep (Fig. 13, 31 to 33, 38, 39, 41, 44)."""

    def made(source: Source, needs: Needs) -> Figure | None:
        from srs_twin.viewing.plots.sweep_table import Plot
        from srs_twin.viewing.plots.sweeps import draw

        return draw(Plot(kind=kind, x=x, metric=metric, y=y, by=by), source.table(needs[0]), beside)

    return made


def tail_angle(source: Source, needs: Needs) -> Figure | None:
    """Draw the heading of the tail over time (Fig. 30)."""
    return _over_time(source, needs, lambda run: run.stack("theta")[:, -1], "tail's heading (rad)")


def readings(source: Source, needs: Needs) -> Figure | None:
    """Draw what the embedded sensors read beside the bends (Fig. 40, 47)."""
    from srs_twin.viewing.plots.style import finish, panels, style_of

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
                run.time[seen],
                run.stack("bend")[seen, j],
                color=style.color,
                linestyle=style.dash,
                linewidth=style.width,
                label=style.label,
            )
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

        from srs_twin.viewing.plots.style import finish, panels, style_of

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
    from srs_twin.viewing.plots.style import finish, panels

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
    from srs_twin.viewing.plots.style import finish, panels, style_of

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


def _run(name: str, changes: Mapping[str, Setting] | None = None, periods: float | None = None) -> Measure:
    return Measure("scenario", name, "", changes or {}, periods)


def _sweep(name: str, **where: Value) -> Measure:
    return Measure("sweep", name, "", where=where)


_STEP = _run("module_static", {"supply.pressure_kpa": 55.158056, "record_hz": 1000, "duration_s": 2.5})
_UNEQUAL = _run(
    "gen1_straight",
    {
        "robot.modules.gain_spread": 0.1,
        "robot.modules.tau_spread": 0.1,
        "robot.modules.bias_spread_rad": 0.05,
    },
)
_FAST3 = _run("gen3_straight", {"controller.frequency_hz": 2.0, "sensor.kind": "hall"})
_FREQUENCY, _PRESSURE = "controller.frequency_hz", "supply.pressure_kpa"
_SIMPLIFIED = {"plants.analytical.model": "simplified"}
_CONTOURS = {
    "fig31": ("31a", "gen 1 over the whole map, analytical"),
    "fig31_coarse": ("31", "gen 1 over few points, both plants"),
    "fig32": ("32a, c", "gen 2 straight, complete model and twin"),
    "fig32_simplified": ("32b", "gen 2 straight, simplified model"),
    "fig33": ("33a, c", "gen 2 at offset 0.4, complete model and twin"),
    "fig33_simplified": ("33b", "gen 2 at offset 0.4, simplified model"),
}


def _contours() -> list[Picture]:
    speed = sweep("contour", _FREQUENCY, "com_speed_m_s", y=_PRESSURE)
    radius = sweep("contour", _FREQUENCY, "turning_radius_m", y=_PRESSURE)
    made = [
        Picture(f"Fig. {number}", f"Speed of {what} (sweep {name})", (_sweep(name),), speed)
        for name, (number, what) in _CONTOURS.items()
    ]
    for name, number in (("fig33", "33d, f"), ("fig33_simplified", "33e")):
        what = _CONTOURS[name][1]
        made.append(
            Picture(f"Fig. {number}", f"Turning radius of {what} (sweep {name})", (_sweep(name),), radius)
        )
    return made


def _modules() -> list[Picture]:
    made = []
    for number, name, what in (
        ("42", "step", "a step of 25°"),
        ("43a", "sine_025hz", "a sine of 0.25 Hz"),
        ("43b", "sine_1hz", "a sine of 1 Hz"),
        ("43c", "sine_4hz", "a sine of 4 Hz"),
        ("43d, 45", "sine_6hz", "a sine of 6 Hz"),
        ("46", "square_2hz", "a square wave of 2 Hz"),
    ):
        for kind in ("direct", "iterative"):
            needs = (_run(f"module_{name}_{kind}"),)
            made.append(Picture(f"Fig. {number}", f"One module, {what}, {kind} SMC", needs, tracking))
    for metric, panel in (("amplitude_rel", "a"), ("phase_lag_rad", "b")):
        draw = sweep("line", "controller.reference.frequency_hz", metric)
        for kind in ("direct", "iterative"):
            caption = f"Closed loop over frequency, {kind} SMC"
            made.append(Picture(f"Fig. 44{panel}", caption, (_sweep(f"fig44_{kind}", seed=0),), draw))
    return made


def _offsets() -> list[Picture]:
    line = sweep("line", _FREQUENCY, "com_speed_m_s", by="controller.offset")
    yaw = sweep("line", _FREQUENCY, "yaw_rate_rad_s", by="controller.offset")
    offsets = (-0.2, -0.1, 0.0, 0.1, 0.2)
    needs = tuple(_run("gen3_turn", {"controller.offset": offset}) for offset in offsets)
    names = [f"offset {offset:g}" for offset in offsets]
    return [
        Picture("Fig. 36", "Gen 3 at offset 0.2, 0.9 Hz, from above", (_run("gen3_turn"),), above),
        Picture("Fig. 37", "Gen 3, 0.9 Hz, five offsets", needs, paths(*names)),
        Picture("Fig. 38", "Speed of gen 3 over frequency (sweep fig38)", (_sweep("fig38"),), line),
        Picture("Fig. 39", "Yaw rate of gen 3 over frequency (sweep fig39)", (_sweep("fig39"),), yaw),
        Picture("Fig. 40", "Gen 3 at 2 Hz: bends, and the Hall sensors' readings", (_FAST3,), readings),
    ]


def _learning() -> list[Picture]:
    made = [
        Picture(
            "Fig. 47",
            "Gen 4 in the open loop: bends, and the sensors' readings",
            (_run("gen4_straight", {"sensor.kind": "hall"}),),
            readings,
        )
    ]
    for name, numbers, what in (
        ("ilc_straight", ("48", "49"), "straight"),
        ("ilc_curve", ("50", "51"), "a curve"),
    ):
        needs = (_run(name),)
        made.append(Picture(f"Fig. {numbers[0]}", f"Learning to go {what}: what is learnt", needs, learning))
        made.append(Picture(f"Fig. {numbers[1]}", f"Learning to go {what}: the path", needs, above))
    return made


def _plans() -> list[Picture]:
    made = [
        Picture(f"Fig. {number}", caption, (_run(name),), plan)
        for number, name, caption in (
            ("53", "plan_fig53", "The example of the text's planner, and both plants following"),
            ("54b", "plan_fig54_3", "Planned among 3 obstacles"),
            ("54c", "plan_fig54_5", "Planned among 5 obstacles"),
            ("54d", "plan_fig54_5_failed", "The text's search fails among 5 obstacles"),
            ("54e", "plan_fig54_8", "Planned among 8 obstacles"),
            ("56", "follow_fig56", "A given path is followed"),
            ("57", "follow_fig57", "Planned and followed among four obstacles"),
            ("59", "follow_gen4_a", "Gen 4, goal at 60°"),
            ("60", "follow_gen4_b", "Gen 4, gaps too narrow"),
            ("61", "follow_gen4_c", "Gen 4, an S through gaps"),
        )
    ]
    study = Measure("law", "planner_success", "", {"planner": "greedy", "draws": 50})
    made.insert(5, Picture("Fig. 55", "Success of the text's search over obstacles", (study,), success))
    return made


PICTURES: tuple[Picture, ...] = (
    Picture("Fig. 20", "The actuator's step to 8 psi", (_STEP,), step),
    Picture("Fig. 21, 29", "Speed of gen 1", (_run("gen1_straight"),), speed),
    Picture("Fig. 24", "Bends of gen 1 with modules that differ", (_UNEQUAL,), bends),
    Picture("Fig. 25, 26", "Bends of gen 1 with equal modules", (_run("gen1_straight"),), bends),
    Picture("Fig. 27, 28", "Difference of the bodies, gen 1", (_run("gen1_straight"),), differences),
    Picture("Fig. 30", "Heading of gen 1's tail", (_run("gen1_straight"),), tail_angle),
    *_contours(),
    Picture(
        "Fig. 34",
        "Gen 2, offset 0.4, 2 Hz, 54 kPa: both models and the twin",
        (_run("gen2_turn", {_PRESSURE: 54.0}), _run("gen2_turn", {_PRESSURE: 54.0, **_SIMPLIFIED})),
        paths("complete", "simplified"),
    ),
    *_offsets(),
    Picture(
        "Fig. 41",
        "Static bend over pressure (sweep fig41)",
        (_sweep("fig41"),),
        sweep("line", _PRESSURE, "final_bend_rad", by="controller.plus"),
    ),
    *_modules(),
    *_learning(),
    *_plans(),
    Picture("Fig. 58", "What gen 4 sweeps on a curve", (_run("ilc_curve"),), above),
)
"""In the order of the text."""
