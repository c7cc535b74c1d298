"""Footprints: what a robot sweeps at each offset, and when the offset changes, measured by running it.

Section 5.3 measured the curvature of the path, the speed and the circles that bound the body at seven offsets
(Fig. 58, Table 8). Here a plant is run instead. `Drive` says how the snake is driven, `Study` which runs a
footprint takes, `Measured` holds what they gave. Each offset is run several times, with the gait begun at
another phase each time; each change of offset as well, at several phases of the gait.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from srs_twin.comparison.gait import GaitWindow
from srs_twin.control.commands import ScheduledOffset
from srs_twin.control.gait import Gait
from srs_twin.control.learning import ILC, TARGETS
from srs_twin.errors import DivergedError, InputError, UnknownNameError
from srs_twin.identification.paths import STEADY_PERIODS, Change, SteadyPath, mean_path, transient, widest
from srs_twin.io.files import display_path, read_text
from srs_twin.planning.footprint import FootprintFile, Transient
from srs_twin.plants.base import Plant
from srs_twin.plants.twin.mjcf.numerics import ModelSettings, as_contact
from srs_twin.pneumatics import KINDS
from srs_twin.recordings.recording import named_in_errors
from srs_twin.robot.spec import RobotSpec
from srs_twin.rollout import Job, run_many
from srs_twin.trajectory import Trajectory

PLANTS = ("twin", "analytical")
CONTROLLERS = ("gait", "ilc")
TICK = 0.005
"""Control tick, s: learning has to see the ripple's peaks, and changes of offset fall on ticks."""
RECORD_HZ = 100.0
_LEAST_SAMPLES = 25
"""Samples in a gait period, fewer do not show the edges."""


@dataclass(frozen=True)
class Drive:
    """A robot, what drives it and how.

    Attributes:
        spec: the robot.
        frequency: of the gait, Hz.
        supply_pa: supply pressure, Pa.
        controller: "gait" (Eq. 13) or "ilc" (Eq. 32).
        target: of learning, rad.
        plant: "twin", "analytical" (model compliant on wheels), or what makes a plant of the right tick.
        steering: of learning, see `ILC`.
        chambers: "lag" or "orifice", of a plant that is named.
        contact: of the twin; None: its default. Other plants have none.
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
        """Refuse what cannot be driven.

        Raises:
            InputError: a number out of its range, or a pressure above what the robot may be given in pulses.
            UnknownNameError: a controller, plant or chambers that there are not.
        """
        if self.controller not in CONTROLLERS:
            raise UnknownNameError("controller", self.controller, CONTROLLERS)
        if isinstance(self.plant, str) and self.plant not in PLANTS:
            raise UnknownNameError("plant", self.plant, PLANTS)
        if self.chambers not in KINDS:
            raise UnknownNameError("chambers", self.chambers, KINDS)
        if self.contact is not None:
            as_contact(self.contact)
            if self.plant != "twin":
                raise InputError(f"contact {self.contact!r} belongs to the twin; take it out")
        given = ("pressure", self.supply_pa / 1000, "kPa"), ("frequency", self.frequency, "Hz")
        for name, value, unit in given:
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"{name} {value:g} {unit} is not allowed; it must be finite and above 0")
        spec, supply = self.spec, self.spec.supply
        if spec.segments < 2:
            raise InputError(f"{spec.name} has one segment; it does not crawl, so that it has no footprint")
        if self.supply_pa > supply.pulsed_limit:
            raise InputError(
                f"pressure {self.supply_pa / 1000:g} kPa is above the {supply.pulsed_limit / 1000:g} kPa "
                f"that {spec.name} may be given in pulses ({supply.limit_source})"
            )
        most = RECORD_HZ / _LEAST_SAMPLES
        if self.frequency > most:
            raise InputError(f"frequency {self.frequency:g} Hz is not allowed; {most:.3g} Hz is the most")
        self.make(0.0)

    @property
    def twin_contact(self) -> str | None:
        """Contact of the twin that runs; None: another plant does."""
        return self.contact or ModelSettings.contact.name if self.plant == "twin" else None

    @property
    def period(self) -> float:
        """Of the gait, s."""
        return 1 / self.frequency

    @property
    def settling(self) -> int:
        """Gait periods after which nothing is left of a start from rest: air, or duties not yet learnt."""
        return 16 if self.controller == "ilc" else 8

    @property
    def lasting(self) -> int:
        """Gait periods that a change of offset is given to be over."""
        return 12 if self.controller == "ilc" else 6

    @property
    def offsets(self) -> tuple[float, ...]:
        """The offsets that are measured where none are asked for: Table 8's, or to ±0.4 as in Fig. 33."""
        most = 3 if self.controller == "ilc" else 4
        return tuple(k / 10 for k in range(-most, most + 1))

    def make(self, offset: float, phase: float = 0.0) -> Gait | ILC:
        """Return a controller; ψ = phase, rad.

        Raises:
            InputError: it cannot have these settings.
        """
        if self.controller == "ilc":
            return ILC(self.frequency, offset, target=self.target, phase=phase, steering=self.steering)
        return Gait(self.frequency, offset, phase=phase)

    def plant_maker(self) -> Callable[[], Plant]:
        """Return what makes the plant; heavy imports wait until it does."""
        if callable(self.plant):
            return self.plant
        return partial(_plant, self)

    def steady_job(self, maker: Callable[[], Plant], offset: float, phase: float, periods: int) -> Job:
        """Return a run under one offset that ends with so many periods to be measured."""
        duration = ticks((self.settling + periods) * self.period)
        return Job(maker, partial(self.make, offset, phase), duration, record_hz=RECORD_HZ)

    def change_time(self, share: float) -> float:
        """Return when the offset changes (s): once the path has settled, after a share of a gait period."""
        return ticks((self.settling + share) * self.period)

    def change_job(
        self, maker: Callable[[], Plant], change: tuple[float, float], time: float, periods: int
    ) -> Job:
        """Return a run in which the offset changes at a time (s) from one to another.

        After what the change may last, so many periods follow.
        """
        before, after = change

        def controller() -> ScheduledOffset:
            return ScheduledOffset(self.make(before), [(time, after)])

        duration = ticks(time + (self.lasting + periods) * self.period)
        return Job(maker, controller, duration, record_hz=RECORD_HZ)


