"""Paths in files are relative to the file first, then to the current folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from srs_twin import load_scenario
from srs_twin.errors import InputError
from srs_twin.identification.fit_file import load_fit
from srs_twin.io.documents import dump_yaml
from srs_twin.io.files import data_root
from srs_twin.live.setup_file import load_setup
from srs_twin.scenario.provenance import file_digests
from srs_twin.studies.optimization.loading import load_study
from srs_twin.studies.sweep.loading import load_sweep

GAIT = {"kind": "gait", "frequency_hz": 2.0}
SCENARIO = {
    "robot": "gen2",
    "duration_s": 1.0,
    "controller": GAIT,
    "plants": {"analytical": {}},
}
FOLLOW = {
    "controller": {"kind": "follow", "gait": GAIT},
    "world": {"goal": {"x_m": 1.0, "y_m": 0.0}},
}
REPLAY = {"controller": {"kind": "replay"}}
SWEEP = {"vary": {"controller.frequency_hz": [1.0, 2.0]}}
STUDY = {
    "variables": {"controller.frequency_hz": {"low": 1.0, "high": 2.0}},
    "objectives": [{"metric": "com_speed_m_s", "goal": "maximize"}],
}

# Loader, keys of the file (PATH is the path), and the name of the other file. The other
# file is invalid, so that a message about its content shows which one was read.
KINDS = {
    "robot": (load_scenario, SCENARIO | {"robot": "PATH"}, "r.yaml"),
    "robot.base": (load_scenario, SCENARIO | {"robot": {"base": "PATH"}}, "r.yaml"),
    "world.map": (load_scenario, SCENARIO | {"world": {"map": "PATH"}}, "m.yaml"),
    "world.circles": (
        load_scenario,
        SCENARIO | {"world": {"circles": "PATH"}},
        "c.csv",
    ),
    "start.from": (
        load_scenario,
        SCENARIO | {"start": {"from": "PATH", "time_s": 1.0}},
        "a_run",
    ),
    "planner": (
        load_scenario,
        SCENARIO | FOLLOW | {"planner": {"kind": "best_first", "footprint": "PATH"}},
        "f.yaml",
    ),
    "motion": (
        load_scenario,
        SCENARIO | REPLAY | {"recording": {"motion": "PATH", "valves": "own.csv"}},
        "w.csv",
    ),
    "valves": (
        load_scenario,
        SCENARIO | REPLAY | {"recording": {"motion": "own.csv", "valves": "PATH"}},
        "v.csv",
    ),
    "sweep": (load_sweep, SWEEP | {"scenario": "PATH"}, "s.yaml"),
    "sweep.fixed": (
        load_sweep,
        SWEEP | {"scenario": "gen2_straight", "fixed": {"robot": "PATH"}},
        "r.yaml",
    ),
    "sweep.vary": (
        load_sweep,
        {"scenario": "gen2_straight", "vary": {"robot": ["gen2", "PATH"]}},
        "r.yaml",
    ),
    "study": (load_study, STUDY | {"scenario": "PATH"}, "s.yaml"),
    "study.fixed": (
        load_study,
        STUDY | {"scenario": "gen2_straight", "fixed": {"world.circles": "PATH"}},
        "c.csv",
    ),
}


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """Return the folder of the files; the current folder is the one around it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab").mkdir()
    return Path("lab")


def write(path: Path, data: object, name: str) -> Path:
    path.write_text(dump_yaml(data).replace("PATH", name), "utf-8")
    return path


def put(path: Path) -> None:
    """Make an invalid file or, for a run, a folder without files."""
    path.parent.mkdir(exist_ok=True)
    if path.suffix:
        path.write_text("- 1\n", "utf-8")
    else:
        path.mkdir()


def refusal(load, path: Path) -> str:
    with pytest.raises(InputError) as error:
        load(path)
    return str(error.value)


@pytest.mark.parametrize("kind", KINDS)
def test_path_is_relative_to_its_file_then_to_the_current_folder(lab, kind):
    load, data, name = KINDS[kind]
    path = write(lab / "x.yaml", data, f"deep/{name}")
    (line,) = (line for line in refusal(load, path).splitlines() if name in line)
    assert line.startswith("lab/x.yaml:")
    both_places = f"(looked for lab/deep/{name} and deep/{name})"
    assert f"deep/{name}: no such file {both_places}" in line
    for place in ("", "lab/"):
        put(Path(f"{place}deep/{name}"))
        # The name of a file in a message begins after a blank or at the start of a
        # line.
        words = refusal(load, path).split()
        assert any(word.startswith(f"{place}deep/{name}") for word in words)


