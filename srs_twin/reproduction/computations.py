"""Computations for claims that cannot be checked by running a scenario."""

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

_PULL_S = 1.0

_MIN_GAIN_M_S = 1e-3
"""Speed increase in the second half of a pull above which the robot counts as sliding,
m/s.

Below the friction limit, the axles creep at a constant speed that is proportional to
the force. The maximum creep speed of generation 1 is 13 mm/s.
"""

_BISECTIONS = 12


def spring_car(robot: str) -> Numbers:
    """Return the friction coefficients μ = F/(m g) of a straight snake in a pull test.

    Section 3.4 describes the experiment (Eq. 17). In the simulation of the twin, a
    horizontal component of gravity pulls the snake, and bisection finds the coefficient
    at which the snake starts to slide. The analytical model prescribes the friction
    law, so the coefficient of this model is the maximum ratio of contact force to load
    of any connector during a gait.

    Returns:
        Coefficients ``mu_t`` (along the body) and ``mu_n`` (across the body) for both
        plants.
    """
    mu_t, mu_n = _analytical_coefficients(robot)
    return {
        "analytical.mu_t": mu_t,
        "analytical.mu_n": mu_n,
        "twin.mu_t": _twin_coefficient(robot, along=True),
        "twin.mu_n": _twin_coefficient(robot, along=False),
    }


def _twin_coefficient(robot: str, *, along: bool) -> float:
    friction = load_robot(robot).friction
    guess = friction.mu_t if along else friction.mu_n
    low = 0.0
    high = 2.0 * max(guess, 0.5)
    for _ in range(_BISECTIONS):
        pull = (low + high) / 2
        low, high = (low, pull) if _slides(robot, pull, along=along) else (pull, high)
    return (low + high) / 2


def _slides(robot: str, pull: float, *, along: bool) -> bool:
    from srs_twin.plants.twin.snake import TwinSnake

    plant = TwinSnake(load_robot(robot))
    vented = np.full((plant.spec.segments, 2), -1, dtype=np.int8)
    plant.reset()
    plant.physics.model.opt.gravity[0 if along else 1] = pull * GRAVITY
    half = round(_PULL_S / plant.tick / 2)
    speeds = [
        float(np.hypot(*plant.step(vented).com_velocity)) for _ in range(2 * half)
    ]
    return speeds[-1] - speeds[half] > _MIN_GAIN_M_S


def _analytical_coefficients(robot: str) -> tuple[float, float]:
    from srs_twin.rollout import rollout

    scenario = load_scenario(f"{robot}_straight")
    load = scenario.robot.mass.array() * GRAVITY
    largest = np.zeros(2)

    def observe(state: SnakeState) -> None:
        c = np.cos(state.connector_heading)
        s = np.sin(state.connector_heading)
        x, y = state.contact_force.T
        ratio = np.abs([x * c + y * s, y * c - x * s]) / load
        np.maximum(largest, ratio.max(axis=1), out=largest)

    plant = scenario.build_plant("analytical")
    controller = scenario.build_controller()
    rollout(plant, controller, scenario.duration, observers=(observe,))
    return float(largest[0]), float(largest[1])


def tail_load(scenario: str, frequency_hz: float) -> Numbers:
    """Return the ratio of the minimum wheel load at the tail to the load at rest.

    Section 3.4.3 of the dissertation describes the experiment. If the ratio is
    negative, a wheel of the twin would lift off without its preload.
    """
    from srs_twin.plants.twin.snake import TwinSnake
    from srs_twin.rollout import rollout

    loaded = _with_controller(load_scenario(scenario), frequency_hz=frequency_hz)
    plant = loaded.build_plant("twin")
    assert isinstance(plant, TwinSnake), "requested above"
    wheels = plant.physics.wheel_loads()[-1].size
    rest = float(loaded.robot.mass.array()[-1]) * GRAVITY / wheels
    smallest = math.inf

    def observe(state: SnakeState) -> None:
        nonlocal smallest
        if state.time > 2 / frequency_hz:
            load = float(plant.physics.wheel_loads()[-1].min())
            smallest = min(smallest, load / rest)

    rollout(plant, loaded.build_controller(), loaded.duration, observers=(observe,))
    return {"twin.least": smallest}


def change_of_offset(
    scenario: str, before: float, after: float, at_period: float
) -> Numbers:
    """Return the path curvature after an offset change during learning (Section 5.3).

    Args:
        scenario: scenario with iterative learning.
        before: initial steering offset.
        after: final steering offset.
        at_period: time of the change, in gait periods.

    Returns:
        Ratio ``first`` of the curvature over the first gait period after the change to
        the curvature over the last period, for both plants.
    """
    from srs_twin.control.commands import ScheduledOffset
    from srs_twin.control.gait import Gait
    from srs_twin.control.learning import ILC
    from srs_twin.rollout import rollout

    loaded = _with_controller(load_scenario(scenario), offset=before)
    numbers: Numbers = {}
    for plant in ("analytical", "twin"):
        gait = loaded.build_controller()
        assert isinstance(gait, Gait | ILC) and gait.frequency is not None, (
            "only scenarios with gaits"
        )
        period = 1 / gait.frequency
        time = at_period / gait.frequency
        controller = ScheduledOffset(gait, [(time, after)])
        run = rollout(loaded.build_plant(plant), controller, loaded.duration)
        last = _curvature(run, loaded.duration - period, period)
        numbers[f"{plant}.first"] = _curvature(run, time, period) / last
    return numbers