def ticks(time: float) -> float:
    """Return the time (s) of the first sample then or later: samples are taken every other tick."""
    return round(math.ceil(time * RECORD_HZ - 1e-6) / RECORD_HZ, 9)


def _plant(drive: Drive) -> Plant:
    settings: dict[str, Any] = {
        "supply_pa": drive.supply_pa, "tick": TICK, "pneumatics": drive.chambers,
    }  # fmt: skip
    if drive.plant == "twin":
        from srs_twin.plants.twin.snake import TwinSnake

        settings["contact"] = drive.twin_contact
        return TwinSnake(drive.spec, **settings)
    from srs_twin.plants.analytical import AnalyticalSnake

    # Under the pulses of learning the model with given bends slips (docs/learning.md).
    return AnalyticalSnake(drive.spec, model="compliant", friction="wheel", **settings)


@dataclass(frozen=True)
class Measured:
    """A measured footprint.

    Attributes:
        drive: robot, controller, plant.
        offsets: rising.
        steady: the path at each.
        spread: half the range of the repeats, of each number of `steady`.
        transients: the changes of offset that were measured.
        repeats: runs an offset, and a change.
        periods: of each that were measured.
    """

    drive: Drive
    offsets: tuple[float, ...]
    steady: tuple[SteadyPath, ...]
    spread: tuple[SteadyPath, ...]
    transients: tuple[Transient, ...]
    repeats: int
    periods: int


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
            self.drive.make(offset)
        if not all(b > a for a, b in zip(self.offsets, self.offsets[1:], strict=False)):
            given = f"offsets {_listed(self.offsets)} are not allowed"
            raise InputError(f"{given}; each must be there once, rising")
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
        limits = {"periods": (LEAST_PERIODS, MOST_PERIODS), "phases": (1, MOST_PHASES)}
        for name, (low, high) in limits.items():
            value = getattr(self, name)
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
            for offset in self.offsets
            for share in shares
        ]
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
        with named_in_errors(f"offset {offset:g}"):
            return mean_path([steady_path(self.drive, run, self.periods) for run in runs])

    def _transient(
        self,
        change: tuple[float, float],
        times: Sequence[float],
        runs: Sequence[Trajectory],
        paths: Mapping[float, SteadyPath],
    ) -> Transient:
        """Return what a change of offset does, at whatever phase of the gait it comes."""
        geometry, period, (before, after) = self.drive.spec.geometry, self.drive.period, change
        with named_in_errors(f"offset {before:g} to {after:g}"):
            found = [
                transient(run, geometry, period, Change(time, before, after), (paths[before], paths[after]))
                for run, time in zip(runs, times, strict=True)
            ]
            return widest(found)

    def _named(self, number: int) -> str:
        if number < len(self.offsets):
            return f"offset {self.offsets[number]:g}"
        return "offset {:g} to {:g}".format(*self.changes[number - len(self.offsets)])


