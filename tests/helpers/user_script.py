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
    def reset(
        self, *, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), seed: int = 0
    ) -> srs.SnakeState:
        raise srs.SrsError("the bench is not connected")

    def step(self, valves: np.ndarray) -> srs.SnakeState:
        raise srs.SrsError("the bench is not connected")


def turned(problem: srs.Problem) -> srs.Plan:
    return srs.plan(problem)


def commands(fits: list[str], folder: str) -> None:
    """Call the functions of commands, which type checkers read and the test of the script does not run."""
    assert_type(srs.plan_scenario("follow_fig57").plan, srs.Plan)
    result = srs.run_scenario("gen2_straight", explain=srs.explain)
    assert_type(result.trajectories["twin"], srs.Trajectory)
    assert_type(srs.replay_scenario("walk.csv", "gen2"), srs.Scenario)
    print(srs.sweep("fig31", out=folder).exit_code, srs.optimize("gen2_speed").files)
    print(srs.uncertainty("gen2_straight", samples=8).plants, srs.diff("a", "b"))
    print(srs.inspect("walk.csv").rate_hz, srs.calibrate_robot(fits, "mine").actuator)
    fits_of_data = (
        srs.calibrate_friction,
        srs.calibrate_actuator,
        srs.calibrate_locomotion,
    )
    for fit in (*fits_of_data, srs.calibrate_damping):
        print(fit(["walk.csv"], "gen2").estimate)
    print(
        srs.calibrate_design("gen2", {"friction.mu_t": 0.05}),
        srs.calibrate_margin("follow_fig57"),
    )
    print(srs.calibrate_footprint("gen2").offsets, srs.reproduce(quick=True).changes)


spec = srs.load_robot("gen2")
twin = srs.TwinSnake(
    spec, contact=srs.LoadedContact(law="wheel"), numerics=srs.Numerics()
)
plants: list[srs.Plant] = [twin, srs.AnalyticalSnake(spec, friction="wheel")]
run, other = (srs.rollout(plant, Swing(), 0.2, record_hz=50) for plant in plants)
assert_type(
    srs.rollout(srs.TwinSnake(spec, contact=srs.PreloadedContact()), Swing(), 0.1),
    srs.Trajectory,
)
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
problem = srs.Problem(
    FIG54_START, FIG54_GOAL, fig54_world(8, seed=0), load_footprint("gen2_section52")
)
try:
    print(
        srs.plan(problem).length,
        *(each.com.shape for each in finished),
        srs.__version__,
    )
except srs.InputError as error:
    print(error)
