"""Recordings, plots, images and reports of simulation runs."""
