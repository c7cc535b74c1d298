"""An experiment in a run folder: simulate, measure, compare, write, read back.

The way of the data in one place: scenario → plants → trajectories → metrics → comparison → files.

A run that is over, read back from its folder: for what is looked at later.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.comparison.compare import Comparison, MeasuredDifference, compare
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.control.base import Controller
from srs_twin.errors import DivergedError, InputError
from srs_twin.io.documents import dump_yaml
from srs_twin.io.files import open_folder, replaced, shown
from srs_twin.plants.base import Plant
from srs_twin.provenance import versions
from srs_twin.rollout import rollout
from srs_twin.scenario import Scenario, load_scenario
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from srs_twin.comparison.compare import Attribution


PLANTS = ("analytical", "twin")
METRICS, RESOLVED = "metrics.json", "scenario.resolved.yaml"
REPORT, RECORDING = "report.html", "recording.rrd"
MEASURED = "measured"
# metrics.json first: as long as it stands, the folder is complete.
PRODUCTS = (METRICS, RESOLVED, REPORT, RECORDING, *(f"{plant}.parquet" for plant in PLANTS))
_OF_REPLAYS = (*PRODUCTS, f"{MEASURED}.parquet")

Progress = Callable[[str, float], None]
Explain = Callable[..., "Attribution"]


@dataclass(frozen=True)
class RunResult:
    """What a run gave and where it lies.

    Attributes:
        name: the scenario's.
        folder: where the files are.
        trajectories: plant → trajectory, up to the divergence where there was one.
        metrics: what stands in metrics.json; empty where a plant diverged.
        diverged: what stopped a plant, its message naming the file that keeps its trajectory.
        unexplained: what stopped one of the runs that were to say why the plants differ.
    """

    name: str
    folder: Path
    trajectories: Mapping[str, Trajectory]
    metrics: Mapping[str, Any] = field(default_factory=dict)
    diverged: tuple[DivergedError, ...] = ()
    unexplained: tuple[DivergedError, ...] = ()


@dataclass(frozen=True)
class PreparedRun:
    """A scenario whose plants and controllers stand ready and whose folder can be written.

    Attributes:
        scenario: what is run.
        folder: where the files go.
        parts: plant → the plant itself and the controller that drives it.
    """

    scenario: Scenario
    folder: Path
    parts: Mapping[str, tuple[Plant, Controller]]

    @property
    def complete(self) -> bool:
        """Whether the folder holds a whole run."""
        return (self.folder / METRICS).is_file()

    def execute(self, progress: Progress | None = None, *, explain: Explain | None = None) -> RunResult:
        """Simulate every plant, measure, compare and write the files, metrics.json last.

        A plant that diverges leaves what it did up to there, and the others still run; then there is
        nothing to compare, so that neither pictures nor metrics.json are written.

        Args:
            progress: called with the plant's name and the part that is done, 0 to 1.
            explain: says why the plants differ (`attribution.explain`); None: nobody asked.

        Raises:
            InputError: a file cannot be written, or the difference cannot be explained.
        """
        trajectories: dict[str, Trajectory] = {}
        walls: dict[str, float] = {}
        diverged: list[DivergedError] = []
        for kind in self.parts:
            self._warm_up(kind)
            start = time.perf_counter()
            try:
                trajectories[kind] = self._drive(kind, progress)
            except DivergedError as error:
                diverged.append(self._located(kind, error))
                trajectories[kind] = error.trajectory
            walls[kind] = time.perf_counter() - start
        attribution, unexplained = None, []
        if explain is not None and not diverged:
            told = None if progress is None else partial(progress, "why they differ")
            try:
                attribution = explain(self.scenario, trajectories, progress=told)
            except DivergedError as error:
                unexplained.append(error)
        # Only now and all at once: an interrupt or a full disk leaves what an earlier run wrote.
        with replaced(self.folder, _OF_REPLAYS) as fresh:
            (fresh / RESOLVED).write_text(dump_yaml(self.scenario.document), "utf-8")
            for kind, trajectory in trajectories.items():
                trajectory.to_parquet(fresh / f"{kind}.parquet")
            if (measured := self.scenario.measured) is not None:
                measured.to_parquet(fresh / f"{MEASURED}.parquet")
            if diverged:
                return RunResult(self.scenario.name, self.folder, trajectories, diverged=tuple(diverged))
            result = self._measure(fresh, trajectories, walls, attribution)
        return replace(result, unexplained=tuple(unexplained))

    def _warm_up(self, kind: str) -> None:
        """Let a plant vent for a tick: kernels that are not compiled yet are no part of a run's time."""
        plant, _ = self.parts[kind]
        plant.step(np.full((plant.spec.segments, 2), -1, dtype=np.int8))

    def _drive(self, kind: str, progress: Progress | None) -> Trajectory:
        plant, controller = self.parts[kind]
        scenario = self.scenario
        watcher = None if progress is None else _Watcher(kind, scenario.duration, progress)
        trajectory = rollout(
            plant, controller, scenario.duration, pose=scenario.pose, seed=scenario.seed,
            record_hz=scenario.record_hz, progress=watcher,
        )  # fmt: skip
        if progress is not None:
            progress(kind, 1.0)
        return trajectory

    def _located(self, kind: str, error: DivergedError) -> DivergedError:
        """Say in the message which scenario it was and where its trajectory is kept."""
        kept = shown(self.folder / f"{kind}.parquet")
        error.args = (f"{self.scenario.name}: {error}; what it did up to there is in {kept}",)
        return error

    def _measure(
        self,
        fresh: Path,
        trajectories: Mapping[str, Trajectory],
        walls: Mapping[str, float],
        attribution: Attribution | None,
    ) -> RunResult:
        # rerun alone takes half a second to import: not before there is something to show.
        from srs_twin.viewing.html.report import write_report
        from srs_twin.viewing.rerun.recording import write_recording

        scenario = self.scenario
        # The plants' own robot: a scenario may have taken its gaps away.
        spec = [plant.spec for plant, _ in self.parts.values()][-1]
        both = all(plant in trajectories for plant in PLANTS)
        comparison = _compare(scenario, trajectories) if both else None
        metrics: dict[str, Any] = {
            "scenario": scenario.name,
            "robot": scenario.robot.name,
            "plants": {k: plant_metrics(t, wall_s=walls[k]) for k, t in trajectories.items()},
            "comparison": comparison.metrics if comparison else None,
            "events": {k: _notable(t) for k, t in trajectories.items()},
        }
        differences: dict[str, MeasuredDifference] = {}
        if scenario.measured is not None:
            differences = {k: MeasuredDifference.of(scenario.measured, t) for k, t in trajectories.items()}
            for kind, difference in differences.items():
                metrics["plants"][kind] |= difference.metrics
            metrics["plants"][MEASURED] = plant_metrics(scenario.measured)
            metrics["residuals"] = {k: difference.document() for k, difference in differences.items()}
        if attribution is not None:
            metrics["attribution"] = attribution.document()
        metrics["expectations"] = [each.check(metrics) for each in scenario.expect]
        metrics["versions"] = versions()
        drawn = dict(trajectories)
        if scenario.measured is not None:
            drawn[MEASURED] = scenario.measured
        write_report(
            fresh / REPORT, scenario_title=scenario.title, spec=spec, trajectories=drawn,
            metrics=metrics, comparison=comparison, attribution=attribution, measured=differences,
        )  # fmt: skip
        write_recording(
            fresh / RECORDING, spec=spec, trajectories=drawn, comparison=comparison,
            title=scenario.title, world=scenario.world, measured=differences,
        )  # fmt: skip
        (fresh / METRICS).write_text(json.dumps(metrics, indent=2, allow_nan=False) + "\n", "utf-8")
        return RunResult(scenario.name, self.folder, trajectories, metrics)


