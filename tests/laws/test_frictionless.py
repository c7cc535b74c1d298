"""Without friction, a snake conserves momentum and moment of momentum; isotropic drag gives no thrust."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from smooth import Wave
from snakes import chain, robot, throw, vented

from srs_twin import (
    AnalyticalSnake,
    Gait,
    PreloadedContact,
    RobotSpec,
    TwinSnake,
    rollout,
)

MASSES = (0.03, 0.05, 0.02, 0.04, 0.1)
EVEN = robot(mu_t=0.0, mu_n=0.0)
UNEVEN = chain(MASSES, mu_t=0.0, mu_n=0.0)
MODELS = {
    "complete": {},
    "lumped": {"inertia": "lumped"},
    "simplified": {"model": "simplified"},
    "no torque": {"model": "simplified", "friction_torque": False},
    "compliant": {"model": "compliant", "inertia": "connector"},
}


@pytest.mark.parametrize("options", MODELS.values(), ids=MODELS)
def test_bending_analytical_snake_conserves_momentum_and_its_moment(options):
    """Σ m ρ × ρ̇ + J φ̇ from differences of recorded positions, independent of the kernels' state."""
    step = 2e-4
    plant = AnalyticalSnake(
        UNEVEN, timestep=step, pneumatics=Wave(UNEVEN, bias=0.2), **options
    )
    own = plant.body.solid.inertia
    throw(plant, (0.3, -0.2), spin=2.0, heading=0.4)
    h = plant.play(plant.pneumatics.schedule(vented(UNEVEN), 1.0), round(1 / step))
    assert np.ptp(h.bend, axis=0).min() > 1.0
    coasting = np.tile([0.3, -0.2], (len(h.time), 1))
    assert h.com_velocity == pytest.approx(coasting, abs=1e-13)
    assert h.com == pytest.approx(coasting * h.time[:, None], abs=1e-12)
    arm = h.position - h.com[:, None]
    velocity = np.gradient(h.position, step, axis=0)
    mass = UNEVEN.mass.array()
    terms = mass * (arm[..., 0] * velocity[..., 1] - arm[..., 1] * velocity[..., 0])
    terms += own * np.gradient(h.connector_heading, step, axis=0)
    stations = -UNEVEN.geometry.pitch * np.arange(5)
    inertia = (mass * (stations - mass @ stations / mass.sum()) ** 2 + own).sum()
    # In its first milliseconds the yielding snake's bends take up the spin that it is
    # thrown with.
    assert terms.sum(axis=1)[51:-1] == pytest.approx(
        2.0 * inertia, abs=1e-6 * np.abs(terms).sum(axis=1).max()
    )


def test_twin_coasts_and_unwraps_its_headings():
    # MuJoCo's contacts have no friction below 1e-5, which a preload multiplies; hence
    # without preload.
    plant = TwinSnake(
        robot(stiffness=20.0, mu_t=0.0, mu_n=0.0), contact=PreloadedContact(preload=0.0)
    )
    throw(plant, (0.3, -0.2), spin=12.0, heading=0.4)
    start = plant.physics.center_of_mass()[:2]
    states = [plant.step(vented(plant.spec)) for _ in range(60)]
    assert states[-1].com - start == pytest.approx([0.36, -0.24], abs=1e-3)
    assert states[-1].com_velocity == pytest.approx([0.3, -0.2], abs=1e-3)
    headings = [state.heading for state in states]
    assert np.diff(headings) == pytest.approx([12.0 * 0.02] * 59, rel=0.01)
    assert headings[-1] > 4 * np.pi


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("spec", [EVEN, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize("smooth", [False, True], ids=["gait", "smooth"])
def test_twin_momentum_drift_is_of_first_order(spec, smooth):
    """Half the step has half the drift: the integrator uses the inertia at the beginning of a step."""
    drifts = np.array(
        [drift(spec, timestep, smooth) for timestep in (0.001, 0.0005, 0.00025)]
    )
    order = np.log2(drifts[:-1] / drifts[1:])
    assert order == pytest.approx(np.ones_like(order), abs=0.15)
    # Connectors move at some 0.5 m/s, half a body turns at some 5 rad/s.
    fraction = drifts[0] / [0.5, 5 * spec.mass.total * 0.08**2]
    assert (fraction < (0.002 if smooth else 0.05)).all()


def drift(spec: RobotSpec, timestep: float, smooth: bool) -> tuple[float, float]:
    """Return the largest speed of the centre of mass (m/s) and moment of momentum (kg·m²/s) of a twin.

    The contact has no preload: the smallest friction coefficient of MuJoCo is 1e-5,
    which a preload would amplify.
    """
    chambers = {"pneumatics": Wave(spec, bias=0.2)} if smooth else {}
    plant = TwinSnake(
        spec, timestep=timestep, contact=PreloadedContact(preload=0.0), **chambers
    )
    data = plant.physics.data
    seen = []

    def watch(state) -> None:
        mujoco.mj_subtreeVel(plant.physics.model, data)
        seen.append(
            (np.hypot(*data.subtree_linvel[0][:2]), abs(data.subtree_angmom[0][2]))
        )

    rollout(plant, Gait(2.0), 0.6, observers=[watch])
    speed, moment = np.max(seen, axis=0)
    return float(speed), float(moment)


def test_isotropic_viscous_friction_gives_no_thrust():
    """Σ f = −c Σ m v: the centre of mass of a snake that starts at rest does not move."""
    spec = chain((0.03, 0.05, 0.02, 0.1), mu_t=0.4, mu_n=0.4)
    trajectory = rollout(AnalyticalSnake(spec, friction="viscous"), Gait(2.0, 0.2), 5.0)
    assert np.abs(trajectory.com).max() < 1e-9
    assert np.abs(trajectory.stack("bend")).max() > 1.0
