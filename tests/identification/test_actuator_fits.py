"""Actuator fits to responses and static tables: known modules are recovered, the rest has no value."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from recorded import RATE, SPEC, motion, recorded, valve_csv
from synthetic_takes import Take

from srs_twin import load_robot
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.identification.actuator import (
    Response,
    default_actuator_parameters,
    fit_actuator,
)
from srs_twin.identification.fit_file import (
    array_hash,
    data_sets,
    fit_file,
    write_fit,
)
from srs_twin.identification.fitted_robot import fitted_robot
from srs_twin.identification.parameters import (
    free_parameters,
    with_values,
)
from srs_twin.identification.static_tables import (
    StaticTable,
    fit_static,
    read_static_table,
)
from srs_twin.pneumatics import LagPneumatics, Schedule
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.recordings.recording import ValveLog
from srs_twin.recordings.signals.clock import join
from srs_twin.recordings.signals.logs import read_valves
from srs_twin.robot.spec import RobotSpec

MODULE = load_robot("gen4_module")
TRUTH = {
    "actuator.tau_fill_s": 0.15,
    "actuator.tau_vent_s": 0.09,
    "actuator.tau_mode_s": 0.01,
    "modules.gain_plus_1": 1.2,
    "modules.gain_minus_1": 0.8,
    "modules.bias_rad_1": 0.05,
}
SUPPLY = 48e3
STEPS = Schedule(
    3.0,
    np.array([0.0, 0.5, 1.5, 2.0]),
    np.array([[[1, -1]], [[-1, -1]], [[-1, 1]], [[-1, -1]]], dtype=np.int8),
)


def free_bends(
    spec: RobotSpec, time: np.ndarray, schedule: Schedule = STEPS
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bends and pressures of free segments."""
    trace = LagPneumatics(spec, supply_pa=SUPPLY, layout="in_out").advance(
        schedule, time
    )
    return trace.bend, trace.pressure


def response(truth=TRUTH, *, noise=0.0, seed=0) -> Response:
    """Return the bends of a module with switched valves, sampled at 100 Hz."""
    time = np.arange(0.0, 3.0, 0.01)
    bend, _ = free_bends(with_values(MODULE, truth), time)
    bend = bend + noise * np.random.default_rng(seed).normal(size=bend.shape)
    return Response("step", array_hash(bend), STEPS, SUPPLY, time, bend)


@given(
    st.tuples(
        st.floats(0.05, 0.4),
        st.floats(0.05, 0.4),
        st.floats(0.004, 0.02),
        st.floats(0.6, 1.6),
        st.floats(0.6, 1.6),
        st.floats(-0.2, 0.2),
    )
)
@settings(max_examples=8)
def test_any_module_is_recovered(numbers):
    truth = dict(zip(TRUTH, numbers, strict=True))
    fit = fit_actuator([response(truth)], MODULE)
    for name, value in truth.items():
        assert fit[name].value == pytest.approx(value, rel=1e-4, abs=1e-6), name
        assert fit[name].verdict == "identified"
    pressure = 1e3 * fit.held["actuator.at_pressure_kpa"]
    assert pressure == pytest.approx(MODULE.supply.nominal)
    assert fit.held["actuator.bend_rad"] == pytest.approx(
        MODULE.actuator.gain * MODULE.supply.nominal
    )


def test_a_common_factor_of_the_gains_is_not_identifiable():
    fit = fit_actuator(
        [response()],
        MODULE,
        names=[*default_actuator_parameters(MODULE), "actuator.bend_rad"],
    )
    for name in ("modules.gain_plus_1", "modules.gain_minus_1", "actuator.bend_rad"):
        assert (
            fit[name].verdict == "not identifiable" and "combination" in fit[name].why
        )
    for name in ("actuator.tau_fill_s", "actuator.tau_mode_s", "modules.bias_rad_1"):
        assert fit[name].value == pytest.approx(TRUTH[name], rel=1e-4)


