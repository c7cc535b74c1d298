"""Fit the friction of the wheels to a table of pulls in a CSV file.

    python examples/fit_from_csv.py [FILE.csv]

A spring scale pulls the robot until it begins to slide, ahead and sideways. The table
has the deflection of the spring at that moment. Without a file, the script writes a
table of a robot with known coefficients, so that the fit can be checked.
"""

import csv
import sys
import tempfile
from pathlib import Path

import numpy as np

import srs_twin as srs

MU = (0.05, 0.45)
"""Coefficients of the simulated pulls: ahead and sideways."""
MASS_KG, SPRING_N_PER_M = 0.15, 30.0


def write_pulls(path: Path, pulls: int = 8) -> None:
    """Write a table of pulls whose deflections scatter by 3 %."""
    rng = np.random.default_rng(0)
    exact = 1e3 * np.array(MU) * MASS_KG * 9.81 / SPRING_N_PER_M
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["along_mm", "across_mm", "spring_n_per_m", "mass_kg"])
        for deflections in exact * rng.normal(1.0, 0.03, (pulls, 2)):
            rows.writerow([*deflections.round(2), SPRING_N_PER_M, MASS_KG])


def main() -> None:
    """Print the coefficients with their intervals, and the speed with them."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(sys.argv[1] if len(sys.argv) > 1 else f"{folder}/pulls.csv")
        if len(sys.argv) == 1:
            write_pulls(path)
        fit = srs.calibrate_friction([path], "gen2")
    changes = {}
    for parameter in fit.estimate.parameters:
        print(
            f"{parameter.name} = {parameter.value:.4f}"
            f" (95 % interval {parameter.low:.4f} to {parameter.high:.4f})"
        )
        changes[f"robot.{parameter.name}"] = parameter.value
    print(srs.compare("gen2_straight", set={"duration_s": 4} | changes))


if __name__ == "__main__":
    main()
