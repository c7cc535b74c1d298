"""Baseline policies of the environments."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from srs_twin.envs import make_task
from srs_twin.envs.gymnasium import SnakeEnv
from srs_twin.envs.policy import PathFollowing, ProportionalIntegral, play_episode


@pytest.mark.slow
@pytest.mark.parametrize(("task", "seed"), [("GoTo", 1), ("Obstacles", 0)])
def test_path_following_reaches_the_goal(task, seed):
    instance = make_task(task)
    score = play_episode(instance, PathFollowing(instance), np.random.default_rng(seed))
    assert score.ending == "goal_reached"
    straight = play_episode(
        instance,
        lambda _: np.array([0.0, 2.0, 48.3], dtype=np.float32),
        np.random.default_rng(seed),
    )
    assert straight.ending != "goal_reached" and straight.reward < score.reward


def test_rows_of_circles_have_one_gate_each():
    task = make_task("Obstacles")
    width = task.robot.geometry.width
    gates = set()
    for seed in range(40):
        world, *_ = task._draw_world(np.random.default_rng(seed))
        for x in task.arena.rows:
            row = sorted(
                (c for c in world.obstacles if c.x == x), key=lambda circle: circle.y
            )
            gaps = np.array([b.y - b.radius - a.y - a.radius for a, b in pairwise(row)])
            gate = int(np.argmax(gaps))
            gates.add((x, gate))
            assert 0.32 <= gaps[gate] <= 0.36 and np.delete(gaps, gate).max() < 0.061
            # Nothing passes beyond the ends of a row, because the room is narrower.
            edges = row[0].y - row[0].radius, row[-1].y + row[-1].radius
            assert (
                edges[0] < world.bounds.y[0] - width
                and edges[1] > world.bounds.y[1] + width
            )
    assert len(gates) == 8, "four sites in each row"


@pytest.mark.parametrize(
    ("name", "distances", "bearing"),
    [
        ("GoTo", (0.6, 1.5), np.pi / 2),
        ("Obstacles", (2.5, 2.7), 0.1),
        ("Pegs", (0.8, 1.0), np.pi),
        ("Crawl3D", (0.4, 1.0), np.pi),
    ],
)
def test_goals_are_drawn_uniformly_from_a_sector(name, distances, bearing):
    task = make_task(name)
    rng = np.random.default_rng(1)
    worlds, headings, _ = zip(*(task._draw_world(rng) for _ in range(200)), strict=True)
    goals = np.array([complex(world.goal.x, world.goal.y) for world in worlds])
    bearings = np.angle(goals * np.exp(-1j * np.array(headings)))
    for values, limits in ((abs(goals), distances), (bearings, (-bearing, bearing))):
        counts, _ = np.histogram(values, bins=4, range=limits)
        assert counts.sum() == 200 and counts.min() > 30


def test_contact_with_a_circle_ends_the_episode():
    task = make_task("Obstacles")
    episode = task.begin(np.random.default_rng(0))
    circle = min(episode.world.obstacles, key=lambda item: abs(item.y))
    half = episode.twin.spec.geometry.body_length / 2
    place = np.array([circle.x - circle.radius - half - 0.05, circle.y])
    episode.set_state(
        replace(episode.state, com=place, heading=0.0, connector_heading=np.zeros(5))
    )
    total = 0.0
    while not episode.ending:
        result = episode.step(task.from_physical([0.0, 2.0, 55.0]))
        total += result.info["reward_progress_m"]
    assert (
        episode.ending == "collided" and result.terminated and result.info["touching"]
    )
    assert result.reward == pytest.approx(result.info["reward_progress_m"] - 1)
    assert total < 0.3


def test_pi_control_tracks_better_than_constant_duties():
    instance = make_task("Module")
    tracked = play_episode(
        instance, ProportionalIntegral(instance), np.random.default_rng(0)
    )
    resting = play_episode(
        instance, lambda _: np.full(2, 0.5, dtype=np.float32), np.random.default_rng(0)
    )
    assert tracked.ending == resting.ending == "time_up"
    assert 3 * abs(tracked.reward) < abs(resting.reward)


def test_reward_and_signals_of_a_module_are_those_of_its_state():
    env = SnakeEnv("Module")
    first, before = env.reset(seed=0)
    seen, reward, *_, after = env.step(env.task.from_physical([1.0, 0.25]))
    error = abs(before["reference_rad"] - after["bend_rad"])
    assert error > 0.01 and reward == pytest.approx(-0.05 * error)
    _, before, reference, *command = seen.tolist()
    assert before == first[0] and command == [1.0, 0.25]
    assert reference == pytest.approx(after["reference_rad"])
    assert after["pressure_plus_pa"] > 2 * after["pressure_minus_pa"] > 100.0
