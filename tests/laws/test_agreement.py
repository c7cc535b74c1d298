"""With the same wheels, track and stiff bends both plants crawl alike, over the grid and not at one point."""

from __future__ import annotations

from dataclasses import replace

import pytest
from snakes import robot

from srs_twin import AnalyticalSnake, Gait, TwinSnake, compare, rollout

STIFF = robot(stiffness=20.0)


@pytest.mark.parametrize(
    ("gap", "f", "kilopascals", "limit"),
    [(0.0, 1.0, 41, 0.04), (0.0, 2.0, 55, 0.04), (0.018, 1.5, 48, 0.06)],
)
def test_matched_plants_crawl_alike(gap, f, kilopascals, limit):
    spec = replace(STIFF, geometry=replace(STIFF.geometry, rigid_gap=gap))
    reference, candidate = (
        rollout(plant, Gait(f), 4.0)
        for plant in (
            AnalyticalSnake(spec, friction="wheel", supply_pa=1e3 * kilopascals),
            TwinSnake(spec, supply_pa=1e3 * kilopascals),
        )
    )
    metrics = compare(reference, candidate).metrics
    assert abs(metrics["com_speed_rel"]) < limit
    assert metrics["bend_rms_rel"] < 0.02
    assert metrics["shape_rms_body"] < 0.02
