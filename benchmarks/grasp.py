"""Grasp and drag of random objects by a chain of generation 2's modules.

    uv run python benchmarks/grasp.py [--objects 50] [--mode sensed] [--payload] [--json
    FILE]

docs/objects.md states the ranges, which were fixed before the runs. An object counts as
held and dragged if it has moved by 0.3 m within 10 s and is then inside the curl: the
distances of its centre to three holding connectors within 20 mm of those when the drag
began. `--payload` instead drags one cylinder with growing floor friction.
"""

from __future__ import annotations

import argparse
import json
import math
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from common.grid import table

from srs_twin import load_robot
from srs_twin.control.grasp import Grasp
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import GRAVITY, RobotSpec
from srs_twin.robot.world import MovableObject, World
from srs_twin.rollout import rollout

MODULES = 12
HOLD = 4
FREQUENCY_HZ = 2.0
SECONDS = 10.0
RADIUS_M = (0.020, 0.030)
MASS_KG = (0.02, 0.10)
LOAD_N = (0.05, 0.25)
BEHIND_M = (0.12, 0.16)
GAP_M = (0.002, 0.015)
DRAGGED_M = 0.3
INSIDE_M = 0.02
PRESET_S = 0.002


def chain() -> RobotSpec:
    """Return generation 2 with 12 modules and one wave over the eight modules that crawl."""
    gen2 = load_robot("gen2")
    return replace(
        gen2,
        name="chain",
        geometry=replace(gen2.geometry, connectors=MODULES + 1),
        mass=replace(gen2.mass, connectors=gen2.mass.connectors[:1] * (MODULES + 1)),
        phase_step=2 * math.pi / (MODULES - HOLD),
    )


def drawn_object(seed: int) -> tuple[MovableObject, str]:
    """Return an object next to the tail, and its side."""
    spec = chain()
    rng = np.random.default_rng((seed, 4))
    radius = rng.uniform(*RADIUS_M)
    mass = rng.uniform(*MASS_KG)
    load = rng.uniform(*LOAD_N)
    behind = rng.uniform(*BEHIND_M)
    gap = rng.uniform(*GAP_M)
    side = rng.choice([1, -1])
    first = spec.geometry.body_length / 2 - (MODULES - HOLD) * spec.geometry.pitch
    y = side * (spec.geometry.width / 2 + gap + radius)
    item = MovableObject(
        (float(radius),),
        float(mass),
        float(load / (mass * GRAVITY)),
        first - behind,
        float(y),
    )
    return item, "left" if side > 0 else "right"


def dragged(
    item: MovableObject, side: str, mode: str, seconds: float = SECONDS
) -> dict[str, Any]:
    """Run one grasp; return the distance that the object moved, its speed and its shift in the curl."""
    twin = TwinSnake(chain(), world=World(objects=(item,)), timestep=PRESET_S)
    start = np.array([item.x, item.y])
    # The curl moves the object by up to 50 mm before the drag begins.
    far = None if seconds > SECONDS else DRAGGED_M + 0.06
    run = rollout(
        twin,
        Grasp(FREQUENCY_HZ, mode=mode, side=side, hold=HOLD),
        seconds,
        until=(
            None
            if far is None
            else lambda state: bool(np.hypot(*(state.qpos[-3:-1] - start)) > far)
        ),
    )
    place = np.stack([run["object_x_1"], run["object_y_1"]], axis=-1)
    dragging = run["grasp_phase"] == 2
    moved = float(np.hypot(*(place[-1] - place[0])))
    result = {
        "moved_m": moved,
        "load_n": item.mass * item.friction * GRAVITY,
        "radius_m": item.size[0],
    }
    if not dragging.any():
        return result | {"held": False, "reason": "missed"}
    first = int(np.argmax(dragging))
    # Distances to three holding connectors locate the object in the curl.
    held = run.position[:, -HOLD : -HOLD + 3]
    distances = np.hypot(*np.moveaxis(held - place[:, None], -1, 0))
    shift = float(np.abs(distances[-1] - distances[first]).max())
    half = (first + len(place)) // 2
    speed = np.hypot(*(place[-1] - place[half])) / (run.time[-1] - run.time[half])
    held_m = float(np.hypot(*(place[-1] - place[first])))
    return result | {
        "held": shift < INSIDE_M and held_m >= DRAGGED_M,
        "shift_m": shift,
        "dragged_m": held_m,
        "speed_m_s": float(speed),
        "reason": "" if shift < INSIDE_M else "lost",
    }


def judged(seed: int, mode: str) -> dict[str, Any]:
    """Return the result for one drawn object."""
    return {"seed": seed, "mode": mode} | dragged(*drawn_object(seed), mode)


def payload(load: float) -> dict[str, Any]:
    """Return the result for a cylinder with a given floor friction, N."""
    item, side = drawn_object(0)
    middle = replace(item, size=(0.025,), mass=0.05, friction=load / (0.05 * GRAVITY))
    return dragged(middle, side, "open_loop", 6.0)


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--objects", type=int, default=50)
    words.add_argument("--mode", choices=["sensed", "open_loop"], default="sensed")
    words.add_argument("--payload", action="store_true")
    words.add_argument("--workers", type=int, default=1)
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    job = partial(judged, mode=given.mode)
    inputs = list[Any](range(given.objects))
    if given.payload:
        job = payload
        inputs = [0.05, 0.15, 0.35, 0.5, 0.7, 1.0]
    with ProcessPoolExecutor(given.workers) as pool:
        results = []
        for result in pool.map(job, inputs):
            results.append(result)
            print(json.dumps(result), flush=True)
    if given.payload:
        rows = [[f"{r['load_n']:.2f}", f"{r.get('speed_m_s', 0):.3f}"] for r in results]
        print(table(["floor friction, N", "speed, m/s"], rows))
    else:
        moved = 1e3 * np.array([r["moved_m"] for r in results])
        row = [
            given.mode,
            f"{sum(r['held'] for r in results)} of {len(results)}",
            f"{moved.min():.0f} to {moved.max():.0f}",
        ]
        heads = ["mode", f"held and dragged {DRAGGED_M} m", "objects moved by, mm"]
        print(table(heads, [row]))
    if given.json:
        given.json.write_text(json.dumps(results, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
