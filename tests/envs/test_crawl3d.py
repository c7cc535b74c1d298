"""Crawl3D: the gait of the controller, signals of both directions, refused robots."""

from __future__ import annotations

import math

import numpy as np
import pytest

from srs_twin import Gait, InputError, TwinSnake, rollout
from srs_twin.control.gait import PitchWave
from srs_twin.envs import make_task
from srs_twin.envs.gymnasium import SnakeEnv


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
    by_name = dict(zip((s.name for s in env.task.observations), seen, strict=True))
    for name, column in (("bend", "bend"), ("pitch", "pitch")):
        readings = [by_name[f"{name}_{j}_rad"] for j in range(1, 9)]
        assert readings == pytest.approx(alone.stack(column)[-1], abs=1e-4)
        assert np.abs(readings).max() > 0.1


def test_tasks_refuse_robots_of_the_other_kind():
    with pytest.raises(
        InputError, match="other than Crawl3D does not support the spatial robot"
    ):
        make_task("GoTo", robot="spatial_example")
    with pytest.raises(InputError, match="robot 'skin_example' bends in one plane"):
        make_task("Crawl3D", robot="skin_example")
