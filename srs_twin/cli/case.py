"""One scenario of a batch: where it is from, where its files go, and what came of it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.errors import DivergedError, InputError, SrsError

if TYPE_CHECKING:
    from srs_twin.running import Explain, Progress, RunResult
    from srs_twin.scenario import Scenario

    Order = tuple[Scenario, Path]


@dataclass(frozen=True)
class Ended:
    """What came of a scenario, small enough to travel between processes.

    Attributes:
        result: without trajectories; None where bad input or a dead worker left none.
        errors: what stopped it or a part of it.
        wall_s: what it took, s.
    """

    result: RunResult | None
    errors: tuple[SrsError, ...] = ()
    wall_s: float = 0.0

    @property
    def metrics(self) -> Mapping[str, Any]:
        """What stands in metrics.json; empty where the folder does not hold a whole run."""
        return {} if self.result is None else self.result.metrics

    @property
    def verdicts(self) -> Counter[str]:
        """How many expectations came out how; see `scenario.expectation.verdict`."""
        from srs_twin.scenario.expectation import verdict

        expectations = self.metrics.get("expectations", ())
        return Counter(verdict(each["met"], each.get("known")) for each in expectations)


@dataclass
class Case:
    """A scenario that somebody asked for.

    Attributes:
        source: as it was given.
        scenario: what it holds; None where it cannot be used.
        folder: where its files go.
        ended: what came of it; None while nothing has.
    """

    source: str
    scenario: Scenario | None = None
    folder: Path = Path()
    ended: Ended | None = None

    @property
    def name(self) -> str:
        """What it is called: the scenario's name, or its file's where there is none."""
        return Path(self.source).stem if self.scenario is None else self.scenario.name

    @property
    def order(self) -> Order:
        """What `simulate` needs to know."""
        assert self.scenario is not None
        return self.scenario, self.folder


def simulate(
    order: Order,
    progress: Progress | None = None,
    *,
    plants: Sequence[str] | None = None,
    explain: bool = False,
) -> Ended:
    """Run a scenario, here or in a worker process.

    Args:
        order: the scenario and the folder for its files.
        progress: as `PreparedRun.execute` takes it.
        plants: which plants; None takes those that the scenario names.
        explain: also say why the plants differ.
    """
    from srs_twin.running import prepare

    start = time.perf_counter()
    asked: dict[str, Any] = {"explain": _explainer()} if explain else {}
    result: RunResult | None = None
    errors: tuple[SrsError, ...] = ()
    try:
        scenario, folder = order
        result = prepare(scenario, folder, plants=plants).execute(progress, **asked)
        errors = (*result.diverged, *result.unexplained)
        result = replace(result, trajectories={}, diverged=(), unexplained=())
    except InputError as error:
        errors = (error,)
    return Ended(result, tuple(map(_light, errors)), time.perf_counter() - start)


def _light(error: SrsError) -> SrsError:
    """Drop what an error carries beside its words: the file that it names holds it."""
    if isinstance(error, DivergedError):
        error.trajectory = error.history = None
    return error


def _explainer() -> Explain:
    from srs_twin.attribution import explain

    return explain
