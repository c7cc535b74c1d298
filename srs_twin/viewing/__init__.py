"""Recordings, plots and reports of finished runs."""
