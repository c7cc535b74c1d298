"""Ends of intervals from 64 runs of the twin and its cheap partner, against those of 2,048 runs of the twin.

    uv run python benchmarks/fidelities.py --out runs/fidelities [--samples 2048]

Ten sets of 64 samples, each a part of the same sequence. A row a metric: correlation of the two fidelities,
the worse end of each set as a share of the interval's width, how many sets are within 5 %, and how many ends
are within two of their stated standard errors.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from srs_twin.robot.file import RobotFile
from srs_twin.robot.priors import Priors
from srs_twin.scenario.loading import load_scenario
from srs_twin.studies.sweep.execution import local
from srs_twin.studies.uncertainty.propagation import OWN_ROWS, propagate
from srs_twin.studies.uncertainty.spreads import predicted, sampling_errors
from srs_twin.studies.uncertainty.study import Study

FEW, SETS = 64, 10
ENDS = [0.025, 0.975]


def main() -> None:
    """Run, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs/fidelities"))
    parser.add_argument("--scenario", default="gen2_straight")
    parser.add_argument("--duration", type=float, default=5.0)
    parser.add_argument("--samples", type=int, default=2048)
    given = parser.parse_args()
    scenario = load_scenario(given.scenario, set={"duration_s": given.duration})
    priors = Priors.of(RobotFile.model_validate(scenario.document["robot"]))
    study = Study(scenario, priors, ("twin",), given.samples, given.samples)
    rows = propagate(study, given.out, local()).rows
    print("| metric | correlation | worse end of each set, % of the width | within 5 % | within 2 s.e. |")
    print("|---|---|---|---|---|")
    for metric, plain in rows["twin"].items():
        cheap, costly = rows["compliant"][metric][:-OWN_ROWS], plain[:-OWN_ROWS]
        if not np.isfinite(costly).all() or np.std(costly) < 1e-9 * abs(np.mean(costly)):
            continue
        full = np.quantile(costly, ENDS)
        width, worst, held = np.ptp(full), [], []
        for first in range(0, given.samples - FEW + 1, max(FEW, given.samples // SETS // FEW * FEW))[:SETS]:
            order = np.r_[first : first + FEW, 0:first, first + FEW : given.samples]
            samples, surrogate = predicted(study.shares[order], cheap[order], costly[order][:FEW])
            errors = np.hypot(sampling_errors(samples), surrogate)
            off = np.nanquantile(samples, ENDS) - full
            worst.append(np.abs(off).max() / width)
            held += list(np.abs(off) < 2 * errors[2:])
        shown = " ".join(f"{100 * each:.1f}" for each in worst)
        near = f"{sum(each < 0.05 for each in worst)} of {len(worst)}"
        same = np.corrcoef(cheap, costly)[0, 1]
        print(f"| {metric} | {same:.3f} | {shown} | {near} | {100 * np.mean(held):.0f} % |", flush=True)


if __name__ == "__main__":
    main()
