"""Optimisation of robot designs and gaits with the compliant model and the twin."""
