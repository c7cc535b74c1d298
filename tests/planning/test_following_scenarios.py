"""Scenarios with a planner and a follower: files, products, commands, reports and sweeps."""

from __future__ import annotations

import json
import math
import re
from itertools import combinations
from typing import Any

import pytest

from srs_twin import InputError, Trajectory, load_scenario
from srs_twin.errors import InputFileError
from srs_twin.experiment import prepare
from srs_twin.io.documents import dump_yaml
from srs_twin.planning.camera import Camera
from srs_twin.planning.follower import Conditions
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.metrics import FOLLOWING_UNITS, PLAN_UNITS
from srs_twin.planning.pictures import following_plot
from srs_twin.planning.planned import plan_scenario
from srs_twin.robot.world import fig54_world
from srs_twin.scenario.loading import parse_scenario

FILE = """\
title: A short way round a circle and a square
robot: gen2
duration_s: 10
record_hz: 50
start: {x_m: 0, y_m: 0}
world:
  goal: {x_m: 0.8, y_m: 0.1, radius_m: 0.05}
  obstacles: [{x_m: 0.4, y_m: 0.0, radius_m: 0.03}]
  polygons: [{corners_m: [[0.3, -0.4], [0.5, -0.4], [0.5, -0.3], [0.3, -0.3]]}]
planner: {kind: best_first, footprint: gen2_section52, margin_m: 0.05}
controller: {kind: follow, gait: {kind: gait, frequency_hz: 2.0}, response_length_m: 0.035}
plants: {analytical: {}}
expect:
  - {metric: plan_found, plant: analytical, near: 1, abs: 0}
  - {metric: goal_reached, plant: analytical, near: 1, abs: 0}
  - {metric: clearance_m, plant: analytical, above: 0}
"""


def data(**changes: Any) -> dict[str, Any]:
    return {
        "robot": "gen2",
        "duration_s": 10,
        "world": {"goal": {"x_m": 0.6, "y_m": 0.1}},
        "planner": {"kind": "best_first", "footprint": "gen2_section52"},
        "controller": {"kind": "follow", "gait": {"kind": "gait", "frequency_hz": 2.0}},
        "plants": {"analytical": {}},
    } | changes


GAIT_PLANNER = {"kind": "best_first", "footprint": "gen2_gait"}


@pytest.fixture
def file(tmp_path):
    (tmp_path / "way.yaml").write_text(FILE, "utf-8")
    return tmp_path


WALL = "[[0.3, -2], [0.5, -2], [0.5, 2], [0.3, 2]]"


def test_no_plan_is_an_outcome_and_fails_under_check(file, srs_twin):
    text = FILE.replace("[[0.3, -0.4], [0.5, -0.4], [0.5, -0.3], [0.3, -0.3]]", WALL)
    text = text.replace(
        "  goal:", "  bounds: {x_m: [-0.5, 1.5], y_m: [-1, 1]}\n  goal:"
    )
    (file / "walled.yaml").write_text(text, "utf-8")
    plain = srs_twin("plan", "walled.yaml", cwd=file)
    assert plain.returncode == 0 and "proven_impossible" in plain.stdout
    checked = srs_twin("plan", "walled.yaml", "--check", cwd=file)
    assert (
        checked.returncode == 1
        and "MISSED plan_found = no, required yes" in checked.stdout
    )
    (file / "unjudged.yaml").write_text(text.partition("expect:")[0], "utf-8")
    assert srs_twin("plan", "unjudged.yaml", "--check", "-q", cwd=file).returncode == 1
    run = srs_twin("run", "walled.yaml", "--check", "--out", "run", cwd=file)
    assert run.returncode == 1, run.stderr
    metrics = json.loads((file / "run/metrics.json").read_text("utf-8"))["plants"][
        "analytical"
    ]
    assert (
        metrics["plan_found"],
        metrics["goal_reached"],
        metrics["plan_length_m"],
    ) == (0, 0, None)
    way = Trajectory.from_parquet(file / "run/analytical.parquet")
    assert way.metadata["control"]["following"]["ending"] == "no_plan"
    assert [event.kind for event in way.events] == ["no_plan"]


