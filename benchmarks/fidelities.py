"""Interval ends from 64 runs of the twin and a low-fidelity plant, compared with 2,048 runs of the twin.

    uv run python benchmarks/fidelities.py --out runs/fidelities [--samples 2048]

Ten sets of 64 samples are taken from the same sequence. The table has one row per
metric: the correlation of the two fidelities, the worse interval end of each set
relative to the width of the interval, the number of sets within 5 %, and the number of
ends within two stated standard errors.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from srs_twin.identification.priors import Priors
from srs_twin.robot.file import RobotFile
from srs_twin.scenario.loading import load_scenario
from srs_twin.studies.sweep.execution import local
from srs_twin.studies.uncertainty.metric_uncertainty import (
    predict_twin,
    sampling_errors,
)
from srs_twin.studies.uncertainty.propagation import REFERENCE_ROWS, propagate
from srs_twin.studies.uncertainty.study import UncertaintyStudy

FEW = 64
SETS = 10
ENDS = [0.025, 0.975]


def main() -> None:
    """Run both plants, compare the interval ends and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs/fidelities"))
    parser.add_argument("--scenario", default="gen2_straight")
    parser.add_argument("--duration", type=float, default=5.0)
    parser.add_argument("--samples", type=int, default=2048)
    options = parser.parse_args()
    scenario = load_scenario(options.scenario, set={"duration_s": options.duration})
    priors = Priors.from_robot(RobotFile.model_validate(scenario.document["robot"]))
    study = UncertaintyStudy(
        scenario, priors, ("twin",), options.samples, options.samples
    )
    rows = propagate(study, options.out, local()).rows
    print(
        "| metric | correlation | worse end of each set, % of the width | within 5 % |"
        " within 2 s.e. |"
    )
    print("|---|---|---|---|---|")
    for metric, plain in rows["twin"].items():
        cheap = rows["compliant"][metric][:-REFERENCE_ROWS]
        costly = plain[:-REFERENCE_ROWS]
        if not np.isfinite(costly).all() or np.std(costly) < 1e-9 * abs(
            np.mean(costly)
        ):
            continue
        full = np.quantile(costly, ENDS)
        width = np.ptp(full)
        worst = []
        held = []
        for first in range(
            0, options.samples - FEW + 1, max(FEW, options.samples // SETS // FEW * FEW)
        )[:SETS]:
            order = np.r_[first : first + FEW, 0:first, first + FEW : options.samples]
            samples, surrogate = predict_twin(
                study.fractions[order], cheap[order], costly[order][:FEW]
            )
            errors = np.hypot(sampling_errors(samples), surrogate)
            deviation = np.nanquantile(samples, ENDS) - full
            worst.append(np.abs(deviation).max() / width)
            held += list(np.abs(deviation) < 2 * errors[2:])
        shown = " ".join(f"{100 * item:.1f}" for item in worst)
        near = f"{sum(item < 0.05 for item in worst)} of {len(worst)}"
        same = np.corrcoef(cheap, costly)[0, 1]
        print(
            f"| {metric} | {same:.3f} | {shown} | {near} |"
            f" {100 * np.mean(held):.0f} % |",
            flush=True,
        )


if __name__ == "__main__":
    main()
