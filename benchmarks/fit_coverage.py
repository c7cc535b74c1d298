"""Coverage of gait fits with a wrong model: analytical models fitted to data of the twin.

    uv run python benchmarks/fit_coverage.py [--robots 300] [--first 0] [--only MODEL]
    [--out FILE] [--table]

Each robot is gen2 or gen4 with other values of μ_t, μ_n and stiffness (a factor up to
e^±0.3 each) and of the rigid gap (up to ±5 mm). It crawls twice for 2 s and is captured
with pairs of markers (noise 0.2 mm). `complete`, `simplified` and `compliant` are
fitted to recordings of the shipped twin. For every third robot `compliant` is also
fitted to recordings of `compliant` ("exact"). The fits follow `calibrate locomotion`,
except that they have one start: the gap comes from the markers and the twin is the
reference. With `--truth finer` the shipped twin is fitted to recordings of a twin with
half the time step, six hinges per segment and chambers with orifices. Each line of the
file is one robot; robots in the file are skipped.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from common.grid import table
from scipy.stats import beta

from srs_twin import Gait, RobotSpec, load_robot, rollout
from srs_twin.errors import InputError
from srs_twin.identification.locomotion import (
    GaitRun,
    PlantModel,
    fit_locomotion,
    measured_length,
)
from srs_twin.identification.parameters import with_values
from srs_twin.recordings.recording import read_motion

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from synthetic_takes import Take, write_motive

NAMES = (
    "friction.mu_t",
    "friction.mu_n",
    "bending.stiffness_nm_per_rad",
    "geometry.rigid_gap_m",
)
GAITS = ((2.0, 0.0), (1.6, 0.2))
SECONDS = 2.0
REACH = 0.3
GAP = 5e-3
EXACT = 3  # every third robot of each kind is also fitted with the exact model
TWIN = PlantModel("twin")
FINER = PlantModel(
    "twin", {"timestep": 0.0005, "hinges_per_segment": 6, "pneumatics": "orifice"}
)
RIGID = ("complete", "simplified")
MODELS = {
    name: PlantModel(settings={"model": name, "friction": "wheel"})
    for name in (*RIGID, "compliant")
}


def robot(seed: int) -> tuple[RobotSpec, dict[str, float]]:
    """Return the initial robot of the fit and the true parameters of the robot that crawls."""
    rng = np.random.default_rng([22, seed])
    spec = load_robot(("gen2", "gen4")[seed % 2])
    factors = np.exp(rng.uniform(-REACH, REACH, 3))
    truth = [spec.friction.mu_t, spec.friction.mu_n, spec.bending.stiffness] * factors
    gap = spec.geometry.rigid_gap + rng.uniform(-min(GAP, spec.geometry.rigid_gap), GAP)
    return spec, dict(zip(NAMES, [*map(float, truth), float(gap)], strict=True))


def fits(seed: int, truth_model: str, only: str | None = None) -> dict[str, Any]:
    """Return the fit results for the recordings of one robot, for all models or a single one."""
    spec, truth = robot(seed)
    of_twin, of_takes = {"twin": (TWIN, MODELS), "finer": (FINER, {"twin": TWIN})}[
        truth_model
    ]
    of_takes = {name: model for name, model in of_takes.items() if only in (None, name)}
    exact = truth_model == "twin" and seed // 2 % EXACT == 0 and only in (None, "exact")
    result: dict[str, Any] = {
        "seed": seed,
        "truth": truth,
        "plant": truth_model,
        "fits": {},
    }
    for label, plant, models in (
        ("", of_twin, of_takes),
        ("exact", MODELS["compliant"], {"exact": MODELS["compliant"]}),
    )[: 1 + exact]:
        near = spec
        recordings = []
        with tempfile.TemporaryDirectory() as folder:
            for k, gait in enumerate(GAITS):
                snake = plant.build(with_values(spec, truth), spec.supply.nominal)
                run = rollout(snake, Gait(*gait), SECONDS, record_hz=100)
                take = Take(
                    layout="pair", labeled=True, seed=10 * seed + k + 5 * bool(label)
                )
                write_motive(run, take, Path(folder) / f"{k}.csv")
            for _ in range(2):  # the second fit uses the gap from the first
                recordings = [
                    read_motion(
                        Path(folder) / f"{k}.csv",
                        near,
                        layout="pair",
                        head="snake:1a",
                        gait_frequency_hz=f,
                    )
                    for k, (f, _) in enumerate(GAITS)
                ]
                known = measured_length(recordings, near, NAMES)
                assert known is not None and known.value is not None
                near = with_values(spec, {known.name: known.value})
        runs = [
            GaitRun(item.trajectory, Gait(*gait), spec.supply.nominal, f"gait_{k}")
            for k, (item, gait) in enumerate(zip(recordings, GAITS, strict=True))
        ]
        for name, model in models.items():
            begin = time.perf_counter()
            names = [
                item for item in NAMES if name not in RIGID or "bending" not in item
            ]
            estimate = fit_locomotion(
                runs,
                near,
                names,
                model=model,
                compare_signals="both",
                starts=1,
                known=[known],
                reference=None if model is TWIN else TWIN,
            )
            result["fits"][name] = {
                "scale": estimate.residual_scale,
                "misfit": estimate.misfit[1:],
                "seconds": time.perf_counter() - begin,
                "parameters": {
                    p.name: [p.verdict, p.value, p.standard_error, p.low, p.high]
                    for p in estimate.parameters
                },
            }
    return result


def rows(done: list[dict[str, Any]]) -> Iterator[list[str]]:
    """Yield the rows of the table: one per parameter and model, and one per model over its parameters."""
    for model in (*MODELS, "exact", "twin"):
        every: list[tuple[str, bool]] = []
        for name in NAMES:
            some = []
            for item in done:
                if name in (
                    result := item["fits"].get(model, {}).get("parameters", {})
                ):
                    verdict, value, _, low, high = result[name]
                    some.append(
                        (
                            verdict,
                            value is not None and low <= item["truth"][name] <= high,
                        )
                    )
            if some:
                every += some
                yield _row(model, name, some)
        if every:
            yield _row(model, "all", every)


def _row(model: str, name: str, some: list[tuple[str, bool]]) -> list[str]:
    sure = [held for verdict, held in some if verdict == "identified"]
    row = [model, name, str(len(some)), f"{100 * len(sure) / len(some):.0f}"]
    row.append(
        f"{100 * sum(verdict == 'cannot tell' for verdict, _ in some) / len(some):.0f}"
    )
    if not sure:
        return [*row, "–", "–"]
    if any(sure):
        lower = beta.ppf(0.05, sum(sure), len(sure) - sum(sure) + 1)
    else:
        lower = 0.0
    return [*row, f"{100 * sum(sure) / len(sure):.1f}", f"{100 * lower:.1f}"]


def main() -> None:
    """Fit the robots that are missing in the file, and print the table."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--robots", type=int, default=300)
    words.add_argument("--first", type=int, default=0, help="seed of the first robot")
    words.add_argument("--truth", choices=["twin", "finer"], default="twin")
    words.add_argument(
        "--only", choices=[*MODELS, "exact", "twin"], help="fit only this model"
    )
    words.add_argument("--out", type=Path, default=Path("coverage.jsonl"))
    words.add_argument(
        "--table",
        action="store_true",
        help="print the table of the existing file without fitting",
    )
    options = words.parse_args()
    if options.out.exists():
        lines = options.out.read_text("utf-8").splitlines()
    else:
        lines = []
    done = {
        item["seed"]: item
        for item in map(json.loads, lines)
        if item["plant"] == options.truth
    }
    for seed in (
        range(options.first, options.first + options.robots)
        if not options.table
        else ()
    ):
        if seed in done:
            continue
        try:
            done[seed] = fits(seed, options.truth, options.only)
        except InputError as error:
            print(f"{seed}: {error}", flush=True)
            continue
        with options.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(done[seed]) + "\n")
    head = ["model", "parameter", "fits", "identified, %", "cannot tell, %"]
    print(
        table(
            head
            + [
                "coverage of identified values, %",
                "lower 95 % bound of the coverage, %",
            ],
            list(rows([*done.values()])),
        )
    )
    if some := [
        item["fits"][m]["seconds"] for item in done.values() for m in item["fits"]
    ]:
        print(f"\n{len(done)} robots, {math.fsum(some) / len(some):.1f} s per fit")


if __name__ == "__main__":
    main()
