"""Curvature sensor by distance, orientation and heights, compared with Fig. 13 and 14 of the dissertation.

    uv run python benchmarks/sensor.py [--out sensor.png]

The strip is that of generation 4. Range is the difference of the fields at ±90°. R² and
largest error are those of a straight line from field (or voltage) to angle.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from common.grid import table

from srs_twin.sensing.hall import (
    GAUSS,
    ORIENTATIONS,
    HallSensor,
    Strip,
    calibrate,
    field,
    fit_line,
)

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from sensor_strips import BENDS, LENGTH, MM, line, of_cylinder, reach, strip

DISTANCES = (3.1, 3.4, 3.7, 4.0, 4.3, 4.6)  # mm
HEIGHTS = (
    (0.25, 0.25),
    (0.45, 0.45),
    (0.45, 0.7),
    (0.7, 0.7),
    (0.45, 0.9),
    (0.85, 0.7),
)  # h_m, h_s, mm


def cell(geometry: Strip) -> str:
    result = line(geometry)
    turns = "" if result.monotonic else ", not monotonic"
    return (
        f"{reach(geometry):.2f}, {result.r_squared:.4f},"
        f" {np.degrees(result.worst_error):.1f}{turns}"
    )


def by_distance() -> None:
    """Print the table for Fig. 13d and e."""
    rows = [
        [f"{h[0]:g}, {h[1]:g}", o, *(cell(strip(d, h, o)) for d in DISTANCES)]
        for h in HEIGHTS
        for o in ORIENTATIONS
    ]
    head = [
        "h_m, h_s mm",
        "north",
        *(f"L = {d:g} mm: range G, R², worst °" for d in DISTANCES),
    ]
    print(table(head, rows), flush=True)


def over_heights() -> None:
    """Print the number of height pairs for which north up gives the larger range or R²."""
    heights = np.linspace(-0.95, 0.95, 20)
    wider = []
    straighter = []
    for pair in itertools.product(heights, heights):
        pairs = [[strip(d, pair, o) for o in ORIENTATIONS] for d in (3.1, 3.85, 4.6)]
        wider.append([reach(up) > reach(side) for up, side in pairs])
        straighter.append(
            [line(up).r_squared > line(side).r_squared for up, side in pairs]
        )
    rows = [
        [
            name,
            *(f"{n}" for n in np.sum(result, axis=0)),
            f"{np.all(result, axis=1).sum()}",
        ]
        for name, result in (("wider range", wider), ("higher R²", straighter))
    ]
    head = [
        f"north up has, of {len(wider)} pairs",
        "L = 3.1 mm",
        "3.85 mm",
        "4.6 mm",
        "all three",
    ]
    print("\n" + table(head, rows), flush=True)


def by_reading() -> None:
    """Print the results of Eq. 1 if θ is the local angle, and if L alone bends by the whole angle."""
    rows = [
        [
            name,
            o,
            *(
                cell(strip(d, (0.45, 0.7), o, d * MM if whole else LENGTH))
                for d in (3.1, 4.6)
            ),
        ]
        for name, whole in (("θ = κL", False), ("θ = q", True))
        for o in ORIENTATIONS
    ]
    print(
        "\n" + table(["reading", "north", "L = 3.1 mm", "L = 4.6 mm"], rows), flush=True
    )


def dipole_or_cylinder() -> None:
    """Print the error of the point dipole."""
    rows = []
    for distance in (3.1, 4.6):
        for orientation in ORIENTATIONS:
            geometry = strip(distance, (0.45, 0.7), orientation)
            point, body = (
                fit_line(b / GAUSS, BENDS)
                for b in (field(BENDS, geometry), of_cylinder(geometry))
            )
            spans = [
                abs(b[-1] - b[0]) / GAUSS
                for b in (field(BENDS, geometry), of_cylinder(geometry))
            ]
            rows.append(
                [f"{distance:g} mm, {orientation}"]
                + [
                    f"{s:.2f}, {f.r_squared:.4f}"
                    for s, f in zip(spans, (point, body), strict=True)
                ]
            )
    print("\n" + table(["", "dipole: range G, R²", "cylinder"], rows), flush=True)


def sensors() -> dict[str, HallSensor]:
    """Return the sensor of generation 4 with either chamber and the same electronics."""
    semicircular = HallSensor.trimmed(Strip(LENGTH))
    rectangular = replace(
        semicircular, strip=replace(semicircular.strip, chamber="rectangular")
    )
    return {"semicircular": semicircular, "rectangular": rectangular}


def by_chamber() -> None:
    """Print the calibrations for Fig. 14e."""
    rows = []
    for name, sensor in sensors().items():
        result = calibrate(sensor)
        smooth = replace(sensor, bits=None).voltage(BENDS)
        back = np.degrees(BENDS[1:][np.diff(smooth) > 0])
        per_volt = np.degrees(abs(result.slope))
        rows.append(
            [
                name,
                f"{result.voltage_range[0]:.2f} to {result.voltage_range[1]:.2f}",
                f"{result.r_squared:.4f}",
                f"{np.degrees(result.worst_error):.1f}",
                f"{back.min():.0f} to {back.max():.0f}" if len(back) else "–",
                f"{per_volt * sensor.gain * sensor.noise:.2f}",
                f"{per_volt * sensor.step:.2f}",
            ]
        )
    angles = [
        "largest error, °",
        "not monotonic, °",
        "noise RMS, °",
        "quantisation step, °",
    ]
    head = ["chamber", "V", "R²", *angles]
    print("\n" + table(head, rows), flush=True)


def draw(path: Path) -> None:
    """Plot the results of Fig. 13c to e and 14e."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7.5), layout="constrained")
    (one, two), (three, four) = figure.subplots(2, 2)
    degrees = np.degrees(BENDS)
    one.plot(
        degrees, field(BENDS, Strip(LENGTH)) / GAUSS, color="tab:blue", label="dipole"
    )
    fit = np.polyval(np.polyfit(BENDS, field(BENDS, Strip(LENGTH)), 1), BENDS)
    one.plot(degrees, fit / GAUSS, "--", color="tab:red", label="line")
    one.set(
        title="Field, L = 3.1 mm, north up (Fig. 13c)",
        xlabel="bend, °",
        ylabel="B_n, G",
    )
    one.legend()
    distances = np.linspace(3.1, 4.6, 16)
    for orientation, color in zip(ORIENTATIONS, ("tab:blue", "tab:red"), strict=True):
        for heights, dashes in (
            ((0.45, 0.7), "-"),
            ((0.45, 0.45), "--"),
            ((0.45, 0.9), ":"),
        ):
            strips = [strip(d, heights, orientation) for d in distances]
            label = f"{orientation}, h_s {heights[1]:g} mm"
            two.plot(
                distances, [reach(s) for s in strips], dashes, color=color, label=label
            )
            three.plot(
                distances,
                [line(s).r_squared for s in strips],
                dashes,
                color=color,
                label=label,
            )
    two.set(
        title="Range over ±90°, h_m 0.45 mm (Fig. 13d)",
        xlabel="L, mm",
        ylabel="G",
        ylim=(0, None),
    )
    three.set(title="Linearity (Fig. 13e)", xlabel="L, mm", ylabel="R² of a line")
    two.legend(fontsize=8)
    for name, sensor in sensors().items():
        read = four.plot(degrees, sensor.voltage(BENDS), label=name)[0]
        result = calibrate(sensor)
        fit = (BENDS - result.intercept) / result.slope
        four.plot(
            degrees,
            fit,
            "--",
            color=read.get_color(),
            linewidth=0.8,
            label=f"{name}, calibration",
        )
    four.set(
        title="Reading with either chamber (Fig. 14e)", xlabel="bend, °", ylabel="V"
    )
    four.legend(fontsize=8)
    for axes in (one, two, three, four):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Print the tables and write the figure."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument(
        "--out", type=Path, help="output file of the figure (png, svg, pdf)"
    )
    out = arguments.parse_args().out
    by_distance()
    over_heights()
    by_reading()
    dipole_or_cylinder()
    by_chamber()
    if out is not None:
        draw(out)


if __name__ == "__main__":
    main()
