"""Algorithms 1 and 2 and the moving line, compared with geometry and calculus."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.integrate import cumulative_simpson

from srs_twin.recordings.body.trajectories import moving_derivative
from srs_twin.robot.geometry import arc_between, measured_bend, pair_heading

pytestmark = pytest.mark.fast


@given(
    st.floats(-3.1, 3.1),
    st.floats(-3.1, 3.1),
    st.floats(0.01, 0.1),
    st.floats(-1, 1),
    st.floats(-1, 1),
)
def test_arc_is_recovered_from_its_ends(turn, bend, length, x, y):
    """The arc is the integral of its tangent; its ends and its curvature recover it."""
    s = np.linspace(0, 1, 201)
    tangent = np.exp(1j * (turn - bend * s))
    path = (
        x
        + 1j * y
        - length
        * (
            cumulative_simpson(tangent.real, x=s, initial=0)
            + 1j * cumulative_simpson(tangent.imag, x=s, initial=0)
        )
    )
    ends = [np.array([path[k].real, path[k].imag]) for k in (0, -1)]
    found = arc_between(*ends, np.array(bend / length), points=201) @ [1, 1j]
    assert np.abs(found - path).max() < 1e-6 * length


@given(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(0.005, 0.05))
def test_bend_from_two_markers_at_each_end(heading, bend, apart):
    def marks(angle):
        along = apart / 2 * np.array([np.cos(angle), np.sin(angle)])
        return -along, along

    found = measured_bend(
        pair_heading(*marks(heading)), pair_heading(*marks(heading - bend))
    )
    assert found == pytest.approx(bend, abs=1e-12)


def test_impossible_curvature_gives_a_half_circle():
    front = np.array([0.05, 0.0])
    rear = np.zeros(2)
    arc = arc_between(front, rear, np.array(1e3))
    assert np.isfinite(arc).all()
    assert np.abs(np.hypot(*(arc - [0.025, 0.0]).T) - 0.025).max() < 1e-12
    assert np.abs(arc_between(front, rear, np.array(0.0))[:, 1]).max() < 1e-15


@pytest.mark.parametrize("rate", [15.0, 120.0])
def test_oscillation_is_attenuated_as_stated_without_lag(rate):
    time = np.arange(400) / rate
    omega = 2 * np.pi * 0.6
    n = np.arange(1, 6)
    kept = 3 * (n * np.sin(n * omega / rate)).sum() / (5 * 6 * 5.5 * omega / rate)
    found = moving_derivative(time, np.sin(omega * time))[5:-5]
    assert np.abs(found - kept * omega * np.cos(omega * time[5:-5])).max() < 1e-9


def test_slope_equals_that_of_the_least_squares_line():
    random = np.random.default_rng(0)
    time = np.cumsum(random.uniform(0.01, 0.1, 40))
    values = random.standard_normal((40, 3))
    found = moving_derivative(time, values)
    for k in (0, 3, 20, 39):
        rows = slice(max(0, k - 5), k + 6)
        assert found[k] == pytest.approx(
            np.polyfit(time[rows], values[rows], 1)[0], rel=1e-9
        )
