"""Constant-curvature geometry against the centre line integrated along its length."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.integrate import quad

from srs_twin.robot.geometry import (
    body_shape,
    chord,
    chord_derivatives,
    relative_headings,
)
from srs_twin.robot.world import MovableObject

pytestmark = pytest.mark.fast

BEND = st.floats(-3.0, 3.0)
LENGTH = st.floats(0.01, 0.2)
GAP = st.floats(0.0, 0.1)


def segment_end(bend: float, length: float, gap: float) -> complex:
    """Return the end of a segment that starts along x, as x + iy: half a gap, an arc, half a gap."""
    arc = complex(
        quad(lambda s: np.cos(bend * s / length), 0, length, epsabs=1e-14)[0],
        quad(lambda s: np.sin(bend * s / length), 0, length, epsabs=1e-14)[0],
    )
    return gap / 2 + arc + gap / 2 * np.exp(1j * bend)


@given(BEND, LENGTH, GAP)
def test_chord_connects_the_ends_along_the_mean_heading(bend, length, gap):
    end = segment_end(bend, length, gap)
    # The chord is positive for bends within ±3 rad, even with long gaps.
    assert end * np.exp(-1j * bend / 2) == pytest.approx(
        complex(chord(bend, length, gap), 0), abs=1e-12
    )


@pytest.mark.parametrize(
    "bend", [0.0, 1e-300, 1e-9, -1e-3, 0.0999, -0.1001, 0.3, -2.0, 6.0]
)
def test_derivatives_of_the_chord_are_those_of_its_integral(bend):
    """The chord is L = l ∫ cos(q s) ds + L_o cos(q/2), with s from −1/2 to 1/2."""
    node, weight = np.polynomial.legendre.leggauss(20)
    s = node / 2
    weight = 0.04 * weight / 2
    cosine = 0.02 * np.cos(bend / 2)
    sine = 0.02 * np.sin(bend / 2)
    expected = (
        weight @ np.cos(bend * s) + cosine,
        -(weight * s) @ np.sin(bend * s) - sine / 2,
        -(weight * s**2) @ np.cos(bend * s) - cosine / 4,
    )
    assert chord_derivatives(bend, 0.04, 0.02) == pytest.approx(
        expected, rel=1e-12, abs=0
    )


def integrated_body(
    bends: np.ndarray, length: float, gap: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return connectors (x + iy) and headings, head first, of a body with its tail at 0 along x."""
    positions = [0j]
    headings = [0.0]
    for bend in bends[::-1]:
        positions.append(
            positions[-1] + segment_end(bend, length, gap) * np.exp(1j * headings[-1])
        )
        headings.append(headings[-1] + bend)
    return np.array(positions[::-1]), np.array(headings[::-1])


@given(st.lists(st.floats(-2, 2), min_size=1, max_size=6), st.integers(0, 1000))
def test_body_shape_is_the_integrated_centre_line(bends, seed):
    mass = np.random.default_rng(seed).uniform(0.01, 0.3, size=len(bends) + 1)
    positions, headings = integrated_body(np.array(bends), 0.037, 0.018)
    mean = headings.mean()
    expected = (positions - (mass @ positions) / mass.sum()) * np.exp(-1j * mean)
    position = body_shape(np.array(bends), mass, 0.037, 0.018)
    assert position == pytest.approx(
        np.stack([expected.real, expected.imag], axis=-1), abs=1e-12
    )
    assert relative_headings(np.array(bends)) == pytest.approx(
        headings - mean, abs=1e-12
    )
    assert mass @ position == pytest.approx([0, 0], abs=1e-14)
    assert relative_headings(np.array(bends)).mean() == pytest.approx(0, abs=1e-14)


@pytest.mark.parametrize(
    ("size", "moments"),
    [((0.06, 0.02), (0.06**2 / 12, 0.02**2 / 12)), ((0.03,), (0.03**2 / 4,) * 2)],
)
def test_objects_have_the_second_moments_of_their_area(size, moments):
    item = MovableObject(size, 0.1, 0.3, 0.0, 0.0)
    assert item.gyration**2 == pytest.approx(sum(moments))
    points = np.array(item.supports)
    assert points.mean(axis=0) == pytest.approx([0, 0])
    if item.is_box:
        assert (points**2).mean(axis=0) == pytest.approx(moments)
    else:
        # The moment of friction is that of a uniform pressure, ∫ r² dr / ∫ r dr.
        assert np.hypot(*points.T) == pytest.approx(2 / 3 * 0.03)


def test_body_shape_supports_leading_axes():
    bends = np.random.default_rng(1).uniform(-1, 1, size=(4, 3, 5))
    whole = body_shape(bends, np.ones(6), 0.04, 0.01)
    assert whole.shape == (4, 3, 6, 2)
    for index in np.ndindex(4, 3):
        assert whole[index] == pytest.approx(
            body_shape(bends[index], np.ones(6), 0.04, 0.01), abs=1e-15
        )
