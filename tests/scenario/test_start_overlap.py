"""Obstacles and objects that overlap the body at the start are refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from snakes import robot

from srs_twin import AnalyticalSnake, Gait, TwinSnake, rollout
from srs_twin.errors import InputError, InputFileError
from srs_twin.robot.world import Circle, MovableObject, Polygon, World
from srs_twin.scenario.loading import load_scenario, parse_scenario

BODY = robot("gen2").geometry
HALF = BODY.width / 2
NOSE = 2 * BODY.pitch
"""x of the foremost connector of a straight snake of generation 2 at the origin, m."""
BOTH = {"analytical": {}, "twin": {}}


def scenario(world, *, start=None, plants=BOTH, snake="gen2", **more):
    return parse_scenario(
        {
            "robot": snake,
            "duration_s": 1,
            "controller": {"kind": "gait", "frequency_hz": 2.0},
            "world": world,
            "start": start or {},
            "plants": plants,
        }
        | more
    )


def refusal(world, **options):
    """Return the message with which a scenario is refused."""
    with pytest.raises(InputFileError) as caught:
        scenario(world, **options)
    return str(caught.value)


def overlap(message):
    """Return the overlap that a message states, in m."""
    return float(message.split(" by ")[1].split(" mm")[0]) / 1e3


def circle(x, y=0.0, radius=0.05):
    return {"obstacles": [{"x_m": x, "y_m": y, "radius_m": radius}]}


def square(x, y, side):
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side / 2 + [x, y]
    return {"polygons": [{"corners_m": corners.tolist()}]}


@pytest.mark.parametrize("plants", [BOTH, {"twin": {"contact": "preloaded"}}])
def test_overlap_is_stated_in_mm(plants):
    said = refusal(circle(NOSE + HALF + 0.05 - 0.023), plants=plants)
    assert said == (
        "scenario: world.obstacles[0]: overlaps the body at the start by 23 mm; move"
        " it or start elsewhere"
    )


def test_message_has_the_line_of_each_obstacle(tmp_path, srs_twin):
    file = tmp_path / "mine.yaml"
    file.write_text(
        "robot: gen2\nduration_s: 1\ncontroller: {kind: gait, frequency_hz:"
        " 2.0}\nplants: {twin: {}}\nworld:\n  obstacles:\n    - {x_m: 1.0, y_m: 0,"
        " radius_m: 0.05}\n    - {x_m: 0.0, y_m: 0.06, radius_m: 0.05}\n  polygons:\n  "
        "  - {corners_m: [[-1, -1], [1, -1], [1, 1]]}\n"
    )
    done = srs_twin("run", "mine.yaml", cwd=tmp_path)
    assert done.returncode == 2
    first, second = done.stderr.splitlines()
    assert (
        first
        == "mine.yaml:8:7: world.obstacles[1]: overlaps the body at the start by 10 mm;"
        " move it or start elsewhere"
    )
    assert second.startswith(
        "mine.yaml:10:7: world.polygons[0]: overlaps the body at the start by "
    )


@pytest.mark.parametrize(
    ("world", "key", "deep"),
    [
        (square(0.0, 0.0, 2.0), "polygons[0]", 1.0 + 0.001 + HALF),
        (circle(-NOSE - HALF - 0.04), "obstacles[0]", 0.01),
        (
            {
                "pegs": {
                    "spacing_m": 0.13,
                    "radius_m": 0.02,
                    "rows": 3,
                    "columns": 3,
                    "x_m": 0.0,
                }
            },
            "pegs",
            HALF + 0.02,
        ),
        (
            {
                "random": {
                    "kind": "strewn",
                    "count": 1,
                    "clear_m": 0.0,
                    "radius_m": [0.5, 0.5],
                    "area": {"x_m": [0.52, 0.54], "y_m": [-0.01, 0.01]},
                }
            },
            "random",
            None,
        ),
    ],
)
def test_every_kind_of_obstacle_is_refused(world, key, deep):
    said = refusal(world, plants={"twin": {}})
    assert said.startswith(f"scenario: world.{key}: ")
    assert "overlaps the body at the start by " in said
    if deep is not None:
        assert overlap(said) == pytest.approx(deep, rel=0.01)


def test_map_and_list_of_circles_are_refused(tmp_path):
    rows = "x_m,y_m,radius_m\n1.0,0,0.05\n0.02,0,0.05\n"
    (tmp_path / "circles.csv").write_text(rows)
    said = refusal({"circles": str(tmp_path / "circles.csv")}, plants={"twin": {}})
    assert "world.circles: obstacle 2 at (0.02, 0) m overlaps the body" in said
    row = " ".join("0" if 8 < column < 12 else "255" for column in range(20))
    picture = "\n".join(["P2", "20 20", "255", *[row] * 20])
    (tmp_path / "map.pgm").write_text(picture)
    (tmp_path / "map.yaml").write_text(
        "image: map.pgm\nresolution: 0.05\norigin: [-0.5, -0.5, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    said = refusal({"map": str(tmp_path / "map.yaml")}, plants={"twin": {}})
    assert "world.map: polygon 1 overlaps the body at the start by" in said


@pytest.mark.parametrize(
    ("shape", "reach"),
    [
        ({"kind": "cylinder", "radius_m": 0.03}, 0.03),
        ({"kind": "box", "length_m": 0.06, "width_m": 0.06}, 0.03 * math.sqrt(2)),
    ],
)
def test_objects_are_refused(shape, reach):
    place = {"x_m": 0.0, "y_m": 0.045, "heading_rad": math.pi / 4}
    item = shape | place | {"mass_kg": 0.1, "friction": 0.3}
    said = refusal({"objects": [item]}, plants={"twin": {}})
    assert "world.objects[0]: " in said
    assert overlap(said) == pytest.approx(HALF + reach - 0.045, rel=0.01)


@pytest.mark.parametrize(
    ("place", "named"),
    [
        ({"x_m": 1.0, "y_m": 0.0}, "obstacle 1 at (1, 0) m"),
        ({"x_m": 1.0, "y_m": 0.135}, "obstacle 1 at (1, 0) m"),
        ({"x_m": 2.0, "y_m": 0.0}, "polygon 1"),
        ({"x_m": 3.0, "y_m": 0.09, "heading_rad": 0.3}, "object 1"),
        ({"x_m": 3.0, "y_m": 0.1}, None),
    ],
)
def test_objects_in_other_solids_are_refused(place, named):
    size = {"kind": "box", "length_m": 0.1, "width_m": 0.1}
    box = size | {"mass_kg": 0.1, "friction": 0.3, "x_m": 3.0, "y_m": 0.0}
    world = circle(1.0, radius=0.1) | square(2.0, 0.0, 0.3)
    world |= {"objects": [box, box | place]}
    if named is None:
        scenario(world, plants={"twin": {}})
    else:
        said = refusal(world, plants={"twin": {}})
        assert said == (
            f"scenario: world.objects[1]: overlaps {named} at the start; move one of"
            " them"
        )


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("gap", [0.0, 1e-4])
@pytest.mark.parametrize("heading", [0.0, 0.7])
def test_touching_is_allowed(gap, heading):
    ahead = NOSE + HALF + 0.05 + gap
    x = 0.1 + ahead * math.cos(heading)
    y = -0.2 + ahead * math.sin(heading)
    start = {"x_m": 0.1, "y_m": -0.2, "heading_rad": heading}
    found = scenario(circle(x, y), start=start)
    for kind in BOTH:
        run = rollout(
            found.build_plant(kind), found.build_controller(), 0.02, pose=found.pose
        )
        assert run["clearance"][0] == pytest.approx(gap, abs=1e-6)
    deeper = gap + 1e-4
    x -= deeper * math.cos(heading)
    y -= deeper * math.sin(heading)
    assert "by 0.1 mm" in refusal(circle(x, y), start=start)


def test_message_names_the_override_that_sets_the_obstacle():
    words = r"^set world=\{.*\}: world.obstacles\[0\]: overlaps the body"
    with pytest.raises(InputFileError, match=words):
        load_scenario("gen2_straight", set={"world": circle(0.0)})


def test_bends_at_the_start_count():
    beside = circle(0.06, 0.1)
    assert scenario(beside, plants={"twin": {}}).initial_state is None
    start = {"bend_rad": [0.9, 0.9, 0.9, 0.9], "y_m": 0.05}
    said = refusal(beside, start=start, plants={"twin": {}})
    assert "world.obstacles[0]: overlaps" in said


@pytest.mark.default_cases(at=[0, 4, 7, 9])
@pytest.mark.parametrize("snake", ["gen1", "gen2", "gen3", "gen4", "skin_example"])
@pytest.mark.parametrize("kind", ["analytical", "twin"])
def test_checked_start_is_that_of_the_plants(snake, kind):
    """The distance at the start equals the first recorded one."""
    pose = (0.1, 0.2, 0.4)
    bend = [0.5, -0.3, 0.4, 0.2]
    segments = robot(snake).segments
    start = dict(zip(("x_m", "y_m", "heading_rad"), pose, strict=True))
    start["bend_rad"] = (bend * segments)[:segments]
    plants = {kind: {"model": "compliant"} if kind == "analytical" else {}}
    options = {"start": start, "plants": plants, "snake": snake}
    far = scenario(circle(0.1, 0.5, 0.02), **options)
    apart = rollout(
        far.build_plant(kind),
        far.build_controller(),
        0.02,
        initial_state=far.initial_state,
    )["clearance"][0]
    deep = overlap(refusal(circle(0.1, 0.5, 0.02 + apart + 0.01), **options))
    # Hinges deviate slightly from arcs, and the mass of a skin is along the arcs.
    tolerance = 1e-3 if snake == "skin_example" else 3e-4
    assert deep == pytest.approx(0.01, abs=tolerance)


def test_run_continues_from_a_contact(tmp_path, srs_twin):
    """Contacts sink in by less than a millimetre, so that another run can start there."""
    world = circle(0.25)
    found = scenario(world, plants={"twin": {}})
    run = rollout(
        found.build_plant("twin"), found.build_controller(), 1.0, pose=found.pose
    )
    rows = np.flatnonzero((run["clearance"] < -1e-5) & (run.time > 0.1))
    assert len(rows), "the run is in contact"
    run.to_parquet(tmp_path / "twin.parquet")
    start = {"from": str(tmp_path), "time_s": float(run.time[rows[0]])}
    again = scenario(world, start=start, plants={"twin": {}})
    rollout(
        again.build_plant("twin"),
        again.build_controller(),
        0.02,
        initial_state=again.initial_state,
    )
    said = refusal(circle(0.25, radius=0.06), start=start, plants={"twin": {}})
    assert "world.obstacles[0]: overlaps" in said


SOLID = [
    (
        World((Circle(0.0, 0.0, 0.05),)),
        r"obstacle 1 at \(0, 0\) m overlaps the body at the start by 70 mm",
    ),
    (
        World(polygons=(Polygon(((-1, -1), (1, -1), (0, 1))),)),
        "polygon 1 overlaps the body",
    ),
    (
        World(objects=(MovableObject((0.1,), 0.1, 0.3, 0.0, 0.0),)),
        "object 1 overlaps the body",
    ),
]


@pytest.mark.parametrize(("world", "words"), SOLID)
def test_python_refuses_a_start_in_an_obstacle(world, words):
    twin = TwinSnake(robot("gen2"), world=world)
    gait = Gait(2.0)
    with pytest.raises(InputError, match=words):
        rollout(twin, gait, 0.1)
    assert rollout(twin, gait, 0.1, pose=(3.0, 3.0, 0.0))["clearance"].min() > 1.0
    with pytest.raises(InputError, match=words):
        rollout(
            twin,
            gait,
            0.1,
            initial_state=lambda plant, seed: plant.reset(pose=(0.02, 0.0, 0.0)),
        )
    if not world.objects:
        with pytest.raises(InputError, match=words):
            rollout(AnalyticalSnake(robot("gen2"), world=world), gait, 0.1)


def test_saved_state_in_contact_continues():
    world = World((Circle(0.25, 0.0, 0.05),))
    twin = TwinSnake(robot("gen2"), world=world)
    gait = Gait(2.0)
    rollout(twin, gait, 0.6)
    saved = twin.save(), gait.save()
    assert len(rollout(twin, gait, 0.1, resume=saved)) == 11


def test_warning_about_ignored_obstacles_is_given_once():
    world = circle(1.0)
    word = "ignores the obstacles"
    both = scenario(world)
    assert [word in text for text in both.warnings] == [True]
    assert both.run_on(["twin"]).warnings == ()
    assert both.run_on(["analytical", "twin"]).warnings == both.warnings
    only = scenario(world, plants={"twin": {}})
    assert only.warnings == ()
    assert len(only.run_on(["analytical", "twin"]).warnings) == 1
    touching = {"analytical": {"model": "compliant", "contact": True}}
    assert scenario(world, plants=touching).warnings == ()
    assert load_scenario("gen2_straight").warnings == ()
