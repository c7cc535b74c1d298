"""Studies that perform many runs: sweeps, uncertainty analysis and optimisation."""
