"""Leaks are detected from pressures, also for chambers with unknown volumes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from snakes import robot

from srs_twin.live.air_balance import (
    SCATTER,
    SCATTER_STROKES,
    LeakDetector,
    SupplyFilter,
)
from srs_twin.live.fault_hypotheses import Inflow
from srs_twin.live.uncertain import Estimates
from srs_twin.pneumatics import LagPneumatics, OrificePneumatics

TICK = 0.02
NOISE = 0.015
VARIANTS = [
    Inflow(leak, fraction)
    for leak, fraction in ((0.0, 1.0), (0.0, 0.0), (2.0, 1.0), (6.0, 1.0), (0.0, 0.5))
]
SOUND, CLOSED, SLOW, FAST, WEAK = range(5)


def stroked(chambers, spec, *, half=17, strokes=16, after=lambda: None, said=None):
    """Return the detector after several strokes, and the log-likelihoods of the last + strokes by variant."""
    rng = np.random.default_rng(4)
    said = said or spec
    detector = LeakDetector(said, supply_pa=said.supply.nominal, variants=VARIANTS)
    found = []
    sound = np.ones(spec.segments)
    supply = SupplyFilter(said.supply.nominal)
    supply.variance = (0.001 * said.supply.nominal) ** 2
    for k in range(2 * half * strokes):
        if k == 2 * half * (strokes - 3):
            after()
            sound = np.zeros(spec.segments)
        way = 1 if k // half % 2 == 0 else -1
        states = np.tile([way, -way], (spec.segments, 1))
        trace = chambers.advance(chambers.schedule(states, TICK), np.array([TICK]))
        filled = (k % half + 1) * TICK * (states == 1)
        bend = trace.bend[-1] + NOISE * rng.normal(size=spec.segments)
        added = detector.update(
            TICK * (k + 1),
            trace.pressure[-1],
            Estimates(bend, np.full_like(bend, NOISE)),
            filled,
            sound,
            supply,
        )
        found.append(added[:, 0])
    return detector, np.array(found)[-6 * half :].reshape(6, half, spec.segments, -1)[
        ::2
    ].sum(axis=1)


def chambers_of(spec, **settings):
    return OrificePneumatics(spec, supply_pa=spec.supply.nominal, **settings)


@pytest.mark.parametrize(
    ("name", "half"),
    [
        ("gen2", 17),
        pytest.param("gen3", 13, marks=pytest.mark.slow),
        pytest.param("gen4", 33, marks=pytest.mark.slow),
    ],
)
def test_leak_is_detected_within_one_stroke(name, half):
    spec = robot(name)
    for rate, variant in ((0.0, SOUND), (2.0, SLOW), (8.0, FAST)):
        chambers = chambers_of(spec)
        _, found = stroked(
            chambers, spec, half=half, after=lambda c=chambers, r=rate: c.leak(2, 0, r)
        )
        first = found[0]
        # A weak supply affects all segments, so it is not compared here.
        assert first[1, :WEAK].argmax() == variant, (name, rate)
        if rate:
            assert first[1, variant] > first[1, SOUND] + 8
        others = np.delete(first, 1, axis=0)
        assert (others.argmax(axis=1) == SOUND).all()


@pytest.mark.slow
def test_unknown_chamber_volumes_are_learnt():
    said = robot("gen4")
    other = replace(
        said.chamber,
        dead_volume=1.5 * said.chamber.dead_volume,
        displacement=0.8 * said.chamber.displacement,
    )
    true = replace(said, chamber=other)
    for given in ({}, {"critical_ratio": 0.5}):
        chambers = chambers_of(true, **given)
        detector, found = stroked(
            chambers, true, said=said, after=lambda c=chambers: c.leak(1, 0, 2.0)
        )
        assert found[0, 0, :WEAK].argmax() == SLOW
        assert (found[0, 1:].argmax(axis=1) == SOUND).all()
        assert np.abs(detector.fit[..., 1]).max() < 0.5, "apparent loss"


def test_chamber_that_fills_half_as_fast_does_not_seem_to_leak_before_it_is_learnt():
    said = robot("gen4")
    true = replace(
        said, actuator=replace(said.actuator, tau_fill=2 * said.actuator.tau_fill)
    )
    _, found = stroked(
        chambers_of(true), true, said=said, strokes=3
    )  # without learning
    assert (found[0, :, [SLOW, FAST]].max(axis=0) - found[0, :, SOUND] < 1.5).all()


def test_first_order_chambers_have_no_leak():
    spec = robot("gen4")
    _, found = stroked(LagPneumatics(spec, supply_pa=spec.supply.nominal), spec)
    assert (found.argmax(axis=-1) == SOUND).all()


def test_weak_supply_is_not_a_leak():
    spec = robot("gen4")
    chambers = chambers_of(spec)
    _, found = stroked(
        chambers,
        spec,
        after=lambda: chambers.set_supply_pressure(0.5 * spec.supply.nominal),
    )
    assert (found.argmax(axis=-1) == WEAK).all()


def test_unknown_initial_supply_does_not_increase_the_scatter():
    spec = robot("gen4")
    true = replace(
        spec, supply=replace(spec.supply, nominal=0.85 * spec.supply.nominal)
    )
    detector, _ = stroked(
        chambers_of(true), true, said=spec, strokes=2 * SCATTER_STROKES
    )
    assert (detector.learnt > 0).all() and (detector.scatter <= SCATTER**2).all()


def test_the_derivative_is_that_of_the_expected_inflow():
    spec = robot("gen4")
    found = []
    for change in (0.0, 100.0):
        detector = LeakDetector(spec, supply_pa=60e3, variants=VARIANTS)
        supply = SupplyFilter(60e3)
        supply.pressure += change
        for k in range(12):
            pressure = np.full((spec.segments, 2), 1e3 * k)
            filled = np.full_like(pressure, TICK * (k + 1))
            arguments = TICK * k, pressure, Estimates(*np.zeros((2, 4))), filled
            balance = detector.residuals(*arguments[:2], filled)
            detector.update(*arguments, np.ones(4), supply)
        found.append(balance)
    change = found[1].residual - found[0].residual
    assert change == pytest.approx(-100.0 * found[0].derivative, rel=1e-3)