def test_run_command_follows_and_writes_all_files(file, srs_twin):
    done = srs_twin("run", "way.yaml", "--check", "--out", "out", cwd=file)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "cross-track, RMS" in done.stdout and "new plans" in done.stdout
    metrics = json.loads((file / "out/metrics.json").read_text("utf-8"))["plants"][
        "analytical"
    ]
    assert metrics.keys() >= FOLLOWING_UNITS.keys()
    assert metrics["cross_track_rms_m"] < 0.015 and metrics["inside_fraction"] > 0.9
    report = (file / "out/report.html").read_text("utf-8")
    assert "Plan with footprint" in report and "The cross-track error is" in report
    from rerun.chunk import RrdReader

    entities = {
        chunk.entity_path
        for chunk in RrdReader(file / "out/recording.rrd").stream().to_chunks()
    }
    obstacles = {f"/world/obstacles/{kind}" for kind in ("round", "straight")}
    assert {
        "/world/plan/path",
        "/world/plan/edges",
        "/world/plan/goal",
    } | obstacles <= entities
    way = Trajectory.from_parquet(file / "out/analytical.parquet")
    for name in (
        "offset",
        "offset_commanded",
        "cross_track",
        "heading_error",
        "node",
        "estimate_x",
    ):
        assert way.has(name), name
    assert (way.unit("cross_track"), way.unit("heading_error")) == ("m", "rad")
    assert (
        way.events[-1].kind == "goal_reached"
        and way.metadata["ended_by"] == "controller"
    )
    again = load_scenario(file / "out/scenario.resolved.yaml")
    assert again.controller == load_scenario(file / "way.yaml").controller
    assert again.world == load_scenario(file / "way.yaml").world


@pytest.mark.slow
def test_both_plants_follow_one_plan_and_are_drawn_together(tmp_path):
    scenario = parse_scenario(data(plants={"analytical": {}, "twin": {}}), name="both")
    result = prepare(scenario, tmp_path).execute()
    assert result.metrics["comparison"]["path_rms_m"] < 0.2
    ways = result.trajectories
    first = [way.metadata["control"]["following"]["plans"][0] for way in ways.values()]
    assert first[0] == first[1]
    figure = following_plot(ways, scenario.robot)
    assert figure is not None
    labels = {text.get_text() for text in figure.axes[0].get_legend().get_texts()}
    assert "plan" in labels and len(labels) == 3
    assert all(each["goal_reached"] == 1 for each in result.metrics["plants"].values())


def test_collision_of_the_twin_is_a_contact(tmp_path):
    """A given path through a circle causes contact, no divergence, and a named ending."""
    scenario = parse_scenario(
        data(
            world={"obstacles": [{"x_m": 0.45, "y_m": 0.0, "radius_m": 0.1}]},
            planner={
                "kind": "given",
                "footprint": "gen2_section52",
                "turns_rad": [0, 0],
                "step_m": 0.5,
            },
            plants={"twin": {}},
            duration_s=8,
        )
    )
    metrics = prepare(scenario, tmp_path).execute().metrics["plants"]["twin"]
    assert metrics["contacts"] >= 1 and metrics["contact_time_s"] > 0.1
    assert -0.001 < metrics["clearance_m"] <= 0


def test_keys_of_the_follower_reach_the_controller():
    follower = data()["controller"] | {
        "delay_s": 0.2,
        "camera": {
            "rate_hz": 60.0,
            "position_noise_m": 0.001,
            "heading_noise_rad": 0.01,
        },
        "replan_beyond_m": 0.3,
        "max_replans": 5,
    }
    lead_in = GAIT_PLANNER | {"lead_in_m": 0.25}
    scenario = parse_scenario(data(controller=follower, planner=lead_in))
    controller = scenario.build_controller()
    response_length = load_footprint("gen2_gait").response_length
    camera = Camera(60.0, 0.001, 0.01)
    assert controller.conditions == Conditions(
        camera, 0.2, response_length, 0.3, 5, lead_in=0.25
    )
    assert not controller.allows_contact


def test_learning_gait_of_a_follower_has_ticks_of_5_ms():
    gait = {"kind": "ilc", "frequency_hz": 1.5, "target_rad": 0.7}
    scenario = parse_scenario(
        data(
            robot="gen4",
            supply={"pressure_kpa": 131},
            controller={"kind": "follow", "gait": gait},
            planner={"kind": "best_first", "footprint": "gen4_table9"},
            plants={"twin": {}},
        )
    )
    assert (
        scenario.build_plant("twin").tick
        == 0.005
        == scenario.build_plant("analytical").tick
    )


