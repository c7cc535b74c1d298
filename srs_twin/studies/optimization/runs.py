"""Storage of finished runs, which prevents repeated simulations of a design.

Because the seed and the earlier results determine the sequence of designs, a resumed
search requests the same designs and finds their stored results.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from srs_twin.io.files import STUDY_MARKS, STUDY_RESULT, check_output_folder
from srs_twin.io.provenance import Provenance
from srs_twin.studies.optimization.loading import OptimizationStudy
from srs_twin.studies.sweep.execution import Engine
from srs_twin.studies.sweep.points import Changes
from srs_twin.studies.sweep.store import RowStore
from srs_twin.studies.sweep.task import DONE, Row

PLANTS = {"compliant": "analytical", "twin": "twin"}
"""Name of the plant that simulates each fidelity."""

RowCallback = Callable[[str, Row], None]
"""Callback that receives the fidelity and the result row of each finished run."""


@dataclass(frozen=True)
class Run:
    """Simulation run of a design at one fidelity.

    Attributes:
        part: fidelity ("compliant" or "twin").
        fractions: design variables as fractions of their ranges, shape (d,).
    """

    part: str
    fractions: np.ndarray
    row: Row

    def metric(self, name: str) -> float:
        """Return a metric of the run, or NaN if the metric has no value."""
        return metric_of(self.row, self.part, name)


def metric_of(row: Row, part: str, name: str) -> float:
    """Return a metric of a result row, or NaN if the metric has no value."""
    value = row.values.get(f"{PLANTS[part]}.{name}")
    return math.nan if value is None or row.status != DONE else value


class StudyRuns(AbstractContextManager["StudyRuns"]):
    """Runs of a study in a locked folder."""

    def __init__(
        self,
        study: OptimizationStudy,
        folder: Path,
        engine: Engine,
        on_row: RowCallback | None = None,
        *,
        changed: bool = False,
    ) -> None:
        self._study = study
        self._engine = engine
        self._on_row = on_row
        self._rows: dict[str, Row] = {}
        self._requested: dict[str, Run] = {}
        check_output_folder(folder, (STUDY_RESULT,), marks=STUDY_MARKS)
        with ExitStack() as opened:
            self._stores = {
                part: opened.enter_context(RowStore(folder / part))
                for part in study.experiments
            }
            for part, store in self._stores.items():
                store.claim(self._provenance(part), changed=changed)
                self._rows |= {row.key: row for row in store.rows()}
            self._opened = opened.pop_all()

    def __exit__(self, *error: object) -> None:
        self._opened.close()

    @property
    def requested(self) -> list[Run]:
        """Distinct runs in the order in which they were first requested."""
        return list(self._requested.values())

    def run(self, part: str, fractions: np.ndarray) -> list[Run]:
        """Return the runs of designs at one fidelity, and simulate missing runs.

        Args:
            part: fidelity ("compliant" or "twin").
            fractions: designs as fractions of the ranges, shape (designs, d).
        """
        changes = [self._study.space.changes(design) for design in fractions]
        rows = self.rows(part, changes)
        for row, design in zip(rows, fractions, strict=True):
            self._requested.setdefault(row.key, Run(part, design, row))
        return [self._requested[row.key] for row in rows]

    def rows(self, part: str, changes: Sequence[Changes]) -> list[Row]:
        """Return one result row per changed scenario, and compute missing rows."""
        experiment = self._study.experiments[part]
        points = [experiment.point(change) for change in changes]
        missing = list({p.key: p for p in points if p.key not in self._rows}.values())

        def on_row(row: Row) -> None:
            self._rows[row.key] = row
            if self._on_row is not None:
                self._on_row(part, row)

        # Starting an engine may take seconds, so it is not started without need.
        if missing:
            self._stores[part].collect(
                self._engine(experiment, missing), [p.key for p in missing], on_row
            )
        return [self._rows[point.key] for point in points]

    def reset(self) -> None:
        """Clear the list of requested runs, but keep the stored results."""
        self._requested = {}

    def _provenance(self, part: str) -> Provenance:
        experiment = self._study.experiments[part]
        base = experiment.provenance(experiment.base)
        variables = list(self._study.space.variables)
        return replace(base, content=base.content | {"variables": variables})
