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
    pulses = PulseWidthModulator(carrier, tick, len(duty), allow_long_ticks=True)
    parts = [pulses.step(duty) for _ in range(round(seconds / tick))]
    states = np.concatenate(parts)
    assert states.dtype == np.int8 and set(np.unique(states)) <= {-1, 1}
    return states == 1


@some
@given(
    arrays(float, (20, 2), elements=duties),
    st.sampled_from([13.0, 33.3, 50.0, 61.7, 240.0]),
)
def test_pulse_length_is_exact_within_a_slot(duty, carrier):
    filling = played(duty, 0.5, carrier=carrier)
    length = 1e4 / carrier
    begins = np.ceil(np.arange(0.5 * carrier) * length - 0.5).astype(int)
    pulses = np.split(filling, begins[1:])[:-1]
    sums = np.array([pulse.sum(axis=0) for pulse in pulses])
    assert np.abs(sums - duty * length).max() <= 1.0 + 1e-9
    # A + chamber fills at the beginning of a period and a − chamber at its end.
    for pulse in pulses:
        assert (np.diff(pulse[..., 0].astype(int), axis=0) <= 0).all()
        assert (np.diff(pulse[..., 1].astype(int), axis=0) >= 0).all()


@some
@given(arrays(float, (50,), elements=duties))
def test_duties_with_sum_1_make_opposite_valves(plus):
    filling = played(np.stack([plus, 1 - plus], axis=-1), 0.2)
    # 1 − (1 − d) may miss d by rounding.
    assert (filling[..., 0] != filling[..., 1]).mean() > 0.999


@some
@given(
    arrays(float, (4, 2), elements=duties),
    st.sampled_from([(1e-4, 1e-3), (1e-3, 2e-3), (1e-3, 5e-3), (1e-3, 0.05)]),
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


@pytest.mark.parametrize("bad", [-1e-9, 1 + 1e-9, math.nan])
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


@pytest.mark.parametrize("carrier", [0.0, -60.0, math.inf])
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
