"""Recursive inverse dynamics, compared with the sum over the dense Jacobian of the whole body."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from rows import fill_rows

from srs_twin.plants.analytical.floor import FloorFriction, fill_forces, floor_friction
from srs_twin.plants.analytical.kernels import PrescribedModel, inverse_dynamics
from srs_twin.plants.analytical.kinematics import ROWS, BodyParameters, pose_body
from srs_twin.pneumatics import Trace


def by_rows(
    u: np.ndarray,
    bend: np.ndarray,
    acceleration: np.ndarray,
    solid: BodyParameters,
    floor: FloorFriction,
    turning: bool,
) -> np.ndarray:
    """Return the moments of the segments from d'Alembert's principle with a dense Jacobian.

    The rows r give the velocities of the connectors along, across and about themselves
    for the velocities u, W are their masses and inertias. The acceleration w of the
    whole body makes rᵀ (W (ṙ u + r u̇) − f) vanish for its three velocities; the
    components of the bends are their moments.
    """
    n = len(solid.mass)
    body = np.empty((ROWS, n))
    pushed = np.empty((n, 3))
    rows = np.empty((n, 3, n + 2))
    rates = np.zeros((n, 3, n + 2))
    pose_body(bend, u[3:], solid, body)
    fill_forces(body, solid.mass, u, floor, pushed)
    fill_rows(body, bend, u, solid, rows, rates)
    r = rows.reshape(3 * n, -1)
    rate = rates.reshape(3 * n, -1)
    f = pushed.ravel()
    weights = np.stack([solid.mass, solid.mass, solid.inertia], axis=1).ravel()
    rate[2::3] = 0.0  # headings are linear in the bends
    forces = r.T @ f
    if not turning:
        forces[2] = 0.0
    needed = r.T @ (weights * (rate @ u + r[:, 3:] @ acceleration)) - forces
    mass = r.T @ (weights[:, None] * r)
    whole = np.linalg.solve(mass[:3, :3], -needed[:3])
    return needed[3:] + mass[3:, :3] @ whole


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    connectors=st.integers(2, 12),
    law=st.sampled_from([("axis", 0.0), ("wheel", 0.02)]),
    frozen=st.sampled_from([0.0, 1.0]),
    heavy=st.booleans(),
    turning=st.booleans(),
)
def test_recursive_inverse_dynamics_equals_the_dense_sum(
    seed, connectors, law, frozen, heavy, turning
):
    random = np.random.default_rng(seed)
    mass = random.uniform(0.01, 0.1, connectors)
    inertia = random.uniform(0.0, 1e-4, connectors) if heavy else np.zeros(connectors)
    solid = BodyParameters.of(mass, inertia, 0.037, 0.018, frozen)
    floor = floor_friction(*law, 0.05, 0.5, 0.01)
    samples = 3
    segments = connectors - 1
    u = random.normal(0, [0.3, 0.3, 2.0, *[5.0] * segments], (samples, 3 + segments))
    bend = random.normal(0, 0.7, (samples, segments))
    acceleration = random.normal(0, 99, (samples, segments))
    result = np.empty((samples, segments))
    trace = Trace.empty(samples, segments)._replace(
        bend=bend, bend_rate=u[:, 3:].copy(), bend_acceleration=acceleration
    )
    model = PrescribedModel(solid, floor, turning)
    inverse_dynamics(u[:, :3].copy(), trace, model, result)
    expected = [
        by_rows(u[k], bend[k], acceleration[k], solid, floor, turning)
        for k in range(samples)
    ]
    assert result == pytest.approx(np.array(expected), rel=1e-10, abs=1e-10)
