"""Simulated snakes: the analytical model and the MuJoCo twin share one interface."""
