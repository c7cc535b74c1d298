"""Clocks, units, gaps and logs of recordings."""
