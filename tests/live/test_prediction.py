"""Commands that go on in their rhythm, and intervals that earlier predictions have told."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin.live.prediction import SLOT_S, Hindsight, Prediction, Rhythm


@pytest.mark.parametrize("period", [0.5, 1 / 1.5, 1.0])
def test_a_rhythm_goes_on(period):
    rhythm, times = Rhythm(), SLOT_S * (np.arange(400) + 0.5)
    wave = np.sin(2 * np.pi * (times / period)[:, None, None] + np.arange(8).reshape(4, 2)) > 0
    for time, opens in zip(times[:300], wave[:300].astype(float), strict=True):
        rhythm.take(time, opens)
    assert np.abs(rhythm.commands(50) - wave[300:350]).mean() < 0.03


def test_without_a_rhythm_the_last_command_holds():
    rhythm, rng = Rhythm(), np.random.default_rng(0)
    for k in range(300):
        last = rng.integers(0, 2, (4, 2)).astype(float)
        rhythm.take(SLOT_S * (k + 0.5), last)
    assert (rhythm.commands(10) == last).all()
    still = Rhythm()
    for k in range(300):
        still.take(SLOT_S * (k + 0.5), np.zeros((4, 2)))
    assert still.period() == 0


def test_hindsight_takes_out_what_predictions_miss_and_covers_the_rest():
    """A model that is 40 % slow, along whatever heading, with noise."""
    rng, rhythm = np.random.default_rng(2), Rhythm()
    hindsight = Hindsight(rhythm)
    commands = np.zeros((50, 4, 2))
    ahead = np.arange(1, 11) * 0.1
    pose, inside, off, told = np.zeros(3), [], [], []
    path = []
    for k in range(3000):
        speed = 0.2 + 0.05 * np.sin(0.02 * k * 2 * np.pi)
        pose = pose + 0.02 * np.array([speed * np.cos(pose[2]), speed * np.sin(pose[2]), 0.3])
        path.append(pose)
        rhythm.take(0.02 * k - 0.01, commands[0])
        hindsight.see(0.02 * k, pose + 1e-3 * rng.normal(size=3))
        if k % 25 == 0:
            forth = 0.12 * ahead
            c, s = np.cos(pose[2]), np.sin(pose[2])
            raw = np.column_stack([pose[0] + c * forth, pose[1] + s * forth, pose[2] + 0.3 * ahead])
            sd = np.full((10, 3), 1e-3)
            begun = Prediction(0.02 * k, pose[2], commands, 0.02 * k + ahead, raw, sd)
            told.append((k, hindsight.corrected(begun)))
    for k, each in told[10:-2]:
        true = np.array(path)[k + 5 * np.arange(1, 11)]
        off.append(each.off(true))
        inside.append(each.covers(true))
    assert np.abs(np.array(off)[:, -1, 0]).mean() < 0.02  # 80 mm without
    assert np.mean(inside) > 0.9


@pytest.mark.parametrize("came", [True, False])
def test_hindsight_learns_from_commands_that_came_true(came):
    """A robot that goes 0.1 m in a second where nothing was predicted, as was commanded or as was not."""
    rhythm = Rhythm()
    hindsight, ahead = Hindsight(rhythm), np.arange(1, 11) * 0.1
    still = Prediction(
        0.99, 0.0, np.zeros((50, 4, 2)), 0.99 + ahead, np.zeros((10, 3)), np.full((10, 3), 0.01)
    )
    for k in range(150):
        if k == 50:
            hindsight.corrected(still)
        rhythm.take(SLOT_S * (k + 0.5), np.full((4, 2), 0.0 if came or k < 50 else 1.0))
        hindsight.see(SLOT_S * k, np.array([0.1 * (SLOT_S * k - 0.99), 0.0, 0.0]))
    assert hindsight.corrected(still).pose[-1, 0] == pytest.approx(0.1 if came else 0.0, abs=1e-3)


def test_intervals_cover_95_percent_along_and_across_the_heading():
    """A few percent more are allowed: standard deviations come from few predictions."""
    heading, sd = 0.7, np.array([0.03, 0.01, 0.2])
    error = np.random.default_rng(5).normal(size=(20_000, 3)) * sd
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    zeros, count = np.zeros((len(error), 3)), np.zeros(len(error))
    predicted = Prediction(0.0, heading, np.zeros((50, 4, 2)), count, zeros + [1.0, 2.0, 3.0], zeros + sd)
    poses = [1.0, 2.0, 3.0] + error @ turn
    assert np.abs(predicted.off(poses) - error).max() < 1e-12
    share = predicted.covers(poses).mean(axis=0)
    assert (share > 0.95).all() and (share < 0.975).all()
