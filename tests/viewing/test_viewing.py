"""Recordings, plots and reports of synthetic runs; geometry compared with an independent integration."""

from __future__ import annotations

import base64
import io
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import rerun as rr
from hero import write_plan_animation
from matplotlib import patches
from matplotlib.figure import Figure
from matplotlib.image import imread
from processes import python
from screenshot import screenshots
from synthetic import Snake, numbered, sampled, with_columns
from viewing_runs import directions, flat, pair, read_back, robot, run

from srs_twin.comparison.centre_line import centre_lines, line_height
from srs_twin.comparison.compare import (
    AssumptionShare,
    Attribution,
    MeasuredDifference,
    compare,
)
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.errors import InputError
from srs_twin.robot.world import Circle, MovableObject, Polygon, World
from srs_twin.trajectory import Event
from srs_twin.viewing.content import RunContent
from srs_twin.viewing.html.report import write_report
from srs_twin.viewing.plots.from_above import plan_view, strobe_times
from srs_twin.viewing.plots.runs import (
    bend_plot,
    error_plot,
    measured_plot,
    pressure_plot,
    speed_plot,
    tracking_plot,
)
from srs_twin.viewing.plots.signals import (
    body_line,
    forward_speed,
    period_speed,
    reference_period,
    wheel_centres,
)
from srs_twin.viewing.plots.style import MINUS_RGB, PLUS_RGB, STYLES, pressure_colors
from srs_twin.viewing.rerun import viewer
from srs_twin.viewing.rerun.blueprint import Layout, run_blueprint, scene_view
from srs_twin.viewing.rerun.recording import (
    subsample,
    write_recording,
    write_side_by_side,
)
from srs_twin.viewing.rerun.viewer import open_recording, verify_recording


@pytest.fixture(scope="module", autouse=True)
def strict():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture(scope="module")
def spec():
    return robot()


@pytest.fixture(scope="module")
def runs():
    return pair()


def integrated(theta, bend, start, fraction):
    """Points of a segment from its tangent alone, front to rear, shape (len(fraction), 2)."""
    where = np.linspace(0, 1, 20001)
    tangent = np.exp(1j * (theta - bend * where))
    steps = (tangent[1:] + tangent[:-1]) / 2 * 0.037 / 20000
    along = np.concatenate([[0], np.cumsum(steps)])
    stub = start - 0.009 * np.exp(1j * theta)
    points = stub - np.interp(fraction, where, along)
    return np.stack([points.real, points.imag], axis=-1)


def test_centre_line_is_the_integral_of_its_tangent(spec, runs):
    snake = runs["analytical"]
    lines = centre_lines(snake, spec.geometry, divisions=8)
    assert lines.shape == (len(snake), 4, 11, 2)
    for row, j in ((0, 0), (333, 2), (700, 3)):
        theta = snake[f"connector_heading_{j + 1}"][row]
        bend = snake[f"bend_{j + 1}"][row]
        start = complex(snake[f"x_{j + 1}"][row], snake[f"y_{j + 1}"][row])
        expected = integrated(theta, bend, start, np.linspace(0, 1, 9))
        assert np.allclose(lines[row, j, 1:-1], expected, atol=1e-8)


def test_centre_line_ends_where_the_connectors_were_recorded(spec, runs):
    # Hinges do not quite make an arc.
    shifted = with_columns(runs["twin"], x_3=runs["twin"]["x_3"] + 1e-3)
    lines = centre_lines(shifted, spec.geometry)
    assert np.array_equal(lines[:, :, 0], shifted.position[:, :-1])
    assert np.allclose(lines[:, :, -1], shifted.position[:, 1:], atol=1e-15)
    assert body_line(shifted, spec.geometry).shape == (len(shifted), 4 * 10 + 1, 2)


def test_wheels_are_on_both_sides_of_the_connectors(spec, runs):
    snake = runs["twin"]
    left, right = np.moveaxis(wheel_centres(snake, spec.geometry), 2, 0)
    theta = snake.stack("connector_heading")
    towards_left = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    assert np.allclose(left - right, 2 * spec.geometry.half_track * towards_left)
    assert np.allclose((left + right) / 2, snake.position)


