"""Execution of sweeps, including the storage of results.

Engines run the points of a sweep in worker processes, on a Ray cluster, or in batches
on an accelerator (`warp`). All engines yield equal results, except that `warp` computes
in single precision.
"""

from __future__ import annotations

import json
import logging
import os
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from srs_twin.compute.workers import TaskResult, run_tasks, start_server
from srs_twin.errors import (
    DivergedError,
    EngineWarning,
    InputError,
    SrsError,
    UnknownNameError,
)
from srs_twin.extensions import PLUGINS
from srs_twin.io.arguments import checked
from srs_twin.io.documents import Overrides, dump_yaml
from srs_twin.io.file_sets import replace_files
from srs_twin.io.files import (
    SWEEP_MARKS,
    SWEEP_SUMMARY,
    StrPath,
    check_output_folder,
    folder_or_temporary,
)
from srs_twin.io.provenance import Provenance
from srs_twin.plants.twin.batch import warp_batch
from srs_twin.rollout import run_scripts
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.provenance import file_digests, versions
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.points import Experiment, Point, Sweep
from srs_twin.studies.sweep.report import REPORT, Summary, write_report
from srs_twin.studies.sweep.store import RowStore, rows_digest
from srs_twin.studies.sweep.table import SweepTable
from srs_twin.studies.sweep.task import DONE, FAILED, Row, run_point

if TYPE_CHECKING:
    from srs_twin.plants.base import Plant
    from srs_twin.trajectory import Trajectory

_RAY_SETTINGS = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
"""Environment variables that disable Ray's usage reports and make Ray workers use the
Python environment of this process.
"""

_LOOPBACK_ONLY = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
"""Environment variables that restrict a local Ray instance to the loopback address."""
Engine = Callable[[Experiment, Sequence[Point]], Iterator[TaskResult[Row]]]


def local(workers: int | None = None) -> Engine:
    """Return an engine that runs points in worker processes on this machine.

    If a worker process crashes, the other runs continue.
    """

    def run(
        experiment: Experiment, points: Sequence[Point]
    ) -> Iterator[TaskResult[Row]]:
        start_server("srs_twin.studies.sweep.warm")
        return run_tasks(partial(run_point, experiment), points, workers=workers)

    return run


def on_ray(address: str | None = None, workers: int | None = None) -> Engine:
    """Return an engine that runs points on a Ray cluster or on a local Ray instance.

    Args:
        address: address of a cluster, as in `ray.init`, or None to start a local
            instance for the duration of the sweep.
        workers: number of processors of the local instance, or None for all processors.
    """
    settings = dict(_RAY_SETTINGS)
    if address is None:
        settings |= _LOOPBACK_ONLY
    for name, value in settings.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError as error:
        raise InputError(
            "--engine ray needs Ray; install it with: pip install 'srs-twin[ray]'"
        ) from error
    if address is not None and workers is not None:
        raise InputError(
            "--workers is only allowed if Ray is started on this machine; remove"
            " --workers or --address"
        )

    def run(
        experiment: Experiment, points: Sequence[Point]
    ) -> Iterator[TaskResult[Row]]:
        try:
            options: dict[str, Any] = {}
            if address is None:
                options |= {"num_cpus": workers, "include_dashboard": False}
            if plugins := os.environ.get(PLUGINS):
                options["runtime_env"] = {"env_vars": {PLUGINS: plugins}}
            ray.init(
                address, log_to_driver=False, logging_level=logging.ERROR, **options
            )
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(
                f"Ray cannot be reached at {address or 'this machine'}: {error}"
            ) from error
        try:
            yield from _run_on_ray(experiment, points)
        finally:
            ray.shutdown()

    return run


def _run_on_ray(
    experiment: Experiment, points: Sequence[Point]
) -> Iterator[TaskResult[Row]]:
    import ray

    task = ray.remote(max_retries=3)(run_point)
    common = ray.put(experiment)
    slots = max(2, int(2 * ray.cluster_resources().get("CPU", 1)))
    submitted: dict[object, int] = {}
    remaining = iter(enumerate(points))
    while True:
        while len(submitted) < slots and (new := next(remaining, None)) is not None:
            submitted[task.remote(common, new[1])] = new[0]
        if not submitted:
            return
        for finished in ray.wait(list(submitted), num_returns=1)[0]:
            number = submitted.pop(finished)
            try:
                yield TaskResult(number, ray.get(finished), None)
            except ray.exceptions.RayError as error:
                yield TaskResult(number, None, error)