def _curvature(run: Trajectory, begin: float, period: float) -> float:
    """Return the heading change per distance travelled during one period, 1/m."""
    times = np.array([begin, begin + period])
    heading = np.interp(times, run.time, run["heading"])
    x, y = (np.interp(times, run.time, run[name]) for name in ("com_x", "com_y"))
    return float(np.diff(heading)[0] / np.hypot(np.diff(x)[0], np.diff(y)[0]))


def _with_controller(scenario: Scenario, **controller: float) -> Scenario:
    document = scenario.document
    settings = {**document["controller"], **controller}
    return parse_scenario({**document, "controller": settings})


def contact_force(
    robot: str, frequency_hz: float, force_n: float, connector: float
) -> Numbers:
    """Estimate the force on a connector without force sensors (Section 6.2).

    The force acts to the left for 0.5 s after 12 s of free crawling.

    Args:
        robot: name of a robot.
        frequency_hz: gait frequency, Hz. The gait period must be a multiple of the
            tick.
        force_n: applied force, N.
        connector: number of the connector, counted from 1 at the head.

    Returns:
        Maximum detection score ``score``, and the corresponding ratio ``ratio`` of the
        estimated to the applied force.
    """
    from srs_twin.control.gait import Gait
    from srs_twin.live.contact_observer import ContactObserver
    from srs_twin.plants.twin.snake import TwinSnake

    twin = TwinSnake(load_robot(robot), sensor="hall")
    gait = Gait(frequency_hz)
    gait.reset(twin.spec, twin.tick)
    ticks = round(1 / (frequency_hz * twin.tick))
    observer = ContactObserver(twin.spec, twin.tick, ticks)
    state = twin.reset()
    k = round(connector) - 1
    best = (0.0, 0.0)
    body = twin.physics.model.body(f"connector_{k + 1}").id
    while state.time < 12.6:
        heading = float(state.connector_heading[k])
        left = np.array([-math.sin(heading), math.cos(heading)])
        pressed = 12.0 <= state.time < 12.5
        twin.physics.data.xfrc_applied[body, :2] = left * force_n * pressed
        valves = np.asarray(gait.step(state))
        state = twin.step(valves)
        mean = valves.reshape(-1, *valves.shape[-2:]).mean(axis=0)
        estimate = observer.update(mean, state.pressure, state.measured_bend)
        if estimate is not None and state.time > 12.0:
            best = max(best, (estimate.score, estimate.force / force_n))
    return {"twin.score": best[0], "twin.ratio": best[1]}


def bend_at(robot: str, pressure_psi: float) -> Numbers:
    """Return the bend of an unloaded module at a pressure (Section 2.1), degrees."""
    actuator = load_robot(robot).actuator
    pascal = 6894.757 * pressure_psi
    return {"alone.bend_deg": math.degrees(actuator.gain * pascal)}


def turn_limit(speed_m_s: float, radius_m: float) -> Numbers:
    """Return the yaw rate on a circle of Table 8 (Section 5.3), degrees per second."""
    return {"alone.turn_deg_s": math.degrees(speed_m_s / radius_m)}


def footprint_edges(footprint: str) -> Numbers:
    """Return the width (m), edge shift (m) and yaw rate (degrees/s) of a footprint.

    The width is measured on a straight path, and the other values are measured at
    maximum curvature. Table 9 of the dissertation lists the width and the edge shift.
    """
    from srs_twin.planning.footprint_file import load_footprint

    body = load_footprint(footprint)
    straight = body.at(0.0)
    tight = body.at(max(body.curvatures))
    return {
        "alone.width_m": straight.left + straight.right,
        "alone.shift_m": abs(tight.left - straight.left),
        "alone.turn_deg_s": math.degrees(tight.speed * max(body.curvatures)),
    }


def primitive_error(count: int, turn_rad: float, length_m: float) -> Numbers:
    """Return the maximum distance between arc ends from the planner and from Eq. 33, m.

    Eq. 33 is evaluated with the signs of the erratum E7.
    """
    from srs_twin.planning.arcs import Primitives
    from srs_twin.robot.world import Pose

    start = Pose(0.3, -0.2, 0.7)
    worst = 0.0
    for alpha, end in zip(
        np.linspace(-turn_rad, turn_rad, count),
        Primitives(count, turn_rad, length_m).children(start),
        strict=True,
    ):
        connector_heading = start.heading + alpha
        if abs(alpha) < 1e-9:
            x = start.x + length_m * math.cos(connector_heading)
            y = start.y + length_m * math.sin(connector_heading)
        else:
            r = length_m / alpha
            x = start.x + r * (math.sin(connector_heading) - math.sin(start.heading))
            y = start.y - r * (math.cos(connector_heading) - math.cos(start.heading))
        worst = max(worst, math.hypot(end.x - x, end.y - y))
    return {"alone.error_m": worst}
