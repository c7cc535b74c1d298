"""The floor of a recording is levelled where its tilt is certain, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import Snake

from srs_twin.recordings.body.floor import map_to_floor

LIFTS = (0.0, 0.3e-3, 1e-3, 3e-3)
NOISE = 2e-4


def take(seed, tilt_deg, lift, in_step, turning=True):
    """Return markers of a snake whose connectors lift by an amplitude `lift` (m), and its true tilt.

    In step, the lift of a connector is proportional to its displacement across the
    path.
    """
    random = np.random.default_rng(seed)
    yaw_rate = random.uniform(0.15, 0.5) * random.choice([-1, 1]) if turning else 0.0
    snake = Snake(
        speed=random.uniform(0.08, 0.25),
        yaw_rate=yaw_rate,
        frequency=random.uniform(0.5, 2.0),
        amplitude=random.uniform(0.5, 0.9),
        duration=random.uniform(6.0, 12.0),
        record_hz=50.0,
    )
    truth = snake.trajectory()
    heading = np.unwrap(yaw_rate * truth.time)[:, None]
    relative = truth.position - truth.com[:, None]
    across = relative[..., 1] * np.cos(heading) - relative[..., 0] * np.sin(heading)
    wave = across / np.abs(across).max()
    if not in_step:
        # At half the gait frequency, with a phase of its own for each connector.
        phase = random.uniform(0, 2 * np.pi, truth.position.shape[1])
        wave = np.sin(np.pi * snake.frequency * truth.time[:, None] + phase)
    height = 0.03 + lift * wave
    points = np.concatenate([truth.position, height[..., None]], axis=-1)
    points += NOISE * random.standard_normal(points.shape)
    direction = random.uniform(0, 2 * np.pi)
    axis = np.radians(tilt_deg) * np.array([np.cos(direction), np.sin(direction), 0.0])
    spin = Rotation.from_euler("z", random.uniform(0, 2 * np.pi))
    return (
        (Rotation.from_rotvec(axis) * spin)
        .apply(points.reshape(-1, 3))
        .reshape(points.shape)
    )


def outcome(points):
    """Return "levelled", "noted" or "level" for the default treatment."""
    notes = map_to_floor(points + [0.0, 0.0, 1.0], "auto", "z").corrections
    if any(note.startswith("the floor was levelled by") for note in notes):
        return "levelled"
    return "noted" if any("was not removed" in note for note in notes) else "level"


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("lift", LIFTS)
@pytest.mark.parametrize("in_step", [True, False])
def test_level_takes_are_never_levelled(lift, in_step):
    seeds = range(100, 105)
    found = [outcome(take(seed, 0.0, lift, in_step, seed % 2 == 0)) for seed in seeds]
    assert "levelled" not in found


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("lift", LIFTS)
def test_tilted_takes_of_a_turning_snake_are_levelled(lift):
    random = np.random.default_rng(1)
    found = [
        outcome(take(seed, random.uniform(5, 12), lift, False))
        for seed in range(200, 210)
    ]
    assert found.count("levelled") >= 9
    assert "level" not in found


def test_lift_in_step_on_a_tilted_floor_is_levelled_or_noted():
    random = np.random.default_rng(2)
    found = [
        outcome(take(seed, random.uniform(5, 12), 1e-3, True, False))
        for seed in range(300, 310)
    ]
    assert "level" not in found


def test_a_map_decides_about_levelling():
    points = take(400, 8.0, 1e-3, in_step=True, turning=False) + [0.0, 0.0, 1.0]
    for up in ("auto", "z"):
        levelled = map_to_floor(points, up, "z", level=True)
        kept = map_to_floor(points, up, "z", level=False)
        assert any(
            note.startswith("the floor was levelled by")
            for note in levelled.corrections
        )
        assert not any("level" in note for note in kept.corrections)
        spread = [
            np.ptp(np.median(each.points[..., 2], axis=1)) for each in (levelled, kept)
        ]
        assert spread[0] < spread[1] / 5
