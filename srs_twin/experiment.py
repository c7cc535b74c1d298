"""Functions that run a scenario, compare the plants and write the results."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from srs_twin.comparison.centre_line import body_overlap
from srs_twin.comparison.compare import (
    Attribution,
    Comparison,
    MeasuredDifference,
    compare as difference,
)
from srs_twin.comparison.contacts import (
    contact_events,
    contact_free_s,
    ignores_obstacles,
)
from srs_twin.comparison.metrics import (
    MainCause,
    PartMetrics,
    RunMetrics,
    StoredIntervals,
    check_plugin_metrics,
    headline,
    plant_metrics,
)
from srs_twin.comparison.undefined import why_undefined
from srs_twin.control.base import Controller
from srs_twin.errors import DivergedError, InputError, named_in_errors
from srs_twin.extensions import reading
from srs_twin.io.arguments import checked
from srs_twin.io.documents import Overrides, dump_yaml
from srs_twin.io.file_sets import replace_files
from srs_twin.io.files import (
    METRICS,
    RUN_MARKS,
    StrPath,
    check_output_folder,
    data_root,
    display_path,
    folder_or_temporary,
    shipped_names,
)
from srs_twin.plants.base import Plant
from srs_twin.plants.twin.mjcf.numerics import UNSTATED_CONTACT
from srs_twin.robot.spec import RobotSpec
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import load_scenario
from srs_twin.scenario.plants import PLANTS
from srs_twin.scenario.provenance import judged_provenance, versions
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.content import RunContent, end_event

RESOLVED = "scenario.resolved.yaml"
"""File name of the resolved scenario, which contains all defaults and the robot."""
REPORT = "report.html"
RECORDING = "recording.rrd"
MEASURED = "measured"
"""Key of the measured trajectory in a dictionary of trajectories."""
PRODUCTS = (
    METRICS,
    RESOLVED,
    REPORT,
    RECORDING,
    *(f"{plant}.parquet" for plant in PLANTS),
)
"""Files that a run writes. The file metrics.json exists only if the run is complete."""
_ALL_PRODUCTS = (*PRODUCTS, f"{MEASURED}.parquet")

Progress = Callable[..., None]
"""Callback that receives the name of a task, the completed fraction (0 to 1) and
optionally the remaining time (s)."""
FindCause = Callable[[Scenario, Mapping[str, Trajectory]], MainCause | None]
"""Function that computes the main cause of the difference between the plants
(`attribution.main_cause`)."""
Explain = Callable[..., Attribution]
"""Function that attributes the difference between the plants, such as
`attribution.explain`."""


@dataclass(frozen=True)
class RunResult:
    """Result of a run.

    Attributes:
        name: name of the scenario.
        folder: output folder, which no longer exists if it was temporary.
        trajectories: trajectory of each plant, keyed by plant name. The trajectory of a
            diverged plant ends at the divergence.
        metrics: content of metrics.json, or an empty dictionary if a plant diverged.
        diverged: errors of diverged plants, whose messages contain the path of the
            recorded trajectory.
        failed_attributions: errors of simulations that diverged during the attribution.
    """

    name: str
    folder: Path
    trajectories: Mapping[str, Trajectory]
    metrics: RunMetrics = field(default_factory=RunMetrics)
    diverged: tuple[DivergedError, ...] = ()
    failed_attributions: tuple[DivergedError, ...] = ()


@dataclass(frozen=True)
class _Simulated:
    trajectories: dict[str, Trajectory] = field(default_factory=dict)
    walls: dict[str, float] = field(default_factory=dict)
    diverged: list[DivergedError] = field(default_factory=list)


@dataclass(frozen=True)
class PreparedRun:
    """Scenario that is ready to run, with its plants, controllers and output folder."""

    scenario: Scenario
    folder: Path
    pairs: Mapping[str, tuple[Plant, Controller]]

    @classmethod
    def build(
        cls, scenario: Scenario, folder: Path, plants: Sequence[str] | None
    ) -> PreparedRun:
        """Build the plants and controllers of a scenario."""
        check_plugin_metrics()
        kinds = scenario.plants_to_run(plants)
        scenario = scenario.run_on(plants)
        with named_in_errors(scenario.source):
            pairs = {
                kind: (scenario.build_plant(kind), scenario.build_controller())
                for kind in kinds
            }
        return cls(scenario, folder, pairs)

    def execute(
        self,
        progress: Progress | None = None,
        *,
        explain: Explain | None = None,
        main_cause: FindCause | None = None,
    ) -> RunResult:
        """Simulate all plants, compute and compare metrics, and write the files.

        The Rerun recording is omitted if Rerun is not installed. If a plant diverges,
        the remaining plants are still simulated, but only the resolved scenario and the
        trajectories are written.

        Args:
            progress: callback that receives the plant name, or "attribution", and the
                completed fraction (0 to 1).
            explain: function that attributes the difference between the plants
                (`attribution.explain`), or None to skip the attribution.
            main_cause: function that computes the main cause of the difference
                (`attribution.main_cause`) if there is no attribution, or None.

        Raises:
            InputError: a file cannot be written, or the difference cannot be
                attributed.
        """
        scenario = self.scenario
        if explain is not None:
            scenario.robot.require_planar("the attribution of a difference")
        done = _Simulated()
        for kind, (plant, controller) in self.pairs.items():
            # This step compiles the kernels, so the measured time excludes compilation.
            shape = (plant.spec.segments, plant.spec.chambers)
            plant.step(np.full(shape, -1, dtype=np.int8))
            report = partial(progress, kind) if progress else None
            watch = _percents(report, scenario.duration)
            start = time.perf_counter()
            try:
                done.trajectories[kind] = rollout(
                    plant, controller, **scenario.timing, progress=watch
                )
                watch(scenario.duration)
            except DivergedError as error:
                path = display_path(self.folder / f"{kind}.parquet")
                text = (
                    f"{scenario.name}: {error}; the trajectory up to that time is in"
                    f" {path}"
                )
                error.args = (text,)
                done.diverged.append(error)
                done.trajectories[kind] = error.trajectory
            done.walls[kind] = time.perf_counter() - start
        return self._conclude(done, progress, explain, main_cause)

    def _conclude(
        self,
        done: _Simulated,
        progress: Progress | None,
        explain: Explain | None,
        main_cause: FindCause | None,
    ) -> RunResult:
        scenario = self.scenario
        attribution = None
        failed: tuple[DivergedError, ...] = ()
        if explain is not None and _can_be_explained(done):
            try:
                attribution = explain(
                    scenario,
                    done.trajectories,
                    progress=partial(progress, "attribution") if progress else None,
                    wall_s=done.walls,
                )
            except DivergedError as error:
                failed = (error,)
        cause = None
        if main_cause is not None and not (done.diverged or attribution):
            cause = main_cause(scenario, done.trajectories)
        metrics: RunMetrics = {}
        # All files are replaced together at the end, so the files of an earlier run
        # survive an interruption or a full disk.
        with replace_files(self.folder, _ALL_PRODUCTS) as fresh:
            self._write_trajectories(fresh, done.trajectories)
            if not done.diverged:
                metrics, content = self.measure(
                    done.trajectories, done.walls, attribution, cause
                )
                self._write(fresh, metrics, content, attribution)
        return RunResult(
            scenario.name,
            self.folder,
            done.trajectories,
            metrics,
            tuple(done.diverged),
            failed,
        )

    def _write_trajectories(
        self, fresh: Path, trajectories: Mapping[str, Trajectory]
    ) -> None:
        scenario = self.scenario
        (fresh / RESOLVED).write_text(dump_yaml(scenario.document), "utf-8")
        for kind, trajectory in trajectories.items():
            trajectory.to_parquet(fresh / f"{kind}.parquet")
        if scenario.measured is not None:
            scenario.measured.to_parquet(fresh / f"{MEASURED}.parquet")

    def measure(
        self,
        trajectories: Mapping[str, Trajectory],
        walls: Mapping[str, float],
        attribution: Attribution | None = None,
        cause: MainCause | None = None,
    ) -> tuple[RunMetrics, RunContent]:
        """Return the entries of metrics.json, and the data for report and recording.

        Args:
            trajectories: trajectory of each plant, keyed by plant name.
            walls: computing time of each plant, keyed by plant name, s.
            attribution: attribution of the difference, or None if it was not computed.
            cause: result of `attribution.main_cause`, or None if it was not computed.
        """
        scenario = self.scenario
        comparison = None
        if all(plant in trajectories for plant in PLANTS):
            factor = scenario.file.comparison.gap_factor
            both = (trajectories[plant] for plant in PLANTS)
            comparison = difference(*both, gap_factor=factor)
        metrics: RunMetrics = {
            "scenario": scenario.name,
            "robot": scenario.robot.name,
            "plants": {
                k: plant_metrics(t, wall_s=walls[k]) for k, t in trajectories.items()
            },
            "comparison": comparison.metrics if comparison else None,
            "events": {k: _notable(t) for k, t in trajectories.items()},
            "changes": list(scenario.changes),
        }
        metrics |= self._contact_entries(trajectories)
        drawn = dict(trajectories)
        differences = {}
        if scenario.measured is not None:
            drawn[MEASURED] = scenario.measured
            differences = _compare_with_measured(
                scenario.measured, metrics, trajectories
            )
        if attribution is not None:
            metrics["attribution"] = attribution.document()
        if cause is not None:
            metrics["cause"] = cause
        twin = scenario.file.plants.twin
        if "twin" in trajectories and twin and twin.fast_preset:
            metrics["preset"] = twin.fast_preset
        metrics |= self._judged(metrics, drawn) | {"versions": versions()}
        # The robot of a plant without rigid gaps differs from the robot of the
        # scenario.
        spec = [plant.spec for plant, _ in self.pairs.values()][-1]
        return metrics, RunContent(spec, drawn, comparison, differences, scenario.world)

    def _contact_entries(self, runs: Mapping[str, Trajectory]) -> RunMetrics:
        entries: RunMetrics = {}
        ignoring = [kind for kind, run in runs.items() if ignores_obstacles(run)]
        if ignoring:
            entries["ignores_obstacles"] = ignoring
        before = _before_contact(runs)
        if before and runs.keys() >= set(PLANTS):
            entries["before_contact"] = before
        overlaps = {
            kind: body_overlap(run, self.pairs[kind][0].spec.geometry)
            for kind, run in runs.items()
        }
        if any(overlaps.values()):
            entries["body_overlap_m"] = {
                k: size for k, size in overlaps.items() if size
            }
        return entries

    def _judged(
        self, metrics: RunMetrics, runs: Mapping[str, Trajectory]
    ) -> RunMetrics:
        """Return the entries of metrics.json that concern expectations."""
        scenario = self.scenario
        # Expectations about a plant that did not run are not checked.
        available = metrics["plants"].keys() - {MEASURED}
        if metrics["comparison"]:
            available |= {"comparison"}
        complete = set(scenario.plants) <= available
        expected = [
            item for item in scenario.expect if item.subject in available or complete
        ]
        entries: RunMetrics = {}
        if any(item.within for item in expected):
            entries["intervals"] = stored_intervals(scenario)
        known = metrics | entries
        entries["expectations"] = [
            item.check(known, why_undefined(item.metric, item.subject, known, runs))
            for item in expected
        ]
        entries["left_out"] = [
            row for row in scenario.left_out if row["of"] in available
        ]
        entries.get("intervals", {}).pop("plants", None)
        return entries

    def _write(
        self,
        fresh: Path,
        metrics: RunMetrics,
        content: RunContent,
        attribution: Attribution | None,
    ) -> None:
        # These imports are local, because the import of rerun takes half a second.
        from srs_twin.viewing.html.report import write_report
        from srs_twin.viewing.rerun.viewer import has_rerun

        title = self.scenario.title
        report = fresh / REPORT
        write_report(
            report,
            content,
            scenario_title=title,
            metrics=metrics,
            attribution=attribution,
        )
        if has_rerun():
            from srs_twin.viewing.rerun.recording import write_recording

            write_recording(fresh / RECORDING, content, title=title)
        (fresh / METRICS).write_text(
            json.dumps(metrics, indent=2, allow_nan=False) + "\n", "utf-8"
        )


INTERVALS = Path("calibration/intervals")
"""Folder of the stored uncertainty intervals."""


def twin_contact(scenario: Scenario) -> str | None:
    """Return the name of the twin's contact model, or None if the scenario has none."""
    contact: str | None = (scenario.document["plants"].get("twin") or {}).get("contact")
    return contact


