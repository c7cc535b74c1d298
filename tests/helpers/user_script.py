"""Script of a user that calls every public name; type checkers and a slow test run it."""

from typing import assert_type

import numpy as np
from numpy.typing import NDArray

import srs_twin as srs
from srs_twin.planning import load_footprint
from srs_twin.robot.world import FIG54_GOAL, FIG54_START, fig54_world


class Swing(srs.Controller):
    kind = "swing"

    def reset(self, spec: srs.RobotSpec, tick: float, *, seed: int = 0) -> None:
        self.gait = srs.Gait(1.5)
        self.gait.reset(spec, tick, seed=seed)

    def step(self, state: srs.SnakeState) -> np.ndarray:
        return self.gait.step(state)


class Bench(srs.Plant):
    def reset(self, *, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), seed: int = 0) -> srs.SnakeState:
        raise srs.SrsError("the bench is not connected")

    def step(self, valves: np.ndarray) -> srs.SnakeState:
        raise srs.SrsError("the bench is not connected")


def turned(problem: srs.Problem) -> srs.Plan:
    return srs.plan(problem, planner="greedy")


spec = srs.load_robot("gen2")
twin = srs.TwinSnake(spec, contact=srs.LoadedContact(law="wheel"), numerics=srs.Numerics())
plants: list[srs.Plant] = [twin, srs.AnalyticalSnake(spec, friction="wheel")]
run, other = (srs.rollout(plant, Swing(), 0.2, record_hz=50) for plant in plants)
assert_type(srs.rollout(srs.TwinSnake(spec, contact=srs.PreloadedContact()), Swing(), 0.1), srs.Trajectory)
assert_type(run["com_x"], NDArray[np.float64])
assert_type(run.com, NDArray[np.float64])
assert_type(twin.spec, srs.RobotSpec)
assert_type(srs.compare(run, other), srs.Comparison)
assert_type(run.events, tuple[srs.Event, ...])
saved: srs.SavedState = Swing().save() if run.events else srs.SavedState({}, {})
scenario: srs.Scenario = srs.load_scenario("gen2_straight")
assert_type(scenario.robot, srs.RobotSpec)
batch = srs.TwinBatch([spec, spec])
done = srs.run_many([srs.Job(lambda: srs.AnalyticalSnake(spec), Swing, 0.2)])
done += srs.run_scripts(batch, [srs.Gait(1.0), srs.Gait(2.0)], 0.2)
done += srs.run_batch(batch, lambda states: np.full((2, 4, 2), -1, dtype=np.int8), 0.2)
finished = [each for each in done if not isinstance(each, srs.DivergedError)]
assert_type(finished, list[srs.Trajectory])
problem = srs.Problem(FIG54_START, FIG54_GOAL, fig54_world(8, seed=0), load_footprint("gen2_section52"))
try:
    print(srs.plan(problem).length, *(each.com.shape for each in finished), srs.__version__)
except srs.InputError as error:
    print(error)
