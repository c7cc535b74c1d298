"""Metrics of following for prescribed motions with known values."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from synthetic import Snake, with_columns

from srs_twin.comparison.metrics import METRIC_UNITS, plant_metrics
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.metrics import (
    FOLLOWING_UNITS,
    METRICS,
    centre_points,
    following_metrics,
    legs,
)
from srs_twin.trajectory import Trajectory

pytestmark = pytest.mark.fast

WIDTH = 0.03
BODY = Footprint.box(0.1, 0.0, speed=0.2, curvature=5.0)


def plan(segments, time=0.0, outcome="found"):
    return {
        "time": time,
        "outcome": outcome,
        "reason": "",
        "nodes": 7,
        "segments": segments,
    }


def line(length=1.2, y=0.0, x=0.0):
    return [x, y, 0.0, 0.0, length, 0.0, 0.2]


def followed(
    trajectory, plans, *, goal=(1.2, 0.0, None, 0.05), footprint=BODY, width=WIDTH
):
    """Return the trajectory with the metadata of a follower."""
    about = {
        "plans": plans,
        "goal": dict(zip(("x", "y", "heading", "radius"), goal, strict=True)),
        "world": {"obstacles": [], "polygons": [], "bounds": None},
        "footprint": asdict(footprint),
    }
    metadata = {
        **trajectory.metadata,
        "control": {"following": about},
        "body_width_m": width,
        "segment_length_m": Snake.segment_length,
        "rigid_gap_m": Snake.rigid_gap,
    }
    return Trajectory(trajectory.columns, events=trajectory.events, metadata=metadata)


def moved(trajectory, lateral):
    columns = {
        name: column + lateral * name.startswith(("y_", "com_y"))
        for name, column in trajectory.columns.items()
    }
    return replace(trajectory, columns=columns)


STILL = Snake(amplitude=0.0, sway=(0.0, 0.0), heading_sway=0.0)
"""Rod that slides along x at 0.2 m/s for 6 s."""


def test_run_without_a_plan_has_no_following_metrics():
    run = STILL.trajectory()
    metrics = plant_metrics(run)
    assert all(metrics[name] is None for name in FOLLOWING_UNITS)
    assert METRICS.why_undefined("replans", run) == "the run follows no plan"
    assert FOLLOWING_UNITS.items() <= METRIC_UNITS.items()


def test_cross_track_of_a_rod_parallel_to_its_path():
    run = followed(moved(STILL.trajectory(), -0.01), [plan([line()])])
    metrics = following_metrics(run)
    assert metrics["cross_track_rms_m"] == pytest.approx(0.01)
    assert metrics["cross_track_max_m"] == pytest.approx(0.01)
    assert metrics["goal_reached"] == metrics["plan_found"] == 1
    assert metrics["replans"] == 0
    assert metrics["arrival_error_m"] == pytest.approx(0.01)
    assert metrics["arrival_heading_error_rad"] is None
    for name, why in (
        ("arrival_heading_error_rad", "the goal has no heading"),
        ("replans", ""),
    ):
        assert METRICS.why_undefined(name, run) == why
    assert metrics["following_time_s"] == pytest.approx(6.0)
    assert (metrics["plan_length_m"], metrics["plan_nodes"]) == (pytest.approx(1.2), 7)
    # 10 + 15 mm are within 25 and 50.
    assert (metrics["inside_fraction"], metrics["inside_50mm_fraction"]) == (1.0, 1.0)


def test_inside_fraction_counts_the_time_within_the_edges():
    trajectory = STILL.trajectory()
    lateral = np.where(
        trajectory.time < 1.5, 0.0, np.where(trajectory.time < 3.0, 0.02, 0.04)
    )
    metrics = following_metrics(followed(moved(trajectory, lateral), [plan([line()])]))
    # With half the width 15, 35 and 55 mm from the path: 50 mm planned, 25 mm in the
    # text.
    assert metrics["inside_fraction"] == pytest.approx(0.5, abs=0.003)
    assert metrics["inside_50mm_fraction"] == pytest.approx(0.25, abs=0.003)


def test_edges_shift_with_the_turn():
    """Rod on a circle: its middle stays on the path, its ends are outside."""
    radius = 0.3
    run = Snake(
        speed=0.2,
        yaw_rate=0.2 / radius,
        amplitude=0.0,
        sway=(0, 0),
        heading_sway=0.0,
        duration=2.0,
    ).trajectory()
    half = run.metadata["body_length_m"] / 2
    reach = math.hypot(radius + WIDTH / 2, half) - radius
    arc = [0.0, 0.0, 0.0, 1 / radius, 1.8 * math.pi * radius, 0.2, 0.2]
    for outer, fraction in ((reach + 1e-3, 1.0), (reach - 1e-3, 0.0)):
        box = Footprint.box(0.2, 0.0, speed=0.2, curvature=1 / radius)
        edges = replace(box, right=(0.1, 0.1, outer))
        metrics = following_metrics(followed(run, [plan([arc])], footprint=edges))
        late = metrics["inside_fraction"]
        # At first the tail is before the start, where the path is extended straight.
        assert late == pytest.approx(fraction, abs=0.5) and (late > 0.5) == (
            fraction == 1.0
        )
    # The box of Section 5.2 is shifted outward by 10 mm in turns of 60 degrees in 0.2 m.
    allowed = 0.025 + 0.01 * (0.2 / radius) / math.radians(60)
    for inside, reach in ((True, allowed - 1e-4), (False, allowed + 1e-4)):
        width = 2 * (math.sqrt((radius + reach) ** 2 - half**2) - radius)
        metrics = following_metrics(followed(run, [plan([arc])], width=width))
        assert (metrics["inside_50mm_fraction"] > 0.5) == inside


def test_each_plan_counts_from_its_start():
    run = followed(STILL.trajectory(), [plan([line()]), plan([line(y=0.03)], time=3.0)])
    parts = list(legs(run))
    assert [part.samples for part in parts] == [slice(0, 300), slice(300, 601)]
    metrics = following_metrics(run)
    assert metrics["replans"] == 1 and metrics["plan_max_heading_jump_rad"] == 0
    assert metrics["cross_track_rms_m"] == pytest.approx(0.03 * math.sqrt(301 / 601))


def test_arrival_error_and_heading_without_oscillation():
    run = Snake(yaw_rate=0.1, duration=4.0).trajectory()
    x, y = run.com[-1]
    metrics = following_metrics(
        followed(run, [plan([line()])], goal=(x + 0.06, y, 0.5, 0.05))
    )
    assert metrics["goal_reached"] == 0
    assert metrics["arrival_error_m"] == pytest.approx(0.06)
    # The heading at the end is 0.4 without the oscillation.
    assert metrics["arrival_heading_error_rad"] == pytest.approx(0.1, abs=2e-3)
    run = Snake(yaw_rate=0.1, duration=4.0, periodic=False).trajectory()
    kinked = plan([line(0.6), [0.6, 0.0, -0.2, 0.0, 0.6, 0.0, 0.2]])
    metrics = following_metrics(followed(run, [kinked], goal=(0.0, 0.0, 0.5, 0.05)))
    last = abs(run["heading"][-1] - 0.5)
    assert metrics["arrival_heading_error_rad"] == pytest.approx(last)
    assert metrics["plan_max_heading_jump_rad"] == pytest.approx(0.2)


@pytest.mark.parametrize(("deep", "reached"), [(-0.01, 1), (0.0005, 1), (0.01, 0)])
def test_a_goal_is_not_reached_through_an_obstacle(deep, reached):
    run = STILL.trajectory()
    run = with_columns(run, clearance=np.linspace(0.3, -deep, len(run)))
    metrics = following_metrics(
        followed(run, [plan([line()])], goal=(*run.com[-1], None, 0.05))
    )
    assert metrics["goal_reached"] == reached


def test_metrics_without_a_path():
    run = followed(STILL.trajectory(), [plan([], outcome="not_found")])
    metrics = following_metrics(run)
    assert metrics["plan_found"] == 0 and metrics["plan_length_m"] is None
    assert metrics["cross_track_rms_m"] is None and metrics["inside_fraction"] is None


def test_middles_of_segments_lie_on_their_arcs():
    """Compare with the centre line that `synthetic` integrates."""
    snake = Snake(amplitude=0.9, rigid_gap=0.0)
    run = snake.trajectory()
    points, heading = centre_points(run)
    middles = points[:, 5:]
    arcs = heading[:, 5:]
    bend = run.stack("bend")
    for j in range(4):
        # From connector j back along the arc: chord of half of it, with bend/2, from
        # its heading.
        half = snake.segment_length / 2
        q = bend[:, j] / 2
        chord = half * np.sinc(q / 2 / np.pi)
        at = run.stack("connector_heading")[:, j] - q / 2
        expected = run.position[:, j] - chord[:, None] * np.stack(
            [np.cos(at), np.sin(at)], axis=-1
        )
        assert middles[:, j] == pytest.approx(expected, abs=2e-4)
        assert arcs[:, j] == pytest.approx(run.stack("connector_heading")[:, j] - q)
