"""Running a sweep: an engine runs what is missing, every row is kept at once, one table at the end.

Rows do not depend on the engine that ran them; those of `warp` are in single precision.
"""

from __future__ import annotations

import json
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.compute.workers import Done, each, start_server
from srs_twin.errors import InputError
from srs_twin.io.documents import dump_yaml
from srs_twin.io.file_sets import replaced
from srs_twin.io.files import open_folder, shown
from srs_twin.scenario.provenance import file_digests, source_digests
from srs_twin.studies.sweep.points import RUNNER, Experiment, Point, Sweep
from srs_twin.studies.sweep.report import REPORT, Summary, write_report
from srs_twin.studies.sweep.store import (
    RESULTS,
    RowStore,
    SweepIdentity,
    digest,
    shown_columns,
    shown_metrics,
    spans,
    table,
    write,
)
from srs_twin.studies.sweep.table import SweepTable, published_table
from srs_twin.studies.sweep.task import DONE, FAILED, Row, failed_row, run_point

if TYPE_CHECKING:
    import pyarrow as pa


# No reports to anybody, and workers that take this environment as it is instead of building it anew.
_RAY_SETTINGS = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
# A Ray of our own serves nobody else. Under this name Ray keeps to the loopback address, on Linux as well.
_LOOPBACK_ONLY = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}

Engine = Callable[[Experiment, Sequence[Point]], Iterator[Done[Row]]]


def local(workers: int | None = None) -> Engine:
    """Return the engine that runs points in processes of this machine.

    Threads, or `mujoco.batch` for twins of one model, would be no faster (see benchmarks/sweeps.py), and one
    run that goes down would take the others along.

    Args:
        workers: how many processes; default one a processor.
    """

    def run(experiment: Experiment, points: Sequence[Point]) -> Iterator[Done[Row]]:
        start_server("srs_twin.studies.sweep.warm")
        return each(partial(run_point, experiment), points, workers=workers)

    return run


def on_ray(address: str | None = None, workers: int | None = None) -> Engine:
    """Return the engine that runs points on a Ray cluster, or on a Ray of this machine's own.

    Args:
        address: of a cluster, as `ray.init` takes it; None starts one here, which ends with the sweep.
        workers: processors of one started here; default all.

    Raises:
        InputError: Ray is not installed, or an address goes with a number of workers.
    """
    for name, value in (_RAY_SETTINGS | ({} if address else _LOOPBACK_ONLY)).items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError as error:
        raise InputError("--engine ray needs Ray; install it with: pip install 'srs-twin[ray]'") from error
    if address is not None and workers is not None:
        raise InputError("--workers belongs to a Ray of this machine's own; a cluster has the workers it has")

    def run(experiment: Experiment, points: Sequence[Point]) -> Iterator[Done[Row]]:
        try:
            own: dict[str, Any] = {} if address else {"num_cpus": workers, "include_dashboard": False}
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **own)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(f"Ray cannot be reached at {address or 'this machine'}: {error}") from error
        try:
            yield from _shared_out(experiment, points)
        finally:
            ray.shutdown()

    return run


def _shared_out(experiment: Experiment, points: Sequence[Point]) -> Iterator[Done[Row]]:
    """Keep two points a processor under way; yield as they finish."""
    import ray

    task = ray.remote(max_retries=3)(run_point)
    common = ray.put(experiment)
    slots = max(2, int(2 * ray.cluster_resources().get("CPU", 1)))
    under_way: dict[object, int] = {}
    coming = iter(enumerate(points))
    while True:
        while len(under_way) < slots and (new := next(coming, None)) is not None:
            under_way[task.remote(common, new[1])] = new[0]
        if not under_way:
            return
        for finished in ray.wait(list(under_way), num_returns=1)[0]:
            number = under_way.pop(finished)
            try:
                yield Done(number, ray.get(finished), None)
            except ray.exceptions.RayError as error:
                yield Done(number, None, error)


ENGINES = ("local", "ray", "warp")


SUMMARY, SWEEP, SCENARIO = "sweep.json", "sweep.yaml", "scenario.resolved.yaml"
PLOTS = "plots"
# The summary marks a complete set.
_PRODUCTS = (SUMMARY, RESULTS, SWEEP, SCENARIO, REPORT, f"{PLOTS}/[0-9]*_*.png")


@contextmanager
def open_sweep(sweep: Sweep, folder: Path, *, changed: bool = False) -> Iterator[OpenSweep]:
    """Lock a folder for a sweep, as a context, and see what is there.

    Args:
        sweep: what is to be run.
        folder: for rows and results; made where it is missing.
        changed: go on although the folder belongs to another version of the sweep; rows that both have stay.

    Raises:
        InputError: the folder cannot be written, is locked, or belongs to another version of the sweep.
    """
    open_folder(folder, _PRODUCTS)
    with RowStore(folder) as store:
        yield OpenSweep(sweep, folder, store, changed=changed)


