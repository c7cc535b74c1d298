"""Study: the runs by which a footprint is measured, and what is measured of them.

Each offset is run several times, with the gait begun at another phase each time; each change of offset as
well, at several phases of the gait.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from srs_twin.comparison.gait_window import GaitWindow
from srs_twin.errors import DivergedError, InputError
from srs_twin.identification.drive import Drive
from srs_twin.identification.measured import Measured
from srs_twin.identification.steady import SteadyPath, together
from srs_twin.identification.transients import STEADY_PERIODS, Change, transient, widest
from srs_twin.planning.footprint import Transient
from srs_twin.rollouts import Job, run_many
from srs_twin.trajectory import Trajectory

LEAST_OFFSETS, MOST_OFFSETS = 3, 101
LEAST_PERIODS, MOST_PERIODS = 3, 200
MOST_PHASES = 64


@dataclass(frozen=True)
class Study:
    """The runs that a footprint is measured by.

    Attributes:
        drive: robot, controller, plant.
        offsets: three or more, on both sides of 0, rising.
        changes: (before, after) of the changes of offset to measure.
        periods: of each steady run that are measured.
        phases: runs an offset and a change, begun at equally spaced phases of the gait.
    """

    drive: Drive
    offsets: tuple[float, ...]
    changes: tuple[tuple[float, float], ...]
    periods: int = 6
    phases: int = 4

    def __post_init__(self) -> None:
        """Refuse what cannot be measured.

        Raises:
            InputError: offsets or numbers out of their range.
        """
        for offset in (*self.offsets, *(each for change in self.changes for each in change)):
            self.drive.check(offset)
        if not all(b > a for a, b in zip(self.offsets, self.offsets[1:], strict=False)):
            raise InputError(
                f"offsets {_listed(self.offsets)} are not allowed; each must be there once, rising"
            )
        both = self.offsets and self.offsets[0] < 0 < self.offsets[-1]
        if not (both and LEAST_OFFSETS <= len(self.offsets) <= MOST_OFFSETS):
            raise InputError(
                f"offsets {_listed(self.offsets)} are not allowed; a planner needs {LEAST_OFFSETS} to "
                f"{MOST_OFFSETS}, on both sides of 0"
            )
        for before, after in self.changes:
            if before == after or not {before, after} <= set(self.offsets):
                raise InputError(
                    f"a change from offset {before:g} to {after:g} is none between two measured ones"
                )
        for name, value, low, high in (
            ("periods", self.periods, LEAST_PERIODS, MOST_PERIODS), ("phases", self.phases, 1, MOST_PHASES),
        ):  # fmt: skip
            if not low <= value <= high:
                raise InputError(f"{name} {value} is not allowed; it must be from {low} to {high}")

    @property
    def runs(self) -> int:
        """How many runs it takes."""
        return self.phases * (len(self.offsets) + len(self.changes))

    def measure(
        self, *, threads: int | None = None, progress: Callable[[int], None] | None = None
    ) -> Measured:
        """Run and measure.

        Args:
            threads: how many runs at once; default one a processor. The numbers do not depend on it.
            progress: called with how many runs are done.

        Raises:
            DivergedError: a run diverged; the message says which.
            InputError: the snake gets nowhere at an offset.
        """
        drive, maker = self.drive, self.drive.plant_maker()
        shares = [k / self.phases for k in range(self.phases)]
        jobs = [
            drive.steady_job(maker, offset, 2 * math.pi * share, self.periods)
            for offset in self.offsets for share in shares
        ]  # fmt: skip
        times = [drive.change_time(share) for share in shares]
        jobs += [
            drive.change_job(maker, change, time, STEADY_PERIODS) for change in self.changes for time in times
        ]
        runs = self._run(jobs, threads, progress)
        repeats = [runs[k : k + self.phases] for k in range(0, len(runs), self.phases)]
        found = {
            offset: self._steady(offset, each)
            for offset, each in zip(self.offsets, repeats[: len(self.offsets)], strict=True)
        }
        transients = [
            self._transient(change, times, each, {offset: path for offset, (path, _) in found.items()})
            for change, each in zip(self.changes, repeats[len(self.offsets) :], strict=True)
        ]
        paths, spread = zip(*found.values(), strict=True)
        return Measured(drive, self.offsets, paths, spread, tuple(transients), self.phases, self.periods)

    def _run(
        self, jobs: Sequence[Job], threads: int | None, progress: Callable[[int], None] | None
    ) -> list[Trajectory]:
        runs = []
        for k, run in enumerate(run_many(jobs, threads=threads, progress=progress)):
            if isinstance(run, DivergedError):
                run.args = (f"{self._named(k // self.phases)}: {run}",)
                raise run
            runs.append(run)
        return runs

    def _steady(self, offset: float, runs: Sequence[Trajectory]) -> tuple[SteadyPath, SteadyPath]:
        """Return the path at an offset and its spread."""
        try:
            return together([steady_path(self.drive, run, self.periods) for run in runs])
        except InputError as error:
            raise InputError(f"offset {offset:g}: {error}") from error

    def _transient(
        self, change: tuple[float, float], times: Sequence[float], runs: Sequence[Trajectory],
        paths: Mapping[float, SteadyPath],
    ) -> Transient:  # fmt: skip
        """Return what a change of offset does, at whatever phase of the gait it comes."""
        geometry, period, (before, after) = self.drive.spec.geometry, self.drive.period, change
        try:
            return widest([
                transient(run, geometry, period, Change(time, before, after), paths[before], paths[after])
                for run, time in zip(runs, times, strict=True)
            ])  # fmt: skip
        except InputError as error:
            raise InputError(f"offset {before:g} to {after:g}: {error}") from error

    def _named(self, number: int) -> str:
        if number < len(self.offsets):
            return f"offset {self.offsets[number]:g}"
        return "offset {:g} to {:g}".format(*self.changes[number - len(self.offsets)])


def steady_path(drive: Drive, run: Trajectory, periods: int) -> SteadyPath:
    """Return the path over the last periods of a run.

    Raises:
        InputError: the run is too short, or the snake gets nowhere.
    """
    window = GaitWindow.last(run, drive.period, float(run.time[-1]), periods)
    if window is None:
        raise InputError(f"the run is shorter than {periods} gait periods")
    return SteadyPath.of(run, drive.spec.geometry, window)


def _listed(offsets: Sequence[float]) -> str:
    return ", ".join(f"{offset:g}" for offset in offsets) or "(none)"
