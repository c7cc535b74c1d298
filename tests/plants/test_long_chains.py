"""Long snakes: bends like those of the compliant model, and restored states."""

from __future__ import annotations

import numpy as np
import pytest
from snakes import chain

from srs_twin import AnalyticalSnake, Gait, TwinSnake, rollout

SPEC = chain((0.0532,) * 17)


def test_long_twin_continues_from_a_saved_state_bit_for_bit():
    twin = TwinSnake(SPEC)
    gait = Gait(2.0)
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
    assert (again.qpos == after.qpos).all() and (
        again.contact_force == after.contact_force
    ).all()


@pytest.mark.parametrize("contact", ["preloaded", "loaded"])
def test_long_twin_bends_like_the_compliant_model(contact):
    twin = rollout(TwinSnake(SPEC, contact=contact), Gait(2.0), 1.0)
    model = rollout(
        AnalyticalSnake(SPEC, model="compliant", friction="wheel", inertia="connector"),
        Gait(2.0),
        1.0,
    )
    difference = twin.stack("bend") - model.stack("bend")
    assert np.sqrt((difference**2).mean() / (twin.stack("bend") ** 2).mean()) < 0.1
