"""Studies with many runs: sweeps, uncertainty and optimisation."""
