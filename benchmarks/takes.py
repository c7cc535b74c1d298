"""How many takes of all kinds become a body, and whether bends lie within their stated errors.

    uv run python benchmarks/takes.py [--draws 200] [--seed 1000] [--noise-mm 0.2 0.4]

Each draw is a gait of generation 2, or of a body of two segments, at another frequency, offset and pressure,
with segments that stretch by up to 25 % (but for one marker a connector), recorded with another layout, rate,
unit and axis, markers lost, columns that change places and spikes. `--plant twin` takes the motions of the
MuJoCo twin, whose segments are no arcs. Motions come from a plant and positions from integrals along arcs,
nothing from what reads them. A refused take is tried again with the remedy its message names.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from grid import table
from scipy.interpolate import CubicSpline

from srs_twin import AnalyticalSnake, Gait, InputError, RobotSpec, TwinSnake, load_robot, rollout
from srs_twin.recordings.recording import read_motion

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from synthetic_takes import MAPS, MOTIVE_LENGTHS, Take, stretched, write_motive

LAYOUTS = ("single", "head", "pair", "middles", "head_middles")
HEADS = {"head": "snake:ahead", "head_middles": "snake:ahead", "pair": "snake:1a"}


@dataclass(frozen=True)
class Drawn:
    """What came of one take: `refused` says why nothing did, `after` whether its remedy helped."""

    layout: str
    refused: str = ""
    after: bool = False
    error: np.ndarray = field(default_factory=lambda: np.zeros(0))
    stated: np.ndarray = field(default_factory=lambda: np.zeros(0))


def of_two(spec: RobotSpec) -> RobotSpec:
    """Return a robot of two segments."""
    mass = replace(spec.mass, connectors=spec.mass.connectors[:3])
    return replace(spec, name="two", geometry=replace(spec.geometry, connectors=3), mass=mass)


def draw(seed: int, noise: float, plant: str) -> Drawn:
    """Return what comes of the take of a seed."""
    random = np.random.default_rng(seed)
    spec = load_robot("gen2") if plant == "twin" or random.random() < 2 / 3 else of_two(load_robot("gen2"))
    fitting = LAYOUTS[:3] if plant == "twin" else LAYOUTS if spec.segments > 2 else LAYOUTS[1:]
    layout = str(random.choice(fitting))
    supply, gait = random.uniform(30e3, 50e3), Gait(random.uniform(0.5, 2.5), random.uniform(-0.2, 0.2))
    snake: Any = (
        TwinSnake(spec, supply_pa=supply)
        if plant == "twin"
        else AnalyticalSnake(spec, supply_pa=supply, model="compliant")
    )
    truth = rollout(snake, gait, round(random.uniform(4, 8), 1), record_hz=500)
    if layout != "single" and plant != "twin":
        truth = stretched(truth, random.uniform(0, 0.25), random.choice([1, 2]))
    take = Take(
        layout=layout, apart=random.uniform(0.015, 0.03), across=random.random() < 0.5, noise=noise,
        rate_hz=float(random.integers(60, 361)), swaps=int(random.integers(0, 20)),
        lost=random.uniform(0, 0.05), spikes=int(random.integers(0, 6)),
        unit=str(random.choice(list(MOTIVE_LENGTHS.values()))), up=str(random.choice(list(MAPS))), digits=7,
        seed=seed, labeled=random.random() < 0.3,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "take.csv"
        write_motive(truth, take, path)
        try:
            found = read_motion(path, spec)
        except InputError as error:
            return Drawn(layout, re.sub(r"^\S+: ", "", str(error)), _helped(path, spec, truth, take))
    found = found.trajectory
    error = found.stack("bend") - CubicSpline(truth.time, truth.stack("bend"))(found.time)
    return Drawn(layout, error=error.ravel(), stated=found.stack("bend_error").ravel())


def _helped(path: Path, spec: RobotSpec, truth: Any, take: Take) -> bool:
    """Say whether a take loads once its layout and its head, by the names of labeled columns, are given."""
    write_motive(truth, replace(take, labeled=True), path)
    try:
        read_motion(path, spec, layout=take.layout, head=HEADS.get(take.layout, "snake:1"))
    except InputError:
        return False
    return True


def count(drawn: list[Drawn]) -> dict[str, Any]:
    """Return the number of refused recordings, their messages, and the coverage of the 95 % intervals."""
    error, stated = (np.concatenate([getattr(each, name) for each in drawn]) for name in ("error", "stated"))
    refused = [each for each in drawn if each.refused]
    return {
        "draws": len(drawn),
        "refused": len(refused),
        "refused_after_remedy": [each.refused for each in refused if not each.after],
        "coverage_95": float((np.abs(error) < 1.96 * stated).mean()),
    }


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--draws", type=int, default=200)
    words.add_argument("--seed", type=int, default=1000)
    words.add_argument("--noise-mm", type=float, nargs="+", default=[0.2, 0.4])
    words.add_argument("--plant", choices=["compliant", "twin"], default="compliant")
    words.add_argument("--json", type=Path, help="also write the counts to this file")
    given = words.parse_args()
    rows, counts = [], {}
    for noise in given.noise_mm:
        with ProcessPoolExecutor() as pool:
            some = partial(draw, noise=1e-3 * noise, plant=given.plant)
            drawn = list(pool.map(some, range(given.seed, given.seed + given.draws)))
        counts[f"{noise:g}"] = count(drawn)
        for layout in ("all", *LAYOUTS):
            own = [each for each in drawn if layout in ("all", each.layout)]
            read = [each for each in own if not each.refused]
            if not read:
                continue
            error, stated = (
                np.concatenate([getattr(each, name) for each in read]) for name in ("error", "stated")
            )
            refused = [each for each in own if each.refused]
            rows.append([
                f"{noise:g}", layout, f"{len(read)} of {len(own)}",
                f"{sum(each.after for each in refused)} of {len(refused)}",
                f"{100 * (np.abs(error) < 1.96 * stated).mean():.1f}",
                f"{1e3 * np.sqrt((error**2).mean()):.0f}", f"{1e3 * np.sqrt((stated**2).mean()):.0f}",
            ])  # fmt: skip
        for each in drawn:
            if each.refused:
                print(f"refused at {noise:g} mm, {each.layout}: {each.refused}")
    head = ["noise, mm", "layout", "read", "refused, read once its remedy was followed"]
    print(table(head + ["within 95 %, %", "error, mrad", "stated, mrad"], rows), flush=True)
    if given.json:
        given.json.write_text(json.dumps(counts, indent=1), "utf-8")


if __name__ == "__main__":
    main()
