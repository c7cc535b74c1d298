"""Segments of a spatial robot that lengthen under the mean pressure of their chambers."""

from dataclasses import replace

import numpy as np
import pytest
from snakes import shortened

from srs_twin import InputError, TwinSnake, load_robot, load_scenario
from srs_twin.errors import InputFileError
from srs_twin.robot.spec import GRAVITY

SUPPLY, EXTENSION = 20e3, 2.5e-7
"""Supply pressure, Pa, and extension, m/Pa: 5 mm when all chambers are full."""


SPEC = replace(
    shortened(load_robot("spatial_example"), 4),
    actuator=replace(load_robot("spatial_example").actuator, extension=EXTENSION),
)


def friction_error():
    """Return the largest compression of a segment by friction on the floor, m."""
    return SPEC.friction.mu_t * SPEC.mass.total * GRAVITY / 2 / SPEC.axial_stiffness


def lengths(state):
    points = np.column_stack([state.position, state.height])
    return np.linalg.norm(np.diff(points, axis=0), axis=1)


def test_all_chambers_lengthen_the_segments_with_their_pressure():
    twin = TwinSnake(SPEC, supply_pa=SUPPLY)
    full = np.ones((SPEC.segments, 4), dtype=np.int8)
    tau1 = SPEC.actuator.tau_fill
    tau2 = SPEC.bending.damping_time
    for tick in range(1, 26):
        state = twin.step(full)
        if tick in (5, 25):
            t = 0.02 * tick
            fraction = 1 - (tau1 * np.exp(-t / tau1) - tau2 * np.exp(-t / tau2)) / (
                tau1 - tau2
            )
            expected = SPEC.geometry.pitch + fraction * EXTENSION * SUPPLY
            assert lengths(state) == pytest.approx(
                np.full(3, expected), abs=friction_error() + 2e-5
            )
    assert np.abs(state.bend).max() < 0.02


def test_one_of_four_chambers_lengthens_the_arc_by_a_quarter_as_much():
    twin = TwinSnake(SPEC, supply_pa=SUPPLY, hinges_per_segment=4)
    one = np.full((SPEC.segments, 4), -1, dtype=np.int8)
    one[:, 0] = 1
    for _ in range(50):
        state = twin.step(one)
    g = SPEC.geometry
    q = state.bend[:, 0]
    assert q == pytest.approx(SPEC.actuator.gain * SUPPLY, rel=0.05)
    arc = g.segment_length + EXTENSION * SUPPLY / 4
    chord = arc * np.sin(q / 2) / (q / 2) + g.rigid_gap * np.cos(q / 2)
    # The link in the middle lengthens, not the whole arc (docs/spatial.md).
    error = friction_error() + (EXTENSION * SUPPLY / 4) * (q**2).max() / 24
    assert lengths(state) == pytest.approx(chord, abs=error + 5e-5)
    assert error < 0.15 * EXTENSION * SUPPLY / 4


def test_a_robot_without_extension_has_the_same_model():
    plain = TwinSnake(replace(SPEC, actuator=replace(SPEC.actuator, extension=0.0)))
    longer = TwinSnake(SPEC)
    assert longer.physics.model.nv == plain.physics.model.nv + SPEC.segments
    joints = [
        plain.physics.model.joint(j).name for j in range(plain.physics.model.njnt)
    ]
    assert not any("stretch" in name for name in joints)


def test_planar_robots_and_single_hinges_are_refused():
    extension = {"robot.actuator.extension_m_per_kpa": 1e-4}
    with pytest.raises(
        InputFileError, match="segments of a planar robot keep their length"
    ):
        load_scenario("gen2_straight", set=extension)
    spec = load_scenario("spatial_sidewinding", set=extension).robot
    assert spec.actuator.extension == pytest.approx(1e-7)
    with pytest.raises(
        InputError,
        match="`hinges_per_segment` 1 is not allowed for segments that lengthen",
    ):
        TwinSnake(spec, hinges_per_segment=1)
    planar = load_robot("skin_example")
    with pytest.raises(
        InputError, match="segments of a planar robot keep their length"
    ):
        replace(planar, actuator=replace(planar.actuator, extension=1e-7))
