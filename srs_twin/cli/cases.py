"""Scenarios that a command was given, and their results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.errors import SrsError

if TYPE_CHECKING:
    from srs_twin.experiment import RunResult
    from srs_twin.scenario.scenario import Scenario

EXPECTATION_FAILED = 1
"""Exit code where an expectation decides it."""


@dataclass(frozen=True)
class CaseResult:
    """Result of a scenario, small enough to travel between processes.

    Attributes:
        result: without trajectories; None where bad input or a dead worker left none.
        errors: that stopped it or a part of it.
        wall_s: wall time, s.
    """

    result: RunResult | None
    errors: tuple[SrsError, ...] = ()
    wall_s: float = 0.0

    @property
    def metrics(self) -> Mapping[str, Any]:
        """Content of metrics.json; empty if the folder does not hold a complete run."""
        return {} if self.result is None else self.result.metrics

    @property
    def verdicts(self) -> Counter[str]:
        """Number of expectations per verdict (`scenario.expectation.verdict`)."""
        from srs_twin.scenario.expectation import verdict

        return Counter(map(verdict, self.metrics.get("expectations", ())))

    def exit_code(self, fails: Set[str]) -> int:
        """Return the highest of its errors' codes; verdicts that fail have one too."""
        failed = EXPECTATION_FAILED if fails & self.verdicts.keys() else 0
        return max([failed, *(error.exit_code for error in self.errors)])


@dataclass
class Case:
    """A scenario that a command was given.

    Attributes:
        source: as it was given.
        scenario: what it holds; None where it cannot be used.
        folder: where its files go.
        ended: its result; None until it has ended.
    """

    source: str
    scenario: Scenario | None = None
    folder: Path = Path()
    ended: CaseResult | None = None

    @property
    def name(self) -> str:
        """Name of the scenario, or of its file if the scenario cannot be used."""
        return Path(self.source).stem if self.scenario is None else self.scenario.name

    @property
    def label(self) -> str:
        """The name, with the changed fields."""
        return self.name if self.scenario is None else self.scenario.label

    def document(self) -> Mapping[str, Any]:
        """Return the result as plain data: metrics.json, or the errors."""
        ended = self.ended or CaseResult(None)
        errors = {"scenario": self.name, "errors": [str(error) for error in ended.errors]}
        return errors if ended.errors else ended.metrics