def test_a_chamber_that_is_never_filled_has_no_gain():
    one_sided = Schedule(
        3.0, np.array([0.0, 1.5]), np.array([[[1, -1]], [[-1, -1]]], dtype=np.int8)
    )
    time = np.arange(0.0, 3.0, 0.01)
    bend, _ = free_bends(with_values(MODULE, TRUTH), time, one_sided)
    fit = fit_actuator(
        [Response("x", array_hash(bend), one_sided, SUPPLY, time, bend)], MODULE
    )
    assert fit["modules.gain_minus_1"].why == "the residuals do not depend on it"
    assert fit["modules.gain_plus_1"].value == pytest.approx(1.2, rel=1e-4)


def test_a_mode_faster_than_the_camera_is_not_identified():
    fit = fit_actuator(
        [response(TRUTH | {"actuator.tau_mode_s": 0.001}, noise=0.019)], MODULE
    )
    assert fit["actuator.tau_mode_s"].verdict == "not identifiable"
    assert fit["actuator.tau_vent_s"].verdict == "identified"


def test_measured_pressures_separate_the_mode_from_the_filling():
    """From bends alone the two time constants can be exchanged if filling and venting are equally slow."""
    time = np.arange(0.0, 3.0, 0.01)
    truth = TRUTH | {
        "actuator.tau_fill_s": 0.04,
        "actuator.tau_vent_s": 0.04,
        "actuator.tau_mode_s": 0.06,
    }
    bend, pressure = free_bends(with_values(MODULE, truth), time)
    seen = Response("x", array_hash(bend), STEPS, SUPPLY, time, bend, pressure)
    fit = fit_actuator([seen], MODULE)
    for name, value in truth.items():
        assert fit[name].value == pytest.approx(value, rel=1e-3), name
    # Typical noise is 10 mrad and 500 Pa.
    assert {residual.name: residual.scale for residual in fit.residuals} == {
        "x bend_1": 0.01,
        "x pressure_plus_1": 500.0,
        "x pressure_minus_1": 500.0,
    }


def test_a_pressure_log_identifies_gains_and_biases():
    time = np.arange(0.0, 3.0, 0.01)
    bend, pressure = free_bends(
        with_values(MODULE, TRUTH | {"actuator.tau_mode_s": 0.004}), time
    )
    log = ValveLog("pressure", time, pressure, "p.csv", "0" * 64, ())
    fit = fit_actuator(
        [Response("x", array_hash(bend), log, SUPPLY, time, bend)], MODULE
    )
    for name in ("modules.gain_plus_1", "modules.gain_minus_1", "modules.bias_rad_1"):
        assert fit[name].value == pytest.approx(TRUTH[name], rel=0.01, abs=5e-4)
    assert (
        fit["actuator.tau_fill_s"].value is None
        and fit["actuator.tau_vent_s"].value is None
    )


@pytest.mark.slow
def test_a_recording_with_another_clock_is_fitted(tmp_path: Path):
    """Free bends of `complete` with noise and an estimated clock offset recover the actuator."""
    truth = motion(3.0)
    log = tmp_path / "valves.csv"
    log.write_text(valve_csv(truth, 0.0, 3.0, 0.37))
    recording = recorded(tmp_path, Take(layout="pair", noise=1e-4, seed=2), truth)
    joined = join(recording, read_valves(log, SPEC), SPEC)
    data = Response.from_recording(joined, "take", 48e3)
    assert not data.clock_known
    # Valve columns hold the state before their sample and logs the state after it: one
    # sample of shift.
    names = ("actuator.tau_fill_s", "actuator.tau_vent_s", "actuator.bend_rad")
    fit = fit_actuator([data], SPEC, names=names)
    for name in names:
        expected = free_parameters(SPEC, [name])[0].start
        assert fit[name].value == pytest.approx(expected, rel=0.05), (name, 1 / RATE)
    with pytest.raises(InputError, match="no log of valves or pressures"):
        Response.from_recording(recording, "take", 48e3)


