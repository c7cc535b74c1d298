"""Errors are unchanged by pickling; unknown names have suggestions in every command."""

from __future__ import annotations

import pickle

import pytest

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


ROBOT = (
    "bending.stiffness_nm_per_rad",
    "bending.damping_time_s",
    "friction.mu_t",
    "friction.mu_n",
    "supply.pressure_kpa",
)
METRICS = tuple(known_metrics())
SCENARIOS = tuple(shipped_names("scenario"))

TYPOS = [
    ("duration", ("title", "robot", "duration_s"), ["duration_s"]),
    ("stiffnes", ROBOT, ["bending.stiffness_nm_per_rad"]),
    ("bending.stifness", ROBOT, ["bending.stiffness_nm_per_rad"]),
    ("friction.mu", ROBOT, ["friction.mu_n", "friction.mu_t"]),
    ("presure", ROBOT, ["supply.pressure_kpa"]),
    ("com_speed", METRICS, ["com_speed_m_s", "com_speed_rel"]),
    ("yawrate", METRICS, ["yaw_rate_abs", "yaw_rate_rad_s"]),
    ("gen2-straight", SCENARIOS, ["gen2_straight"]),
    ("Gen2_Turn", SCENARIOS, ["gen2_turn"]),
    ("elsewhere/gen2_strait.yml", SCENARIOS, ["gen2_straight"]),
    ("gate", ("gait", "ilc", "following"), ["gait"]),
    ("modules.gan_plus_1", tuple(parameter_names()), ["modules.gain_plus_N"]),
]


@pytest.mark.parametrize(("text", "available", "suggested"), TYPOS)
def test_closest_names_are_suggested(text, available, suggested):
    listed = " or ".join(suggested)
    assert did_you_mean(text, sorted(available)) == f"; did you mean {listed}?"


@pytest.mark.parametrize("text", ["banana", "x", "", "...", "on", "\u202erobot", "/"])
@pytest.mark.parametrize("available", [ROBOT, METRICS, SCENARIOS, ()])
def test_unrelated_text_has_no_suggestion(text, available):
    assert did_you_mean(text, available) == ""


def test_at_most_three_names_are_suggested():
    suggestion = did_you_mean("straight", SCENARIOS)
    assert suggestion == "; did you mean gen1_straight, gen2_straight or gen3_straight?"


def test_long_lists_of_names_are_counted():
    many = UnknownNameError("metric", "banana", METRICS, "`srs-twin list metrics`")
    assert str(many) == (
        f"unknown metric 'banana' (available: {len(METRICS)} names; `srs-twin list"
        " metrics` lists them)"
    )
    few = UnknownNameError("plant", "banana", ("analytical", "twin"))
    assert str(few) == "unknown plant 'banana' (available: analytical, twin)"


KEYS = (
    "robot: {base: gen2, bending: {stiffnes: 1}}\nduration_s: 1\n"
    "controller: {kind: gait, freq: 2}\npneumatics: {kind: orifise}\n"
)
EXPECT = (
    "robot: gen2\nduration_s: 1\ncontroller: {kind: gait, frequency_hz: 2}\n"
    "expect:\n  - {metric: com_speed, plant: twin, above: 0}\n"
)
SWEEP = (
    "scenario: gen2_straight\nvary: {supply.pressure_kpa: [40, 48]}\n"
    "metrics: [com_speed]\nplots:\n  - {kind: line, x: supply.presure, metric:"
    " com_speed_m_s}\n"
)


@pytest.mark.parametrize(
    ("command", "text", "suggestions"),
    [
        ("run scenarios/gen2_strait.yaml", "", ["gen2_straight?"]),
        (
            "run a.yaml",
            KEYS,
            ["stiffness_nm_per_rad?", "frequency_hz?", "orifice?"],
        ),
        ("run a.yaml", EXPECT, ["com_speed_m_s or com_speed_rel?"]),
        ("sweep a.yaml", SWEEP, ["com_speed_m_s", "supply.pressure_kpa?"]),
        (
            "sweep a.yaml",
            "scenario: gen2_straight\nvary: {controller.freq: [1, 2]}\n",
            ["frequency_hz?"],
        ),
        ("schema scenaro", "", ["scenario?"]),
        ("models export gen22", "", ["gen2?"]),
    ],
)
def test_every_command_suggests_the_closest_name(
    srs_twin, tmp_path, command, text, suggestions
):
    (tmp_path / "a.yaml").write_text(text)
    done = srs_twin(*command.split(), cwd=tmp_path)
    assert done.returncode == 2
    for suggestion in suggestions:
        assert f"did you mean {suggestion}" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["a.yaml"]