def test_random_world_depends_on_the_seed():
    world = {"random": {"kind": "fig54", "count": 6}, "goal": {"x_m": 2, "y_m": 1}}
    drawn = [
        parse_scenario(data(world=world, seed=seed)).world.obstacles for seed in (0, 1)
    ]
    assert drawn[0] == fig54_world(6, 0).obstacles != drawn[1]
    assert len(fig54_world(18, 0).obstacles) == 18
    with pytest.raises(
        InputError, match="19 obstacles do not fit; Fig. 54 has only 18 sites"
    ):
        fig54_world(19, 0)
    strewn = {
        "random": {
            "count": 8,
            "radius_m": [0.03, 0.05],
            "gap_m": 0.1,
            "clear_m": 0.2,
            "seed": 5,
        },
        "bounds": {"x_m": [-0.5, 2.5], "y_m": [-1, 1]},
        "goal": {"x_m": 2, "y_m": 0},
    }
    one, other = (
        parse_scenario(data(world=strewn, seed=seed)).world for seed in (0, 1)
    )
    assert one == other and len(one.obstacles) == 8
    for a, b in combinations(one.obstacles, 2):
        assert math.hypot(a.x - b.x, a.y - b.y) >= a.radius + b.radius + 0.1
    for circle in one.obstacles:
        assert math.hypot(circle.x, circle.y) >= circle.radius + 0.2
        assert math.hypot(circle.x - 2, circle.y) >= circle.radius + 0.2
        assert 0.03 <= circle.radius <= 0.05


def test_footprint_is_reduced_for_planning_only():
    file = data()["planner"] | {"turn_fraction": 0.5, "margin_m": 0.02}
    planner = parse_scenario(data(planner=file)).planner
    assert planner.footprint.tightest == pytest.approx((5.23599, 5.23599))
    assert planner.problem.footprint.tightest == pytest.approx((2.617995, 2.617995))
    assert planner.problem.footprint.at(0.0).left == pytest.approx(0.045)
    half = planner.footprint.at(2.617995)
    edge = planner.problem.footprint.at(2.617995)
    assert (edge.offset, edge.left, edge.right) == pytest.approx(
        (half.offset, half.left + 0.02, half.right + 0.02)
    )
    assert max(abs(s.curvature) for s in planner.plan().segments) <= 2.618


def test_run_up_is_straight_and_must_be_free():
    planner = {"kind": "best_first", "footprint": "gen2_section52", "lead_in_m": 0.25}
    first = parse_scenario(data(planner=planner)).planner.plan().segments[0]
    assert first.curvature == 0 and first.length == pytest.approx(0.25)
    world = {
        "goal": {"x_m": 0.6, "y_m": 0.3},
        "obstacles": [{"x_m": 0.3, "y_m": 0, "radius_m": 0.06}],
    }
    with pytest.raises(
        InputError,
        match=r"straight lead-in of 0\.25 m touches .*; set a shorter `lead_in_m`",
    ):
        parse_scenario(data(planner=planner, world=world)).build_controller()


def test_goal_of_a_given_path_is_its_end():
    planner = {
        "kind": "given",
        "footprint": "gen2_section52",
        "turns_rad": [0.5, -0.5],
        "step_m": 0.2,
    }
    scenario = parse_scenario(data(planner=planner, world={}))
    route = scenario.planner
    plan = route.plan()
    assert 1.0 <= plan_scenario(scenario).quality.length_over_least < 1.3
    walls = {"bounds": {"x_m": [-0.5, 0.2], "y_m": [-0.5, 0.5]}}
    blocked = parse_scenario(data(planner=planner, world=walls))
    assert plan_scenario(blocked).quality.length_over_least is None
    goal = route.problem.goal
    assert [(s.curvature, s.length) for s in plan.segments] == [(2.5, 0.2), (-2.5, 0.2)]
    assert (goal.x, goal.y, goal.heading) == pytest.approx(
        (plan.end.x, plan.end.y, 0.0)
    )


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (
            {"planner": None},
            "controller: `kind: follow` needs a plan; add the section `planner`",
        ),
        (
            {"controller": {"kind": "gait", "frequency_hz": 2}},
            "planner: no controller follows the plan",
        ),
        (
            {"planner": {"kind": "best_first", "footprint": "gen9"}},
            "planner.footprint: unknown footprint 'gen9'",
        ),
        (
            {"world": {"goal": {"x_m": 1, "y_m": 0}, "random": {"count": 3}}},
            "world.random: obstacles of kind `strewn` need an area; set `area`, or"
            " `bounds` of the world",
        ),
        (
            {
                "world": {
                    "goal": {"x_m": 1, "y_m": 0},
                    "bounds": {"x_m": [0, 1], "y_m": [0, 1]},
                    "random": {"count": 99, "gap_m": 1.0},
                }
            },
            "of 99 circles fit with gaps of",
        ),
        (
            {
                "planner": {
                    "kind": "best_first",
                    "footprint": "gen2_section52",
                    "primitives": {"count": 3, "turn_rad": 0.8, "length_m": 0.1},
                }
            },
            "planner.primitives: the curvature -8 1/m is not allowed",
        ),
        ({"bench": True}, "planner: a robot on a bench does not move along a path"),
        ({"world": {}}, "planner: the planner `best_first` needs a goal"),
        ({"start": {"from": "run"}}, "start.from: a plan begins at a single pose"),
        (
            {"planner": GAIT_PLANNER | {"margin_m": 0, "margin_probability": 0.9}},
            "planner: `margin_m` and `margin_probability` both set the margin",
        ),
    ],
)
def test_contradictions_are_reported(changes, says):
    given = {
        name: value for name, value in data(**changes).items() if value is not None
    }
    with pytest.raises(InputFileError) as caught:
        parse_scenario(given)
    assert says in str(caught.value)


