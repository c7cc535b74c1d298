"""The floor is homogeneous and isotropic: shifted, rotated and mirrored runs correspond."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from snakes import robot

from srs_twin import (
    AnalyticalSnake,
    Gait,
    LoadedContact,
    Plant,
    PreloadedContact,
    Trajectory,
    TwinSnake,
    rollout,
)

pytestmark = pytest.mark.default_cases(3)

PLANTS = {
    "axis": lambda: AnalyticalSnake(robot(), friction="axis"),
    "wheel": lambda: AnalyticalSnake(robot(), friction="wheel"),
    "ellipse": lambda: AnalyticalSnake(robot(), friction="ellipse"),
    "twin": lambda: TwinSnake(robot(), contact="preloaded"),
    "skids": lambda: TwinSnake(robot(), contact=PreloadedContact("skid")),
    "loaded": lambda: TwinSnake(robot(), contact="loaded"),
    "loaded ellipse": lambda: TwinSnake(robot(), contact=LoadedContact("ellipse")),
}
OFFSET = 0.2
# Stick-slip amplifies rounding: by 3e7 in 2 s if friction across is ten times that
# along.
ROUNDING = {"loaded ellipse": 1e-8}


@cache
def plant(name: str) -> Plant:
    return PLANTS[name]()


@cache
def turning(name: str) -> Trajectory:
    """Left turn from the origin, 2 s."""
    return rollout(plant(name), Gait(2.0, OFFSET), 2.0)


@pytest.mark.parametrize(
    "pose", [(0.0, 0.0, np.pi / 6), (0.3, -0.2, 0.0), (-1.0, 2.0, np.pi / 6)]
)
@pytest.mark.parametrize("name", PLANTS)
def test_trajectory_transforms_with_the_initial_pose(name, pose):
    x, y, angle = pose
    on_cpu = turning(name)
    on_device = rollout(plant(name), Gait(2.0, OFFSET), 2.0, pose=pose)
    c = np.cos(angle)
    s = np.sin(angle)
    turned = on_cpu.position @ np.array([[c, s], [-s, c]]) + [x, y]
    rounding = ROUNDING.get(name, 1e-9)
    assert np.abs(on_device.position - turned).max() < rounding
    assert np.abs(on_device["heading"] - on_cpu["heading"] - angle).max() < rounding
    assert np.abs(on_device.stack("bend") - on_cpu.stack("bend")).max() < rounding


@pytest.mark.parametrize("name", PLANTS)
def test_opposite_offset_and_half_period_mirror_the_path(name):
    left = turning(name)
    right = rollout(plant(name), Gait(2.0, -OFFSET, phase=np.pi), 2.0)
    # The same code runs with left and right exchanged: no more than rounding is allowed
    # to differ.
    assert np.abs(right.position - left.position * [1, -1]).max() < 1e-9
    assert np.abs(right["heading"] + left["heading"]).max() < 1e-9
    for plus, minus in (
        ("pressure_plus", "pressure_minus"),
        ("valve_plus", "valve_minus"),
    ):
        assert np.abs(right.stack(plus) - left.stack(minus)).max() < 1e-6


@pytest.mark.parametrize("name", PLANTS)
def test_forward_wave_drives_forward_and_positive_offset_turns_left(name):
    run = turning(name)
    ahead = run.com[-1] @ [np.cos(run["heading"].mean()), np.sin(run["heading"].mean())]
    assert ahead > 0.5 * run.time[-1] * 0.2  # half of gen2's 0.2 m/s
    period = 50
    assert run["heading"][-period:].mean() > run["heading"][:period].mean() + 0.1


@pytest.mark.parametrize("name", PLANTS)
def test_wave_from_tail_to_head_drives_backward(name):
    backward = rollout(plant(name), Gait(2.0, phase_step=-np.pi / 2), 2.0)
    assert backward["com_x"][-1] < -0.2
