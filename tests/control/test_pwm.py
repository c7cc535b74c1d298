"""Pulse-width modulation: exact mean duties for carrier periods that are not multiples of the tick."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from srs_twin.control.pwm import PulseWidthModulator
from srs_twin.errors import InputError

SLOT = 1e-4
some = settings(max_examples=25)
duties = st.floats(0, 1) | st.sampled_from([0.0, 1.0, 0.5])


def played(
    duty: np.ndarray, seconds: float, *, carrier: float = 60.0, tick: float = 1e-3
) -> np.ndarray:
    """Return which chambers fill in each slot, shape (slots, segments, 2), for duties (segments, 2)."""
    pulses = PulseWidthModulator(carrier, tick, len(duty))
    parts = [pulses.step(duty) for _ in range(round(seconds / tick))]
    states = np.concatenate(parts)
    assert states.dtype == np.int8 and set(np.unique(states)) <= {-1, 1}
    return states == 1


def openings(filling: np.ndarray) -> np.ndarray:
    """Return the number of openings of each valve, which is closed before the first slot."""
    closed_before = np.concatenate([np.zeros_like(filling[:1]), filling[:-1]])
    return (filling & ~closed_before).sum(axis=0)


@pytest.mark.slow
@some
@given(
    arrays(float, (20, 2), elements=duties),
    st.sampled_from([13.0, 50.0, 60.0, 61.7, 240.0]),
)
def test_duty_is_exact_over_many_periods(duty, carrier):
    filling = played(duty, 1.0, carrier=carrier)
    # The error of a pulse is at most one slot, and the last period may be incomplete.
    assert np.abs(filling.mean(axis=0) - duty).max() <= carrier * SLOT + 1 / carrier
    if carrier in (
        50.0,
        60.0,
    ):  # three periods are a whole number of slots, so that nothing is unfinished
        whole = filling[: round(30 * 1e4 / carrier)]
        assert np.abs(whole.mean(axis=0) - duty).max() <= carrier * SLOT


@some
@given(arrays(float, (20, 2), elements=duties))
def test_pulse_length_is_exact_within_a_slot(duty):
    filling = played(duty, 0.5)
    edges = np.ceil(np.arange(31) * 1e4 / 60 - 0.5).astype(int)
    lengths = np.add.reduceat(filling, edges[:-1], axis=0)[:-1]
    assert np.abs(lengths - duty * 1e4 / 60).max() <= 1.0 + 1e-9


@pytest.mark.slow
@some
@given(arrays(float, (20, 2), elements=duties), st.sampled_from([33.3, 60.0, 100.0]))
def test_a_valve_opens_at_most_once_per_period_and_not_at_0_and_1(duty, carrier):
    filling = played(duty, 1.0, carrier=carrier)
    counted = openings(filling)
    assert (counted <= math.ceil(carrier)).all()
    assert (counted[duty == 0.0] == 0).all() and (counted[duty == 1.0] == 1).all()


@some
@given(arrays(float, (50,), elements=duties))
def test_duties_with_sum_1_make_opposite_valves(plus):
    filling = played(np.stack([plus, 1 - plus], axis=-1), 0.2)
    assert (
        filling[..., 0] != filling[..., 1]
    ).mean() > 0.999  # 1 − (1 − d) may miss d by rounding


@some
@given(
    arrays(float, (4, 2), elements=duties),
    st.sampled_from([(1e-4, 1e-3), (1e-3, 2e-3), (1e-3, 5e-3)]),
)
def test_pulses_do_not_depend_on_the_tick(duty, ticks):
    short, long = (played(duty, 0.1, tick=tick) for tick in ticks)
    assert (short == long).all()


def test_new_duties_take_effect_at_the_start_of_a_period():
    pulses = PulseWidthModulator(60.0, 1e-3, 1)
    begun = []
    for k in range(50):
        if pulses.due():
            begun.append(k)
        pulses.step(np.full((1, 2), k / 50))
        assert pulses.duty[0, 0] == begun[-1] / 50
    # Periods begin at 0, 16.67, 33.33 ms: in these ticks.
    assert begun == [0, 16, 33]


def test_a_new_duty_does_not_change_the_current_period():
    pulses = PulseWidthModulator(60.0, 1e-3, 1)
    parts = [pulses.step(np.full((1, 2), 0.25 if k < 5 else 1.0)) for k in range(40)]
    filling = np.concatenate(parts)[:, 0, 0] == 1
    first = filling[:167]
    rest = filling[167:]
    assert first.sum() in (41, 42) and rest.all()


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("bad", [-1e-9, 1 + 1e-9, math.nan, math.inf])
def test_duties_outside_0_to_1_are_refused(bad):
    with pytest.raises(
        InputError, match=r"duty .* is not allowed; it must be between 0 and 1"
    ):
        PulseWidthModulator(60.0, 1e-3, 1).step(np.array([[0.5, bad]]))


def test_duties_of_another_shape_are_refused():
    with pytest.raises(
        InputError,
        match=r"duties of shape \(2, 2\) are not allowed; their shape must be \(1, 2\)",
    ):
        PulseWidthModulator(60.0, 1e-3, 1).step(np.zeros((2, 2)))


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("carrier", [0.0, -60.0, math.nan, math.inf])
def test_invalid_carrier_frequencies_are_refused(carrier):
    with pytest.raises(InputError, match="carrier_hz"):
        PulseWidthModulator(carrier, 1e-3, 1)


def test_ticks_that_do_not_fit_are_refused():
    with pytest.raises(
        InputError, match=r"60 Hz is too fast for the tick of 0.02 s; use 50 Hz or less"
    ):
        PulseWidthModulator(60.0, 0.02, 1)
    with pytest.raises(InputError, match=r"tick -0.001 s is not allowed"):
        PulseWidthModulator(60.0, -0.001, 1)


@some
@given(arrays(float, (4, 2), elements=duties))
def test_aligned_pulses_treat_both_chambers_alike(duty):
    def together(given: np.ndarray) -> np.ndarray:
        pulses = PulseWidthModulator(60.0, 1e-3, 4, aligned=True)
        return np.concatenate([pulses.step(given) for _ in range(100)])

    plus = played(np.stack([duty[:, 0], np.zeros(4)], axis=-1), 0.1)[..., 0]
    found = together(duty) == 1
    assert (found[..., 0] == plus).all()
    assert (together(duty[:, ::-1]) == together(duty)[..., ::-1]).all()


@some
@given(arrays(float, (4, 2), elements=duties))
def test_long_ticks_give_the_same_pulses(duty):
    parts = []
    for tick in (1e-3, 0.05):
        pulses = PulseWidthModulator(60.0, tick, 4, allow_long_ticks=True)
        parts.append(
            np.concatenate([pulses.step(duty) for _ in range(round(0.2 / tick))])
        )
    assert (parts[0] == parts[1]).all()