def test_the_least_length_includes_the_lead_in():
    """On a straight way the shortest line to the goal's circle has 0.8 m."""
    world = {"goal": {"x_m": 0.9, "y_m": 0.0, "radius_m": 0.1}}
    for lead_in in (0.0, 0.7):
        about = data(planner=GAIT_PLANNER | {"lead_in_m": lead_in}, world=world)
        found = plan_scenario(parse_scenario(about, name="way"))
        assert found.plan.least_length == pytest.approx(0.8, rel=1e-6)
        ratio = found.quality.length_over_least
        assert ratio == pytest.approx(found.plan.length / 0.8, rel=1e-6)
        assert 1.0 <= ratio < 1.3


@pytest.fixture
def planned(srs_twin, tmp_path):
    """Return a function from a world to the output and the document of `srs-twin plan`."""

    def planned(world):
        about = data(planner=GAIT_PLANNER, world=world)
        (tmp_path / "way.yaml").write_text(dump_yaml(about), "utf-8")
        done = srs_twin("plan", "way.yaml", "--out", "out", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("way: found: ")
        assert (tmp_path / "out/plan.png").read_bytes().startswith(b"\x89PNG")
        return done.stdout, json.loads((tmp_path / "out/plan.json").read_text("utf-8"))

    return planned


@pytest.mark.parametrize(("heading", "segments"), [(0.0, 0), (3.0, 3)])
def test_plan_from_the_goal_has_no_relative_length(planned, heading, segments):
    goal = {"x_m": 0.0, "y_m": 0.0, "radius_m": 0.05, "heading_rad": heading}
    printed, document = planned({"goal": goal})
    assert f"{segments} segments" in printed
    assert "least length 0: the start is within the goal's radius, " in printed
    assert "times" not in printed and "1 node," in printed
    assert document["quality"]["length_over_least"] is None


@pytest.mark.parametrize(
    ("bound", "room"),
    [(5.0, "at least 1000 mm of clearance"), (0.5, "mm of clearance")],
)
def test_clearance_beyond_the_limit_is_reported_as_at_least_the_limit(
    planned, bound, room
):
    bounds = {"x_m": [-5, 5], "y_m": [-bound, bound]}
    printed, _ = planned({"goal": {"x_m": 1.0, "y_m": 0.0}, "bounds": bounds})
    assert room in printed and ("at least" in printed) == (bound == 5.0)


def test_the_printed_numbers_of_a_straight_plan_are_those_of_the_line(planned):
    """Without obstacles the least length is that of the line to the goal's circle."""
    goal = {"x_m": 0.9, "y_m": 0.0, "radius_m": 0.1}
    bounds = {"x_m": [-1, 2], "y_m": [-0.4, 0.4]}
    printed, document = planned({"goal": goal, "bounds": bounds})
    length, duration, ratio, clearance = map(
        float,
        re.search(
            r"length ([\d.]+) m, ([\d.]+) s at.*?"
            r"([\d.]+) times the least length .*?, ([\d.]+) mm",
            printed,
            re.DOTALL,
        ).groups(),
    )
    assert 0.8 <= length <= 0.9
    metrics = document["metrics"]
    assert metrics.keys() == PLAN_UNITS.keys()
    assert metrics["plan_length_m"] == pytest.approx(length, abs=6e-4)
    assert f"\n{metrics['plan_nodes']} node" in printed
    jump = metrics["plan_max_heading_jump_rad"]
    assert f"1 segment, maximum heading jump {jump:.3g} rad" in printed
    (segment,) = document["segments"]
    assert segment["length"] == pytest.approx(length, abs=6e-4)
    assert ratio == pytest.approx(length / 0.8, abs=0.006)
    assert ratio == pytest.approx(document["quality"]["length_over_least"], abs=0.006)
    straight = load_footprint("gen2_gait").at(0.0)
    assert duration == pytest.approx(length / straight.speed, rel=0.05)
    edge = max(straight.left, straight.right)
    assert clearance == pytest.approx(1000 * (0.4 - edge), abs=5.0)
