"""Sweeps: one scenario over many values of its fields, rows that survive whatever happens to the process."""
