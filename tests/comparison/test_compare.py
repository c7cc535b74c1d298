"""Comparison of two runs: invariance, known differences, and refused runs."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from synthetic import (
    Snake,
    mirrored,
    moved,
    numbered,
    sampled,
    with_columns,
    with_metadata,
)

from srs_twin.comparison.compare import compare, in_body_frame
from srs_twin.comparison.gait import SPATIAL_DIFFERENCES
from srs_twin.comparison.metrics import COMPARISON_UNITS
from srs_twin.errors import InputError

pytestmark = pytest.mark.fast

some = settings(deadline=None, max_examples=20)
REFERENCE = Snake(speed=0.2, yaw_rate=0.2, frequency=1.7)


@some
@given(
    yaw_rate=st.floats(-0.5, 0.5),
    frequency=st.floats(0.8, 3.0),
    connectors=st.integers(2, 7),
)
def test_the_difference_of_a_run_from_itself_is_zero(yaw_rate, frequency, connectors):
    run = Snake(
        yaw_rate=yaw_rate, frequency=frequency, connectors=connectors
    ).trajectory()
    same = compare(run, run)
    assert same.metrics["gap_factor"] == 1.0
    assert {value for name, value in same.metrics.items() if name != "gap_factor"} == {
        0.0
    }
    assert same.metrics.keys() == COMPARISON_UNITS.keys() - SPATIAL_DIFFERENCES.keys()
    for series in (same.shape_error, same.path_error, same.bend_error):
        assert not series.any()


@some
@given(x=st.floats(-20, 20), y=st.floats(-20, 20), angle=st.floats(-10, 10))
def test_comparison_does_not_depend_on_the_world_frame(x, y, angle):
    reference = REFERENCE.trajectory()
    candidate = Snake(speed=0.18, amplitude=0.7).trajectory("twin")
    here = compare(reference, candidate).metrics
    there = compare(
        moved(reference, x, y, angle), moved(candidate, x, y, angle)
    ).metrics
    assert there == pytest.approx(here, rel=1e-7, abs=1e-9)


@some
@given(x=st.floats(-1, 1), y=st.floats(-1, 1), angle=st.floats(-3, 3))
def test_shape_error_does_not_depend_on_the_pose(x, y, angle):
    run = REFERENCE.trajectory()
    found = compare(run, moved(run, x, y, angle)).metrics
    assert found["shape_rms_m"] == pytest.approx(0, abs=1e-12)
    assert found["bend_rms_rad"] == 0
    assert found["heading_rms_rad"] == pytest.approx(abs(angle))


def test_path_error_of_a_shifted_run_is_the_shift():
    run = REFERENCE.trajectory()
    found = compare(run, moved(run, 0.3, -0.4, 0.0))
    assert found.metrics["path_rms_m"] == pytest.approx(0.5)
    assert found.path_error == pytest.approx(np.full(len(run), 0.5))
    assert found.metrics["com_speed_rel"] == pytest.approx(0, abs=1e-9)


def test_whole_turns_between_headings_are_ignored():
    run = REFERENCE.trajectory()
    turned = with_columns(run, heading=run["heading"] - 4 * np.pi)
    assert compare(run, turned).metrics["heading_rms_rad"] == pytest.approx(
        0, abs=1e-12
    )


@pytest.mark.parametrize(
    ("analytical", "twin"), [(0.2, 0.17), (0.2, -0.1), (-0.1, -0.12)]
)
def test_speed_difference_is_relative_to_the_reference(analytical, twin):
    runs = (Snake(speed=analytical, frequency=1.7), Snake(speed=twin, frequency=1.7))
    found = compare(runs[0].trajectory(), runs[1].trajectory("twin")).metrics
    assert found["com_speed_rel"] == pytest.approx(
        (twin - analytical) / analytical, rel=1e-5
    )


def test_yaw_rate_difference_is_a_magnitude():
    runs = [Snake(yaw_rate=rate).trajectory() for rate in (0.3, 0.1)]
    for reference, candidate in (runs, runs[::-1]):
        assert compare(reference, candidate).metrics["yaw_rate_abs"] == pytest.approx(
            0.2, rel=1e-4
        )


def test_bend_error_is_proportional_to_the_amplitude_error():
    found = compare(
        Snake(amplitude=0.8).trajectory(), Snake(amplitude=0.6).trajectory("twin")
    ).metrics
    assert found["bend_rms_rel"] == pytest.approx(0.25)
    assert found["bend_rms_rad"] == pytest.approx(0.2 / np.sqrt(2), rel=1e-3)
    assert found["shape_rms_body"] == pytest.approx(
        found["shape_rms_m"] / Snake().body_length
    )
    assert found["shape_rms_m"] > 1e-3


def test_shape_error_is_the_distance_of_corresponding_connectors():
    run = Snake(connectors=3).trajectory()
    moved_head = with_columns(
        run,
        x_1=run["x_1"] + 0.03 * np.cos(run["heading"]),
        y_1=run["y_1"] + 0.03 * np.sin(run["heading"]),
    )
    assert compare(run, moved_head).shape_error == pytest.approx(
        np.full(len(run), 0.03 / np.sqrt(3))
    )


def test_shape_error_of_a_mirrored_run_is_twice_the_lateral_position():
    run = Snake(connectors=4).trajectory()
    lateral = in_body_frame(run.position, run.com, run["heading"])[..., 1]
    found = compare(run, mirrored(run))
    assert found.metrics["shape_rms_m"] == pytest.approx(
        2 * np.sqrt(np.mean(lateral**2))
    )
    assert found.bend_error == pytest.approx(-2 * run.stack("bend"))


def test_x_axis_of_the_body_frame_points_forward():
    head = np.array([1.0, 3.0])
    tail = np.array([1.0, 1.0])
    com = np.array([1.0, 2.0])
    seen = in_body_frame(np.stack([head, tail]), com, np.array(np.pi / 2))
    assert seen == pytest.approx(np.array([[1.0, 0.0], [-1.0, 0.0]]))


@pytest.mark.parametrize("record_hz", [100 * 4 / 3, 60.0])
def test_other_sample_times_are_interpolated(record_hz):
    reference = REFERENCE.trajectory()
    found = compare(
        reference, replace(REFERENCE, record_hz=record_hz).trajectory("twin")
    )
    assert np.array_equal(found.time, reference.time)
    assert found.metrics["path_rms_m"] < 1e-6
    assert found.metrics["shape_rms_body"] < 1e-4
    assert found.metrics["bend_rms_rel"] < 1e-4


def test_only_the_common_time_is_compared():
    run = REFERENCE.trajectory()
    found = compare(run, sampled(run, slice(20, 400)))
    assert found.time == pytest.approx(run.time[20:400])
    assert found.metrics["path_rms_m"] < 1e-12
    assert found.bend_error.shape == (380, 4)


def test_a_candidate_with_one_sample_is_compared_at_it():
    run = REFERENCE.trajectory()
    found = compare(run, sampled(run, slice(1)))
    assert found.time.tolist() == [0.0]
    assert found.metrics["com_speed_rel"] is None
    assert found.metrics["path_rms_m"] == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize("snake", [Snake(periodic=False), Snake(duration=0.5)])
def test_without_a_gait_only_distances_are_compared(snake):
    found = compare(snake.trajectory(), snake.trajectory("twin")).metrics
    assert found["com_speed_rel"] is None and found["yaw_rate_abs"] is None
    assert found["shape_rms_m"] == found["path_rms_m"] == 0


def test_zero_denominators_give_none():
    still = Snake(
        speed=0.0, amplitude=0.0, sway=(0.0, 0.0), heading_sway=0.0
    ).trajectory()
    found = compare(still, Snake().trajectory("twin")).metrics
    assert found["com_speed_rel"] is None
    assert found["bend_rms_rel"] is None
    assert found["bend_rms_rad"] > 0


def test_robots_with_equally_many_connectors_can_be_compared():
    straight = Snake(amplitude=0.0)
    longer = replace(straight, segment_length=straight.segment_length + 0.013)
    other = with_metadata(longer.trajectory("twin"), robot="another")
    # The five connectors are 26, 13, 0, 13 and 26 mm farther from the middle.
    distance = compare(straight.trajectory(), other).metrics["shape_rms_m"]
    assert distance == pytest.approx(0.013 * np.sqrt(2))


@pytest.mark.parametrize(
    ("candidate", "words"),
    [
        (
            Snake(connectors=4).trajectory("twin"),
            (
                "analytical has 5 connectors, but twin has 4; only runs of robots"
                " with the same number of connectors can be compared"
            ),
        ),
        (
            with_columns(
                Snake().trajectory("twin"), **numbered("x", np.zeros((601, 6)))
            ),
            (
                "twin has 6 columns x_1…, 5 columns y_1… and 4 columns bend_1…; a"
                " snake with N connectors must have N columns x, N columns y and N − 1"
                " columns bend"
            ),
        ),
        (
            with_columns(Snake().trajectory("twin"), time=np.arange(601) / 100 + 9),
            "the runs cannot be compared, because they have fewer than two times in common"
            " (analytical covers 0 to 6 s, twin covers 9 to 15 s",
        ),
        (
            with_columns(Snake().trajectory("twin"), time=np.arange(601) / 100 + 6),
            "fewer than two times in common (analytical covers 0 to 6 s, twin covers 6",
        ),
        (
            with_columns(Snake().trajectory("twin"), x_2=np.full(601, np.nan)),
            "twin: column 'x' is not finite",
        ),
    ],
)
def test_incomparable_runs_are_refused(candidate, words):
    with pytest.raises(InputError, match=re.escape(words)):
        compare(Snake().trajectory(), candidate)


def test_a_reference_without_body_length_is_refused():
    run = Snake(periodic=False).trajectory()
    with pytest.raises(
        InputError, match="analytical: the metadata lack `body_length_m`"
    ):
        compare(with_metadata(run, body_length_m=None), run)
