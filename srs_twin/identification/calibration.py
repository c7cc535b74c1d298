"""Fits of parameters of a robot to recordings and tables: the functions behind `srs-twin calibrate`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import Any

from srs_twin.errors import InputError
from srs_twin.identification.actuator import Response, fit_actuator
from srs_twin.identification.damping import HangingBody, fit_damping
from srs_twin.identification.decay import read_decay
from srs_twin.identification.estimate import FitEstimate
from srs_twin.identification.fit_file import (
    Data,
    DataSet,
    FitFile,
    Method,
    data_sets,
    fit_file,
    short_command,
    write_fit,
)
from srs_twin.identification.friction import (
    PULL_COLUMNS,
    CoastingTest,
    fit_coasting,
    fit_pulls,
    is_pull_table,
    read_pull_table,
)
from srs_twin.identification.least_squares import Watch
from srs_twin.identification.locomotion import (
    GaitRun,
    PlantModel,
    fit_locomotion,
    gait_run,
    measured_length,
)
from srs_twin.identification.parameters import with_values
from srs_twin.identification.static_tables import (
    NamedRecordings,
    StaticTable,
    fit_static,
    is_static_table,
    merge_tables,
    plateau_tables,
    read_static_table,
)
from srs_twin.io.arguments import checked
from srs_twin.io.file_sets import replace_files
from srs_twin.io.files import StrPath, check_file_name, path_from
from srs_twin.recordings.formats import UnknownFormatError
from srs_twin.recordings.takes import RecordingReader, logs_of
from srs_twin.robot.file import load_robot
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.provenance import versions

Paths = Sequence[StrPath]
Robot = StrPath | RobotSpec
Notify = Callable[[str], object]
"""Function called with a note about each recording, before the search."""

LOCOMOTION = (
    "friction.mu_t",
    "friction.mu_n",
    "geometry.rigid_gap_m",
    "bending.stiffness_nm_per_rad",
)
"""Parameters that `calibrate_locomotion` fits by default."""

_READER = RecordingReader()
_NOT_RECORDED = {"out", "notify", "progress"}
"""Arguments that do not change a result."""


@dataclass(frozen=True)
class Calibration:
    """Result of a fit, with the data that it used.

    Attributes:
        estimate: parameters, correlations and residuals; a notebook displays it as a
            page.
        method: method of the fit.
        title: title, one line.
        robot: initial robot, a name or a path.
        data: data sets with their roles.
        plateaus: table of the constant pressures in recordings; None for other fits.
    """

    estimate: FitEstimate
    method: Method
    title: str
    robot: str
    data: tuple[DataSet, ...]
    plateaus: StaticTable | None = None

    def write(self, path: Path, name: str, command: str) -> FitFile:
        """Write report and fit file atomically together; return the content of the fit file.

        Args:
            path: fit file; the report is in the same folder.
            name: name of the fit.
            command: command that made the fit.

        Raises:
            InputError: a file cannot be written.
        """
        from srs_twin.identification.fit_report import fit_report

        fit = fit_file(
            self.estimate,
            name=name,
            title=self.title[:200],
            robot=path_from(path.parent, self.robot),
            method=self.method,
            command=command,
            versions=versions(),
            data=self.data,
        )
        report = path.with_suffix(".html").name
        text = fit_report(fit, self.estimate)
        with replace_files(path.parent, (path.name, report)) as fresh:
            (fresh / report).write_text(text, "utf-8")
            write_fit(fit, fresh / path.name)
        return fit


@checked
def calibrate_friction(
    files: Paths,
    robot: Robot,
    *,
    validate: Paths = (),
    law: str = "wheel",
    wheel_inertia: bool = True,
    reader: RecordingReader = _READER,
    out: StrPath | None = None,
    notify: Notify = str,
    progress: Watch | None = None,
) -> Calibration:
    """Estimate mu_t and mu_n from pulls or coasting tests, as `srs-twin calibrate friction`.

    Args:
        files: one table of spring deformations, or recordings of coasting tests.
        robot: initial robot, a name or path.
        validate: tables or recordings for validation, not used by the fit.
        law: friction law of coasting tests: "wheel", "axis" or "ellipse".
        wheel_inertia: whether coasting tests include the rotational inertia of the
            wheels.
        reader: settings with which recordings are read.
        out: fit file; an existing one is replaced, and the report is in the same
            folder. None: not written.
        notify: function called with a note about each recording.
        progress: function called with the number of model runs and the best weighted
            RMS so far.

    Raises:
        InputError: a file cannot be read, or the data do not allow the fit.
    """
    given = locals()
    spec = load_robot(robot)
    paths = _texts(files)
    kept = _texts(validate)
    if _all_of_kind(
        [*paths, *kept], is_pull_table, "table of pulls", "recording of a coasting test"
    ):
        if len(paths) > 1:
            raise InputError(
                f"{paths[1]}: a fit uses one table of pulls; give further ones with"
                " --validate"
            )
        pulls = read_pull_table(paths[0])
        validation_pulls = [read_pull_table(path) for path in kept]
        estimate = fit_pulls(pulls, validation=validation_pulls)
        title = f"Friction of {spec.name} from pulls"
        return _finished(
            calibrate_friction,
            given,
            estimate,
            "pulls",
            title,
            [pulls],
            validation_pulls,
        )

    def coasting_test(path: str) -> CoastingTest:
        try:
            recording = reader.motion(path, spec)
        except UnknownFormatError as error:
            raise InputError(
                f"{error}; a table of pulls has the columns {PULL_COLUMNS}"
            ) from None
        notify(recording.summary.text())
        return CoastingTest.from_trajectory(recording.trajectory, path)

    runs = [coasting_test(path) for path in paths]
    validation = [coasting_test(path) for path in kept]
    estimate = fit_coasting(
        runs,
        spec,
        validation=validation,
        law=law,
        wheel_inertia=wheel_inertia,
        watch=progress,
    )
    title = f"Friction of {spec.name} from coasting tests"
    return _finished(
        calibrate_friction, given, estimate, "coasting", title, runs, validation
    )


@checked
def calibrate_actuator(
    files: Paths,
    robot: Robot,
    *,
    valves: Paths = (),
    validate: Paths = (),
    supply_pa: float | None = None,
    find: Sequence[str] | None = None,
    static: bool = False,
    starts: int = 1,
    reader: RecordingReader = _READER,
    out: StrPath | None = None,
    notify: Notify = str,
    progress: Watch | None = None,
) -> Calibration:
    """Estimate time constants, gains and rest bends, as `srs-twin calibrate actuator`.

    Args:
        files: recordings of step responses, or tables or recordings of constant
            pressures (gains only).
        robot: initial robot, a name or path.
        valves: logs, one for each of `files`, then for each of `validate`; default:
            those beside them.
        validate: recordings or tables for validation, not used by the fit.
        supply_pa: supply pressure, Pa; None: the nominal pressure of the robot.
        find: parameters to fit; None: all that the data can show.
        static: whether plateaus of constant pressure in recordings are fitted.
        starts: number of searches.
        reader: settings with which recordings are read.
        out: see `calibrate_friction`.
        notify: see `calibrate_friction`.
        progress: see `calibrate_friction`.

    Raises:
        InputError: a file cannot be read, or the data do not allow the fit.
    """
    given = locals()
    spec = load_robot(robot)
    paths = _texts(files)
    kept = _texts(validate)
    held = f"Actuators of {spec.name} from held pressures"
    if _all_of_kind(
        [*paths, *kept], is_static_table, "table of constant pressures", "recording"
    ):
        _refuse_option(valves, "--valves", "tables of constant pressures have no log")
        _refuse_option(
            static, "--static", "tables of constant pressures already contain plateaus"
        )
        tables, kept_tables = (
            [read_static_table(path, spec) for path in group] for group in (paths, kept)
        )
        estimate = fit_static(
            tables, spec, names=find, validation=kept_tables, watch=progress
        )
        return _finished(
            calibrate_actuator, given, estimate, "static", held, tables, kept_tables
        )
    supply = spec.supply.nominal if supply_pa is None else supply_pa
    recordings, kept_recordings = _recordings(
        paths, kept, _texts(valves), reader, spec, notify
    )
    if static:
        tables = plateau_tables(recordings, spec, supply)
        kept_tables = [
            StaticTable.from_recording(r, path, spec, supply)
            for path, r in kept_recordings
        ]
        merged = merge_tables(tables)
        estimate = fit_static(
            [merged], spec, names=find, validation=kept_tables, watch=progress
        )
        return _finished(
            calibrate_actuator,
            given,
            estimate,
            "static",
            held,
            tables,
            kept_tables,
            merged,
        )
    fitted, validation = (
        [Response.from_recording(recording, path, supply) for path, recording in named]
        for named in (recordings, kept_recordings)
    )
    estimate = fit_actuator(
        fitted, spec, names=find, validation=validation, starts=starts, watch=progress
    )
    title = f"Actuators of {spec.name} from responses"
    return _finished(
        calibrate_actuator, given, estimate, "actuator", title, fitted, validation
    )


@checked
def calibrate_locomotion(
    files: Paths,
    robot: Robot,
    *,
    valves: Paths = (),
    validate: Paths = (),
    supply_pa: float | None = None,
    find: Sequence[str] = LOCOMOTION,
    plant: str = "analytical",
    model: str | None = None,
    law: str | None = None,
    against: str = "both",
    starts: int | None = None,
    reader: RecordingReader = _READER,
    out: StrPath | None = None,
    notify: Notify = str,
    progress: Watch | None = None,
) -> Calibration:
    """Estimate friction, gap, masses or stiffness from runs on the floor, as `srs-twin calibrate locomotion`.

    If there are markers, the rigid gap (or the length of a segment) is measured from
    them.

    Args:
        files: recordings.
        robot: initial robot, a name or path.
        valves: logs, one for each of `files`, then for each of `validate`; default:
            those beside them.
        validate: recordings for validation, not used by the fit.
        supply_pa: supply pressure, Pa; None: the nominal pressure of the robot.
        find: parameters to fit.
        plant: simulated plant, "analytical" or "twin".
        model: analytical model; None: "compliant".
        law: friction law of the analytical plant; None: "wheel".
        against: compared signals: "averages", "shapes" or "both".
        starts: number of searches; None: 3, or 1 with the twin's shapes.
        reader: settings with which recordings are read.
        out: see `calibrate_friction`.
        notify: see `calibrate_friction`.
        progress: see `calibrate_friction`.

    Raises:
        InputError: a file cannot be read, or the data do not allow the fit.
    """
    given = locals()
    spec = load_robot(robot)
    paths = _texts(files)
    kept = _texts(validate)
    plant_model = PlantModel(plant, _plant_settings(plant, model, law))
    supply = spec.supply.nominal if supply_pa is None else supply_pa
    recordings, kept_recordings = _recordings(
        paths, kept, _texts(valves), reader, spec, notify
    )
    length = measured_length([recording for _, recording in recordings], spec, find)
    if (
        length is not None
    ):  # bends and centre of mass depend on the length, so read the recordings again
        spec = with_values(spec, {length.name: length.value or 0.0})
        recordings, kept_recordings = _recordings(
            paths, kept, _texts(valves), reader, spec, str
        )
        length = measured_length([recording for _, recording in recordings], spec, find)
    runs, validation = (
        _gait_runs(named, supply, notify) for named in (recordings, kept_recordings)
    )
    estimate = fit_locomotion(
        runs,
        spec,
        find,
        model=plant_model,
        against=against,
        validation=validation,
        starts=starts or (1 if plant == "twin" and against != "averages" else 3),
        watch=progress,
        reference=None if plant == "twin" else PlantModel("twin"),
        known=[length] if length else [],
    )
    title = f"Locomotion of {spec.name} against the {plant} plant"
    return _finished(
        calibrate_locomotion, given, estimate, "locomotion", title, runs, validation
    )


@checked
def calibrate_damping(
    files: Paths,
    robot: Robot,
    *,
    valves: str = "open",
    mass_kg: float | None = None,
    inertia_kg_m2: float | None = None,
    leak_per_s: float | None = None,
    noise_rad: float | None = None,
    from_s: float | None = None,
    out: StrPath | None = None,
    notify: Notify = str,
    progress: Watch | None = None,
) -> Calibration:
    """Estimate stiffness, damping time and loss factor of a segment, as `srs-twin calibrate damping`.

    Args:
        files: recordings of one hanging segment that is released from a bend.
        robot: initial robot, a name or path.
        valves: whether the chambers were open to the air or closed: "open" or "closed".
        mass_kg: mass of the body at the end of the segment; None: that of the first
            connector.
        inertia_kg_m2: moment of inertia of the body about its centre; None: with the
            connector's radius of gyration.
        leak_per_s: leak rate of closed chambers; None: fitted.
        noise_rad: standard deviation of a recorded bend; None: estimated from the
            recording.
        from_s: time from which the segment swings freely; None: detected.
        out: see `calibrate_friction`.
        notify: see `calibrate_friction`.
        progress: see `calibrate_friction`.

    Raises:
        InputError: a file cannot be read, or the data do not allow the fit.
    """
    given = locals()
    spec = load_robot(robot)
    body = HangingBody.of(spec, mass_kg, inertia_kg_m2)
    decays = [read_decay(path, start=from_s, noise=noise_rad) for path in _texts(files)]
    for decay in decays:
        notify(decay.text())
    estimate = fit_damping(
        decays, spec, valves=valves, body=body, leak=leak_per_s, watch=progress
    )
    if valves == "closed":
        notify(
            "valves closed: frequency and loss_factor contain the spring of the air and"
            " its loss"
        )
    title = f"Damping of {spec.name} from decays with {valves} valves"
    return _finished(calibrate_damping, given, estimate, "damping", title, decays, [])


def _texts(paths: Paths) -> list[str]:
    return [os.fspath(path) for path in paths]


def _finished(
    function: Callable[..., Calibration],
    given: Mapping[str, Any],
    estimate: FitEstimate,
    method: Method,
    title: str,
    fitted: Iterable[Data],
    validation: Iterable[Data],
    plateaus: StaticTable | None = None,
) -> Calibration:
    """Return the result of a fit, and write it if the arguments `given` to the function name a file."""
    robot = given["robot"]
    if isinstance(robot, RobotSpec):
        name = robot.name
    else:
        name = os.fspath(robot)
    data = tuple(data_sets(fitted, validation))
    result = Calibration(estimate, method, title, name, data, plateaus)
    if given["out"] is not None:
        path = Path(given["out"])
        if path.suffix not in (".yaml", ".yml"):
            raise InputError(f"out: {path} is not allowed; a fit file ends in .yaml")
        result.write(
            path,
            check_file_name(path.stem, "out names the fit"),
            _call(function, given),
        )
    return result


def _call(function: Callable[..., Calibration], given: Mapping[str, Any]) -> str:
    """Return a call of a function as text, without arguments that have their default value."""
    words = [
        f"{name}={getattr(given[name], 'name', given[name])!r}"
        for name, parameter in signature(function).parameters.items()
        if name not in _NOT_RECORDED and given[name] != parameter.default
    ]
    return short_command(f"srs_twin.{function.__name__}({', '.join(words)})")


def _recordings(
    paths: list[str],
    validation: list[str],
    logs: list[str],
    reader: RecordingReader,
    spec: RobotSpec,
    notify: Notify,
) -> tuple[NamedRecordings, NamedRecordings]:
    """Return the recordings of the fit and of the validation with their logs."""
    every = [*paths, *validation]
    recordings = []
    for path, log in zip(every, logs_of(every, logs), strict=True):
        recording = reader.take(path, log, spec)
        notify(f"{recording.summary.text()}\n")
        recordings.append((path, recording))
    return recordings[: len(paths)], recordings[len(paths) :]


def _gait_runs(
    recordings: NamedRecordings, supply_pa: float, notify: Notify
) -> list[GaitRun]:
    """Return recordings as gait runs, with a warning if chambers are filling at the start."""
    for path, recording in recordings:
        if not recording.starts_at_rest():
            notify(
                f"warning: {path}: chambers are filling at the start; the plants start"
                " with empty ones"
            )
    return [gait_run(recording, path, supply_pa) for path, recording in recordings]


def _all_of_kind(
    files: Sequence[str], is_first: Callable[[str], bool], first: str, second: str
) -> bool:
    """Return whether all files are of the first kind, False if all are of the second.

    Raises:
        InputError: both kinds occur, or a file cannot be read.
    """
    kinds = [is_first(path) for path in files]
    if len(set(kinds)) > 1:
        one = files[kinds.index(True)]
        other = files[kinds.index(False)]
        raise InputError(f"{one} is a {first}, {other} a {second}; fit them separately")
    return kinds[0]


def _plant_settings(plant: str, model: str | None, law: str | None) -> dict[str, str]:
    """Return the settings of a fit's plant."""
    if plant == "analytical":
        return {"model": model or "compliant", "friction": law or "wheel"}
    _refuse_option(model, "--model", "it is only for --plant analytical")
    _refuse_option(law, "--law", "it is only for --plant analytical")
    return {}


def _refuse_option(value: object, option: str, why: str) -> None:
    if value:
        raise InputError(f"{option}: remove this option; {why}")
