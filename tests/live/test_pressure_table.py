"""Deviations of a chamber from its first-order law are learnt by the time since its valve switched."""

from __future__ import annotations

import math

import numpy as np
import pytest

from srs_twin.live.pressure_table import PressureLevels, PressureRates

SUPPLY = 50e3
TAU = 0.11
NOISE = 300.0
TICK = 0.02
STEP = 0.001


def followed(deviation, seconds=30.0, half=15, late=0.007):
    """Return rates and innovations for a chamber that changes by `deviation` (age) faster than its law."""
    rng = np.random.default_rng(5)
    rates = PressureRates(1, SUPPLY, 0.15)
    pressure = model = 0.0
    off = []
    for k in range(round(seconds / STEP)):
        opens = float((k * STEP // TICK) // half % 2)
        age = (k * STEP) % (half * TICK)
        place = rates.advance(np.full((1, 2), opens), STEP)
        fades = math.exp(-STEP / TAU)
        end = opens * SUPPLY
        pressure = end + (pressure - end) * fades + STEP * deviation(age, opens)
        model = end + (model - end) * fades + STEP * rates.rate[place][0, 0]
        if (k * STEP - late) % TICK < STEP - 1e-9:
            told = pressure + NOISE * rng.normal()
            off.append(told - model)
            rates.update(np.array([[off[-1], np.nan]]), NOISE)
            model = told
    return rates, np.array(off)


@pytest.mark.slow
def test_inrush_after_switching_is_learnt():
    rates, off = followed(
        lambda age, opens: (2 * opens - 1) * 400e3 if age < 0.04 else 0.0
    )
    late = np.sqrt(np.mean(off[-300:] ** 2))
    assert np.sqrt(np.mean(off[:30] ** 2)) > 6 * late
    assert late < 4 * NOISE
    for state, way in ((0, -1), (1, 1)):
        # Pressures that come each tick tell what rushes in, but not at which moment of
        # the tick.
        early, then = np.split(rates.rate[0, 0, state, :30], [6])
        assert 0.01 * early.sum() == pytest.approx(way * 400e3 * 0.04, rel=0.1)
        assert (
            np.abs(then[:-2]).max() < 60e3
        )  # a pressure after the switch also informs ages before it
    # Well-known rates have a small random walk; the other chamber had no measurements.
    assert rates.wander[0, 0, 1, 10:20].max() < 0.5 * rates.wander[0, 1, 1, 0]
    assert (rates.rate[0, 1] == 0).all()


def test_first_order_chamber_has_no_deviation():
    rates, off = followed(lambda age, opens: 0.0)
    assert np.sqrt(np.mean(rates.rate[0, 0] ** 2)) < 2 * NOISE / TICK
    assert np.sqrt(np.mean(off[-300:] ** 2)) < 2.5 * NOISE


def test_usual_residuals_are_known_after_a_few_strokes():
    """Each chamber is judged by the time since its own valve switched."""
    levels = PressureLevels(1, 0.1)
    known = []
    for step in range(400):
        half = step // 10
        levels.ages.advance(np.array([[half % 2, 0.0]]), TICK)
        known.append(levels.are_known()[0])
        levels.update(np.full((1, 2), 0.2), np.array([[True, True]]))
    strokes = np.array(known)[:, 0].reshape(-1, 10)[1::2]
    assert not strokes[:3].any() and strokes[6:].all()
    # The other chamber vents all the time, so all its pressures belong to the last bin.
    assert np.array(known)[-1, 1]