def steady_path(drive: Drive, run: Trajectory, periods: int) -> SteadyPath:
    """Return the path over the last periods of a run.

    Raises:
        InputError: the run is too short, or the snake gets nowhere.
    """
    window = GaitWindow.ending_at(run, drive.period, float(run.time[-1]), periods)
    if window is None:
        raise InputError(f"the run is shorter than {periods} gait periods")
    return SteadyPath.of(run, drive.spec.geometry, window)


def _listed(offsets: Sequence[float]) -> str:
    return ", ".join(f"{offset:g}" for offset in offsets) or "(none)"


Changes = Sequence[tuple[float, float]]


def study(
    drive: Drive, *, offsets: Sequence[float] | None = None, changes: Changes | None = None, **counts: int
) -> Study:
    """Return the study of a footprint, with its defaults filled in.

    Args:
        drive: robot, controller, plant.
        offsets: rising; default −0.3 to 0.3 under learning, −0.4 to 0.4 else, in steps of 0.1.
        changes: (before, after) of offsets; default `changes_between`.
        **counts: periods and phases of the `Study`.

    Raises:
        InputError: what cannot be measured.
    """
    rows = drive.offsets if offsets is None else tuple(float(each) for each in offsets)
    checked = Study(drive, rows, (), **counts)
    return replace(checked, changes=changes_between(rows) if changes is None else tuple(changes))


def changes_between(offsets: Sequence[float]) -> tuple[tuple[float, float], ...]:
    """Return the changes that say most: among the outermost offsets and 0, and half way (where measured).

    Between changes that were measured a footprint is linear in their size.
    """
    low, high = min(offsets), max(offsets)
    full = [each for each in (low, 0.0, high) if each in offsets]
    pairs = [(a, b) for a in full for b in full if a != b]
    if 0.0 in offsets:
        for end in (low, high):
            inner = [each for each in offsets if 0 < each / end < 1]
            half = min(inner, key=lambda each: abs(each - end / 2), default=None)
            if half is not None:
                pairs += [(0.0, half), (half, 0.0)]
    return tuple(pairs)


_DIGITS = 4
_SPREADS = {"curvature_per_m": "curvature", "speed_m_s": "speed", "left_m": "left", "right_m": "right"}


def footprint_file(measured: Measured, name: str) -> FootprintFile:
    """Return a measurement as a file's content, each column with unit, status and source."""
    drive, paths, source = measured.drive, measured.steady, _source(measured)
    edge = "as curvature_per_m; the farthest that any repeat reached"
    # The snake lies straight at first, longer than it ever is in its gait.
    body = drive.spec.geometry
    at_rest = round((body.body_length + body.width) / 2, _DIGITS)

    def record(value: object, unit: str, source: str) -> dict[str, object]:
        return {"value": value, "unit": unit, "status": "calibrated", "source": source}

    content: dict[str, Any] = {
        "name": name,
        "title": f"{drive.spec.title.split(':')[0]}, {drive.frequency:g} Hz, "
        f"{drive.supply_pa / 1000:.4g} kPa, as measured on {_plant_text(drive)}",
        "robot": drive.spec.name,
        "contact": drive.twin_contact,
        "offset": record(list(measured.offsets), "1", "chosen"),
        "curvature_per_m": record(_column(paths, "curvature"), "1/m", source),
        "speed_m_s": record(_column(paths, "speed"), "m/s", "as curvature_per_m; along the arc"),
        "left_m": record(_column(paths, "left"), "m", edge),
        "right_m": record(_column(paths, "right"), "m", "as left_m"),
        "ahead_m": record(max(*_column(paths, "ahead"), at_rest), "m", "as left_m, or straight"),
        "behind_m": record(max(*_column(paths, "behind"), at_rest), "m", "as ahead_m"),
        "spread": {
            "source": f"half the range over {measured.repeats} phases of the gait at the start",
            **{key: _column(measured.spread, name) for key, name in _SPREADS.items()},
        },
    }
    if measured.transients:
        content["transients"] = {
            "status": "calibrated",
            "source": f"as curvature_per_m, each change at {measured.repeats} phases of the gait: the widest "
            "and longest of them, and the mean jump",
            "changes": [_change(each) for each in measured.transients],
        }
    return FootprintFile.model_validate(content)