@pytest.mark.parametrize(("speed", "yaw_rate"), [(0.2, 0.0), (-0.05, 0.0), (0.2, 0.3)])
def test_period_speed_is_the_prescribed_one(speed, yaw_rate):
    snake = run(
        "twin", Snake(speed=speed, yaw_rate=yaw_rate, sway=(0.0, 0.0), duration=4.0)
    )
    time_s, mean = period_speed(snake, 0.5)
    # A chord of half a second on this circle is 0.1 % shorter than its arc.
    assert np.allclose(mean, speed, rtol=2e-3)
    assert time_s[0] == pytest.approx(0.25) and time_s[-1] == pytest.approx(3.75)
    assert forward_speed(snake)[1:-1].mean() == pytest.approx(speed, abs=0.01)


def test_period_speed_needs_a_period():
    snake = run("twin", Snake(duration=0.3))
    assert [len(part) for part in period_speed(snake, 0.5)] == [0, 0]


def test_pressure_colours_distinguish_the_chambers():
    plus, none, minus, unknown = pressure_colors(
        np.array([5e4, 0.0, -5e4, np.nan])
    ).astype(int)
    assert plus[0] > 150 > plus[1] and minus[1] > 150 > minus[0]
    assert np.array_equal(none, unknown) and none[:3].min() > 200
    assert {tuple(style.rgb) for style in STYLES.values()}.isdisjoint(
        {tuple(plus[:3]), tuple(minus[:3])}
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory, spec, runs):
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    both = compare(*runs.values())
    write_recording(path, RunContent(spec, runs, comparison=both), title="both")
    return path


def test_recording_of_ten_seconds_is_small_and_valid(recording):
    assert recording.stat().st_size < 5e6
    verify_recording(recording)


def test_the_recording_holds_the_signals(recording, runs):
    found = read_back(recording)

    def scalars(entity):
        seconds, values = found[entity]["Scalars:scalars"]
        return seconds, flat(values)

    for plant, snake in runs.items():
        for j in (1, 4):
            seconds, bends = scalars(f"/module/{j}/bend/{plant}")
            assert np.allclose(seconds, snake.time, atol=1e-9)
            assert np.array_equal(bends, snake[f"bend_{j}"])
            _, kilopascal = scalars(f"/module/{j}/pressure/{plant}")
            difference = snake[f"pressure_plus_{j}"] - snake[f"pressure_minus_{j}"]
            assert np.allclose(1e3 * kilopascal, difference)
        _, heading = scalars(f"/body/heading/{plant}")
        assert np.array_equal(heading, snake["heading"])
        _, mean = scalars(f"/body/speed/{plant}")
        assert np.array_equal(mean, period_speed(snake, 0.5)[1])
    both = compare(*runs.values())
    for name, error in (("shape", both.shape_error), ("path", both.path_error)):
        assert np.allclose(scalars(f"/comparison/{name}")[1], 1e3 * error)


