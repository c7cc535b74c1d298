"""Runs that claims need, each under a key of all that decides it, so that rows share runs that are kept.

What is missing runs in worker processes; what comes of each is kept as soon as it is done.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

from srs_twin.errors import SrsError
from srs_twin.io.files import atomic_write, open_folder, shipped_folder
from srs_twin.parallel import Done, each, start_server
from srs_twin.provenance import digest_of, run_key, source_digests, versions
from srs_twin.reproduction.claims import Measure, Setting, Value
from srs_twin.reproduction.computations import COMPUTATIONS
from srs_twin.scenario import load_scenario
from srs_twin.sweep import load_sweep
from srs_twin.sweep.points import Experiment, Point, Sweep
from srs_twin.sweep.store import RowStore
from srs_twin.sweep.task import DONE, FAILED, Row, run_point
from srs_twin.trajectory import Trajectory

Document = dict[str, Any]
Alter = Callable[[Document], Document]


@dataclass(frozen=True)
class Order:
    """Something that a worker runs.

    Attributes:
        key: SHA-256 of everything that decides the results, hex.
        experiment: the whole scenario; None of a computation.
        law: name of the computation; None of a run.
        arguments: of the computation.
    """

    key: str
    experiment: Experiment | None = None
    law: str | None = None
    arguments: Mapping[str, Setting] = field(default_factory=dict)

    @property
    def point(self) -> Point:
        """The run as a point of a sweep that varies nothing."""
        return Point(self.key, {})


class Orders:
    """Makes the orders of measures; runs that several rows need are one order."""

    def __init__(self, alter: Alter | None = None) -> None:
        """Start without any.

        Args:
            alter: changes the plain data of every scenario that is run (tests put faults in with it).
        """
        self.made: dict[str, Order] = {}
        self._alter = alter
        self._experiments: dict[tuple[str, float | None], Experiment] = {}
        self._sweeps: dict[str, Sweep] = {}
        self._of: dict[str, tuple[str, ...]] = {}

    def of(self, measure: Measure, changes: Mapping[str, Setting] | None = None) -> tuple[Order, ...]:
        """Return what a measure needs to be run: one order, or one a point of its sweep.

        Args:
            measure: of a claim.
            changes: fields of the scenario that are otherwise, besides the measure's own.

        Raises:
            InputError: the scenario or sweep cannot be used.
        """
        more = {**measure.set, **(changes or {})}
        same = json.dumps([measure.kind, measure.name, more, measure.periods, dict(measure.where)])
        if same not in self._of:
            self._of[same] = tuple(order.key for order in self._made(measure, more))
        return tuple(self.made[key] for key in self._of[same])

    def sweep(self, name: str) -> Sweep:
        """Return a sweep, loaded once.

        Raises:
            InputError: it cannot be used.
        """
        if name not in self._sweeps:
            self._sweeps[name] = load_sweep(name)
        return self._sweeps[name]

    def points(self, measure: Measure) -> tuple[Point, ...]:
        """Return the points of a measure's sweep that count, in the order of their orders."""
        return tuple(each for each in self.sweep(measure.name).points if _counts(each.changes, measure.where))

    def _made(self, measure: Measure, more: Mapping[str, Setting]) -> Iterator[Order]:
        if measure.kind == "law":
            yield self._kept(computation(measure.name, more))
        elif measure.kind == "scenario":
            yield self._run(self._experiment(measure.name, measure.periods), more, keep=True)
        else:
            experiment = self.sweep(measure.name).experiment
            for point in self.points(measure):
                yield self._run(experiment, {**point.changes, **more}, keep=False)

    def _run(self, experiment: Experiment, more: Mapping[str, Setting], *, keep: bool) -> Order:
        document: Document = experiment.document(more)  # type: ignore[arg-type]
        if self._alter is not None:
            document = self._alter(document)
        plants = experiment.plants
        whole = Experiment(document, plants, trajectories=keep)
        return self._kept(Order(run_key(document, plants), whole))

    def _kept(self, order: Order) -> Order:
        """Return the order of this key that there is; it keeps trajectories if one of them is to."""
        before = self.made.get(order.key)
        keeps = order.experiment is not None and order.experiment.trajectories
        if before is None or (keeps and before.experiment and not before.experiment.trajectories):
            self.made[order.key] = order
        return self.made[order.key]

    def _experiment(self, name: str, periods: float | None) -> Experiment:
        if (name, periods) not in self._experiments:
            scenario = load_scenario(name)
            found = Experiment(scenario.document, tuple(scenario.plants), periods)
            self._experiments[name, periods] = found
        return self._experiments[name, periods]


def computation(name: str, arguments: Mapping[str, Setting]) -> Order:
    """Return the order of a computation."""
    key = digest_of(
        law=name,
        arguments=dict(arguments),
        versions=versions(),
        sources=source_digests("srs_twin.reproduction.computations"),
        data=_data_digests(),
    )
    return Order(key, law=name, arguments=dict(arguments))


