"""Exported runs: another library decodes them, and `inspect` and `replay` read them back."""

from __future__ import annotations

import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from srs_twin import Gait, TwinSnake, load_robot, rollout
from srs_twin.control.gait import PitchWave
from srs_twin.experiment import load_run, run_scenario
from srs_twin.pneumatics.chambers import AMBIENT_PA
from srs_twin.recordings.export import recording_map, write_mcap
from srs_twin.recordings.facts import in_words
from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recording_map import read_map
from srs_twin.recordings.takes import RecordingReader
from srs_twin.scenario.loading import load_scenario

TEXT_VIEW_FACING = 9
"""Type of a label in visualization_msgs/Marker."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "run"
    run_scenario(load_scenario("gen2_turn", set={"duration_s": 2.0}), folder)
    return folder


@pytest.mark.slow
def test_another_library_decodes_the_poses_of_the_parquet_file(run, tmp_path):
    path = tmp_path / "run.mcap"
    finished = load_run(run)
    write_mcap(path, finished.trajectories, finished.scenario.robot.geometry)
    seen: dict[str, list] = {}
    with path.open("rb") as file:
        for _, channel, message, decoded in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            seen.setdefault(channel.topic, []).append((message.log_time, decoded))
    for plant, trajectory in finished.trajectories.items():
        for i in range(1, 6):
            messages = seen[f"/{plant}/connector_{i}/pose"]
            times = [
                decoded.header.stamp.sec + 1e-9 * decoded.header.stamp.nanosec
                for _, decoded in messages
            ]
            assert times == pytest.approx(trajectory.time, abs=1e-9)
            assert [1e-9 * time for time, _ in messages] == pytest.approx(
                times, abs=1e-9
            )
            poses = [decoded.pose for _, decoded in messages]
            assert [(p.position.x, p.position.y) for p in poses] == pytest.approx(
                trajectory.position[:, i - 1], abs=1e-9
            )
            angles = np.unwrap(
                [2 * np.arctan2(p.orientation.z, p.orientation.w) for p in poses]
            )
            assert angles == pytest.approx(
                trajectory[f"connector_heading_{i}"], abs=1e-9
            )
        joints = [decoded for _, decoded in seen[f"/{plant}/bends"]]
        bends = np.array([joint.position for joint in joints])
        assert bends == pytest.approx(trajectory.stack("bend"), abs=1e-9)
        assert joints[0].name == ["segment_1", "segment_2", "segment_3", "segment_4"]
        # The rates integrate to the change of the bends.
        rates = np.array([joint.velocity for joint in joints])
        change = np.trapezoid(rates, trajectory.time, axis=0)
        assert change == pytest.approx(bends[-1] - bends[0], abs=0.02)
        for j in range(1, 5):
            pressure = [
                decoded.fluid_pressure
                for _, decoded in seen[f"/{plant}/pressure_minus_{j}"]
            ]
            gauge = trajectory[f"pressure_minus_{j}"]
            assert np.array(pressure) - AMBIENT_PA == pytest.approx(gauge, abs=1e-6)
        transforms = [decoded.transforms for _, decoded in seen["/tf"]]
        assert {t.child_frame_id for each in transforms for t in each} >= {
            f"{plant}/connector_1",
            f"{plant}/com",
        }
    assert len(seen["/tf"]) == 2 * len(trajectory)


def test_layout_of_the_valve_states_gives_the_state_of_each_chamber(run, tmp_path):
    path = tmp_path / "run.mcap"
    finished = load_run(run)
    write_mcap(path, finished.trajectories, finished.scenario.robot.geometry)
    twin = finished.trajectories["twin"]
    with path.open("rb") as file:
        messages = make_reader(file, decoder_factories=[DecoderFactory()])
        arrays = [
            decoded
            for *_, decoded in messages.iter_decoded_messages(topics="/twin/valves")
        ]
    segments, chambers = arrays[0].layout.dim
    assert (segments.label, segments.size) == ("segments", 4)
    assert (chambers.label, chambers.size) == ("chambers", 2)
    # By the definition of MultiArrayLayout, the outer stride is the number of elements.
    assert segments.stride == len(arrays[0].data)
    for c, side in enumerate(("plus", "minus")):
        for j in range(segments.size):
            place = chambers.stride * j + c
            states = [array.data[place] for array in arrays]
            assert states == twin[f"valve_{side}_{j + 1}"].tolist()
    assert set(twin["valve_plus_1"]) != {0}


def test_markers_show_the_body_where_it_is(run, tmp_path):
    path = tmp_path / "run.mcap"
    finished = load_run(run)
    geometry = finished.scenario.robot.geometry
    write_mcap(path, finished.trajectories, geometry)
    twin = finished.trajectories["twin"]
    with path.open("rb") as file:
        messages = make_reader(file, decoder_factories=[DecoderFactory()])
        shown = [
            decoded.markers
            for *_, decoded in messages.iter_decoded_messages(topics="/twin/body")
        ]
    assert len(shown) == len(twin)
    for row in (0, len(twin) // 2, -1):
        line, *connectors, label = shown[row]
        assert (label.text, label.type) == ("twin", TEXT_VIEW_FACING)
        assert all(marker.header.frame_id == "world" for marker in shown[row])
        assert len({marker.id for marker in shown[row]}) == len(shown[row])
        places = [(m.pose.position.x, m.pose.position.y) for m in connectors]
        assert places == pytest.approx(twin.position[row], abs=1e-9)
        points = np.array([(point.x, point.y, point.z) for point in line.points])
        # The line lies on the floor, begins at the head and ends at the last connector.
        assert points[:, 2].min() >= line.scale.x / 2
        assert points[[0, -1], :2] == pytest.approx(twin.position[row][[0, -1]])
        length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
        assert length == pytest.approx(geometry.body_length, rel=5e-3)


def test_the_file_reads_back_as_a_recording_of_the_robot(run, tmp_path):
    path = tmp_path / "run.mcap"
    finished = load_run(run)
    twin = finished.trajectories["twin"]
    spec = finished.scenario.robot
    write_mcap(path, finished.trajectories, finished.scenario.robot.geometry)
    reader = RecordingReader(map=read_map(recording_map("twin", twin)))
    recording = reader.take(str(path), str(path), spec)
    # The shapes in /twin/body are drawings. The file contains no data that are left out.
    assert not any("skipped" in text for text in recording.summary.corrections)
    apart = recording.trajectory.position - twin.position
    assert (
        np.sqrt((apart**2).mean()) < 1e-3
    )  # constant curvature is fitted to the poses
    assert recording.valves is not None and recording.valves.kind == "pressure"
    time, values = recording.valves.breakpoints()
    expected = np.stack(
        [twin.stack("pressure_plus"), twin.stack("pressure_minus")], axis=-1
    )
    assert time - time[0] == pytest.approx(
        twin.time, abs=1e-9
    ) and values == pytest.approx(expected, abs=1e-6)


def test_inspection_needs_no_further_map_for_mapped_signals(run, tmp_path):
    path = tmp_path / "run.mcap"
    finished = load_run(run)
    twin = finished.trajectories["twin"]
    write_mcap(path, {"twin": twin}, finished.scenario.robot.geometry)
    facts, _ = inspect_file(path, read_map(recording_map("twin", twin)), None)
    understood = {signal.name for signal in facts.signals if signal.understood}
    pressures = {
        f"/twin/pressure_{side}_{j}.fluid_pressure"
        for side in ("plus", "minus")
        for j in range(1, 5)
    }
    assert understood == pressures
    needing = [line for line in in_words(facts).split("\n") if "(needs a map)" in line]
    assert needing and not any("fluid_pressure" in line for line in needing)


def test_the_command_writes_each_format(run, srs_twin, tmp_path):
    twin = load_run(run).trajectories["twin"]
    done = srs_twin("export", str(run), "--csv", "--out", "run.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    assert set(table.dtype.names) == set(twin.columns)
    assert np.array_equal(table["x_1"], twin["x_1"])  # to the last bit

    assert (
        srs_twin(
            "export", str(run), "--npz", "--out", "run.npz", cwd=tmp_path
        ).returncode
        == 0
    )
    with np.load(tmp_path / "run.npz") as archive:
        assert np.array_equal(archive["bend_2"], twin["bend_2"])
        assert json.loads(str(archive["units"]))["bend_2"] == "rad"

    done = srs_twin(
        "export",
        str(run),
        "--mcap",
        "--plant",
        "analytical",
        "--out",
        "a.mcap",
        cwd=tmp_path,
    )
    assert done.returncode == 0 and {path.name for path in tmp_path.iterdir()} >= {
        *("a.mcap", "a.map.yaml", "a.foxglove.json")
    }


@pytest.mark.default_cases(at=[0, 2, 3])
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "output formats --mcap, --csv, --npz"),
        (("--csv", "--npz"), "give exactly one of the output formats"),
        (
            ("--csv", "--out", "run.parquet"),
            "the name of a file for --csv must end in .csv",
        ),
        (("--csv", "--plant", "twim"), "did you mean twin"),
    ],
)
def test_what_cannot_be_exported_is_refused(words, message, run, srs_twin, tmp_path):
    done = srs_twin("export", str(run), *words, cwd=tmp_path)
    assert (
        done.returncode == 2 and message in done.stderr and not list(tmp_path.iterdir())
    )


def test_an_existing_file_is_kept(run, srs_twin, tmp_path):
    (tmp_path / "run.csv").write_text("mine")
    done = srs_twin("export", str(run), "--csv", "--out", "run.csv", cwd=tmp_path)
    assert done.returncode == 2 and "--overwrite" in done.stderr
    assert (tmp_path / "run.csv").read_text() == "mine"
    assert (
        srs_twin(
            "export", str(run), "--csv", "--out", "run.csv", "--overwrite", cwd=tmp_path
        ).returncode
        == 0
    )


def test_a_spatial_robot_is_exported_with_its_heights(tmp_path):
    spec = load_robot("spatial_example")
    twin = TwinSnake(spec, supply_pa=20e3)
    run = rollout(twin, Gait(0.5, pitch=PitchWave(0.4)), 1.0, record_hz=10)
    path = tmp_path / "run.mcap"
    write_mcap(path, {"twin": run}, spec.geometry)
    with path.open("rb") as file:
        messages = make_reader(file, decoder_factories=[DecoderFactory()])
        poses = [
            decoded.pose
            for *_, decoded in messages.iter_decoded_messages(
                topics="/twin/connector_1/pose"
            )
        ]
    assert np.ptp(run["z_1"]) > 1e-3
    assert [pose.position.z for pose in poses] == pytest.approx(run["z_1"], abs=1e-9)
    assert [pose.orientation.y for pose in poses] == pytest.approx(
        run["quaternion_y_1"], abs=1e-9
    )