def test_recording_contains_the_recorded_positions(recording, spec, runs):
    found = read_back(recording)
    twin, ghost = (subsample(runs[plant], 50) for plant in ("twin", "analytical"))
    segment = found["/world/twin/body/segment_2"]
    seconds, places = segment["Capsules3D:translations"]
    assert np.allclose(np.diff(seconds), 0.02)
    places = flat(places).reshape(len(twin), -1, 3)
    assert np.allclose(places[:, 0, :2], twin.position[:, 1], atol=1e-6)
    # Each capsule ends at the start of the next capsule.
    _, quaternions = segment["Capsules3D:quaternions"]
    axis = directions(quaternions, [0, 0, 1]).reshape(places.shape)
    step = np.diff(places, axis=1)
    step /= np.linalg.norm(step, axis=-1, keepdims=True)
    assert np.allclose(axis[:, :-1], step, atol=1e-3)

    _, vertices = found["/world/analytical/body"]["Mesh3D:vertex_positions"]
    middle = flat(vertices).reshape(len(ghost), -1, 6, 3).mean(axis=2)
    expected = body_line(ghost, spec.geometry, 6)
    assert np.allclose(middle[..., :2], expected, atol=1e-6)
    _, strips = found["/world/twin/trail"]["LineStrips3D:strips"]
    steps = flat(strips.flatten()).reshape(len(twin), 2, 3)[..., :2]
    assert np.allclose(steps[1:], np.stack([twin.com[:-1], twin.com[1:]], 1), atol=1e-6)
    radius = spec.geometry.wheel_radius
    wheels = wheel_centres(twin, spec.geometry)
    for entity, column, places, height in (
        (
            "twin/connectors",
            "Boxes3D:centers",
            twin.position,
            line_height(spec.geometry),
        ),
        ("twin/wheels", "Cylinders3D:centers", wheels, radius),
        ("analytical/com", "Points3D:positions", ghost.com, 0.003),
    ):
        drawn = flat(found[f"/world/{entity}"][column][1]).reshape(-1, 3)
        assert np.allclose(drawn[:, :2], places.reshape(-1, 2), atol=1e-6)
        assert np.allclose(drawn[:, 2], height)


def test_the_camera_follows_the_middle_of_the_plants_and_keeps_both_in_the_picture(
    spec, runs, tmp_path
):
    path = tmp_path / "far.rrd"
    ahead = with_columns(runs["twin"], com_x=runs["twin"]["com_x"] + 0.7)
    both = {"analytical": runs["analytical"], "twin": ahead}
    write_recording(path, RunContent(spec, both))
    _, places = read_back(path)["/world/eye"]["Points3D:positions"]
    middle = (runs["analytical"].com + ahead.com) / 2
    assert np.allclose(flat(places).reshape(-1, 3)[:, :2], middle, atol=1e-6)
    write_side_by_side(tmp_path / "two.rrd", {"a": path, "b": path})
    assert "/a/world/eye" in read_back(tmp_path / "two.rrd")
    # Of a viewer with 55° from top to bottom and a view wider than high.
    for apart in (0.0, 0.3, 1.5):
        eye = scene_view(layout_of(spec, apart)).properties["EyeControls3D"]
        distance = np.linalg.norm(eye.position.as_arrow_array().to_pylist()[0])
        half_height = distance * np.tan(np.radians(27.5))
        assert half_height > (apart + spec.geometry.body_length) / 2


@pytest.mark.parametrize("kind", ["gait", "learning", "bench"])
def test_plots_of_the_middle_module_are_shown_first(spec, kind):
    layout = replace(layout_of(spec, 0.0), segments=7, kind=kind)
    _, plots = run_blueprint(layout).root_container.contents
    shown = [tabs.contents[tabs.active_tab] for tabs in plots.contents[:2]]
    assert [view.origin.split("/")[:2] for view in shown] == [["module", "4"]] * 2


def layout_of(spec, apart):
    return Layout(
        plants=["analytical", "twin"],
        segments=4,
        start=np.zeros(2),
        heading=0.0,
        body_length=spec.geometry.body_length,
        separation=apart,
        period=0.5,
        compared=True,
    )


