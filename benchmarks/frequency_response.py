"""Closed-loop frequency response of a module with both controllers, with its scatter (Fig. 44).

    uv run python benchmarks/frequency_response.py [--results DIR] [--out
    docs/images/frequency_response.png]

Runs the shipped sweeps fig44_direct and fig44_iterative (some minutes; existing rows
are kept), plots amplitude and phase lag for both controllers on both benches, and
prints them as a table. Error bars are one standard deviation over the periods of a run
and the draws of the sensor noise.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from common.grid import table
from matplotlib.figure import Figure

from srs_twin.studies.sweep.execution import local, open_sweep
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.viewing.plots.style import finish, save

FREQUENCY = "controller.reference.frequency_hz"
CONTROLLERS = {"direct": "#0072B2", "iterative": "#D55E00"}
PLANTS = {"analytical": ("--", "s"), "twin": ("-", "o")}
SHOWN = {
    "amplitude_rel": "amplitude relative to the reference",
    "phase_lag_rad": "phase lag (rad)",
}
SPREAD = {
    "amplitude_rel": "amplitude_spread_rel",
    "phase_lag_rad": "phase_lag_spread_rad",
}

Columns = Mapping[str, np.ndarray]


def results(controller: str, folder: Path) -> Columns:
    """Return the columns of the sweep, after running its missing rows."""
    name = f"fig44_{controller}"
    with open_sweep(load_sweep(name), folder / name) as opened:
        opened.run(local(None), opened.missing())
        opened.finish()
    read = pq.read_table(folder / name / "results.parquet")
    return {
        column: read.column(column).to_numpy(zero_copy_only=False)
        for column in read.column_names
    }


def response(
    columns: Columns, plant: str, metric: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frequencies (Hz), means over the draws, and standard deviations over periods and draws."""
    frequencies = np.unique(columns[FREQUENCY])
    means = []
    deviations = []
    for frequency in frequencies:
        rows = columns[FREQUENCY] == frequency
        values = columns[f"{plant}.{metric}"][rows]
        within = columns[f"{plant}.{SPREAD[metric]}"][rows]
        means.append(values.mean())
        deviations.append(np.sqrt(np.mean(within**2) + values.var()))
    return frequencies, np.array(means), np.array(deviations)


def draw(result: Mapping[str, Columns]) -> Figure:
    """Plot amplitude and phase lag over frequency; return the figure."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axes, (metric, label) in zip(figure.subplots(1, 2), SHOWN.items(), strict=True):
        for controller, columns in result.items():
            for plant, (dash, marker) in PLANTS.items():
                frequency, mean, deviation = response(columns, plant, metric)
                axes.errorbar(
                    frequency,
                    mean,
                    deviation,
                    color=CONTROLLERS[controller],
                    linestyle=dash,
                    marker=marker,
                    markersize=4,
                    linewidth=1.3,
                    capsize=3,
                    label=f"{controller} SMC, {plant}",
                    markerfacecolor="none" if plant == "analytical" else None,
                )
        axes.set_xscale("log")
        axes.set_xticks(frequency, [f"{item:g}" for item in frequency])
        axes.minorticks_off()
        axes.set_xlabel("frequency (Hz)", fontsize=9)
        finish(axes, label)
    axes.legend(fontsize=8, frameon=False, loc="upper left")
    figure.suptitle(
        "A sine of 34.3°: closed-loop frequency response",
        x=0.01,
        ha="left",
        fontsize=10,
    )
    return figure


def report(result: Mapping[str, Columns]) -> str:
    """Return the table: mean ± standard deviation."""
    frequencies = response(result["direct"], "twin", "amplitude_rel")[0]
    rows = []
    for controller, columns in result.items():
        for plant in PLANTS:
            for metric, label in SHOWN.items():
                _, mean, deviation = response(columns, plant, metric)
                cells = [
                    f"{m:.3f} ± {d:.3f}" for m, d in zip(mean, deviation, strict=True)
                ]
                rows.append([controller, plant, label, *cells])
    return table(["SMC", "bench", "", *(f"{item:g} Hz" for item in frequencies)], rows)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument(
        "--results",
        type=Path,
        default=Path("runs/sweeps"),
        help="folder for the sweeps",
    )
    arguments.add_argument(
        "--out", type=Path, help="output file of the figure, .png or .svg"
    )
    options = arguments.parse_args()
    result = {
        controller: results(controller, options.results) for controller in CONTROLLERS
    }
    if options.out is not None:
        save(draw(result), options.out)
    print(report(result))


if __name__ == "__main__":
    main()
