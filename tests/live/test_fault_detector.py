"""Errors of bend sensors, and a weak supply, of a robot that publishes no pressures."""

from __future__ import annotations

import numpy as np
import pytest
from snakes import robot

from srs_twin.live.fault_detector import FaultDetector
from srs_twin.pneumatics import LagPneumatics, OrificePneumatics
from srs_twin.pneumatics.valves import StuckValve

TICK = 0.02
HALF = 17
NOISE = 0.02
OFFSET, SCALE, DRIFT = np.array(
    [[0.06, -0.05, 0.0, 0.03], [0.05, -0.05, 0.08, 0.0], [6e-4, 0.0, -6e-4, 3e-4]]
)


def walked(
    seconds,
    fault=lambda time, readings: readings,
    supply=lambda time: 1.0,
    stuck=None,
):
    """Return a detector after a walk, the last readings of poor sensors and the bends.

    If a valve sticks, pressures of compressible air are measured as well.
    """
    spec = robot("gen4")
    rng = np.random.default_rng(2)
    kind = LagPneumatics if stuck is None else OrificePneumatics
    chambers = kind(spec, supply_pa=spec.supply.nominal)
    chambers.stuck = (stuck,) if stuck is not None else ()
    detector = FaultDetector(spec, supply_pa=spec.supply.nominal)
    for k in range(round(seconds / TICK)):
        way = 1 if k // HALF % 2 == 0 else -1
        states = np.tile([way, -way], (spec.segments, 1))
        chambers.set_supply_pressure(supply(k * TICK) * spec.supply.nominal)
        trace = chambers.advance(chambers.schedule(states, TICK), np.array([TICK]))
        bend = trace.bend[-1]
        detector.predict((states + 1) / 2, TICK)
        error = OFFSET + DRIFT * k * TICK + NOISE * rng.normal(size=bend.shape)
        readings = fault(k * TICK, (1 + SCALE) * bend + error)
        detector.update(readings)
        if stuck is not None:
            detector.update(pressures=trace.pressure[-1])
        if k % 2 == 0:
            detector.update(markers=bend + NOISE * rng.normal(size=bend.shape))
    return detector, readings, bend


def silent(time, readings):
    return np.where(np.arange(4) == 2, np.nan, readings) if time > 2.5 else readings


def frozen(time, readings):
    return np.where(np.arange(4) == 2, 0.2, readings) if time > 2.5 else readings


@pytest.mark.parametrize(
    ("sensor", "side", "state", "named"),
    [
        (silent, 0, -1, {1: "stuck_valve +=closed", 3: "dead_sensor"}),
        (frozen, 1, 1, {1: "stuck_valve -=open", 3: "dead_sensor frozen"}),
    ],
)
def test_a_dead_sensor_and_a_stuck_valve_are_told_apart(sensor, side, state, named):
    detector, *_ = walked(4.5, sensor, stuck=StuckValve(1, side, state, 2.5))
    assert detector.detected_faults == named
    assert detector.probability[[1, 3], 0].min() > 0.9


@pytest.mark.slow
def test_poor_sensors_are_corrected_and_are_no_fault():
    detector, readings, bend = walked(15.0)
    assert detector.detected_faults == {}
    corrected, sd = detector.corrected(readings)
    assert (sd < NOISE).all()
    # Five standard deviations of the correction and of one reading.
    assert corrected == pytest.approx(bend, abs=5 * np.hypot(sd, NOISE).max())
    constant, _ = detector.corrected(OFFSET + DRIFT * 15.0)
    assert np.abs(constant).max() < 3 * sd.max()


def test_drift_of_a_poor_sensor_is_a_fault():
    def drifting(time, readings):
        return readings + np.array([0.0, 0.1, 0.0, 0.0]) * max(time - 6.0, 0.0)

    detector, readings, bend = walked(8.5, drifting)
    assert detector.detected_faults == {2: "drifting_sensor"}
    corrected, sd = detector.corrected(readings)
    allowed = 5 * np.hypot(sd, NOISE)
    assert (np.abs(corrected - bend) < allowed)[[0, 2, 3]].all()


@pytest.mark.slow
def test_half_of_the_supply_is_reported_without_pressures():
    detector, *_ = walked(8.5, supply=lambda time: 1.0 if time < 6.0 else 0.5)
    assert detector.detected_faults == {0: "low_supply_pressure"}


def test_missing_pressures_are_no_evidence():
    detector, *_ = walked(3.0)
    before = detector.probability.copy()
    for _ in range(50):
        detector.update(pressures=np.full((4, 2), np.nan))
    assert detector.probability == pytest.approx(before, abs=1e-9)
