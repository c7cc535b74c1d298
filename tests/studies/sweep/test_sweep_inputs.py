"""Keys of rows depend on the content of every file that a sweep reads."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from conftest import ROOT
from PIL import Image
from small import write

from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.trajectory import Trajectory

WALK = """\
robot: {robot}
duration_s: 0.1
controller: {{kind: gait, frequency_hz: 2.0}}
plants: {{analytical: {{model: compliant, friction: wheel}}, twin: {{}}}}
"""
ROUTE = """\
robot: gen2
duration_s: 0.1
world: {map: room.yaml, circles: posts.csv, goal: {x_m: 1.5, y_m: 0.2}}
planner: {kind: best_first, footprint: feet.yaml}
controller: {kind: follow, follower: path, gait: {kind: gait, frequency_hz: 2.0}}
plants: {analytical: {}, twin: {}}
"""
BENCH = """\
robot: gen4_module
duration_s: 1.0
bench: true
controller: {kind: replay}
recording: {motion: bend.csv%s}
plants: {analytical: {}, twin: {}}
"""
BOTH = ("analytical", "twin")
CASES = {
    "scenario": (WALK.format(robot="gen2"), BOTH),
    "robot": (WALK.format(robot="mine.yaml"), BOTH),
    "robot base": (
        WALK.format(robot="{base: mine.yaml, friction: {mu_t: 0.05}}"),
        BOTH,
    ),
    "map, circles and footprint": (ROUTE, BOTH),
    "what is only planned": (ROUTE, ()),
    "earlier run": (
        WALK.format(robot="gen2") + "start: {from: earlier, time_s: 0.1}\n",
        BOTH,
    ),
    "earlier run of one plant": (
        WALK.format(robot="gen2").replace(
            "analytical: {model: compliant, friction: wheel}, ", ""
        )
        + "start: {from: earlier, time_s: 0.1}\n",
        ("twin",),
    ),
    "recording and the log beside it": (BENCH % "", BOTH),
    "recording and a log of pressures": (BENCH % ", valves: air.csv", BOTH),
    "recording with a map of its columns": (
        BENCH % ", valves: foreign.csv, map: {log: {pressure_kpa_plus_1: up,"
        " pressure_kpa_minus_1: down}}",
        BOTH,
    ),
}
EDITS = [
    ("scenario", "scenario.yaml", b"0.1", b"0.2"),
    ("robot", "mine.yaml", b"value: 0.57", b"value: 0.56"),
    ("robot base", "mine.yaml", b"value: 0.57", b"value: 0.56"),
    *(
        (case, *edit)
        for case in ("map, circles and footprint", "what is only planned")
        for edit in (
            ("room.yaml", b"0.65", b"0.66"),
            ("room.pgm", b"\xfe\x00", b"\xfe\xfe"),
            ("posts.csv", b"-0.9", b"-0.8"),
            ("feet.yaml", b"5.23599", b"5.13599"),
        )
    ),
    *(("earlier run", f"earlier/{plant}.parquet", None, None) for plant in BOTH),
    ("earlier run of one plant", "earlier/twin.parquet", None, None),
    ("recording and the log beside it", "bend.csv", b"0.50,0.2", b"0.50,0.3"),
    ("recording and the log beside it", "bend.valves.csv", b"0.4,1,-1", b"0.4,1,0"),
    ("recording and a log of pressures", "air.csv", b"0.4,40,0", b"0.4,50,0"),
    ("recording with a map of its columns", "foreign.csv", b"0.4,40,0", b"0.4,50,0"),
]


@functools.cache
def earlier_run(height):
    """Return the content of a short recording of a snake with four segments."""
    time = np.arange(30) / 100
    names = ["com_x", "com_y", "heading", *(f"bend_{j}" for j in range(1, 5))]
    names += [f"pressure_{side}_{j}" for side in ("plus", "minus") for j in range(1, 5)]
    columns = {name: height * np.sin(time + k) ** 2 for k, name in enumerate(names)}
    return Trajectory({"time": time, **columns}, {})


@pytest.fixture
def project(tmp_path, monkeypatch):
    """Write every kind of input file, and return a loader of sweeps by the name of a case."""
    monkeypatch.chdir(tmp_path)
    shipped = ROOT / "calibration"
    (tmp_path / "mine.yaml").write_bytes((shipped / "robots/gen2.yaml").read_bytes())
    (tmp_path / "feet.yaml").write_bytes(
        (shipped / "footprints/gen2_section52.yaml").read_bytes()
    )
    grey = np.full((20, 40), 254, dtype=np.uint8)
    grey[0, 1] = 0
    Image.fromarray(grey).save(tmp_path / "room.pgm")
    (tmp_path / "room.yaml").write_text(
        "image: room.pgm\nresolution: 0.1\norigin: [-1, -1, 0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    (tmp_path / "posts.csv").write_text("x_m,y_m,radius_m\n1.0,-0.9,0.05\n")
    (tmp_path / "earlier").mkdir()
    for plant in BOTH:
        earlier_run(0.01).to_parquet(tmp_path / f"earlier/{plant}.parquet")
    steps = np.arange(0, 151) / 100
    rows = [f"{step:.2f},{0.2 * (step > 0.45)}" for step in steps]
    (tmp_path / "bend.csv").write_text("time,bend_1\n" + "\n".join(rows) + "\n")
    (tmp_path / "bend.valves.csv").write_text(
        "time,valve_plus_1,valve_minus_1\n0,-1,-1\n0.4,1,-1\n1.5,1,-1\n"
    )
    for name, head in (
        ("air", "pressure_plus_1_kpa,pressure_minus_1_kpa"),
        ("foreign", "up,down"),
    ):
        (tmp_path / f"{name}.csv").write_text(
            f"time,{head}\n0,0,0\n0.4,40,0\n1.5,40,0\n"
        )

    def load(case):
        text, plants = CASES[case]
        if not (tmp_path / "scenario.yaml").exists():
            (tmp_path / "scenario.yaml").write_text(text)
        vary = (
            f"scenario: scenario.yaml\nplants: [{', '.join(plants)}]\nvary:"
            " {record_hz: [50, 100]}\n"
        )
        return load_sweep(write(tmp_path, vary))

    return load


def keys(sweep):
    return {point.key for point in sweep.points}


@pytest.mark.default_cases(at=[0, 1, 3, 5, 11, 14, 15, 17])
@pytest.mark.parametrize(("case", "name", "old", "new"), EDITS)
def test_a_changed_byte_of_any_input_changes_the_keys(
    project, tmp_path, case, name, old, new
):
    before = keys(project(case))
    path = tmp_path / name
    content = path.read_bytes()
    if old is None:
        earlier_run(0.011).to_parquet(path)
    else:
        assert old in content
        path.write_bytes(content.replace(old, new, 1))
    assert not before & keys(project(case))
    path.write_bytes(content)
    assert before == keys(project(case))
