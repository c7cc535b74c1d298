"""Identification of robot parameters from simulations, measurements and recordings."""
