"""Plants with the same wheels, track and stiff bends agree in speed and yaw rate at several points."""

from __future__ import annotations

from dataclasses import replace

import pytest
from snakes import robot

from srs_twin import (
    AnalyticalSnake,
    Gait,
    PreloadedContact,
    Trajectory,
    TwinSnake,
    compare,
    rollout,
)
from srs_twin.comparison.metrics import plant_metrics

STIFF = robot(stiffness=20.0)


@pytest.mark.parametrize(
    ("gap", "f", "kilopascals", "limit"),
    [(0.0, 1.0, 41, 0.04), (0.0, 2.0, 55, 0.04), (0.018, 1.5, 48, 0.06)],
)
def test_matched_plants_have_equal_speed(gap, f, kilopascals, limit):
    reference, candidate = both(gap, f, kilopascals, 0.0, 4.0)
    metrics = compare(reference, candidate).metrics
    assert abs(metrics["com_speed_rel"]) < limit
    assert metrics["bend_rms_rel"] < 0.02
    assert metrics["shape_rms_body"] < 0.02


@pytest.mark.parametrize("f", [1.0, 1.5, 2.0])
def test_matched_plants_have_equal_yaw_rate(f):
    reference, candidate = both(0.018, f, 48, 0.2, 6.0)
    yaw, twin_yaw = (
        plant_metrics(run)["yaw_rate_rad_s"] for run in (reference, candidate)
    )
    assert yaw > 0.5
    assert twin_yaw == pytest.approx(yaw, rel=0.1)


@pytest.mark.parametrize(
    ("gap", "f", "kilopascals", "offset"),
    [
        (0.0, 1.0, 41, 0.0),
        pytest.param(0.0, 2.0, 55, 0.0, marks=pytest.mark.slow),
        pytest.param(0.018, 1.5, 41, 0.0, marks=pytest.mark.slow),
        (0.018, 2.0, 48, 0.2),
        pytest.param(0.018, 1.0, 55, 0.2, marks=pytest.mark.slow),
    ],
)
def test_matched_plants_on_skids_have_equal_speed(gap, f, kilopascals, offset):
    reference, candidate = both(
        gap, f, kilopascals, offset, 4.0, friction="ellipse", wheels="skid"
    )
    metrics = compare(reference, candidate).metrics
    assert abs(metrics["com_speed_rel"]) < 0.025
    assert metrics["bend_rms_rel"] < 0.01
    assert metrics["shape_rms_body"] < 0.01
    yaw, twin_yaw = (
        plant_metrics(run)["yaw_rate_rad_s"] for run in (reference, candidate)
    )
    assert twin_yaw == pytest.approx(yaw, rel=0.03, abs=0.002)
    assert (abs(yaw) > 0.5) == (offset > 0)


def both(
    gap: float,
    f: float,
    kilopascals: float,
    offset: float,
    duration: float,
    friction: str = "wheel",
    wheels: str = "rolling",
) -> list[Trajectory]:
    """Run both plants with one gait; return the trajectories of the analytical model and the twin."""
    spec = replace(STIFF, geometry=replace(STIFF.geometry, rigid_gap=gap))
    plants = (
        AnalyticalSnake(spec, friction=friction, supply_pa=1e3 * kilopascals),
        TwinSnake(spec, contact=PreloadedContact(wheels), supply_pa=1e3 * kilopascals),
    )
    return [rollout(plant, Gait(f, offset), duration) for plant in plants]