Progress = Callable[[str, int, Row | None], object]
"""Callback that receives the name of a study part, its number of runs, and the row of a
finished run (None at the start).
"""


def quiet(part: str, total: int, row: Row | None) -> None:
    """Ignore a progress report."""


def make_engine(
    engine: str | Engine, workers: int | None = None, address: str | None = None
) -> Engine:
    """Return the engine with the given name.

    Args:
        engine: name of the engine ("local", "ray" or "warp"), or an engine object,
            which is returned unchanged.
        workers: number of parallel runs, or None for one per processor.
        address: address of a Ray cluster, or name of a Warp device.
    """
    if not isinstance(engine, str):
        return engine
    if engine == "ray":
        return on_ray(address, workers)
    if engine == "warp":
        return on_device(address, workers)
    if engine != "local":
        raise UnknownNameError("engine", engine, ("local", "ray", "warp"))
    if address is not None:
        raise InputError(
            "--address is allowed only for the engines ray and warp; remove it"
        )
    return local(workers)


def select_points(swept: Sweep, exclude: Sequence[str]) -> set[str]:
    """Return the keys of all points without an excluded value (`field=value`)."""
    selected = {point.key for point in swept.points}
    for excluded in exclude:
        field, _, value = excluded.partition("=")
        if field not in swept.fields:
            raise UnknownNameError("varied field", field, swept.fields)
        values = {point.key: str(point.changes[field]) for point in swept.points}
        if value not in values.values():
            raise UnknownNameError(f"value of {field}", value, {*values.values()})
        selected -= {key for key, text in values.items() if text == value}
    return selected


@checked
def sweep(
    sweep: StrPath | Sweep,
    *,
    out: StrPath | None = None,
    set: Overrides = (),
    plants: Sequence[str] | None = None,
    exclude: Sequence[str] = (),
    engine: str | Engine = "local",
    workers: int | None = None,
    retry_failed: bool = False,
    changed: bool = False,
    progress: Progress = quiet,
) -> Summary:
    """Run a scenario with grids, lists or samples of field values.

    An interrupted sweep resumes if the function is called again with the same output
    folder.

    Args:
        sweep: name of a shipped sweep, path of a sweep file, or a loaded sweep.
        out: output folder, or None to write no files.
        set: values of scenario fields, as described in `load_sweep`.
        plants: plants to simulate, or None for the plants of the sweep.
        exclude: field values to exclude, each in the form `field=value`.
        engine: name of the execution engine ("local", "ray" or "warp"), or an engine
            object (see `local`, `on_ray` and `on_device`).
        workers: number of parallel runs, or None for one per processor.
        retry_failed: whether to repeat points that failed in an earlier run.
        changed: whether the folder may contain rows of a different version of the sweep
            (see `open_sweep`).
        progress: callback for progress reports (see `Progress`).

    Raises:
        InputError: the sweep is not valid, the engine is not available, or the folder
            cannot be used.
    """
    runner = make_engine(engine, workers)
    loaded = load_sweep(sweep, set=set, plants=plants)
    selected = select_points(loaded, exclude)
    with (
        folder_or_temporary(out) as folder,
        open_sweep(loaded, folder, changed=changed) as opened,
    ):
        missing = tuple(
            p for p in opened.missing(retry_failed=retry_failed) if p.key in selected
        )
        progress(loaded.name, len(missing), None)
        try:
            opened.run(runner, missing, partial(progress, loaded.name, len(missing)))
        except KeyboardInterrupt as interrupt:
            kept = opened.finish()
            rows = kept.done + kept.failed
            interrupt.add_note(
                f"{rows} of {kept.points} rows are kept; start the command again to"
                " resume"
            )
            raise
        return opened.finish()


RESULTS = "results.parquet"

SWEEP = "sweep.yaml"

SCENARIO = "scenario.resolved.yaml"

PLOTS = "plots"

# The summary comes first, because `replace_files` uses it to mark a complete set.
_PRODUCTS = (SWEEP_SUMMARY, RESULTS, SWEEP, SCENARIO, REPORT, f"{PLOTS}/[0-9]*_*.png")


