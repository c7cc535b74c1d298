"""Studies over many runs: sweeps, uncertainty, optimisation."""
