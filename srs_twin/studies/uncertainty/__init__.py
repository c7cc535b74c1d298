"""Uncertainty of predictions: propagation of a robot's uncertain parameters to the metrics of a scenario."""
