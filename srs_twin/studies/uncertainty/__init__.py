"""Every number with an interval: what is uncertain of a robot, propagated to what a scenario predicts."""

from srs_twin.robot.priors import Prior, Priors
from srs_twin.studies.uncertainty.discrepancy import Discrepancy
from srs_twin.studies.uncertainty.propagation import Propagation, propagate
from srs_twin.studies.uncertainty.spreads import Spread
from srs_twin.studies.uncertainty.study import Study

__all__ = ["Discrepancy", "Prior", "Priors", "Propagation", "Spread", "Study", "propagate"]