def test_a_name_is_not_a_path_beside_the_file(lab):
    (lab / "gen2").mkdir()
    (lab / "gen2_gait").mkdir()
    planner = {"planner": {"kind": "best_first", "footprint": "gen2_gait"}}
    scenario = load_scenario(write(lab / "x.yaml", SCENARIO | FOLLOW | planner, ""))
    assert scenario.robot.name == "gen2"
    assert scenario.document["planner"]["footprint"] == "gen2_gait"


def test_path_of_an_option_is_relative_to_the_current_folder(lab, srs_twin):
    circles = "x_m,y_m,radius_m\n{},0.5,0.03\n"
    (lab / "c.csv").write_text(circles.format(1))
    Path("c.csv").write_text(circles.format(2))
    path = write(lab / "x.yaml", SCENARIO, "")
    scenario = load_scenario(path, set={"world.circles": "c.csv"})
    assert [circle.x for circle in scenario.world.obstacles] == [2.0]
    done = srs_twin("run", "lab/x.yaml", "--set", "world.map=gone.yaml", cwd=Path.cwd())
    assert (
        "--set world.map=gone.yaml: world.map: gone.yaml: no such file\n" in done.stderr
    )


def test_an_option_replaces_a_missing_file(lab):
    path = write(lab / "x.yaml", SCENARIO | {"robot": "gone.yaml"}, "")
    scenario = load_scenario(path, set={"robot": "gen3"})
    assert scenario.robot.name == "gen3"
    unchanged = SCENARIO | {"world": {"circles": "c.csv"}}
    (lab / "c.csv").write_text("x_m,y_m,radius_m\n1,0.5,0.03\n")
    changed = load_scenario(
        write(lab / "y.yaml", unchanged, ""), set={"world.floor.tilt_deg": 0.0}
    )
    assert changed.document.get("changes") is None, (
        "a found file is not a changed field"
    )


def test_resolved_paths_are_absolute_and_their_content_belongs_to_the_key(lab):
    footprint = data_root() / "calibration/footprints/gen2_gait.yaml"
    (lab / "f.yaml").write_bytes(footprint.read_bytes())
    (lab / "maps").mkdir()
    (lab / "maps/picture.pgm").write_bytes(b"P5\n2 2\n255\n\xff\xff\xff\x00")
    write(
        lab / "maps/m.yaml",
        {"image": "picture.pgm", "resolution": 0.1, "origin": [5.0, 5.0, 0.0]},
        "",
    )
    world = FOLLOW["world"] | {"map": "maps/m.yaml"}
    planner = {"planner": {"kind": "best_first", "footprint": "f.yaml"}}
    scenario = load_scenario(
        write(lab / "x.yaml", SCENARIO | FOLLOW | planner | {"world": world}, "")
    )
    places = [
        scenario.document["planner"]["footprint"],
        scenario.document["world"]["map"],
    ]
    assert places == [
        str(Path("lab/f.yaml").resolve()),
        str(Path("lab/maps/m.yaml").resolve()),
    ]
    digests = file_digests(scenario.document)
    assert all(digests.values())
    assert {Path(path).name for path in digests} == {"f.yaml", "m.yaml", "picture.pgm"}


def test_picture_of_a_map_is_beside_the_map_or_in_the_current_folder(lab):
    Path("picture.pgm").write_bytes(b"P5\n2 2\n255\n\xff\xff\xff\x00")
    write(
        lab / "m.yaml",
        {"image": "picture.pgm", "resolution": 0.1, "origin": [5.0, 5.0, 0.0]},
        "",
    )
    scenario = load_scenario(
        write(lab / "x.yaml", SCENARIO | {"world": {"map": "m.yaml"}}, "")
    )
    assert len(scenario.world.polygons) == 1


def test_set_up_and_fit_name_files_beside_them(lab):
    (lab / "ca.pem").touch()
    put(lab / "r.yaml")
    setup = {"robot": "r.yaml", "broker": {"address": "127.0.0.1", "ca": "ca.pem"}}
    options = load_setup(write(lab / "setup.yaml", setup, "")).options()
    assert (options["robot"], options["ca"]) == ("lab/r.yaml", Path("lab/ca.pem"))
    missing = write(lab / "gone.yaml", setup | {"robot": "s.yaml"}, "")
    assert "looked for lab/s.yaml and s.yaml" in refusal(load_setup, missing)
    assert load_setup(missing, {"robot"}).robot == "s.yaml", "an option replaces it"
    fit = (data_root() / "calibration/fits/gen4_table8_twin.yaml").read_text("utf-8")
    assert "\nrobot: gen4\n" in fit
    (lab / "fit.yaml").write_text(
        fit.replace("\nrobot: gen4\n", "\nrobot: r.yaml\n"), "utf-8"
    )
    assert load_fit(lab / "fit.yaml").robot == "lab/r.yaml"