def table(
    limit: float, noise: float = 0.0, seed: int = 0, most: float = 90e3
) -> StaticTable:
    """Return held pressures and the bends at rest of a module with TRUTH's gains, by another formula."""
    pressure = np.zeros((14, 1, 2))
    pressure[:7, 0, 0] = pressure[7:, 0, 1] = np.linspace(0, most, 7)
    x = MODULE.actuator.gain * (1.2 * pressure[..., 0] - 0.8 * pressure[..., 1])
    bend = 0.05 + x * (1 + (x / limit) ** 4) ** -0.25
    bend = bend + noise * np.random.default_rng(seed).normal(size=bend.shape)
    return StaticTable("table", array_hash(bend), pressure, bend)


STATIC = {
    "modules.gain_plus_1": 1.2,
    "modules.gain_minus_1": 0.8,
    "modules.bias_rad_1": 0.05,
    "actuator.bend_limit_rad": 1.4,
}


def test_static_tables_identify_gains_bias_and_limit():
    fit = fit_static([table(1.4)], MODULE)
    for name, value in STATIC.items():
        assert fit[name].value == pytest.approx(value, rel=1e-5), name
    rough = fit_static([table(1.4, noise=0.01)], MODULE)
    assert "actuator.dead_zone_rad" not in rough.held | rough.values
    assert len(rough.residuals[0].values) == 14 and rough.residuals[0].unit == "rad"
    assert rough.rms("fit") == pytest.approx(1.0, abs=0.4)


@pytest.mark.slow
def test_a_straight_line_rarely_gets_a_dead_zone():
    """The F-test has a level of 1 %: 3 of 20 would have a probability of 1 in 1,000."""
    fits = [fit_static([table(1.4, 0.01, seed)], MODULE) for seed in range(20)]
    assert sum("actuator.dead_zone_rad" in fit.held | fit.values for fit in fits) < 3


@pytest.mark.slow
def test_a_limit_that_is_never_reached_has_no_number():
    fit = fit_static([table(1e9, noise=0.01, most=40e3)], MODULE)
    assert fit["actuator.bend_limit_rad"].value is None
    assert fit["modules.gain_plus_1"].value == pytest.approx(1.2, rel=0.05)


def convex(curve, noise: float = 0.004) -> StaticTable:
    """Return plateaus of a module that bends by an odd function (rad) of the pressure divided by 60 kPa."""
    pressure = np.zeros((24, 1, 2))
    pressure[:12, 0, 0] = pressure[12:, 0, 1] = np.linspace(0, 60e3, 12)
    fraction = (1.2 * pressure[..., 0] - 0.8 * pressure[..., 1]) / 60e3
    bend = 0.05 + np.sign(fraction) * curve(np.abs(fraction))
    bend = bend + noise * np.random.default_rng(3).normal(size=bend.shape)
    return StaticTable(
        "convex", array_hash(bend), pressure, bend, np.full(bend.shape, noise)
    )


@pytest.mark.parametrize(
    "curve",
    [
        lambda u: 0.5 * u + np.maximum(u - 0.4, 0.0),
        lambda u: 1.2 / (1 + np.exp((0.5 - u) / 0.12)) - 1.2 / (1 + np.exp(0.5 / 0.12)),
    ],
    ids=["partial", "sigmoid"],
)
def test_a_dead_zone_explains_curves_that_a_straight_line_does_not(curve):
    """The curves do not follow the model's law, but the fitted robot reproduces them."""
    table = convex(curve)
    straight = fit_static(
        [table],
        MODULE,
        names=["modules.gain_plus_1", "modules.gain_minus_1", "modules.bias_rad_1"],
    )
    fit = fit_static([table], MODULE)
    assert straight.residual_scale > 8
    assert fit.residual_scale == pytest.approx(1.0, abs=0.5)
    assert "without a dead zone" in fit["actuator.dead_zone_rad"].why
    fitted = with_values(MODULE, fit.held | fit.values)
    difference = fitted.modules.bias[0] + air_bend(fitted, table.pressure) - table.bend
    assert np.sqrt(np.mean(difference**2)) < 1.5 * 0.004


