"""MJCF models of robots and their surroundings, and export of these models."""
