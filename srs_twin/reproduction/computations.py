"""Computations that rows need and no scenario gives: pulls, loads, changes of offset, the planner's study."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.robot.file import load_robot
from srs_twin.robot.spec import GRAVITY
from srs_twin.scenario.loading import load_scenario, parse_scenario

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState
    from srs_twin.scenario.scenario import Scenario
    from srs_twin.trajectory import Trajectory

Numbers = dict[str, float | None]

_PULL_S, _GAINED_M_S = 1.0, 1e-3
"""A pull lasts so long. What has come loose gains speed in the second half of it; axles that still hold only
creep, at a speed in proportion to the pull (13 mm/s at most in generation 1)."""
_PULLS = 12


def spring_car(robot: str) -> Numbers:
    """Pull a straight snake along and across until it comes loose (Section 3.4, Eq. 17): μ = F/(m g).

    The twin is pulled by a force on every body in proportion to its mass, a level component of gravity,
    and the coefficient bisected. The analytical model has friction as a law: the largest force over the
    load that any connector meets in a gait is its coefficient.

    Args:
        robot: a shipped robot.

    Returns:
        ``mu_t`` and ``mu_n`` of both plants.
    """
    felt = _felt(robot)
    return {
        "analytical.mu_t": felt[0],
        "analytical.mu_n": felt[1],
        "twin.mu_t": _loose(robot, along=True),
        "twin.mu_n": _loose(robot, along=False),
    }


def _loose(robot: str, *, along: bool) -> float:
    """Return the level pull over the weight at which the twin comes loose."""
    friction = load_robot(robot).friction
    guess = friction.mu_t if along else friction.mu_n
    low, high = 0.0, 2.0 * max(guess, 0.5)
    for _ in range(_PULLS):
        pull = (low + high) / 2
        low, high = (low, pull) if _comes_loose(robot, pull, along=along) else (pull, high)
    return (low + high) / 2


def _comes_loose(robot: str, pull: float, *, along: bool) -> bool:
    from srs_twin.plants.twin.snake import TwinSnake

    plant = TwinSnake(load_robot(robot))
    vented = np.full((plant.spec.segments, 2), -1, dtype=np.int8)
    plant.reset()
    plant.physics.model.opt.gravity[:] = (*((pull * GRAVITY, 0) if along else (0, pull * GRAVITY)), -GRAVITY)
    half = round(_PULL_S / plant.tick / 2)
    speeds = [float(np.hypot(*plant.step(vented).com_velocity)) for _ in range(2 * half)]
    return speeds[-1] - speeds[half] > _GAINED_M_S


def _felt(robot: str) -> tuple[float, float]:
    """Return the largest friction over load of the analytical connectors, along and across."""
    from srs_twin.rollout import rollout

    scenario = load_scenario(f"{robot}_straight")
    load = scenario.robot.mass.array() * GRAVITY
    most = np.zeros(2)

    def look(state: SnakeState) -> None:
        c, s = np.cos(state.theta), np.sin(state.theta)
        x, y = state.contact_force.T
        felt = np.abs([x * c + y * s, y * c - x * s]) / load
        np.maximum(most, felt.max(axis=1), out=most)

    rollout(
        scenario.build_plant("analytical"), scenario.build_controller(), scenario.duration, observers=(look,)
    )
    return float(most[0]), float(most[1])


def tail_load(scenario: str, frequency_hz: float) -> Numbers:
    """Return the least load on the twin's tail over that at rest: below 0 a wheel lifts (Section 3.4.3)."""
    from srs_twin.plants.twin.snake import TwinSnake
    from srs_twin.rollout import rollout

    given = _with(load_scenario(scenario), frequency_hz=frequency_hz)
    plant = given.build_plant("twin")
    assert isinstance(plant, TwinSnake), "asked for"
    wheels = plant.physics.wheel_loads()[-1].size
    rest = float(given.robot.mass.array()[-1]) * GRAVITY / wheels
    least = math.inf

    def look(state: SnakeState) -> None:
        nonlocal least
        if state.time > 2 / frequency_hz:
            least = min(least, float(plant.physics.wheel_loads()[-1].min()) / rest)

    rollout(plant, given.build_controller(), given.duration, observers=(look,))
    return {"twin.least": least}


def change_of_offset(scenario: str, before: float, after: float, at_period: float) -> Numbers:
    """Change the offset of a learning snake once: how its path turns first, and in the end (Section 5.3).

    Args:
        scenario: under iterative learning, which says frequency and duration.
        before: offset at first.
        after: offset from the change on.
        at_period: when, in periods.

    Returns:
        Of both plants ``first``: curvature over the first period after the change over the final one.
    """
    from srs_twin.control.commands import Steered
    from srs_twin.control.gait import Gait
    from srs_twin.control.learning import ILC
    from srs_twin.rollout import rollout

    given = _with(load_scenario(scenario), offset=before)
    found: Numbers = {}
    for plant in ("analytical", "twin"):
        gait = given.build_controller()
        assert isinstance(gait, Gait | ILC) and gait.frequency is not None, "scenarios of gaits only"
        time = at_period / gait.frequency
        run = rollout(given.build_plant(plant), Steered(gait, [(time, after)]), given.duration)
        first, last = (
            _curvature(run, t, 1 / gait.frequency) for t in (time, given.duration - 1 / gait.frequency)
        )
        found[f"{plant}.first"] = first / last
    return found


