"""Every number with an interval: what is uncertain of a robot, propagated to what a scenario predicts."""

from srs_twin.uncertainty.discrepancy import Discrepancy
from srs_twin.uncertainty.priors import Prior, Priors
from srs_twin.uncertainty.propagation import Propagation, propagate
from srs_twin.uncertainty.spreads import Spread
from srs_twin.uncertainty.study import Study

__all__ = ["Discrepancy", "Prior", "Priors", "Propagation", "Spread", "Study", "propagate"]
