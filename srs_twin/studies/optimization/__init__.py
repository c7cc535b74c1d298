"""Optimisation of robot designs and gaits with the fidelities `compliant` and twin."""
