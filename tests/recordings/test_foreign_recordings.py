"""Replays and fits of foreign files: a ROS 2 bag, and CSV files with other column names."""

from __future__ import annotations

import json

import numpy as np
import pytest
from bag_files import ns, written
from recorded import SPEC, csv_text, motion, true_at
from synthetic_takes import Take, markers

from srs_twin.cli import main
from srs_twin.recordings.recording_map import read_map
from srs_twin.recordings.takes import RecordingReader

SHIFT = 7.3  # s, of the log's clock in the CSV files
NOISE = 2e-4
SIDES = ("plus", "minus")


def valves():
    """Return the valve states on the frames of the motion, shape (frames, segments, 2)."""
    truth = motion()
    return np.stack([truth.stack(f"valve_{side}") for side in SIDES], axis=-1)


def seen():
    """Return markers of layout head, with noise, shape (frames, 6, 2), m."""
    place = markers(motion(), Take(layout="head"))
    return place + NOISE * np.random.default_rng(4).standard_normal(place.shape)


def bag(folder):
    """Write a bag with a pose of each connector, mounted at any angle, and the valves as JSON."""
    truth = motion()
    random = np.random.default_rng(5)
    states = valves().astype(int)
    kind = "geometry_msgs/PoseStamped"
    mounted = 0.3 * np.arange(5)
    heading = truth.stack("connector_heading") + mounted
    half = (heading + 5e-3 * random.standard_normal(heading.shape)) / 2
    places = truth.position + NOISE * random.standard_normal(truth.position.shape)

    def messages(make):
        for k in range(len(truth)):
            for j in range(5):
                turn = [0.0, 0.0, np.sin(half[k, j]), np.cos(half[k, j])]
                pose = make.pose([*places[k, j], 0.03], turn)
                body = make(kind, header=make.header(k), pose=pose)
                yield f"/snake/link{j + 1}", kind, ns(k), body
            said = {side: states[k, :, c].tolist() for c, side in enumerate(SIDES)}
            yield "/valves", "json", ns(k), said

    return written(folder, "mcap", messages)


BAG = {
    "bodies": {f"/snake/link{j}": {"connector": j} for j in range(1, 6)},
    "log": {
        f"valve_{side}_{j}": f"/valves.{side}[{j - 1}]"
        for j in range(1, 5)
        for side in SIDES
    },
}
LEDS = ("front", "base", "led2", "led3", "led4", "tip")
NAMED = {
    "units": "cm",
    "markers": (
        {"front": {"connector": 1, "side": "ahead"}}
        | {name: {"connector": k} for k, name in enumerate(LEDS[1:], start=1)}
    ),
    "log": (
        {"time": "Stamp"}
        | {
            f"valve_{side}_{j}": f"V{j}{side[0].upper()}"
            for j in range(1, 5)
            for side in SIDES
        }
    ),
}


def leds(folder):
    """Write the markers in cm and the valves with other names and another clock."""
    head = ["Time (s)", *(f"{name} {axis}" for name in LEDS for axis in "XY")]
    rows = np.column_stack([motion().time, 100 * seen().reshape(len(motion()), -1)])
    (folder / "leds.csv").write_text(csv_text(head, rows, 6))
    names = [
        "Stamp",
        *(f"V{j}{side[0].upper()}" for j in range(1, 5) for side in SIDES),
        "Battery",
    ]
    states = valves().reshape(len(motion()), -1)
    rows = np.column_stack([motion().time - SHIFT, states, np.full(len(states), 11.1)])
    (folder / "io.csv").write_text(csv_text(names, rows, 6))


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Return a folder with a bag and foreign CSV files of one run."""
    folder = tmp_path_factory.mktemp("lab")
    bag(folder)
    leds(folder)
    return folder


@pytest.mark.parametrize(
    ("take", "log", "given", "offset"),
    [
        ("walk.mcap", "walk.mcap", BAG, 0.0),
        ("leds.csv", "io.csv", NAMED, SHIFT),
    ],
)
def test_the_motion_is_recovered_within_its_errors(lab, take, log, given, offset):
    reader = RecordingReader(map=read_map(given))
    found = reader.take(str(lab / take), str(lab / log), SPEC)
    bends = found.trajectory.stack("bend")
    error = bends - true_at(found.trajectory, motion()).stack("bend")
    within = np.abs(error) < 1.96 * found.trajectory.stack("bend_error")
    assert 0.9 < within.mean() < 0.99
    assert np.sqrt((error**2).mean()) < 0.04
    about = found.trajectory.metadata["valve_log"]
    assert about["offset_s"] == pytest.approx(offset, abs=0.01)


@pytest.mark.slow
def test_a_replay_of_foreign_files_runs_again_from_its_scenario(lab, monkeypatch):
    def metrics(folder, *words):
        with pytest.raises(SystemExit) as left:
            main([*words, "--out", folder, "--quiet"])
        assert left.value.code == 0
        return json.loads((lab / folder / "metrics.json").read_text())["plants"]["twin"]

    monkeypatch.chdir(lab)
    (lab / "leds.yaml").write_text(json.dumps(NAMED))
    words = ["leds.csv", "--valves", "io.csv", "--map", "leds.yaml", "-r", "gen2"]
    one = metrics("one", "replay", *words)
    two = metrics("two", "run", "one/scenario.resolved.yaml")
    assert one["com_speed_m_s"] == two["com_speed_m_s"]
    assert one["measured_shape_rms_m"] < 0.01