def test_recording_shows_contact_forces_during_contacts(tmp_path, spec):
    twin = run("twin", Snake(duration=2.0))
    force = np.zeros((len(twin), 5, 2))
    force[50:53, 0] = [0.3, -0.4]
    force[52:60, 3, 0] = 2.0
    force[100, 4, 1] = -0.1
    touched = with_columns(
        twin,
        **numbered("obstacle_force_x", force[..., 0]),
        **numbered("obstacle_force_y", force[..., 1]),
    )
    triangle = Polygon(((0, 1), (1, 1), (0.5, 2)))
    world = World((Circle(0.4, 0.1, 0.05),), polygons=(triangle,))
    path = tmp_path / "touched.rrd"
    write_recording(path, RunContent(spec, {"twin": touched}, world=world))
    verify_recording(path)
    arrows = read_back(path)["/world/twin/contact"]
    seconds, vectors = arrows["Arrows3D:vectors"]
    rows = [*range(50, 61), 100, 101]
    assert np.allclose(seconds, twin.time[rows], atol=1e-9)
    for row, vector in zip(rows, vectors, strict=True):
        pushed = force[row][force[row].any(axis=1)]
        drawn = np.array(vector.as_py() or []).reshape(-1, 3)
        assert np.allclose(drawn[:, :2], 0.05 * pushed, atol=1e-7)
        assert not drawn[:, 2].any()
    _, origins = arrows["Arrows3D:origins"]
    start = np.array(origins[1].as_py())[0, :2]
    assert np.allclose(start, twin.position[51, 0], atol=1e-6)


def no_pressures():
    bare = run("twin", Snake(duration=1.0))
    names = ("pressure", "valve")
    kept = {n: c for n, c in bare.columns.items() if not n.startswith(names)}
    return {"twin": replace(bare, columns=kept)}


ODD_RUNS = {
    "one plant": lambda: {"analytical": run("analytical", Snake(duration=2.0))},
    "no gait": lambda: {"twin": run("twin", Snake(duration=2.0, periodic=False))},
    "one sample": lambda: pair(duration=0.0),
    "no pressures": no_pressures,
    "another plant": lambda: (
        pair(duration=1.0) | {"lab": run("lab", Snake(duration=1.0))}
    ),
    "two connectors": lambda: pair(duration=1.0, connectors=2),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ODD_RUNS)
def test_unusual_runs_have_recording_and_report(tmp_path, name):
    runs = ODD_RUNS[name]()
    spec = robot(next(iter(runs.values())).position.shape[1])
    both = None
    if {"analytical", "twin"} <= runs.keys():
        both = compare(runs["analytical"], runs["twin"])
    content = RunContent(spec, runs, comparison=both)
    write_recording(tmp_path / "r.rrd", content)
    verify_recording(tmp_path / "r.rrd")
    plants = {plant: plant_metrics(run) for plant, run in runs.items()}
    metrics = {"plants": plants, "comparison": None}
    write_report(tmp_path / "r.html", content, scenario_title=name, metrics=metrics)
    # A single module has no plan view.
    figures = 4 + (both is not None) - (spec.segments == 1)
    assert (tmp_path / "r.html").read_text("utf-8").count("<figure>") == figures
    write_plan_animation(tmp_path / "plan.webp", runs, spec, seconds=0.1)


def test_report_lists_events_in_the_order_of_time(tmp_path, spec):
    events = Event(0.4, "grasp", "drag begins"), Event(0.2, "reading_lost", "segment 2")
    content = RunContent(spec, {"twin": replace(Snake().trajectory(), events=events)})
    path = tmp_path / "r.html"
    write_report(path, content, scenario_title="", metrics={"plants": {}})
    rows = [row for row in rows_of(path.read_text("utf-8")) if len(row) == 4]
    assert rows == [
        ["time, s", "plant", "event", "details"],
        ["0.20", "twin", "reading lost", "segment 2"],
        ["0.40", "twin", "grasp", "drag begins"],
    ]


@pytest.mark.parametrize(
    "trajectories", [{}, {"twin": sampled(Snake().trajectory("twin"), slice(0))}]
)
def test_missing_trajectories_are_refused(tmp_path, spec, trajectories):
    with pytest.raises(
        InputError,
        match="(there is no trajectory|has no samples) to draw",
    ):
        write_recording(tmp_path / "r.rrd", RunContent(spec, trajectories))
    assert not list(tmp_path.iterdir())


def lines_of(figure: Figure, label):
    lines = (line for axes in figure.axes for line in axes.lines)
    return [line for line in lines if line.get_label() == label]