@contextmanager
def open_sweep(
    sweep: Sweep, folder: Path, *, changed: bool = False
) -> Iterator[OpenSweep]:
    """Open and lock a folder for a sweep.

    Args:
        sweep: sweep to run in the folder.
        folder: folder for rows and results, which is created if it does not exist.
        changed: whether the folder may contain rows of a different version of the
            sweep. Rows that are still valid are kept.
    """
    check_output_folder(folder, _PRODUCTS, marks=SWEEP_MARKS)
    with RowStore(folder) as store:
        yield OpenSweep(sweep, folder, store, changed=changed)


class OpenSweep:
    """Sweep with an open and locked output folder."""

    def __init__(
        self, sweep: Sweep, folder: Path, store: RowStore, *, changed: bool
    ) -> None:
        self.sweep = sweep
        self.folder = folder
        self._store = store
        store.claim(self._provenance(), changed=changed)
        if changed:
            store.retain(point.key for point in sweep.points)

    def missing(self, *, retry_failed: bool = False) -> tuple[Point, ...]:
        """Return the points without a result, optionally including failed points."""
        existing = self._store.keys(failed=not retry_failed)
        return tuple(point for point in self.sweep.points if point.key not in existing)

    def rows(self) -> list[Row]:
        """Return the stored rows, ordered by key."""
        return list(self._store.rows())

    def run(
        self,
        engine: Engine,
        points: tuple[Point, ...],
        finished: Callable[[Row], object] | None = None,
    ) -> None:
        """Run sweep points, store each finished row, and pass it to `finished`."""
        self._store.collect(
            engine(self.sweep.experiment, points), [p.key for p in points], finished
        )

    def finish(self) -> Summary:
        """Write the table, plots, report and summary of the stored rows.

        After an error, the earlier files in the folder are restored.
        """
        with replace_files(self.folder, _PRODUCTS) as fresh:
            return self._write(fresh)

    def _write(self, fresh: Path) -> Summary:
        rows = self.rows()
        results = SweepTable.from_rows(self.sweep, rows)
        results.write(fresh / RESULTS, self.sweep)
        titles = self._draw(fresh, results)
        base = self.sweep.experiment.base
        (fresh / SWEEP).write_text(dump_yaml(self.sweep.document), "utf-8")
        (fresh / SCENARIO).write_text(dump_yaml(base), "utf-8")
        failed = [row for row in rows if row.status == FAILED]
        summary = Summary(
            folder=self.folder,
            points=len(self.sweep.points),
            done=len(rows) - len(failed),
            reasons=dict(Counter(row.reason or "" for row in failed).most_common()),
            exit_code=max((row.exit_code for row in failed), default=0),
            sha256=rows_digest(rows),
            ranges=results.ranges(),
            results=results,
            files=(RESULTS, *titles, SWEEP, SCENARIO, REPORT, SWEEP_SUMMARY),
        )
        pictures = {
            title: (fresh / name).read_bytes() for name, title in titles.items()
        }
        write_report(fresh / REPORT, self.sweep, summary, pictures)
        (fresh / SWEEP_SUMMARY).write_text(
            json.dumps(self._document(summary), indent=2) + "\n", "utf-8"
        )
        return summary

    def _draw(self, fresh: Path, results: SweepTable) -> dict[str, str]:
        if not self.sweep.plots:
            return {}
        # A top-level import of Matplotlib would delay sweeps without plots.
        from srs_twin.studies.sweep.plots import draw
        from srs_twin.viewing.plots.style import save

        titles = {}
        for number, plot in enumerate(self.sweep.plots, start=1):
            name = f"{PLOTS}/{number}_{plot.kind}_{plot.metric}.png"
            figure = draw(plot, results)
            save(figure, fresh / name)
            title, _, _ = figure.get_suptitle().partition("\n")
            titles[name] = f"{name}: {title}"
        return titles

    def _document(self, summary: Summary) -> dict[str, object]:
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
            "versions": versions(),
        }

    def _provenance(self) -> Provenance:
        experiment = self.sweep.experiment
        base = experiment.provenance(experiment.base)
        points = rows_digest([Row(point.key, DONE) for point in self.sweep.points])
        content = base.content | {"fields": list(self.sweep.fields), "points": points}
        return replace(base, content=content, files=self._input_files())

    def _input_files(self) -> dict[str, str]:
        experiment = self.sweep.experiment
        digests: dict[str, str] = {}
        for point in self.sweep.points:
            digests |= file_digests(experiment.document(point.changes))
        return digests


