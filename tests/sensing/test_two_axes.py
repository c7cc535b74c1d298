"""Curvature sensors with two axes, for spatial robots."""

from dataclasses import replace

import numpy as np
import pytest

from srs_twin import load_robot, load_scenario, rollout
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.sensing import CurvatureSensor, DeadSensor, FaultySensor, make_sensor

SPATIAL = load_robot("spatial_example")
PLANAR = load_robot("skin_example")
BEND = np.random.default_rng(1).uniform(-1, 1, (400, SPATIAL.segments, 2))
TIME = 0.01 * np.arange(400)


def test_each_axis_reads_as_the_sensor_of_a_planar_robot():
    both = make_sensor("hall", SPATIAL, noise=1e-4).read(BEND, TIME, 3)
    one = make_sensor("hall", replace(PLANAR, geometry=SPATIAL.geometry), noise=1e-4)
    assert (both[..., 0] == one.read(BEND[..., 0], TIME, 3)).all()
    assert np.abs(both - BEND).max() < 0.25


def test_the_noise_of_both_axes_is_independent_and_equally_large():
    rest = np.zeros_like(BEND)
    exact = make_sensor("hall", SPATIAL, noise=0.0, bits=None).read(rest, TIME, 3)
    noise = (
        make_sensor("hall", SPATIAL, noise=1e-4, bits=None).read(rest, TIME, 3) - exact
    ).reshape(-1, 2)
    correlation = np.corrcoef(noise.T)[0, 1]
    assert abs(correlation) < 4 / np.sqrt(len(noise))
    assert noise.std(axis=0)[0] == pytest.approx(noise.std(axis=0)[1], rel=0.1)


def test_bias_and_drift_move_both_axes():
    sensor = make_sensor("hall", SPATIAL, noise=0.0, bits=None)
    biased = make_sensor("hall", SPATIAL, noise=0.0, bits=None, bias=0.1)
    shift = biased.read(0.1 * BEND, TIME, 0) - sensor.read(0.1 * BEND, TIME, 0)
    assert (
        shift == pytest.approx(np.full(BEND.shape, shift[0, 0, 0]))
        and abs(shift[0, 0, 0]) > 0.01
    )
    drift = replace(SPATIAL.modules, sensor_gain=(1.1,) * 8, sensor_bias=(0.05,) * 8)
    read = make_sensor("ideal", replace(SPATIAL, variation=drift)).read(BEND, TIME, 0)
    assert read == pytest.approx(1.1 * BEND + 0.05)


def test_a_dead_sensor_loses_both_axes_of_its_segment_only():
    faulty = FaultySensor(
        make_sensor("ideal", SPATIAL), (DeadSensor(3, 0.2, since=2.0),)
    )
    read = faulty.read(BEND, TIME, 0)
    dead = TIME >= 2.0
    assert (read[dead, 2] == 0.2).all() and (read[~dead] == BEND[~dead]).all()
    others = np.delete(np.arange(8), 2)
    assert (read[:, others] == BEND[:, others]).all()
    assert faulty.read(BEND[0], 3.0, 0).shape == (8, 2)


def test_a_given_sensor_gets_two_axes_on_a_spatial_robot():
    one = make_sensor("hall", PLANAR)
    assert isinstance(one, CurvatureSensor)
    assert (
        TwinSnake(SPATIAL, sensor=one).sensor.axes == 2
        and TwinSnake(PLANAR, sensor=one).sensor.axes == 1
    )


def test_readings_of_both_axes_are_recorded():
    changes = {
        "sensor.kind": "hall",
        "duration_s": 0.4,
        "robot.modules.sensor_bias_rad": [0.1] * 8,
    }
    scenario = load_scenario("spatial_sidewinding", set=changes)
    run = rollout(
        scenario.build_plant("twin"), scenario.build_controller(), 0.4, seed=5
    )
    bends = np.stack([run.stack("bend"), run.stack("pitch")], axis=-1)
    read = np.stack([run.stack("measured_bend"), run.stack("measured_pitch")], axis=-1)
    assert read == pytest.approx(
        make_sensor("hall", SPATIAL).read(bends, run.time, 5) + 0.1
    )
    assert np.abs(bends).max() > 0.2 and run.unit("measured_pitch_1") == "rad"
