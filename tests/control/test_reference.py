"""References: values, rates, steps, and the range of the module."""

from __future__ import annotations

import math
from itertools import accumulate, repeat

import numpy as np
import pytest
from hypothesis import given, strategies as st

from srs_twin.control.reference import (
    Constant,
    Sine,
    Square,
    Staircase,
    StepReference,
)
from srs_twin.errors import InputError, UnknownNameError

bends = st.floats(-1.5, 1.5)
positive = st.floats(0.05, 1.5)
references = st.one_of(
    st.builds(Constant, bends),
    st.builds(StepReference, bends, bends, st.floats(0, 2)),
    st.builds(Sine, positive, st.floats(0.1, 10), bends, bends),
    st.builds(Square, positive, st.floats(0.1, 10), bends, bends),
    st.builds(
        Staircase,
        st.lists(bends, min_size=1, max_size=6).map(tuple),
        st.floats(0.05, 1),
    ),
)
times = np.linspace(0, 3, 3001)


@given(references)
def test_values_never_exceed_the_peak(reference):
    values = reference.value(times)
    assert values.shape == times.shape
    assert np.abs(values).max() <= reference.peak + 1e-12


@given(references, st.floats(0, 3))
def test_numbers_and_arrays_give_the_same_values(reference, time):
    for function in (reference.value, reference.rate, reference.is_clipped):
        assert np.ndim(function(time)) == 0
        assert function(np.array([time]))[0] == function(time)


@given(references, st.floats(0.1, 0.9))
def test_limited_reference_is_clipped_exactly_where_it_exceeds_the_limit(
    reference, fraction
):
    limit = max(fraction * reference.peak, 1e-3)
    cut = reference.limited(limit, "saturate")
    wanted = reference.value(times)
    values = cut.value(times)
    beyond = cut.is_clipped(times)
    assert np.abs(values).max() <= limit == pytest.approx(cut.peak) or cut is reference
    assert (values == wanted)[~beyond].all()
    assert (np.abs(values[beyond]) == limit).all() and (
        np.abs(wanted[beyond]) > limit
    ).all()
    assert (cut.rate(times)[beyond] == 0).all()


@given(st.builds(Sine, positive, st.floats(0.1, 10), bends, bends))
def test_rate_of_a_sine_equals_its_difference_quotient(sine):
    h = 1e-5
    quotient = (sine.value(times + h) - sine.value(times - h)) / (2 * h)
    # The third derivative times h², and the rounding of values and angles over h.
    omega = 2 * math.pi * sine.frequency
    eps = np.finfo(float).eps
    angle = omega * times[-1] + abs(sine.phase)
    allowed = (
        sine.amplitude * omega**3 * h**2
        + 2 * eps * (sine.peak + sine.amplitude * angle) / h
    )
    assert np.abs(sine.rate(times) - quotient).max() <= allowed


def test_steps_occur_at_their_tick_despite_rounding():
    """The sum of ticks differs from 0.3 s by rounding, in either direction."""
    ticks = list(accumulate(repeat(0.001, 2000), initial=0.0))
    assert ticks[300] != 0.3
    for k in (300, 600, 900):
        assert StepReference(1.0, time=k / 1000).value(ticks[k]) == 1.0
        assert StepReference(1.0, time=k / 1000).value(ticks[k - 1]) == 0.0
        stairs = Staircase((0.0, 1.0, 2.0, 3.0), 0.3)
        assert stairs.value(ticks[k]) - stairs.value(ticks[k - 1]) == 1.0
    square = Square(1.0, 2.0)
    values = [square.value(ticks[k]) for k in (0, 249, 250, 499, 500, 750)]
    assert values == [1, 1, -1, -1, 1, -1]


def test_staircase_keeps_its_last_level():
    values = Staircase((0.1, 0.2), 0.5).value(np.array([0.0, 0.49, 0.5, 100.0]))
    assert values.tolist() == [0.1, 0.1, 0.2, 0.2]


def test_square_has_the_sign_of_its_sine():
    sine = Sine(1.0, 1.7, 0.3)
    square = Square(1.0, 1.7, 0.3)
    assert (np.sign(sine.value(times)) == square.value(times)).all()


def test_references_within_the_range_are_unchanged():
    sine = Sine(0.6, 6.0)
    assert sine.limited(0.6) is sine
    assert not sine.is_clipped(times).any()


def test_the_error_for_an_exceeded_range_names_both_angles():
    with pytest.raises(
        InputError, match=r"reaches 45°, but the module bends at most 41.97°.*saturate"
    ):
        StepReference(math.radians(45)).limited(math.radians(41.97))


@pytest.mark.parametrize("limit", [0.0, math.nan, math.inf])
def test_invalid_range_limits_are_refused(limit):
    with pytest.raises(InputError, match=r"range limit .* rad is not allowed"):
        Constant(0.1).limited(limit)


def test_an_unknown_policy_lists_the_known_ones():
    with pytest.raises(UnknownNameError, match=r"'refused'; did you mean refuse\?"):
        Constant(0.1).limited(1.0, "refused")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Constant(math.nan), "bend nan is not allowed"),
        (lambda: StepReference(math.inf), "bend inf is not allowed"),
        (
            lambda: Sine(0.0, 1.0),
            "amplitude 0.0 is not allowed; it must be finite and above 0",
        ),
        (
            lambda: Sine(0.5, -1.0),
            "frequency -1.0 is not allowed; it must be finite and above 0",
        ),
        (lambda: Square(0.5, 1.0, math.nan), "phase nan is not allowed"),
        (lambda: Staircase((), 1.0), "one or more"),
        (lambda: Staircase((0.1, math.nan), 1.0), "give one or more finite numbers"),
        (lambda: Staircase((0.1,), 0.0), "hold 0.0 s is not allowed"),
    ],
)
def test_invalid_references_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()
