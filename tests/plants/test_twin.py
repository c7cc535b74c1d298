"""Twin: named accessors, samples within a tick, the same chambers as the other plant, invalid settings."""

from __future__ import annotations

import numpy as np
import pytest
from snakes import robot

from srs_twin import (
    AnalyticalSnake,
    Gait,
    InputError,
    PreloadedContact,
    TwinSnake,
    rollout,
)
from srs_twin.plants.twin.mjcf.model import ModelSettings

SPEC = robot()


def test_named_accessors_agree_with_mujoco_arrays():
    plant = TwinSnake(SPEC)
    rollout(plant, Gait(2.0, 0.2), 0.3)
    physics = plant.physics
    data = plant.physics.data
    for j in range(1, 5):
        hinges = [
            data.joint(f"hinge_{j}_{k}")
            for k in range(1, ModelSettings.hinges_per_segment + 1)
        ]
        angle = sum(hinge.qpos[0] for hinge in hinges)
        rate = sum(hinge.qvel[0] for hinge in hinges)
        assert physics.bend_angles()[j - 1] == pytest.approx(angle, abs=1e-12)
        assert physics.bend_rates()[j - 1] == pytest.approx(rate, abs=1e-9)
    for i in range(1, 6):
        assert physics.connector_positions()[i - 1] == pytest.approx(
            data.body(f"connector_{i}").xpos
        )
        frame = data.body(f"connector_{i}").xmat.reshape(3, 3)
        heading = physics.connector_headings()[i - 1]
        assert [np.cos(heading), np.sin(heading)] == pytest.approx(
            frame[:2, 0] / np.hypot(*frame[:2, 0])
        )
    assert physics.floor_forces().shape == (5, 2, 3)
    assert (physics.wheel_loads() == physics.floor_forces()[..., 2]).all()
    weights = physics.model.body_mass
    assert physics.center_of_mass() == pytest.approx(
        weights @ physics.data.xipos / weights.sum()
    )


def test_accessors_return_copies():
    physics = TwinSnake(SPEC).physics
    for accessor in (
        physics.bend_angles,
        physics.connector_positions,
        physics.center_of_mass,
    ):
        accessor()[:] = 9.0
        assert np.abs(accessor()).max() < 1.0


def test_samples_within_a_tick_belong_to_the_same_run():
    generator = np.random.default_rng(4)
    whole = TwinSnake(SPEC)
    parts = TwinSnake(SPEC)
    for _ in range(5):
        slots = np.repeat(generator.choice([-1, 1], size=(4, 4, 2)), 50, axis=0)
        end = whole.advance(slots, 1)
        samples = parts.advance(slots, 10)
        assert [s.time for s in samples] == pytest.approx(
            end[0].time - 0.002 * np.arange(9, -1, -1)
        )
        assert samples[-1].qpos == pytest.approx(end[0].qpos, abs=1e-9)


def test_both_plants_have_the_same_pressures_and_openings():
    twin, analytical = (
        rollout(build(SPEC), Gait(1.7, 0.3), 2.0, record_hz=10)
        for build in (TwinSnake, AnalyticalSnake)
    )
    for name in ("pressure_plus", "pressure_minus"):
        assert twin.stack(name) == pytest.approx(analytical.stack(name), abs=1e-6)
    openings = twin.metadata["valve_switches"]
    assert openings == analytical.metadata["valve_switches"]
    assert np.array(openings).min() >= 3


def test_invalid_settings_raise():
    with pytest.raises(
        InputError, match="wheels 'round' is unknown; allowed: rolling, skid"
    ):
        TwinSnake(SPEC, contact=PreloadedContact("round"))
    with pytest.raises(
        InputError, match=r"tick 0.02 s is not a multiple of time step 0.0015 s"
    ):
        TwinSnake(SPEC, timestep=0.0015)


@pytest.mark.parametrize("build", [AnalyticalSnake, TwinSnake])
def test_plants_refuse_to_return_no_samples(build):
    plant = build(SPEC)
    vented = np.full((4, 2), -1)
    schedule = plant.pneumatics.schedule(vented, 0.02)
    for advance, commands in ((plant.advance, vented), (plant.play, schedule)):
        with pytest.raises(InputError, match="`samples` 0 is not allowed; it must be"):
            advance(commands, 0)
