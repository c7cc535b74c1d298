"""The width of generation 4's body from Table 8's boxes at 0 and ±0.3, predicting those at ±0.1 and ±0.2.

    uv run python benchmarks/table8_width.py

Takes what the plant reaches from the fit to speeds and radii (benchmarks/table8_fit.py), which must be there,
and writes calibration/fits/gen4_table8_width.yaml. A body has one width: the analytical plant finds it.
"""

from __future__ import annotations

import sys
from pathlib import Path

from grid import table
from table8_fit import place

from srs_twin import load_robot
from srs_twin.identification.fit_file import FitFile, fit_file, load_fit, write_fit
from srs_twin.scenario.provenance import versions

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from box_edges import WIDTH, BoxEdges, fit_width

PLANT = "analytical"


def main() -> None:
    """Fit, write and show."""
    file = fit()
    print(write_fit(file, place("width")))
    print(file.estimate().text())
    print("\n" + edges_table(file))


def edges(fitted: FitFile, role: str) -> list[BoxEdges]:
    """Return the runs of a role, as a fit to speeds and radii holds them."""
    found = []
    for each in fitted.data:
        if each.role == role:
            assert each.measured is not None and each.predicted is not None, "the fit holds what it predicts"
            measured, drawn = ((-told["left_m"], told["right_m"]) for told in (each.measured, each.predicted))
            found.append(BoxEdges(float(each.name.removeprefix("offset ")), measured, drawn))
    return found


def fit() -> FitFile:
    """Fit the width to three rows and predict all."""
    moves, spec = load_fit(place(PLANT)), load_robot("gen4")
    fitted, kept = edges(moves, "fit"), edges(moves, "validation")
    found = fit_width(fitted, spec, validation=kept)
    change = found.values[WIDTH] - spec.geometry.width
    return fit_file(
        found, name="gen4_table8_width", title="Generation 4's width from Table 8's boxes at 0 and ±0.3",
        robot="gen4", method="edges", command="uv run python benchmarks/table8_width.py", versions=versions(),
        data=[each.data_set("fit") for each in fitted] + [each.data_set("validation") for each in kept],
        averages={
            f"offset {each.offset:g}": (_named(*each.measured), _named(*each.of_width(change)))
            for each in [*fitted, *kept]
        },
    )  # fmt: skip


def _named(left: float, right: float) -> dict[str, float]:
    return {"left_m": -left, "right_m": right}


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