def test_bends_are_plotted_as_recorded_over_the_last_periods(runs):
    figure = bend_plot(runs)
    shown = lines_of(figure, "twin (MuJoCo)")
    seen = runs["twin"].time >= 8.0 - 1e-9
    assert len(shown) == 4
    for j, line in enumerate(shown, start=1):
        assert np.array_equal(line.get_ydata(), runs["twin"][f"bend_{j}"][seen])
    assert "last 4 gait periods" in figure.axes[0].get_title(loc="left")
    assert (
        figure.axes[-1].get_xlabel() == "time (s)"
        and "(rad)" in figure.axes[0].get_ylabel()
    )


def test_plants_differ_in_greyscale(runs):
    for figure in (bend_plot(runs), pressure_plot(runs)):
        ours, theirs = (lines_of(figure, STYLES[plant].label)[0] for plant in runs)
        assert ours.get_linestyle() != theirs.get_linestyle()
        assert ours.get_color() != theirs.get_color()


def test_plot_of_long_body_names_the_number_of_plotted_segments():
    runs = pair(duration=1.0, connectors=13)
    figure = pressure_plot(runs)
    assert len(figure.axes) == 8
    assert "8 of 12 segments" in figure.axes[0].get_title(loc="left")
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert (labels[0], labels[-1]) == ("segment 1", "segment 12")
    last = lines_of(figure, "twin (MuJoCo)")[-1].get_ydata()
    twin = runs["twin"]
    kilopascal = 1e-3 * (twin["pressure_plus_12"] - twin["pressure_minus_12"])
    assert last == pytest.approx(kilopascal)


def test_speed_plot_shows_the_mean_of_a_period(runs):
    (mean,) = lines_of(speed_plot(runs), "twin (MuJoCo), mean of one gait period")
    assert np.array_equal(mean.get_ydata(), period_speed(runs["twin"], 0.5)[1])


def test_errors_are_plotted_in_mm_and_body_lengths(spec, runs):
    both = compare(runs["analytical"], runs["twin"])
    figure = error_plot(both, spec)
    figure.draw_without_rendering()
    shape, path = figure.axes[:2]
    assert np.allclose(shape.lines[0].get_ydata(), 1e3 * both.shape_error)
    assert np.allclose(path.lines[0].get_ydata(), 1e3 * both.path_error)
    low, high = path.get_ylim()
    assert low == 0 and "(mm)" in path.get_ylabel()
    (percent,) = path.child_axes
    share = 100 * high / (1e3 * spec.geometry.body_length)
    assert percent.get_ylim() == pytest.approx((0, share))


def test_differences_from_the_robot_are_plotted_in_mm_and_rad(runs):
    difference = MeasuredDifference.between(runs["analytical"], runs["twin"])
    both = difference.comparison
    figure = measured_plot({"twin": difference})
    plotted = [axes.lines[0].get_ydata() for axes in figure.axes]
    for values, expected in zip(
        plotted,
        (
            1e3 * both.shape_error,
            1e3 * both.path_error,
            both.heading_error,
            np.linalg.norm(both.bend_error, axis=1) / 2,  # of four segments
        ),
        strict=True,
    ):
        assert values == pytest.approx(expected)
    assert measured_plot({}) is None


def test_the_last_four_periods_of_a_tracked_reference_are_plotted():
    snake = run("twin", Snake(duration=10.0))
    reference = np.sign(np.sin(np.pi * snake.time + 0.1))  # a period of 2 s
    tracked = with_columns(
        snake, reference_1=reference, measured_bend_1=snake["bend_1"] + 0.1
    )
    bends, valves = tracking_plot({"twin": tracked}).axes
    shown = snake.time >= 2.0
    asked, measured, bend = (line.get_ydata() for line in bends.lines)
    assert np.array_equal(asked, reference[shown])
    assert measured == pytest.approx(snake["bend_1"][shown] + 0.1)
    assert np.array_equal(bend, snake["bend_1"][shown])
    assert np.array_equal(valves.lines[0].get_ydata(), snake["valve_plus_1"][shown])
    for wave, period in ((np.sin(np.pi * snake.time), 2.0), (0.1 * snake.time, None)):
        found = reference_period(with_columns(snake, reference_1=wave))
        assert found == (period and pytest.approx(period, rel=1e-3))


