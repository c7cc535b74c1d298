"""Published theory of locomotion: serpenoid without slip, local connection, independence of the rate."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.curvature_wave import CurvatureWave, PrescribedBends, continuous_snake
from helpers.local_connection import displacement, loop, wheeled
from scipy.special import j0

from srs_twin import AnalyticalSnake, rollout
from srs_twin.control.replay import HoldValves
from srs_twin.errors import DivergedError
from srs_twin.robot.spec import Friction

PERIOD = 60.0


def without_inertia(spec, pneumatics, period=PERIOD, **settings):
    """Run the model for two periods, so slowly that inertia is negligible."""
    plant = AnalyticalSnake(
        spec,
        pneumatics=pneumatics,
        track=0.0,
        tick=period / 50,
        timestep=period / 5_000,
        slip_speed=1e-4 / period,
        tolerance=1e-3 / period,
        **settings,
    )
    return rollout(plant, HoldValves("vent", "vent"), 2 * period, record_hz=50 / period)


def distance(run):
    return math.hypot(*(run.com[-1] - run.com[-51]))


@pytest.mark.slow
@pytest.mark.parametrize(("winding", "within"), [(0.4, 0.003), (0.8, 0.004)])
def test_a_serpenoid_without_slip_advances_by_the_mean_cosine_of_its_heading(
    winding, within
):
    """Hirose: λ J₀(α) per period.

    The slip at a ratio of 10,000 and 32 segments cause the rest.
    """
    spec = continuous_snake(1e-4, 1e-4, 1.0)
    wave = CurvatureWave(spec, amplitude=4 * math.pi * winding, period=PERIOD, waves=2)
    assert 2 * distance(without_inertia(spec, wave)) == pytest.approx(
        j0(winding), rel=within
    )


@pytest.mark.parametrize(
    ("segments", "friction", "middle", "radius", "friction_law"),
    [
        (2, Friction(1e-4, 1.0), (0.7, -0.7), 0.3, "axis"),
        (4, Friction(100.0, 1000.0), (0.0,) * 4, 0.5, "viscous"),
    ],
)
def test_the_displacement_without_inertia_is_that_of_the_local_connection(
    segments, friction, middle, radius, friction_law
):
    """Kelly and Murray, for wheels without slip and for viscous friction."""
    spec = wheeled(segments, friction)
    path = loop(middle, radius, PERIOD)
    run = without_inertia(spec, PrescribedBends(spec, path), friction=friction_law)
    x, y, heading = (
        run[f"{name}_1"][[-51, -1]] for name in ("x", "y", "connector_heading")
    )
    (dx, dy), c, s = (
        (x[1] - x[0], y[1] - y[0]),
        math.cos(heading[0]),
        math.sin(heading[0]),
    )
    moved = np.array([c * dx + s * dy, c * dy - s * dx, heading[1] - heading[0]])
    own = displacement(path, PERIOD, spec, slips=friction_law == "viscous")
    assert np.abs(own).max() > 0.05
    assert moved == pytest.approx(own, abs=2e-3 * np.abs(own).max())


def wave_speed(spec, period=PERIOD):
    """Return the distance per period under a slow wave of curvature, body lengths."""
    wave = CurvatureWave(spec, amplitude=7.0, period=period)
    return distance(without_inertia(spec, wave, period))


@pytest.mark.slow
def test_isotropic_skin_hardly_moves():
    speed = wave_speed(continuous_snake(0.1, 0.1, 0.1, segments=16))
    assert speed < 0.02 * wave_speed(continuous_snake(0.1, 0.1, 1.0, segments=16))


@pytest.mark.slow
def test_distance_per_period_does_not_depend_on_the_rate():
    spec = continuous_snake(0.11, 0.14, 0.19, segments=16)
    assert wave_speed(spec, 120.0) == pytest.approx(wave_speed(spec, 60.0), rel=1e-4)


@pytest.mark.slow
def test_wave_of_curvature_has_the_speed_of_published_theory():
    """Hu et al. 2009; benchmarks/theory.py has further cases and an independent solver."""
    assert wave_speed(continuous_snake(0.11, 0.14, 0.19)) == pytest.approx(
        0.1255, rel=0.01
    )
    other = wave_speed(continuous_snake(0.11, 0.11, 0.19, friction_law="ellipse"))
    assert other == pytest.approx(
        1.9 * wave_speed(continuous_snake(0.11, 0.11, 0.19)), rel=0.05
    )


@pytest.mark.slow
def test_a_model_on_skin_that_fails_in_its_first_step_is_reported():
    spec = continuous_snake(0.1, 0.1, 1e3)
    wave = CurvatureWave(spec, amplitude=0.8 * math.pi, period=PERIOD, waves=2)
    with pytest.raises(DivergedError, match="no plausible solution"):
        without_inertia(spec, wave)