def _notable(trajectory: Trajectory) -> list[dict[str, Any]]:
    """Return what a person should know of a run: faults, and why it ended before its time."""
    told = [asdict(event) for event in trajectory.events if event.kind == "fault"]
    by = trajectory.metadata.get("ended_by")
    if by is not None:
        told.append({"time": float(trajectory.time[-1]), "kind": "ended", "text": f"the run, by its {by}"})
    return told


def _compare(scenario: Scenario, trajectories: Mapping[str, Trajectory]) -> Comparison:
    analytical, twin = (trajectories[plant] for plant in PLANTS)
    return compare(analytical, twin, gap_factor=scenario.file.comparison.gap_factor)


class _Watcher:
    """Reports a rollout's progress, a hundred times at most."""

    def __init__(self, kind: str, duration: float, progress: Progress) -> None:
        self._kind, self._duration, self._progress = kind, duration, progress
        self._told = 0
        progress(kind, 0.0)

    def __call__(self, time: float) -> None:
        part = time / self._duration
        if self._told < int(100 * part) < 100:
            self._told = int(100 * part)
            self._progress(self._kind, part)


def prepare(scenario: Scenario, out: Path, *, plants: Sequence[str] | None = None) -> PreparedRun:
    """Build the plants and controllers of a scenario and open its folder; simulate nothing.

    Args:
        scenario: what to run.
        out: folder for the files; made where it is missing, may hold other files.
        plants: which plants, in this order; None takes those the scenario names.

    Raises:
        InputError: a plant, a controller or the folder cannot be had as asked.
    """
    kinds = tuple(plants or scenario.plants)
    with scenario.named_in_errors():
        parts = {kind: (scenario.build_plant(kind), scenario.build_controller()) for kind in kinds}
    open_folder(out, _OF_REPLAYS)
    return PreparedRun(scenario, out, parts)


