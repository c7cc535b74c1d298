"""The width of generation 4's body from Table 8's boxes at 0 and ±0.3, predicting those at ±0.1 and ±0.2.

    uv run python benchmarks/table8_width.py

Takes what the plant reaches from the fit to speeds and radii (benchmarks/table8_fit.py), which must be there,
and writes calibration/fits/gen4_table8_width.yaml. A body has one width: the analytical plant finds it.
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
    parser.add_argument("--show", action="store_true", help="show the written fit, without fitting")
    if parser.parse_args().show:
        file = load_fit(place("width"))
    else:
        file = fit_body_width()
        print(write_fit(file, place("width")))
    print(file.estimate().text())
    print("\n" + edges_table(file))


def edges_table(file: FitFile) -> str:
    """Return each row's edges beside the predicted ones."""
    rows = []
    for each in sorted(file.data, key=lambda each: float(each.name.removeprefix("offset "))):
        cells = []
        for side in ("left_m", "right_m"):
            told, seen = each.predicted[side], each.measured[side]
            cells += [f"{seen:g}", f"{told:.3f} ({100 * (told / seen - 1):+.0f} %)"]
        rows.append([each.name.removeprefix("offset "), "fit" if each.role == "fit" else "predicted", *cells])
    sides = [f"{side} edge: {whose}" for side in ("left", "right") for whose in ("Table 8 (m)", "fit")]
    return table(["offset", "row", *sides], rows)


if __name__ == "__main__":
    main()
