"""An experiment in a run folder: simulate, measure, compare, write, read back.

The way of the data in one place: scenario → plants → trajectories → metrics → comparison → files. A run that
is over is read back from its folder, for what is looked at later.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.comparison.compare import Comparison, MeasuredDifference
from srs_twin.comparison.compare import compare as difference
from srs_twin.comparison.metrics import headline, plant_metrics
from srs_twin.comparison.undefined import why_undefined
from srs_twin.control.base import Controller
from srs_twin.errors import DivergedError, InputError
from srs_twin.io.documents import dump_yaml
from srs_twin.io.file_sets import replaced
from srs_twin.io.files import data_root, open_folder, shipped_names, shown
from srs_twin.plants.base import Plant
from srs_twin.plants.twin.mjcf.numerics import UNSTATED_CONTACT
from srs_twin.robot.spec import RobotSpec
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.scenario.plants import PLANTS
from srs_twin.scenario.provenance import judged_digest, versions
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from srs_twin.comparison.compare import Attribution


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

    @classmethod
    def of(cls, scenario: Scenario, folder: Path, plants: Sequence[str] | None) -> PreparedRun:
        """Build plants and controllers; arguments as in `prepare`."""
        kinds, scenario = tuple(plants or scenario.plants), scenario.run_on(plants)
        with scenario.named_in_errors():
            parts = {kind: (scenario.build_plant(kind), scenario.build_controller()) for kind in kinds}
        return cls(scenario, folder, parts)

    def execute(
        self,
        progress: Progress | None = None,
        *,
        explain: Explain | None = None,
        cause: Callable[..., dict[str, Any] | None] | None = None,
    ) -> RunResult:
        """Simulate every plant, measure, compare and write the files, metrics.json last.

        A plant that diverges leaves what it did up to there, and the others still run; then there is
        nothing to compare, so that neither pictures nor metrics.json are written.

        Args:
            progress: called with the plant's name and the part that is done, 0 to 1.
            explain: says why the plants differ (`attribution.explain`); None: nobody asked.
            cause: says what the main cause changes (`attribution.main_cause`), where `explain` is not asked.

        Raises:
            InputError: a file cannot be written, or the difference cannot be explained.
        """
        scenario = self.scenario
        trajectories: dict[str, Trajectory] = {}
        walls: dict[str, float] = {}
        diverged: list[DivergedError] = []
        for kind, (plant, controller) in self.parts.items():
            # Kernels that are not compiled yet are no part of a run's time.
            plant.step(np.full((plant.spec.segments, 2), -1, dtype=np.int8))
            watch = _percents(partial(progress, kind) if progress else None, scenario.duration)
            start = time.perf_counter()
            try:
                trajectories[kind] = rollout(plant, controller, **scenario.timing, progress=watch)
                watch(scenario.duration)
            except DivergedError as error:
                kept = shown(self.folder / f"{kind}.parquet")
                error.args = (f"{scenario.name}: {error}; what it did up to there is in {kept}",)
                diverged.append(error)
                trajectories[kind] = error.trajectory
            walls[kind] = time.perf_counter() - start
        attribution, unexplained = None, []
        if explain is not None and not diverged:
            explaining = partial(progress, "why they differ") if progress else None
            try:
                attribution = explain(scenario, trajectories, progress=explaining)
            except DivergedError as error:
                unexplained.append(error)
        main = cause(scenario, trajectories) if cause is not None and not (diverged or attribution) else None
        # Only now and all at once: an interrupt or a full disk leaves what an earlier run wrote.
        with replaced(self.folder, _OF_REPLAYS) as fresh:
            (fresh / RESOLVED).write_text(dump_yaml(scenario.document), "utf-8")
            for kind, trajectory in trajectories.items():
                trajectory.to_parquet(fresh / f"{kind}.parquet")
            if scenario.measured is not None:
                scenario.measured.to_parquet(fresh / f"{MEASURED}.parquet")
            if diverged:
                return RunResult(scenario.name, self.folder, trajectories, diverged=tuple(diverged))
            metrics, shared = self.measure(trajectories, walls, attribution, main)
            self._write(fresh, metrics, shared, attribution)
        return RunResult(scenario.name, self.folder, trajectories, metrics, unexplained=tuple(unexplained))

    def measure(
        self,
        trajectories: Mapping[str, Trajectory],
        walls: Mapping[str, float],
        attribution: Attribution | None = None,
        cause: dict[str, Any] | None = None,
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return what stands in metrics.json, and what report and recording show besides.

        Args:
            trajectories: plant → what it did.
            walls: plant → how long that took, s.
            attribution: why they differ, where somebody asked.
            cause: the main cause, see `execute`.
        """
        scenario, measured = self.scenario, self.scenario.measured
        comparison = None
        if all(plant in trajectories for plant in PLANTS):
            factor = scenario.file.comparison.gap_factor
            comparison = difference(*(trajectories[plant] for plant in PLANTS), gap_factor=factor)
        metrics: dict[str, Any] = {
            "scenario": scenario.name,
            "robot": scenario.robot.name,
            "plants": {k: plant_metrics(t, wall_s=walls[k]) for k, t in trajectories.items()},
            "comparison": comparison.metrics if comparison else None,
            "events": {k: _notable(t) for k, t in trajectories.items()},
            "changes": list(scenario.changes),
        }
        drawn, differences = dict(trajectories), {}
        if measured is not None:
            drawn[MEASURED] = measured
            differences = {k: MeasuredDifference.of(measured, t) for k, t in trajectories.items()}
            for kind, apart in differences.items():
                metrics["plants"][kind] |= apart.metrics
            metrics["plants"][MEASURED] = plant_metrics(measured)
            metrics["residuals"] = {k: apart.document() for k, apart in differences.items()}
        if attribution is not None:
            metrics["attribution"] = attribution.document()
        if cause is not None:
            metrics["cause"] = cause
        twin = scenario.file.plants.twin
        if "twin" in trajectories and twin and twin.searched_with:
            metrics["preset"] = twin.searched_with
        # What was said of a plant that the scenario names and nobody asked to run is not missed.
        there = {*trajectories, *(["comparison"] if comparison else ())}
        asked = [each for each in scenario.expect if each.subject in there or set(scenario.plants) <= there]
        if any(each.within for each in asked):
            metrics["intervals"] = kept_intervals(scenario)
        lacks = [why_undefined(each.metric, each.subject, metrics, drawn) for each in asked]
        metrics["expectations"] = [each.check(metrics, why) for each, why in zip(asked, lacks, strict=True)]
        metrics["left_out"] = [each for each in scenario.left_out if each["of"] in there]
        metrics.get("intervals", {}).pop("plants", None)
        metrics["versions"] = versions()
        # The plants' own robot: a scenario may have taken its gaps away.
        spec = [plant.spec for plant, _ in self.parts.values()][-1]
        return metrics, {
            "spec": spec,
            "trajectories": drawn,
            "comparison": comparison,
            "measured": differences,
        }

    def _write(
        self, fresh: Path, metrics: dict[str, Any], shared: dict[str, Any], attribution: Attribution | None
    ) -> None:
        """Write report, recording and metrics into a folder."""
        # rerun alone takes half a second to import: not before there is something to show.
        from srs_twin.viewing.html.report import write_report
        from srs_twin.viewing.rerun.recording import write_recording

        title = self.scenario.title
        write_report(fresh / REPORT, scenario_title=title, metrics=metrics, attribution=attribution, **shared)
        write_recording(fresh / RECORDING, title=title, world=self.scenario.world, **shared)
        (fresh / METRICS).write_text(json.dumps(metrics, indent=2, allow_nan=False) + "\n", "utf-8")