def test_strobe_bodies_do_not_overlap(spec, runs):
    times = strobe_times(runs, spec.geometry)
    places = np.interp(times, runs["twin"].time, runs["twin"]["com_x"])
    assert len(times) == 6 and times[0] == 0 and times[-1] == 10
    assert np.diff(places).min() > spec.geometry.body_length
    assert strobe_times(pair(speed=0.001), spec.geometry) == [0.0, 10.0]


def test_plan_view_keeps_the_scale(spec, runs):
    figure = plan_view(runs, spec)
    figure.draw_without_rendering()
    axes = figure.axes[0]
    corners = axes.transData.transform([[0, 0], [0.1, 0.1]])
    across, up = corners[1] - corners[0]
    assert across == pytest.approx(up)
    (path,) = lines_of(figure, "analytical")
    assert np.array_equal(path.get_xdata(), runs["analytical"]["com_x"])


def test_plan_view_shows_obstacles_and_objects_where_they_are(spec):
    twin = run("twin", Snake(duration=2.0))
    path = np.linspace(0.3, 0.5, len(twin))
    place = {"object_x_1": path, "object_y_1": 0 * path, "object_heading_1": 0 * path}
    item = MovableObject((0.08, 0.04), mass=0.1, friction=0.3, x=0.3, y=0.0)
    world = World((Circle(0.2, 0.1, 0.03), Circle(50.0, 0.0, 0.1)), objects=(item,))
    (axes,) = plan_view({"twin": with_columns(twin, **place)}, spec, world).axes
    boxes = [
        patch.get_xy()[:4]
        for patch in axes.patches
        if isinstance(patch, patches.Polygon)
    ]
    assert np.allclose(boxes[0].mean(axis=0), [0.3, 0.0])
    assert np.allclose(boxes[-1].mean(axis=0), [0.5, 0.0])
    assert np.allclose(np.ptp(boxes[0], axis=0), item.size)
    circles = axes.findobj(patches.Circle)
    assert [circle.center for circle in circles] == [(0.2, 0.1), (50.0, 0.0)]
    assert axes.get_xlim()[1] < 2.0  # an obstacle far away does not shrink the picture


TITLE = "<script>alert('x')</script> & Co"


EXPECTATIONS = [
    {
        "metric": "com_speed_m_s",
        "of": "twin",
        "value": 0.2,
        "near": 0.214,
        "met": True,
        "allowed": "0.214 within 15 %",
        "source": "Table 10",
    },
    {
        "metric": "com_speed_rel",
        "of": "comparison",
        "value": -0.09,
        "met": False,
        "allowed": "above 0",
    },
    {
        "metric": "yaw_rate_abs",
        "of": "comparison",
        "value": 0.3,
        "met": False,
        "allowed": "below 0.2",
        "expected_failure": "soft bends",
    },
    {
        "metric": "rise_time_s",
        "of": "twin",
        "value": None,
        "met": False,
        "state": "not_judged",
        "allowed": "at most 0.2",
        "reason": "the run is short",
    },
]


SHARE = AssumptionShare(
    name="compliance",
    title="bends: prescribed → compliant",
    value=(0.02, 4e-6, -0.1234567, 0.01),
    low=(0.02, 4e-6, -0.2, 0.01),
    high=(0.02, 4e-6, 0.1, 0.01),
    how="averaged",
)
ATTRIBUTION = Attribution(
    reference=(0.2,) * 4,
    gap=(0.03, 0.0, 0.0, 0.0),
    remainder=(0.01, 0.0, 0.0, 0.0),
    matched=(-6e-6, 0.0, 0.0, 0.0),
    same=("rigid gaps",),
    shares=(SHARE,),
    damping={"damping of 1 ms": (0.5, 0.0, 0.0, 0.0)},
)