_RUN_KEYS = ("title", "name", "duration_s", "seed", "record_hz", "controller", "start")
"""Scenario keys that do not affect the model of the twin."""


class _TwinPoint(NamedTuple):
    number: int
    scenario: Scenario
    twin: Plant


def on_device(device: str | None = None, workers: int | None = None) -> Engine:
    """Return an engine that simulates twins with MuJoCo Warp.

    The engine `local` runs the points that Warp does not support, and a warning is
    issued.

    Args:
        device: name of a Warp device, or None to use an accelerator if available.
        workers: number of workers of the engine `local`.
    """
    batch_class = warp_batch()
    if device is None and not batch_class.accelerated():
        message = (
            "engine 'warp' finds no accelerator, so all points run on the CPU"
            " (engine 'local')"
        )
        warnings.warn(message, EngineWarning, stacklevel=1)
        return local(workers)

    def run(
        experiment: Experiment, points: Sequence[Point]
    ) -> Iterator[TaskResult[Row]]:
        unsupported: dict[int, str] = {}
        for group in _batches(batch_class, device, experiment, points, unsupported):
            numbers = [each.number for each in group]
            try:
                trajectories = _run(batch_class, device, group)
            except InputError as error:
                unsupported |= dict.fromkeys(numbers, str(error))
                continue
            for number, trajectory in zip(numbers, trajectories, strict=True):
                row = run_point(experiment, points[number], {"twin": trajectory})
                yield TaskResult(number, row, None)
        if unsupported:
            message = (
                f"{len(unsupported)} of {len(points)} points run on the CPU:"
                f" {next(iter(unsupported.values()))}"
            )
            warnings.warn(message, EngineWarning, stacklevel=1)
            rest = list(unsupported)
            for done in local(workers)(experiment, [points[k] for k in rest]):
                yield replace(done, number=rest[done.number])

    return run


def _batches(
    batch_class: Any,
    device: str | None,
    experiment: Experiment,
    points: Sequence[Point],
    unsupported: dict[int, str],
) -> Iterator[list[_TwinPoint]]:
    """Yield batches of points that fit into memory, and record unsupported points."""
    groups: dict[object, list[_TwinPoint]] = defaultdict(list)
    most: dict[object, int] = {}
    twins: dict[str, Plant] = {}
    for number, point in enumerate(points):
        try:
            scenario = parse_scenario(experiment.document(point.changes))
            key = _group_key(experiment, scenario)
            twin = _shared_twin(scenario, twins)
            batch_class.check(twin)
        except SrsError as error:
            unsupported[number] = str(error)
            continue
        if key not in most:
            samples = round(scenario.duration * scenario.record_hz) + 1
            most[key] = batch_class.max_worlds(twin, samples, device)
        groups[key].append(_TwinPoint(number, scenario, twin))
        if len(groups[key]) == most[key]:
            yield groups.pop(key)
            twins.clear()
    yield from groups.values()


def _shared_twin(scenario: Scenario, twins: dict[str, Plant]) -> Plant:
    """Return the twin that all scenarios with equal robots and worlds share."""
    relevant = {
        key: value for key, value in scenario.document.items() if key not in _RUN_KEYS
    }
    key = json.dumps([relevant, scenario.file.tick("twin")], sort_keys=True)
    if key not in twins:
        twins[key] = scenario.build_plant("twin")
    return twins[key]


def _group_key(experiment: Experiment, scenario: Scenario) -> tuple[object, ...]:
    """Return the duration, seed and recording rate, which all runs in a batch share."""
    timing = scenario.timing
    if "twin" not in experiment.plants:
        raise InputError(
            "engine 'warp' simulates only the twin; add `twin` to `plants`"
        )
    if scenario.initial_state is not None:
        raise InputError(
            "engine 'warp' cannot start from a moving state; use another engine"
        )
    return tuple(timing[name] for name in ("duration", "seed", "record_hz"))


def _run(
    batch_class: Any, device: str | None, group: Sequence[_TwinPoint]
) -> list[Trajectory | DivergedError]:
    timing = group[0].scenario.timing
    return list(
        run_scripts(
            batch_class([each.twin for each in group], device=device),
            [each.scenario.build_controller() for each in group],
            timing["duration"],
            seed=timing["seed"],
            record_hz=timing["record_hz"],
            poses=[each.scenario.pose for each in group],
        )
    )
