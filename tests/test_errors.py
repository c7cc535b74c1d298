"""Errors are unchanged by pickling; unknown names have suggestions in every command."""

from __future__ import annotations

import pickle

import pytest

from srs_twin.cli import main
from srs_twin.errors import (
    AbsentPartError,
    DivergedError,
    InputError,
    InputFileError,
    SrsError,
    TaskFailedError,
    TimeStepError,
    UnknownNameError,
    WorkerDiedError,
    WriteError,
    did_you_mean,
    named_in_errors,
)
from srs_twin.identification.parameters import parameter_names
from srs_twin.io.files import shipped_names
from srs_twin.scenario.expectation import known_metrics

pytestmark = pytest.mark.fast

ERRORS = [
    InputError("no such file"),
    UnknownNameError("metric", "sped", ["speed", "yaw"]),
    WriteError("rows.sqlite: the disk is full"),
    AbsentPartError("module:Name"),
    TimeStepError("tick", 0.02, "time step", 0.003),
    InputFileError(["a.yaml:1:2: x: unknown key", "a.yaml:3:4: y: missing"]),
    DivergedError("twin", 0.31, "it flew", history=[1, 2]),
    TaskFailedError(ZeroDivisionError("division by zero")),
    WorkerDiedError(-9, 3),
]


def kinds(kind: type) -> set[type]:
    return {kind}.union(*map(kinds, kind.__subclasses__()))


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_error_is_unchanged_by_pickling(error):
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert (str(copy), copy.exit_code, copy.__dict__) == (
        str(error),
        error.exit_code,
        error.__dict__,
    )


INPUT_ERRORS = [error for error in ERRORS if isinstance(error, InputError)]


@pytest.mark.parametrize("error", INPUT_ERRORS, ids=lambda error: type(error).__name__)
def test_a_file_name_in_an_error_keeps_its_type_and_attributes(error):
    given = pickle.loads(pickle.dumps(error))
    with pytest.raises(type(error)) as raised, named_in_errors("a.csv"):
        raise given
    assert type(raised.value) is type(error)
    assert str(raised.value) == f"a.csv: {error}"
    assert raised.value.__dict__ == error.__dict__


def test_every_error_class_is_covered():
    ours = {kind for kind in kinds(SrsError) if kind.__module__ == "srs_twin.errors"}
    assert ours - {type(error) for error in ERRORS} <= {SrsError}


CONTROLLER = (
    "controller.kind",
    "controller.frequency_hz",
    "controller.offset",
    "controller.phase_rad",
)
ROBOT = (
    "bending.stiffness_nm_per_rad",
    "bending.damping_time_s",
    "friction.mu_t",
    "friction.mu_n",
    "mass.wheel_kg",
    "actuator.tau_fill_s",
    "actuator.tau_vent_s",
    "supply.pressure_kpa",
    "geometry.segment_length_m",
)
METRICS = tuple(known_metrics())
SCENARIOS = tuple(shipped_names("scenario"))
PATHS = tuple(f"scenarios/{name}.yaml" for name in SCENARIOS)
FIELDS = (
    *CONTROLLER,
    *ROBOT,
    "duration_s",
    "seed",
    "reference.frequency_hz",
    "planner.kind",
)
FITS = tuple(parameter_names())

TYPOS = [
    ("titel", ("name", "title", "robot", "duration_s"), ["title"]),
    ("duration", ("name", "title", "robot", "duration_s"), ["duration_s"]),
    (
        "stiffnes",
        [name.partition(".")[2] for name in ROBOT[:2]],
        ["stiffness_nm_per_rad"],
    ),
    ("stiffnes", ROBOT, ["bending.stiffness_nm_per_rad"]),
    ("bending.stifness", ROBOT, ["bending.stiffness_nm_per_rad"]),
    ("friction.mu", ROBOT, ["friction.mu_n", "friction.mu_t"]),
    ("presure", ROBOT, ["supply.pressure_kpa"]),
    ("controller.freq", FIELDS, ["controller.frequency_hz"]),
    ("reference.freq", FIELDS, ["reference.frequency_hz"]),
    ("freq", FIELDS, ["controller.frequency_hz", "reference.frequency_hz"]),
    ("contoller.frequency_hz", FIELDS, ["controller.frequency_hz"]),
    ("controller.ofset", FIELDS, ["controller.offset"]),
    ("controller.kin", FIELDS, ["controller.kind"]),
    ("com_sped_m_s", METRICS, ["com_speed_m_s"]),
    ("com_speed", METRICS, ["com_speed_m_s", "com_speed_rel"]),
    ("yawrate", METRICS, ["yaw_rate_abs", "yaw_rate_rad_s"]),
    ("overshot", METRICS, ["overshoot_rad", "overshoot_rel"]),
    ("settling", METRICS, ["settling_2_s", "settling_5_s"]),
    ("cost_of_transprt", METRICS, ["cost_of_transport"]),
    ("gen2_strait", SCENARIOS, ["gen2_straight"]),
    ("gen2-straight", SCENARIOS, ["gen2_straight"]),
    ("Gen2_Turn", SCENARIOS, ["gen2_turn"]),
    ("scenarios/gen2_strait.yaml", PATHS, ["scenarios/gen2_straight.yaml"]),
    ("elsewhere/gen2_strait.yml", SCENARIOS, ["gen2_straight"]),
    ("gen2_strait.yaml", PATHS, ["scenarios/gen2_straight.yaml"]),
    ("gate", ("gait", "ilc", "following"), ["gait"]),
    ("gen22", ("gen1", "gen2", "gen3", "gen4"), ["gen2"]),
    ("rai", ("local", "ray"), ["ray"]),
    ("best_fist", ("best_first", "given"), ["best_first"]),
    ("analytic", ("analytical", "twin"), ["analytical"]),
    ("tau_fil_s", FITS, ["actuator.tau_fill_s"]),
    ("modules.gan_plus_1", FITS, ["modules.gain_plus_N"]),
    ("actuator.tau_fill", FITS, ["actuator.tau_fill_s"]),
    ("Milimeters", ("Meters", "Centimeters", "Millimeters"), ["Millimeters"]),
]


