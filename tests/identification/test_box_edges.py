"""Fits of a width to box edges: a known one is recovered, the shipped one is current and in its scenario."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from benchmark_runs import run_benchmark
from box_edges import WIDTH, BoxEdges, fit_width
from conftest import ROOT
from hypothesis import given, strategies as st
from published_tables import published_runs
from table8 import fit_body_width, place

from srs_twin import AnalyticalSnake, load_robot, load_scenario, rollout
from srs_twin.comparison.centre_line import body_sides
from srs_twin.control.gait import Gait
from srs_twin.identification.fit_file import load_fit

pytestmark = pytest.mark.fast

SPEC = load_robot("gen4")


@given(
    width=st.floats(0.02, 0.3),
    drawn=st.lists(st.floats(0.01, 0.1), min_size=6, max_size=6),
)
def test_a_known_width_is_recovered(width, drawn):
    """Edges of a body by a sum of our own: how far the middle reaches, and half of the width."""
    runs = [
        BoxEdges(
            0.1 * i,
            (drawn[2 * i] + width / 2, drawn[2 * i + 1] + width / 2),
            (
                drawn[2 * i] + SPEC.geometry.width / 2,
                drawn[2 * i + 1] + SPEC.geometry.width / 2,
            ),
        )
        for i in range(3)
    ]
    assert fit_width(runs, SPEC).values[WIDTH] == pytest.approx(width, rel=1e-3)


def test_a_wider_body_moves_alike_and_reaches_farther_by_half():
    """What the fit takes for granted, of a snake that crawls and turns."""
    wide = replace(
        SPEC, geometry=replace(SPEC.geometry, width=SPEC.geometry.width + 0.04)
    )
    runs = [
        rollout(AnalyticalSnake(item), Gait(1.0, 0.2), 2.0) for item in (SPEC, wide)
    ]
    assert np.array_equal(runs[0]["com_x"], runs[1]["com_x"])
    narrow, far = (
        body_sides(run, spec.geometry)
        for run, spec in zip(runs, (SPEC, wide), strict=True)
    )
    apart = np.hypot(*np.moveaxis(far - narrow, -1, 0))
    assert apart == pytest.approx(np.full_like(apart, 0.02), abs=1e-9)


def test_the_shipped_width_is_what_its_command_finds():
    shipped = load_fit(place("width"))
    assert fit_body_width().parameters == shipped.parameters
    assert {item.name for item in shipped.data if item.role == "fit"} == {
        "offset 0",
        "offset 0.3",
        "offset -0.3",
    }
    table = {
        f"offset {row.offset:g}": (row.left_m, row.right_m) for row in published_runs()
    }
    for item in shipped.data:
        assert (item.measured["left_m"], item.measured["right_m"]) == table[item.name]


@pytest.mark.slow
def test_the_page_shows_the_edges_of_the_shipped_width():
    done = run_benchmark("table8_fit.py", "--width", "--show")
    assert done.returncode == 0, done.stderr
    table = "\n".join(line for line in done.stdout.splitlines() if line.startswith("|"))
    assert "Table 8 (m)" in table and table in (
        ROOT / "docs/reproduction.md"
    ).read_text("utf-8")


def test_the_scenario_has_the_robot_of_the_fits():
    moves = load_fit(place("analytical")).estimate().values
    width = load_fit(place("width")).estimate().values
    robot = load_scenario("ilc_table8").robot
    assert robot.geometry.segment_length == moves["geometry.segment_length_m"]
    assert robot.friction.mu_t == moves["friction.mu_t"]
    assert (
        robot.modules.sensor_bias
        == (moves["modules.sensor_bias_rad"],) * robot.segments
    )
    assert robot.geometry.width == pytest.approx(width[WIDTH], abs=5e-5)
    assert robot.mass == SPEC.mass and robot.bending == SPEC.bending
