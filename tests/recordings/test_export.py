"""Exported runs: another library decodes them, and `inspect` and `replay` read them back."""

from __future__ import annotations

import json
from collections import defaultdict

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from srs_twin import Gait, TwinSnake, load_robot, rollout
from srs_twin.control.gait import PitchWave
from srs_twin.experiment import load_run, run_scenario
from srs_twin.pneumatics.chambers import AMBIENT_PA
from srs_twin.recordings.export import foxglove_layout, recording_map, write_mcap
from srs_twin.recordings.recording_map import read_map
from srs_twin.recordings.takes import RecordingReader
from srs_twin.scenario.loading import load_scenario

TEXT_VIEW_FACING = 9
"""Type of a label in visualization_msgs/Marker."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "run"
    run_scenario(load_scenario("gen2_turn", set={"duration_s": 1.0}), folder)
    return load_run(folder)


@pytest.fixture(scope="module")
def file(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("mcap") / "run.mcap"
    write_mcap(path, run.trajectories, run.scenario.robot.geometry)
    return path


def decoded(path):
    """Return the log times (s) and messages of each topic, decoded by another library."""
    seen = defaultdict(list)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages():
            seen[channel.topic].append((1e-9 * message.log_time, content))
    return seen


@pytest.fixture(scope="module")
def topics(file):
    return decoded(file)


def stamps(messages):
    return [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for _, m in messages]


@pytest.mark.parametrize("plant", ["analytical", "twin"])
def test_poses_and_transforms_are_those_of_the_run(run, topics, plant):
    trajectory = run.trajectories[plant]
    bodies = {
        f"connector_{i}": (place, trajectory[f"connector_heading_{i}"])
        for i, place in enumerate(np.moveaxis(trajectory.position, 1, 0), start=1)
    }
    bodies["com"] = (trajectory.com, trajectory["heading"])
    transforms = [each for _, message in topics["/tf"] for each in message.transforms]
    assert {each.header.frame_id for each in transforms} == {"world"}
    for name, (place, heading) in bodies.items():
        messages = topics[f"/{plant}/{name}/pose"]
        assert stamps(messages) == pytest.approx(trajectory.time, abs=1e-9)
        assert [time for time, _ in messages] == pytest.approx(stamps(messages))
        poses = [(m.pose.position, m.pose.orientation) for _, m in messages]
        moved = [
            (each.transform.translation, each.transform.rotation)
            for each in transforms
            if each.child_frame_id == f"{plant}/{name}"
        ]
        expected = np.column_stack([place, np.zeros(len(place))])
        for pairs in (poses, moved):
            points = [(point.x, point.y, point.z) for point, _ in pairs]
            assert points == pytest.approx(expected, abs=1e-9)
            angles = np.unwrap([2 * np.arctan2(turn.z, turn.w) for _, turn in pairs])
            assert angles == pytest.approx(heading, abs=1e-9)


@pytest.mark.parametrize("plant", ["analytical", "twin"])
def test_bends_and_pressures_are_those_of_the_run(run, topics, plant):
    trajectory = run.trajectories[plant]
    joints = [message for _, message in topics[f"/{plant}/bends"]]
    bends = np.array([joint.position for joint in joints])
    assert bends == pytest.approx(trajectory.stack("bend"), abs=1e-9)
    assert joints[0].name == ["segment_1", "segment_2", "segment_3", "segment_4"]
    rates = np.array([joint.velocity for joint in joints])
    slopes = (bends[2:] - bends[:-2]) / (trajectory.time[2:] - trajectory.time[:-2])[
        :, None
    ]
    assert rates[1:-1] == pytest.approx(slopes)
    for side in ("plus", "minus"):
        for j in range(1, 5):
            messages = topics[f"/{plant}/pressure_{side}_{j}"]
            gauge = np.array([m.fluid_pressure for _, m in messages]) - AMBIENT_PA
            expected = trajectory[f"pressure_{side}_{j}"]
            assert gauge == pytest.approx(expected, abs=1e-6)
            assert stamps(messages) == pytest.approx(trajectory.time, abs=1e-9)


def test_layout_of_the_valve_states_gives_the_state_of_each_chamber(run, topics):
    twin = run.trajectories["twin"]
    arrays = [message for _, message in topics["/twin/valves"]]
    segments, chambers = arrays[0].layout.dim
    assert (segments.label, segments.size) == ("segments", 4)
    assert (chambers.label, chambers.size) == ("chambers", 2)
    # By the definition of MultiArrayLayout, the outer stride is the number of elements.
    assert segments.stride == len(arrays[0].data)
    for c, side in enumerate(("plus", "minus")):
        for j in range(segments.size):
            states = [array.data[chambers.stride * j + c] for array in arrays]
            assert states == twin[f"valve_{side}_{j + 1}"].tolist()
    assert set(twin["valve_plus_1"]) != {0}


def test_markers_show_the_body_where_it_is(run, topics):
    twin = run.trajectories["twin"]
    geometry = run.scenario.robot.geometry
    shown = [message.markers for _, message in topics["/twin/body"]]
    assert len(shown) == len(twin)
    for row in (0, len(twin) // 2, -1):
        line, *connectors, label = shown[row]
        assert (label.text, label.type) == ("twin", TEXT_VIEW_FACING)
        assert all(marker.header.frame_id == "world" for marker in shown[row])
        assert len({marker.id for marker in shown[row]}) == len(shown[row])
        places = [(m.pose.position.x, m.pose.position.y) for m in connectors]
        assert places == pytest.approx(twin.position[row], abs=1e-9)
        head = connectors[0].pose.position
        above = label.pose.position
        assert (above.x, above.y) == pytest.approx((head.x, head.y))
        assert above.z == pytest.approx(head.z + 2 * geometry.width)
        points = np.array([(point.x, point.y, point.z) for point in line.points])
        # The line lies on the floor, begins at the head and ends at the last connector.
        assert points[:, 2].min() >= line.scale.x / 2
        assert points[[0, -1], :2] == pytest.approx(twin.position[row][[0, -1]])
        length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
        assert length == pytest.approx(geometry.body_length, rel=5e-3)


def test_the_layout_shows_topics_of_the_file(run, topics):
    layout = foxglove_layout(run.trajectories)["configById"]
    assert layout["3D!snakes"]["followTf"] == "world"
    assert layout["3D!snakes"]["topics"].keys() <= topics.keys()
    bends, pressures = (
        {each["value"] for each in layout[name]["paths"]}
        for name in ("Plot!bends", "Plot!pressures")
    )
    segments = topics["/twin/bends"][0][1].name
    plants = ("analytical", "twin")
    assert bends == {
        f'/{plant}/bends.position[:]{{name=="{segment}"}}'
        for plant in plants
        for segment in segments
    }
    assert pressures == {
        f"{topic}.fluid_pressure" for topic in topics if "/pressure_plus_" in topic
    }


def test_the_file_reads_back_as_a_recording_of_the_robot(run, file):
    twin = run.trajectories["twin"]
    reader = RecordingReader(map=read_map(recording_map("twin", twin)))
    recording = reader.take(str(file), str(file), run.scenario.robot)
    # The shapes in /twin/body are drawings. The file contains no data that are left out.
    assert not any("skipped" in text for text in recording.summary.corrections)
    apart = recording.trajectory.position - twin.position
    # Constant curvature is fitted to the poses.
    assert np.sqrt((apart**2).mean()) < 1e-3
    assert recording.valves.kind == "pressure"
    time, values = recording.valves.breakpoints()
    sides = [twin.stack("pressure_plus"), twin.stack("pressure_minus")]
    assert time - time[0] == pytest.approx(twin.time, abs=1e-9)
    assert values == pytest.approx(np.stack(sides, axis=-1), abs=1e-6)


@pytest.fixture
def exported(run, srs_twin, tmp_path):
    """Return a function that exports the run into the folder of the test."""
    return lambda *words: srs_twin("export", str(run.folder), *words, cwd=tmp_path)


def test_the_command_writes_each_format(run, exported, tmp_path):
    twin = run.trajectories["twin"]
    done = exported("--csv", "--out", "run.csv")
    assert done.returncode == 0, done.stderr
    table = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    assert set(table.dtype.names) == set(twin.columns)
    assert np.array_equal(table["x_1"], twin["x_1"])  # to the last bit
    assert exported("--npz", "--out", "run.npz").returncode == 0
    with np.load(tmp_path / "run.npz") as archive:
        assert np.array_equal(archive["bend_2"], twin["bend_2"])
        assert json.loads(str(archive["units"]))["bend_2"] == "rad"
        assert json.loads(str(archive["metadata"]))["plant"] == "twin"
    done = exported("--mcap", "--plant", "analytical", "--out", "a.mcap")
    assert done.returncode == 0
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {
        "run.csv",
        "run.npz",
        "a.mcap",
        "a.map.yaml",
        "a.foxglove.json",
    }
    assert {topic.split("/")[1] for topic in decoded(tmp_path / "a.mcap")} == {
        "analytical",
        "tf",
    }


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "output formats --mcap, --csv, --npz"),
        (
            ("--out", "x.parquet"),
            "x.parquet: the suffix '.parquet' is unknown; the name",
        ),
        (("--csv", "--npz"), "give exactly one of the output formats"),
        (
            ("--csv", "--out", "run.parquet"),
            "the name of a file for --csv must end in .csv",
        ),
        (("--csv", "--plant", "twim"), "did you mean twin"),
        (
            ("a.csv", "--out", "b.csv"),
            "FILE a.csv and --out b.csv both name the output",
        ),
    ],
)
def test_what_cannot_be_exported_is_refused(words, message, exported, tmp_path):
    done = exported(*words)
    assert done.returncode == 2
    assert message in done.stderr
    assert not list(tmp_path.iterdir())


def test_an_existing_file_is_kept(exported, tmp_path):
    (tmp_path / "run.csv").write_text("mine")
    done = exported("--csv", "--out", "run.csv")
    assert done.returncode == 2
    assert "--overwrite" in done.stderr
    assert (tmp_path / "run.csv").read_text() == "mine"
    assert exported("--csv", "--out", "run.csv", "--overwrite").returncode == 0


def test_a_spatial_robot_is_exported_with_its_heights(tmp_path):
    spec = load_robot("spatial_example")
    twin = TwinSnake(spec, supply_pa=20e3)
    run = rollout(twin, Gait(0.5, pitch=PitchWave(0.4)), 1.0, record_hz=10)
    path = tmp_path / "run.mcap"
    write_mcap(path, {"twin": run}, spec.geometry)
    poses = [message.pose for _, message in decoded(path)["/twin/connector_1/pose"]]
    assert np.ptp(run["z_1"]) > 1e-3
    assert [pose.position.z for pose in poses] == pytest.approx(run["z_1"], abs=1e-9)
    assert [pose.orientation.y for pose in poses] == pytest.approx(
        run["quaternion_y_1"], abs=1e-9
    )
