"""Tasks Pegs and Grasp: rewards follow from the motion, observations from places; changed robot keys."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from test_gymnasium import named

from srs_twin.control.gait import Gait
from srs_twin.envs import make_task
from srs_twin.envs.contact import GRASP_FREQUENCY_HZ, HELD_S, HOLD, MAX_PHASE_STEP_RAD
from srs_twin.envs.gymnasium import SnakeEnv
from srs_twin.envs.policy import baseline, play_episode


def test_observed_posts_are_the_nearest_ones():
    env = SnakeEnv("Pegs")
    observation, info = env.reset(seed=4)
    values = named(env.task, observation)
    posts = env.episode.world.obstacles
    places = np.array(
        [(post.x - info["com_x_m"], post.y - info["com_y_m"]) for post in posts]
    )
    nearest = places[np.argsort(np.hypot(*places.T))[:4]]
    seen = [
        (values[f"peg_{k}_ahead_m"], values[f"peg_{k}_left_m"]) for k in range(1, 5)
    ]
    # The camera has 1 mm and 5 mrad of noise.
    assert np.array(sorted(map(tuple, nearest))) == pytest.approx(
        np.array(sorted(seen)), abs=0.006
    )
    assert not any(name.startswith("obstacle") for name in values)


def test_posts_leave_room_for_the_snake_at_the_start():
    for seed in range(4):
        episode = make_task("Pegs", limit_s=0.1).begin(np.random.default_rng(seed))
        assert not np.any(episode.state.obstacle_force)
        half = episode.twin.spec.geometry.width / 2
        assert min(abs(post.y) - post.radius for post in episode.world.obstacles) > half


def test_progress_among_posts_is_the_way_to_the_goal_and_contact_ends_nothing():
    env = SnakeEnv("Pegs", rewards={"touching_s": -0.5})
    observation, first = env.reset(seed=0)
    policy = baseline(env.task)
    total = 0.0
    touched = 0
    for _ in range(12):
        observation, reward, *_, info = env.step(policy(observation))
        total = total + reward
        touched = touched + info["touching"]
    away = math.hypot(
        info["goal_x_m"] - info["com_x_m"], info["goal_y_m"] - info["com_y_m"]
    )
    assert info["goal_distance_m"] == pytest.approx(away)
    assert total == pytest.approx(
        first["goal_distance_m"] - away - 0.05 * touched, abs=1e-9
    )
    assert touched and not info["ending"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "ending"), [("Pegs", "goal_reached"), ("Grasp", "dragged")]
)
def test_baseline_succeeds_and_resting_does_not(name, ending):
    task = make_task(name)
    score = play_episode(task, baseline(task), np.random.default_rng(0))
    assert score.ending == ending
    vented = task.from_physical([0.0, 0.0, 0.0, 1.2]) if name == "Grasp" else None
    if vented is not None:
        rest = play_episode(
            make_task(name, limit_s=2.0), lambda _: vented, np.random.default_rng(0)
        )
        assert rest.ending == "time_up" and abs(rest.reward) < 1e-3
        assert score.time > HELD_S and 1.2 < score.reward < 1.6


def test_the_grasping_policy_approaches_rests_and_closes():
    task = make_task("Grasp")
    policy = baseline(task)

    def action(ahead: float, left: float) -> list[float]:
        known = {"object_ahead_m": ahead, "object_left_m": left, "heading_cos": 1.0}
        seen = [known.get(signal.name, 0.0) for signal in task.observations]
        return task.to_physical(policy(np.array(seen)))

    short_waves = pytest.approx(2 * math.pi / 3)
    assert action(-0.184, -0.05) == [0.0, 1.0, 0.0, short_waves]
    for _ in range(4):  # 0.4 s
        assert action(-0.186, -0.05) == [0.0, 0.0, 0.0, short_waves]
    # The tail curls to the right within 1.5 s.
    for k in range(3):
        grip = pytest.approx(-k / 15, abs=1e-6)
        assert action(-0.2, -0.05) == [grip, 0.0, 0.0, pytest.approx(1.2)]


def test_a_grip_needs_forces_on_opposite_sides():
    episode = make_task("Grasp").begin(np.random.default_rng(0))

    def is_gripped(*forces: tuple[float, float]) -> bool:
        """Return the verdict on forces (size in N, direction in degrees) on the last connectors."""
        of_connectors = np.zeros_like(episode.state.obstacle_force)
        for k, (size, degrees) in enumerate(forces, start=1):
            angle = math.radians(degrees)
            of_connectors[-k] = size * math.cos(angle), size * math.sin(angle)
        episode.state = replace(episode.state, obstacle_force=of_connectors)
        return episode._is_gripped()

    assert not is_gripped()
    assert not is_gripped((1.0, 170.0))
    assert not is_gripped((1.0, 170.0), (2.0, -71.0))
    assert is_gripped((1.0, 170.0), (2.0, -69.0))
    assert is_gripped((1.0, 170.0), (2.0, 90.0), (3.0, -60.0))
    assert not is_gripped((1.0, 170.0), (0.019, -10.0))


def test_motion_in_the_grip_is_rewarded_and_ends_after_two_seconds():
    episode = make_task("Grasp").begin(np.random.default_rng(0))
    place = episode.twin.physics.data.qpos[-3:]
    none = np.zeros_like(episode.state.obstacle_force)
    opposite = none.copy()
    opposite[-1] = (1.0, 0.0)
    opposite[-2] = (-1.0, 0.0)

    def after_a_shift(
        force: np.ndarray, shift: float
    ) -> tuple[float, dict[str, float]]:
        """Return by how much farther the object is from its start, and the values of the reward."""
        before = episode._moved
        episode.state = replace(episode.state, obstacle_force=force)
        place[0] += shift
        values = episode._reward_values()
        return episode._moved - before, values

    moved, values = after_a_shift(none, 0.02)
    assert moved == pytest.approx(0.02) and values["progress_m"] == 0
    moved, values = after_a_shift(opposite, 0.02)
    assert moved == pytest.approx(0.02) and values["progress_m"] == pytest.approx(moved)
    # From here on the object is 0.3 m farther from its start.
    episode._item = replace(episode._item, x=episode._item.x - 0.3)
    for _ in range(18):
        assert after_a_shift(opposite, 0.0)[1]["dragged"] == 0 and not episode.ending
    assert (
        after_a_shift(opposite, 0.0)[1]["dragged"] == 1 and episode.ending == "dragged"
    )
    episode.ending = ""
    assert (
        after_a_shift(none, -0.9)[1]["object_lost"] == 1
        and episode.ending == "object_lost"
    )


def test_an_object_is_held_after_two_seconds_at_rest():
    episode = make_task("Grasp").begin(np.random.default_rng(0))
    steps = round(HELD_S / 0.1)
    places = np.full((40, HOLD), 0.05)
    episode._grips = list(places[: steps - 1])
    assert not episode._is_held()
    episode._grips = list(places[:steps])
    assert episode._is_held()
    places[20, 2] += 0.021
    episode._grips = list(places)
    assert not episode._is_held()
    episode._grips = list(places[:20])
    assert episode._is_held()


def test_object_is_observed_at_its_place():
    env = SnakeEnv("Grasp")
    observation, info = env.reset(seed=2)
    values = named(env.task, observation)
    item = env.episode._item
    assert (info["object_x_m"], info["object_y_m"]) == pytest.approx(
        (item.x, item.y), abs=1e-4
    )
    seen = (
        values["object_ahead_m"] + info["com_x_m"],
        values["object_left_m"] + info["com_y_m"],
    )
    assert seen == pytest.approx((item.x, item.y), abs=0.006)
    assert values["object_radius_m"] == pytest.approx(item.size[0])
    assert info["object_moved_m"] == pytest.approx(0.0, abs=1e-4) and not info["held"]


@pytest.mark.slow
def test_short_waves_pass_an_object_that_long_waves_push(monkeypatch):
    # The object stands near the head, so the whole body passes it.
    monkeypatch.setattr("srs_twin.envs.contact._AHEAD_M", (0.2, 0.3))
    task = make_task("Grasp")

    def distance_after_passing(phase_lag: float) -> float:
        """Return the distance by which a snake moves the object that it crawls past."""
        episode = task.begin(np.random.default_rng(1))
        action = task.from_physical([0.0, 1.0, 0.0, phase_lag])
        while not episode.ending:
            episode.step(action)
        assert episode.ending == "object_lost"
        return episode._moved

    assert distance_after_passing(MAX_PHASE_STEP_RAD) < 0.005
    assert distance_after_passing(1.2) > 0.01


def test_phase_lag_of_the_action_sets_the_wave():
    episode = make_task("Grasp").begin(np.random.default_rng(0))
    twin = episode.twin
    for phase_lag in (1.2, MAX_PHASE_STEP_RAD):
        time = episode._driven
        gait = Gait(GRASP_FREQUENCY_HZ, phase_step=phase_lag)
        gait.reset(twin.spec, twin.tick)
        valves = episode._valves([-0.6, 1.0, 0.0, phase_lag])
        expected = gait.valves_at(time)
        assert (valves[:, :-HOLD] == expected[:, :-HOLD]).all()
        # A negative grip bends to the right.
        assert (valves[:, -HOLD:, 0] == -1).all()
        assert (valves[:, -HOLD:, 1] == 1).mean() == pytest.approx(0.6)
        assert len({pulse.tobytes() for pulse in np.split(valves[:, -HOLD:], 5)}) == 1
    assert episode._driven == pytest.approx(0.2)
    assert (episode._valves([0.0, 0.5, 0.0, 1.2]) == -1).all()


def test_robots_may_have_changed_keys():
    stiff = {
        "base": "gen2",
        "bending": {"stiffness_nm_per_rad": 0.5},
        "modules": {"gain_spread": 0.2},
    }
    task = make_task("GoTo", robot=stiff)
    assert task.robot.bending.stiffness == 0.5
    drawn = [task.begin(np.random.default_rng(seed)).twin.spec for seed in range(2)]
    assert drawn[0] != drawn[1]