@pytest.fixture(scope="module")
def report(tmp_path_factory, spec, runs):
    path = tmp_path_factory.mktemp("report") / "report.html"
    both = compare(runs["analytical"], runs["twin"])
    content = RunContent(spec, runs, comparison=both)
    metrics = {
        "plants": {plant: plant_metrics(r, wall_s=0.5) for plant, r in runs.items()},
        "comparison": both.metrics,
        "expectations": EXPECTATIONS,
        "versions": {"mujoco": "3.17"},
    }
    written = []
    for _ in range(2):
        write_report(
            path,
            content,
            scenario_title=TITLE,
            metrics=metrics,
            attribution=ATTRIBUTION,
        )
        written.append(path.read_text("utf-8"))
    assert written[0] == written[1], "the same run gives the same report"
    return written[0]


def elements(page):
    """Return a page as a tree; its elements nest as in XML, except for void elements."""
    closed = re.sub(r"<(meta|img)([^>]*)>", r"<\1\2/>", page)
    return ElementTree.fromstring(closed.removeprefix("<!doctype html>"))


def rows_of(page):
    """Return the texts of the cells of every table row of a page."""
    rows = elements(page).iter("tr")
    return [["".join(cell.itertext()) for cell in row] for row in rows]


def test_bends_of_both_plants_are_shown_where_the_runs_differ_in_length(runs):
    long = runs["twin"]
    end = float(long.time[-1]) - 0.7
    short = sampled(long, long.time <= end + 1e-9)
    figure = bend_plot({"analytical": short, "twin": long})
    for axes in figure.axes:
        low, high = axes.get_xlim()
        assert high == pytest.approx(end, abs=0.02) and high - low > 0.5
        for line in axes.lines:
            assert line.get_xdata()[[0, -1]] == pytest.approx([low, high], abs=0.02)
    assert "before the first end" in figure.axes[0].get_title(loc="left")


def test_report_is_one_small_file(report):
    assert len(report) < 2e6
    tree = elements(report)
    sources = [image.get("src") for image in tree.iter("img")]
    assert len(sources) == 6
    for source in sources:
        kind, _, content = source.partition(",")
        assert kind == "data:image/svg+xml;base64"
        assert base64.b64decode(content).lstrip().startswith(b"<?xml")
    assert not {"script", "link"} & {each.tag for each in tree.iter()}
    assert not re.search(r"https?://|@import|url\(", report)


def test_report_escapes_user_text(report):
    assert "<script>" not in report
    assert report.count("&lt;script&gt;alert(&#39;x&#39;)&lt;/script&gt; &amp; Co") == 2


def test_report_contains_results_and_expectations(report):
    assert ", 10 s simulated, analytical and twin" in report
    rows = {row[0]: " | ".join(row[1:]) for row in rows_of(report) if row}
    assert rows["metric"] == "unit | analytical | twin | difference | % | published"
    assert rows["CoM speed"] == (
        "m/s | 0.22 | 0.2002 | -0.0198 | -9.0 | 0.214 (Table 10)"
    )
    assert rows["turning radius"].startswith("m | –")
    assert rows["bend amplitude"].startswith("rad | 1.2, 1.2")
    assert float(rows["shape RMS"].split(" | ")[3]) > 0
    speed = "CoM speed | twin | 0.2 | 0.214 within 15 % | Table 10 |  | "
    assert rows["met"] == speed
    relative = "CoM speed, relative difference | comparison | -0.09 | above 0 |  |  | "
    assert rows["missed"] == relative
    assert rows["expected failure"] == (
        "yaw rate, size of difference | comparison | 0.3 | below 0.2 |  | soft bends | "
    )
    assert rows["not judged"].endswith(
        " | twin | – | at most 0.2 |  |  | the run is short"
    )
    assert "Expectations: 1 met, 1 missed, 1 known to be missed, 1 not judged" in report
    assert rows["geometry.segment_length"] == "m | 0.037"
    assert rows["mujoco"] == "3.17"


