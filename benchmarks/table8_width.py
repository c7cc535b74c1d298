"""Width of generation 4 fitted to the edges in Table 8 at offsets 0 and ±0.3, validated at ±0.1 and ±0.2.

    uv run python benchmarks/table8_width.py [--show]

The lateral reach of the plant is taken from the fit to speeds and radii
(`table8_fit.py`), which must exist. The result is written to
calibration/fits/gen4_table8_width.yaml. The width is a property of the body, so only
the analytical plant is used.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from grid import table

from srs_twin.identification.fit_file import FitFile, load_fit, write_fit

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from table8 import fit_body_width, place


def main() -> None:
    """Fit and write, or show the written fit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--show", action="store_true", help="show the written fit, without fitting"
    )
    if parser.parse_args().show:
        file = load_fit(place("width"))
    else:
        file = fit_body_width()
        print(write_fit(file, place("width")))
    print(file.estimate().text())
    print("\n" + edges_table(file))


def edges_table(file: FitFile) -> str:
    """Return the measured and predicted edges of each row."""
    rows = []
    for item in sorted(
        file.data, key=lambda item: float(item.name.removeprefix("offset "))
    ):
        cells = []
        for side in ("left_m", "right_m"):
            prediction = item.predicted[side]
            seen = item.measured[side]
            cells += [
                f"{seen:g}",
                f"{prediction:.3f} ({100 * (prediction / seen - 1):+.0f} %)",
            ]
        rows.append(
            [
                item.name.removeprefix("offset "),
                "fit" if item.role == "fit" else "predicted",
                *cells,
            ]
        )
    sides = [
        f"{side} edge: {whose}"
        for side in ("left", "right")
        for whose in ("Table 8 (m)", "fit")
    ]
    return table(["offset", "row", *sides], rows)


if __name__ == "__main__":
    main()
