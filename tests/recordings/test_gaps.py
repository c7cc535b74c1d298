"""Gaps and outliers of tracks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from srs_twin import InputError
from srs_twin.recordings.signals.gaps import (
    at_frames,
    fill_gaps,
    frame_grid,
    longest_complete,
    outliers,
    time_order,
)

pytestmark = pytest.mark.fast


@pytest.mark.parametrize("missing", [1, 3, 7])
def test_duration_of_a_gap_is_measured_between_its_neighbours(missing):
    time = 5.0 + 0.01 * np.arange(60)
    tracks = np.zeros((60, 2, 2))
    tracks[20 : 20 + missing, 1] = np.nan
    lasts = 0.01 * (missing + 1)
    assert longest_complete(time, tracks, lasts + 1e-6) == slice(0, 60)
    assert longest_complete(time, tracks, lasts - 1e-6) == slice(20 + missing, 60)


def test_the_longest_interval_begins_and_ends_with_visible_markers():
    tracks = np.zeros((100, 2, 2))
    tracks[[*range(20, 30), *range(70, 80)], 1] = np.nan
    tracks[[30, 31, 69], 0] = np.nan  # short gaps beside the long ones
    found = longest_complete(0.01 * np.arange(100), tracks, 0.05)
    assert found == slice(32, 69)


@pytest.mark.parametrize("place", [0.0, 10.0])
def test_outliers_are_detected_at_any_position(place):
    """A cubic track has none; a jump of more than 1 mm is one, also with few visible neighbours."""
    s = np.linspace(-1, 1, 200)
    track = place + np.column_stack([s**3 - 0.2 * s, 0.3 * s**2 + s])
    points = np.stack([track, track[::-1]], axis=1)
    points[[57, 61, 119, 123]] = np.nan
    assert not outliers(points, 1e-3).any()
    points[59, 0] += [0.6e-3, -0.9e-3]
    points[121, 1] -= [0.0, 1.1e-3]
    points[20, 0] += [0.6e-3, -0.7e-3]
    points[160, 0] += [0.6e-3, -0.9e-3]
    assert np.argwhere(outliers(points, 1e-3)).tolist() == [[59, 0], [121, 1], [160, 0]]


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("seed", range(20))
def test_only_the_outlier_among_missing_samples_is_detected(seed):
    """Any samples around it may be missing; near the ends there are too few of them."""
    random = np.random.default_rng(seed)
    s = np.linspace(-1, 1, 200)
    points = np.column_stack([s**3 - 0.2 * s, 0.3 * s**2 + s])[:, None].copy()
    points[random.random(200) < 0.25] = np.nan
    places = np.flatnonzero(np.isfinite(points[:, 0, 0]))[[0, 20, 40, 60, 80, -2]]
    points[places] += [0.03, -0.04]
    found = np.flatnonzero(outliers(points, 1e-3)[:, 0])
    assert found.tolist() == places[1:-1].tolist()


FRAMES_S = np.arange(201) / 100
NOISE = np.random.default_rng(0).normal(size=201)


@given(
    st.integers(20, 180),
    st.floats(0.035, 0.5),
    st.floats(0.0, 1e-3),
    st.integers(0, 2**31),
)
@settings(max_examples=50)
def test_a_clock_that_is_set_back_is_refused(row, back_s, noise_s, seed):
    time = FRAMES_S + np.random.default_rng(seed).normal(size=201) * noise_s
    time[row:] -= back_s
    with pytest.raises(
        InputError, match=rf"after data row {row}, so the clock was probably"
    ):
        time_order(time, NOISE)


def test_a_counter_of_microseconds_that_overflows_is_refused():
    time = (4_294_000_000 + 10_000 * np.arange(201)) % 2**32 / 1e6
    with pytest.raises(InputError, match=r"go back from 4294.96 s to 0.002704 s"):
        time_order(time, NOISE)


def test_a_long_recording_over_an_overflow_is_refused():
    """More than half of the range of the counter lies between both ends."""
    time = (3_000_000_000 + 200_000 * np.arange(12_000)) % 2**32 / 1e6
    with pytest.raises(InputError, match="clock was probably set back"):
        time_order(time, np.zeros(12_000))


@pytest.mark.parametrize("order", ["one late row", "shuffled"])
def test_rows_over_an_hour_are_sorted(order):
    if order == "shuffled":
        time = np.random.default_rng(0).permutation(np.arange(0.0, 3600.0))
    else:
        time = np.arange(201) / 10
        time[120:] += 2460.0
        time[[100, 101]] = time[[101, 100]]
    order, (note,) = time_order(time, np.zeros(len(time)))
    assert (np.diff(time[order]) > 0).all()
    assert "and were sorted" in note


def test_late_rows_are_sorted_with_a_note():
    rows = np.r_[0:40, 43, 40:43, 44:80, 90:100, 80:90, 100:200]
    order, (note,) = time_order(FRAMES_S[rows], NOISE[rows])
    assert (rows[order] == np.arange(200)).all()
    assert "(2 steps back)" in note


@given(st.integers(0, 2**31), st.sampled_from([0.0, 0.002, 0.005, 0.01, 0.04]))
@example(11078, 0.005)
@settings(max_examples=50)
def test_late_and_shuffled_rows_are_sorted(seed, jitter_s):
    rng = np.random.default_rng(seed)
    time = FRAMES_S + rng.normal(size=201) * jitter_s
    blocks = np.concatenate([time[100:], time[:100]])
    for rows in (time, time[::-1], rng.permutation(time), blocks):
        order, notes = time_order(rows, NOISE)
        assert rows[order].tolist() == sorted(rows)
        assert bool(notes) == (rows.tolist() != sorted(rows))


@given(st.integers(0, 2**31))
@settings(max_examples=50)
def test_up_to_5_per_cent_of_rows_may_be_sent_again(seed):
    rng = np.random.default_rng(seed)
    rows = np.arange(201)
    for size in (6, 4):
        first = rng.integers(1, 190)
        end = np.flatnonzero(rows == first + size)[-1] + 1
        rows = np.insert(rows, end, range(first, first + size))
    order, notes = time_order(FRAMES_S[rows], NOISE[rows])
    assert rows[order].tolist() == list(range(201))
    assert "10 rows were left out, because they repeat the time and" in notes[0]
    for values in (np.arange(len(rows)), np.zeros(len(rows))):
        with pytest.raises(InputError, match="the clock was probably set back"):
            time_order(FRAMES_S[rows], values)


def test_more_than_5_per_cent_of_repeated_rows_are_refused():
    rows = np.r_[0:60, 48:201]
    with pytest.raises(InputError, match="the clock was probably set back"):
        time_order(FRAMES_S[rows], NOISE[rows])


VALVE = np.arange(201) // 4 % 2.0


@pytest.mark.parametrize("size", [1, 2, 3])
def test_constant_rows_that_are_sent_again_are_left_out(size):
    """The valve switches before the rows are sent again."""
    again = range(100, 100 + size)
    rows = np.r_[0:106, again, 106:201]
    order, notes = time_order(FRAMES_S[rows], VALVE[rows])
    assert rows[order].tolist() == list(range(201))
    assert f"{size} rows were left out" in notes[0]


@pytest.mark.parametrize("end", [103, 106, 201])
def test_a_clock_that_is_set_back_may_repeat_some_rows(end):
    """The valve switches at row 104, but does not after the clock was set back."""
    rows = np.r_[0:106, 100:end]
    values = np.r_[VALVE[:106], np.full(end - 100, VALVE[100])]
    with pytest.raises(InputError, match="the clock was probably set back"):
        time_order(FRAMES_S[rows], values)


def test_missing_frames_are_inserted_at_their_times():
    rows = np.delete(np.arange(60), [20, 21, 40])
    grid = frame_grid(5.0 + 0.01 * rows, rows)
    assert grid.time == pytest.approx(5.0 + 0.01 * np.arange(60))
    assert grid.period == pytest.approx(0.01)
    assert np.flatnonzero(grid.rows < 0).tolist() == [20, 21, 40]
    values = at_frames(rows.astype(float), grid)
    assert values[19:23] == pytest.approx([19, np.nan, np.nan, 22], nan_ok=True)
    assert grid.corrections == (
        "3 frames are missing in the file and were inserted without markers",
    )


def test_times_of_uneven_frames_are_kept():
    """A step may differ by 20 % from the frame period."""
    for longer in (0.0021, -0.0021, 0.0019):
        time = np.append(0.01 * np.arange(60), 0.6 + longer)
        grid = frame_grid(time, NOISE[:61])
        assert (grid.time == time).all()
        assert grid.corrections == (
            "the frames are not evenly spaced in time, and their times are kept",
        ) * (abs(longer) > 0.002)


def test_a_recording_with_few_of_its_frames_is_refused():
    """At least 12 frames and a tenth of all frames are needed."""
    rows = np.append(np.arange(11), 119)
    assert len(frame_grid(0.01 * rows, rows).rows) == 120
    said = "12 of 121 frames, and none between 0.1 s and 1.2 s; cut the recording there"
    with pytest.raises(InputError, match=said):
        frame_grid(0.01 * np.append(rows[:11], 120), rows)
    with pytest.raises(InputError, match="11 frames, but at least 12 are needed"):
        frame_grid(0.01 * rows[:11], rows[:11])


def test_gaps_of_cubic_tracks_are_filled_exactly():
    """A track with three visible samples is interpolated linearly."""
    time = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.03, 40))
    cubic = np.column_stack([time**3 - time, 2 * time**3])
    points = np.stack([cubic, np.column_stack([time, -time])], axis=1)
    hidden = points.copy()
    hidden[[5, 6, 20], 0] = np.nan
    hidden[:, 1][~np.isin(np.arange(40), [0, 9, 39])] = np.nan
    assert fill_gaps(time, hidden, 3) == pytest.approx(points)
