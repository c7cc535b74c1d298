"""Do 95 % intervals hold robots whose physics is another than the predictor's?

    uv run python benchmarks/predictive.py --out runs/predictive [--robots 400]

A robot is drawn from the priors of generation 2 and walks (offset 0.4, 2 Hz) as the finer twin has it: four
hinges a segment, half of the step, chambers behind orifices. The predictor is the
twin as shipped. A robot is known as its file says (prior), or with each number measured to ±10 % besides.
The table counts intervals that hold, a metric at a time; then what each assumption alone changes.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from srs_twin.robot.file import RobotFile
from srs_twin.robot.priors import Priors
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.studies.sweep.execution import local
from srs_twin.studies.uncertainty.propagation import OWN_ROWS, Propagation, propagate
from srs_twin.studies.uncertainty.study import Study
from srs_twin.studies.uncertainty.surrogates import Chaos

FINER: dict[str, Any] = {"hinges_per_segment": 4, "timestep_s": 0.0005}
ASSUMPTIONS: dict[str, Mapping[str, Any]] = {
    "MuJoCo's friction on static loads": {"plants.twin": {"contact": "preloaded"}},
    "four hinges a segment": {"plants.twin": {"hinges_per_segment": 4}},
    "half of the step": {"plants.twin": {"timestep_s": 0.0005}},
    "orifices": {"pneumatics": {"kind": "orifice"}},
}
METRICS = {
    "speed": lambda m: m["com_speed_m_s"],
    "yaw rate": lambda m: m["yaw_rate_rad_s"],
    "curvature": lambda m: m["yaw_rate_rad_s"] / m["com_speed_m_s"],
    "amplitude": lambda m: m["mean_bend_amplitude_rad"],
}


FORMS = {"pneumatics.kind": ("lag", "orifice")}


def study(changes: Mapping[str, Any], samples: int, seed: int, scenario: str, duration: float) -> Study:
    """Return the twin's runs of a scenario with other assumptions."""
    found = load_scenario(scenario, set={"duration_s": duration, **changes})
    document = {**found.document, "plants": {"twin": found.document["plants"]["twin"]}, "expect": []}
    priors = Priors.of(RobotFile.model_validate(document["robot"]))
    return Study(parse_scenario(document, name=scenario), priors, ("twin",), samples, 64, seed)


class Alone(Study):
    """Runs of the twin that have no cheap partner."""

    partner = None


def held(predictor: Propagation, truth: Mapping[str, np.ndarray], robots: np.ndarray) -> None:
    """Print how many intervals hold, from what the file says and with every number measured to ±10 %."""
    study, rng = predictor.study, np.random.default_rng(2)
    spreads = {name: spread.samples for name, spread in predictor.plants["twin"].items()}
    fresh = study.draw(1024, 3)
    print("| metric | prior holds | width | all to ±10 % holds | width | bias over spread |")
    print("|---|---|---|---|---|---|")
    for metric, of in METRICS.items():
        column, true = of(spreads), truth[metric]
        known = np.isfinite(true)
        chaos = Chaos.fit(study.shares, column[:, None])
        low, high = np.quantile(column, [0.025, 0.975])
        wide, narrow, widths = (low <= true[known]) & (true[known] <= high), [], []
        for robot, value in zip(robots[known], true[known], strict=True):
            after = fresh.copy()
            for i, (prior, number) in enumerate(zip(study.priors.each, robot, strict=True)):
                sd = 0.1 / 1.96 * abs(float(number))
                said = prior.measured(float(number) + sd * float(rng.standard_normal()), sd).at(fresh[:, i])
                after[:, i] = prior.shares_of(said)
            drawn = chaos.at(after)[:, 0] + rng.choice(chaos.rest[:, 0], len(fresh))
            a, b = np.quantile(drawn, [0.025, 0.975])
            narrow.append(a <= value <= b)
            widths.append(b - a)
        bias = (np.median(true[known]) - np.median(column)) / _spread(column)
        cells = (
            metric,
            _share(wide),
            f"{high - low:.3g}",
            _share(narrow),
            f"{np.mean(widths):.3g}",
            f"{bias:+.2f}",
        )
        print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Run, count, print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs/predictive"))
    parser.add_argument("--robots", type=int, default=400)
    parser.add_argument("--few", type=int, default=64, help="robots for each assumption alone")
    parser.add_argument("--scenario", default="gen2_turn")
    parser.add_argument("--duration", type=float, default=5.0)
    parser.add_argument("--forms", action="store_true", help="also a predictor that knows both models")
    given = parser.parse_args()

    def made(changes: Mapping[str, Any], samples: int, seed: int) -> Study:
        return study(changes, samples, seed, given.scenario, given.duration)

    def ran(name: str, changes: Mapping[str, Any], samples: int) -> dict[str, np.ndarray]:
        found = made(changes, samples, 1)
        alone = Alone(found.scenario, found.priors, ("twin",), samples, samples, 1)
        rows = propagate(alone, given.out / name.replace(" ", "_"), local()).rows["twin"]
        return {metric: np.asarray(of(rows))[:-OWN_ROWS] for metric, of in METRICS.items()}

    same = ran("same_chambers", {"plants.twin": FINER}, given.robots)
    truth = ran("truth", {"plants.twin": FINER, "pneumatics": {"kind": "orifice"}}, given.robots)
    shipped, drawn = made({}, 2048, 0), made({}, given.robots, 1)
    robots = drawn.priors.at(drawn.shares)
    found = propagate(shipped, given.out / "shipped", local())
    print("Robots with the predictor's model of the chambers")
    held(found, same, robots)
    print("\nRobots with orifices, predictor as shipped")
    held(found, truth, robots)
    if given.forms:
        print("\nRobots with orifices, predictor with --form pneumatics.kind=lag,orifice")
        held(propagate(replace(shipped, forms=FORMS), given.out / "forms", local()), truth, robots)
    spreads = {name: spread.samples for name, spread in found.plants["twin"].items()}
    print("\n| assumption alone, median change over spread | " + " | ".join(METRICS) + " |\n|" + "---|" * 5)
    reference: dict[str, np.ndarray] | None = None
    for name, changes in {"as shipped": {}, **ASSUMPTIONS}.items():
        rows = ran(name, changes, given.few)
        reference = reference or rows
        moved = [np.nanmedian(rows[m] - reference[m]) / _spread(of(spreads)) for m, of in METRICS.items()]
        print(f"| {name} | " + " | ".join(f"{each:+.2f}" for each in moved) + " |", flush=True)


def _spread(values: np.ndarray) -> float:
    """Return half of what holds two thirds: some robots nearly stand, and their curvature has no bound."""
    low, high = np.nanquantile(values, (0.16, 0.84))
    return float(high - low) / 2


def _share(held: Any) -> str:
    ends = binomtest(int(np.sum(held)), len(held)).proportion_ci(0.95, "exact")
    return f"{100 * np.mean(held):.1f} % ({100 * ends.low:.0f} to {100 * ends.high:.0f})"


if __name__ == "__main__":
    main()
