"""Metrics of a gait, compared with runs of prescribed speed, radius and bends."""

import json
import math
import re

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from synthetic import (
    Snake,
    backwards,
    mirrored,
    moved,
    numbered,
    sampled,
    with_columns,
    with_metadata,
)

from srs_twin.comparison import metrics
from srs_twin.comparison.compare import compare
from srs_twin.comparison.contacts import CONTACT_UNITS, OBJECT_UNITS
from srs_twin.comparison.gait import ENERGY_MEANINGS, SPATIAL_UNITS, GaitWindow
from srs_twin.comparison.learning import LEARNING_LIST_UNITS, LEARNING_UNITS
from srs_twin.comparison.metrics import (
    LIST_METRIC_UNITS,
    MEASURED_UNITS,
    METRIC_UNITS,
    plant_metrics,
)
from srs_twin.comparison.sampling import metric_groups
from srs_twin.comparison.tracking import READING_UNITS, TRACKING_UNITS
from srs_twin.errors import InputError
from srs_twin.planning.metrics import FOLLOWING_UNITS
from srs_twin.trajectory import Trajectory

pytestmark = pytest.mark.fast

GAIT_METRICS = {
    "com_speed_m_s",
    "yaw_rate_rad_s",
    "turning_radius_m",
    "bend_amplitude_rad",
    "bend_bias_rad",
    "mean_bend_amplitude_rad",
    "mechanical_power_w",
    "internal_power_w",
    "cost_of_transport",
    "pneumatic_power_w",
    "pneumatic_cost_of_transport",
}

some = settings(deadline=None, max_examples=25)
# Frequencies whose period is not a multiple of 10 ms are as likely as the others.
frequencies = st.floats(0.8, 4.0).map(lambda f: round(f, 4))
speeds = st.floats(0.02, 0.4)


def assert_metrics_close(
    given: dict, wanted: dict, *, flipped: tuple[str, ...] = (), rel: float = 1e-7
) -> None:
    assert given.keys() == wanted.keys()
    for name, value in wanted.items():
        if value is None or name == "valve_switches":
            assert given[name] == value, name
        else:
            expected = np.asarray(value) * (-1 if name in flipped else 1)
            np.testing.assert_allclose(
                given[name], expected, rtol=rel, atol=1e-9, err_msg=name
            )


@some
@given(
    speed=speeds, frequency=frequencies, phase=st.floats(-3, 3), angle=st.floats(-3, 3)
)
def test_speed_of_a_straight_run_is_recovered(speed, frequency, phase, angle):
    run = moved(
        Snake(speed=speed, frequency=frequency, phase=phase).trajectory(),
        1.0,
        -2.0,
        angle,
    )
    found = plant_metrics(run)
    # The error is that of the spline through the lateral oscillation, 3e-8 m/s at 4 Hz
    # for any speed.
    assert found["com_speed_m_s"] == pytest.approx(speed, rel=0, abs=1e-7)
    assert found["yaw_rate_rad_s"] == pytest.approx(0, abs=1e-6)
    assert found["turning_radius_m"] is None


@pytest.mark.parametrize("record_hz", [25, 1000 / 7])
def test_speed_does_not_depend_on_the_recording_rate(record_hz):
    run = Snake(
        speed=0.2, frequency=1.37, record_hz=record_hz, duration=8.4
    ).trajectory()
    assert plant_metrics(run)["com_speed_m_s"] == pytest.approx(
        0.2, rel=2e-5 if record_hz < 60 else 1e-6
    )


@some
@given(
    radius=st.floats(0.2, 3.0),
    yaw_rate=st.floats(0.02, 0.6),
    frequency=frequencies,
    side=st.sampled_from([-1, 1]),
)
def test_radius_and_yaw_rate_of_a_circle_are_recovered(
    radius, yaw_rate, frequency, side
):
    speed = radius * yaw_rate
    run = Snake(
        speed=speed, yaw_rate=side * yaw_rate, frequency=frequency, sway=(0, 0)
    ).trajectory()
    found = plant_metrics(run)
    assert found["yaw_rate_rad_s"] == pytest.approx(side * yaw_rate, rel=1e-6, abs=1e-7)
    assert found["turning_radius_m"] == pytest.approx(side * radius, rel=1e-5)
    # The averaged path is inside the circle.
    inside = np.sinc(yaw_rate / frequency / 2 / np.pi)
    assert found["com_speed_m_s"] == pytest.approx(speed * inside, rel=1e-6)


