"""Periodic commands, and calibrated intervals of predictions."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin.live.commands import SLOT_S, CommandHistory, CommandPeriod
from srs_twin.live.estimate import (
    IntervalCalibration,
    Prediction,
    PredictionCalibration,
)
from srs_twin.live.messages import COMMAND, VALVES, Message
from srs_twin.live.uncertain import Estimates


@pytest.mark.parametrize("seconds", [0.5, 1 / 1.5, 1.0])
def test_periodic_commands_are_repeated(seconds):
    period = CommandPeriod()
    times = SLOT_S * (np.arange(400) + 0.5)
    wave = (
        np.sin(
            2 * np.pi * (times / seconds)[:, None, None] + np.arange(8).reshape(4, 2)
        )
        > 0
    )
    for time, opens in zip(times[:300], wave[:300].astype(float), strict=True):
        period.add(time, opens)
    assert np.abs(period.commands(50) - wave[300:350]).mean() < 0.03


def test_without_a_period_the_last_command_is_kept():
    period = CommandPeriod()
    rng = np.random.default_rng(0)
    for k in range(300):
        last = rng.integers(0, 2, (4, 2)).astype(float)
        period.add(SLOT_S * (k + 0.5), last)
    assert (period.commands(10) == last).all()
    still = CommandPeriod()
    for k in range(300):
        still.add(SLOT_S * (k + 0.5), np.zeros((4, 2)))
    assert still.period() == 0


def valves(kind: str, sent: float, state: float) -> tuple[float, Message]:
    return sent, Message(kind, "r", sent, sent, np.full((1, 2), state))


def test_a_command_acts_after_half_a_tick_and_ends_after_a_fifth_of_a_second():
    history = CommandHistory(1)
    history.add(*valves(COMMAND, 1.0, 1.0))

    def duties(*times: float, waiting=()) -> list[float]:
        return history.at(np.array(times), waiting)[:, 0, 0].tolist()

    assert duties(0.9, 1.009, 1.011, 1.209, 1.211) == [0, 0, 1, 1, 0]
    assert duties(1.109, 1.111, waiting=[valves(COMMAND, 1.1, -1.0)]) == [1, 0]
    # Valve states are reported one tick of the robot after they begin.
    history.add(*valves(VALVES, 1.3, 1.0))
    assert duties(1.279, 1.281) == [0, 1]


def test_commands_count_as_lost_after_one_and_a_half_usual_intervals():
    history = CommandHistory(1)
    for sent in (0.0, 0.02, 0.04, 0.06, 0.08, 0.109):
        assert history.add(*valves(COMMAND, sent, -1.0)) is None
    lost = history.add(*valves(COMMAND, 0.14, 0.25))
    assert lost.interval == pytest.approx(0.031) and (lost.change == 0.25).all()


def test_errors_of_earlier_predictions_widen_intervals():
    """A model that is 10 % slow, with stated standard deviations of 1 mm."""
    rng = np.random.default_rng(2)
    calibration = PredictionCalibration()
    ahead = np.arange(1, 11) * 0.1
    pose = np.zeros(3)
    path = []
    predictions = []
    for k in range(3000):
        speed = 0.2 + 0.05 * np.sin(0.02 * k * 2 * np.pi)
        pose = pose + 0.02 * np.array(
            [speed * np.cos(pose[2]), speed * np.sin(pose[2]), 0.3]
        )
        path.append(pose)
        calibration.observe(0.02 * k, pose + 1e-3 * rng.normal(size=3))
        if k % 25 == 0:
            arc = pose[2] + 0.3 * ahead / 2
            step = 0.18 * ahead[:, None] * np.column_stack([np.cos(arc), np.sin(arc)])
            raw = np.column_stack([pose[:2] + step, pose[2] + 0.3 * ahead])
            raw = Prediction(
                0.02 * k, pose[2], 0.02 * k + ahead, raw, np.full((10, 3), 1e-3)
            )
            predictions.append((k, calibration.inflate(raw)))
    inside = []
    for k, prediction in predictions[10:-2]:
        true = np.array(path)[k + 5 * np.arange(1, 11)]
        assert prediction.pose_sd[-1, 0] < 0.06  # the error is 20 mm
        inside.append(prediction.contains(true))
    assert np.mean(inside) > 0.9


def test_intervals_cover_95_percent_along_and_across_the_heading():
    """A few percent more are allowed: standard deviations come from few predictions."""
    heading = 0.7
    sd = np.array([0.03, 0.01, 0.2])
    error = np.random.default_rng(5).normal(size=(20_000, 3)) * sd
    c = np.cos(heading)
    s = np.sin(heading)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    zeros = np.zeros((len(error), 3))
    count = np.zeros(len(error))
    predicted = Prediction(0.0, heading, count, zeros + [1.0, 2.0, 3.0], zeros + sd)
    poses = [1.0, 2.0, 3.0] + error @ turn
    assert np.abs(predicted.error(poses) - error).max() < 1e-12
    fraction = predicted.contains(poses).mean(axis=0)
    assert (fraction > 0.95).all() and (fraction < 0.975).all()


@pytest.mark.parametrize("rate", [5, 50])
def test_intervals_are_calibrated_for_errors_with_heavy_tails(rate):
    """Errors have a Student's t distribution and twice the stated standard deviation."""
    rng = np.random.default_rng(1)
    calibration = IntervalCalibration([4, 2])
    inside = []
    for k in range(60 * rate):
        time = k / rate
        error = 0.015 * rng.standard_t(4, size=6)
        calibration.predict(time, Estimates(error, np.full(6, 0.01)))
        inside.append(np.abs(error) < 1.96 * calibration.calibrated(np.full(6, 0.01)))
        exact = Estimates(np.zeros(6), np.full(6, 1e-3))
        calibration.update((k - 1) / rate, exact, [True, False])
    assert np.mean(inside[len(inside) // 2 :], axis=0)[:4].mean() == pytest.approx(
        0.95, abs=0.02
    )
    assert calibration.scale[4:] == pytest.approx(1.0)


def test_variance_added_since_the_last_measurement_is_not_scaled_down():
    """While only a tenth of the stated errors occurs, the scale sinks to its limit."""
    calibration = IntervalCalibration([2])
    values = np.zeros(2)
    for k in range(3000):
        calibration.predict(0.02 * k, Estimates(values, np.full(2, 0.03)))
        exact = Estimates(values, np.full(2, 1e-4))
        calibration.update(0.02 * (k - 1), exact, [True])
    scale = calibration.scale
    assert (scale < 0.4).all()
    assert calibration.calibrated(np.full(2, 0.03)) == pytest.approx(0.03 * scale)
    for k in range(3000, 3100):
        calibration.predict(0.02 * k, Estimates(values, np.full(2, 0.05)))
        calibration.update(0.02 * (k - 1), exact, [False])
    blind = np.hypot(0.03 * scale, 0.04)
    assert calibration.calibrated(np.full(2, 0.05)) == pytest.approx(blind)
