"""Signals and events in recordings, and the plots of each kind of run."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation
from synthetic import Snake, numbered, with_columns, with_metadata
from viewing_runs import directions, flat, pair, read_back, robot

from srs_twin import Gait, TwinSnake, load_robot, rollout
from srs_twin.comparison.centre_line import spatial_centre_lines
from srs_twin.control.gait import PitchWave
from srs_twin.planning.footprint import Footprint
from srs_twin.trajectory import Event
from srs_twin.viewing.content import RunContent, events_of
from srs_twin.viewing.plots.signals import kind_of, wheel_turns
from srs_twin.viewing.rerun import recording as recording_module, scene
from srs_twin.viewing.rerun.blueprint import run_blueprint
from srs_twin.viewing.rerun.recording import subsample, write_recording


def bench(run):
    asked = np.sign(np.sin(2 * np.pi * run.time))[:, None] * np.ones((1, 4))
    return with_columns(
        run,
        **numbered("reference", asked),
        **numbered("measured_bend", run.stack("bend") + 0.05),
    )


def learning(run):
    duty = 1 - 0.1 * np.floor(run.time)[:, None] * np.ones((1, 4))
    for name in ("duty_plus", "duty_minus", "target_plus", "target_minus"):
        run = with_columns(run, **numbered(name, duty))
    run = with_columns(run, **numbered("measured_bend", run.stack("bend") * 1.01))
    events = (
        Event(1.0, "ilc_update", "after period 2"),
        Event(2.0, "saturation", "segment 1"),
    )
    return replace(run, events=events)


def following(run):
    plan = {
        "time": 0.0,
        "segments": [[0, 0, 0, 0.0, 0.4, 0.0, 0.2]],
        "outcome": "found",
        "nodes": 1,
    }
    obstacle = {"x": 0.3, "y": 0.3, "radius": 0.1}
    goal = {"x": 0.4, "y": 0.0, "radius": 0.05}
    about = {
        "plans": [plan],
        "footprint": asdict(Footprint.box(0.06, 0.0, speed=0.2, curvature=3.0)),
        "world": {"obstacles": [obstacle], "polygons": [], "bounds": None},
        "goal": goal | {"heading": None, "heading_tolerance": 0.1},
    }
    changed = with_columns(
        run,
        cross_track=0.01 * np.sin(run.time),
        offset_commanded=0.2 * np.cos(run.time),
    )
    changed = replace(changed, events=(Event(1.5, "replanned", "a new way"),))
    return with_metadata(
        changed,
        control={"following": about},
        segment_length_m=Snake.segment_length,
        rigid_gap_m=Snake.rigid_gap,
        body_width_m=0.04,
    )


KINDS = {
    "gait": lambda run: run,
    "bench": bench,
    "learning": learning,
    "following": following,
}


def of_kind(kind):
    return {plant: KINDS[kind](run) for plant, run in pair(duration=3.0).items()}


def recorded(runs, folder):
    path = folder / "r.rrd"
    write_recording(path, RunContent(robot(), runs))
    return read_back(path)


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


def plots_of(part):
    """Return the origins of all plots in a part of a blueprint."""
    if isinstance(part, rrb.Container):
        return [origin for child in part.contents for origin in plots_of(child)]
    return [part.origin] * isinstance(part, rrb.TimeSeriesView)


@pytest.mark.parametrize("kind", SIGNALS)
def test_signals_of_each_kind(kind, tmp_path):
    runs = of_kind(kind)
    assert kind_of(runs) == kind
    found = recorded(runs, tmp_path)
    assert SIGNALS[kind] <= found.keys()
    layout = recording_module._layout(RunContent(robot(), runs), {})
    plots = plots_of(run_blueprint(layout).root_container)
    assert len(plots) >= 6
    for origin in plots:
        assert any(name.startswith(f"/{origin}/") for name in found), origin
    if kind == "gait":
        # An ideal reading is the bend.
        for absent in ("sensed", "events", "contact"):
            assert not any(absent in each for each in found)
    if kind == "learning":
        seconds, texts = found["/events/twin"]["TextLog:text"]
        assert seconds.tolist() == [1.0, 2.0]
        assert texts.flatten().to_pylist() == [
            "ilc_update: after period 2",
            "saturation: segment 1",
        ]
        _, levels = found["/events/twin"]["TextLog:level"]
        assert levels.flatten().to_pylist() == ["INFO", "WARN"]


def test_step_signals_keep_their_changes(tmp_path):
    runs = of_kind("gait")
    twin = runs["twin"]
    found = recorded(runs, tmp_path)
    state = (twin.stack("valve_plus") - twin.stack("valve_minus")) / 2
    for j in range(4):
        seconds, values = found[f"/module/{j + 1}/valve/twin"]["Scalars:scalars"]
        assert len(seconds) < len(twin) / 5 and seconds[-1] == twin.time[-1]
        # The value of a step signal has been valid since the previous sample.
        middle = (twin.time[1:] + twin.time[:-1]) / 2
        drawn = flat(values)[np.searchsorted(seconds, middle) - 1]
        assert np.array_equal(drawn, state[1:, j])


def test_events_of_a_run_include_its_contacts_and_its_end():
    run = pair(duration=3.0)["twin"]
    force = np.zeros((len(run), 5))
    force[[50, 200], 2] = 0.4
    touching = with_columns(
        run,
        **numbered("obstacle_force_x", force),
        **numbered("obstacle_force_y", 0 * force),
    )
    ended = with_metadata(touching, ended_by="controller")
    replanned = Event(1.5, "replanned", "a new way")
    assert events_of(replace(ended, events=(replanned,))) == [
        Event(0.5, "contact", "connector 3, up to 0.4 N"),
        replanned,
        Event(2.0, "contact", "connector 3, up to 0.4 N"),
        Event(3.0, "ended", "the run, by its controller"),
    ]


def test_wheels_roll_without_slip():
    geometry = robot().geometry
    rod = {"amplitude": 0.0, "sway": (0.0, 0.0), "heading_sway": 0.0, "duration": 2.0}
    ahead = wheel_turns(pair(**rod, speed=0.22)["analytical"], geometry)[-1]
    assert ahead * geometry.wheel_radius == pytest.approx(np.full((5, 2), 0.44))
    spinning = pair(**rod, speed=0.0, yaw_rate=0.3)["analytical"]
    left, right = wheel_turns(spinning, geometry)[-1].T
    apart = 2 * geometry.half_track * 0.6 / geometry.wheel_radius
    assert np.allclose(right - left, apart, rtol=1e-3), (
        "on the way round to the left the right one leads"
    )


def test_spokes_rotate_about_the_axle(tmp_path):
    runs = pair(duration=1.0)
    spokes = recorded(runs, tmp_path)["/world/twin/spokes"]
    _, quaternions = spokes["Boxes3D:quaternions"]
    twin = subsample(runs["twin"], 50)
    theta = np.repeat(twin.stack("connector_heading"), 2, axis=1).ravel()
    left = np.stack([-np.sin(theta), np.cos(theta), 0 * theta], axis=-1)
    assert np.allclose(directions(quaternions, [0, 1, 0]), left, atol=1e-5)
    down = -directions(quaternions, [1, 0, 0])[:, 2]
    turns = wheel_turns(twin, robot().geometry).ravel()
    assert np.allclose(down, np.sin(turns), atol=1e-4)


def test_a_spatial_snake_is_drawn_above_the_floor_where_it_lifts_itself():
    spec = load_robot("spatial_example")
    twin = TwinSnake(spec, supply_pa=20e3)
    run = rollout(twin, Gait(0.5, pitch=PitchWave(0.4)), 1.0, record_hz=10)
    lines = spatial_centre_lines(run, spec.geometry, scene.CHORDS)
    ends = np.concatenate([run.position, run.stack("z")[..., None]], axis=-1)
    assert np.ptp(run.stack("z")[-1]) > 0.01
    assert lines[:, :, 0] == pytest.approx(ends[:, :-1])
    assert lines[:, :, -1] == pytest.approx(ends[:, 1:])
    length = np.linalg.norm(np.diff(lines, axis=2), axis=-1).sum(axis=2)
    assert length == pytest.approx(np.full_like(length, spec.geometry.pitch), rel=0.03)
    steps = np.diff(lines[-1, 0], axis=0)
    turned = Rotation.from_quat(scene._along(steps)).apply([0.0, 0.0, 1.0])
    units = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    assert turned == pytest.approx(units, abs=1e-6)


def test_the_axis_of_the_speeds_contains_zero_and_all_speeds():
    runs = pair()
    shown = recording_module._layout(RunContent(robot(), runs), {})
    speeds = np.concatenate([recording_module._speed(run)[1] for run in runs.values()])
    low, high = min(0.0, speeds.min()), speeds.max()
    assert high == pytest.approx(0.22, rel=0.3)  # the faster of the two
    assert shown.speeds == pytest.approx((1.1 * low, 1.1 * high))
    apart = np.hypot(*(runs["twin"].com - runs["analytical"].com).T)
    assert shown.separation == pytest.approx(apart.max())
    start = np.mean([run.com[0] for run in runs.values()], axis=0)
    assert shown.start == pytest.approx(start)
    assert (shown.segments, shown.period, shown.compared) == (4, 0.5, False)
    assert shown.heading == runs["twin"]["heading"][0]