@pytest.mark.parametrize(
    ("snake", "radius"),
    [
        # A lateral oscillation does not change the radius.
        (
            Snake(speed=0.15, yaw_rate=0.3, frequency=1.3, duration=12),
            pytest.approx(0.5, rel=1e-3),
        ),
        (Snake(speed=0.0, yaw_rate=0.5, sway=(0, 0)), pytest.approx(0, abs=1e-9)),
        (Snake(speed=1e-6, yaw_rate=1e-4), None),
        # 99 and 101 body lengths.
        (
            Snake(speed=0.22, yaw_rate=0.01010101, sway=(0, 0), duration=20.0),
            pytest.approx(21.78, rel=1e-3),
        ),
        (Snake(speed=0.22, yaw_rate=0.00990099, sway=(0, 0), duration=20.0), None),
    ],
)
def test_radius_of_turns_on_the_spot_and_of_nearly_straight_paths(snake, radius):
    found = plant_metrics(snake.trajectory())
    assert found["turning_radius_m"] == radius
    assert found["yaw_rate_rad_s"] == pytest.approx(snake.yaw_rate, abs=1e-5)


@some
@given(
    yaw_rate=st.sampled_from([0.0, 0.3]),
    x=st.floats(-20, 20),
    y=st.floats(-20, 20),
    angle=st.floats(-10, 10),
)
def test_metrics_do_not_depend_on_the_world_frame(yaw_rate, x, y, angle):
    run = Snake(yaw_rate=yaw_rate, frequency=1.7).trajectory()
    assert_metrics_close(plant_metrics(moved(run, x, y, angle)), plant_metrics(run))


@some
@given(yaw_rate=st.floats(-0.5, 0.5), bias=st.floats(-0.3, 0.3), frequency=frequencies)
def test_mirroring_swaps_left_and_right(yaw_rate, bias, frequency):
    run = Snake(yaw_rate=yaw_rate, bias=bias, frequency=frequency).trajectory()
    flipped = ("yaw_rate_rad_s", "turning_radius_m", "bend_bias_rad")
    assert_metrics_close(
        plant_metrics(mirrored(run)), plant_metrics(run), flipped=flipped
    )


def test_a_reversed_wave_has_negative_speed():
    run = Snake(speed=-0.1, yaw_rate=0.2, backward_wave=True, sway=(0, 0)).trajectory()
    found = plant_metrics(run)
    assert found["com_speed_m_s"] == pytest.approx(-0.1, rel=1e-3)
    assert found["yaw_rate_rad_s"] == pytest.approx(0.2, rel=1e-6)
    # The head is to the left of the tangent of the path, and the centre of the circle
    # to the right of the body.
    assert found["turning_radius_m"] == pytest.approx(-0.5, rel=1e-5)


@some
@given(speed=speeds, frequency=frequencies)
def test_time_reversal_changes_the_signs_of_speed_and_yaw_rate(speed, frequency):
    run = Snake(
        speed=speed, yaw_rate=0.2, frequency=frequency, duration=6.0
    ).trajectory()
    ahead = plant_metrics(run)
    back = plant_metrics(backwards(run))
    for name in ("com_speed_m_s", "yaw_rate_rad_s"):
        assert back[name] == pytest.approx(-ahead[name], rel=1e-5), name
    assert back["turning_radius_m"] == pytest.approx(
        ahead["turning_radius_m"], rel=1e-5
    )


@some
@given(
    amplitude=st.floats(0.05, 1.5),
    bias=st.floats(-0.5, 0.5),
    frequency=frequencies,
    connectors=st.integers(2, 8),
)
def test_amplitude_and_bias_of_bends_are_recovered(
    amplitude, bias, frequency, connectors
):
    snake = Snake(
        amplitude=amplitude, bias=bias, frequency=frequency, connectors=connectors
    )
    found = plant_metrics(snake.trajectory())
    assert found["bend_amplitude_rad"] == pytest.approx(
        [amplitude] * (connectors - 1), rel=1e-3
    )
    assert found["mean_bend_amplitude_rad"] == pytest.approx(amplitude, rel=1e-3)
    assert found["bend_bias_rad"] == pytest.approx([bias] * (connectors - 1), abs=1e-6)


def test_bends_are_listed_head_first():
    run = Snake(connectors=3).trajectory()
    found = plant_metrics(with_columns(run, bend_2=0.5 * run["bend_2"] + 0.2))
    assert found["bend_amplitude_rad"] == pytest.approx([0.8, 0.4], rel=1e-3)
    assert found["bend_bias_rad"] == pytest.approx([0.0, 0.2], abs=1e-6)


def test_drift_does_not_change_the_amplitude():
    run = Snake(connectors=2, duration=20.0).trajectory()
    drifting = with_columns(run, bend_1=run["bend_1"] + 0.02 * run.time)
    assert plant_metrics(drifting)["bend_amplitude_rad"][0] == pytest.approx(
        0.8, rel=0.01
    )


