"""Measurement of footprints, which describe the area that a crawling robot sweeps.

In the dissertation, the path curvature, the speed and the circles that bound the swept
area were measured at seven steering offsets (Section 5.3, Fig. 58, Table 8). This
module determines the same quantities from simulations.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from srs_twin.comparison.gait import GaitWindow
from srs_twin.compute.arrays import check_positive
from srs_twin.control.commands import ScheduledOffset
from srs_twin.control.gait import Gait
from srs_twin.control.learning import ILC, TARGETS
from srs_twin.errors import (
    DivergedError,
    InputError,
    UnknownNameError,
    named_in_errors,
)
from srs_twin.identification.paths import (
    STEADY_PERIODS,
    OffsetChange,
    SteadyPath,
    average_repeats,
    combine_transients,
    measure_transient,
)
from srs_twin.planning.footprint import Transient
from srs_twin.plants.base import Plant
from srs_twin.plants.twin.mjcf.numerics import ModelSettings, as_contact
from srs_twin.pneumatics import KINDS
from srs_twin.robot.spec import RobotSpec
from srs_twin.rollout import Job, run_many
from srs_twin.trajectory import Trajectory

PLANTS = ("twin", "analytical")
CONTROLLERS = ("gait", "ilc")
TICK = 0.005
"""Control period, s.

