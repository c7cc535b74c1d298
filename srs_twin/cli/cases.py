"""Scenarios given on the command line, and the results of their runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from srs_twin.errors import SrsError

if TYPE_CHECKING:
    from srs_twin.comparison.metrics import RunMetrics
    from srs_twin.experiment import RunResult
    from srs_twin.scenario.scenario import Scenario

EXPECTATION_FAILED = 1
"""Exit code if an expectation is missed."""


@dataclass(frozen=True)
class CaseResult:
    """Result of a run, as returned by a worker process without the trajectories.

    Attributes:
        run: results of the run, or None if the input was invalid or a worker process
            died.
        errors: errors that stopped the run or a single plant.
        wall_s: wall time, s.
    """

    run: RunResult | None
    errors: tuple[SrsError, ...] = ()
    wall_s: float = 0.0

    @property
    def metrics(self) -> RunMetrics:
        """Contents of metrics.json, or {} if the run is incomplete."""
        if self.run is None:
            return {}
        return self.run.metrics

    @property
    def verdicts(self) -> Counter[str]:
        """Number of expectations in each state, as defined by `expectation.verdict`."""
        from srs_twin.scenario.expectation import verdict

        return Counter(map(verdict, self.metrics.get("expectations", ())))

    def exit_code(self, fails: Set[str]) -> int:
        """Return the highest exit code due to errors and failed expectations.

        `fails` contains the states of failed expectations.
        """
        if fails & self.verdicts.keys():
            failed = EXPECTATION_FAILED
        else:
            failed = 0
        return max([failed, *(error.exit_code for error in self.errors)])


@dataclass
class Case:
    """Scenario given on the command line.

    Attributes:
        source: name or path of the scenario as typed by the user.
        scenario: loaded scenario, or None if it is invalid.
        folder: output folder.
        result: result of the run, or None if the run is incomplete.
        in_folder: whether the scenario was found in a folder that the user gave.
    """

    source: str
    scenario: Scenario | None = None
    folder: Path = Path()
    result: CaseResult | None = None
    in_folder: bool = False

    @property
    def name(self) -> str:
        """Name of the scenario, or of its file if the scenario is invalid."""
        if self.scenario is None:
            return Path(self.source).stem
        return self.scenario.name

    @property
    def label(self) -> str:
        """Name of the scenario, followed by the overridden fields."""
        if self.scenario is None:
            return self.name
        return self.scenario.label

    def document(self) -> Mapping[str, object]:
        """Return the contents of metrics.json, or the errors, as JSON data."""
        result = self.result or CaseResult(None)
        if result.errors:
            return {
                "scenario": self.name,
                "errors": [str(error) for error in result.errors],
            }
        return result.metrics
