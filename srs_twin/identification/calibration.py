"""Functions that fit robot parameters to data, as `srs-twin calibrate` does."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

from srs_twin.errors import InputError
from srs_twin.identification.actuator import Response, fit_actuator
from srs_twin.identification.damping import HangingBody, fit_damping
from srs_twin.identification.decay import Decay, read_decay
from srs_twin.identification.estimate import FitEstimate, Parameter
from srs_twin.identification.fit_file import (
    DataSet,
    FitFile,
    Method,
    check_fit_suffix,
    data_sets,
    fit_file,
    short_command,
    write_fit,
)
from srs_twin.identification.friction import (
    PULL_COLUMNS,
    CoastingTest,
    Pulls,
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
from srs_twin.identification.parameters import free_parameters, with_values
from srs_twin.identification.static_tables import (
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
from srs_twin.recordings.formats.base import UnknownFormatError
from srs_twin.recordings.recording import Recording
from srs_twin.recordings.takes import RecordingReader, logs_of
from srs_twin.robot.file import load_robot
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.provenance import versions

Paths = Sequence[StrPath]
Robot = StrPath | RobotSpec
Notify = Callable[[str], object]
"""Callback that receives a message about each recording before the search starts."""

LOCOMOTION = (
    "friction.mu_t",
    "friction.mu_n",
    "geometry.rigid_gap_m",
    "bending.stiffness_nm_per_rad",
)
"""Parameters that `calibrate_locomotion` fits by default."""

_READER = RecordingReader()
_NOT_RECORDED = {"out", "notify", "progress"}
"""Arguments that the command in a fit file omits, as they do not affect the fit."""


@dataclass(frozen=True)
class Calibration:
    """Result of a fit, with a description of the data.

    Attributes:
        estimate: estimated parameters, correlations and residuals.
        method: fit method.
        title: one-line title of the report.
        robot: name or path of the robot from which the fit started.
        data: data sets used for the fit and for its validation.
        plateaus: pressures and bends in the intervals of constant pressure, or None if
            the method does not use such intervals.
    """

    estimate: FitEstimate
    method: Method
    title: str
    robot: str
    data: tuple[DataSet, ...]
    plateaus: StaticTable | None = None

    def write(self, path: Path, name: str, command: str) -> FitFile:
        """Write the fit file and the HTML report, and return the fit file.

        Args:
            path: path of the fit file. The report is written to the same folder.
            name: name of the fit.
            command: command line that produced the fit.

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
    friction_law: str = "wheel",
    wheel_inertia: bool = True,
    reader: RecordingReader = _READER,
    out: StrPath | None = None,
    notify: Notify = str,
    progress: Watch | None = None,
) -> Calibration:
    """Estimate friction coefficients, as `srs-twin calibrate friction` does.

    Args:
        files: path of one table of pulls, or paths of recordings of coasting tests.
        robot: name or path of the initial robot, or a loaded robot.
        validate: paths of tables or recordings that are used only for validation.
        friction_law: friction law for coasting tests, "wheel", "axis", "ellipse" or
            "cosine".
        wheel_inertia: whether the model of coasting tests includes the rotational
            inertia of the wheels.
        reader: object that reads the recordings.
        out: path of the fit file, or None to write nothing. An existing file is
            replaced, and the report is written to the same folder.
        notify: function that receives a message about each recording.
        progress: function called with the number of model runs and the smallest
            weighted RMS so far.

    Raises:
        InputError: a file cannot be read, the data are not sufficient for the fit, or
            pulls give an implausible coefficient.
    """
    task = _Task(calibrate_friction, locals())
    if task.all_are(is_pull_table, "table of pulls", "recording of a coasting test"):
        return task.calibrate(_PULLS)
    return task.calibrate(
        _COASTING_TESTS, friction_law=friction_law, wheel_inertia=wheel_inertia
    )


