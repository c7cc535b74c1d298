"""Whole-body grasp: phases of the controller, and the statics of the wrap on the twin."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from srs_twin import load_robot
from srs_twin.control.grasp import Grasp, Phase
from srs_twin.errors import InputError
from srs_twin.plants.twin.snake import TwinSnake

GEN2 = load_robot("gen2")
CHAIN = replace(
    GEN2,
    geometry=replace(GEN2.geometry, connectors=9),
    mass=replace(GEN2.mass, connectors=GEN2.mass.connectors[:1] * 9),
)


@functools.cache
def initial_state():
    return TwinSnake(CHAIN).state


def at(time: float, measured_bend: float, **changes: object):
    """Return a state with true fields of NaN."""
    nothing = np.full(8, math.nan)
    return replace(
        initial_state(),
        time=time,
        measured_bend=np.full(8, measured_bend),
        bend=nothing,
        bend_rate=nothing,
        **changes,
    )


def stepped(grasp: Grasp, bend: float, seconds: float) -> Phase:
    grasp.reset(CHAIN, 0.02)
    for k in range(round(seconds / 0.02)):
        grasp.step(at(k * 0.02, bend * min(k * 0.02 / 1.5, 1.0)))
    return grasp.phase


def test_sensed_grasp_drags_only_what_it_holds():
    free = GEN2.actuator.gain * GEN2.supply.nominal
    grasp = Grasp(2.0)
    assert stepped(grasp, free - 0.4, 2.5) is Phase.DRAG and not grasp.finished
    missed = Grasp(2.0)
    assert stepped(missed, free, 2.5) is Phase.CURL and missed.finished
    assert [event.kind for event in missed.events()] == ["grasp_missed"]


def test_open_loop_grasp_follows_the_clock():
    grasp = Grasp(2.0, mode="open_loop", release_after_s=1.0)
    assert stepped(grasp, 1.57, 1.9) is Phase.CURL
    assert stepped(grasp, 1.57, 2.5) is Phase.DRAG
    assert stepped(grasp, 1.57, 3.5) is Phase.RELEASE


@pytest.mark.parametrize(("side", "chamber"), [("left", 0), ("right", 1)])
def test_holding_segments_fill_the_side_of_the_object(side, chamber):
    grasp = Grasp(2.0, side=side, mode="open_loop")
    stepped(grasp, 0.0, 2.5)
    valves = grasp.step(at(2.5, 0.0))
    assert (valves[:, -4:, chamber] == 1).all() and (
        valves[:, -4:, 1 - chamber] == -1
    ).all()
    assert (valves[:, :4] == 1).any(), "the others crawl"


def test_robot_with_too_few_segments_is_refused():
    with pytest.raises(InputError, match="at least two must crawl"):
        Grasp(2.0).reset(GEN2, 0.02)
    with pytest.raises(
        InputError, match="`drag_m` is allowed only in the mode 'sensed'"
    ):
        Grasp(2.0, mode="open_loop", drag_m=0.3)
