"""Runs that claims need, each under a key of all that decides it, so that rows share runs that are kept.

What is missing runs in worker processes; what comes of each is kept as soon as it is done.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from srs_twin.compute.workers import each, start_server
from srs_twin.errors import SrsError
from srs_twin.io.files import open_folder, shipped_folder
from srs_twin.reproduction.claims import COMPUTATIONS, Plain, RunRequest, Set
from srs_twin.scenario.loading import load_scenario
from srs_twin.scenario.provenance import digest_of, run_key, source_digests, versions
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.points import RUNNER, Experiment, Point, Sweep
from srs_twin.studies.sweep.store import RowStore
from srs_twin.studies.sweep.task import DONE, Row, failed_row, run_point
from srs_twin.trajectory import Trajectory

Document = dict[str, Any]
Alter = Callable[[Document], Document]
Started = Callable[[int], Callable[[Row], None]]


@dataclass(frozen=True)
class Job:
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
    arguments: Mapping[str, Set] = field(default_factory=dict)

    @property
    def keeps(self) -> bool:
        """Whether its trajectories are kept."""
        return self.experiment is not None and self.experiment.trajectories

    @property
    def steps(self) -> float:
        """How many time steps it simulates: nobody shall wait for a long one at the end."""
        if self.experiment is None:
            return math.inf
        base = self.experiment.base
        return float(base["duration_s"]) / base["plants"].get("twin", {}).get("timestep_s", 0.001)


@cache
def sweep_of(name: str) -> Sweep:
    """Return a shipped sweep, loaded once."""
    return load_sweep(name)


@cache
def _experiment(name: str, periods: float | None) -> Experiment:
    scenario = load_scenario(name)
    return Experiment(scenario.document, tuple(scenario.plants), periods)


def points_of(request: RunRequest) -> tuple[Point, ...]:
    """Return the points of a sweep that count, in the order of their jobs."""
    return tuple(each for each in sweep_of(request.name).points if _counts(each.changes, request.where))


def _counts(place: Mapping[str, Plain], where: Mapping[str, Plain]) -> bool:
    return all(_same(place[name], value) for name, value in where.items())


def _same(one: Plain, other: Plain) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)


@cache
def _data_digests() -> dict[str, str]:
    """Return the shipped robots and footprints, which computations read by name → SHA-256, hex."""
    files = [path for kind in ("robot", "footprint") for path in shipped_folder(kind).glob("*.yaml")]
    return {path.stem: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(files)}


HTML, JSON, JUNIT = "reproduce.html", "reproduce.json", "reproduce.xml"


@contextmanager
def open_store(folder: Path, alter: Alter | None = None) -> Iterator[Store]:
    """Lock a folder for what comes of runs, as a context, and see what is there.

    Args:
        folder: where it is kept; made where it is missing.
        alter: changes the plain data of every scenario that is run (tests put faults in with it).

    Raises:
        InputError: the folder cannot be written, is locked, or holds something else.
    """
    open_folder(folder, (HTML, JSON, JUNIT))
    with RowStore(folder) as store:
        yield Store(store, alter)


class Store:
    """The jobs of runs, and what came of them."""

    def __init__(self, store: RowStore, alter: Alter | None) -> None:
        self._store, self._alter = store, alter
        self._rows = {row.key: row for row in self._store.rows() if row.status == DONE}
        self._failures: dict[str, str] = {}
        self._jobs: dict[str, Job] = {}
        self._keys: dict[str, tuple[str, ...]] = {}

    def jobs(self, request: RunRequest) -> tuple[Job, ...]:
        """Return one job, or one a point of the sweep; what several claims need is one job.

        Raises:
            InputError: the scenario or sweep cannot be used.
        """
        same = json.dumps([request.kind, request.name, request.set, request.periods, request.where])
        if same not in self._keys:
            made = list(self._made(request))
            for job in made:
                # One that keeps its trajectories also serves those that need none.
                if job.key not in self._jobs or job.keeps:
                    self._jobs[job.key] = job
            self._keys[same] = tuple(job.key for job in made)
        return tuple(self._jobs[key] for key in self._keys[same])

    def _made(self, request: RunRequest) -> Iterator[Job]:
        if request.kind == "law":
            key = digest_of(
                law=request.name,
                arguments=request.set,
                versions=versions(),
                sources=source_digests("srs_twin.reproduction.computations"),
                data=_data_digests(),
            )
            yield Job(key, law=request.name, arguments=request.set)
            return
        sweep = sweep_of(request.name) if request.kind == "sweep" else None
        experiment = sweep.experiment if sweep else _experiment(request.name, request.periods)
        for changes in [point.changes for point in points_of(request)] if sweep else [{}]:
            document = experiment.document({**changes, **request.set})  # type: ignore[dict-item]
            if self._alter is not None:
                document = self._alter(document)
            plants = experiment.plants
            whole = Experiment(document, plants, trajectories=sweep is None)
            yield Job(run_key(document, plants, RUNNER), whole)

    def run(self, jobs: Iterable[Job], *, workers: int | None = None, started: Started | None = None) -> None:
        """Run what is missing and keep what comes of each as it finishes; what fails becomes a failed row.

        Args:
            jobs: of `jobs`.
            workers: how many processes; default one a processor.
            started: called with the number of jobs that are due, if there are any; returns what is called
                with every row.

        Raises:
            InputError: a row cannot be kept.
        """
        # What stands under a key may have been replaced by a job that also keeps its trajectories.
        known = [self._jobs[key] for key in dict.fromkeys(job.key for job in jobs)]
        due = sorted((job for job in known if not self._has(job)), key=lambda job: job.steps, reverse=True)
        if not due:
            return
        finished_row = started(len(due)) if started is not None else None
        start_server("srs_twin.studies.sweep.warm")
        with closing(each(carry_out, due, workers=workers)) as finished:
            for done in finished:
                row = done.result or failed_row(due[done.number].key, done.error)
                self._store.add(row)
                if row.status == DONE:
                    self._rows[row.key] = row
                else:
                    self._failures[row.key] = row.reason or "it failed"
                if finished_row is not None:
                    finished_row(row)

    def row(self, key: str) -> Row | None:
        """Return what came of a job; None where it was not run, or failed."""
        return self._rows.get(key)

    def failure(self, key: str) -> str:
        """Return why a job failed; empty where it did not."""
        return self._failures.get(key, "")

    def trajectory(self, key: str, plant: str) -> Trajectory | None:
        """Return a trajectory that was kept; None where there is none."""
        path = self._store.trajectory_file(key, plant)
        return Trajectory.from_parquet(path) if path.is_file() else None

    def _has(self, job: Job) -> bool:
        if job.key not in self._rows or job.experiment is None or not job.keeps:
            return job.key in self._rows
        return all(self._store.trajectory_file(job.key, plant).is_file() for plant in job.experiment.plants)


def carry_out(job: Job) -> Row:
    """Do a job, here or in a worker; what it does wrong becomes a failed row."""
    if job.experiment is not None:
        return run_point(job.experiment, Point(job.key, {}))
    assert job.law is not None, "a job is a run or a computation"
    start = time.perf_counter()
    try:
        values = COMPUTATIONS[job.law](**job.arguments)
    except SrsError as error:
        return failed_row(job.key, error, time.perf_counter() - start)
    return Row(job.key, DONE, values, time.perf_counter() - start)
