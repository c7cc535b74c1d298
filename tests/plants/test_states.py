"""Recorded states of both plants: poses after a reset, chords of arcs, rates and the floor's impulse."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from snakes import chain

from srs_twin import AnalyticalSnake, Gait, TwinSnake

SPEC = chain((0.03, 0.05, 0.02, 0.04, 0.1))
STEP = 1e-3
PLANTS = {
    "complete": partial(AnalyticalSnake, SPEC, friction="wheel"),
    "compliant": partial(AnalyticalSnake, SPEC, model="compliant", friction="wheel"),
    "twin": partial(TwinSnake, SPEC),
}


@pytest.mark.parametrize("name", PLANTS)
def test_reset_gives_a_straight_snake_at_rest_at_the_pose(name):
    plant = PLANTS[name]()
    plant.step(np.tile([1, -1], (4, 1)))
    state = plant.reset(pose=(0.3, -0.1, np.pi / 3))
    ahead = np.array([0.5, np.sqrt(0.75)])
    assert state.com == pytest.approx([0.3, -0.1], abs=1e-12)
    assert -np.diff(state.position, axis=0) == pytest.approx(
        np.tile(SPEC.geometry.pitch * ahead, (4, 1))
    )
    assert state.connector_heading == pytest.approx([np.pi / 3] * 5)
    for quantity in (
        state.com_velocity,
        state.bend,
        state.bend_rate,
        state.pressure,
        state.contact_force,
    ):
        assert quantity == pytest.approx(np.zeros_like(quantity), abs=1e-15)
    assert state.time == 0 and not plant.openings().any()


def turn_left(name: str, step: float = STEP):
    """Return the motion of an uneven snake from a pose, every 1 ms for 0.8 s."""
    plant = PLANTS[name](timestep=step)
    plant.reset(pose=(0.3, -0.1, 1.0))
    gait = Gait(2.0, 0.3)
    gait.reset(SPEC, plant.tick)
    return plant.play(gait.script(0.8), 800)


@pytest.fixture(scope="module", params=PLANTS)
def turning(request):
    """Name of the plant and motion of a snake that turns left."""
    return request.param, turn_left(request.param)


def test_state_fields_are_consistent(turning):
    name, h = turning
    # The twin's links between hinges, and wheels away from the centre of the axle,
    # carry 2 % of the mass. Its pitch and roll change headings seen from above a little.
    centre_error, bend_error, chord_error = {"twin": (1e-3, 0.02, 3e-4)}.get(
        name, (1e-12, 1e-12, 1e-12)
    )
    mass = SPEC.mass.array()
    assert mass @ h.position / mass.sum() == pytest.approx(h.com, abs=centre_error)
    assert h.connector_heading.mean(axis=1) == pytest.approx(h.heading, abs=1e-12)
    assert -np.diff(h.connector_heading) == pytest.approx(h.bend, abs=bend_error)
    assert h.measured_bend == pytest.approx(h.bend)
    # Neighbours are one chord apart along their mean heading: an arc of l and half a
    # gap at each end.
    g = SPEC.geometry
    half = h.bend / 2
    chords = g.segment_length * np.sinc(half / np.pi) + g.rigid_gap * np.cos(half)
    links = -np.diff(h.position, axis=1)
    assert np.linalg.norm(links, axis=-1) == pytest.approx(chords, abs=chord_error)
    if name != "twin":
        mean = (h.connector_heading[:, :-1] + h.connector_heading[:, 1:]) / 2
        across = links[..., 1] * np.cos(mean) - links[..., 0] * np.sin(mean)
        assert across == pytest.approx(np.zeros_like(across), abs=1e-12)
    assert np.abs(h.bend).max() > 0.8


def test_velocities_are_time_derivatives_of_positions(turning):
    _, h = turning
    for value, rate in ((h.com, h.com_velocity), (h.bend, h.bend_rate)):
        difference = np.diff(value, axis=0) / STEP
        error = difference - (rate[1:] + rate[:-1]) / 2
        # Valve events make kinks.
        assert np.quantile(np.abs(error), 0.97) < 0.05 * np.abs(rate).max()


def impulse_error(name: str, h) -> float:
    """Return the largest |Δp − ∫ Σ f dt| over the largest |p|."""
    momentum = SPEC.mass.total * h.com_velocity
    force = h.contact_force.sum(axis=1)
    # The twin records means since the previous sample.
    mean = force[1:] if name == "twin" else (force[1:] + force[:-1]) / 2
    error = momentum[1:] - momentum[0] - np.cumsum(mean, axis=0) * STEP
    return float(np.abs(error).max() / np.abs(momentum).max())


def test_momentum_changes_by_the_impulse_of_the_floor(turning):
    name, h = turning
    error = impulse_error(name, h)
    if name == "twin":
        fine = impulse_error(name, turn_left(name, STEP / 4))
        assert fine == pytest.approx(error / 16, rel=0.3)
        assert fine < 0.002
    else:
        assert error < 0.05
        limit = SPEC.friction.mu_n * SPEC.mass.array() * 9.81
        assert (np.linalg.norm(h.contact_force, axis=-1) <= 1.0001 * limit).all()