INTERVALS = Path("calibration/intervals")


def twin_contact(scenario: Scenario) -> str | None:
    """Return the contact of a scenario's twin; None: no twin runs, or it stands on no floor."""
    contact: str | None = (scenario.document["plants"].get("twin") or {}).get("contact")
    return contact


def kept_intervals(scenario: Scenario) -> dict[str, Any]:
    """Return the intervals stored by `srs-twin uncertainty SCENARIO --write`: in this folder, else shipped.

    Returns:
        The file's document, with "stale": the reason why it does not apply, None where robot and scenario are
        those that it was made from; "renew": the command that renews it.
    """
    given = scenario.name if scenario.name in shipped_names("scenario") else scenario.source
    name, renew = f"{scenario.name}.json", f"`srs-twin uncertainty {given} --write`"
    path = next((p for p in (INTERVALS / name, data_root() / INTERVALS / name) if p.is_file()), None)
    if path is None:
        return {"stale": f"no interval is stored; {renew} makes one"}
    try:
        found = json.loads(path.read_text("utf-8"))
        kept, plants = found["digest"], found["plants"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        return {"stale": f"{shown(path)} cannot be read ({error}); {renew} writes it again"}
    own, here = found.get("contact") or UNSTATED_CONTACT, twin_contact(scenario)
    if "twin" in plants and here is not None and own != here:
        return {
            "stale": f"the interval in {shown(path)} is for a twin with contact {own}, not {here}; "
            f"{renew} renews it"
        }
    if kept != judged_digest(scenario.document):
        return {"stale": f"the interval in {shown(path)} is for another robot or scenario; {renew} renews it"}
    return {"stale": None, "file": shown(path), "renew": renew, "plants": plants}


def _notable(trajectory: Trajectory) -> list[dict[str, Any]]:
    """Return what a person should know of a run: faults, and why it ended before its time."""
    events = [asdict(event) for event in trajectory.events if event.kind == "fault"]
    by = trajectory.metadata.get("ended_by")
    if by is not None:
        events.append({"time": float(trajectory.time[-1]), "kind": "ended", "text": f"the run, by its {by}"})
    return events


def _percents(progress: Callable[[float], None] | None, duration: float) -> Callable[[float], None]:
    """Return what reports the part of a run that is done, once a percent, given the simulated time (s)."""
    reported = -1

    def watch(time: float) -> None:
        nonlocal reported
        percent = int(100 * time / duration + 1e-9)
        if progress is not None and percent > reported:
            reported = percent
            progress(percent / 100)

    watch(0.0)
    return watch


@dataclass(frozen=True)
class ComparedRuns(Comparison):
    """A scenario on both plants, and how far they are apart; a notebook shows it as a page.

    Attributes:
        title: of the scenario.
        trajectories: plant → what it did.
        results: what stands in metrics.json.
        spec: the robot that ran.
    """

    title: str
    trajectories: Mapping[str, Trajectory]
    results: Mapping[str, Any]
    spec: RobotSpec

    def __str__(self) -> str:
        """Return the sentence that says what the run says."""
        return headline(self.results)

    def _repr_html_(self) -> str:
        from srs_twin.viewing.html.report import shown_run

        return shown_run(self.title, self.results, self.trajectories, self.spec)

    def show(self) -> None:
        """Show the page in a notebook; elsewhere print its sentence."""
        try:
            from IPython.display import display
        except ImportError:
            print(self)
        else:
            display(self)


def compare(
    reference: Trajectory | Scenario | str | Path,
    candidate: Trajectory | None = None,
    *,
    set: Mapping[str, Any] | None = None,
    gap_factor: bool = False,
) -> Comparison:
    """Compare two runs, or run a scenario on both plants and compare these.

    Args:
        reference: the analytical model's run; or a scenario, by itself, by name or by path.
        candidate: the twin's run; None with a scenario.
        set: dotted fields of the scenario and their values, as `load_scenario` takes them.
        gap_factor: of two runs, see `comparison.compare.compare`; a scenario says so itself.

    Returns:
        Of a scenario `ComparedRuns`, which holds the trajectories as well.

    Raises:
        InputError: as in `comparison.compare.compare` and `load_scenario`, or a part is missing.
        DivergedError: a plant's state is no longer finite.
    """
    if isinstance(reference, Trajectory):
        if candidate is None or set is not None:
            raise InputError("two trajectories are compared, or a scenario with what is set of it")
        return difference(reference, candidate, gap_factor=gap_factor)
    if candidate is not None:
        raise InputError("a scenario is run on both plants: there is nothing to compare it with")
    if isinstance(reference, Scenario):
        scenario = parse_scenario(reference.document, name=reference.name, set=set or {})
    else:
        scenario = load_scenario(reference, set=set or {})
    run = PreparedRun.of(scenario, Path(), PLANTS)
    trajectories, walls = {}, {}
    for kind, (plant, controller) in run.parts.items():
        start = time.perf_counter()
        trajectories[kind] = rollout(plant, controller, **scenario.timing)
        walls[kind] = time.perf_counter() - start
    results, shared = run.measure(trajectories, walls)
    found = shared["comparison"]
    parts = {each.name: getattr(found, each.name) for each in fields(found)}
    return ComparedRuns(
        **parts, title=run.scenario.title, trajectories=trajectories, results=results, spec=shared["spec"]
    )


def prepare(scenario: Scenario, out: Path, *, plants: Sequence[str] | None = None) -> PreparedRun:
    """Build the plants and controllers of a scenario and open its folder; simulate nothing.

    Args:
        scenario: what to run.
        out: folder for the files; made where it is missing, may hold other files.
        plants: which plants, in this order; None takes those the scenario names.

    Raises:
        InputError: a plant, a controller or the folder cannot be had as asked.
    """
    found = PreparedRun.of(scenario, out, plants)
    open_folder(out, _OF_REPLAYS)
    return found


def check_run(scenario: Scenario, out: Path) -> None:
    """See that a scenario can run into a folder, before anything is built or simulated.

    Raises:
        InputError: the folder cannot be written, or nothing can be planned.
    """
    open_folder(out, _OF_REPLAYS)
    scenario.check_run()


def run_scenario(
    scenario: Scenario, out: Path, *, plants: Sequence[str] | None = None, progress: Progress | None = None
) -> RunResult:
    """Run a scenario and leave its files: `prepare`, then `PreparedRun.execute`.

    Raises:
        InputError: bad input, or a folder that cannot be written; found before simulating.
    """
    return prepare(scenario, out, plants=plants).execute(progress)


@dataclass(frozen=True)
class FinishedRun:
    """What a run left.

    Attributes:
        folder: where it lies.
        scenario: what was run, defaults and robot written out.
        trajectories: plant → what it did, the plants' before what was measured.
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
    paths = {kind: folder / f"{kind}.parquet" for kind in (*PLANTS, MEASURED)}
    found = {kind: Trajectory.from_parquet(path) for kind, path in paths.items() if path.is_file()}
    if not found:
        raise InputError(f"{shown(folder)}: holds no trajectory; `srs-twin run SCENARIO` leaves them")
    return FinishedRun(folder, load_scenario(folder / RESOLVED), found)


def find_run(run: str | Path) -> Path:
    """Return the folder that a run left: as given, or of that name in ``./runs``.

    Raises:
        InputError: there is none.
    """
    looked = [Path(run), Path("runs") / run]
    for folder in looked:
        if os.path.isfile(folder / RESOLVED):
            return folder
    tried = " and ".join(shown(path / RESOLVED) for path in looked)
    raise InputError(f"{run}: no run there (looked for {tried}); `srs-twin run SCENARIO` makes one")
