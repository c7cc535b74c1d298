"""Simulated snakes, which share the interface `Plant`."""