Iterative learning must resolve the bend ripple due to pulse-width modulation, and a
change of offset must coincide with a tick.
"""

RECORD_HZ = 100.0
"""Sampling rate of the simulations, Hz."""

FREQUENCY_HZ = {"gait": 2.0, "ilc": 1.5}
"""Default gait frequency for each controller, Hz."""

_MIN_SAMPLES = 25
"""Minimum number of samples per gait period."""


@dataclass(frozen=True)
class GaitSetup:
    """Robot, gait and plant of a footprint measurement.

    Attributes:
        frequency: gait frequency, Hz.
        controller: controller of the robot, "gait" (Eq. 13) or "ilc" (Eq. 32).
        target: target bend amplitude of the learning controller, rad.
        plant: "twin", "analytical" (the model `compliant` on wheels), or a function
            that creates a plant with the tick `TICK`.
        steering: steering method of the learning controller, as in `ILC`.
        chambers: pneumatic model, "lag" or "orifice", which is ignored if `plant` is a
            function.
        contact: contact model of the twin, or None for the default contact model.
    """

    spec: RobotSpec
    frequency: float
    supply_pa: float
    controller: str = "gait"
    target: float = 0.7
    plant: str | Callable[[], Plant] = "twin"
    steering: str = TARGETS
    chambers: str = "lag"
    contact: str | None = None

    def __post_init__(self) -> None:
        allowed = {"controller": CONTROLLERS, "plant": PLANTS, "chambers": KINDS}
        for name, names in allowed.items():
            value = getattr(self, name)
            if isinstance(value, str) and value not in names:
                raise UnknownNameError(name, value, names)
        if self.contact is not None:
            as_contact(self.contact)
            if self.plant != "twin":
                raise InputError(
                    f"contact {self.contact!r} is allowed only for the twin; remove it"
                    " for other plants"
                )
        check_positive("pressure", self.supply_pa / 1000, "kPa")
        check_positive("frequency", self.frequency, "Hz")
        spec = self.spec
        supply = spec.supply
        spec.require_planar("a footprint")
        if spec.segments < 2:
            raise InputError(
                f"{spec.name} has one segment and cannot crawl, so it has no"
                " footprint; use a robot with more segments"
            )
        if self.supply_pa > supply.pulsed_limit:
            raise InputError(
                f"the pressure {self.supply_pa / 1000:g} kPa is not allowed, because"
                f" {spec.name} supports at most {supply.pulsed_limit / 1000:g} kPa in"
                f" pulses ({supply.limit_source}); use a lower pressure"
            )
        highest = RECORD_HZ / _MIN_SAMPLES
        if self.frequency > highest:
            raise InputError(
                f"the frequency {self.frequency:g} Hz is not allowed; it must be"
                f" {highest:.3g} Hz or less"
            )
        self.make_controller(0.0)  # raises an error if a setting is invalid

    @property
    def twin_contact(self) -> str | None:
        """Contact model of the twin, or None if the plant is not the twin."""
        if self.plant == "twin":
            return self.contact or ModelSettings.contact.name
        return None

    @property
    def period(self) -> float:
        """Gait period, s."""
        return 1 / self.frequency

    @property
    def settling_periods(self) -> int:
        """Number of gait periods after which a run is considered steady."""
        return 16 if self.controller == "ilc" else 8

    @property
    def transient_periods(self) -> int:
        """Maximum duration of the transient after an offset change, in gait periods."""
        return 12 if self.controller == "ilc" else 6

    @property
    def offsets(self) -> tuple[float, ...]:
        """Default steering offsets.

        The offsets range from −0.3 to 0.3 for the controller "ilc" (Table 8), and from
        −0.4 to 0.4 for "gait" (Fig. 33).
        """
        count = 3 if self.controller == "ilc" else 4
        return tuple(k / 10 for k in range(-count, count + 1))

    def make_controller(self, offset: float, phase: float = 0.0) -> Gait | ILC:
        """Create a controller with a steering offset and an initial phase ψ (rad)."""
        if self.controller == "ilc":
            return ILC(
                self.frequency,
                offset,
                target=self.target,
                phase=phase,
                steering=self.steering,
            )
        return Gait(self.frequency, offset, phase=phase)

    def plant_factory(self) -> Callable[[], Plant]:
        """Return a function that creates the plant."""
        if callable(self.plant):
            return self.plant
        return partial(_make_plant, self)

    def steady_job(
        self, factory: Callable[[], Plant], offset: float, phase: float, periods: int
    ) -> Job:
        """Return a simulation job with a constant offset."""
        duration = next_sample((self.settling_periods + periods) * self.period)
        return Job(
            factory,
            partial(self.make_controller, offset, phase),
            duration,
            record_hz=RECORD_HZ,
        )

    def change_time(self, phase: float) -> float:
        """Return the time (s) of an offset change at a phase given in gait periods."""
        return next_sample((self.settling_periods + phase) * self.period)

    def change_job(
        self,
        factory: Callable[[], Plant],
        change: tuple[float, float],
        time: float,
        periods: int,
    ) -> Job:
        """Return a simulation job in which the offset changes at a given time (s).

        The simulation ends `periods` gait periods after the maximum duration of the
        transient.
        """
        before, after = change

        def controller() -> ScheduledOffset:
            return ScheduledOffset(self.make_controller(before), [(time, after)])

        duration = next_sample(time + (self.transient_periods + periods) * self.period)
        return Job(factory, controller, duration, record_hz=RECORD_HZ)


def next_sample(time: float) -> float:
    """Round a time (s) up to the next sample."""
    return round(math.ceil(time * RECORD_HZ - 1e-6) / RECORD_HZ, 9)


def _make_plant(setup: GaitSetup) -> Plant:
    settings: dict[str, Any] = {
        "supply_pa": setup.supply_pa,
        "tick": TICK,
        "pneumatics": setup.chambers,
    }
    if setup.plant == "twin":
        from srs_twin.plants.twin.snake import TwinSnake

        settings["contact"] = setup.twin_contact
        return TwinSnake(setup.spec, **settings)
    from srs_twin.plants.analytical import AnalyticalSnake

    # Iterative learning pulses the valves, and a model with prescribed bends would then
    # slip too much (docs/module.md).
    return AnalyticalSnake(setup.spec, model="compliant", friction="wheel", **settings)


@dataclass(frozen=True)
class FootprintMeasurement:
    """Measured footprint.

    Attributes:
        spread: half the range of each value in `steady` over the repeated simulations.
        repeats: number of simulations per offset and per change of offset.
        periods: number of measured gait periods in each steady simulation.
    """

    setup: GaitSetup
    offsets: tuple[float, ...]
    steady: tuple[SteadyPath, ...]
    spread: tuple[SteadyPath, ...]
    transients: tuple[Transient, ...]
    repeats: int
    periods: int


_OFFSETS = (3, 101)
"""Minimum and maximum number of offsets."""

_LIMITS = {"periods": (3, 200), "phases": (1, 64)}
"""Minimum and maximum of `periods` and `phases` in a `FootprintStudy`."""


@dataclass(frozen=True)
class FootprintStudy:
    """Set of simulations from which a footprint is measured.

    Attributes:
        offsets: three or more offsets in ascending order, including negative and
            positive values.
        changes: changes of offset to measure, as pairs of the old and the new offset.
        periods: number of measured gait periods in each steady simulation.
        phases: number of simulations per offset and per change of offset, at equally
            spaced gait phases.
    """

    setup: GaitSetup
    offsets: tuple[float, ...]
    changes: tuple[tuple[float, float], ...]
    periods: int = 6
    phases: int = 4

    def __post_init__(self) -> None:
        for offset in (*self.offsets, *itertools.chain.from_iterable(self.changes)):
            self.setup.make_controller(offset)
        listed = ", ".join(f"{offset:g}" for offset in self.offsets) or "(none)"
        message = f"offsets {listed} are not allowed"
        if not all(a < b for a, b in itertools.pairwise(self.offsets)):
            raise InputError(f"{message}; give each offset once, in ascending order")
        fewest, most = _OFFSETS
        if not (
            fewest <= len(self.offsets) <= most
            and self.offsets[0] < 0 < self.offsets[-1]
        ):
            raise InputError(
                f"{message}; a planner needs between {fewest} and {most} offsets, some"
                " below 0 and some above 0"
            )
        for before, after in self.changes:
            if before == after or not {before, after} <= set(self.offsets):
                raise InputError(
                    f"a change from offset {before:g} to {after:g} is not allowed;"
                    " both must be measured offsets, and they must differ"
                )
        for name, (low, high) in _LIMITS.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(
                    f"{name} {value} is not allowed; it must be between {low} and"
                    f" {high}"
                )

    @property
    def runs(self) -> int:
        """Number of simulations."""
        return self.phases * (len(self.offsets) + len(self.changes))

    def measure(
        self,
        *,
        threads: int | None = None,
        progress: Callable[[int, int], object] = max,
    ) -> FootprintMeasurement:
        """Simulate the plant and measure the footprint.

        By default, one thread per processor is used. The callback `progress` receives
        the number of finished simulations and the total number of simulations.

        Raises:
            DivergedError: a simulation diverged.
            InputError: the snake does not move forward at an offset.
        """
        setup = self.setup
        factory = setup.plant_factory()
        phases = [k / self.phases for k in range(self.phases)]
        jobs = [
            setup.steady_job(factory, offset, 2 * math.pi * phase, self.periods)
            for offset in self.offsets
            for phase in phases
        ]
        times = [setup.change_time(phase) for phase in phases]
        jobs += [
            setup.change_job(factory, change, time, STEADY_PERIODS)
            for change in self.changes
            for time in times
        ]

        runs = iter(self._run(jobs, threads, progress))
        paths = {}
        spreads = {}
        for offset in self.offsets:
            with named_in_errors(_name_of((offset,))):
                paths[offset], spreads[offset] = average_repeats(
                    [steady_path(setup, run, self.periods) for run in next(runs)]
                )
        transients = [
            self._transient(change, times, next(runs), paths) for change in self.changes
        ]
        return FootprintMeasurement(
            setup,
            self.offsets,
            tuple(paths.values()),
            tuple(spreads.values()),
            tuple(transients),
            self.phases,
            self.periods,
        )

    def _run(
        self,
        jobs: Sequence[Job],
        threads: int | None,
        progress: Callable[[int, int], object],
    ) -> list[list[Trajectory]]:
        """Return the repeated simulations of each offset and of each change."""
        offsets = [*((offset,) for offset in self.offsets), *self.changes]
        repeats: list[list[Trajectory]] = [[] for _ in offsets]

        def count(done: int) -> None:
            progress(done, self.runs)

        done = run_many(jobs, threads=threads, progress=count)
        for k, run in enumerate(done):
            if isinstance(run, DivergedError):
                run.args = (f"{_name_of(offsets[k // self.phases])}: {run}",)
                raise run
            repeats[k // self.phases].append(run)
        return repeats

    def _transient(
        self,
        change: tuple[float, float],
        times: Sequence[float],
        runs: Sequence[Trajectory],
        paths: Mapping[float, SteadyPath],
    ) -> Transient:
        before, after = change
        with named_in_errors(_name_of(change)):
            transients = [
                measure_transient(
                    run,
                    self.setup.spec.geometry,
                    self.setup.period,
                    OffsetChange(time, before, after),
                    (paths[before], paths[after]),
                )
                for run, time in zip(runs, times, strict=True)
            ]
            return combine_transients(transients)


def _name_of(offsets: Sequence[float]) -> str:
    return f"offset {' to '.join(f'{offset:g}' for offset in offsets)}"


def steady_path(setup: GaitSetup, run: Trajectory, periods: int) -> SteadyPath:
    """Return the steady path over the last `periods` gait periods of a simulation."""
    window = GaitWindow.ending_at(run, setup.period, float(run.time[-1]), periods)
    if window is None:
        raise InputError(
            f"the run is shorter than {periods} gait periods; simulate a longer run"
        )
    return SteadyPath.measure(run, setup.spec.geometry, window)


Changes = Sequence[tuple[float, float]]


def footprint_study(
    setup: GaitSetup,
    *,
    offsets: Sequence[float] | None = None,
    changes: Changes | None = None,
    **counts: int,
) -> FootprintStudy:
    """Create the study that measures a footprint.

    The argument `changes` contains pairs of the old and the new offset. The defaults
    are `GaitSetup.offsets` and `default_changes`. The arguments `counts` are `periods`
    and `phases` of the `FootprintStudy`.
    """
    rows = setup.offsets if offsets is None else tuple(map(float, offsets))
    study = FootprintStudy(setup, rows, tuple(changes or ()), **counts)
    if changes is None:
        return replace(study, changes=default_changes(rows))
    return study


def default_changes(offsets: Sequence[float]) -> tuple[tuple[float, float], ...]:
    """Return the changes of offset that are measured by default.

    Each change is a pair of the old and the new offset. The pairs contain all changes
    between 0, the lowest and the highest offset, and those between 0 and the offsets
    closest to half of these extremes.
    """
    low = min(offsets)
    high = max(offsets)
    full = [offset for offset in (low, 0.0, high) if offset in offsets]
    pairs = [(a, b) for a in full for b in full if a != b]
    if 0.0 in offsets:
        for outermost in (low, high):
            inner = [offset for offset in offsets if 0 < offset / outermost < 1]
            half = min(
                inner, key=lambda offset: abs(offset - outermost / 2), default=None
            )
            if half is not None:
                pairs += [(0.0, half), (half, 0.0)]
    return tuple(pairs)
