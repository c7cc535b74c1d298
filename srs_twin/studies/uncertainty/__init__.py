"""Uncertainty of predictions: propagation of a robot's uncertain parameters to the metrics of a scenario."""

from srs_twin.studies.uncertainty.discrepancy import Discrepancy
from srs_twin.studies.uncertainty.metric_uncertainty import MetricUncertainty
from srs_twin.studies.uncertainty.priors import Prior, Priors
from srs_twin.studies.uncertainty.propagation import Propagation, propagate
from srs_twin.studies.uncertainty.study import UncertaintyStudy

__all__ = [
    "Discrepancy",
    "MetricUncertainty",
    "Prior",
    "Priors",
    "Propagation",
    "UncertaintyStudy",
    "propagate",
]