def lasting(orders: Iterable[Order]) -> list[Order]:
    """Return orders with those first that simulate the longest: nobody waits for one at the end."""

    def seconds(order: Order) -> float:
        if order.experiment is None:
            return math.inf
        base = order.experiment.base
        step = base["plants"].get("twin", {}).get("timestep_s", 0.001)
        return float(base["duration_s"]) / step

    return sorted(orders, key=seconds, reverse=True)


@cache
def _data_digests() -> dict[str, str]:
    """Return the shipped robots and footprints, which computations read by name → SHA-256, hex."""
    files = [path for kind in ("robot", "footprint") for path in shipped_folder(kind).glob("*.yaml")]
    return {path.stem: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(files)}


def _counts(place: Mapping[str, Value], where: Mapping[str, Value]) -> bool:
    return all(_same(place[name], value) for name, value in where.items())


def _same(one: Value, other: Value) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)


Progress = Callable[[Row], None]

_TRAJECTORIES = "trajectories"
HTML, JSON, JUNIT = "reproduce.html", "reproduce.json", "reproduce.xml"


def open_store(folder: Path) -> Store:
    """Lock a folder for what comes of orders and see what is there.

    Raises:
        InputError: the folder cannot be written, is locked, or holds something else.
    """
    open_folder(folder, (HTML, JSON, JUNIT))
    return Store(folder, RowStore(folder))


class Store:
    """What came of orders; a context manager that unlocks its folder."""

    def __init__(self, folder: Path, rows: RowStore) -> None:
        self._folder, self._store = folder, rows
        self._rows = {row.key: row for row in rows.rows() if row.status == DONE}
        self._failures: dict[str, str] = {}

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._store.close()

    def missing(self, orders: Iterable[Order]) -> list[Order]:
        """Return the orders that have not been run, or whose trajectories are not there."""
        return [order for order in orders if not self._has(order)]

    def run(
        self, orders: Iterable[Order], *, workers: int | None = None, progress: Progress | None = None
    ) -> None:
        """Run orders and keep what comes of each as it finishes; what fails becomes a failed row.

        Args:
            orders: what is missing.
            workers: how many processes; default one a processor.
            progress: called with every row.

        Raises:
            InputError: a row cannot be kept.
        """
        due = lasting(orders)
        if not due:
            return
        start_server("srs_twin.sweep.warm")
        with closing(each(carry_out, due, workers=workers)) as finished:
            for done in finished:
                self._keep(row := _row(due[done.number], done))
                if progress is not None:
                    progress(row)

    def row(self, key: str) -> Row | None:
        """Return what came of an order; None where it was not run, or failed."""
        return self._rows.get(key)

    def failure(self, key: str) -> str:
        """Return why an order failed; empty where it did not."""
        return self._failures.get(key, "")

    def trajectory(self, key: str, plant: str) -> Trajectory | None:
        """Return a trajectory that was kept; None where there is none."""
        path = self._file(key, plant)
        return Trajectory.from_parquet(path) if path.is_file() else None

    def _has(self, order: Order) -> bool:
        if order.key not in self._rows:
            return False
        experiment = order.experiment
        if experiment is None or not experiment.trajectories:
            return True
        return all(self._file(order.key, plant).is_file() for plant in experiment.plants)

    def _keep(self, row: Row) -> None:
        # The row is what says that an order is done: its files come first.
        for plant, content in row.files.items():
            with atomic_write(self._file(row.key, plant)) as part:
                part.write_bytes(content)
        self._store.add(row)
        if row.status == DONE:
            self._rows[row.key] = row
        else:
            self._failures[row.key] = row.reason or "it failed"

    def _file(self, key: str, plant: str) -> Path:
        return self._folder / _TRAJECTORIES / f"{key}.{plant}.parquet"


def carry_out(order: Order) -> Row:
    """Run an order, here or in a worker; what it does wrong becomes a failed row."""
    if order.experiment is not None:
        return run_point(order.experiment, order.point)
    assert order.law is not None, "an order is a run or a computation"
    start = time.perf_counter()
    try:
        values = COMPUTATIONS[order.law](**order.arguments)
    except SrsError as error:
        reason = " ".join(str(error).split())
        return Row(order.key, FAILED, {}, time.perf_counter() - start, reason, error.exit_code)
    return Row(order.key, DONE, values, time.perf_counter() - start)


def _row(order: Order, done: Done[Row]) -> Row:
    if done.result is not None:
        return done.result
    code = done.error.exit_code if isinstance(done.error, SrsError) else SrsError.exit_code
    return Row(order.key, FAILED, reason=" ".join(str(done.error).split()), exit_code=code)
