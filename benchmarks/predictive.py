"""Coverage of 95 % intervals for robots whose physics differs from that of the predictor.

    uv run python benchmarks/predictive.py --out runs/predictive [--robots 400]

Each robot is drawn from the priors of generation 2 and walks (offset 0.4, 2 Hz) in a
finer twin with four hinges per segment, half the time step, and chambers with orifices.
The predictor is the shipped twin. The parameters of a robot are known from its file
(prior), or are also measured to ±10 % each. The table gives the coverage by metric, and
then the effect of each single assumption.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from srs_twin.identification.priors import Priors
from srs_twin.robot.file import RobotFile
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.studies.sweep.execution import local
from srs_twin.studies.uncertainty.propagation import (
    REFERENCE_ROWS,
    Propagation,
    propagate,
)
from srs_twin.studies.uncertainty.study import UncertaintyStudy
from srs_twin.studies.uncertainty.surrogates import PolynomialChaos

FINER: dict[str, Any] = {"hinges_per_segment": 4, "timestep_s": 0.0005}
ASSUMPTIONS: dict[str, Mapping[str, Any]] = {
    "MuJoCo's friction on static loads": {"plants.twin": {"contact": "preloaded"}},
    "four hinges per segment": {"plants.twin": {"hinges_per_segment": 4}},
    "half the time step": {"plants.twin": {"timestep_s": 0.0005}},
    "orifices": {"pneumatics": {"kind": "orifice"}},
}
METRICS = {
    "speed": lambda m: m["com_speed_m_s"],
    "yaw rate": lambda m: m["yaw_rate_rad_s"],
    "curvature": lambda m: m["yaw_rate_rad_s"] / m["com_speed_m_s"],
    "amplitude": lambda m: m["mean_bend_amplitude_rad"],
}


FORMS = {"pneumatics.kind": ("lag", "orifice")}


def study(
    changes: Mapping[str, Any], samples: int, seed: int, scenario: str, duration: float
) -> UncertaintyStudy:
    """Return the runs of a scenario on the twin with other assumptions."""
    result = load_scenario(scenario, set={"duration_s": duration, **changes})
    document = {
        **result.document,
        "plants": {"twin": result.document["plants"]["twin"]},
        "expect": [],
    }
    priors = Priors.from_robot(RobotFile.model_validate(document["robot"]))
    return UncertaintyStudy(
        parse_scenario(document, name=scenario), priors, ("twin",), samples, 64, seed
    )


class Alone(UncertaintyStudy):
    """Runs of the twin without a low-fidelity plant."""

    partner = None


def held(
    predictor: Propagation, truth: Mapping[str, np.ndarray], robots: np.ndarray
) -> None:
    """Print the coverage with the priors, and with every parameter measured to ±10 %."""
    study = predictor.study
    rng = np.random.default_rng(2)
    spreads = {
        name: spread.samples for name, spread in predictor.plants["twin"].items()
    }
    fresh = study.draw(1024, 3)
    print(
        "| metric | coverage, prior | width | coverage, all to ±10 % | width | bias"
        " over spread |"
    )
    print("|---|---|---|---|---|---|")
    for metric, column_of in METRICS.items():
        column = column_of(spreads)
        true = truth[metric]
        known = np.isfinite(true)
        chaos = PolynomialChaos.fit(study.fractions, column[:, None])
        low, high = np.quantile(column, [0.025, 0.975])
        wide = (low <= true[known]) & (true[known] <= high)
        narrow = []
        widths = []
        for robot, value in zip(robots[known], true[known], strict=True):
            after = fresh.copy()
            for i, (prior, number) in enumerate(
                zip(study.priors.parameters, robot, strict=True)
            ):
                sd = 0.1 / 1.96 * abs(float(number))
                measurement = prior.with_measurement(
                    float(number) + sd * float(rng.standard_normal()), sd
                ).quantile(fresh[:, i])
                after[:, i] = prior.cdf(measurement)
            drawn = chaos.at(after)[:, 0] + rng.choice(
                chaos.residuals[:, 0], len(fresh)
            )
            a, b = np.quantile(drawn, [0.025, 0.975])
            narrow.append(a <= value <= b)
            widths.append(b - a)
        bias = (np.median(true[known]) - np.median(column)) / _spread(column)
        cells = (
            metric,
            _fraction(wide),
            f"{high - low:.3g}",
            _fraction(narrow),
            f"{np.mean(widths):.3g}",
            f"{bias:+.2f}",
        )
        print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Run the robots, count covered values and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs/predictive"))
    parser.add_argument("--robots", type=int, default=400)
    parser.add_argument(
        "--few", type=int, default=64, help="robots for each single assumption"
    )
    parser.add_argument("--scenario", default="gen2_turn")
    parser.add_argument("--duration", type=float, default=5.0)
    parser.add_argument(
        "--forms", action="store_true", help="also use a predictor with both models"
    )
    options = parser.parse_args()

    def made(changes: Mapping[str, Any], samples: int, seed: int) -> UncertaintyStudy:
        return study(changes, samples, seed, options.scenario, options.duration)

    def ran(
        name: str, changes: Mapping[str, Any], samples: int
    ) -> dict[str, np.ndarray]:
        result = made(changes, samples, 1)
        alone = Alone(result.scenario, result.priors, ("twin",), samples, samples, 1)
        rows = propagate(alone, options.out / name.replace(" ", "_"), local()).rows[
            "twin"
        ]
        return {
            metric: np.asarray(column_of(rows))[:-REFERENCE_ROWS]
            for metric, column_of in METRICS.items()
        }

    same = ran("same_chambers", {"plants.twin": FINER}, options.robots)
    truth = ran(
        "truth",
        {"plants.twin": FINER, "pneumatics": {"kind": "orifice"}},
        options.robots,
    )
    shipped = made({}, 2048, 0)
    drawn = made({}, options.robots, 1)
    robots = drawn.priors.quantile(drawn.fractions)
    result = propagate(shipped, options.out / "shipped", local())
    print("Robots with the chamber model of the predictor")
    held(result, same, robots)
    print("\nRobots with orifices, predictor as shipped")
    held(result, truth, robots)
    if options.forms:
        print(
            "\nRobots with orifices, predictor with --model-form pneumatics.kind=lag,orifice"
        )
        held(
            propagate(
                replace(shipped, discrete_choices=FORMS), options.out / "forms", local()
            ),
            truth,
            robots,
        )
    spreads = {name: spread.samples for name, spread in result.plants["twin"].items()}
    print(
        "\n| assumption alone, median change over spread | "
        + " | ".join(METRICS)
        + " |\n|"
        + "---|" * 5
    )
    reference: dict[str, np.ndarray] | None = None
    for name, changes in {"as shipped": {}, **ASSUMPTIONS}.items():
        rows = ran(name, changes, options.few)
        reference = reference or rows
        moved = [
            np.nanmedian(rows[m] - reference[m]) / _spread(column_of(spreads))
            for m, column_of in METRICS.items()
        ]
        print(
            f"| {name} | " + " | ".join(f"{item:+.2f}" for item in moved) + " |",
            flush=True,
        )


def _spread(values: np.ndarray) -> float:
    """Return half the width of the central two thirds, because the curvature of slow robots is unbounded."""
    low, high = np.nanquantile(values, (0.16, 0.84))
    return float(high - low) / 2


def _fraction(held: Any) -> str:
    ends = binomtest(int(np.sum(held)), len(held)).proportion_ci(0.95, "exact")
    return (
        f"{100 * np.mean(held):.1f} % ({100 * ends.low:.0f} to {100 * ends.high:.0f})"
    )


if __name__ == "__main__":
    main()
