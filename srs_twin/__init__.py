"""Digital twin of the WPI soft robotic snake: a MuJoCo twin and an analytical model under the same valves."""

from typing import TYPE_CHECKING

from srs_twin.extensions import lazy

__version__ = "0.1.0"

if TYPE_CHECKING:
    from srs_twin.comparison.compare import Comparison as Comparison
    from srs_twin.control.base import Controller as Controller
    from srs_twin.control.gait import Gait as Gait
    from srs_twin.errors import DivergedError as DivergedError
    from srs_twin.errors import InputError as InputError
    from srs_twin.errors import SrsError as SrsError
    from srs_twin.experiment import compare as compare
    from srs_twin.io.saved_state import SavedState as SavedState
    from srs_twin.planning.planner import plan as plan
    from srs_twin.planning.problem import Plan as Plan
    from srs_twin.planning.problem import Problem as Problem
    from srs_twin.plants.analytical import AnalyticalSnake as AnalyticalSnake
    from srs_twin.plants.base import Plant as Plant
    from srs_twin.plants.base import SnakeState as SnakeState
    from srs_twin.plants.twin.batch import TwinBatch as TwinBatch
    from srs_twin.plants.twin.mjcf.numerics import (
        LoadedContact as LoadedContact,
    )
    from srs_twin.plants.twin.mjcf.numerics import (
        Numerics as Numerics,
    )
    from srs_twin.plants.twin.mjcf.numerics import (
        PreloadedContact as PreloadedContact,
    )
    from srs_twin.plants.twin.snake import TwinSnake as TwinSnake
    from srs_twin.robot.file import load_robot as load_robot
    from srs_twin.robot.spec import RobotSpec as RobotSpec
    from srs_twin.rollout import (
        Job as Job,
    )
    from srs_twin.rollout import (
        rollout as rollout,
    )
    from srs_twin.rollout import (
        run_batch as run_batch,
    )
    from srs_twin.rollout import (
        run_many as run_many,
    )
    from srs_twin.rollout import (
        run_scripts as run_scripts,
    )
    from srs_twin.scenario.loading import load_scenario as load_scenario
    from srs_twin.scenario.scenario import Scenario as Scenario
    from srs_twin.trajectory import Event as Event
    from srs_twin.trajectory import Trajectory as Trajectory

lazy(__name__)
