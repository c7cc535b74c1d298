"""Signals and events in recordings, and the plots of each kind of run."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from scipy.spatial.transform import Rotation
from screenshot import screenshots
from synthetic import Snake, numbered, with_columns
from viewing_runs import pair, robot

from srs_twin import Gait, TwinSnake, load_robot, rollout
from srs_twin.comparison.centre_line import spatial_centre_lines
from srs_twin.comparison.contacts import contact_metrics, touches
from srs_twin.control.gait import PitchWave
from srs_twin.errors import InputError
from srs_twin.trajectory import Event, Trajectory
from srs_twin.viewing.content import RunContent, events_of
from srs_twin.viewing.plots.signals import kind_of, wheel_turns
from srs_twin.viewing.plots.style import STYLES
from srs_twin.viewing.rerun import recording as recording_module, scene
from srs_twin.viewing.rerun.recording import subsample, write_recording


def with_events(run, *events, **metadata):
    return Trajectory(
        run.columns, run.units, tuple(events), {**run.metadata, **metadata}
    )


def bench(run):
    noise = np.random.default_rng(1).normal(0, 0.05, run.stack("bend").shape)
    asked = np.sign(np.sin(2 * np.pi * run.time))[:, None] * np.ones_like(noise)
    return with_columns(
        run,
        **numbered("reference", asked),
        **numbered("measured_bend", run.stack("bend") + noise),
    )


def learning(run):
    duty = 1 - 0.1 * np.floor(run.time)[:, None] * np.ones((1, 4))
    columns = {
        name: duty
        for name in ("duty_plus", "duty_minus", "target_plus", "target_minus")
    }
    changed = with_columns(
        run,
        **{
            k: v
            for name, values in columns.items()
            for k, v in numbered(name, values).items()
        },
        **numbered("measured_bend", run.stack("bend") * 1.01),
    )
    return with_events(
        changed,
        Event(1.0, "ilc_update", "after period 2"),
        Event(2.0, "saturation", "segment 1"),
    )


def following(run):
    plan = {
        "time": 0.0,
        "segments": [[0, 0, 0, 0.0, 0.4, 0.0, 0.2]],
        "outcome": "found",
        "nodes": 1,
    }
    footprint = {
        "name": "f",
        "title": "f",
        "offsets": [-0.3, 0.3],
        "curvatures": [-3, 3],
        "speeds": [0.2, 0.2],
        "left": [0.03, 0.03],
        "right": [0.03, 0.03],
        "ahead": 0.1,
        "behind": 0.1,
    }
    world = {
        "obstacles": [{"x": 0.3, "y": 0.3, "radius": 0.1}],
        "polygons": [],
        "bounds": None,
    }
    goal = {
        "x": 0.4,
        "y": 0.0,
        "radius": 0.05,
        "heading": None,
        "heading_tolerance": 0.1,
    }
    about = {
        "following": {
            "plans": [plan],
            "footprint": footprint,
            "world": world,
            "goal": goal,
        }
    }
    changed = with_columns(
        run,
        cross_track=0.01 * np.sin(run.time),
        offset_commanded=0.2 * np.cos(run.time),
    )
    lengths = {
        "segment_length_m": Snake.segment_length,
        "rigid_gap_m": Snake.rigid_gap,
        "body_width_m": 0.04,
    }
    return with_events(
        changed, Event(1.5, "replanned", "a new way"), control=about, **lengths
    )


KINDS = {
    "gait": lambda run: run,
    "bench": bench,
    "learning": learning,
    "following": following,
}


def of_kind(kind, duration=3.0):
    return {plant: KINDS[kind](run) for plant, run in pair(duration=duration).items()}


def chunks(path):
    from rerun.chunk import RrdReader

    return list(RrdReader(path).stream().to_chunks())


def read_back(path):
    """Entity path → (seconds, values), of signals and texts."""
    found = {}
    for chunk in chunks(path):
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        for name in ("Scalars:scalars", "TextLog:text"):
            if name in batch.schema.names:
                seconds = (
                    batch.column("sim_time")
                    .to_numpy(zero_copy_only=False)
                    .astype(float)
                    * 1e-9
                )
                found[chunk.entity_path] = (
                    seconds,
                    batch.column(name).flatten().to_pylist(),
                )
    return found


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("kind", KINDS)
def test_kind_of_run_follows_from_its_signals(kind):
    assert kind_of(of_kind(kind, duration=0.5)) == kind


SIGNALS = {
    "gait": {
        "/module/1/valve/twin",
        "/module/4/bend/twin",
        "/module/2/pressure/analytical",
        "/body/speed/twin",
    },
    "bench": {
        "/module/1/valve/twin",
        "/module/1/sensed/twin",
        "/module/1/bend/reference",
    },
    "learning": {
        "/module/3/duty/twin/plus",
        "/module/3/duty/analytical/minus",
        "/events/twin",
    },
    "following": {
        "/follow/cross_track/twin",
        "/follow/offset/analytical",
        "/events/analytical",
    },
}


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("kind", SIGNALS)
def test_signals_of_each_kind(kind, tmp_path):
    path = tmp_path / "r.rrd"
    write_recording(path, RunContent(robot(), of_kind(kind)))
    found = read_back(path)
    assert SIGNALS[kind] <= found.keys()
    if kind == "gait":
        assert not any("measured_bend" in each or "events" in each for each in found), (
            "an ideal reading is the bend"
        )


def test_step_signals_keep_their_changes(tmp_path):
    runs = of_kind("gait")
    path = tmp_path / "r.rrd"
    write_recording(path, RunContent(robot(), runs))
    twin = runs["twin"]
    found = read_back(path)
    state = (twin.stack("valve_plus") - twin.stack("valve_minus")) / 2
    for j in range(4):
        seconds, values = found[f"/module/{j + 1}/valve/twin"]
        assert len(seconds) < len(twin) / 5 and seconds[-1] == twin.time[-1]
        # The value of a step signal has been valid since the previous sample.
        middle = (twin.time[1:] + twin.time[:-1]) / 2
        drawn = np.array(values)[np.searchsorted(seconds, middle) - 1]
        assert np.array_equal(drawn, state[1:, j])


def test_events_are_in_the_text_log(tmp_path):
    runs = of_kind("learning")
    path = tmp_path / "r.rrd"
    write_recording(path, RunContent(robot(), runs))
    seconds, texts = read_back(path)["/events/twin"]
    assert seconds.tolist() == [1.0, 2.0]
    assert texts == ["ilc_update: after period 2", "saturation: segment 1"]


def test_contacts_are_events_and_metrics():
    run = following(pair(duration=3.0)["twin"])
    force = np.zeros((len(run), 5))
    force[50:60, 2], force[55, 3], force[65:70, 2] = (
        0.4,
        0.9,
        0.1,
    )  # 50 ms apart: one contact
    force[200:210, 0] = 0.2
    run = with_columns(
        run,
        **numbered("obstacle_force_x", force),
        **numbered("obstacle_force_y", 0 * force),
    )
    run = with_events(run, Event(1.5, "replanned", "a new way"), ended_by="controller")
    first, second = touches(run)
    assert (first.begin, first.end, first.connector) == pytest.approx((0.5, 0.69, 4))
    assert first.force == pytest.approx(0.9)
    assert contact_metrics(run)["contacts"] == 2
    kinds = [(event.kind, round(event.time, 2)) for event in events_of(run)]
    assert kinds == [
        ("contact", 0.5),
        ("replanned", 1.5),
        ("contact", 2.0),
        ("ended", 3.0),
    ]
    assert events_of(run)[0].text == "connector 4, up to 0.9 N, for 0.19 s"
    assert second.connector == 1


def test_wheels_roll_without_slip():
    spec = robot()
    snake = pair(
        duration=2.0, amplitude=0.0, sway=(0.0, 0.0), heading_sway=0.0, yaw_rate=0.0
    )["analytical"]
    turns = wheel_turns(snake, spec.geometry)
    moved = snake.com[-1] - snake.com[0]
    assert np.allclose(
        turns[-1] * spec.geometry.wheel_radius, np.hypot(*moved), rtol=1e-6
    )
    spinning = pair(
        duration=2.0,
        speed=0.0,
        amplitude=0.0,
        sway=(0.0, 0.0),
        heading_sway=0.0,
        yaw_rate=0.3,
    )
    left, right = wheel_turns(spinning["analytical"], spec.geometry)[-1].T
    apart = 2 * spec.geometry.half_track * 0.3 * 2.0 / spec.geometry.wheel_radius
    assert np.allclose(right - left, apart, rtol=1e-3), (
        "on the way round to the left the right one leads"
    )


def test_spokes_rotate_about_the_axle(tmp_path):
    spec = robot()
    runs = pair(duration=1.0)
    path = tmp_path / "r.rrd"
    write_recording(path, RunContent(spec, runs))
    (poses,) = (
        c
        for c in chunks(path)
        if c.entity_path == "/world/twin/spokes" and not c.is_static
    )
    flat = poses.to_record_batch().column("Boxes3D:quaternions").flatten().flatten()
    x, y, z, w = np.array(flat.to_numpy(zero_copy_only=False)).reshape(-1, 4).T
    twin = subsample(runs["twin"], 50)
    # Rotated unit vectors +y (the axle) and +x (the bar).
    axle = np.stack(
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=-1
    )
    theta = np.repeat(twin.stack("connector_heading"), 2, axis=1).ravel()
    assert np.allclose(
        axle, np.stack([-np.sin(theta), np.cos(theta), 0 * theta], axis=-1), atol=1e-5
    )
    down = -2 * (x * z - w * y)
    assert np.allclose(
        down, np.sin(wheel_turns(twin, spec.geometry).reshape(-1)), atol=1e-4
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_viewer_shows_the_plots_of_each_kind(kind, tmp_path):
    path = tmp_path / "r.rrd"
    write_recording(path, RunContent(robot(), of_kind(kind)))
    try:
        (png,) = screenshots(path, [2.5], size=(1000, 800))
    except InputError as error:
        if "no Vulkan driver" not in str(error):
            raise
        pytest.skip(str(error))
    picture = imread(io.BytesIO(png))[..., :3]
    beside = picture[60:, int(0.62 * picture.shape[1]) :]
    hue = beside / np.maximum(beside.max(axis=-1, keepdims=True), 1e-6)
    blue = np.array(STYLES["twin"].rgb) / max(STYLES["twin"].rgb)
    colored = np.abs(hue - blue).max(axis=-1) < 0.12
    if kind == "learning":  # there the colours are the chambers'
        colored |= beside.max(axis=-1) - beside.min(axis=-1) > 0.3
    thirds = np.array_split(colored[: int(0.75 * len(colored))], 3)
    assert all(third.sum() > 30 for third in thirds), "no row of plots is empty"


def test_recording_with_all_signals_is_small(tmp_path):
    runs = {plant: learning(replace(run)) for plant, run in pair(duration=10.0).items()}
    path = tmp_path / "r.rrd"
    write_recording(path, RunContent(robot(), runs))
    assert path.stat().st_size < 5e6


def test_a_spatial_snake_is_drawn_above_the_floor_where_it_lifts_itself():
    spec = load_robot("spatial_example")
    run = rollout(
        TwinSnake(spec, supply_pa=20e3),
        Gait(0.5, pitch=PitchWave(0.4)),
        1.0,
        record_hz=10,
    )
    lines = spatial_centre_lines(run, spec.geometry, scene.CHORDS)
    ends = np.concatenate([run.position, run.stack("z")[..., None]], axis=-1)
    assert np.ptp(run.stack("z")[-1]) > 0.01
    assert lines[:, :, 0] == pytest.approx(ends[:, :-1]) and lines[
        :, :, -1
    ] == pytest.approx(ends[:, 1:])
    length = np.linalg.norm(np.diff(lines, axis=2), axis=-1).sum(axis=2)
    assert length == pytest.approx(np.full_like(length, spec.geometry.pitch), rel=0.03)
    steps = np.diff(lines[-1, 0], axis=0)
    turned = Rotation.from_quat(scene._along(steps)).apply([0.0, 0.0, 1.0])
    assert turned == pytest.approx(
        steps / np.linalg.norm(steps, axis=1, keepdims=True), abs=1e-6
    )


def test_the_axis_of_the_speeds_contains_zero_and_all_speeds():
    runs = pair()
    shown = recording_module._layout(RunContent(robot(), runs), {})
    speeds = [recording_module._speed(run)[1] for run in runs.values()]
    low = min(0.0, *(float(values.min()) for values in speeds))
    high = max(float(values.max()) for values in speeds)
    assert high == pytest.approx(0.22, rel=0.3)  # the faster of the two
    assert shown.speeds == pytest.approx((1.1 * low, 1.1 * high))
    assert shown.separation == pytest.approx(
        max(
            np.hypot(*(a - b))
            for a, b in zip(
                *(np.column_stack([r["com_x"], r["com_y"]]) for r in runs.values()),
                strict=True,
            )
        )
    )
