"""Messages and the emulator of spatial robots."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from brokers import wait

from srs_twin import InputError, TwinSnake, load_robot
from srs_twin.live.emulator import EmulatedRobot, Simulation, emulate
from srs_twin.live.links import MqttLink
from srs_twin.live.messages import (
    BENDS,
    COMMAND,
    PRESSURES,
    VALVES,
    BadMessageError,
    decode,
    encode,
)

SPEC = load_robot("spatial_example")
QUIET = {
    "simulation": Simulation(gain_spread=0.0, supply_kpa=20.0),
    "noise_rad": 0.0,
}
FULL = np.tile([1.0, -1.0, 1.0, -1.0], (SPEC.segments, 1))


def back(kind, values, segments=SPEC.segments, chambers=4):
    return decode(
        kind,
        encode(kind, 1.5, values),
        source="s",
        arrived=2.0,
        segments=segments,
        chambers=chambers,
    )


def test_messages_have_a_list_per_chamber_and_two_bends():
    assert json.loads(encode(COMMAND, 1.0, np.array([[1, -1, 0]]))) == {
        "t": 1.0,
        "chamber_1": [1],
        "chamber_2": [-1],
        "chamber_3": [0],
    }
    bends = np.array([[0.5, -0.25], [math.nan, 0.125]])
    assert json.loads(encode(BENDS, 1.0, bends)) == {
        "t": 1.0,
        "rad": [0.5, None],
        "pitch_rad": [-0.25, 0.125],
    }
    assert np.array_equal(back(BENDS, bends, segments=2).values, bends, equal_nan=True)
    assert back(PRESSURES, 1e4 * FULL).values == pytest.approx(1e4 * FULL)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("kind", "values", "chambers", "words"),
    [
        (COMMAND, FULL, 0, "`plus` must be a list of 8"),
        (COMMAND, FULL[:, :2], 4, "`chamber_1` must be a list of 8 numbers"),
        (VALVES, FULL[:, :3], 4, "`chamber_4` must be a list of 8 numbers"),
        (BENDS, np.zeros(8), 4, "`pitch_rad` must be a list of 8 numbers"),
    ],
)
def test_messages_of_the_other_kind_of_robot_are_refused(kind, values, chambers, words):
    with pytest.raises(BadMessageError, match=words):
        back(kind, values, chambers=chambers)


def test_the_emulated_robot_bends_in_both_directions():
    robot = EmulatedRobot("spatial_example", **QUIET, start=(0.1, 0.2, 0.7))
    turn = robot.bodies()[1].turn
    assert turn == pytest.approx((0.0, math.sin(0.35), 0.0, math.cos(0.35)), abs=1e-6)
    twin = TwinSnake(SPEC, supply_pa=20e3)
    twin.reset(pose=(0.1, 0.2, 0.7))
    for _ in range(10):
        robot.step(FULL)
        state = twin.step(FULL.astype(np.int8))
    assert (
        robot.bends() == pytest.approx(state.bend, abs=1e-9)
        and (robot.bends() > 0.1).all()
    )
    place = robot.bodies()[5].place
    assert place[1] == pytest.approx(state.height[4], abs=2e-3)
    assert (robot.valves == FULL).all()
    for _ in range(5):
        robot.step(np.full(FULL.shape, 0.5))
    assert (
        robot.state.pressure[:, 1].min() > 0 and robot.state.pressure[:, 1].max() < 10e3
    )


def test_dead_sensors_freeze_both_axes_and_chambers_with_a_side_are_refused():
    robot = EmulatedRobot(
        "spatial_example", **QUIET, faults=["dead_sensor:2=frozen@0.1"]
    )
    for _ in range(10):
        robot.step(FULL)
        held = robot.bends()
    robot.step(FULL)
    assert (robot.bends()[1] == held[1]).all() and (robot.bends()[0] != held[0]).all()
    with pytest.raises(
        InputError, match="fault stuck_valve.* does not support the spatial robot"
    ):
        EmulatedRobot("spatial_example", faults=["stuck_valve:2+@1"])
    with pytest.raises(
        InputError, match="a leak can be simulated only with compressible flow"
    ):
        EmulatedRobot("spatial_example", faults=["leak:2+@1"])


def test_commands_reach_an_emulated_spatial_robot(broker):
    robot = EmulatedRobot("spatial_example", **QUIET)
    options = {"broker": broker.access, "chambers": 4}
    with (
        MqttLink("s", 8, kinds=(BENDS, PRESSURES), **options) as here,
        MqttLink("s", 8, kinds=(COMMAND,), **options) as there,
    ):

        def fills():  # on a busy machine the first command may arrive after the first run
            here.send(COMMAND, FULL)
            emulate(robot, there, None, duration=0.3)
            return (robot.state.pressure[:, [0, 2]] > 1e3).all()

        wait(fills)
        shapes = {each.kind: each.values.shape for each in here.received()}
    assert shapes == {BENDS: (8, 2), PRESSURES: (8, 4)}
    assert (robot.state.pressure[:, [1, 3]] == 0).all()