def test_report_contains_the_contributions_of_the_assumptions(report):
    rows = {row[0]: row[3:] for row in rows_of(report) if row}
    assert rows["compliance"] == ["+0.02", "0", "-0.123 [-0.2, +0.1]", "+0.01"]
    assert rows["not explained"] == ["+0.01", "0", "0", "0"]
    assert rows["difference"] == ["+0.03", "0", "0", "0"]
    assert rows["matched (stiff bends)"] == ["-6e-06", "0", "0", "0"]
    assert rows["damping of 1 ms"] == ["+0.5", "0", "0", "0"]
    assert "Identical in both plants of this scenario: rigid gaps." in report


@pytest.mark.slow
def test_twin_and_report_need_neither_rerun_nor_pyplot_nor_glfw(monkeypatch):
    """Without MUJOCO_GL, MuJoCo imports glfw, which starts a process to look for its library."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    code = (
        "import sys, srs_twin.plants.twin.snake, srs_twin.viewing.html.report\n"
        "print({'rerun', 'matplotlib.pyplot', 'glfw'} & sys.modules.keys())"
    )
    said = python("-c", code)
    assert said.stdout.strip() == "set()"


def test_viewer_errors_name_alternatives(tmp_path, recording, monkeypatch):
    with pytest.raises(
        InputError,
        match="this recording does not exist; run `srs-twin run SCENARIO` to write",
    ):
        open_recording(tmp_path / "none.rrd")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    spaced = shutil.copy(recording, tmp_path / "my run.rrd")
    with pytest.raises(
        InputError,
        match=r"no display .* Open .*report\.html in a browser.*my run\.rrd' --web",
    ):
        open_recording(spaced)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    with pytest.raises(
        InputError,
        match=r"rerun is missing; install it with: pip install 'rerun-sdk>=0\.41",
    ):
        open_recording(recording)


def test_viewer_is_bound_to_this_machine(recording, monkeypatch):
    commands = []

    def started(command, **_):
        commands.append([str(word) for word in command])
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(viewer.subprocess, "run", started)
    open_recording(recording)
    assert commands[0][1:] == ["--bind", "127.0.0.1", str(recording)]


def test_a_broken_recording_is_not_verified(tmp_path, recording):
    (tmp_path / "junk.rrd").write_bytes(b"junk")
    with pytest.raises(
        InputError,
        match=r"junk\.rrd: the recording is incomplete or damaged \(0 files verified",
    ):
        verify_recording(tmp_path / "junk.rrd")


def test_viewer_shows_a_moving_snake(recording):
    try:
        pictures = screenshots(recording, [1.0, 6.0], scene_only=True, size=(1000, 600))
    except InputError as error:
        if "no Vulkan driver" not in str(error):
            raise
        pytest.skip(str(error))
    before, after = (imread(io.BytesIO(png))[..., :3] for png in pictures)
    for picture in (before, after):
        hue = picture / np.maximum(picture.max(axis=-1, keepdims=True), 1e-6)
        for rgb in (PLUS_RGB, MINUS_RGB):
            alike = np.abs(hue - np.array(rgb) / max(rgb)).max(axis=-1) < 0.1
            assert alike.mean() > 0.002, "a pressurised segment is in the picture"
    # The camera moves with the snake, so only trails and ghost change.
    assert (np.abs(before - after).max(axis=-1) > 0.1).mean() > 0.01


def test_recordings_leave_no_threads_behind(spec, tmp_path):
    """Each of Rerun's streams has two; those of finished recordings would pile up over a long run."""
    content = RunContent(spec, pair(duration=0.5))
    threads = []
    for _ in range(5):
        write_recording(tmp_path / "r.rrd", content)
        threads.append(len(os.listdir("/proc/self/task")))
    assert threads[-1] <= threads[0]


def test_height_of_body_is_at_least_half_its_width(spec):
    low = replace(spec.geometry, width=0.2, com_height=0.03)
    assert line_height(low) == pytest.approx(0.1)  # half its width: it must not sink in
    assert line_height(replace(low, width=0.04)) == 0.03
