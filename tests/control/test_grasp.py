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
from srs_twin.robot.world import MovableObject, World

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


@pytest.mark.slow
def test_uniform_moment_presses_mainly_with_the_ends_of_the_wrap():
    """An arc that wants to curl further touches at its ends: the middle lifts off.

    The moment k (q_free − q) is uniform along the arc. Its gradient, the shear force,
    is zero, so there is no load between the two ends of the held part, and the forces
    act near the ends.
    """
    radius = 0.025
    ring = radius + GEN2.geometry.width / 2
    item = MovableObject((radius,), 1000.0, 10.0, 0.0, 0.0)
    bend = np.append(np.zeros(4), np.full(4, GEN2.geometry.pitch / ring))
    twin = TwinSnake(CHAIN, world=World(objects=(replace(item, x=9.0, y=9.0),)))
    twin.set_state(replace(twin.reset(pose=(0.0, 5.0, 0.0)), bend=bend))
    place = twin.physics.connector_positions()[:, :2]
    theta = twin.physics.connector_headings()
    left = np.array([-np.sin(theta[4]), np.cos(theta[4])])
    centre = place[4] + (ring + 0.001) * left - [0.0, 5.0]
    twin = TwinSnake(
        CHAIN, world=World(objects=(replace(item, x=centre[0], y=centre[1]),))
    )
    pressure = np.stack([bend / GEN2.actuator.gain, np.zeros(8)], axis=-1)
    twin.set_state(
        replace(twin.reset(pose=(0.0, 5.0, 0.0)), bend=bend, pressure=pressure)
    )
    twin.physics.data.qpos[1] -= 5.0
    twin.physics.refresh()
    valves = np.full((8, 2), -1, dtype=np.int8)
    valves[4:, 0] = 1
    for _ in range(100):
        state = twin.step(valves)
    model = twin.physics.model
    data = twin.physics.data

    def pressed(collision_geom: str) -> np.ndarray:
        """Return force and point of application of the object on a collision geom."""
        return data.sensordata[
            model.sensor(f"force_object_1_{collision_geom}").adr[0] :
        ][:6]

    assert np.hypot(*pressed("collision_8_2")[:2]) > 1.0, (
        "the last collision geom presses"
    )
    inner = ["collision_8_0", "collision_8_1", "collision_5_0"]
    assert (
        max(np.hypot(*pressed(collision_geom)[:2]) for collision_geom in inner) < 1e-6
    ), "its neighbours do not"
    # Statics of the last hinge: moment of the force behind it, against air and spring.
    hinge = model.joint("hinge_8_2")
    arm = pressed("collision_8_2")[3:5] - data.xanchor[hinge.id][:2]
    force = state.obstacle_force[8]
    external = arm[0] * force[1] - arm[1] * force[0]
    free = GEN2.actuator.gain * GEN2.supply.nominal
    internal = GEN2.bending.stiffness * (free - 2 * data.qpos[hinge.qposadr[0]])
    floor = GEN2.friction.mu_n * GEN2.mass.connectors[0] * 9.81 * np.hypot(*arm)
    assert abs(external - internal) < floor < 0.2 * internal