class OpenSweep:
    """A sweep whose folder is locked."""

    def __init__(self, sweep: Sweep, folder: Path, store: RowStore, *, changed: bool) -> None:
        self.sweep, self.folder, self._store = sweep, folder, store
        self._settle(changed=changed)

    def missing(self, *, retry_failed: bool = False) -> tuple[Point, ...]:
        """Return the points without a row, or (asked for) with one that failed."""
        there = self._store.keys(failed=not retry_failed)
        return tuple(point for point in self.sweep.points if point.key not in there)

    def run(
        self, engine: Engine, points: tuple[Point, ...], finished: Callable[[Row], None] | None = None
    ) -> None:
        """Run points and keep each row as it finishes.

        An interrupt ends the workers; rows that are finished stay.

        Args:
            engine: who runs them.
            points: some of the sweep's.
            finished: called with every row.

        Raises:
            InputError: a row cannot be kept.
        """
        with closing(engine(self.sweep.experiment, points)) as rows:  # type: ignore[type-var]
            for done in rows:
                row = done.result or failed_row(points[done.number].key, done.error)
                self._store.add(row)
                if finished is not None:
                    finished(row)

    def finish(self) -> Summary:
        """Write the table, the pictures and the report of the rows there are, sweep.json last.

        Raises:
            InputError: a file cannot be written; those of an earlier start are as they were.
        """
        with replaced(self.folder, _PRODUCTS) as fresh:
            return self._write(fresh)

    def _write(self, fresh: Path) -> Summary:
        rows = list(self._store.rows())
        found = table(self.sweep, rows)
        write(fresh / RESULTS, found)
        titles = self._draw(fresh, found)
        read, beside = SweepTable.of(shown_columns(self.sweep, found)), self.sweep.beside
        for name, document in ((SWEEP, self.sweep.document), (SCENARIO, self.sweep.experiment.base)):
            (fresh / name).write_text(dump_yaml(document), "utf-8")
        failed = [row for row in rows if row.status == FAILED]
        summary = Summary(
            folder=self.folder,
            points=len(self.sweep.points),
            done=len(rows) - len(failed),
            reasons=dict(Counter(row.reason or "" for row in failed).most_common()),
            exit_code=max((row.exit_code for row in failed), default=0),
            sha256=digest(rows),
            spans=spans(found),
            files=(RESULTS, *titles, SWEEP, SCENARIO, REPORT, SUMMARY),
            published=None if beside is None else published_table(beside, read),
        )
        pictures = {title: (fresh / name).read_bytes() for name, title in titles.items()}
        write_report(fresh / REPORT, self.sweep, summary, read, shown_metrics(self.sweep), pictures)
        (fresh / SUMMARY).write_text(json.dumps(self._about(summary), indent=2) + "\n", "utf-8")
        return summary

    def _draw(self, fresh: Path, found: pa.Table) -> dict[str, str]:
        """Write the pictures into a folder; return their names and titles."""
        if not self.sweep.plots:
            return {}
        # matplotlib takes longer to import than a sweep without pictures has to wait.
        from srs_twin.studies.sweep.plots import draw
        from srs_twin.viewing.plots.picture_file import save

        titles = {}
        for number, plot in enumerate(self.sweep.plots, start=1):
            name = f"{PLOTS}/{number}_{plot.kind}_{plot.metric}.png"
            figure = draw(plot, found, self.sweep.beside)
            save(figure, fresh / name)
            title, _, _ = figure.get_suptitle().partition("\n")
            titles[name] = f"{name}: {title}"
        return titles

    def _about(self, summary: Summary) -> dict[str, Any]:
        return {
            "sweep": self.sweep.name,
            "title": self.sweep.title,
            "changes": list(self.sweep.changes),
            "points": summary.points,
            "done": summary.done,
            "failed": summary.failed,
            "reasons": dict(summary.reasons),
            "results_sha256": summary.sha256,
            "plants": list(self.sweep.experiment.plants),
            "fields": list(self.sweep.fields),
            "versions": dict(self.sweep.versions),
        }

    def _settle(self, *, changed: bool) -> None:
        """Refuse a folder that belongs to another version of the sweep, unless told; note whose it is."""
        keys = digest([Row(point.key, DONE) for point in self.sweep.points])
        rest = (self.sweep.experiment.base, self.sweep.fields, self.sweep.versions)
        rest = json.loads(json.dumps((*rest, source_digests(RUNNER), self._files())))
        now, before = SweepIdentity(keys, *rest), self._store.identity()
        if before is not None and before.keys != now.keys:
            if not changed:
                raise InputError(
                    f"{shown(self.folder)}: its rows are of another version of this sweep "
                    f"({_difference(before, now)}); give --changed to keep the rows that still belong and "
                    f"run the others, or another --out"
                )
            self._store.keep(point.key for point in self.sweep.points)
        if before != now:
            self._store.keep_identity(now)

    def _files(self) -> dict[str, str]:
        """Return the files that any point reads → SHA-256 of their contents."""
        experiment = self.sweep.experiment
        found: dict[str, str] = {}
        for point in self.sweep.points:
            found |= file_digests(experiment.document(point.changes))
        return found


def _difference(before: SweepIdentity, now: SweepIdentity) -> str:
    """Say in a few words how two versions of a sweep differ."""
    said = []
    if changed := list(_changes(before.versions, now.versions, "")):
        said.append(f"made with other versions: {_few(changed)}")
    for old, new, what in (
        (before.sources, now.sources, "the program has changed"),
        (before.files, now.files, "contents have changed"),
    ):
        names = [name for name in dict.fromkeys((*new, *old)) if old.get(name) != new.get(name)]
        if names:
            said.append(f"{what}: {_few(names)}")
    if before.fields != now.fields:
        said.append(f"it varied {', '.join(before.fields)}")
    elif changed := list(_changes(before.scenario, now.scenario, "")):
        said.append(f"the scenario has changed: {_few(changed)}")
    return "; ".join(said) or "the values have changed"


def _few(names: Sequence[str]) -> str:
    """Return a list of at most three, and how many more there are."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def _changes(before: Any, now: Any, where: str) -> Any:
    """Yield 'field old → new' for every plain value that differs."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in dict.fromkeys((*before, *now)):
            yield from _changes(before.get(key), now.get(key), f"{where}.{key}" if where else key)
    elif before != now:
        old, new = (each if isinstance(each, str) else json.dumps(each) for each in (before, now))
        yield f"{where} {old} → {new}"
