"""Every friction law of the twin, translated to Warp, compared with the function it is translated from."""

# No `from __future__ import annotations`: Warp needs the types themselves.

from typing import NamedTuple

import numpy as np
import pytest

from srs_twin.plants.twin.friction_solve import _friction_law
from srs_twin.plants.twin.mjcf.numerics import LAWS_ON_LOADS
from srs_twin.plants.twin.stick_slip import (
    FloorLaw,
    axis_friction,
    rolling_friction,
    skin_friction,
    stick_slip_friction,
)

wp = pytest.importorskip("warp", reason="the extra gpu is not installed")
from srs_twin.warp.translation import (  # noqa: E402
    as_warp_functions,
    stack_records,
    warp_struct,
)

CONTACTS = 60


class Constants(NamedTuple):
    """Constants of the contacts that the law reads, as in `friction_solve.Contacts`."""

    wheels: int
    floor: FloorLaw
    obstacle_friction: float


@pytest.fixture(scope="module")
def evaluated():
    """Return a function that evaluates the law in Warp for constants, states and previous forces."""
    floor = FloorLaw(0, 0.0, 0.0, 0.0, 0.0, 0.0)
    struct = warp_struct(Constants(1, floor, 0.0))
    functions = as_warp_functions(
        [
            stick_slip_friction,
            skin_friction,
            rolling_friction,
            axis_friction,
            _friction_law,
        ]
    )
    friction_law = functions["_friction_law"]
    All = struct.batched
    select = struct.select

    @wp.kernel(enable_backward=False)
    def each(
        constants: All,
        state: wp.array2d(dtype=float),
        force: wp.array2d(dtype=float),
        out: wp.array2d(dtype=float),
    ):
        i = wp.tid()
        traction, rim = friction_law(
            select(constants, i),
            0,
            state[i, 0],
            state[i, 1],
            state[i, 2],
            force[i],
            state[i, 3],
            state[i, 4],
        )
        out[i, 0] = traction.along
        out[i, 1] = traction.across
        out[i, 2] = traction.derivative_along
        out[i, 3] = traction.off_diagonal
        out[i, 4] = traction.derivative_across
        out[i, 5] = rim

    def evaluate(constants, state, force):
        out = wp.zeros((len(state), 6), dtype=float, device="cpu")
        given = [
            wp.array(values, dtype=float, device="cpu") for values in (state, force)
        ]
        inputs = [stack_records(struct, constants, "cpu"), *given, out]
        wp.launch(each, dim=len(state), inputs=inputs, device="cpu")
        return out.numpy()

    return evaluate


@pytest.mark.default_cases(at=[0, 5, 6])
@pytest.mark.parametrize(
    "skin", [False, True], ids=["same both ways", "differs backwards"]
)
@pytest.mark.parametrize("friction_law", LAWS_ON_LOADS)
def test_every_law_of_the_twin_agrees_in_warp(evaluated, friction_law, skin):
    """A law that Warp cannot translate stops the engine for all laws."""
    rng = np.random.default_rng(5)
    velocity = rng.choice([-1, 1], (CONTACTS, 3)) * 10 ** rng.uniform(
        -5, -1, (CONTACTS, 3)
    )  # stick or slide
    load = rng.uniform(0.1, 1, CONTACTS)
    h = rng.uniform(1e-3, 1e-2, CONTACTS)
    state = np.column_stack([velocity[:, :2], load, velocity[:, 2], h])
    force = rng.normal(scale=0.02, size=(CONTACTS, 3))
    mu = np.sort(rng.uniform(0.01, 0.5, size=(CONTACTS, 2)), axis=1)
    constants = [
        Constants(
            wheels=1,
            floor=FloorLaw(
                friction_law_index=LAWS_ON_LOADS.index(friction_law),
                forward=t,
                across=n,
                slip_speed=1e-3,
                spin_mass=1e-3,
                backward=1.5 * t if skin else t,
            ),
            obstacle_friction=0.3,
        )
        for t, n in mu
    ]
    expected = []
    for given, row, previous in zip(constants, state, force, strict=True):
        traction, rim = _friction_law.py_func(given, 0, *row[:3], previous, *row[3:])
        expected.append([*traction, rim])
    expected = np.array(expected)
    error = np.abs(evaluated(constants, state, force) - expected).max(axis=0)
    assert (np.abs(expected[:, 2]) > 100).any() and (
        np.abs(expected[:, 2]) < 10
    ).any()  # sticking; sliding
    steepest = np.abs(expected[:, 2:5]).max()
    assert (error <= np.array([1e-5, 1e-5, *3 * [1e-4 * steepest], 1e-6])).all(), error
