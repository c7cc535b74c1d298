"""Simulated snakes. The analytical model and the MuJoCo twin implement `Plant`."""