@checked
def calibrate_actuator(
    files: Paths,
    robot: Robot,
    *,
    valves: Paths = (),
    validate: Paths = (),
    supply_pa: float | None = None,
    parameters: Sequence[str] | None = None,
    static: bool = False,
    starts: int = 1,
    reader: RecordingReader = _READER,
    out: StrPath | None = None,
    notify: Notify = str,
    progress: Watch | None = None,
) -> Calibration:
    """Estimate the actuator parameters, as `srs-twin calibrate actuator` does.

    Args:
        files: paths of recordings of step responses, or paths of tables of constant
            pressures. Constant pressures do not determine the time constants.
        robot: name or path of the initial robot, or a loaded robot.
        valves: paths of the valve or pressure logs, first for `files` and then for
            `validate`. By default, each log is in the folder of its recording.
        validate: paths of recordings or tables that are used only for validation.
        supply_pa: supply pressure, Pa, by default the nominal pressure of the robot.
        parameters: names of the parameters to fit, by default all parameters that the
            data can determine.
        static: whether the fit uses only the intervals of constant pressure in the
            recordings.
        starts: number of searches, each from a different starting point.
        reader: object that reads the recordings.
        out: path of the fit file, or None to write nothing.
        notify: function that receives a message about each recording.
        progress: progress callback, as in `calibrate_friction`.

    Raises:
        InputError: a file cannot be read, or the data are not sufficient for the fit.
    """
    task = _Task(calibrate_actuator, locals())
    if task.all_are(is_static_table, "table of constant pressures", "recording"):
        why = "tables of constant pressures"
        _refuse_option(valves, "--valves", f"{why} need no log")
        _refuse_option(static, "--static", f"{why} already contain plateaus")
        return task.calibrate(_STATIC_TABLES, names=parameters)
    if static:
        return task.calibrate(_PLATEAUS, names=parameters)
    return task.calibrate(_RESPONSES, names=parameters, starts=starts)


