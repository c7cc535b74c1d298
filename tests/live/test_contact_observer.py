"""Observer of contact forces: estimates on signals with known moments, and on a twin that is pressed."""

import numpy as np
import pytest
from helpers.scaled_robots import scaled

from srs_twin import Gait, TwinSnake, load_robot
from srs_twin.live.contact_observer import LEARNING_S, SETTLING_S, ContactObserver
from srs_twin.live.pushed_body import PushedBody
from srs_twin.pneumatics.chambers import air_bend

GEN2 = load_robot("gen2")
N = GEN2.segments
PITCH = GEN2.geometry.pitch
SAMPLE_S = 0.02
PERIOD = 25


def gait_sample(k, supply=1.0):
    """Return commands and pressures (Pa) of a travelling wave."""
    phase = 2 * np.pi * k / PERIOD - np.pi / 2 * np.arange(N)
    wave = np.stack([np.sin(phase), -np.sin(phase)], axis=-1)
    return np.sign(wave + 1e-9), supply * 24000.0 * (1 + wave), 0.1 * np.cos(3 * phase)


def observed(force, place, *, gains=1.0, lost=0.0, scale=1.0):
    """Return the estimates of a periodic gait with a contact in the last 0.4 s of 14 s.

    Args:
        force: N for the unscaled robot.
        place: segments.
        gains: gain of the chambers over the nominal one.
        lost: share of lost samples.
        scale: factor on all lengths of the robot.
    """
    spec = GEN2 if scale == 1.0 else scaled(GEN2, scale)
    sample = SAMPLE_S * np.sqrt(scale)
    rng = np.random.default_rng(3)
    observer = ContactObserver(spec, sample, PERIOD)
    count = 700
    touch = 680
    results = []

    def bend(k):
        _, pressure, extra = gait_sample(k)
        return gains * air_bend(GEN2, pressure) + extra

    body = PushedBody(
        spec,
        np.array([bend(k) for k in range(PERIOD)]),
        sample,
        np.array([place]) * spec.geometry.pitch,
    )
    u = body.free_velocity[(touch - 1) % PERIOD][None]
    for k in range(count):
        command, pressure, _ = gait_sample(k)
        measured_bend = bend(k) + 0.006 * rng.standard_normal(N)
        if k >= touch:
            u, moment = body.step(k, u, np.array([force * scale**3]), np.array([0]))
            measured_bend += (
                moment[0] - body.free_moment[k % PERIOD]
            ) / spec.bending.stiffness
        if rng.uniform() < lost:
            observer.skip(1)
            continue
        pressure = pressure * GEN2.actuator.gain / spec.actuator.gain
        results.append(observer.update(command, pressure, measured_bend))
    return results


@pytest.mark.slow
def test_estimates_scale_with_the_robot():
    """A robot of four times the size has two times the times, and 64 times the forces."""
    last = observed(0.6, 2.2)[-1]
    large = observed(0.6, 2.2, scale=4.0)[-1]
    assert large.score == pytest.approx(last.score, rel=1e-6)
    assert large.force == pytest.approx(64 * last.force, rel=1e-6)
    assert large.place == pytest.approx(4 * last.place)


@pytest.mark.slow
@pytest.mark.parametrize("chambers", ["lag", "orifice"])
def test_pressed_twin_is_detected_with_force_and_place(chambers):
    """The reference is another plant: hinges, spinning wheels and instantaneous loads of the twin."""
    twin = TwinSnake(GEN2, pneumatics=chambers)
    gait = Gait(2.0)
    force = 0.7
    place = 2.0 * PITCH
    observer = ContactObserver(GEN2, SAMPLE_S, PERIOD)
    gait.reset(GEN2, twin.tick)
    state = twin.reset()
    data = twin.physics.data
    rng = np.random.default_rng(1)
    connector = data.body("connector_3")
    for k in range(630):
        left = connector.xmat.reshape(3, 3)[:, 1]
        data.xfrc_applied[connector.id, :3] = force * left if k >= 612 else 0.0
        valves = gait.step(state)
        state = twin.step(valves)
        command = np.reshape(valves, (-1, N, 2)).mean(axis=0)
        estimate = observer.update(
            command, state.pressure, state.bend + 0.006 * rng.standard_normal(N)
        )
    assert estimate.touched
    assert abs(estimate.force) == pytest.approx(force, rel=0.25)
    assert estimate.force_interval[0] <= force <= estimate.force_interval[1]
    assert estimate.place_interval[0] <= place <= estimate.place_interval[1]


def test_drifting_supply_is_no_contact():
    rng = np.random.default_rng(3)
    observer = ContactObserver(GEN2, SAMPLE_S, PERIOD)
    scores = []
    for k in range(900):
        command, pressure, _ = gait_sample(k, supply=1.0 if k < 700 else 0.9)
        measured_bend = air_bend(GEN2, pressure) + 0.006 * rng.standard_normal(N)
        result = observer.update(command, pressure, measured_bend)
        scores.append(0.0 if result is None else result.score)
    assert max(scores) < 6.0
    assert not any(scores[: round((SETTLING_S + LEARNING_S) / SAMPLE_S) - 1])


def test_another_gait_is_learnt_again():
    observer = ContactObserver(GEN2, SAMPLE_S, PERIOD)
    still = np.zeros((N, 2))
    for k in range(700):
        command = np.full((N, 2), 1.0 if k % PERIOD < 12 else -1.0)
        result = observer.update(command, still, np.zeros(N))
    assert result is not None
    for k in range(700, 750):
        command = np.full((N, 2), -1.0 if k % PERIOD < 12 else 1.0)
        result = observer.update(command, still, np.zeros(N))
    assert result is None
    assert observer.period == PERIOD


@pytest.mark.parametrize("period", [PERIOD, 600])
def test_estimates_begin_after_the_noise_has_been_measured(period):
    """Messages are missing while the observer learns, or a period is longer than the time for learning."""
    rng = np.random.default_rng(3)
    observer = ContactObserver(GEN2, SAMPLE_S, period)
    scores = []
    for k in range(1500):
        if 123 < k < 700 and period == PERIOD:
            observer.skip(1)
            continue
        command, pressure, _ = gait_sample(k)
        estimate = observer.update(
            command, pressure, air_bend(GEN2, pressure) + 0.006 * rng.normal(size=N)
        )
        scores += [estimate.score] if estimate is not None else []
    assert len(scores) > 100
    assert np.isfinite(scores).all() and max(scores) < 6.0


@pytest.mark.parametrize(
    ("force", "place", "conditions"),
    [(0.6, 2.0, {"lost": 0.1}), (-0.6, 0.3, {"gains": 1.2})],
)
def test_force_and_place_of_a_contact_are_recovered(force, place, conditions):
    """Missing samples do not shift the phase, and gains may be wrong."""
    results = observed(force, place, **conditions)
    *free, last = [result for result in results if result is not None]
    assert all(np.isnan(result.force) and not result.touched for result in free[:-21])
    assert last.touched
    assert last.force == pytest.approx(force, rel=0.2)
    assert last.place == pytest.approx(place * PITCH, abs=0.3 * PITCH)
    assert last.force_interval[0] <= force <= last.force_interval[1]
    assert last.place_interval[0] <= place * PITCH <= last.place_interval[1]
