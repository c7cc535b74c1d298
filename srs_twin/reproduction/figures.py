"""The dissertation's figures drawn again: which runs each needs, and what it is drawn from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from srs_twin.reproduction.claims import COLUMNS, Measure
from srs_twin.reproduction.execution import Store
from srs_twin.reproduction.runs import Order, Orders
from srs_twin.spec import RobotSpec
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
