"""What every run of a sweep needs, loaded: imported once by the server that worker processes come from.

One short run of the analytical model loads the kernels, compiled earlier or not, and what measures a run:
half a second that no worker has to spend again. MuJoCo is left to those that need it.
"""

from srs_twin.comparison.metrics import plant_metrics
from srs_twin.control.gait import Gait
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.robot.file import load_robot
from srs_twin.rollout import rollout
from srs_twin.studies.sweep import task as task

plant_metrics(rollout(AnalyticalSnake(load_robot("gen2")), Gait(2.0), 2.0))
