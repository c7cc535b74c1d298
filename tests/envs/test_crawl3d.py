"""Crawl3D: gait of the controller, signals of both directions, refused robots, baseline."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_gymnasium import named

from srs_twin import Gait, TwinSnake, rollout
from srs_twin.control.gait import PitchWave
from srs_twin.envs import make_task
from srs_twin.envs.gymnasium import SnakeEnv
from srs_twin.envs.policy import Sidewinding, baseline, play_episode


@pytest.mark.slow
def test_constant_action_equals_a_rollout_of_the_sidewinding_gait():
    env = SnakeEnv("Crawl3D", limit_s=1.0)
    _, info = env.reset(seed=3)
    heading = info["heading_rad"]
    action = env.task.from_physical([0.1, 0.5, 20.0, 0.4, math.pi / 2])
    for _ in range(10):
        seen, _, _, _, info = env.step(action)
    offset, frequency, kpa, fraction, lag = env.task.to_physical(action)
    twin = TwinSnake(env.task.robot, supply_pa=1e3 * kpa, tick=0.1)
    gait = Gait(frequency, offset, pitch=PitchWave(fraction, lag))
    alone = rollout(twin, gait, 1.0, pose=(0.0, 0.0, heading), record_hz=10)
    assert info["com_x_m"] == pytest.approx(alone["com_x"][-1], abs=1e-6)
    assert info["com_y_m"] == pytest.approx(alone["com_y"][-1], abs=1e-6)
    by_name = named(env.task, seen)
    for name, column in (("bend", "bend"), ("pitch", "pitch")):
        readings = [by_name[f"{name}_{j}_rad"] for j in range(1, 9)]
        assert readings == pytest.approx(alone.stack(column)[-1], abs=1e-4)
        assert np.abs(readings).max() > 0.1


def mean_velocities(lag: float) -> tuple[float, float]:
    """Return the twin's mean velocity to the left (m/s) and yaw rate (rad/s) from 3 to 9 s."""
    task = make_task("Crawl3D")
    kpa = task.to_physical(np.ones(5))[2]
    twin = TwinSnake(task.robot, supply_pa=1e3 * kpa, tick=0.1)
    wave = PitchWave(Sidewinding.pitch_fraction, lag)
    run = rollout(twin, Gait(1.0, pitch=wave), 9.0, record_hz=10)
    begin, end = 30, 90
    turn = run["heading"][end] - run["heading"][begin]
    moved = (run["com_x"] + 1j * run["com_y"])[[begin, end]]
    # With constant velocities, the chord is parallel to the mean heading and shorter
    # than the arc.
    chord = (moved[1] - moved[0]) * np.exp(-1j * (run["heading"][begin] + turn / 2))
    return chord.imag / np.sinc(turn / 2 / np.pi) / 6.0, turn / 6.0


def test_the_baseline_chooses_the_gait_that_meets_the_goal():
    """A body with constant velocities moves on a circle, here for three seconds."""
    task = make_task("Crawl3D")
    for gait in Sidewinding._GAITS:
        goal = gait.left / gait.yaw_rate * (np.exp(3j * gait.yaw_rate) - 1)
        known = {"goal_ahead_m": goal.real, "goal_left_m": goal.imag}
        seen = [known.get(signal.name, 0.0) for signal in task.observations]
        action = task.to_physical(Sidewinding(task)(np.array(seen)))
        assert action == pytest.approx([0.0, 1.0, 28.98, 0.25, gait.lag], abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("gait", Sidewinding._GAITS)  # noqa: SLF001
def test_velocities_of_the_baseline_gaits_are_those_of_the_twin(gait):
    left, yaw_rate = mean_velocities(gait.lag)
    assert left == pytest.approx(gait.left, rel=0.1)
    assert yaw_rate == pytest.approx(gait.yaw_rate, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [7000, pytest.param(7001, marks=pytest.mark.slow)])
def test_the_baseline_reaches_the_goal_in_less_than_half_of_the_time(seed):
    task = make_task("Crawl3D")
    score = play_episode(task, baseline(task), np.random.default_rng(seed))
    assert score.ending == "goal_reached"
    assert score.time < 15.0
