"""Observer of contact forces: statics of a pressed beam, and the estimate on signals with known moments."""

import numpy as np
import pytest

from srs_twin import load_robot
from srs_twin.control.contact_observer import (
    LEARNING_S,
    SETTLING_S,
    ContactObserver,
    moment_patterns,
)
from srs_twin.pneumatics.chambers import air_bend

GEN2 = load_robot("gen2")
N, PITCH, SAMPLE_S, PERIOD = GEN2.segments, GEN2.geometry.pitch, 0.02, 25


def test_moments_of_a_force_vanish_at_both_ends_of_a_free_body():
    """A force on the first connector of a straight chain, against an independent sum over the connectors."""
    pattern = moment_patterns(GEN2, np.zeros(N), np.array([0.0]))[0]
    x = -PITCH * np.arange(N + 1)
    x = x - x.mean()
    mass, total = GEN2.mass.array(), GEN2.mass.total
    inertia = float(mass @ x**2 + GEN2.yaw_inertia().sum())
    acceleration = 1 / total + x * x[0] / inertia
    for j in range(N):
        cut = x[j] - PITCH / 2
        ahead = slice(0, j + 1)
        expected = (x[0] - cut) - (mass[ahead] * acceleration[ahead] * (x[ahead] - cut)).sum()
        expected -= GEN2.yaw_inertia()[ahead].sum() * x[0] / inertia
        assert pattern[j] == pytest.approx(expected, rel=1e-6)


def test_patterns_mirror_with_the_body():
    bend = np.array([0.5, -0.2, 0.4, 0.1])
    stations = np.linspace(0.0, GEN2.geometry.body_length, 9)
    pattern = moment_patterns(GEN2, bend, stations)
    np.testing.assert_allclose(moment_patterns(GEN2, -bend, stations), pattern, atol=1e-12)
    # A force to the left, seen from the other end, is a force to the right that bends the same way.
    turned = moment_patterns(GEN2, bend[::-1], GEN2.geometry.body_length - stations)
    np.testing.assert_allclose(turned[:, ::-1], pattern, atol=1e-6)


def observed(
    force: float,
    place: float,
    *,
    noise: float = 0.006,
    gains: float = 1.0,
    seconds: float = 14.0,
    lost: float = 0.0,
):
    """Return the estimates of a periodic gait with a static contact in its last 0.4 s."""
    rng, observer = np.random.default_rng(3), ContactObserver(GEN2, SAMPLE_S, PERIOD)
    results, seconds, noise = [], 14.0, 0.006
    for k in range(round(seconds / SAMPLE_S)):
        phase = 2 * np.pi * k / PERIOD - np.pi / 2 * np.arange(N)
        command = np.sign(np.stack([np.sin(phase), -np.sin(phase)], axis=-1) + 1e-9)
        pressure = 24000.0 * (1 + np.stack([np.sin(phase), -np.sin(phase)], axis=-1))
        bend = gains * air_bend(GEN2, pressure) + 0.1 * np.cos(3 * phase)
        if k * SAMPLE_S > seconds - 0.4:
            bend = bend + force * moment_patterns(GEN2, bend, np.array([place]))[0] / GEN2.bending.stiffness
        sensed = bend + noise * rng.standard_normal(N)
        if rng.uniform() < lost:
            observer.skip(1)
            continue
        results.append(observer.update(command, pressure, sensed))
    return results


@pytest.mark.parametrize("place", [0.3, 1.1, 2.0, 3.2])
@pytest.mark.parametrize("force", [-0.6, 0.6])
def test_force_and_place_of_a_static_contact_are_recovered_in_spite_of_wrong_gains(place, force):
    results = observed(force, place * PITCH, gains=1.2)
    assert all(result is None for result in results[: round((SETTLING_S + LEARNING_S) / SAMPLE_S) - 1])
    free = [result for result in results[:-22] if result is not None]
    assert free and not any(result.touched for result in free)
    last = results[-1]
    assert last.touched
    assert last.force == pytest.approx(force, rel=0.3)
    assert last.place == pytest.approx(place * PITCH, abs=0.5 * PITCH)
    assert last.force_interval[0] <= force <= last.force_interval[1]
    assert last.place_interval[0] <= place * PITCH <= last.place_interval[1]


def test_drifting_supply_is_no_contact():
    rng, observer = np.random.default_rng(3), ContactObserver(GEN2, SAMPLE_S, PERIOD)
    scores = []
    for k in range(900):
        phase = 2 * np.pi * k / PERIOD - np.pi / 2 * np.arange(N)
        command = np.sign(np.stack([np.sin(phase), -np.sin(phase)], axis=-1) + 1e-9)
        supply = 1.0 if k < 700 else 0.9
        pressure = supply * 24000.0 * (1 + np.stack([np.sin(phase), -np.sin(phase)], axis=-1))
        sensed = air_bend(GEN2, pressure) + 0.006 * rng.standard_normal(N)
        result = observer.update(command, pressure, sensed)
        scores.append(0.0 if result is None else result.score)
    assert max(scores) < 6.0


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


def test_missing_samples_do_not_shift_the_phase():
    results = observed(0.6, 2.0 * PITCH, lost=0.1)
    assert not any(result.touched for result in results[:-22] if result is not None)
    assert [result for result in results if result is not None][-1].touched
