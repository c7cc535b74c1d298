"""Recordings, plots and reports of synthetic runs; geometry compared with an independent integration."""

from __future__ import annotations

import base64
import html.parser
import io
import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import rerun as rr
from hero import write_plan_animation
from matplotlib import patches
from matplotlib.figure import Figure
from matplotlib.image import imread
from screenshot import screenshots
from synthetic import Snake, sampled, with_columns
from viewing_runs import pair, robot, run

from srs_twin.comparison.centre_line import centre_lines, line_height
from srs_twin.comparison.compare import compare
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.errors import InputError
from srs_twin.robot.world import Circle, MovableObject, Polygon, World
from srs_twin.trajectory import Event, Trajectory
from srs_twin.viewing.content import RunContent
from srs_twin.viewing.html.report import write_report
from srs_twin.viewing.plots.from_above import plan_view, strobe_times
from srs_twin.viewing.plots.runs import bend_plot, error_plot, pressure_plot, speed_plot
from srs_twin.viewing.plots.signals import (
    body_line,
    forward_speed,
    period_speed,
    pressure_difference,
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
    bent = runs["twin"]
    shifted = with_columns(
        bent, x_3=bent["x_3"] + 1e-3
    )  # hinges do not quite make an arc
    lines = centre_lines(shifted, spec.geometry)
    assert np.array_equal(lines[:, :, 0], shifted.position[:, :-1])
    assert np.allclose(lines[:, :, -1], shifted.position[:, 1:], atol=1e-15)
    assert body_line(shifted, spec.geometry).shape == (len(bent), 4 * 10 + 1, 2)


def test_segments_keep_their_length(spec, runs):
    lines = centre_lines(runs["analytical"], spec.geometry, divisions=60)
    lengths = np.linalg.norm(np.diff(lines, axis=2), axis=-1).sum(axis=-1)
    assert np.allclose(lengths, spec.geometry.pitch, rtol=1e-4)


def test_wheels_are_perpendicular_to_the_heading(spec, runs):
    snake = runs["twin"]
    wheels = wheel_centres(snake, spec.geometry)
    apart = wheels[:, :, 0] - wheels[:, :, 1]
    theta = snake.stack("connector_heading")
    ahead = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    assert np.allclose(np.linalg.norm(apart, axis=-1), 2 * spec.geometry.half_track)
    assert np.allclose((apart * ahead).sum(axis=-1), 0, atol=1e-12)
    left = ahead[..., 0] * apart[..., 1] - ahead[..., 1] * apart[..., 0]
    assert (left > 0).all(), "the first wheel is the left one"


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


def read_back(path):
    """Return entity path → component name → (seconds, values per row) of the temporal columns."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[str, tuple[np.ndarray, list]]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            seconds = (
                batch.column("sim_time").to_numpy(zero_copy_only=False).astype(float)
                * 1e-9
            )
            for name in batch.schema.names[2:]:
                found.setdefault(chunk.entity_path, {})[name] = (
                    seconds,
                    batch.column(name),
                )
    return found


def flat(column):
    values = column.flatten()
    while hasattr(values, "flatten") and hasattr(values.type, "value_type"):
        values = values.flatten()
    return values.to_numpy(zero_copy_only=False)


@pytest.fixture(scope="module")
def recording(tmp_path_factory, spec, runs):
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    write_recording(
        path, RunContent(spec, runs, comparison=compare(*runs.values())), title="both"
    )
    return path


def test_recording_of_ten_seconds_is_small_and_valid(recording):
    assert recording.stat().st_size < 5e6
    verify_recording(recording)


def test_the_recording_holds_the_signals(recording, runs):
    found = read_back(recording)
    for plant, snake in runs.items():
        for j in (1, 4):
            seconds, bends = found[f"/module/{j}/bend/{plant}"]["Scalars:scalars"]
            assert np.allclose(seconds, snake.time, atol=1e-9)
            assert np.array_equal(flat(bends), snake[f"bend_{j}"])
            _, kilopascal = found[f"/module/{j}/pressure/{plant}"]["Scalars:scalars"]
            assert np.allclose(
                1e3 * flat(kilopascal), pressure_difference(snake)[:, j - 1]
            )
        assert np.array_equal(
            flat(found[f"/body/heading/{plant}"]["Scalars:scalars"][1]),
            snake["heading"],
        )
        _, mean = found[f"/body/speed/{plant}"]["Scalars:scalars"]
        assert np.array_equal(flat(mean), period_speed(snake, 0.5)[1])
    assert {"/comparison/shape", "/comparison/path"} <= found.keys()


def test_recording_contains_the_recorded_positions(recording, spec, runs):
    found = read_back(recording)
    twin = subsample(runs["twin"], 50)
    seconds, places = found["/world/twin/body/segment_2"]["Capsules3D:translations"]
    assert np.allclose(np.diff(seconds), 0.02)
    front = flat(places).reshape(len(twin), -1, 3)[:, 0, :2]
    assert np.allclose(front, twin.position[:, 1], atol=1e-6)
    x, y, z, w = (
        flat(found["/world/twin/body/segment_2"]["Capsules3D:quaternions"][1])
        .reshape(-1, 4)
        .T
    )
    # The rotated axis +z of a capsule must end at the start of the next capsule.
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x)], axis=-1).reshape(
        len(twin), -1, 2
    )
    step = np.diff(flat(places).reshape(len(twin), -1, 3)[..., :2], axis=1)
    assert np.allclose(
        axis[:, :-1], step / np.linalg.norm(step, axis=-1, keepdims=True), atol=1e-3
    )

    _, vertices = found["/world/analytical/body"]["Mesh3D:vertex_positions"]
    ghost = flat(vertices).reshape(len(twin), -1, 6, 3)
    middle = ghost.mean(axis=2)[..., :2]
    assert np.allclose(
        middle,
        body_line(subsample(runs["analytical"], 50), spec.geometry, 6),
        atol=1e-6,
    )
    _, com = found["/world/analytical/com"]["Points3D:positions"]
    assert np.allclose(
        flat(com).reshape(-1, 3)[:, :2],
        subsample(runs["analytical"], 50).com,
        atol=1e-6,
    )


def test_the_camera_follows_the_middle_of_the_plants_and_keeps_both_in_the_picture(
    spec, runs, tmp_path
):
    path = tmp_path / "far.rrd"
    ahead = with_columns(runs["twin"], com_x=runs["twin"]["com_x"] + 0.7)
    write_recording(
        path, RunContent(spec, {"analytical": runs["analytical"], "twin": ahead})
    )
    places = flat(read_back(path)["/world/eye"]["Points3D:positions"][1]).reshape(-1, 3)
    assert np.allclose(
        places[:, :2], (runs["analytical"].com + ahead.com) / 2, atol=1e-6
    )
    write_side_by_side(tmp_path / "two.rrd", {"a": path, "b": path})
    assert "/a/world/eye" in read_back(tmp_path / "two.rrd")
    # Of a viewer with 55° from top to bottom and a view wider than high.
    for apart in (0.0, 0.3, 1.5):
        layout = layout_of(spec, apart)
        eye = scene_view(layout).properties["EyeControls3D"]
        distance = np.linalg.norm(eye.position.as_arrow_array().to_pylist()[0])
        assert (
            distance * np.tan(np.radians(27.5))
            > (apart + spec.geometry.body_length) / 2
        )


@pytest.mark.parametrize("kind", ["gait", "learning", "bench"])
def test_plots_of_the_middle_module_are_shown_first(spec, kind):
    layout = replace(layout_of(spec, 0.0), segments=7, kind=kind)
    _, plots = run_blueprint(layout).root_container.contents
    shown = [tabs.contents[tabs.active_tab] for tabs in plots.contents[:2]]
    assert [view.origin.split("/")[:2] for view in shown] == [["module", "4"]] * 2


def layout_of(spec, apart):
    return Layout(
        plants=["analytical", "twin"],
        camera_target="eye",
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
    force = np.zeros((2, 5, len(twin)))
    force[:, 0, 50:53] = [[0.3], [-0.4]]
    force[0, 3, 52:60] = 2.0
    force[1, 4, 100] = -0.1
    pushes = {
        f"obstacle_force_{axis}": pushed
        for axis, pushed in zip("xy", force, strict=True)
    }
    columns = {
        f"{name}_{i + 1}": row
        for name, rows in pushes.items()
        for i, row in enumerate(rows)
    }
    world = World(
        (Circle(0.4, 0.1, 0.05),), polygons=(Polygon(((0, 1), (1, 1), (0.5, 2))),)
    )
    path = tmp_path / "touched.rrd"
    touched = with_columns(twin, **columns)
    write_recording(path, RunContent(spec, {"twin": touched}, world=world))
    verify_recording(path)
    seconds, vectors = read_back(path)["/world/twin/contact"]["Arrows3D:vectors"]
    drawn = [np.array(row.as_py() or []).reshape(-1, 3) for row in vectors]
    shown = dict(zip(seconds.tolist(), drawn, strict=True))
    assert np.allclose(sorted(shown), twin.time[[*range(50, 61), 100, 101]], atol=1e-9)
    for time_s, arrows in shown.items():
        row = int(np.argmin(abs(twin.time - time_s)))
        pushed = force[:, :, row].T
        pushed = pushed[(pushed != 0).any(axis=1)]
        assert np.allclose(
            arrows, np.column_stack([0.05 * pushed, np.zeros(len(pushed))]), atol=1e-7
        )
    _, origins = read_back(path)["/world/twin/contact"]["Arrows3D:origins"]
    expected = twin.position[51, 0]
    assert np.allclose(np.array(origins[1].as_py())[0, :2], expected, atol=1e-6)


def test_run_without_contacts_has_no_arrows(recording):
    assert not [
        entity for entity in read_back(recording) if entity.endswith("/contact")
    ]


def without(trajectory, *prefixes):
    kept = {n: c for n, c in trajectory.columns.items() if not n.startswith(prefixes)}
    return Trajectory(kept, metadata=trajectory.metadata)


ODD_RUNS = {
    "one plant": lambda: {"analytical": run("analytical", Snake(duration=2.0))},
    "no gait": lambda: {"twin": run("twin", Snake(duration=2.0, periodic=False))},
    "shorter than a period": lambda: pair(duration=0.2),
    "one sample": lambda: {
        p: sampled(r, slice(1)) for p, r in pair(duration=0.2).items()
    },
    "no pressures": lambda: {
        "twin": without(run("twin", Snake(duration=1.0)), "pressure", "valve")
    },
    "at rest": lambda: pair(
        duration=1.0, speed=0.0, amplitude=0.0, sway=(0.0, 0.0), heading_sway=0.0
    ),
    "another plant": lambda: (
        pair(duration=1.0) | {"lab": run("lab", Snake(duration=1.0))}
    ),
    "two connectors": lambda: pair(duration=1.0, connectors=2),
    "many connectors": lambda: pair(duration=1.0, connectors=13),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        (
            name
            if name in ("one sample", "another plant")
            else pytest.param(name, marks=pytest.mark.slow)
        )
        for name in ODD_RUNS
    ],
)
def test_unusual_runs_have_recording_and_report(tmp_path, name):
    runs = ODD_RUNS[name]()
    spec = robot(next(iter(runs.values())).position.shape[1])
    both = (
        compare(runs["analytical"], runs["twin"])
        if {"analytical", "twin"} <= runs.keys()
        else None
    )
    write_recording(tmp_path / "r.rrd", RunContent(spec, runs, comparison=both))
    verify_recording(tmp_path / "r.rrd")
    metrics = {
        "plants": {plant: plant_metrics(r) for plant, r in runs.items()},
        "comparison": None,
    }
    write_report(
        tmp_path / "r.html",
        RunContent(spec, runs, comparison=both),
        scenario_title=name,
        metrics=metrics,
    )
    figures = (5 if both else 4) - (
        spec.segments == 1
    )  # a single module has no plan view
    assert (tmp_path / "r.html").read_text("utf-8").count("<figure>") == figures
    write_plan_animation(tmp_path / "plan.webp", runs, spec, seconds=0.1)


def test_report_lists_events_in_the_order_of_time(tmp_path, spec):
    events = Event(0.4, "grasp", "drag begins"), Event(0.2, "reading_lost", "segment 2")
    run_ = replace(Snake().trajectory("twin"), events=events)
    metrics = {"plants": {"twin": plant_metrics(run_)}, "comparison": None}
    path = tmp_path / "r.html"
    write_report(
        path, RunContent(spec, {"twin": run_}), scenario_title="", metrics=metrics
    )
    text = path.read_text("utf-8")
    assert 0 < text.find("reading lost") < text.find("drag begins")


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
    return [
        line for axes in figure.axes for line in axes.lines if line.get_label() == label
    ]


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
    figure = pressure_plot(pair(duration=1.0, connectors=13))
    assert len(figure.axes) == 8
    assert "8 of 12 segments" in figure.axes[0].get_title(loc="left")
    assert (
        figure.axes[0].get_ylabel() == "segment 1"
        and figure.axes[-1].get_ylabel() == "segment 12"
    )


def test_speed_plot_shows_the_mean_of_a_period(runs):
    (mean,) = lines_of(speed_plot(runs), "twin (MuJoCo), mean of one gait period")
    assert np.array_equal(mean.get_ydata(), period_speed(runs["twin"], 0.5)[1])


def test_errors_are_plotted_in_mm_and_body_lengths(spec, runs):
    both = compare(runs["analytical"], runs["twin"])
    shape, path = error_plot(both, spec).axes[:2]
    assert np.allclose(shape.lines[0].get_ydata(), 1e3 * both.shape_error)
    assert np.allclose(path.lines[0].get_ydata(), 1e3 * both.path_error)
    assert path.get_ylim()[0] == 0 and "(mm)" in path.get_ylabel()


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
    twin = with_columns(
        twin, object_x_1=path, object_y_1=0 * path, object_heading_1=0 * path
    )
    item = MovableObject((0.08, 0.04), mass=0.1, friction=0.3, x=0.3, y=0.0)
    world = World((Circle(0.2, 0.1, 0.03), Circle(50.0, 0.0, 0.1)), objects=(item,))
    (axes,) = plan_view({"twin": twin}, spec, world).axes
    boxes = [
        patch.get_xy()[:4]
        for patch in axes.patches
        if isinstance(patch, patches.Polygon)
    ]
    assert np.allclose(boxes[0].mean(axis=0), [0.3, 0.0]) and np.allclose(
        boxes[-1].mean(axis=0), [0.5, 0.0]
    )
    assert np.allclose(np.ptp(boxes[0], axis=0), item.size)
    circles = [
        artist.center
        for artist in axes.get_children()
        if isinstance(artist, patches.Circle)
    ]
    assert circles == [(0.2, 0.1), (50.0, 0.0)]
    assert axes.get_xlim()[1] < 2.0  # an obstacle far away does not shrink the picture


TITLE = "<script>alert('x')</script> & Co"


@pytest.fixture(scope="module")
def report(tmp_path_factory, spec, runs):
    path = tmp_path_factory.mktemp("report") / "report.html"
    both = compare(runs["analytical"], runs["twin"])
    metrics = {
        "plants": {plant: plant_metrics(r, wall_s=0.5) for plant, r in runs.items()},
        "comparison": both.metrics,
        "expectations": [
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
                "metric": "path_rms_m",
                "of": "comparison",
                "value": 0.1,
                "met": True,
                "allowed": "below 0.2",
                "expected_failure": "once it was",
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
        ],
        "versions": {"mujoco": "3.17"},
    }
    written = []
    for _ in range(2):
        write_report(
            path,
            RunContent(spec, runs, comparison=both),
            scenario_title=TITLE,
            metrics=metrics,
        )
        written.append(path.read_bytes())
    assert written[0] == written[1], "the same run gives the same report"
    return path.read_text("utf-8")


class Reader(html.parser.HTMLParser):
    """Checks that elements nest and collects the cells of tables and the addresses of images."""

    def __init__(self):
        super().__init__()
        self.open = []
        self.rows = []
        self.sources = []
        self.tags = set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "td" in self.open or "th" in self.open:
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def parsed(report):
    reader = Reader()
    reader.feed(report)
    assert reader.open == []
    return reader


def test_bends_of_both_plants_are_shown_where_the_runs_differ_in_length(runs):
    long = runs["twin"]
    end = float(long.time[-1]) - 0.7
    columns = {
        name: column[long.time <= end + 1e-9] for name, column in long.columns.items()
    }
    short = replace(runs["analytical"], columns=columns)
    figure = bend_plot({"analytical": short, "twin": long})
    for axes in figure.axes:
        low, high = axes.get_xlim()
        assert high == pytest.approx(end, abs=0.02) and high - low > 0.5
        for line in axes.lines:
            assert line.get_xdata()[0] == pytest.approx(low, abs=0.02)
            assert line.get_xdata()[-1] == pytest.approx(high, abs=0.02)
    assert "before the first end" in figure.axes[0].get_title(loc="left")


def test_report_is_one_small_file(report, parsed):
    assert len(report) < 2e6
    assert len(parsed.sources) == 5
    assert all(
        source.startswith("data:image/svg+xml;base64,") for source in parsed.sources
    )
    assert (
        base64.b64decode(parsed.sources[0].partition(",")[2])
        .lstrip()
        .startswith(b"<?xml")
    )
    assert "script" not in parsed.tags and "link" not in parsed.tags
    assert not re.search(r"https?://|@import|url\(", report)


def test_report_escapes_user_text(report):
    assert "<script>" not in report
    assert report.count("&lt;script&gt;alert(&#39;x&#39;)&lt;/script&gt; &amp; Co") == 2


def test_report_contains_results_and_expectations(report, parsed):
    rows = {row[0]: row for row in parsed.rows if row}
    assert rows["metric"] == [
        "metric",
        "unit",
        "analytical",
        "twin",
        "difference",
        "%",
        "published",
    ]
    assert rows["CoM speed"][1:] == [
        "m/s",
        "0.22",
        "0.2002",
        "-0.0198",
        "-9.0",
        "0.214 (Table 10)",
    ]
    assert rows["turning radius"][2] == "–"
    assert rows["bend amplitude"][2].startswith("1.2, 1.2")
    assert rows["shape RMS"][1] == "m" and float(rows["shape RMS"][4]) > 0
    assert rows["met"][1:] == [
        "CoM speed",
        "twin",
        "0.2",
        "0.214 within 15 %",
        "Table 10",
        "",
        "",
    ]
    assert rows["missed"][1:3] == ["CoM speed, relative difference", "comparison"]
    assert rows["missed"][3:] == ["-0.09", "above 0", "", "", ""]
    assert rows["expected failure"][1:] == [
        "yaw rate, size of difference",
        "comparison",
        "0.3",
        "below 0.2",
        "",
        "soft bends",
        "",
    ]
    assert rows["holds"][1:] == [
        "path RMS",
        "comparison",
        "0.1",
        "below 0.2",
        "",
        "once it was",
        "",
    ]
    assert rows["not judged"][2:] == [
        "twin",
        "–",
        "at most 0.2",
        "",
        "",
        "the run is short",
    ]
    assert (
        "Expectations: 1 met, 1 missed, 1 known to be missed, 1 met though known to be"
        " missed" in report
    )
    assert "1 not judged" in report
    assert rows["geometry.segment_length"] == ["geometry.segment_length", "m", "0.037"]
    assert rows["mujoco"] == ["mujoco", "3.17"]


@pytest.mark.slow
def test_twin_and_report_need_neither_rerun_nor_pyplot_nor_glfw(monkeypatch):
    """Without MUJOCO_GL, MuJoCo imports glfw, which starts a process to look for its library."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    code = (
        "import sys, srs_twin.plants.twin.snake, srs_twin.viewing.html.report\n"
        "print({'rerun', 'matplotlib.pyplot', 'glfw'} & sys.modules.keys())"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
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
    with pytest.raises(
        InputError, match=r"no display .* Open .*report\.html in a browser"
    ):
        open_recording(recording)
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


def test_missing_vulkan_names_its_packages(recording, monkeypatch):
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, "/nonexistent")
    with pytest.raises(
        InputError, match="no Vulkan driver .* apt-get install mesa-vulkan-drivers"
    ):
        screenshots(recording, [1.0])


def test_recordings_leave_no_threads_behind(tmp_path):
    """Each of Rerun's streams has two; those of finished recordings would pile up over a long run."""
    runs = pair()

    def threads():
        return len(os.listdir("/proc/self/task"))

    write_recording(tmp_path / "r.rrd", RunContent(robot(), runs))
    before = threads()
    for _ in range(4):
        write_recording(tmp_path / "r.rrd", RunContent(robot(), runs))
    assert threads() <= before


def test_height_of_body_is_at_least_half_its_width(spec):
    low = replace(spec.geometry, width=0.2, com_height=0.03)
    assert line_height(low) == pytest.approx(0.1)  # half its width: it must not sink in
    assert line_height(replace(low, width=0.04)) == 0.03
