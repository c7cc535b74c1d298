"""Plants: the analytical model and the MuJoCo twin, with a common interface."""
