"""MJCF models of robots and their surroundings, and their export."""
