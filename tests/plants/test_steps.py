"""Time steps of the integrators: laws for arbitrary events, samples and lengths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from srs_twin.plants.analytical.kernels import GAMMA
from srs_twin.plants.analytical.steps import TimeSteps

pytestmark = pytest.mark.fast

SAME = 1e-9

spans = st.sampled_from([0.001, 0.02, 0.5])
near_the_grid = st.builds(
    lambda k, deviation: k / 40 + deviation,
    st.integers(1, 39),
    st.sampled_from([0.0, 1e-15, -1e-15, 3e-4]),
)
fractions = st.lists(
    st.floats(0.001, 0.999) | near_the_grid, max_size=6, unique=True
).map(sorted)


@given(spans, fractions, st.integers(1, 5), st.floats(0.05, 2.0))
def test_steps_cover_the_span_and_end_on_samples_and_events(
    span, fractions, samples, length
):
    """Events within rounding of the even grid neither add a step nor drop a sample."""
    events = span * np.array(fractions)
    longest = span * length
    steps = TimeSteps.between(span, events, samples, longest=longest, same=SAME)
    assert (steps.lengths > 0.9 * SAME).all()
    assert steps.lengths.max() <= longest * (1 + 1e-9)
    assert steps.lengths.sum() == pytest.approx(span)
    assert steps.ends[steps.sample_steps - 1] == pytest.approx(
        span * np.arange(1, samples + 1) / samples
    )
    assert all(np.abs(steps.ends - event).min() <= SAME for event in events)
    assert steps.stage_times[2::2] == pytest.approx(steps.ends)
    assert steps.stage_times[1::2] == pytest.approx(
        steps.ends - (1 - GAMMA) * steps.lengths
    )


@given(spans, fractions, st.integers(1, 5), st.floats(0.02, 0.7))
def test_chunks_contain_the_same_steps_and_samples(span, fractions, samples, turn):
    steps = TimeSteps.between(
        span, span * np.array(fractions), samples, longest=span / 20, same=SAME
    )
    pieces = list(steps.chunks(turn * span))
    assert [begin for begin, _, _ in pieces][1:] == [end for _, end, _ in pieces][:-1]
    assert np.concatenate(
        [begin + piece.ends for begin, _, piece in pieces]
    ) == pytest.approx(steps.ends)
    before = np.cumsum([0] + [len(piece.ends) for _, _, piece in pieces])
    marks = [
        first + piece.sample_steps
        for first, (_, _, piece) in zip(before, pieces, strict=False)
    ]
    assert np.concatenate(marks).tolist() == steps.sample_steps.tolist()


def test_equal_ticks_share_one_object():
    none = np.empty(0)
    one, other = (
        TimeSteps.between(0.001, none, 1, longest=0.002, same=SAME) for _ in range(2)
    )
    assert one is other
    event = TimeSteps.between(0.001, np.array([0.0004]), 1, longest=0.002, same=SAME)
    assert event.ends.tolist() == [0.0004, 0.001] and event.sample_steps.tolist() == [2]
