"""Facts of `srs-twin inspect` are correct, and recordings can be read with the proposed map."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from jsonschema import Draft202012Validator
from recorded import NOISE, RATE, SPEC, csv_text, motion, valve_csv
from synthetic_takes import Take, motive_csv, write_motive
from test_foreign_recordings import bag
from test_formats import FILES

from srs_twin.cli import main
from srs_twin.cli.options import print_json
from srs_twin.io.validation import load_model
from srs_twin.recordings.facts import RecordingFacts, in_words, proposed_map
from srs_twin.recordings.inspection import inspect, inspect_file, markers_view
from srs_twin.recordings.recording import read_motion
from srs_twin.recordings.recording_map import NO_MAP, RecordingMap


def inspected(folder, take, **known):
    path = folder / "take.csv"
    write_motive(motion(), take, path)
    return inspect_file(path, RecordingMap(**known), None)


def test_facts_of_a_marker_recording(tmp_path):
    facts, scene = inspected(
        tmp_path, Take(layout="head", labeled=True, unit="cm", up="x")
    )
    assert facts.format == "Motive CSV 1.21"
    assert facts.content == "markers"
    assert facts.up == "x"
    assert facts.rate_hz == pytest.approx(RATE)
    assert facts.frames == len(motion())
    assert facts.noise_mm == pytest.approx(1e3 * NOISE, rel=0.2)
    assert facts.markers[0].noise_mm == pytest.approx(1e3 * facts.markers[0].noise_m)
    assert facts.order == ["snake:ahead", *(f"snake:{k}" for k in range(1, 6))]
    assert facts.rigid_pairs == [["snake:ahead", "snake:1"]]
    assert {each.marker for each in facts.head} == {"snake:ahead"}
    crawled = float(facts.head[1].why.split()[3])  # m
    assert crawled == pytest.approx(
        np.hypot(*(motion().com[-1] - motion().com[0])), rel=0.1
    )
    assert facts.duration_s == pytest.approx(4.0)
    assert facts.announced_frames == len(motion())
    assert (facts.frames_missing, facts.tracks, facts.positions_of_nothing) == (0, 6, 0)
    assert facts.in_other_columns == 0.0
    assert facts.layouts["head"] == 5
    assert facts.layouts["single"] == 6
    assert "lengths were converted from cm to m" in facts.notes
    near = {frozenset(each.markers): each for each in facts.distances}
    pair = near[frozenset(["snake:ahead", "snake:1"])]
    assert pair.median_mm == pytest.approx(20, abs=0.2)
    assert pair.spread_mm < 0.5
    assert near[frozenset(["snake:1", "snake:2"])].spread_mm > 0.5
    assert scene.places.shape == (len(motion()), 6, 2)
    assert scene.rigid == ((0, 1),)
    for line in (
        "401 frames, 100 Hz, 4 s",
        f"up: x; noise {facts.noise_mm:.2g} mm; 6 persistent markers",
        "head: snake:ahead (the only end with a second marker on a rigid part); snake",
        "snake:1: seen in 100.0 % of the frames, 0 gaps up to 0 s, noise 0.",
        " mm, 30 mm high",
        f"snake:ahead to snake:1: {pair.median_mm:.1f} mm, varies by 0.",
        "layouts with this number of markers: single (6 connectors), head (5 connectors)",
    ):
        assert line in in_words(facts)
    places = proposed_map([facts])
    assert '"snake:ahead": {connector: 1, side: ahead}' in places
    assert '"snake:1": {connector: 1}' in places
    assert '"snake:5": {connector: 5}' in places


def test_gaps_and_coverage_are_counted(tmp_path):
    facts, _ = inspected(
        tmp_path,
        Take(labeled=True, occluded=[(2, 1.0, 1.15), (2, 2.0, 2.05), (4, 3.5, 9.0)]),
    )
    third = facts.markers[2]
    last = facts.markers[4]
    assert third.gaps == 2 and third.longest_gap_s == pytest.approx(0.16)
    assert third.coverage == pytest.approx(1 - 20 / 401) and last.gaps == 0
    assert last.coverage == pytest.approx(350 / 401)
    assert "snake:3: seen in 95.0 % of the frames, 2 gaps up to 0.16 s" in in_words(
        facts
    )


@pytest.mark.parametrize("layout", ["single", "head", "pair"])
def test_the_proposed_map_reads_the_recording(tmp_path, layout):
    facts, _ = inspected(tmp_path, Take(layout=layout, labeled=False, seed=3))
    path = tmp_path / "map.yaml"
    path.write_text(proposed_map([facts]))
    found = read_motion(
        tmp_path / "take.csv", SPEC, map=load_model(RecordingMap, path)
    ).trajectory
    known = read_motion(tmp_path / "take.csv", SPEC).trajectory
    assert found.stack("bend") == pytest.approx(known.stack("bend"), abs=1e-6)


def test_a_wrong_unit_of_length_is_noted(tmp_path):
    path = tmp_path / "x.csv"
    position = 1e3 * motion().position.reshape(len(motion()), -1)
    names = [f"{name}_{axis}" for name in "abcde" for axis in "xy"]
    rows = np.column_stack([motion().time, position])
    path.write_text(csv_text(["t", *names], rows, 6))
    assert any(
        "if the lengths are in mm, give --units mm" in each
        for each in inspect_file(path, NO_MAP, None)[0].notes
    )
    facts, _ = inspect_file(path, RecordingMap(units="mm"), SPEC)
    assert not any("give --units mm" in each for each in facts.notes)
    assert facts.robot.reads
    assert facts.robot.layout == "single"
    assert facts.robot.stretch == pytest.approx([0.0] * 4, abs=0.02)
    assert facts.robot.length_mm == pytest.approx(
        [1e3 * SPEC.geometry.segment_length] * 4, rel=0.02
    )


def test_the_map_names_no_markers_that_change_their_columns(tmp_path):
    facts, _ = inspected(tmp_path, Take(swaps=20, seed=2))
    path = tmp_path / "map.yaml"
    path.write_text(text := proposed_map([facts]))
    proposed = load_model(RecordingMap, path)
    assert proposed.up == facts.up and not proposed.markers
    assert "states no places" in text
    share = (
        f"{100 * facts.in_other_columns:.2g} % of the positions are not in the columns"
    )
    assert share in text
    assert any(note.startswith(share) for note in facts.notes)
    read_motion(tmp_path / "take.csv", SPEC, map=proposed)


def test_facts_of_a_log(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(valve_csv(motion(), 0.0, 4.0, 7.0))
    facts, scene = inspect_file(path, NO_MAP, None)
    assert scene is None and facts.content == "log" and facts.starts_s == 7.0
    first = facts.signals[0]
    assert first.understood and first.looks_like == "valve states"
    assert first.openings_per_s == pytest.approx(2.0, rel=0.02)
    assert facts.duration_s == pytest.approx(4.0)
    line = '  valve_plus_1: "valve_plus_1"  # valve states, -1 to 1\n'
    assert line in proposed_map([facts])


def test_quantities_are_known_by_names_and_units(tmp_path):
    """Neither other words nor the range of the values tell a quantity."""
    known = {
        "valve_plus_1": ([0, 1], "valve states"),
        "duty_minus_1": ([0.5, 1], "duty"),
        "setpoint_plus_2": ([22.0, 41.0], "pressure, without a unit"),
        "bend_1": ([-0.4, 0.9], "angle, without a unit"),
        "note": (["x", "x"], "text"),
        "Valve1": ([0, 1], "unknown"),
        "PWM 1": ([0, 50], "unknown"),
        "setpoint 2": ([22.0, 41.0], "unknown"),
        "torque": ([0.1, 1.0], "unknown"),
        "force_N": ([22.0, 48.3], "unknown"),
        "battery": ([7.2, 8.1], "unknown"),
        "velocity": ([-0.3, 0.2], "unknown"),
        "P1 (MPa)": ([0.0, 0.03], "pressure, MPa: 0 to 30 kPa"),
        "theta1 (deg)": ([-3.0, 2.0], "angle, deg"),
        "theta2 (deg)": ([-3.0, 2.0], "angle, deg"),
    }
    columns = {name: values * 50 for name, (values, _) in known.items()}
    table = pd.DataFrame({"time": 0.01 * np.arange(100), **columns})
    table.to_csv(tmp_path / "log.csv", index=False)
    facts, _ = inspect_file(tmp_path / "log.csv", NO_MAP, None)
    assert [signal.name for signal in facts.signals] == list(known)
    for signal, (_, said) in zip(facts.signals, known.values(), strict=True):
        assert signal.looks_like.startswith(said), signal.name
    assert '# bend_3: "theta2 (deg)"' in proposed_map([facts])
    battery = facts.signals[10]
    assert (battery.low, battery.high, battery.distinct) == (7.2, 8.1, 2)


def test_a_bag_has_bodies_and_signals(tmp_path):
    facts, _ = inspect_file(bag(tmp_path), NO_MAP, None)
    assert facts.format == "MCAP"
    assert [each.rigid_body for each in facts.markers] == [True] * 5
    assert all(len(set(each.markers)) == 2 for each in facts.distances)
    assert {each.looks_like for each in facts.signals} == {"unknown"}
    text = proposed_map([facts])
    for line in ("bodies:", '"/snake/link1": {connector: 1}', '"/valves.plus[0]"'):
        assert line in text


def run(words, code=0):
    with pytest.raises(SystemExit) as left:
        main(words)
    assert left.value.code == code


def test_the_picture_has_a_legend_of_the_frames(tmp_path):
    _, scene = inspected(tmp_path, Take(layout="head"))
    (axes,) = markers_view(scene).axes
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert texts == ["first frame", "middle frame", "last frame"]
    drawn = {line.get_label(): line.get_xydata() for line in axes.lines}
    for label, row in zip(texts, (0, len(scene.places) // 2, -1), strict=True):
        assert (drawn[label] == scene.places[row, list(scene.order)]).all()


def test_inspect_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_motive(motion(), Take(layout="head"), "take.csv")
    (tmp_path / "cut.csv").write_text(motive_csv(motion(), Take())[:300])
    run(["inspect", "take.csv", "--picture", "seen.png", "--write-map", "map.yaml"])
    assert "one rigid part" in capsys.readouterr().out
    assert (tmp_path / "seen.png").read_bytes().startswith(b"\x89PNG")
    run(["inspect", "take.csv", "--write-map", "map.yaml"], 2)
    assert (
        "map.yaml already exists; replace it with --overwrite"
        in capsys.readouterr().err
    )
    run(["inspect", "cut.csv", "take.csv", "--json"], 2)
    said = capsys.readouterr()
    assert [each["file"] for each in json.loads(said.out)] == [
        "take.csv"
    ] and "cut.csv:" in said.err
    run(["inspect", "take.csv", "--robot", "gen2", "--units", "mm"])
    assert "layout head" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["walk.mcap", "walk.MCAP"])
def test_inspect_uses_the_map_beside_a_bag(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    bag(tmp_path).rename(name)
    (tmp_path / "walk.map.yaml").write_text("up: z\n")
    run(["inspect", name])
    assert "using the recording map walk.map.yaml" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("header", "robot", "reads", "said"),
    [
        ("valve_plus_1,valve_minus_1", "gen4_module", True, "valve log, 20 rows"),
        ("bend_1_deg,P1 (kPa)", "gen4_module", True, "kept: 20 rows"),
        (
            "valve_plus_1,valve_minus_1",
            "gen2",
            False,
            "'valve_plus_2' is missing; gen2 has 4",
        ),
        (
            "bend_1,pressure_plus_1_kpa",
            "gen4_module",
            False,
            "'pressure_minus_1' is missing",
        ),
        (
            "valve_plus_1,valve_plus_2",
            "gen4_module",
            False,
            "'valve_minus_1' is missing",
        ),
        ("P1 (kPa),P2 (kPa)", "gen4_module", False, "assign other names in a map"),
    ],
)
def test_a_log_is_read_as_a_log_of_the_robot(tmp_path, header, robot, reads, said):
    rows = "".join(f"{k / 10},{k % 2},0\n" for k in range(20))
    (tmp_path / "log.csv").write_text(f"time,{header}\n{rows}")
    found = inspect(tmp_path / "log.csv", robot=robot).robot
    assert said in found.says
    assert found.reads == reads


def test_repeated_rows_are_judged_without_unknown_columns(tmp_path):
    order = [*range(56), 50, 51, 52, *range(56, 100)]
    rows = "".join(f"{k / 10},{k % 2},0,{n}\n" for n, k in enumerate(order))
    path = tmp_path / "log.csv"
    path.write_text(f"time,valve_plus_1,valve_minus_1,received\n{rows}")
    found = inspect(path, robot="gen4_module")
    assert found.robot.reads
    assert (found.steps_back, found.repeated_times, found.rows) == (1, 0, 103)
    assert "3 rows were left out" in found.robot.says
    assert any("3 rows were left out" in note for note in found.notes)
    assert not any("refuse this file" in note for note in found.notes)


def typed(schema):
    """Yield every part of a schema that has a type."""
    if isinstance(schema, dict):
        yield from [schema] * (schema.get("type") in ("number", "integer"))
        schema = list(schema.values())
    if isinstance(schema, list):
        for each in schema:
            yield from typed(each)


def test_json_matches_its_schema(tmp_path, monkeypatch, capsys):
    """It includes markers, bodies with signals, logs and unreadable files; every number has a unit."""
    monkeypatch.chdir(tmp_path)
    run(["schema", "inspect"])
    schema = json.loads(capsys.readouterr().out)
    Draft202012Validator.check_schema(schema)
    assert all("unit" in each for each in typed(schema))
    for block in (schema["$defs"][name] for name in schema["$defs"]):
        assert all(each.get("description") for each in block["properties"].values())
    write_motive(motion(), Take(layout="head", unit="cm"), "take.csv")
    (tmp_path / "take.c3d").write_bytes(FILES["C3D"]())
    (tmp_path / "log.csv").write_text(valve_csv(motion(), 0.0, 4.0, 7.0))
    (tmp_path / "none.csv").write_text("hello\nworld\n")
    bag(tmp_path)
    files = ["take.csv", "take.c3d", "log.csv", "walk.mcap", "none.csv"]
    run(["inspect", *files, "-r", "gen2", "--json"], 2)
    found = json.loads(capsys.readouterr().out)
    Draft202012Validator(schema).validate(found)
    assert [each["format"] for each in found] == [
        "Motive CSV 1.21",
        "C3D",
        "plain CSV",
        "MCAP",
    ]
    take, c3d, log, walk = found
    assert (take["units"], take["bodies"], c3d["units"]) == ("cm", [], "mm")
    assert take["markers"][0]["noise_m"] == pytest.approx(NOISE, rel=0.2)
    assert any(each.startswith("markers:") for each in take["proposals"])
    assert "log:" in log["proposals"]
    assert walk["bodies"][0] == "/snake/link1" and c3d["robot"]["reads"] is False
    assert take["robot"]["reads"] and "markers" not in log


def test_numpy_numbers_do_not_reach_json(capsys):
    facts = RecordingFacts(
        file="x",
        format="C3D",
        content="markers",
        sha256="",
        proposals=[],
        notes=[],
        frames=np.uint16(435),
    )
    facts.rate_hz = np.float32(100)
    plain = facts.document()
    assert (type(plain["frames"]), type(plain["rate_hz"])) == (int, float)
    print_json(
        {
            "a": np.uint16(3),
            "b": np.arange(2),
            "c": np.float32(0.5),
            "d": np.bool_(True),
        }
    )
    assert json.loads(capsys.readouterr().out) == {
        "a": 3,
        "b": [0, 1],
        "c": 0.5,
        "d": True,
    }