def command(study: Study, robot: str, name: str) -> str:
    """Return the command that measures the same again.

    Args:
        study: what was measured.
        robot: as it was given, a name or a path.
        name: of the footprint.
    """
    drive = study.drive
    words = [
        f"srs-twin calibrate footprint {robot} --name {name} --controller {drive.controller}",
        f"--frequency {drive.frequency:g} --pressure {drive.supply_pa / 1000:.9g}",
    ]
    if drive.controller == "ilc":
        words.append(f"--target {drive.target:g}")
    if drive.plant != "twin":
        words.append(f"--plant {drive.plant}")
    else:
        words.append(f"--contact {drive.twin_contact}")
    if drive.chambers != "lag":
        words.append(f"--chambers {drive.chambers}")
    if study.offsets != drive.offsets:
        words.append("--offsets=" + ",".join(f"{offset:g}" for offset in study.offsets))
    if study.changes != changes_between(study.offsets):
        words.append("--no-transients")
    words.append(f"--periods {study.periods} --phases {study.phases}")
    return " ".join(words)


def header(study: Study, robot: str, name: str, versions: Mapping[str, str]) -> list[str]:
    """Return the lines that say how a file came to be, those that identify it first."""
    with_versions = ", ".join(f"{package} {version}" for package, version in versions.items())
    return [*_identity(study, robot, name), f"with: {with_versions}"]


def robot_hash(spec: RobotSpec) -> str:
    """Return the SHA-256 of a robot's numbers in SI, of those that are not their defaults.

    A parameter that is added later, and does nothing by default, leaves it as it was.
    """

    def told(part: Any) -> Any:
        if not is_dataclass(part):
            return part
        values = {each: getattr(part, each.name) for each in fields(part)}
        return {each.name: told(value) for each, value in values.items() if value != each.default}

    return hashlib.sha256(repr(told(spec)).encode()).hexdigest()


def refuse_other(path: Path, study: Study, robot: str, name: str) -> None:
    """Refuse a place where another file stands than one that this study wrote.

    Raises:
        InputError: it does, or the place cannot be read.
    """
    if not os.path.lexists(path):
        return
    first = [line.removeprefix("# ") for line in read_text(path).splitlines()[:2]]
    if first != _identity(study, robot, name):
        raise InputError(
            f"{display_path(path)}: another footprint stands there; --overwrite replaces it, "
            "--name and --out lead elsewhere"
        )


def _identity(study: Study, robot: str, name: str) -> list[str]:
    return [
        f"measured by: {command(study, robot, name)}",
        f"robot {study.drive.spec.name}, sha256 of its numbers: {robot_hash(study.drive.spec)}",
    ]


def _column(paths: Sequence[SteadyPath], key: str) -> list[float]:
    # Not -0.0, which a straight path may round to.
    return [round(getattr(path, key), _DIGITS) + 0.0 for path in paths]


def _change(each: Transient) -> dict[str, float]:
    keys = ("from_offset", "to_offset", "left_m", "right_m", "length_m", "dx_m", "dy_m", "dheading_rad")
    values = dict(zip(keys, astuple(each), strict=True))
    return {key: round(value, _DIGITS) + 0.0 for key, value in values.items()}


def _source(measured: Measured) -> str:
    return (
        f"measured on {_plant_text(measured.drive)} by `srs-twin calibrate footprint`, over "
        f"{measured.periods} gait periods at each of {measured.repeats} phases of the gait at the start"
    )


def _plant_text(drive: Drive) -> str:
    if not isinstance(drive.plant, str):
        return "a plant of one's own"
    named = {"twin": "the twin", "analytical": "the analytical model compliant"}[drive.plant]
    return named if drive.chambers == "lag" else f"{named} with {drive.chambers} chambers"


def rows(measured: Measured) -> list[Sequence[str]]:
    """Return the table that people read: offset, then speed, curvature and edges with their spread."""
    found: list[Sequence[str]] = []
    for offset, path, spread in zip(measured.offsets, measured.steady, measured.spread, strict=True):
        names = ("speed", "curvature", "left", "right")
        cells = (f"{getattr(path, name):.4f} ± {getattr(spread, name):.4f}" for name in names)
        found.append((f"{offset:g}", *cells))
    return found
