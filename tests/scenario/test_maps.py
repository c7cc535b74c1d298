"""Maps and lists of circles: occupied cells, their positions, and invalid files."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from PIL import Image

from srs_twin.cli import main
from srs_twin.errors import InputError
from srs_twin.scenario.loading import load_scenario
from srs_twin.scenario.map_file import read_circles, read_map

MAP = """image: room.pgm
resolution: 0.1
origin: [{x}, {y}, {turn}]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def drawn(tmp_path, grey, *, x=0.0, y=0.0, turn=0.0):
    Image.fromarray(np.asarray(grey, dtype=np.uint8)).save(tmp_path / "room.pgm")
    path = tmp_path / "room.yaml"
    path.write_text(MAP.format(x=x, y=y, turn=turn))
    return path


@pytest.mark.parametrize("quoted", ['"[5.0, -1.0, 1.5e-1]"', "'5, -1, 0.15'"])
def test_a_quoted_origin_is_read(tmp_path, quoted):
    path = drawn(tmp_path, [[0, 255], [255, 255]], x=5.0, y=-1.0, turn=0.15)
    (plain,) = read_map(path)
    path.write_text(path.read_text().replace("[5.0, -1.0, 0.15]", quoted))
    assert read_map(path) == (plain,)


def test_a_map_is_rotated_about_its_lower_left_corner(tmp_path):
    (one,) = read_map(
        drawn(tmp_path, [[0, 255], [255, 255]], x=5.0, y=-1.0, turn=math.pi / 2)
    )
    assert shapely.Polygon(one.corners).centroid.coords[0] == pytest.approx(
        (5.0 - 0.15, -1.0 + 0.05)
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "resolution: 0.1",
            "resolution: 0",
            "room.yaml:2:13: resolution: must be a number from 0.0001 to 100",
        ),
        ("origin: [0.0, 0.0, 0.0]", "origin: [0, 0]", "room.yaml:3:9: origin: "),
        ("origin: [0.0, 0.0, 0.0]", "origin: 5", "room.yaml:3:9: origin: "),
        (
            "[0.0, 0.0, 0.0]",
            "[0, 1e9, 0]",
            "room.yaml:3:13: origin[1]: must be a number from -10000 to 10000",
        ),
        (
            "free_thresh: 0.196",
            "free_thresh: 0.65",
            "room.yaml:6:14: free_thresh: must be below `occupied_thresh`",
        ),
        (
            "occupied_thresh: 0.65",
            "occupied_thresh: 65",
            "occupied_thresh: must be a number from 0 to 1, not 65",
        ),
        ("room.pgm", "rom.pgm", " and rom.pgm); did you mean room.pgm?"),
        ("image: room.pgm\n", "", "image: missing"),
        (
            "negate: 0",
            "mode: raw",
            "room.yaml:4:7: mode: must be one of trinary, scale, not text 'raw'",
        ),
        (
            "negate: 0",
            "negate: 2",
            "room.yaml:4:9: negate: must be true, yes, on, 1 or false, no, off, 0, not",
        ),
        ("negate: 0", "negate: []", "room.yaml:4:9: negate: must be"),
    ],
)
def test_invalid_maps_are_rejected(tmp_path, old, new, words):
    path = drawn(tmp_path, [[0, 255]])
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=".") as error:
        read_map(path)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_a_list_of_circles(tmp_path):
    path = tmp_path / "circles.csv"
    path.write_text("name,x_m,y_m,radius_m\npost,1,2,0.1\ntable,-1,0.5,0.4\n")
    assert [(c.x, c.y, c.radius) for c in read_circles(path)] == [
        (1, 2, 0.1),
        (-1, 0.5, 0.4),
    ]
    for text, words in (
        (
            "x_m,y_m\n1,2\n",
            ":1: the column 'radius_m' is missing; the columns x_m, y_m, radius_m are"
            " required",
        ),
        (
            "x_m,y_m,radius_m\n1,2,0\n",
            ":2: the numbers must be finite and the radius above 0",
        ),
        ("x_m,y_m,radius_m,x_m\n1,2,3,4\n", ":1: the column 'x_m' is repeated"),
        ("x_m,y_m,radius_m\n1,5,2,0.1\n", "and write decimals with a point"),
        ("x_m,y_m,radius_m\n1,2,0.1,\n", "than the header; remove trailing commas"),
        ("x_m,y_m,radius_m\n\n1,2,wide\n", ":3: the row must have three numbers"),
    ):
        path.write_text(text)
        with pytest.raises(InputError) as error:
            read_circles(path)
        assert words in str(error.value)


SCENARIO = """
title: A room
robot: gen2
duration_s: 2
world: {map: room.yaml, circles: posts.csv, goal: {x_m: 3.0, y_m: 0.5}}
planner: {kind: best_first, footprint: gen2_gait, turn_fraction: 0.5}
controller: {kind: follow, follower: path, gait: {kind: gait, frequency_hz: 2.0}}
plants: {analytical: {}, twin: {}}
"""


@pytest.mark.slow
def test_scenario_in_a_map_plans_runs_and_detects_changes(tmp_path, monkeypatch):
    """The wall leaves a path above it; the map is part of both plants and of the pictures."""
    grey = np.full((30, 40), 254)
    grey[15:, 20] = 0
    drawn(tmp_path, grey, x=-0.5, y=-1.5)
    (tmp_path / "posts.csv").write_text("x_m,y_m,radius_m\n2.5,-0.5,0.1\n")
    (tmp_path / "room_run.yaml").write_text(SCENARIO)
    monkeypatch.chdir(tmp_path)
    scenario = load_scenario("room_run.yaml")
    answer = scenario.planner.plan()
    assert answer.found and max(y for _, y, _ in answer.samples()) > 0.05
    for _ in range(2):
        with pytest.raises(SystemExit) as end:
            main(["compare", "room_run.yaml", "--quiet"])
        assert end.value.code == 0
    first = (tmp_path / "runs/room_run/metrics.json").stat().st_mtime_ns
    grey[15:, 21] = 0
    drawn(tmp_path, grey, x=-0.5, y=-1.5)
    with pytest.raises(SystemExit):
        main(["compare", "room_run.yaml", "--quiet"])
    assert (tmp_path / "runs/room_run/metrics.json").stat().st_mtime_ns > first
