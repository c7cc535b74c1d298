"""A run that is over, read back from its folder: for what is looked at later."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from srs_twin.errors import InputError
from srs_twin.files import shown
from srs_twin.running import PLANTS, RESOLVED
from srs_twin.scenario import Scenario, load_scenario
from srs_twin.trajectory import Trajectory

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