def test_parameters_of_a_dead_zone_are_recovered_in_the_robot(tmp_path):
    x_full = MODULE.actuator.gain * 60e3

    def curve(u):
        x = u * x_full
        return x - 0.1 * np.log(np.cosh((x + 0.3) / 0.2) / np.cosh((x - 0.3) / 0.2))

    result = fit_static([table := convex(curve)], MODULE)
    truth = {
        "actuator.dead_zone_rad": 0.3,
        "actuator.dead_zone_transition_rad": 0.2,
        "modules.gain_plus_1": 1.2,
    }
    for name, value in truth.items():
        assert result[name].low <= value <= result[name].high, result[name]
    about = {
        "name": "late",
        "title": "late",
        "robot": "gen4_module",
        "method": "static",
        "command": "x",
    }
    fit = fit_file(result, **about, versions={}, data=data_sets([table], []))
    write_fit(fit, path := tmp_path / "late.yaml")
    spec = fitted_robot([path], "late").spec()
    assert spec.actuator.onset_fraction == 1.0
    expected = with_values(MODULE, result.held | result.values)
    assert air_bend(spec, table.pressure) == pytest.approx(
        air_bend(expected, table.pressure), abs=1e-6
    )


def test_a_static_table_identifies_no_mass_or_time_constant():
    names = [
        "modules.gain_plus_1",
        "mass.connectors_kg_2",
        "actuator.tau_fill_s",
        "bending.stiffness_nm_per_rad",
    ]
    fit = fit_static([table(1e9)], MODULE, names=names)
    for name in names[1:]:
        assert fit[name].verdict == "not identifiable" and fit[name].value is None
        assert fit[name].why == "the residuals do not depend on it"


def test_validation_data_have_their_own_residuals():
    fit = fit_actuator([response()], MODULE, validation=[response(noise=0.01, seed=1)])
    assert (
        fit.rms("validation") == pytest.approx(1.0, abs=0.1) and fit.rms("fit") < 1e-6
    )


def test_unsuitable_actuator_data_are_refused():
    with pytest.raises(
        UnknownNameError, match=r"actuator.tau_fil_s.*did you mean actuator.tau_fill_s"
    ):
        fit_actuator([response()], MODULE, names=["actuator.tau_fil_s"])
    with pytest.raises(
        InputError,
        match="modules.bias_rad_2: this parameter does not exist, because gen4_module",
    ):
        fit_actuator([response()], MODULE, names=["modules.bias_rad_2"])
    with pytest.raises(InputError, match="given twice"):
        free_parameters(MODULE, ["friction.mu_t", "friction.mu_t"])
    with pytest.raises(
        InputError, match="bends of 1 segments, but gen2 has 4 segments"
    ):
        fit_actuator([response()], SPEC)
    with pytest.raises(InputError, match="give at least one"):
        fit_actuator([], MODULE)


def test_a_static_table_is_read_from_a_file(tmp_path: Path):
    path = tmp_path / "table.csv"
    path.write_text("pressure_plus_1_kpa,bend_1_deg,note\n0,0\n10,9\n20,\n")
    with pytest.raises(
        InputError, match=r"table.csv:2: the row has 2 cells, but the header has 3"
    ):
        read_static_table(path, MODULE)
    path.write_text("pressure_plus_1_kpa,bend_1_deg\n0,0\n10,9\n20,\n")
    fit = read_static_table(path, MODULE)
    assert fit.pressure[:, 0].tolist() == [[0, 0], [10e3, 0], [20e3, 0]]
    assert fit.bend[:2, 0] == pytest.approx([0, np.pi / 20]) and np.isnan(
        fit.bend[2, 0]
    )
    assert fit.data_set("fit").samples == 2
