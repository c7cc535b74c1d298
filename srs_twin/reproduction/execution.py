"""Store: what came of orders, kept under their keys as each is done; what is missing runs in processes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from types import TracebackType

from srs_twin.errors import SrsError
from srs_twin.files import atomic_write
from srs_twin.folders import open_folder
from srs_twin.process_server import start_server
from srs_twin.processes import Done, each
from srs_twin.reproduction.computations import COMPUTATIONS
from srs_twin.reproduction.runs import Order, lasting
from srs_twin.sweep.store import RowStore
from srs_twin.sweep.task import DONE, FAILED, Row, run_point
from srs_twin.trajectory import Trajectory

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
