"""Without friction, a bending snake conserves momentum and moment of momentum."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from smooth import Wave
from snakes import chain, robot, throw

from srs_twin import (
    AnalyticalSnake,
    Gait,
    Plant,
    PreloadedContact,
    RobotSpec,
    TwinSnake,
    rollout,
)
from srs_twin.plants.analytical import kernels

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
ALL = pytest.mark.parametrize("options", MODELS.values(), ids=MODELS)


def valves(plant: Plant) -> np.ndarray:
    return np.full((plant.spec.segments, 2), -1, dtype=np.int8)


@pytest.mark.slow
@ALL
@pytest.mark.parametrize("friction_law", ["axis", "wheel", "ellipse", "viscous"])
def test_bending_analytical_snake_conserves_momentum(options, friction_law):
    plant = AnalyticalSnake(UNEVEN, friction=friction_law, **options)
    gait = Gait(2.0, 0.2)
    throw(plant, (0.3, -0.2), spin=2.0, heading=0.4)
    gait.reset(plant.spec, plant.tick)
    begun = plant.body.state[kernels.MOMENT]
    # `throw` leaves the plant at t = 0; the script bends it from there.
    h = plant.play(gait.script(2.0), 200)
    assert np.ptp(h.bend, axis=0).min() > 0.5
    assert h.com_velocity == pytest.approx(np.tile([0.3, -0.2], (200, 1)), abs=1e-13)
    assert h.com == pytest.approx(np.outer(h.time, [0.3, -0.2]), abs=1e-12)
    assert plant.body.state[kernels.MOMENT] == pytest.approx(begun, rel=1e-12)


@pytest.mark.parametrize("name", ["complete", "simplified", "compliant"])
def test_moment_of_momentum_of_recorded_positions_is_conserved(name):
    """Σ m ρ × ρ̇ from differences of recorded positions, independent of the kernels' state."""
    step = 2e-4
    plant = AnalyticalSnake(
        UNEVEN,
        timestep=step,
        pneumatics=Wave(UNEVEN, bias=0.2),
        **{**MODELS[name], "inertia": "point"},
    )
    throw(plant, (0.3, -0.2), spin=2.0)
    h = plant.play(plant.pneumatics.schedule(valves(plant), 1.0), round(1 / step))
    arm = h.position - h.com[:, None]
    velocity = np.gradient(h.position, step, axis=0)
    terms = UNEVEN.mass.array() * (
        arm[..., 0] * velocity[..., 1] - arm[..., 1] * velocity[..., 0]
    )
    moment = terms.sum(axis=1)[1:-1]
    scale = np.abs(terms).sum(axis=1).max()
    assert np.ptp(h.bend, axis=0).min() > 1.0
    stations = -UNEVEN.geometry.pitch * np.arange(5)
    mass = UNEVEN.mass.array()
    begun = 2.0 * (mass * (stations - mass @ stations / mass.sum()) ** 2).sum()
    # In its first milliseconds the yielding snake's bends take up the spin that it is
    # thrown with.
    assert moment[50:] == pytest.approx(
        np.full(len(moment) - 50, begun), abs=1e-6 * scale
    )


@pytest.mark.slow
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
