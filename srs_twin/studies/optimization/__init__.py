"""Optimisation of robot designs and gaits with two fidelities, `compliant` and the twin."""
