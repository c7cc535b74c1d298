"""Replays and fits of foreign files: a ROS 2 bag, and CSV files with other column names."""

from __future__ import annotations

import json

import numpy as np
import pytest
from mcap_ros2.writer import Writer
from recorded import RATE, csv_text, motion
from synthetic_takes import Take, markers, write_motive
from test_formats import DEFINED, ns, pose, stamped

from srs_twin import Trajectory
from srs_twin.cli import main

pytestmark = pytest.mark.slow

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


def bag(path):
    """Write a bag with a pose of each connector, mounted at any angle, and the valves as JSON."""
    truth = motion()
    random = np.random.default_rng(5)
    states = valves()
    name = "geometry_msgs/msg/PoseStamped"
    with path.open("wb") as stream:
        writer = Writer(stream)
        kind = writer.register_msgdef(name, DEFINED[name])
        raw = writer._writer
        channel = raw.register_channel(
            "/valves", "json", raw.register_schema("valves", "jsonschema", b"{}")
        )
        for k, time in enumerate(truth.time):
            stamp = ns(time)
            for j in range(5):
                place = [
                    *(truth.position[k, j] + NOISE * random.standard_normal(2)),
                    0.03,
                ]
                half = (
                    truth[f"connector_heading_{j + 1}"][k]
                    + 0.3 * j
                    + 5e-3 * random.standard_normal()
                ) / 2
                body = {
                    "header": stamped(stamp),
                    "pose": pose(place, [0.0, 0.0, np.sin(half), np.cos(half)]),
                }
                writer.write_message(f"/snake/link{j + 1}", kind, body, log_time=stamp)
            said = {
                side: states[k, :, c].astype(int).tolist()
                for c, side in enumerate(SIDES)
            }
            raw.add_message(channel, stamp, json.dumps(said).encode(), stamp)
        writer.finish()
    return path


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


def run(words):
    with pytest.raises(SystemExit) as left:
        main(words)
    assert left.value.code == 0


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    """Return a folder with replays of one run from a Motive export, a bag and foreign CSV files."""
    folder = tmp_path_factory.mktemp("lab")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_motive(motion(), Take(layout="head", noise=NOISE, seed=4), "take.csv")
        names = [f"valve_{side}_{j}" for j in range(1, 5) for side in SIDES]
        rows = np.column_stack([motion().time, valves().reshape(len(motion()), -1)])
        (folder / "take.valves.csv").write_text(csv_text(["time", *names], rows, 6))
        bag(folder / "walk.mcap")
        leds(folder)
        (folder / "bag.yaml").write_text(json.dumps(BAG))
        (folder / "leds.yaml").write_text(json.dumps(NAMED))
        robot = ["--robot", "gen2", "--quiet"]
        run(["replay", "take.csv", *robot])
        run(["replay", "walk.mcap", "--map", "bag.yaml", *robot])
        run(["replay", "leds.csv", "--valves", "io.csv", "--map", "leds.yaml", *robot])
    return folder


@pytest.mark.parametrize("name", ["take", "walk", "leds"])
def test_the_motion_is_recovered_within_its_errors(replayed, name):
    found = Trajectory.from_parquet(replayed / f"runs/{name}/measured.parquet")
    rows = np.rint((found.time - found.time[0]) * RATE).astype(int)
    truth = motion().stack("bend")
    offset = min(
        range(3),
        key=lambda k: np.abs(
            found.stack("bend") - truth[(rows + k) % len(truth)]
        ).mean(),
    )
    error = found.stack("bend") - truth[(rows + offset) % len(truth)]
    assert 0.9 < (np.abs(error) < 1.96 * found.stack("bend_error")).mean() < 0.99
    assert np.sqrt((error**2).mean()) < 0.04


@pytest.mark.parametrize("name", ["walk", "leds"])
def test_plants_differ_as_little_as_from_a_motive_export(replayed, name):
    known, found = (
        json.loads((replayed / f"runs/{each}/metrics.json").read_text())["plants"]
        for each in ("take", name)
    )
    for plant in ("analytical", "twin"):
        for metric in ("measured_com_speed_rel", "measured_yaw_rate_abs"):
            assert found[plant][metric] == pytest.approx(known[plant][metric], abs=0.01)


def test_a_replay_of_foreign_files_runs_again_from_its_scenario(replayed, monkeypatch):
    monkeypatch.chdir(replayed)
    run(["run", "runs/leds/scenario.resolved.yaml", "--out", "again", "--quiet"])
    one, two = (
        json.loads((replayed / f"{each}/metrics.json").read_text())
        for each in ("runs/leds", "again")
    )
    assert (
        one["plants"]["twin"]["com_speed_m_s"] == two["plants"]["twin"]["com_speed_m_s"]
    )


def test_a_bag_can_be_fitted(replayed, monkeypatch, capsys):
    monkeypatch.chdir(replayed)
    words = [
        "--robot",
        "gen2",
        "--map",
        "bag.yaml",
        "--parameters",
        "geometry.rigid_gap_m",
        "--starts",
        "1",
        "--json",
    ]
    run(["calibrate", "locomotion", "walk.mcap", *words, "--name", "bag"])
    assert "geometry.rigid_gap_m" in capsys.readouterr().out
