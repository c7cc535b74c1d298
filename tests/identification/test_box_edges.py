"""Fits of a body width to box edges: a known width is recovered, and the shipped one is current."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from box_edges import WIDTH, BoxEdges, fit_width
from hypothesis import given
from hypothesis import strategies as st
from published_tables import published_runs
from table8_fit import place
from table8_width import edges, edges_table, fit

from srs_twin import AnalyticalSnake, load_robot, load_scenario, rollout
from srs_twin.comparison.centre_line import body_sides
from srs_twin.control.gait import Gait
from srs_twin.errors import InputError
from srs_twin.identification.fit_file import load_fit

pytestmark = pytest.mark.fast

SPEC = load_robot("gen4")


@given(width=st.floats(0.02, 0.3), drawn=st.lists(st.floats(0.01, 0.1), min_size=6, max_size=6))
def test_a_known_width_is_recovered(width, drawn):
    """The expected edges are the extent of the centre line plus half of the width."""
    runs = [
        BoxEdges(
            0.1 * i,
            (drawn[2 * i] + width / 2, drawn[2 * i + 1] + width / 2),
            (drawn[2 * i] + SPEC.geometry.width / 2, drawn[2 * i + 1] + SPEC.geometry.width / 2),
        )
        for i in range(3)
    ]
    assert fit_width(runs, SPEC).values[WIDTH] == pytest.approx(width, rel=1e-3)


def test_a_wider_body_moves_equally_with_edges_farther_by_half_the_difference():
    """Assumption of the fit, checked for a snake that crawls and turns."""
    wide = replace(SPEC, geometry=replace(SPEC.geometry, width=SPEC.geometry.width + 0.04))
    runs = [rollout(AnalyticalSnake(spec), Gait(1.0, 0.2), 2.0) for spec in (SPEC, wide)]
    assert np.array_equal(runs[0]["com_x"], runs[1]["com_x"])
    narrow, far = (body_sides(run, spec.geometry) for run, spec in zip(runs, (SPEC, wide), strict=True))
    apart = np.hypot(*np.moveaxis(far - narrow, -1, 0))
    assert apart == pytest.approx(np.full_like(apart, 0.02), abs=1e-9)


def test_an_edge_row_cannot_fit_and_validate():
    run = BoxEdges(0.1, (0.1, 0.1), (0.05, 0.05))
    with pytest.raises(InputError, match=r"offset 0\.1"):
        fit_width([run], SPEC, validation=[run])
    with pytest.raises(InputError, match="give at least one"):
        fit_width([], SPEC)


def test_the_shipped_width_is_reproduced_by_its_command():
    shipped = load_fit(place("width"))
    assert fit().parameters == shipped.parameters
    assert {data.name for data in shipped.data if data.role == "fit"} == {
        "offset 0",
        "offset 0.3",
        "offset -0.3",
    }
    table = {f"offset {row.offset:g}": (row.left_m, row.right_m) for row in published_runs()}
    for data in shipped.data:
        assert (data.measured["left_m"], data.measured["right_m"]) == table[data.name]
    page = (Path(__file__).parents[2] / "docs/dissertation-data.md").read_text("utf-8")
    assert edges_table(shipped) in page


def test_the_scenario_has_the_robot_of_the_fits():
    moves, width = load_fit(place("analytical")).estimate().values, load_fit(place("width")).estimate().values
    robot = load_scenario("ilc_table8").robot
    assert robot.geometry.segment_length == moves["geometry.segment_length_m"]
    assert robot.friction.mu_t == moves["friction.mu_t"]
    assert robot.modules.sensor_bias == (moves["modules.sensor_bias_rad"],) * robot.segments
    assert robot.geometry.width == pytest.approx(width[WIDTH], abs=5e-5)
    assert robot.mass == SPEC.mass and robot.bending == SPEC.bending


def test_edges_are_read_for_both_sides():
    rows = edges(load_fit(place("analytical")), "fit")
    assert len(rows) == 3
    for row in rows:
        assert min(*row.measured, *row.drawn) > 0
