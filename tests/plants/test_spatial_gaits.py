"""Gaits of spatial robots on the twin against kinematics and statics."""

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar
from snakes import shortened

from srs_twin import Gait, TwinSnake, load_robot, rollout
from srs_twin.control.gait import PitchWave
from srs_twin.robot.spec import GRAVITY

SPEC = load_robot("spatial_example")


def rolling_speed(spec, frequency, supply):
    """Return the speed at which a rigid arc that turns once per period dissipates least, m/s.

    A part with the heading θ rolls with ωR across its axis, so that it slips by |V − ωR
    n(θ)|. Equal friction in all directions and equal loads: V minimises the sum of the
    slip speeds.
    """
    rim = 2 * np.pi * frequency * spec.geometry.com_height
    bend = (
        np.sqrt(2) * spec.actuator.gain * supply
    )  # two neighbouring chambers are full
    headings = np.linspace(-1, 1, 2001) * spec.segments * bend / 2

    def slip(fraction):
        return np.sqrt(fraction**2 - 2 * fraction * np.cos(headings) + 1).sum()

    return rim * minimize_scalar(slip, bounds=(0, 1), method="bounded").x


@pytest.mark.parametrize("side", [1, -1])
def test_rolling_is_that_of_an_arc_that_turns_once_per_period(side):
    spec = shortened(SPEC, 5)
    frequency = 1.0
    supply = 5e3
    twin = TwinSnake(spec, supply_pa=supply, timestep=0.002)
    pitch = PitchWave(0.5, side * np.pi / 2)
    phase = 0.0 if side > 0 else np.pi
    run = rollout(twin, Gait(frequency, phase=phase, phase_step=0.0, pitch=pitch), 4.0)
    speed = (run["com_y"][-1] - run["com_y"][200]) / 2.0
    assert side * speed == pytest.approx(
        rolling_speed(spec, frequency, supply), rel=0.1
    )
    assert abs(run["com_x"][-1]) < 1e-6


def lifted_head(spec, lifted, supply, cells=8):
    """Return the height of the head of a chain of arcs with the least potential energy, m.

    The chain lies in a vertical plane. Unknowns are the bends, and the slope and height
    of the tail.
    """
    g = spec.geometry
    free = np.zeros(spec.segments)
    free[:lifted] = spec.actuator.gain * supply
    pieces = [
        (g.rigid_gap / 2, 0.0, 1),
        (g.segment_length, 1.0, cells),
        (g.rigid_gap / 2, 0.0, 1),
    ]
    lengths = np.concatenate(
        [np.full(count, size / count) for size, _, count in pieces]
    )
    fractions = np.concatenate(
        [np.full(count, fraction / count) for _, fraction, count in pieces]
    )
    weights = GRAVITY * np.outer(spec.mass.segments, lengths / g.pitch).ravel()

    def heights(unknowns):
        """Return the heights of the middles of all parts, tail last, and that of the head."""
        turns = np.outer(unknowns[: spec.segments], fractions).ravel()
        derivatives = unknowns[-2] + np.cumsum(turns[::-1])[::-1] - turns / 2
        rises = np.tile(lengths, spec.segments) * np.sin(derivatives)
        tops = unknowns[-1] + np.cumsum(rises[::-1])[::-1]
        return tops - rises / 2, tops[0]

    def energy(unknowns):
        bending = (
            spec.bending.pitch_stiffness
            * ((unknowns[: spec.segments] - free) ** 2).sum()
            / 2
        )
        return bending + weights @ heights(unknowns)[0]

    floor = {"type": "ineq", "fun": lambda unknowns: 100 * heights(unknowns)[0]}
    start = [*0.9 * free, 0, 0]
    options = {"ftol": 1e-12}
    found = minimize(
        energy, start, constraints=[floor], method="SLSQP", options=options
    )
    assert found.success
    return heights(found.x)[1] + g.com_height


@pytest.mark.parametrize("supply", [20e3, 10e3])
def test_a_lifted_head_reaches_the_height_of_least_potential_energy(supply):
    twin = TwinSnake(SPEC, supply_pa=supply, timestep=0.002)
    # The other segments form an arc at rest, which supports the head sideways; a
    # straight body tips over.
    gait = Gait(0.02, phase_step=0.0, pitch=PitchWave(0.0, lifted_segments=2))
    run = rollout(twin, gait, 1.0)
    expected = lifted_head(SPEC, 2, supply)
    assert run["z_1"][-1] == pytest.approx(expected, rel=0.03)
    assert expected > 2 * SPEC.geometry.com_height
    assert np.abs(run.stack("bend")[-1, :2]).max() < 0.01