def run_scenario(
    scenario: Scenario, out: Path, *, plants: Sequence[str] | None = None, progress: Progress | None = None
) -> RunResult:
    """Run a scenario and leave its files: `prepare`, then `PreparedRun.execute`.

    Raises:
        InputError: bad input, or a folder that cannot be written; found before simulating.
    """
    return prepare(scenario, out, plants=plants).execute(progress)


KINDS = (*PLANTS, "measured")
"""Whose trajectories a folder may hold."""


@dataclass(frozen=True)
class FinishedRun:
    """What a run left.

    Attributes:
        folder: where it lies.
        scenario: what was run, defaults and robot written out.
        trajectories: plant → what it did, in the order of `KINDS`.
    """

    folder: Path
    scenario: Scenario
    trajectories: Mapping[str, Trajectory]

    @property
    def name(self) -> str:
        """What it is called: its folder."""
        return self.folder.resolve().name


def load_run(run: str | Path) -> FinishedRun:
    """Read a run back.

    Args:
        run: its folder, or a name in ``./runs``.

    Raises:
        InputError: there is none, or its files are not what a run leaves.
    """
    folder = find_run(run)
    found = {kind: folder / f"{kind}.parquet" for kind in KINDS if (folder / f"{kind}.parquet").is_file()}
    if not found:
        raise InputError(f"{shown(folder)}: holds no trajectory; `srs-twin run SCENARIO` leaves them")
    scenario = load_scenario(folder / RESOLVED)
    return FinishedRun(
        folder, scenario, {kind: Trajectory.from_parquet(path) for kind, path in found.items()}
    )


def find_run(run: str | Path) -> Path:
    """Return the folder that a run left: as given, or of that name in ``./runs``.

    Raises:
        InputError: there is none.
    """
    looked = [Path(run), Path("runs") / run]
    for folder in looked:
        if (folder / RESOLVED).is_file():
            return folder
    tried = " and ".join(shown(path / RESOLVED) for path in looked)
    raise InputError(f"{run}: no run there (looked for {tried}); `srs-twin run SCENARIO` makes one")
