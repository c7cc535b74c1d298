"""Recordings of robots as trajectories: file formats, body shape from markers, logs, and clocks."""
