"""Run a sweep over frequency and stiffness, and pivot its table with pandas.

python examples/sweep_with_pandas.py
"""

from pathlib import Path

import pandas as pd

import srs_twin as srs

SWEEP = Path(__file__).with_name("sweep.yaml")


def main() -> None:
    """Print the speeds of both plants, and the difference between them."""
    swept = srs.sweep(SWEEP, workers=1)
    table = pd.DataFrame(dict(swept.results.columns))
    table = table.rename(
        columns={
            "controller.frequency_hz": "Hz",
            "robot.bending.stiffness_nm_per_rad": "N m/rad",
        }
    )
    for column in ("analytical.com_speed_m_s", "twin.com_speed_m_s"):
        print(f"{column}, mm/s")
        print(
            (1e3 * table.pivot(index="Hz", columns="N m/rad", values=column)).round(1)
        )
    largest = table["comparison.com_speed_rel"].abs().max()
    print(f"{swept.done} points; the plants differ by at most {100 * largest:.0f} %")


if __name__ == "__main__":
    main()