@pytest.mark.default_cases(at=[0, 5, 9, 22, 33])
@pytest.mark.parametrize(("text", "available", "suggested"), TYPOS)
def test_closest_names_are_suggested(text, available, suggested):
    *first, last = suggested
    listed = f"{', '.join(first)} or {last}" if first else last
    assert did_you_mean(text, sorted(available)) == f"; did you mean {listed}?"


@pytest.mark.default_cases(at=[0, 49, 60])
@pytest.mark.parametrize(
    "text",
    ["zzz", "banana", "x", "", "...", "on", "hello_world", "\u202erobot", "/", "?"],
)
@pytest.mark.parametrize(
    "available", [CONTROLLER, ROBOT, METRICS, SCENARIOS, PATHS, FITS, ()]
)
def test_unrelated_text_has_no_suggestion(text, available):
    assert did_you_mean(text, available) == ""


def test_at_most_three_names_are_suggested():
    suggestion = did_you_mean("straight", SCENARIOS)
    assert suggestion == "; did you mean gen1_straight, gen2_straight or gen3_straight?"


def test_long_lists_of_names_are_counted():
    assert (
        str(UnknownNameError("metric", "banana", METRICS, "`srs-twin list metrics`"))
        == f"unknown metric 'banana' (available: {len(METRICS)} names; `srs-twin list"
        " metrics` lists them)"
    )
    assert len(METRICS) > 80
    few = str(UnknownNameError("plant", "banana", ("analytical", "twin")))
    assert few == "unknown plant 'banana' (available: analytical, twin)"


COMMANDS = [
    (("run", "scenarios/gen2_strait.yaml"), "did you mean gen2_straight?"),
    (("run", "gen2_strait"), "did you mean gen2_straight?"),
    (
        ("run", "keys.yaml"),
        "robot.bending.stiffnes: unknown key; did you mean stiffness_nm_per_rad?",
    ),
    (("run", "keys.yaml"), "controller.freq: unknown key; did you mean frequency_hz?"),
    (
        ("run", "keys.yaml"),
        "one of lag, orifice, not text 'orifise'; did you mean orifice?",
    ),
    (
        ("run", "metric.yaml"),
        "unknown metric 'com_speed'; did you mean com_speed_m_s or com_speed_rel?",
    ),
    (
        ("run", "metric.yaml"),
        (
            f"'banana' (available: {len(METRICS)} names; `srs-twin list metrics` lists"
            " them)"
        ),
    ),
    (
        ("sweep", "sweep.yaml"),
        "vary.controller.freq: unknown key; did you mean frequency_hz?",
    ),
    (
        ("sweep", "metrics.yaml"),
        "metrics[0]: unknown metric 'com_speed'; did you mean com_speed_m_s",
    ),
    (
        ("sweep", "metrics.yaml"),
        "'supply.presure' is not varied; did you mean supply.pressure_kpa?",
    ),
    (("schema", "scenaro"), "unknown kind of file 'scenaro'; did you mean scenario?"),
    (("models", "export", "gen22"), "unknown robot 'gen22'; did you mean gen2?"),
]
FILES = {
    "keys.yaml": (
        "robot: {base: gen2, bending: {stiffnes: 1}}\nduration_s: 1\n"
        "controller: {kind: gait, freq: 2}\npneumatics: {kind: orifise}\n"
    ),
    "metric.yaml": (
        "robot: gen2\nduration_s: 1\ncontroller: {kind: gait, frequency_hz:"
        " 2}\nexpect:\n  - {metric: com_speed, plant: twin, above: 0}\n  - {metric:"
        " banana, plant: twin, above: 0}\n"
    ),
    "sweep.yaml": "scenario: gen2_straight\nvary: {controller.freq: [1, 2]}\n",
    "metrics.yaml": (
        "scenario: gen2_straight\nvary: {supply.pressure_kpa: [40, 48]}\nmetrics:"
        " [com_speed]\nplots:\n  - {kind: line, x: supply.presure, metric:"
        " com_speed_m_s}\n"
    ),
}


@pytest.mark.default_cases(at=[0, 2, 5, 7, 8, 10, 11])
@pytest.mark.parametrize(("arguments", "message"), COMMANDS)
def test_every_command_suggests_the_closest_name(
    arguments, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(SystemExit) as left:
        main(list(arguments))
    assert left.value.code == 2
    err = capsys.readouterr().err
    assert message in err, err
    assert {path.name for path in tmp_path.iterdir()} == FILES.keys()
