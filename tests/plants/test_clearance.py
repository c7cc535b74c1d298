"""Clearance of obstacles, compared with the distances between collision bodies in MuJoCo."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from snakes import robot
from synthetic import numbered

from srs_twin import Trajectory, TwinSnake, rollout
from srs_twin.comparison.centre_line import centre_lines
from srs_twin.comparison.contacts import contact_metrics
from srs_twin.plants.clearance import clearance, collision_lines
from srs_twin.robot.world import Circle, Polygon, World
from srs_twin.scenario.loading import parse_scenario

WORLD = World(
    (Circle(0.3, 0.1, 0.06), Circle(-0.4, -0.35, 0.11)),
    polygons=(
        Polygon(((0.1, -0.5), (0.4, -0.5), (0.4, -0.46), (0.1, -0.46))),
        Polygon(((-0.5, 0.3), (-0.1, 0.45), (-0.4, 0.36), (-0.48, 0.34))),
    ),
)
"""Obstacles too narrow to contain a body, which would then touch no side."""

ROUNDING_M = 1e-12
TILT_M = 1e-6
"""Effect of pitch and roll of a crawling snake, fractions of a degree, on planar distances, m."""


def mujoco_distances(twin: TwinSnake, places: np.ndarray) -> np.ndarray:
    """Return the smallest distance between the geoms of snake and obstacles for each qpos, m."""
    model = twin.physics.model
    data = mujoco.MjData(model)
    names = [model.geom(k).name for k in range(model.ngeom)]
    collision_geoms = [
        k for k, name in enumerate(names) if name.startswith("collision_")
    ]
    solid = [
        k for k, name in enumerate(names) if name.startswith(("obstacle_", "polygon_"))
    ]
    found = []
    for qpos in places:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        found.append(
            min(
                mujoco.mj_geomDistance(model, data, a, b, 10.0, None)
                for a in collision_geoms
                for b in solid
            )
        )
    return np.array(found)


def poses(twin: TwinSnake, count: int, *, unequal: bool, seed: int) -> np.ndarray:
    """Draw poses anywhere among the obstacles, segments bent by up to 1.5 rad, shape (count, nq)."""
    draw = np.random.default_rng(seed)
    model = twin.physics.model
    found = np.tile(twin.physics.data.qpos, (count, 1))
    heading = draw.uniform(-np.pi, np.pi, count)
    found[:, :2] = draw.uniform(-0.6, 0.6, (count, 2))
    found[:, 3] = np.cos(heading / 2)
    found[:, 6] = np.sin(heading / 2)
    segments = twin.spec.segments
    hinges = twin.describe()["hinges_per_segment"]
    angles = (
        draw.uniform(-1.5, 1.5, (count, segments, hinges if unequal else 1)) / hinges
    )
    for j in range(segments):
        for k in range(hinges):
            found[:, model.joint(f"hinge_{j + 1}_{k + 1}").qposadr[0]] = angles[
                :, j, k if unequal else 0
            ]
    return found


def seen(twin: TwinSnake, places: np.ndarray) -> SimpleNamespace:
    """Return connectors and qpos with one sample per pose."""
    states = np.concatenate(
        [
            np.zeros((len(places), 1)),
            places,
            np.zeros((len(places), twin.physics.model.nv)),
        ],
        axis=1,
    )
    view = twin.physics.kinematics(states)
    # Headings are recorded without jumps along the body.
    connector_heading = view.headings[:, :1] - np.cumsum(
        np.pad(view.bends, ((0, 0), (1, 0))), axis=1
    )
    return SimpleNamespace(
        position=view.positions[..., :2],
        connector_heading=connector_heading,
        qpos=places,
    )


def trajectory_of(seen: SimpleNamespace) -> Trajectory:
    """Return the connectors as a trajectory."""
    columns = {"time": np.arange(len(seen.connector_heading), dtype=float)}
    columns |= numbered("x", seen.position[..., 0]) | numbered(
        "y", seen.position[..., 1]
    )
    return Trajectory(columns | numbered("connector_heading", seen.connector_heading))


@pytest.mark.default_cases(at=[0, 10, 15])
@pytest.mark.parametrize("name", ["gen1", "gen2", "gen3", "gen4"])
@pytest.mark.parametrize(
    ("hinges", "unequal"), [(1, True), (2, True), (3, False), (5, False)]
)
def test_clearance_equals_mujocos_smallest_distance(name, hinges, unequal):
    # Preloaded: the wheels of a loaded snake sink in by micrometres, and its body
    # pitches.
    twin = TwinSnake(
        robot(name), world=WORLD, hinges_per_segment=hinges, contact="preloaded"
    )
    places = poses(twin, 40, unequal=unequal, seed=hinges)
    run = seen(twin, places)
    distance = mujoco_distances(twin, places)
    assert clearance(twin, run) == pytest.approx(distance, abs=ROUNDING_M)
    assert distance.min() < 0 < distance.max()


def test_inner_hinges_that_bend_unequally_are_bounded():
    """With three or more hinges per segment, connectors do not determine the inner ones."""
    twin = TwinSnake(robot("gen2"), world=WORLD, hinges_per_segment=3)
    places = poses(twin, 100, unequal=True, seed=7)
    apart = clearance(twin, seen(twin, places))
    error = np.abs(apart - mujoco_distances(twin, places)).max()
    assert ROUNDING_M < error < twin.spec.geometry.segment_length * 1.0 / 8


def test_the_hull_is_within_its_bound_of_the_arc():
    twin = TwinSnake(robot("gen2"), world=WORLD)
    places = poses(twin, 100, unequal=False, seed=3)
    run = seen(twin, places)
    geometry = twin.spec.geometry
    bend = np.abs(np.diff(run.connector_heading, axis=1))
    lines = collision_lines(run.position, run.connector_heading, geometry, 2)
    hinges = lines[:, :-1].reshape(100, geometry.segments, 3, 2)[:, :, 1:]
    middle = centre_lines(trajectory_of(run), geometry, divisions=2)[:, :, 2]
    beside = np.linalg.norm(hinges.mean(axis=2) - middle, axis=-1)
    bound = geometry.segment_length * bend / 24  # of small bends
    assert (beside < 1.05 * bound + 1e-9).all()
    assert beside.max() > bound.max()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "lateral", "touched"),
    [
        ("circle", 0.0, True),
        ("circle", 0.133, None),
        ("circle", 0.135, None),
        ("circle", 0.137, None),
        ("circle", 0.15, False),
        ("square", 0.0, True),
        ("square", 0.16, False),
    ],
)
def test_clearance_is_positive_exactly_without_contact(shape, lateral, touched):
    """The twin of generation 2 passes a circle or a square of 0.1 m at a given distance from its path, m.

    At small distances (None), contact depends on the follower.
    """
    corners = [
        [0.35, lateral - 0.1],
        [0.55, lateral - 0.1],
        [0.55, lateral + 0.1],
        [0.35, lateral + 0.1],
    ]
    world = {
        "circle": {"obstacles": [{"x_m": 0.45, "y_m": lateral, "radius_m": 0.1}]},
        "square": {"polygons": [{"corners_m": corners}]},
    }[shape]
    given = {
        "kind": "given",
        "footprint": "gen2_section52",
        "turns_rad": [0, 0],
        "step_m": 0.5,
    }
    gait = {"kind": "gait", "frequency_hz": 2.0}
    scenario = parse_scenario(
        {
            "robot": "gen2",
            "duration_s": 4,
            "record_hz": 50,
            "world": world,
            "planner": given,
            "controller": {"kind": "follow", "gait": gait},
            "plants": {"twin": {}},
        }
    )
    twin = scenario.build_plant("twin")
    run = rollout(twin, scenario.build_controller(), 4.0, record_hz=50)
    metrics = contact_metrics(run)
    assert (metrics["contacts"] > 0) == (metrics["clearance_m"] <= 0)
    assert touched in (None, metrics["contacts"] > 0)
    assert metrics["clearance_m"] > -0.001  # penetration of contacts in the engine
    distance = mujoco_distances(twin, run.stack("qpos"))
    assert run["clearance"] == pytest.approx(distance, abs=TILT_M)
