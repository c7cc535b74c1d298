"""Digital twin of the WPI soft robotic snake: a MuJoCo twin and an analytical model under the same valves."""

from typing import TYPE_CHECKING

from srs_twin.extensions import lazy

__version__ = "0.1.0"

if TYPE_CHECKING:
    from srs_twin.attribution import explain as explain
    from srs_twin.comparison.compare import Comparison as Comparison
    from srs_twin.comparison.diff import diff as diff
    from srs_twin.control.base import Controller as Controller
    from srs_twin.control.gait import Gait as Gait
    from srs_twin.errors import (
        DivergedError as DivergedError,
        InputError as InputError,
        SrsError as SrsError,
    )
    from srs_twin.experiment import compare as compare, run_scenario as run_scenario
    from srs_twin.identification.calibration import (
        calibrate_actuator as calibrate_actuator,
        calibrate_damping as calibrate_damping,
        calibrate_friction as calibrate_friction,
        calibrate_locomotion as calibrate_locomotion,
    )
    from srs_twin.identification.design import calibrate_design as calibrate_design
    from srs_twin.identification.excursions import calibrate_margin as calibrate_margin
    from srs_twin.identification.fitted_robot import calibrate_robot as calibrate_robot
    from srs_twin.identification.footprint_report import (
        calibrate_footprint as calibrate_footprint,
    )
    from srs_twin.identification.replay import replay_scenario as replay_scenario
    from srs_twin.io.saved_state import SavedState as SavedState
    from srs_twin.planning.planned import plan_scenario as plan_scenario
    from srs_twin.planning.planner import plan as plan
    from srs_twin.planning.problem import Plan as Plan, Problem as Problem
    from srs_twin.plants.analytical import AnalyticalSnake as AnalyticalSnake
    from srs_twin.plants.base import Plant as Plant, SnakeState as SnakeState
    from srs_twin.plants.twin.batch import TwinBatch as TwinBatch
    from srs_twin.plants.twin.mjcf.numerics import (
        LoadedContact as LoadedContact,
        Numerics as Numerics,
        PreloadedContact as PreloadedContact,
    )
    from srs_twin.plants.twin.snake import TwinSnake as TwinSnake
    from srs_twin.recordings.inspection import inspect as inspect
    from srs_twin.reproduction.reproduce import reproduce as reproduce
    from srs_twin.robot.file import load_robot as load_robot
    from srs_twin.robot.spec import RobotSpec as RobotSpec
    from srs_twin.rollout import (
        Job as Job,
        rollout as rollout,
        run_batch as run_batch,
        run_many as run_many,
        run_scripts as run_scripts,
    )
    from srs_twin.scenario.loading import load_scenario as load_scenario
    from srs_twin.scenario.scenario import Scenario as Scenario
    from srs_twin.studies.optimization.optimize import optimize as optimize
    from srs_twin.studies.sweep.execution import sweep as sweep
    from srs_twin.studies.uncertainty.propagation import uncertainty as uncertainty
    from srs_twin.trajectory import Event as Event, Trajectory as Trajectory

lazy(__name__)
