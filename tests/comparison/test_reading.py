"""Metrics of a sensor reading, compared with closed-form readings and with the law of the sensor."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from srs_twin import load_robot, load_scenario, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.comparison.tracking import BIN_RAD, READING_UNITS, reading_metrics
from srs_twin.scenario.loading import parse_scenario
from srs_twin.sensing import make_sensor
from srs_twin.sensing.hall import field
from srs_twin.trajectory import Trajectory

SENSOR = {"kind": "own"}


def run(bend, measured_bend, sensor=SENSOR):
    bend = np.asarray(bend, dtype=float)
    measured_bend = np.asarray(measured_bend, dtype=float)
    columns = {
        "time": 0.01 * np.arange(len(bend)),
        "bend_1": bend,
        "measured_bend_1": measured_bend,
    }
    return Trajectory(columns, metadata={"sensor": sensor})


def there_and_back(reach):
    return reach * np.sin(np.linspace(0, 4 * math.pi, 4001))


@given(st.floats(0.3, 1.5), st.floats(0.2, 3.0), st.floats(-0.2, 0.2))
def test_a_linear_reading_has_r_squared_1(reach, slope, offset):
    bend = there_and_back(reach)
    found = reading_metrics(run(bend, slope * bend + offset))
    assert found["reading_r_squared"] == pytest.approx(1.0)
    assert found["reading_backstep_rad"] == pytest.approx(0.0, abs=1e-12)
    worst = max(abs((slope - 1) * end + offset) for end in (-reach, reach))
    assert found["reading_error_rad"] == pytest.approx(
        worst, abs=abs(slope - 1) * BIN_RAD + 1e-12
    )
    # Nobody told how readings come from a field.
    assert found["reading_range_t"] is None


@settings(max_examples=30)
@given(st.floats(1.2, 3.0), st.floats(0.05, 0.3), st.floats(-0.3, 0.3))
def test_depth_and_position_of_a_fold_are_recovered(press, scale, place):
    bend = there_and_back(1.4)

    def reading(q):
        return q - press * scale * np.tanh((q - place) / scale)

    crest = scale * math.acosh(math.sqrt(press))
    found = reading_metrics(run(bend, reading(bend)))
    # Bins smooth the extrema by less than the steepest slope times the bin width.
    assert found["reading_backstep_rad"] == pytest.approx(
        reading(place - crest) - reading(place + crest),
        abs=press * BIN_RAD**2 / scale + 1e-3,
    )
    assert found["reading_backstep_at_rad"] == pytest.approx(place, abs=2 * BIN_RAD)


def test_every_bend_counts_once_regardless_of_its_duration():
    bend = np.linspace(-1, 1, 2001)
    dwelling = np.concatenate([bend, np.full(50_000, 1.0), np.full(100, -1.0)])
    quick, slow = (reading_metrics(run(q, q**3 + q)) for q in (bend, dwelling))
    assert slow["reading_r_squared"] == pytest.approx(
        quick["reading_r_squared"], abs=2e-3
    )
    # The mean bend of the last bin moves to the bend that lasted longest.
    assert slow["reading_error_rad"] == pytest.approx(
        quick["reading_error_rad"], abs=3 * BIN_RAD
    )
    # Weighted by time, nearly all samples would be one bend.
    q = dwelling
    assert np.corrcoef(q, q**3 + q)[0, 1] ** 2 != pytest.approx(
        quick["reading_r_squared"], abs=0.01
    )


def test_r_squared_equals_that_at_evenly_spaced_bends():
    bend = there_and_back(1.2)
    even = np.linspace(-1.2, 1.2, 100_001)
    expected = np.corrcoef(even, np.sin(even))[0, 1] ** 2
    assert reading_metrics(run(bend, np.sin(bend)))[
        "reading_r_squared"
    ] == pytest.approx(expected, abs=2e-4)


def test_noise_averages_out_and_lost_readings_are_left_out():
    bend = np.tile(there_and_back(1.0), 20)
    noise = 0.02 * np.random.default_rng(1).standard_normal(len(bend))
    found = reading_metrics(
        run(bend, np.where(np.arange(len(bend)) % 7 == 0, np.nan, bend + noise))
    )
    assert found["reading_r_squared"] > 0.9999
    assert found["reading_error_rad"] < 0.005
    assert found["reading_backstep_rad"] < 0.005


@pytest.mark.parametrize(
    ("bend", "measured_bend"), [([0.5] * 5, [0.5] * 5), ([0.0, 0.5, 1.0], [np.nan] * 3)]
)
def test_too_few_bins_give_no_metrics(bend, measured_bend):
    assert set(reading_metrics(run(bend, measured_bend)).values()) == {None}


def test_a_constant_reading_has_no_r_squared():
    found = reading_metrics(run([-1.0, 0.0, 1.0], [0.2, 0.2, 0.2]))
    assert found["reading_r_squared"] is None
    assert found["reading_backstep_rad"] == 0


@pytest.mark.parametrize("sensor", [{"kind": "ideal"}, {}, None, "hall"])
def test_an_ideal_sensor_or_none_has_no_metrics(sensor):
    bend = there_and_back(1.0)
    found = reading_metrics(run(bend, bend, sensor))
    assert found == dict.fromkeys(READING_UNITS)


@pytest.mark.parametrize(
    "broken", [{"hall": {}}, {"hall": {"gain": "x"}, "calibration": {"slope": 1.0}}]
)
def test_range_needs_the_settings_of_the_hall_element(broken):
    bend = there_and_back(1.0)
    assert (
        reading_metrics(run(bend, bend, {"kind": "hall"} | broken))["reading_range_t"]
        is None
    )


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(["up", "side"]), st.floats(3.1e-3, 4.6e-3), st.floats(-0.3, 0.5))
def test_range_does_not_depend_on_the_electronics(orientation, distance, drift):
    spec = load_robot("gen4_module")
    sensor = make_sensor(
        "hall",
        spec,
        orientation=orientation,
        distance=distance,
        noise=0.0,
        bits=None,
        gain_error=drift,
        rails=(-50.0, 50.0),
        converter_range=(-50.0, 50.0),
        offset=0.0,
    )
    bend = there_and_back(1.2)
    # The metadata of a run describe its sensor.
    found = reading_metrics(
        run(bend, sensor.read(bend[:, None], 0.0, 0)[:, 0], sensor.describe())
    )
    ends = field(np.array([bend.min(), bend.max()]), sensor.hall.strip)
    assert found["reading_range_t"] == pytest.approx(abs(np.diff(ends)[0]), rel=0.01)


def test_readings_depend_on_the_bend_only():
    def measured(plant, controller):
        changes = {"controller": controller, "allow_overpressure": True}
        scenario = parse_scenario(
            load_scenario("sensor_semicircular").document | changes
        )
        pair = scenario.build_plant(plant), scenario.build_controller()
        return plant_metrics(rollout(*pair, 4.0, record_hz=1000))

    gait = {"kind": "gait", "frequency_hz": 0.5}
    model, twin = (measured(plant, gait) for plant in ("analytical", "twin"))
    assert model["reading_r_squared"] == pytest.approx(
        twin["reading_r_squared"], abs=1e-3
    )
    # Constant valves bend it to one side only, which is half the range.
    held = measured("analytical", {"kind": "hold_valves"})
    assert held["reading_range_t"] == pytest.approx(
        model["reading_range_t"] / 2, rel=0.1
    )


def test_bounds_of_sensor_side_and_sensor_far_come_from_sensor_up():
    scenario = load_scenario("sensor_up")
    pair = scenario.build_plant("analytical"), scenario.build_controller()
    given = plant_metrics(rollout(*pair, scenario.duration, record_hz=1000))
    for name in ("sensor_side", "sensor_far"):
        bounds = {
            each.metric: each.allowed[1]
            for each in load_scenario(name).expect
            if each.metric in READING_UNITS
        }
        wanted = pytest.approx(given["reading_range_t"], rel=1e-3)
        assert bounds["reading_range_t"] == wanted
        if name == "sensor_side":
            wanted = pytest.approx(given["reading_r_squared"], abs=1e-5)
            assert bounds["reading_r_squared"] == wanted


def test_the_report_shows_readings_only_with_a_sensor(tmp_path):
    from srs_twin.viewing.plots.runs import reading_plot

    bend = there_and_back(1.0)
    figure = reading_plot({"twin": run(bend, 2 * bend), "analytical": run(bend, bend)})
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "sensed (°)",
        "mean − bend (°)",
    ]
    errors = figure.axes[1].lines[0]
    assert errors.get_ydata() == pytest.approx(errors.get_xdata())
    assert errors.get_xdata()[-1] == pytest.approx(math.degrees(1.0), abs=0.5)
    assert reading_plot({"twin": run(bend, bend, {"kind": "ideal"})}) is None
    lost = reading_plot({"twin": run([0.0, 0.1], [np.nan, np.nan])})
    lost.savefig(tmp_path / "lost.png")
