"""Planning of a scenario without simulation, with path quality and output files."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

from srs_twin.errors import InputError, named_in_errors
from srs_twin.io.arguments import checked
from srs_twin.io.documents import Overrides
from srs_twin.io.file_sets import replace_files
from srs_twin.io.files import StrPath, check_output_folder
from srs_twin.planning.collision import Checker
from srs_twin.planning.metrics import plan_metrics
from srs_twin.planning.problem import Plan
from srs_twin.scenario.loading import load_scenario
from srs_twin.scenario.scenario import Scenario

_ROUNDING = 1e-9
"""Path length that is considered 0 because of rounding errors, m."""

PLAN = "plan.json"
PICTURE = "plan.png"
_FILES = (PLAN, PICTURE)


@dataclass(frozen=True)
class PathQuality:
    """Quality of a planned path.

    Attributes:
        length_over_least: ratio of the path length to `Plan.least_length`, or None if
            the least length is 0 or exceeds the length of a given path.
        clearance_m: minimum distance of the footprint with its margin from obstacles
            and bounds, m.
    """

    length_over_least: float | None
    clearance_m: float


@dataclass(frozen=True)
class ScenarioPlan:
    """Plan of a scenario.

    Attributes:
        files: names of the written files, if an output folder was given.
    """

    scenario: Scenario
    plan: Plan
    files: tuple[str, ...] = ()

    @cached_property
    def metrics(self) -> dict[str, float | None]:
        """Metrics of the plan, keyed by their names in `srs-twin list metrics`."""
        return plan_metrics(self.plan.found, self.plan.segments, self.plan.expanded)

    @cached_property
    def quality(self) -> PathQuality | None:
        """Quality of the path, or None if no path was found."""
        result = self.plan
        if not result.found:
            return None
        assert result.problem is not None, "set by plan()"
        checker = Checker(result.problem.world, result.problem.footprint)
        least = result.least_length
        ratio = None
        # A given path may pass through obstacles, and be shorter than the least length.
        if _ROUNDING < least < result.length + _ROUNDING:
            ratio = result.length / least
        return PathQuality(ratio, checker.clearance(result.segments))

    def document(self) -> dict[str, object]:
        """Return the contents of the file `plan.json`."""
        result = self.plan
        problem = self.scenario.planner.problem
        return {
            "scenario": self.scenario.name,
            "outcome": result.outcome.value,
            "reason": result.reason,
            "start": asdict(problem.start),
            "world": asdict(problem.world),
            "goal": asdict(problem.goal),
            "segments": [asdict(segment) for segment in result.segments],
            **(
                {}
                if result.touches is None
                else {"touches": [asdict(touch) for touch in result.touches]}
            ),
            "quality": asdict(self.quality) if self.quality else None,
            "metrics": self.metrics,
            "changes": list(self.scenario.changes),
        }


@checked
def plan_scenario(
    scenario: StrPath | Scenario,
    *,
    out: StrPath | None = None,
    set: Overrides = (),
) -> ScenarioPlan:
    """Plan the path of a scenario without simulating it.

    The function `plan` solves a `Problem` instead of a scenario.

    Args:
        scenario: name or path of a scenario with a planner, or a loaded scenario.
        out: output folder, or None to write no files.
        set: new values for scenario fields, as described in `load_scenario`.

    Raises:
        InputError: the scenario is not valid or has no planner, or its start or goal is
            in an obstacle or outside the bounds.
    """
    loaded = load_scenario(scenario, set=set)
    if loaded.planner is None:
        raise InputError(
            f"{loaded.name}: the scenario has no planner; add the section `planner`,"
            " and set `controller.kind: follow`"
        )
    if out is not None:
        check_output_folder(Path(out), _FILES)
    with named_in_errors(loaded.source):
        result = loaded.planner.plan()
    if out is None:
        return ScenarioPlan(loaded, result)
    planned = ScenarioPlan(loaded, result, _FILES)
    with replace_files(Path(out), _FILES) as fresh:
        _write(fresh, planned)
    return planned


def _write(folder: Path, planned: ScenarioPlan) -> None:
    from srs_twin.planning.pictures import plan_plot
    from srs_twin.viewing.plots.style import save

    title = f"{planned.scenario.title}: {planned.plan.outcome.value}"
    figure = plan_plot(planned.scenario.planner.problem, planned.plan.segments, title)
    document = json.dumps(planned.document(), indent=2, allow_nan=False)
    (folder / PLAN).write_text(document + "\n", "utf-8")
    save(figure, folder / PICTURE, dpi=150)
