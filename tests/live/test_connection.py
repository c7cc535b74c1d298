"""Local connection: laws of physics, and recovery of hidden parameters."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from live_runs import Run, followed_estimate
from subsets import first_by_default

from srs_twin import load_robot
from srs_twin.live.odometry import LocalConnection
from srs_twin.plants.analytical.kinematics import BodyParameters


def connection(robot="gen4"):
    spec = load_robot(robot)
    g = spec.geometry
    mass = BodyParameters.of(
        spec.mass.array(), spec.yaw_inertia(), g.segment_length, g.rigid_gap
    ).mass
    return LocalConnection(spec, mass)


def gait(steps, segments=4):
    time = np.linspace(0, 12 * np.pi, steps)
    return 0.5 * np.sin(time[:, None] - 1.1 * np.arange(segments)) + 0.15 * np.sin(
        time[:, None] / 5
    )


def test_who_bends_and_straightens_the_same_way_is_where_it_was():
    """Scallop theorem: without momentum, a shape change and its reverse cause no displacement."""
    known = connection()
    there = gait(40)
    bends = np.concatenate([there, there[-2::-1]])
    went = sum(known.matrix((a + b) / 2) @ (b - a) for a, b in pairwise(bends))
    assert np.abs(went).max() < 1e-12


def test_mirrored_bends_go_the_mirrored_way():
    known = connection()
    bends = gait(9)[4]
    left = known.matrix(bends)
    right = known.matrix(-bends)
    assert right == pytest.approx(left * [[-1.0], [1.0], [1.0]], abs=1e-5)


def test_what_a_robot_does_otherwise_is_found():
    known = connection()
    rng = np.random.default_rng(3)
    hidden = rng.normal(size=known.weights.shape) * 0.01
    bends = gait(3000)
    bends = bends + 0.2 * np.cumsum(rng.normal(size=bends.shape), axis=0) / np.sqrt(
        3000
    )
    for a, b in pairwise(bends):
        parts = known.features(a, b)
        known.learn(parts, parts @ hidden)
    new = gait(700) * 0.9
    parts = np.array([known.features(a, b) for a, b in pairwise(new)])
    apart = parts @ (known.weights - hidden)
    missed = parts @ hidden
    assert (
        np.abs(np.cumsum(apart, axis=0)).max()
        < 0.2 * np.abs(np.cumsum(missed, axis=0)).max()
    )


def test_a_robot_is_known_in_the_bends_in_which_it_was_seen():
    known = connection()
    bends = gait(600)
    rng = np.random.default_rng(1)
    draws = rng.normal(size=(200, *known.weights.shape))

    def unsure(change):
        return known.sample_model_error(known.features(*change), draws)[
            :, 2
        ].std() / np.linalg.norm(change[1] - change[0])

    seen = bends[30:32]
    other = np.array([np.full(4, 0.9), np.full(4, 1.0)])
    before = unsure(seen)
    for a, b in pairwise(bends):
        known.learn(known.features(a, b), rng.normal(size=3) * [1e-4, 1e-4, 1e-3])
    assert unsure(seen) < 0.5 * before
    assert unsure(other) > 3 * unsure(seen)


@pytest.mark.parametrize(
    "robot, frequency", first_by_default(1, [("gen2", 2.0), ("gen4", 1.5)])
)
@pytest.mark.slow
def test_bends_tell_for_ten_seconds_where_a_robot_goes(robot, frequency):
    found = followed_estimate(
        Run(2, 40.0, robot=robot, frequency=frequency, cameras_s=30.0)
    )
    truth = found["truth"]
    end = found["estimate"][-1]
    n = found["truth"].shape[1] - 4
    there = truth[:, 0] >= 30.0
    way = np.hypot(*np.diff(truth[there][:, n + 1 : n + 3], axis=0).T).sum()
    true = [np.interp(end[0], truth[:, 0], truth[:, n + k]) for k in (1, 2)]
    off = np.hypot(*(end[n + 1 : n + 3] - true))
    assert off < 0.07 * way
    assert off < 2.45 * np.hypot(*end[2 * n + 4 : 2 * n + 6])
