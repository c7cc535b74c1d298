"""Long snakes in the engine: the start of its solver is the solution, and changes no result."""

from __future__ import annotations

from functools import partial

import mujoco
import numpy as np
import pytest
from snakes import chain

from srs_twin import AnalyticalSnake, Gait, SnakeState, TwinSnake, rollout
from srs_twin.plants import loaded, physics
from srs_twin.world import Circle, World

SPEC = chain((0.0532,) * 17)
POSTS = World(obstacles=(Circle(0.62, 0.03, 0.05), Circle(0.3, -0.1, 0.05)))


def twins(monkeypatch: pytest.MonkeyPatch, **options) -> tuple[TwinSnake, TwinSnake]:
    """Return a long twin, and one that the engine's Newton's method steps alone, to a finer tolerance."""
    fast = TwinSnake(SPEC, **options)
    monkeypatch.setattr(physics, "_SHORT", SPEC.segments)
    slow = TwinSnake(SPEC, **options)
    slow.physics.model.opt.tolerance = 1e-12
    return fast, slow


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"wheels": "skid"}, {"world": POSTS}])
def test_long_twins_crawl_as_the_engine_alone_has_it(options, monkeypatch):
    runs = [rollout(twin, Gait(2.0, 0.2), 0.5) for twin in twins(monkeypatch, **options)]
    assert np.ptp(runs[1].stack("bend"), axis=0).min() > 0.3
    assert runs[0].stack("bend") == pytest.approx(runs[1].stack("bend"), abs=2e-6)
    assert runs[0].position == pytest.approx(runs[1].position, abs=1e-6)


def test_normals_of_long_loaded_twins_are_the_engines(monkeypatch):
    slow = TwinSnake(SPEC, contact="loaded")
    monkeypatch.setattr(loaded, "_SHORT", 8)
    fast = TwinSnake(SPEC, contact="loaded")
    runs = [rollout(twin, Gait(2.0, 0.2), 0.5) for twin in (fast, slow)]
    assert runs[0].stack("bend") == pytest.approx(runs[1].stack("bend"), abs=1e-9)
    assert runs[0].position == pytest.approx(runs[1].position, abs=1e-9)


def test_the_engine_finds_nothing_left_to_do(monkeypatch):
    fast, slow = twins(monkeypatch)
    counts: list[int] = []

    def count(twin: TwinSnake, state: SnakeState) -> None:
        counts.append(int(twin.physics.data.solver_niter[0]))

    rollout(fast, Gait(2.0), 0.4, observers=[partial(count, fast)])
    assert np.mean(counts) < 0.5
    assert slow.physics.model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON


def test_a_long_twin_goes_on_from_a_saved_state_with_the_same_bits():
    twin, gait = TwinSnake(SPEC), Gait(2.0)
    gait.reset(SPEC, twin.tick)
    states = [twin.reset()]
    for _ in range(6):
        states.append(twin.step(gait.step(states[-1])))
    valves = gait.step(states[-1])
    saved = twin.save()
    after = twin.step(valves)
    other = TwinSnake(SPEC)
    other.restore(saved)
    again = other.step(valves)
    assert (again.qpos == after.qpos).all() and (again.contact_force == after.contact_force).all()


def test_what_joins_hinges_is_left_to_the_engine():
    twin = TwinSnake(SPEC, constant_curvature=True)
    assert twin.physics.model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON


@pytest.mark.parametrize("contact", ["preloaded", "loaded"])
def test_long_twins_and_the_compliant_model_bend_alike(contact):
    twin = rollout(TwinSnake(SPEC, contact=contact), Gait(2.0), 1.0)
    model = rollout(
        AnalyticalSnake(SPEC, model="compliant", friction="wheel", inertia="connector"), Gait(2.0), 1.0
    )
    difference = twin.stack("bend") - model.stack("bend")
    assert np.sqrt((difference**2).mean() / (twin.stack("bend") ** 2).mean()) < 0.1
