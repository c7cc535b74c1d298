"""Module that the fork server imports once for all workers of a sweep.

A short run of the analytical model loads the compiled kernels and the metrics, which
saves half a second per worker. MuJoCo is not imported, because some workers do not need
it.
"""

import srs_twin.studies.sweep.task  # noqa: F401 - imported for the workers
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.control.gait import Gait
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.robot.file import load_robot
from srs_twin.rollout import rollout

plant_metrics(rollout(AnalyticalSnake(load_robot("gen2")), Gait(2.0), 2.0))
