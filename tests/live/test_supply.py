"""Supply pressure as a state of the shadow: estimated from chambers that fill, or measured."""

from __future__ import annotations

import numpy as np
import pytest
from live_runs import (
    DROOPS_S,
    OUTAGE,
    Run,
    alarms,
    conditioned,
    shadowed,
    steered,
)
from subsets import first_by_default

from srs_twin.live.air_balance import LARGEST_SD, PRIOR_SD, WALK, SupplyFilter

NOMINAL = 60e3
TICK = 0.02
SD = 0.03 * NOMINAL


def followed(supplies, seed=1, outlier=0.0, repeats=1.0):
    """Return estimates and standard deviations from the pressures of four chambers that fill."""
    rng = np.random.default_rng(seed)
    supply = SupplyFilter(NOMINAL)
    estimates = []
    for true in supplies:
        supply.predict(TICK)
        response = rng.uniform(0.3, 0.95, 4)
        pressure = response * true + SD * rng.normal(size=4)
        pressure[0] *= 1 - outlier
        residual = pressure - response * supply.pressure
        supply.update(residual, response, np.full(4, SD), np.ones(4), repeats)
        estimates.append((supply.pressure, supply.sd))
    return np.array(estimates)


def test_droop_is_followed_within_half_a_second():
    found = followed(np.full(50, 0.9 * NOMINAL))
    assert found[25:, 0] == pytest.approx(0.9 * NOMINAL, rel=0.05)


def test_standard_deviation_is_that_of_the_errors():
    """Supplies drawn from the filter's own random walk."""
    errors = []
    for seed in range(40):
        rng = np.random.default_rng((seed, 1))
        walk = NOMINAL * (
            1
            + PRIOR_SD * rng.normal()
            + np.cumsum(WALK * np.sqrt(TICK) * rng.normal(size=100))
        )
        found = followed(walk, seed)
        errors.append((found[50:, 0] - walk[50:]) / found[50:, 1])
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.2


def test_one_leaking_chamber_hardly_moves_the_estimate():
    assert followed(np.full(100, NOMINAL), outlier=0.5)[-1, 0] == pytest.approx(
        NOMINAL, rel=0.05
    )


def test_measurement_corrects_and_variance_grows_up_to_its_limit():
    supply = SupplyFilter(NOMINAL)
    for _ in range(1000):
        supply.predict(1.0)
    assert supply.sd == pytest.approx(LARGEST_SD * NOMINAL)
    supply.measure(0.9 * NOMINAL)
    assert supply.fraction == pytest.approx(0.9, abs=0.002)


def test_sudden_loss_is_followed_by_one_message():
    found = followed(np.where(np.arange(50) < 25, NOMINAL, 0.5 * NOMINAL), repeats=16.0)
    assert found[25, 0] == pytest.approx(0.5 * NOMINAL, abs=0.05 * NOMINAL)
    assert found[25, 1] < 0.06 * NOMINAL


@pytest.mark.slow
@pytest.mark.parametrize(
    "supply", first_by_default(1, ["wander", "droop:0.97", "droop:0.85"])
)
def test_drooping_supply_is_followed_and_is_not_a_fault(supply):
    assert alarms((104, 20.0, supply)) == []
    run = conditioned(supply, 104, 20.0)
    off = [
        moment.shadow.faults.supply.fraction - run.supply_fraction(moment.time)
        for moment in shadowed(run, members=8)
        if moment.time > DROOPS_S + 1
    ]
    assert np.abs(np.subtract(off, np.median(off))).max() < 0.06


@pytest.mark.slow
def test_low_supply_pressure_is_reported_and_cleared_on_recovery():
    back = DROOPS_S + OUTAGE[1]
    named = {}
    for moment in shadowed(Run(104, back + 3.0, supply="outage"), members=8):
        named[moment.time] = dict(moment.shadow.faults.detected_faults)
    period = 1 / 1.5
    assert all(not faults for time, faults in named.items() if time < DROOPS_S)
    assert all(
        faults == {0: "low_supply_pressure"}
        for time, faults in named.items()
        if DROOPS_S + 1.5 < time < back
    )
    assert all(not faults for time, faults in named.items() if time > back + 2 * period)


def test_a_measurement_is_weighted_with_student_t():
    """At two standard deviations and four degrees of freedom, the weight is 5/8."""
    supply = SupplyFilter(NOMINAL)
    prior = supply.variance
    residual = -2 * np.sqrt(SD**2 + prior)
    supply.update(*(np.array([value]) for value in (residual, 1.0, SD, 1.0)))
    information = 5 / 8 / SD**2
    assert supply.variance == pytest.approx(1 / (1 / prior + information))
    change = supply.variance * information * residual
    assert supply.pressure == pytest.approx(NOMINAL + change)


@pytest.mark.slow
def test_first_strokes_of_compressible_chambers_are_not_a_loss_of_the_supply():
    """Chambers that deviate from the first-order model are not a loss of the supply."""
    run = Run(7, 4.0, robot="gen2", frequency=2.0, cameras_s=4.0, pneumatics="orifice")
    assert steered((run, "follow_orifice"))["faults"] == {}