def _curvature(run: Trajectory, begin: float, period: float) -> float:
    """Return the turn of one period over the way of the centre of mass, 1/m."""
    times = np.array([begin, begin + period])
    heading = np.interp(times, run.time, run["heading"])
    x, y = (np.interp(times, run.time, run[name]) for name in ("com_x", "com_y"))
    return float(np.diff(heading)[0] / np.hypot(np.diff(x)[0], np.diff(y)[0]))


def _with(scenario: Scenario, **controller: float) -> Scenario:
    """Return a scenario whose controller has other numbers."""
    document = dict(scenario.document)
    return parse_scenario(document | {"controller": {**document["controller"], **controller}})


def planner_success(planner: str, draws: int) -> Numbers:
    """Plan in the field of Fig. 54 with 1 to 18 obstacles (Fig. 55).

    Args:
        planner: "greedy", the text's, or "best_first".
        draws: of the obstacles, for each count.

    Returns:
        ``count_1`` … ``count_18``: shares of draws with a path; ``trend``: their rank correlation with the
        count, −1 where success falls at every step.
    """
    from scipy.stats import spearmanr

    from srs_twin.planning.arcs import Primitives
    from srs_twin.planning.footprint import load_footprint
    from srs_twin.planning.planner import plan
    from srs_twin.planning.problem import Problem
    from srs_twin.robot.drawn_worlds import FIG54_GOAL, FIG54_SITES, FIG54_START, fig54_world

    body = load_footprint("gen2_section52")
    arcs = Primitives(21, math.pi / 3, 0.2) if planner == "greedy" else None
    counts = range(1, len(FIG54_SITES) + 1)
    shares = []
    for count in counts:
        problems = (Problem(FIG54_START, FIG54_GOAL, fig54_world(count, k), body, arcs) for k in range(draws))
        shares.append(sum(plan(each, planner=planner).found for each in problems) / draws)
    trend = float(spearmanr(list(counts), shares).statistic)
    found: Numbers = {f"alone.count_{count}": share for count, share in zip(counts, shares, strict=True)}
    return found | {"alone.trend": None if math.isnan(trend) else trend}


def bend_at(robot: str, pressure_psi: float) -> Numbers:
    """Return the bend of a free module at a pressure by the robot's gain, degrees (Section 2.1)."""
    actuator = load_robot(robot).actuator
    pascal = 6894.757 * pressure_psi
    return {"alone.bend_deg": math.degrees(actuator.gain * pascal)}


def turn_limit(speed_m_s: float, radius_m: float) -> Numbers:
    """Return how fast a circle of Table 8 is turned along, degrees a second (Section 5.3)."""
    return {"alone.turn_deg_s": math.degrees(speed_m_s / radius_m)}


def footprint_edges(footprint: str) -> Numbers:
    """Return a footprint's width going straight and its shift at the tightest turn, m (Table 9)."""
    from srs_twin.planning.footprint import load_footprint

    body = load_footprint(footprint)
    straight, tight = body.at(0.0), body.at(max(body.curvatures))
    return {
        "alone.width_m": straight.left + straight.right,
        "alone.shift_m": abs(tight.left - straight.left),
        "alone.turn_deg_s": math.degrees(tight.speed * max(body.curvatures)),
    }


def primitive_error(count: int, turn_rad: float, length_m: float) -> Numbers:
    """Return how far the planner's arcs end from where Eq. 33 (signs put right, E7) has them at most, m."""
    from srs_twin.planning.arcs import Primitives
    from srs_twin.robot.world import Pose

    start = Pose(0.3, -0.2, 0.7)
    worst = 0.0
    for alpha, end in zip(
        np.linspace(-turn_rad, turn_rad, count),
        Primitives(count, turn_rad, length_m).children(start),
        strict=True,
    ):
        theta = start.heading + alpha
        if abs(alpha) < 1e-9:
            x, y = start.x + length_m * math.cos(theta), start.y + length_m * math.sin(theta)
        else:
            r = length_m / alpha
            x = start.x + r * (math.sin(theta) - math.sin(start.heading))
            y = start.y - r * (math.cos(theta) - math.cos(start.heading))
        worst = max(worst, math.hypot(end.x - x, end.y - y))
    return {"alone.error_m": worst}