def test_the_first_two_periods_are_left_out():
    run = Snake(speed=0.2, frequency=2.0).trajectory()
    late = run.time > 1.0
    started = with_columns(
        run,
        com_x=np.where(late, run["com_x"], run["com_x"] + (1.0 - run.time) ** 3 * 0.5),
    )
    assert plant_metrics(started)["com_speed_m_s"] == pytest.approx(0.2, rel=1e-6)


@pytest.mark.parametrize("shift", [0.0, 3.7])
def test_the_window_contains_all_whole_periods_after_the_warm_up(shift):
    run = Snake(frequency=1.7, duration=5.0).trajectory()
    window = GaitWindow.from_trajectory(with_columns(run, time=run.time + shift))
    assert window.start == pytest.approx(shift + 2 / 1.7)
    assert window.periods == 6
    assert window.end == pytest.approx(shift + 8 / 1.7)


def test_a_window_needs_three_whole_periods():
    assert (
        GaitWindow.from_trajectory(Snake(frequency=0.5, duration=5.9).trajectory())
        is None
    )
    exactly = Snake(frequency=0.5, duration=6.0, speed=0.03).trajectory()
    assert GaitWindow.from_trajectory(exactly).periods == 2
    assert plant_metrics(exactly)["com_speed_m_s"] == pytest.approx(0.03, rel=1e-6)
    four_samples_per_period = Snake(frequency=2.0, record_hz=8.0).trajectory()
    assert GaitWindow.from_trajectory(four_samples_per_period).periods == 10


@pytest.mark.parametrize(
    "snake",
    [
        pytest.param(Snake(periodic=False), id="no gait"),
        pytest.param(Snake(duration=1.4), id="fewer than three periods"),
        pytest.param(Snake(duration=0.0), id="one sample"),
        pytest.param(Snake(frequency=2.0, record_hz=7.9), id="too sparse"),
    ],
)
def test_gait_metrics_are_none_without_a_resolved_gait(snake):
    found = plant_metrics(snake.trajectory(), wall_s=2.0)
    others = {"final_bend_rad"}.union(
        LEARNING_UNITS,
        LEARNING_LIST_UNITS,
        TRACKING_UNITS,
        READING_UNITS,
        FOLLOWING_UNITS,
        MEASURED_UNITS,
        CONTACT_UNITS,
    )
    undefined = {name for name, value in found.items() if value is None}
    assert undefined == GAIT_METRICS | others


@pytest.mark.parametrize("speed", [0.2, -0.2])
def test_power_and_cost_of_transport_follow_from_constant_rates(speed):
    run = Snake(speed=speed, sway=(0, 0)).trajectory()
    energies = {
        "work": 3.0 * run.time - 1.0,
        "internal_loss": 0.5 * run.time,
        "pneumatic_energy": 12.0 * run.time,
    }
    found = plant_metrics(with_metadata(with_columns(run, **energies), mass_kg=0.5))
    # The weight is 4.905 N.
    assert {name: found[name] for name in ENERGY_MEANINGS} == pytest.approx(
        {
            "mechanical_power_w": 3.0,
            "internal_power_w": 0.5,
            "cost_of_transport": 3.0 / (4.905 * 0.2),
            "pneumatic_power_w": 12.0,
            "pneumatic_cost_of_transport": 12.0 / (4.905 * 0.2),
        },
        rel=1e-3,
    )
    unknown = plant_metrics(with_columns(run, **energies))
    assert unknown["mechanical_power_w"] == pytest.approx(3.0)
    assert unknown["cost_of_transport"] is None


def sidewinder(direction: float, **columns: np.ndarray) -> Trajectory:
    """Return a run that travels in a direction relative to its heading of 0.4 rad."""
    run = Snake(sway=(0, 0), heading_sway=0.0).trajectory()
    run = moved(run, 0.0, 0.0, 0.4 + direction)
    zero = np.zeros((len(run), 5))
    signals = dict.fromkeys(("quaternion_x", "quaternion_y", "quaternion_z"), zero)
    signals |= {"quaternion_w": zero + 1.0, "z": zero + 0.02}
    signals |= {"load": zero + [0.5, 0.3, 0.0, 0.2, 0.0]} | columns
    for name, values in signals.items():
        run = with_columns(run, **numbered(name, values))
    return with_columns(run, heading=np.full(len(run), 0.4))


def test_travel_and_supports_of_a_sidewinder():
    height = np.full((601, 5), 0.02)
    height[300, 3] = 0.07
    height[50, 1] = 0.5  # before the third gait period
    found = plant_metrics(sidewinder(-1.2, z=height))
    assert {name: found[name] for name in SPATIAL_UNITS} == pytest.approx(
        {
            "travel_speed_m_s": 0.2,
            "travel_direction_rad": -1.2,
            "body_height_m": 0.07,
            "contact_fraction": 0.6,
            "supports": 2.0,
            "roll_turns": 0.0,
        },
        abs=1e-6,
    )
    assert found["com_speed_m_s"] == pytest.approx(0.2)


