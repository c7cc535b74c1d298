"""Plans that lean on obstacles: the body stays free, forces follow from mechanics, refusals have names."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from plan_sampling import TOUCH, deepest, misses
from rectangles import rectangle
from snakes import robot

from srs_twin.errors import InputError
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.path import path_from_arcs
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Plan, PlanOutcome, Problem, Settings
from srs_twin.planning.touch import _overlaps, touch_limits
from srs_twin.robot.world import Bounds, Circle, Goal, Pose, World
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import parse_scenario

SPEC = robot("gen2")
BODY = load_footprint("gen2_gait").reduced(turn_fraction=0.5)
LIMITS = touch_limits(SPEC, BODY)
LEANING = Settings(touch_limits=LIMITS)
RADIUS = 0.06
X = 0.8


def row(
    gap: float, shift: float = 0.0, count: int = 9, x: float = X
) -> tuple[Circle, ...]:
    """Return a row of posts across the room, with one gap in its middle."""
    pitch = gap + 2 * RADIUS
    return tuple(
        Circle(x, shift + (k + 0.5) * pitch, RADIUS) for k in range(-count, count)
    )


def across(gap: float, shift: float = 0.0, **world: object) -> Problem:
    goal = Goal(1.6, 0.0, None, 0.05)
    posts = World(row(gap, shift), Bounds((-1.0, 3.0), (-0.8, 0.8)), goal)
    return Problem(Pose(0.0, 0.0, 0.0), goal, replace(posts, **world), BODY)


def hard(problem: Problem) -> Problem:
    return replace(problem, footprint=LIMITS.hard)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("seed", range(8))
def test_the_edges_that_must_stay_free_are_free(seed):
    """Sampling shares no code with the planner; the edges contain the body everywhere."""
    rng = np.random.default_rng(seed)
    problem = across(rng.uniform(0.072, 0.095), rng.uniform(-0.1, 0.1))
    result = plan(problem, LEANING)
    assert result.found and result.touches
    assert deepest(result, hard(problem)) <= TOUCH
    assert not misses(result, problem)
    assert deepest(result, problem) > 0.001  # with its full edges it does lean
    assert min(*LIMITS.hard.left, *LIMITS.hard.right) >= SPEC.geometry.width / 2


def test_gaps_narrower_than_the_hard_edges_have_no_plan():
    narrow = 2 * LIMITS.hard.narrowest
    assert plan(across(narrow + 0.002), LEANING).found
    result = plan(across(narrow - 0.002), LEANING)
    assert result.outcome is PlanOutcome.PROVEN_IMPOSSIBLE and result.touches == ()
    assert not plan(across(narrow + 0.002)).found


def test_clear_worlds_have_the_plan_without_touch():
    for problem in (across(0.3), replace(across(0.2), world=World())):
        leaning = plan(problem, LEANING)
        clear = plan(problem)
        assert leaning.touches == () and clear.touches is None
        assert leaning.length <= clear.length + 1e-9


def test_stiffness_is_that_of_a_chain_with_fixed_neighbours():
    """Minimise the elastic energy of two segments; the multiplier is the force on the connector."""
    # Lateral positions of the second and third connector for small angles, as functions
    # of the first heading and of two bends.
    ends = SPEC.geometry.pitch * np.array([[1, 0.5, 0], [2, 1.5, 0.5]])
    energy = np.diag([0.0, 1.0, 1.0]) * SPEC.bending.stiffness
    system = np.block([[energy, ends.T], [ends, np.zeros((2, 2))]])
    pushed = 1e-4
    force = -np.linalg.solve(system, [0, 0, 0, pushed, 0])[3]
    assert force / pushed == pytest.approx(LIMITS.stiffness)


@pytest.mark.parametrize("depth", [0.0005, 0.008])
@pytest.mark.parametrize("side", [1, -1])
def test_place_depth_and_force_of_touches_follow_from_geometry(side, depth):
    """Force of a wave that a wall and then a post on the other side limit by a depth."""
    body = replace(BODY, left=tuple(edge + 0.005 for edge in BODY.left))
    straight = body.at(0.0)
    edges = (straight.left, straight.right)[::side]
    near = edges[0] - depth
    wall = rectangle(0.3, 0.6, *sorted((side * near, side * (near + 0.1))))
    far = edges[1] + RADIUS
    post = Circle(1.205, -side * (far - depth), RADIUS)
    world = World((post,), polygons=(wall,))
    problem = replace(across(0.3), world=world, footprint=body)
    path = path_from_arcs(problem.start, [(0.0, 1.6)], body)
    overlaps = _overlaps(path, problem, LIMITS)
    ends = math.sqrt(edges[0] ** 2 - near**2)
    round_ends = math.sqrt(far**2 - (far - depth) ** 2)
    expected = (
        ("polygon 1", 0.3 - ends, 0.6 + ends, edges[0], 1),
        ("obstacle 1", 1.205 - round_ends, 1.205 + round_ends, edges[1], 0),
    )
    for touch, (name, begin, end, edge, row) in zip(
        overlaps.touches(), expected, strict=True
    ):
        assert touch.obstacle == name
        assert (touch.begin, touch.end) == pytest.approx((begin, end), abs=0.011)
        assert touch.depth == pytest.approx(depth)
        amplitude = edge - LIMITS.core
        wave = amplitude * np.sin(np.linspace(0, 2 * np.pi, 100_001)[:-1])
        pushing = np.mean(wave > amplitude - touch.depth)
        largest = pushing * min(LIMITS.stiffness * touch.depth, LIMITS.floor)
        force = overlaps.force[row]
        assert force.max() == pytest.approx(largest, rel=1e-3)
        # The steps have equal length, and overlaps of up to 0.1 mm are not reported.
        reported = overlaps.depth[row] > 1e-4
        assert touch.force == pytest.approx(force[reported].mean())


def test_mirrored_worlds_have_mirrored_touches():
    curvatures = np.array(BODY.curvatures)
    even = replace(
        BODY,
        left=tuple(np.maximum(BODY.left, BODY.right[::-1])),
        curvatures=tuple((curvatures - curvatures[::-1]) / 2),
        transients=(),
    )
    even = replace(even, right=even.left[::-1])
    settings = Settings(touch_limits=touch_limits(SPEC, even))
    ours, mirrored = (
        plan(replace(across(0.085, shift), footprint=even), settings)
        for shift in (0.03, -0.03)
    )
    assert ours.length == pytest.approx(mirrored.length, abs=1e-6)
    depths = sorted(touch.depth for touch in ours.touches)
    assert depths == pytest.approx(sorted(t.depth for t in mirrored.touches), abs=1e-6)


def test_bounds_are_no_obstacles_to_lean_on():
    wide = 2 * BODY.narrowest + 0.004
    problem = replace(
        across(0.3), world=World(bounds=Bounds((-1.0, 3.0), (-wide / 2, wide / 2)))
    )
    inside = plan(problem, LEANING)
    assert inside.found and deepest(inside, problem) <= TOUCH
    tight = replace(problem, world=World(bounds=Bounds((-1.0, 3.0), (-0.045, 0.045))))
    with pytest.raises(InputError, match="touches the bounds"):
        plan(tight, LEANING)


def scenario(**changes: object) -> dict:
    posts = [
        {"x_m": c.x, "y_m": c.y, "radius_m": c.radius} for c in row(0.085, count=5)
    ]
    planner = {
        "kind": "best_first",
        "footprint": "gen2_gait",
        "turn_fraction": 0.5,
        "contact": "allowed",
    }
    world = {
        "bounds": {"x_m": [-1, 3], "y_m": [-0.8, 0.8]},
        "obstacles": posts,
        "goal": {"x_m": 1.2, "y_m": 0, "radius_m": 0.08},
    }
    follow = {
        "kind": "follow",
        "follower": "path",
        "gait": {"kind": "gait", "frequency_hz": 2.0},
    }
    return {
        "robot": "gen2",
        "duration_s": 15,
        "record_hz": 50,
        "supply": {"pressure_kpa": 48.3},
        "world": world,
        "planner": planner | changes,
        "controller": follow,
        "plants": {"twin": {}},
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"kind": "given", "turns_rad": [0], "step_m": 1},
            "planner.contact: unknown key",
        ),
        (
            {"clearance_weight": 1},
            "`contact: allowed` and `clearance_weight` cannot be combined",
        ),
        (
            {"shape_changes": True},
            "`contact: allowed` and `shape_changes` cannot be combined",
        ),
    ],
)
def test_touch_is_refused_by_name(changes, message):
    with pytest.raises(InputError, match=message):
        parse_scenario(scenario(**changes))


def test_limits_of_leaning_follow_from_the_robot():
    core = SPEC.geometry.width / 2
    for side in ("left", "right"):
        full = np.array(getattr(BODY, side))
        assert getattr(LIMITS.hard, side) == pytest.approx((full + core) / 2)
    mass = sum(SPEC.mass.connectors)
    assert LIMITS.floor == pytest.approx(SPEC.friction.mu_n * mass * 9.81, rel=1e-3)
    assert parse_scenario(scenario()).build_controller().allows_contact


def test_a_plant_without_contact_is_refused():
    with pytest.raises(
        InputError,
        match="set `model: compliant` and `contact: true`, or remove `analytical`",
    ):
        parse_scenario(scenario() | {"plants": {"analytical": {}, "twin": {}}})


def test_touch_excludes_a_cost_of_clearance_in_python():
    with pytest.raises(InputError, match="`clearance_weight` must be 0"):
        replace(LEANING, clearance_weight=1.0)


def test_the_command_states_where_the_path_leans(srs_twin, tmp_path):
    (tmp_path / "lean.yaml").write_text(json.dumps(scenario(lead_in_m=0.2)))

    def planned(*options: str) -> tuple[str, dict]:
        done = srs_twin("plan", "lean.yaml", "--out", "out", *options, cwd=tmp_path)
        assert done.returncode == 0
        return done.stdout, json.loads((tmp_path / "out/plan.json").read_text())

    printed, document = planned()
    assert len(document["touches"]) == 2
    for touch in document["touches"]:
        # Path lengths include the straight run-up.
        assert touch["begin"] < 0.8 < touch["end"]
        assert (
            f"leans on {touch['obstacle']} from {touch['begin']:.2f} to"
            f" {touch['end']:.2f} m: footprint and margin overlap by"
            f" {1000 * touch['depth']:.0f} mm, estimated mean force"
            f" {touch['force']:.2g} N\n" in printed
        )
    assert "touches" not in planned("--set", "planner.contact=null")[1]


@pytest.mark.slow
@pytest.mark.parametrize("plant", ["twin", "analytical"])
def test_a_snake_passes_a_gap_narrower_than_its_footprint(plant):
    models = {
        "twin": {"hinges_per_segment": 3},
        "analytical": {
            "model": "compliant",
            "friction": "ellipse",
            "load": "instantaneous",
            "contact": True,
        },
    }
    loaded = parse_scenario(scenario() | {"plants": {plant: models[plant]}})
    plan_ = loaded.planner.plan()
    assert isinstance(plan_, Plan) and plan_.touches
    run = rollout(
        loaded.build_plant(plant), loaded.build_controller(), 15.0, seed=0, record_hz=50
    )
    assert run.metadata["control"]["following"]["ending"] == "goal_reached"
    assert np.linalg.norm(run.com[-1] - (1.2, 0.0)) <= 0.08
