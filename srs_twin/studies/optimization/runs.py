"""Runs of designs: each is kept as soon as it is finished, and none is run twice.

A search asks for designs in an order that depends on the seed and on results alone. So one that was
interrupted is begun again from the start, finds its earlier runs here, and goes on where it was; workers
change how fast that is, nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import check_output_folder, display_path
from srs_twin.scenario.provenance import run_key, source_digests, versions
from srs_twin.studies.optimization.loading import Study
from srs_twin.studies.sweep.execution import Engine
from srs_twin.studies.sweep.points import RUNNER, Changes, Point
from srs_twin.studies.sweep.store import RowStore, SweepIdentity
from srs_twin.studies.sweep.task import DONE, Row, failed_row

PLANTS = {"compliant": "analytical", "twin": "twin"}
"""Fidelity → plant that runs it."""

Told = Callable[[str, Row], None]


@dataclass(frozen=True)
class Run:
    """One design at one fidelity.

    Attributes:
        part: "compliant" or "twin".
        shares: of the design, shape (d,).
        row: what came of it.
    """

    part: str
    shares: np.ndarray
    row: Row

    def metric(self, name: str) -> float:
        """Return a metric; NaN where there is none."""
        return metric_of(self.row, self.part, name)


def metric_of(row: Row, part: str, name: str) -> float:
    """Return a metric of a row at a fidelity; NaN where there is none."""
    value = row.values.get(f"{PLANTS[part]}.{name}")
    return float("nan") if value is None or row.status != DONE else value


class Runs(AbstractContextManager["Runs"]):
    """The runs of a study, in a folder that is locked.

    Attributes:
        asked: all runs in the order in which they were asked for, each once.
    """

    def __init__(
        self, study: Study, folder: Path, engine: Engine, told: Told | None = None, *, changed: bool = False
    ) -> None:
        """Open the folder.

        Args:
            study: whose runs they are.
            folder: made where it is missing.
            engine: who runs what is missing.
            told: called with each run that finishes now.
            changed: go on in a folder of another study; runs that both have stay.

        Raises:
            InputError: the folder cannot be written, is locked, or belongs to another study.
        """
        self._study, self._engine, self._told = study, engine, told
        self.asked: list[Run] = []
        self._known: dict[str, Row] = {}
        self._seen: dict[str, Run] = {}
        check_output_folder(folder, ())
        with ExitStack() as opened:
            self._stores = {part: opened.enter_context(RowStore(folder / part)) for part in study.experiments}
            for part, store in self._stores.items():
                self._settle(folder / part, part, store, changed=changed)
                self._known |= {row.key: row for row in store.rows()}
            self._opened = opened.pop_all()

    def __exit__(self, *error: object) -> None:
        """Unlock the folder."""
        self._opened.close()

    def run(self, part: str, shares: np.ndarray) -> list[Run]:
        """Return the runs of designs, shape (designs, d), at one fidelity; raises as `rows`."""
        found = []
        rows = self.rows(part, [self._study.space.changes(each) for each in shares])
        for row, each in zip(rows, shares, strict=True):
            if row.key not in self._seen:
                self._seen[row.key] = Run(part, each, row)
                self.asked.append(self._seen[row.key])
            found.append(self._seen[row.key])
        return found

    def rows(self, part: str, changes: Sequence[Changes]) -> list[Row]:
        """Return what came of changes of the scenario at one fidelity, "compliant" or "twin".

        Raises:
            InputError: a row cannot be kept.
        """
        experiment, plant = self._study.experiments[part], PLANTS[part]
        points = [Point(run_key(experiment.document(each), (plant,), RUNNER), each) for each in changes]
        missing = list({p.key: p for p in points if p.key not in self._known}.values())
        if missing:  # an engine may take seconds to begin
            with closing(self._engine(experiment, missing)) as rows:  # type: ignore[type-var]
                for done in rows:
                    row = done.result or failed_row(missing[done.number].key, done.error)
                    self._stores[part].add(row)
                    self._known[row.key] = row
                    if self._told is not None:
                        self._told(part, row)
        return [self._known[point.key] for point in points]

    def forget(self) -> None:
        """Begin another search: what was asked for is not told any more, and not run again either."""
        self.asked, self._seen = [], {}

    def _settle(self, folder: Path, part: str, store: RowStore, *, changed: bool) -> None:
        """Refuse a folder that belongs to another study, unless told; note whose it is."""
        experiment, names = self._study.experiments[part], list(self._study.space.variables)
        rest: tuple[Mapping[str, object], ...] = (versions(), source_digests(RUNNER))
        now = SweepIdentity("", *json.loads(json.dumps((experiment.base, names, *rest))))
        before = store.identity()
        if before is not None and before != now and not changed:
            raise InputError(
                f"{display_path(folder)}: its runs are of another study, or of another version of the "
                "program; give --changed to keep those that still belong, or another --out"
            )
        store.keep_identity(now)
