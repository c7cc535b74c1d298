"""Maps and lists of circles: occupied cells, their positions, and invalid files."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from PIL import Image
from plan_sampling import TOUCH, deepest

from srs_twin.cli import main
from srs_twin.errors import InputError
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Problem
from srs_twin.robot.world import Goal, Pose, World
from srs_twin.scenario.loading import load_scenario
from srs_twin.scenario.map_file import read_circles, read_map

MAP = """image: {image}
resolution: 0.1
origin: [{x}, {y}, {turn}]
negate: {negate}
occupied_thresh: 0.65
free_thresh: 0.196
"""


def drawn(tmp_path, grey, *, suffix="pgm", x=0.0, y=0.0, turn=0.0, negate=0):
    Image.fromarray(np.asarray(grey, dtype=np.uint8)).save(tmp_path / f"room.{suffix}")
    path = tmp_path / "room.yaml"
    path.write_text(
        MAP.format(image=f"room.{suffix}", x=x, y=y, turn=turn, negate=negate)
    )
    return path


def cells(grey) -> set[tuple[int, int]]:
    """Return column and row, from the lower left, of cells that are not known to be free."""
    rows, columns = np.nonzero((255 - np.asarray(grey, dtype=float)) / 255 >= 0.196)
    return {
        (int(column), len(grey) - 1 - int(row))
        for row, column in zip(rows, columns, strict=True)
    }


@pytest.mark.parametrize("suffix", ["pgm", "png"])
def test_rectangles_cover_occupied_cells_once(tmp_path, suffix):
    grey = np.random.default_rng(0).choice(
        [0, 100, 205, 254, 255], p=[0.2, 0.05, 0.05, 0.4, 0.3], size=(23, 31)
    )
    polygons = [
        shapely.Polygon(each.corners)
        for each in read_map(drawn(tmp_path, grey, suffix=suffix))
    ]
    whole = shapely.union_all(polygons)
    assert (
        whole.area
        == pytest.approx(0.01 * len(cells(grey)))
        == sum(each.area for each in polygons)
    )
    for column in range(31):
        for row in range(23):
            inside = shapely.contains_xy(whole, 0.1 * (column + 0.5), 0.1 * (row + 0.5))
            assert inside == ((column, row) in cells(grey))
    assert len(polygons) < len(cells(grey))


@pytest.mark.parametrize("quoted", ['"[5.0, -1.0, 1.5e-1]"', "'5, -1, 0.15'"])
def test_a_quoted_origin_is_read(tmp_path, quoted):
    path = drawn(tmp_path, [[0, 255], [255, 255]], x=5.0, y=-1.0, turn=0.15)
    (plain,) = read_map(path)
    path.write_text(path.read_text().replace("[5.0, -1.0, 0.15]", quoted))
    assert read_map(path) == (plain,)


def test_a_pgm_of_text_is_read_and_negate_turns_it_round(tmp_path):
    (tmp_path / "room.pgm").write_text(
        "P2\n# another program's\n3 2\n255\n0 255 255\n255 255 255\n"
    )
    path = tmp_path / "room.yaml"
    for negate, area in ((0, 0.01), (1, 0.05)):
        path.write_text(MAP.format(image="room.pgm", x=0, y=0, turn=0, negate=negate))
        assert sum(
            shapely.Polygon(each.corners).area for each in read_map(path)
        ) == pytest.approx(area)
    (one,) = read_map(
        drawn(tmp_path, [[0, 255], [255, 255]], x=5.0, y=-1.0, turn=math.pi / 2)
    )
    assert shapely.Polygon(one.corners).centroid.coords[0] == pytest.approx(
        (5.0 - 0.15, -1.0 + 0.05)
    )


@pytest.mark.default_cases(at=[0, 7, 8, 9, 11, 14, 17, 18, 23])
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "resolution: 0.1",
            "resolution: 0",
            "room.yaml:2:13: resolution: must be a number from 0.0001 to 100",
        ),
        (
            "resolution: 0.1",
            "resolution: -0.1",
            "resolution: must be a number from 0.0001 to 100, not -0.1",
        ),
        (
            "resolution: 0.1",
            "resolution: 1e-300",
            "resolution: must be a number from 0.0001 to 100, not 1e-300",
        ),
        (
            "resolution: 0.1",
            "resolution: .inf",
            "resolution: must be a number from 0.0001 to 100, not infinity",
        ),
        (
            "resolution: 0.1",
            "resolution: .nan",
            "resolution: must be a number from 0.0001 to 100, not NaN",
        ),
        (
            "resolution: 0.1",
            "resolution: true",
            "resolution: must be a number from 0.0001 to 100, not true",
        ),
        ("resolution: 0.1", "resolution: fine", "from 0.0001 to 100, not text 'fine'"),
        ("origin: [0.0, 0.0, 0.0]", "origin: [0, 0]", "room.yaml:3:9: origin: "),
        ("origin: [0.0, 0.0, 0.0]", "origin: 5", "room.yaml:3:9: origin: "),
        (
            "[0.0, 0.0, 0.0]",
            "[0, 1e9, 0]",
            "room.yaml:3:13: origin[1]: must be a number from -10000 to 10000",
        ),
        (
            "[0.0, 0.0, 0.0]",
            "[0, .nan, 0]",
            "room.yaml:3:13: origin[1]: must be a number from -10000 to 10000",
        ),
        (
            "free_thresh: 0.196",
            "free_thresh: 0.65",
            "room.yaml:6:14: free_thresh: must be below `occupied_thresh`",
        ),
        (
            "free_thresh: 0.196",
            "free_thresh: -0.1",
            "free_thresh: must be a number from 0 to 1, not -0.1",
        ),
        (
            "occupied_thresh: 0.65",
            "occupied_thresh: 65",
            "occupied_thresh: must be a number from 0 to 1, not 65",
        ),
        ("room.pgm", "rom.pgm", "room.yaml:1:8: image: "),
        ("room.pgm", "rom.pgm", " and rom.pgm); did you mean room.pgm?"),
        (
            "room.pgm",
            "[room.pgm]",
            "image: must be text of 1 to 1000 characters, not a list of 1",
        ),
        ("image: room.pgm\n", "", "image: missing"),
        (
            "negate: 0",
            "mode: raw",
            "room.yaml:4:7: mode: must be one of trinary, scale, not text 'raw'",
        ),
        (
            "negate: 0",
            "negate: maybe",
            "room.yaml:4:9: negate: must be true, yes, on, 1 or false, no, off, 0, not",
        ),
        *(
            ("negate: 0", f"negate: {each}", "room.yaml:4:9: negate: must be")
            for each in ("2", "0.0", "[0]", "''")
        ),
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


@pytest.mark.slow
def test_plan_among_ten_thousand_cells(tmp_path):
    """A wall of a thousand pillars has a gap; distances are computed for near obstacles only."""
    grey = np.full((400, 600), 254)
    for row in range(0, 400, 12):
        for column in range(60, 560, 12):
            grey[row : row + 3, column : column + 3] = 0
    grey[:, 300:304] = 0
    grey[180:220, 60:560] = 254
    polygons = read_map(drawn(tmp_path, grey, y=-20.0))
    assert 1000 < len(polygons) < 2000 and (grey == 0).sum() > 10_000
    body = load_footprint("gen4_ilc").reduced(1.0, 0.05)
    problem = Problem(
        Pose(2.5, 0.0, 0.0),
        Goal(57.0, 0.0, None, 0.2),
        World((), None, None, polygons),
        body,
    )
    answer = plan(problem)
    near = tuple(each for each in polygons if abs(each.corners[0][1]) < 4.0)
    assert (
        answer.found
        and deepest(answer, replace(problem, world=World((), None, None, near)))
        <= TOUCH
    )
