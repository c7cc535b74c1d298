"""Optimisation of robot designs and gaits with two simulation models."""