def test_rolling_is_counted_at_any_heading():
    roll = np.linspace(0, 3.2 * np.pi, 601)[:, None] + np.zeros(5)
    axis = np.exp(0.5j)
    turn = np.exp(0.5j * roll)
    parts = {
        "quaternion_w": axis.real * turn.real,
        "quaternion_x": axis.real * turn.imag,
        "quaternion_y": axis.imag * turn.imag,
        "quaternion_z": axis.imag * turn.real,
    }
    found = plant_metrics(sidewinder(0.0, **parts))
    assert found["roll_turns"] == pytest.approx(1.6)


def test_sidewinders_differ_by_the_angle_between_their_directions():
    load = np.tile([0.5, 0.3, 0.0, 0.0, 0.1], (601, 1))
    reference = sidewinder(3.0)
    found = compare(reference, sidewinder(-3.0, load=load)).metrics
    assert found["travel_direction_abs"] == pytest.approx(2 * math.pi - 6.0)
    assert found["travel_speed_rel"] == pytest.approx(0.0, abs=1e-6)
    assert found["contact_agreement"] == pytest.approx(0.6)


def test_path_length_is_that_of_the_raw_path():
    run = Snake(speed=0.2, sway=(0, 0.01), frequency=2.0, duration=5.0).trajectory()
    time = np.linspace(0, 5, 20001)
    arc = np.hypot(0.2, 0.01 * 4 * np.pi * np.sin(4 * np.pi * time)).mean() * 5
    assert plant_metrics(run)["path_length_m"] == pytest.approx(arc, rel=2e-3)


def test_wall_time_and_valve_openings_are_passed_through():
    found = plant_metrics(Snake(duration=6.0).trajectory(), wall_s=1.5)
    assert found["wall_s"] == 1.5
    assert found["realtime_factor"] == pytest.approx(4.0)
    assert found["valve_switches"] == [[12, 12]] * 4
    unknown = plant_metrics(Snake().trajectory())
    assert unknown["wall_s"] is None and unknown["realtime_factor"] is None


@pytest.mark.parametrize("periodic", [True, False])
def test_every_metric_is_json_and_has_a_unit(periodic):
    found = plant_metrics(
        Snake(yaw_rate=0.3, periodic=periodic).trajectory(), wall_s=1.0
    )
    others = SPATIAL_UNITS.keys() | OBJECT_UNITS.keys()
    assert found.keys() == (METRIC_UNITS.keys() | LIST_METRIC_UNITS.keys()) - others
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    for kind, units in ((float, METRIC_UNITS), (list, LIST_METRIC_UNITS)):
        assert {type(found.get(name)) for name in units} <= {kind, type(None)}


def spoiled(name: str, index: int, value: float) -> Trajectory:
    run = Snake(connectors=3).trajectory()
    column = run[name].copy()
    column[index] = value
    return with_columns(run, **{name: column})


@pytest.mark.parametrize(
    ("run", "words"),
    [
        (
            spoiled("com_y", 7, math.nan),
            "analytical: column 'com_y' is not finite at sample 7",
        ),
        (spoiled("bend_2", 30, math.inf), "column 'bend' is not finite at sample 30"),
        (spoiled("time", 5, 0.0), "the times are not increasing"),
        (sampled(Snake().trajectory(), slice(0)), "has no samples"),
        (
            Trajectory({"time": np.arange(3.0)}),
            "trajectory: the metrics cannot be computed, because the column 'com_x' is"
            " missing",
        ),
        (
            with_metadata(Snake().trajectory(), body_length_m=None),
            "the metadata lack `body_length_m`",
        ),
        (
            with_metadata(Snake().trajectory(), gait_frequency_hz=-1.0),
            "the metadata entry `gait_frequency_hz` is -1.0, but must be a positive"
            " number",
        ),
        (
            with_metadata(Snake().trajectory(), gait_frequency_hz=True),
            "gait_frequency_hz` is True",
        ),
        (
            with_metadata(Snake().trajectory(), gait_frequency_hz=math.nan),
            "gait_frequency_hz` is nan",
        ),
    ],
)
def test_unusable_runs_are_refused(run, words):
    with pytest.raises(InputError, match=re.escape(words)):
        plant_metrics(run)


def test_each_metric_has_one_meaning():
    tables = (*metrics.MEANINGS, *(group.meanings for group in metric_groups()))
    names = [name for table in tables for name in table]
    assert len(names) == len(set(names))
