"""Without friction, momentum and moment of momentum stay constant."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from snakes import chain, robot, throw, vented

from srs_twin import AnalyticalSnake, Gait, PreloadedContact, TwinSnake, rollout

SLIPPERY = robot(mu_t=0.0, mu_n=0.0)


@pytest.mark.parametrize("friction_law", ["axis", "wheel", "viscous"])
def test_analytical_model_coasts_without_friction(friction_law):
    plant = AnalyticalSnake(SLIPPERY, friction=friction_law)
    throw(plant, (0.3, -0.2), spin=2.0, heading=0.4)
    for _ in range(50):
        state = plant.step(vented(SLIPPERY))
    assert state.com == pytest.approx([0.3, -0.2], abs=1e-9)
    assert state.com_velocity == pytest.approx([0.3, -0.2], abs=1e-12)
    assert state.heading == pytest.approx(2.4, abs=1e-9)


def test_twin_coasts_without_friction():
    # MuJoCo's contacts have no friction below 1e-5, which a preload multiplies; hence
    # without preload.
    plant = TwinSnake(
        robot(stiffness=20.0, mu_t=0.0, mu_n=0.0), contact=PreloadedContact(preload=0.0)
    )
    throw(plant, (0.3, -0.2), spin=2.0, heading=0.4)
    start = plant.physics.center_of_mass()[:2]
    heading = plant.physics.connector_headings().mean()
    for _ in range(50):
        state = plant.step(vented(plant.spec))
    assert state.com - start == pytest.approx([0.3, -0.2], abs=1e-3)
    assert state.com_velocity == pytest.approx([0.3, -0.2], abs=1e-3)
    assert state.heading - heading == pytest.approx(2.0, rel=1e-2)


def test_frictionless_analytical_snake_has_no_thrust():
    spec = chain((0.03, 0.05, 0.02, 0.04, 0.1), mu_t=0.0, mu_n=0.0)
    plant = AnalyticalSnake(spec, timestep=2e-4)
    trajectory = rollout(plant, Gait(2.0, 0.2), 1.0, record_hz=5000)
    assert np.abs(trajectory.com).max() < 1e-12
    # It does turn: a change of shape that comes back to itself leaves a geometric
    # phase.
    assert np.abs(trajectory["heading"]).max() > 1e-2
    # Yet Σ m ρ × ρ̇ is zero, here from recorded positions; its terms by themselves are
    # not.
    middle = (trajectory.position[1:] + trajectory.position[:-1]) / 2
    velocity = np.diff(trajectory.position, axis=0) / 2e-4
    cross = middle[..., 0] * velocity[..., 1] - middle[..., 1] * velocity[..., 0]
    terms = spec.mass.array() * cross
    assert np.abs(terms.sum(axis=1)).max() < 2e-3 * np.abs(terms).sum(axis=1).max()


def test_frictionless_twin_gains_momentum_only_from_the_time_step():
    # Generalised coordinates conserve momentum to first order in the step: half of it,
    # half the drift.
    coarse = _largest_momentum(0.001)
    fine = _largest_momentum(0.00025)
    assert fine[0] < 0.4 * coarse[0]
    assert fine[1] < 0.4 * coarse[1]
    # Against what the parts have: connectors move at about 0.5 m/s, half a body turns
    # at about 5 rad/s.
    assert fine[0] < 0.03 * 0.5 * SLIPPERY.mass.total
    assert fine[1] < 0.05 * 5 * SLIPPERY.mass.total * 0.08**2


def _largest_momentum(timestep: float) -> tuple[float, float]:
    """Return the largest horizontal momentum (kg·m/s) and moment about z (kg·m²/s) of an undulating twin."""
    plant = TwinSnake(
        SLIPPERY, timestep=timestep, contact=PreloadedContact(preload=0.0)
    )
    physics = plant.physics
    seen = []

    def watch(state) -> None:
        mujoco.mj_subtreeVel(physics.model, physics.data)
        momentum = SLIPPERY.mass.total * np.hypot(*physics.data.subtree_linvel[0][:2])
        seen.append((momentum, abs(physics.data.subtree_angmom[0][2])))

    rollout(plant, Gait(2.0), 0.6, observers=[watch])
    momentum, moment = np.max(seen, axis=0)
    return float(momentum), float(moment)


@pytest.mark.parametrize("masses", [(0.03,) * 5, (0.03, 0.05, 0.02, 0.1)])
def test_isotropic_viscous_friction_gives_no_thrust(masses):
    """Σ f = −c Σ m v: the centre of mass of a snake that starts at rest does not move."""
    spec = chain(masses, mu_t=0.4, mu_n=0.4)
    trajectory = rollout(AnalyticalSnake(spec, friction="viscous"), Gait(2.0, 0.2), 5.0)
    assert np.abs(trajectory.com).max() < 1e-9
    assert np.abs(trajectory.stack("bend")).max() > 1.0


def test_anisotropic_viscous_friction_gives_thrust():
    spec = robot(mu_t=0.4, mu_n=4.0)
    trajectory = rollout(AnalyticalSnake(spec, friction="viscous"), Gait(2.0), 5.0)
    assert trajectory["com_x"][-1] > 0.05