@checked
def calibrate_locomotion(
    files: Paths,
    robot: Robot,
    *,
    valves: Paths = (),
    validate: Paths = (),
    supply_pa: float | None = None,
    parameters: Sequence[str] = LOCOMOTION,
    plant: str = "analytical",
    model: str | None = None,
    friction_law: str | None = None,
    compare_signals: str = "both",
    starts: int | None = None,
    reader: RecordingReader = _READER,
    out: StrPath | None = None,
    notify: Notify = str,
    progress: Watch | None = None,
) -> Calibration:
    """Estimate friction, lengths, masses or stiffness from recorded gait runs.

    If the recordings contain markers and either the rigid gap or the segment length is
    requested, this length is measured from the marker positions.

    Args:
        files: paths of recordings.
        robot: name or path of the initial robot, or a loaded robot.
        valves: paths of the valve or pressure logs, first for `files` and then for
            `validate`. By default, each log is in the folder of its recording.
        validate: paths of recordings that are used only for validation.
        supply_pa: supply pressure, Pa, by default the nominal pressure of the robot.
        parameters: names of the parameters to fit.
        plant: simulated plant, "analytical" or "twin".
        model: name of the analytical model, by default "compliant".
        friction_law: friction law of the analytical plant, by default "wheel".
        compare_signals: signals to compare, "averages", "shapes" or "both".
        starts: number of searches, each from a different starting point. The default is
            3, or 1 if the shapes of twin simulations are compared.
        reader: object that reads the recordings.
        out: path of the fit file, or None to write nothing.
        notify: function that receives a message about each recording.
        progress: progress callback, as in `calibrate_friction`.

    Raises:
        InputError: a file cannot be read, or the data are not sufficient for the fit.
    """
    task = _Task(calibrate_locomotion, locals())
    reference = None if plant == "twin" else PlantModel("twin")
    default_starts = 1 if plant == "twin" and compare_signals != "averages" else 3
    return task.calibrate(
        _GAIT_RUNS,
        names=parameters,
        model=PlantModel(plant, _plant_settings(plant, model, friction_law)),
        compare_signals=compare_signals,
        starts=starts or default_starts,
        reference=reference,
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
    """Estimate stiffness, damping time and loss factor from free oscillations.

    Args:
        files: paths of recordings of one hanging segment that is bent and then
            released.
        robot: name or path of the initial robot, or a loaded robot.
        valves: state of the chambers, "open" to the air or "closed".
        mass_kg: mass of the body at the end of the segment, kg, by default the mass of
            the first connector.
        inertia_kg_m2: moment of inertia of the body about its centre, kg·m². By
            default, the body has the radius of gyration of the first connector.
        leak_per_s: leak rate of closed chambers, 1/s, or None to estimate the rate.
        noise_rad: standard deviation of a recorded bend, rad, or None to estimate it.
        from_s: time at which the free swing starts, s, or None to detect this time.
        out: path of the fit file, or None to write nothing.
        notify: function that receives a message about each recording.
        progress: progress callback, as in `calibrate_friction`.

    Raises:
        InputError: a file cannot be read, or the data are not sufficient for the fit.
    """
    task = _Task(calibrate_damping, locals())
    body = HangingBody.of(task.spec, mass_kg, inertia_kg_m2)
    return task.calibrate(_DECAYS, valves=valves, body=body, leak=leak_per_s)


def _texts(paths: Paths) -> list[str]:
    return [os.fspath(path) for path in paths]


class _Task:
    """Settings, robot and input files of one call to a fit function."""

    def __init__(
        self, function: Callable[..., Calibration], given: Mapping[str, Any]
    ) -> None:
        self._function = function
        self.given = given
        self.notify: Notify = given["notify"]
        self.spec = load_robot(given["robot"])
        self.length: Parameter | None = None
        self.fitted = _texts(given["files"])
        self.files = [*self.fitted, *_texts(given.get("validate", ()))]

    @property
    def supply_pa(self) -> float:
        supply: float | None = self.given["supply_pa"]
        return self.spec.supply.nominal if supply is None else supply

    def all_are(self, is_first: Callable[[str], bool], first: str, second: str) -> bool:
        kinds = [is_first(path) for path in self.files]
        if len(set(kinds)) > 1:
            one = self.files[kinds.index(True)]
            other = self.files[kinds.index(False)]
            raise InputError(
                f"{one} is a {first}, but {other} is a {second}; fit them with"
                " separate commands"
            )
        return kinds[0]

    def recordings(self) -> list[tuple[str, Recording]]:
        recordings = []
        logs = logs_of(self.files, _texts(self.given["valves"]))
        for path, log in zip(self.files, logs, strict=True):
            recording = self.given["reader"].take(path, log, self.spec)
            self.notify(f"{recording.summary.text()}\n")
            recordings.append((path, recording))
        return recordings

    def calibrate(self, kind: _Kind, **settings: Any) -> Calibration:
        data = kind.read(self)
        fitted = data[: len(self.fitted)]
        validation = data[len(self.fitted) :]
        if validation:
            settings["validation"] = validation
        if self.length is not None:
            settings["known"] = [self.length]
        estimate = kind.fit(fitted, self.spec, watch=self.given["progress"], **settings)
        robot = self.given["robot"]
        result = Calibration(
            estimate,
            kind.method,
            kind.title.format(spec=self.spec, **self.given),
            robot.name if isinstance(robot, RobotSpec) else os.fspath(robot),
            tuple(data_sets(fitted, validation)),
            merge_tables(fitted) if kind is _PLATEAUS else None,
        )
        if self.given["out"] is not None:
            path = Path(self.given["out"])
            check_fit_suffix("out", path)
            name = check_file_name(path.stem, "`out` is also the name of the fit")
            result.write(path, name, self._call())
        return result

    def _call(self) -> str:
        words = [
            f"{name}={getattr(self.given[name], 'name', self.given[name])!r}"
            for name, parameter in signature(self._function).parameters.items()
            if name not in _NOT_RECORDED and self.given[name] != parameter.default
        ]
        return short_command(f"srs_twin.{self._function.__name__}({', '.join(words)})")


def _read_pulls(task: _Task) -> list[Pulls]:
    if len(task.fitted) > 1:
        raise InputError(
            f"{task.fitted[1]}: only one table of pulls is allowed in a fit; give"
            " other tables with --validate"
        )
    return [read_pull_table(path) for path in task.files]


def _fit_pulls(
    pulls: Sequence[Pulls], spec: RobotSpec, watch: Watch | None, **settings: Any
) -> FitEstimate:
    fit = fit_pulls(*pulls, **settings)
    for limits in free_parameters(spec, [each.name for each in fit.parameters]):
        value = fit[limits.name].value
        if value is not None and not limits.low <= value <= limits.high:
            raise InputError(
                f"{pulls[0].name}: the pulls give {limits.name} = {value:.3g}, but it"
                f" must be between {limits.low:g} and {limits.high:g}; check"
                f" `spring_n_per_m` {pulls[0].stiffness:g} and `mass_kg`"
                f" {pulls[0].mass:g} ({spec.name} has a mass of"
                f" {spec.mass.total:.3g} kg)"
            )
    return fit


def _read_coasting_tests(task: _Task) -> list[CoastingTest]:
    tests = []
    for path in task.files:
        try:
            recording = task.given["reader"].motion(path, task.spec)
        except UnknownFormatError as error:
            raise InputError(
                f"{error}. A table of pulls has the columns {PULL_COLUMNS}"
            ) from None
        task.notify(recording.summary.text())
        tests.append(CoastingTest.from_trajectory(recording.trajectory, path))
    return tests


def _read_plateaus(task: _Task) -> list[StaticTable]:
    recordings = task.recordings()
    count = len(task.fitted)
    return [
        *plateau_tables(recordings[:count], task.spec, task.supply_pa),
        *(
            StaticTable.from_recording(recording, path, task.spec, task.supply_pa)
            for path, recording in recordings[count:]
        ),
    ]


def _read_gait_runs(task: _Task) -> list[GaitRun]:
    def measured() -> Parameter | None:
        fitted = [recording for _, recording in recordings[: len(task.fitted)]]
        return measured_length(fitted, task.spec, task.given["parameters"])

    recordings = task.recordings()
    length = measured()
    if length is not None:
        # Read the recordings again, because the bends and the centre of mass depend on
        # the measured length.
        task.spec = with_values(task.spec, {length.name: length.value or 0.0})
        task.notify = str
        recordings = task.recordings()
        task.length = measured()
    for path, recording in recordings:
        if not recording.starts_at_rest():
            task.given["notify"](
                f"warning: {path}: some chambers are already filling at the start, but"
                " the simulation starts with empty chambers"
            )
    return [gait_run(recording, path, task.supply_pa) for path, recording in recordings]


def _read_decays(task: _Task) -> list[Decay]:
    start = task.given["from_s"]
    noise = task.given["noise_rad"]
    decays = [read_decay(path, start=start, noise=noise) for path in task.files]
    for decay in decays:
        task.notify(decay.text())
    if task.given["valves"] == "closed":
        task.notify(
            "the valves are closed, so the estimated frequency and `loss_factor`"
            " include the stiffness and the damping of the enclosed air"
        )
    return decays


class _Kind(NamedTuple):
    method: Method
    title: str
    read: Callable[[_Task], Sequence[Any]]
    fit: Callable[..., FitEstimate]


_PULLS = _Kind(
    "pulls",
    "Friction of {spec.name} from pulls",
    _read_pulls,
    _fit_pulls,
)
_COASTING_TESTS = _Kind(
    "coasting",
    "Friction of {spec.name} from coasting tests",
    _read_coasting_tests,
    fit_coasting,
)
_STATIC_TABLES = _Kind(
    "static",
    "Actuators of {spec.name} from held pressures",
    lambda task: [read_static_table(path, task.spec) for path in task.files],
    fit_static,
)
_PLATEAUS = _STATIC_TABLES._replace(
    read=_read_plateaus,
    fit=lambda tables, *robot, **settings: fit_static(
        [merge_tables(tables)], *robot, **settings
    ),
)
_RESPONSES = _Kind(
    "actuator",
    "Actuators of {spec.name} from responses",
    lambda task: [
        Response.from_recording(recording, path, task.supply_pa)
        for path, recording in task.recordings()
    ],
    fit_actuator,
)
_GAIT_RUNS = _Kind(
    "locomotion",
    "Locomotion of {spec.name} against the {plant} plant",
    _read_gait_runs,
    fit_locomotion,
)
_DECAYS = _Kind(
    "damping",
    "Damping of {spec.name} from decays with {valves} valves",
    _read_decays,
    fit_damping,
)


def _plant_settings(
    plant: str, model: str | None, friction_law: str | None
) -> dict[str, str]:
    if plant == "analytical":
        return {"model": model or "compliant", "friction": friction_law or "wheel"}
    why = "this option is allowed only with --plant analytical"
    _refuse_option(model, "--model", why)
    _refuse_option(friction_law, "--friction-law", why)
    return {}


def _refuse_option(value: object, option: str, why: str) -> None:
    if value:
        raise InputError(f"{option}: {why}; remove {option}")
