"""Recordings, plots, images and reports of runs."""