def stored_intervals(scenario: Scenario) -> StoredIntervals:
    """Return the intervals that `srs-twin uncertainty SCENARIO --write` has stored.

    The interval file is looked up first in the current folder, and then among the
    shipped files.

    Returns:
        Dictionary with an entry "stale", which states why no stored interval applies.
        If intervals apply, "stale" is None, the entry "file" is the path of the
        interval file, and "renew" is the command that updates the file. The entry
        "plants" contains the metric intervals of each plant. The entry "segments"
        contains the speed ranges of the twin for plausible values of segment stiffness
        and damping, or is None.
    """
    if scenario.name in shipped_names("scenario"):
        reference = scenario.name
    else:
        reference = scenario.source
    name = f"{scenario.name}.json"
    renew = f"`srs-twin uncertainty {reference} --write`"
    path = next(
        (p for p in (INTERVALS / name, data_root() / INTERVALS / name) if p.is_file()),
        None,
    )
    if path is None:
        return {"stale": f"no interval is stored; the command {renew} stores one"}
    try:
        data = json.loads(path.read_text("utf-8"))
        digest = data["digest"]
        plants = data["plants"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        reason = (
            f"{display_path(path)} cannot be read ({error}); the command {renew}"
            " writes this file again"
        )
        return {"stale": reason}
    own = data.get("contact") or UNSTATED_CONTACT
    contact = twin_contact(scenario)
    shown = f"the interval in {display_path(path)}"
    if "twin" in plants and contact is not None and own != contact:
        reason = (
            f"{shown} belongs to a twin with the contact '{own}', but this twin has"
            f" the contact '{contact}'; the command {renew} computes the interval"
            " again"
        )
        return {"stale": reason}
    if digest != judged_provenance(scenario.document).key:
        reason = (
            f"{shown} was computed for another robot or scenario; the command {renew}"
            " computes the interval again"
        )
        return {"stale": reason}
    return {
        "stale": None,
        "file": display_path(path),
        "renew": renew,
        "plants": plants,
        "segments": data.get("segments"),
    }


def _notable(trajectory: Trajectory) -> list[dict[str, object]]:
    faults = [event for event in trajectory.events if event.kind == "fault"]
    return [
        asdict(event)
        for event in (*faults, *contact_events(trajectory), *end_event(trajectory))
    ]


def _compare_with_measured(
    measured: Trajectory,
    metrics: RunMetrics,
    trajectories: Mapping[str, Trajectory],
) -> dict[str, MeasuredDifference]:
    differences = {
        kind: MeasuredDifference.between(measured, run)
        for kind, run in trajectories.items()
    }
    for kind, deviation in differences.items():
        metrics["plants"][kind] |= deviation.metrics
    metrics["plants"][MEASURED] = plant_metrics(measured)
    metrics["residuals"] = {k: each.document() for k, each in differences.items()}
    return differences


def _can_be_explained(done: _Simulated) -> bool:
    if done.diverged:
        return False
    before = _before_contact(done.trajectories)
    if before is None:
        return True
    return all(row["com_speed_m_s"] is not None for row in before["plants"].values())


def _before_contact(runs: Mapping[str, Trajectory]) -> PartMetrics | None:
    """Return speeds and yaw rates before the first contact, or None if there is none.

    Speed and yaw rate are None if too few whole gait periods precede the contact.
    """
    end = contact_free_s(runs.values())
    names = ("com_speed_m_s", "yaw_rate_rad_s")
    if math.isinf(end):
        return None
    metrics = {kind: plant_metrics(run.between(0.0, end)) for kind, run in runs.items()}
    return {
        "end_s": end,
        "plants": {
            k: {name: row[name] for name in names} for k, row in metrics.items()
        },
    }


def _percents(
    progress: Callable[[float], None] | None, duration: float
) -> Callable[[float], None]:
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
    """Comparison of the two plants of a scenario, which notebooks display as a page."""

    title: str
    trajectories: Mapping[str, Trajectory]
    results: RunMetrics
    spec: RobotSpec

    def __str__(self) -> str:
        return headline(self.results)

    def _repr_html_(self) -> str:
        from srs_twin.viewing.html.report import notebook_run

        return notebook_run(self.title, self.results, self.trajectories, self.spec)

    def show(self) -> None:
        """Display the comparison as a page in a notebook, or print it elsewhere."""
        try:
            from IPython.display import display
        except ImportError:
            print(self)
        else:
            display(self)


@checked
def compare(
    reference: Trajectory | Scenario | StrPath,
    candidate: Trajectory | None = None,
    *,
    set: Mapping[str, object] | None = None,
    gap_factor: bool = False,
) -> Comparison:
    """Compare two trajectories, or run a scenario and compare its plants.

    Args:
        reference: trajectory of the analytical model, or a scenario (object, name or
            path).
        candidate: trajectory of the twin, or None if `reference` is a scenario.
        set: values that override scenario fields, as described in `load_scenario`.
        gap_factor: whether to scale the speed as described in
            `comparison.compare.compare`. For a scenario, the key
            `comparison.gap_factor` in the file is used instead.

    Returns:
        Comparison of the plants. For a scenario, the result is a `ComparedRuns`, which
        also contains the trajectories.

    Raises:
        InputError: the combination of arguments is not allowed, the trajectories cannot
            be compared, or the scenario cannot be loaded.
        DivergedError: a plant diverged.
    """
    if isinstance(reference, Trajectory):
        if candidate is None or set is not None:
            raise InputError(
                "two trajectories or one scenario are needed, and the argument `set`"
                " is allowed only with a scenario; add the second trajectory, or"
                " remove `set`"
            )
        return difference(reference, candidate, gap_factor=gap_factor)
    if candidate is not None:
        raise InputError(
            "a scenario already runs on both plants; remove the second argument"
        )
    scenario = load_scenario(reference, set=set or {})
    run = PreparedRun.build(scenario, Path(), PLANTS)
    trajectories = {}
    walls = {}
    for kind, (plant, controller) in run.pairs.items():
        start = time.perf_counter()
        trajectories[kind] = rollout(plant, controller, **scenario.timing)
        walls[kind] = time.perf_counter() - start
    results, content = run.measure(trajectories, walls)
    assert content.comparison is not None, "both plants ran"
    return ComparedRuns(
        **vars(content.comparison),
        title=run.scenario.title,
        trajectories=trajectories,
        results=results,
        spec=content.spec,
    )


def prepare(
    scenario: Scenario, out: Path, *, plants: Sequence[str] | None = None
) -> PreparedRun:
    """Build the plants and controllers of a scenario and check the output folder.

    Args:
        scenario: scenario to run.
        out: output folder, which may not exist yet and may contain other files.
        plants: names of the plants in the order in which they run, or None for the
            plants of the scenario.

    Raises:
        InputError: a plant or controller cannot be built, or the folder is not
            writable.
    """
    run = PreparedRun.build(scenario, out, plants)
    check_output_folder(out, _ALL_PRODUCTS, marks=RUN_MARKS)
    return run


def check_run(scenario: Scenario, out: Path) -> None:
    """Check the output folder and the plan of a scenario.

    Raises:
        InputError: the folder is not writable, or the plan cannot be computed.
    """
    check_output_folder(out, _ALL_PRODUCTS, marks=RUN_MARKS)
    scenario.check_run()


@checked
def run_scenario(
    scenario: StrPath | Scenario,
    out: StrPath | None = None,
    *,
    set: Overrides = (),
    plants: Sequence[str] | None = None,
    progress: Progress | None = None,
    explain: Explain | None = None,
) -> RunResult:
    """Run a scenario, compare the metrics of the plants, and write the results.

    Args:
        scenario: name or path of a scenario, or a loaded scenario.
        out: output folder, or None to write no files.
        set: values that override scenario fields, as described in `load_scenario`.
        plants: names of the plants in the order in which they run, or None for the
            plants of the scenario.
        progress: callback that receives the plant name and the completed fraction.
        explain: function that attributes the difference between the plants
            (`attribution.explain`), or None to skip the attribution.

    Returns:
        Trajectories and metrics. If a plant diverges, the attribute `diverged` contains
        the error.

    Raises:
        InputError: the scenario cannot run, the folder is not writable, or the
            difference cannot be attributed.
    """
    loaded = load_scenario(scenario, set=set)
    with folder_or_temporary(out) as folder:
        return prepare(loaded, folder, plants=plants).execute(progress, explain=explain)


@dataclass(frozen=True)
class FinishedRun:
    """Finished run that was loaded from an output folder.

    Attributes:
        folder: output folder.
        scenario: resolved scenario, which contains all defaults and the robot.
        trajectories: trajectory of each plant, keyed by plant name, and the measured
            trajectory if there is one.
    """

    folder: Path
    scenario: Scenario
    trajectories: Mapping[str, Trajectory]

    @property
    def name(self) -> str:
        """Name of the output folder."""
        return self.folder.resolve().name


def load_run(run: str | Path) -> FinishedRun:
    """Load a finished run, given by output folder or by name in ``./runs``.

    Raises:
        InputError: the run does not exist, or its files are not valid.
    """
    folder = find_run(run)
    paths = {kind: folder / f"{kind}.parquet" for kind in (*PLANTS, MEASURED)}
    trajectories = {
        kind: Trajectory.from_parquet(path)
        for kind, path in paths.items()
        if path.is_file()
    }
    if not trajectories:
        raise InputError(
            f"{display_path(folder)}: the folder contains no trajectory; `srs-twin run"
            " SCENARIO` writes one"
        )
    with reading():
        return FinishedRun(folder, load_scenario(folder / RESOLVED), trajectories)


def find_run(run: str | Path) -> Path:
    """Return the output folder of a run, given by its path or by a name in ``./runs``.

    Raises:
        InputError: the run does not exist.
    """
    candidates = [Path(run), Path("runs") / run]
    for folder in candidates:
        if os.path.isfile(folder / RESOLVED):
            return folder
    files = " and ".join(display_path(path / RESOLVED) for path in candidates)
    raise InputError(
        f"{run}: no finished run was found (looked for {files}); `srs-twin run"
        " SCENARIO` creates one"
    )
