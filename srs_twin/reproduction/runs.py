"""Runs that claims and figures require, stored under a hash of all inputs.

Several claims can share a run. Worker processes execute missing runs, and each result
is stored as soon as its run is finished.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from srs_twin.compute.workers import run_tasks, start_server
from srs_twin.errors import SrsError
from srs_twin.io.files import check_output_folder, shipped_folder
from srs_twin.io.provenance import Provenance
from srs_twin.reproduction.claims import COMPUTATIONS, RunRequest, Set
from srs_twin.scenario.loading import load_scenario
from srs_twin.scenario.provenance import file_digest, source_digests, versions
from srs_twin.studies.sweep.execution import Progress, quiet
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.points import Experiment, Plain, Point, Sweep
from srs_twin.studies.sweep.store import RowStore
from srs_twin.studies.sweep.task import DONE, Row, failed_row, run_point
from srs_twin.trajectory import Trajectory

Document = dict[str, Any]

DocumentChange = Callable[[Document], Document]
"""Function that changes a scenario document, for example to inject a fault in a test.
"""


@dataclass(frozen=True)
class ReproductionJob:
    """Scenario or computation that a worker process runs.

    Attributes:
        key: SHA-256 hash of all inputs.
        experiment: complete scenario, or None for a computation.
        computation: name of the computation, or None for a scenario.
        arguments: arguments of the computation.
    """

    key: str
    experiment: Experiment | None = None
    computation: str | None = None
    arguments: Mapping[str, Set] = field(default_factory=dict)

    @property
    def stored_plants(self) -> tuple[str, ...]:
        """Plants whose trajectories the job stores."""
        if self.experiment is None or not self.experiment.trajectories:
            return ()
        return self.experiment.plants

    @property
    def steps(self) -> float:
        """Number of time steps of the twin, or infinity for a computation.

        Jobs with many steps are started first, so that no processor is idle at the end.
        """
        if self.experiment is None:
            return math.inf
        base = self.experiment.base
        twin = base["plants"].get("twin", {})
        return float(base["duration_s"] / twin.get("timestep_s", 0.001))


@cache
def sweep_of(name: str) -> Sweep:
    """Return a sweep, which is loaded once and then cached."""
    return load_sweep(name)


@cache
def _experiment(name: str, periods: float | None) -> Experiment:
    scenario = load_scenario(name)
    return Experiment(scenario.document, tuple(scenario.plants), periods)


def points_of(request: RunRequest) -> tuple[Point, ...]:
    """Return the requested points of a sweep."""
    where = request.where.items()
    return tuple(
        point
        for point in sweep_of(request.name).points
        if all(_equal(point.changes[name], value) for name, value in where)
    )


def _equal(one: Plain, other: Plain) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)


@cache
def _data_digests() -> dict[str, str]:
    folders = map(shipped_folder, ("robot", "footprint"))
    files = sorted(path for folder in folders for path in folder.glob("*.yaml"))
    return {path.stem: file_digest(str(path)) for path in files}


HTML = "reproduce.html"
JSON = "reproduce.json"
JUNIT = "reproduce.xml"


@contextmanager
def open_store(
    folder: Path, change: DocumentChange | None = None
) -> Iterator[RunStore]:
    """Open and lock a folder of stored runs.

    Raises:
        InputError: the folder is not writable, is locked, or contains other results.
    """
    check_output_folder(folder, (HTML, JSON, JUNIT))
    with RowStore(folder) as store:
        yield RunStore(store, change)


class RunStore:
    """Store of requested jobs and their results."""

    def __init__(self, store: RowStore, change: DocumentChange | None) -> None:
        self._store = store
        self._change = change
        self._rows = {row.key: row for row in self._store.rows() if row.status == DONE}
        self._failures: dict[str, str] = {}
        self._jobs: dict[str, ReproductionJob] = {}
        self._keys: dict[str, tuple[str, ...]] = {}

    def jobs(self, request: RunRequest) -> tuple[ReproductionJob, ...]:
        """Return the job of a request, or one job per point if a sweep is requested.

        Raises:
            InputError: the scenario or sweep is invalid.
        """
        text = json.dumps(
            [request.kind, request.name, request.set, request.periods, request.where]
        )
        if text not in self._keys:
            jobs = list(self._make_jobs(request))
            for job in jobs:
                # Of two jobs with the same key, the job that stores trajectories is
                # kept.
                if job.key not in self._jobs or job.stored_plants:
                    self._jobs[job.key] = job
            self._keys[text] = tuple(job.key for job in jobs)
        return tuple(self._jobs[key] for key in self._keys[text])

    def _make_jobs(self, request: RunRequest) -> Iterator[ReproductionJob]:
        if request.kind == "computation":
            run = Provenance(
                {"computation": request.name, "arguments": request.set},
                files=_data_digests(),
                sources=source_digests("srs_twin.reproduction.computations"),
                versions=versions(),
            )
            yield ReproductionJob(
                run.key, computation=request.name, arguments=request.set
            )
            return
        is_sweep = request.kind == "sweep"
        settings: list[Mapping[str, Plain]] = [{}]
        if is_sweep:
            experiment = sweep_of(request.name).experiment
            settings = [point.changes for point in points_of(request)]
        else:
            experiment = _experiment(request.name, request.periods)
        for changes in settings:
            document = experiment.document({**changes, **request.set})  # type: ignore[dict-item]
            if self._change is not None:
                document = self._change(document)
            plants = experiment.plants
            complete = Experiment(document, plants, trajectories=not is_sweep)
            yield ReproductionJob(complete.provenance(document).key, complete)

    def run(
        self,
        jobs: Iterable[ReproductionJob],
        part: str = "runs",
        *,
        workers: int | None = None,
        progress: Progress = quiet,
    ) -> None:
        """Run the jobs that have no stored result, and store each result immediately.

        If a job raises an error, the error is stored instead of a result.

        Raises:
            InputError: a result cannot be stored.
        """
        # A job may have been replaced by an equal job that stores trajectories.
        current = [self._jobs[key] for key in dict.fromkeys(job.key for job in jobs)]
        missing = [job for job in current if not self._is_finished(job)]
        missing.sort(key=lambda job: job.steps, reverse=True)
        if not missing:
            return
        progress(part, len(missing), None)
        start_server("srs_twin.studies.sweep.warm")

        def keep(row: Row) -> None:
            if row.status == DONE:
                self._rows[row.key] = row
            else:
                self._failures[row.key] = row.reason or "it failed"
            progress(part, len(missing), row)

        finished = run_tasks(run_job, missing, workers=workers)
        self._store.collect(finished, [job.key for job in missing], keep)

    def row(self, key: str) -> Row | None:
        """Return the result of a job, or None if there is no result."""
        return self._rows.get(key)

    def failure(self, key: str) -> str:
        """Return why a job failed, or an empty string if the job has not failed."""
        return self._failures.get(key, "")

    def trajectory(self, key: str, plant: str) -> Trajectory | None:
        """Return a stored trajectory, or None if it does not exist."""
        path = self._store.trajectory_file(key, plant)
        if path.is_file():
            return Trajectory.from_parquet(path)
        return None

    def _is_finished(self, job: ReproductionJob) -> bool:
        return job.key in self._rows and all(
            self._store.trajectory_file(job.key, plant).is_file()
            for plant in job.stored_plants
        )


def run_job(job: ReproductionJob) -> Row:
    """Run a job in this process, and return the result or the error as a row."""
    if job.experiment is not None:
        return run_point(job.experiment, Point(job.key, {}))
    assert job.computation is not None, "a job is a scenario or a computation"
    start = time.perf_counter()
    try:
        values = COMPUTATIONS[job.computation](**job.arguments)
    except SrsError as error:
        return failed_row(job.key, error, time.perf_counter() - start)
    return Row(job.key, DONE, values, time.perf_counter() - start)
