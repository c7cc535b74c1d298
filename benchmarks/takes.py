"""Random recordings: share that is read, and coverage of the stated bend errors.

    uv run python benchmarks/takes.py [--draws 200] [--seed 1000] [--noise-mm 0.2 0.4]

Each draw is a gait of generation 2, or of a robot with two segments, with random
frequency, offset and pressure. The segments stretch by up to 25 %, except with one
marker per connector. The recording has a random layout, rate, unit and axis convention,
lost markers, swapped columns and spikes. `--plant twin` uses motions of the MuJoCo
twin, whose segments are not circular arcs. Motions come from a plant and marker
positions from integrals along arcs, independent of the code that reads them. A refused
recording is read again with the remedy in the error message.
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
from common.grid import table
from scipy.interpolate import CubicSpline

from srs_twin import (
    AnalyticalSnake,
    Gait,
    InputError,
    RobotSpec,
    TwinSnake,
    load_robot,
    rollout,
)
from srs_twin.recordings.recording import read_motion

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from synthetic_takes import MAPS, MOTIVE_LENGTHS, Take, stretched, write_motive

LAYOUTS = ("single", "head", "pair", "middles", "head_middles")
HEADS = {"head": "snake:ahead", "head_middles": "snake:ahead", "pair": "snake:1a"}


@dataclass(frozen=True)
class Drawn:
    """Result of one recording: `refused` is the error message, `after` whether its remedy helped."""

    layout: str
    refused: str = ""
    after: bool = False
    error: np.ndarray = field(default_factory=lambda: np.zeros(0))
    stated: np.ndarray = field(default_factory=lambda: np.zeros(0))


def two_segments(spec: RobotSpec) -> RobotSpec:
    """Return a robot with two segments."""
    mass = replace(spec.mass, connectors=spec.mass.connectors[:3])
    return replace(
        spec, name="two", geometry=replace(spec.geometry, connectors=3), mass=mass
    )


def draw(seed: int, noise: float, plant: str) -> Drawn:
    """Draw, write and read the recording with a seed."""
    random = np.random.default_rng(seed)
    if plant == "twin" or random.random() < 2 / 3:
        spec = load_robot("gen2")
    else:
        spec = two_segments(load_robot("gen2"))
    if plant == "twin":
        fitting = LAYOUTS[:3]
    elif spec.segments > 2:
        fitting = LAYOUTS
    else:
        fitting = LAYOUTS[1:]
    layout = str(random.choice(fitting))
    supply = random.uniform(30e3, 50e3)
    gait = Gait(random.uniform(0.5, 2.5), random.uniform(-0.2, 0.2))
    snake: Any = (
        TwinSnake(spec, supply_pa=supply)
        if plant == "twin"
        else AnalyticalSnake(spec, supply_pa=supply, model="compliant")
    )
    truth = rollout(snake, gait, round(random.uniform(4, 8), 1), record_hz=500)
    if layout != "single" and plant != "twin":
        truth = stretched(truth, random.uniform(0, 0.25), random.choice([1, 2]))
    take = Take(
        layout=layout,
        apart=random.uniform(0.015, 0.03),
        across=random.random() < 0.5,
        noise=noise,
        rate_hz=float(random.integers(60, 361)),
        swaps=int(random.integers(0, 20)),
        lost=random.uniform(0, 0.05),
        spikes=int(random.integers(0, 6)),
        unit=str(random.choice(list(MOTIVE_LENGTHS.values()))),
        up=str(random.choice(list(MAPS))),
        digits=7,
        seed=seed,
        labeled=random.random() < 0.3,
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "take.csv"
        write_motive(truth, take, path)
        try:
            result = read_motion(path, spec)
        except InputError as error:
            return Drawn(
                layout,
                re.sub(r"^\S+: ", "", str(error)),
                _helped(path, spec, truth, take),
            )
    result = result.trajectory
    error = result.stack("bend") - CubicSpline(truth.time, truth.stack("bend"))(
        result.time
    )
    return Drawn(layout, error=error.ravel(), stated=result.stack("bend_error").ravel())


def _helped(path: Path, spec: RobotSpec, truth: Any, take: Take) -> bool:
    """Return whether a recording is read with its layout and its head (by labels) given."""
    write_motive(truth, replace(take, labeled=True), path)
    try:
        read_motion(
            path, spec, layout=take.layout, head=HEADS.get(take.layout, "snake:1")
        )
    except InputError:
        return False
    return True


def count(drawn: list[Drawn]) -> dict[str, Any]:
    """Return the number of refused recordings, their messages, and the coverage of the 95 % intervals."""
    error, stated = (
        np.concatenate([getattr(item, name) for item in drawn])
        for name in ("error", "stated")
    )
    refused = [item for item in drawn if item.refused]
    return {
        "draws": len(drawn),
        "refused": len(refused),
        "refused_after_remedy": [item.refused for item in refused if not item.after],
        "coverage_95": float((np.abs(error) < 1.96 * stated).mean()),
    }


def main() -> None:
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--draws", type=int, default=200)
    words.add_argument("--seed", type=int, default=1000)
    words.add_argument("--noise-mm", type=float, nargs="+", default=[0.2, 0.4])
    words.add_argument("--plant", choices=["compliant", "twin"], default="compliant")
    words.add_argument("--json", type=Path, help="also write the counts to this file")
    options = words.parse_args()
    rows = []
    counts = {}
    for noise in options.noise_mm:
        with ProcessPoolExecutor() as pool:
            some = partial(draw, noise=1e-3 * noise, plant=options.plant)
            drawn = list(
                pool.map(some, range(options.seed, options.seed + options.draws))
            )
        counts[f"{noise:g}"] = count(drawn)
        for layout in ("all", *LAYOUTS):
            own = [item for item in drawn if layout in ("all", item.layout)]
            read = [item for item in own if not item.refused]
            if not read:
                continue
            error, stated = (
                np.concatenate([getattr(item, name) for item in read])
                for name in ("error", "stated")
            )
            refused = [item for item in own if item.refused]
            rows.append(
                [
                    f"{noise:g}",
                    layout,
                    f"{len(read)} of {len(own)}",
                    f"{sum(item.after for item in refused)} of {len(refused)}",
                    f"{100 * (np.abs(error) < 1.96 * stated).mean():.1f}",
                    f"{1e3 * np.sqrt((error**2).mean()):.0f}",
                    f"{1e3 * np.sqrt((stated**2).mean()):.0f}",
                ]
            )
        for item in drawn:
            if item.refused:
                print(f"refused at {noise:g} mm, {item.layout}: {item.refused}")
    head = ["noise, mm", "layout", "read", "refused, but read with the remedy"]
    print(
        table(head + ["within 95 %, %", "error, mrad", "stated, mrad"], rows),
        flush=True,
    )
    if options.json:
        options.json.write_text(json.dumps(counts, indent=1), "utf-8")


if __name__ == "__main__":
    main()
