"""Whole-body grasp: phases, valves and messages of the controller."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from srs_twin import Gait, load_robot
from srs_twin.control.grasp import Grasp, Phase
from srs_twin.errors import InputError
from srs_twin.plants.twin.snake import TwinSnake

GEN2 = load_robot("gen2")
FREE = GEN2.actuator.gain * GEN2.supply.nominal
CHAIN = replace(
    GEN2,
    geometry=replace(GEN2.geometry, connectors=9),
    mass=replace(GEN2.mass, connectors=GEN2.mass.connectors[:1] * 9),
)
SENSED = {"mode": "sensed"}
BY_TIME = {"mode": "open_loop"}


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


def stepped(grasp: Grasp, bend, seconds: float) -> np.ndarray:
    """Return the valves at a time, after the segments have had the bends `bend(t)`."""
    grasp.reset(CHAIN, 0.02)
    for k in range(round(seconds / 0.02) + 1):
        valves = grasp.step(at(k * 0.02, bend(k * 0.02)))
    return valves


def curling(end: float):
    return lambda time: end * min(time / 1.5, 1.0)


def test_sensed_grasp_drags_only_what_it_holds():
    for end, phase, finished in ((0.11, Phase.DRAG, False), (0.09, Phase.CURL, True)):
        grasp = Grasp(2.0)
        stepped(grasp, curling(FREE - end), 2.5)
        assert grasp.phase is phase and grasp.finished is finished
    assert [event.kind for event in grasp.events()] == ["grasp_missed"]


def test_drag_begins_when_the_readings_have_settled():
    """In 0.28 s before 1.66 s, the readings change by 0.07 rad, less than 0.3 rad/s."""
    grasp = Grasp(2.0)
    stepped(grasp, lambda time: min(time, 1.45) - 1.0, 1.8)
    (event,) = grasp.events()
    assert (event.kind, event.time) == ("grasp", pytest.approx(1.66))
    assert event.text == (
        f"drag begins; the holding segments bend {FREE - 0.45:.2g} rad less than"
        " without an object"
    )
    assert grasp.signals() == {"grasp_phase": 2.0, "grip": pytest.approx(FREE - 0.45)}


@pytest.mark.parametrize(
    ("options", "seconds", "phase"),
    [
        (BY_TIME, 1.98, Phase.CURL),
        (BY_TIME, 2.98, Phase.DRAG),
        (BY_TIME, 3.02, Phase.RELEASE),
        (SENSED, 1.48, Phase.CURL),
    ],
)
def test_phases_follow_the_clock(options, seconds, phase):
    grasp = Grasp(2.0, release_after_s=1.0, **options)
    stepped(grasp, lambda time: 0.0, seconds)
    assert grasp.phase is phase


def test_object_is_released_after_its_distance():
    grasp = Grasp(2.0, drag_m=0.5)
    stepped(grasp, curling(FREE - 0.4), 2.5)
    start = np.asarray(initial_state().com)
    for distance, phase in ((0.499, Phase.DRAG), (0.501, Phase.RELEASE)):
        com = start + distance * np.array([0.6, 0.8])
        valves = grasp.step(at(2.52, FREE - 0.4, com=com))
        assert grasp.phase is phase
    assert (valves[:, -4:] == -1).all() and (valves[:, :4] == 1).any()


@pytest.mark.parametrize(("side", "chamber"), [("left", 0), ("right", 1)])
def test_holding_segments_fill_the_side_of_the_object(side, chamber):
    grasp = Grasp(2.0, side=side, **BY_TIME)
    # The duty cycle rises to 1 in 1.5 s; a tick has 20 slots.
    for seconds, filled in ((0.3, 4), (0.6, 8), (1.8, 20)):
        valves = stepped(grasp, lambda time: 0.0, seconds)
        expected = np.full((20, 8, 2), -1)
        expected[:filled, -4:, chamber] = 1
        assert (valves == expected).all()
    valves = stepped(grasp, lambda time: 0.0, 2.5)
    assert (valves[:, -4:, chamber] == 1).all()
    assert (valves[:, -4:, 1 - chamber] == -1).all()
    gait = Gait(2.0)
    gait.reset(CHAIN, 0.02)
    assert (valves[:, :4] == gait.valves_at(0.5)[..., :4, :]).all()


@pytest.mark.parametrize("hold", [0, 7])
def test_robot_with_too_few_segments_is_refused(hold):
    with pytest.raises(InputError, match="at least two must crawl"):
        Grasp(2.0, hold=hold).reset(CHAIN, 0.02)
    for allowed in (1, 6):
        Grasp(2.0, hold=allowed).reset(CHAIN, 0.02)


def test_drag_distance_needs_sensing():
    with pytest.raises(
        InputError, match="`drag_m` is allowed only in the mode 'sensed'"
    ):
        Grasp(2.0, mode="open_loop", drag_m=0.3)
