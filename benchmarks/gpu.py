"""Twins on an accelerator compared with twins on the processor, and their steps per second.

    uv run --extra gpu python benchmarks/gpu.py [--device cpu] [--seconds 10] [--json
    FILE]

36 points of generation 2 (three frequencies, three pressures, with and without gaps,
straight and turning) are the 36 worlds of one batch, with both contacts. Then batches
of increasing size are stepped with one gait, without host synchronisation and with a
sample every 10 ms. Only this repository and a device are needed.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from agreement import FREQUENCIES_HZ, PRESSURES_KPA
from common.grid import Run, table

from srs_twin import Gait, TwinBatch
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.rollout import run_scripts

WORLDS = (1, 64, 1024, 4096, 16384)


def agreement(contact: str, seconds: float, device: str | None) -> dict[str, Any]:
    """Run the 36 points on both engines; return the largest differences."""
    points = list(product(FREQUENCIES_HZ, PRESSURES_KPA, (False, True), (0.0, 0.2)))
    specs = [Run("twin", gaps=gaps).spec() for _, _, gaps, _ in points]
    supplies = [1e3 * p for _, p, _, _ in points]
    results = []
    times = []
    for more in ({"engine": "cpu"}, {"engine": "warp", "device": device}):
        batch = TwinBatch(specs, supply_pa=supplies, contact=contact, **more)
        gaits = [Gait(f, offset) for f, _, _, offset in points]
        run_scripts(batch, gaits, batch.tick)  # compiles
        begun = time.perf_counter()
        results.append(run_scripts(batch, gaits, seconds))
        times.append(time.perf_counter() - begun)
    bends = []
    places = []
    speeds = []
    for here, there in zip(*results, strict=True):
        last = np.argmin(np.abs(here["time"] - min(1.0, seconds)))
        segments = range(1, 5)
        difference = [
            np.abs(here[f"bend_{j}"] - there[f"bend_{j}"])[: last + 1].max()
            for j in segments
        ]
        bends.append(max(difference))
        xy = [
            np.abs(here[f"{c}_{i}"] - there[f"{c}_{i}"])[: last + 1].max()
            for c in "xy"
            for i in range(1, 6)
        ]
        places.append(max(xy))
        v = [plant_metrics(item)["com_speed_m_s"] for item in (here, there)]
        speeds.append(abs(v[1] / v[0] - 1) if v[0] else np.nan)
    return {
        "contact": contact,
        "seconds": seconds,
        "bend_rad": max(bends),
        "place_m": max(places),
        "speed": float(np.nanmax(speeds)),
        "wall_s": times,
    }


def speed(
    contact: str, worlds: int, seconds: float, device: str | None, *, look: bool
) -> dict[str, Any]:
    """Step one gait in a batch of worlds; return steps per second."""
    batch = _stepped(contact, worlds, device)
    steps = round(seconds / batch.twins[0].timestep)
    begun = time.perf_counter()
    if look:
        batch.follow(seconds, round(100 * seconds))
    else:
        batch.run(steps, gait=True)
    wp.synchronize()
    wall = time.perf_counter() - begun
    return {
        "contact": contact,
        "worlds": worlds,
        "look": look,
        "steps_per_s": worlds * steps / wall,
    }


def memory(contact: str, worlds: int, device: str | None) -> float:
    """Return the memory per world, bytes.

    Needs a fresh process, which keeps the memory of freed graphs.
    """
    _stepped(contact, 1, device)  # loads the kernels
    before = wp.get_device(device).free_memory
    kept = _stepped(contact, worlds, device)
    return (before - wp.get_device(device).free_memory) / len(kept)


def _stepped(contact: str, worlds: int, device: str | None) -> Any:
    batch = TwinBatch(
        [Run("twin").spec()] * worlds, contact=contact, engine="warp", device=device
    )
    batch.set_gaits([Gait(2.0, 0.2 * k / worlds) for k in range(worlds)])
    batch.run(20, gait=True)  # compiles and records the graph
    wp.synchronize()
    return batch


def main() -> None:
    """Measure and print the tables."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument(
        "--device", help="device name of Warp (default: its preferred device)"
    )
    words.add_argument(
        "--seconds", type=float, default=10.0, help="duration of the 36 runs, s"
    )
    words.add_argument(
        "--stepped", type=float, default=1.0, help="duration of each timing, s"
    )
    words.add_argument("--worlds", type=int, nargs="+", default=WORLDS)
    words.add_argument("--json", type=Path, metavar="FILE")
    options = words.parse_args()
    device = wp.get_device(options.device)
    print(f"{device.name}, Warp {wp.__version__}", flush=True)
    kept: dict[str, Any] = {"device": device.name, "warp": wp.__version__}
    kept |= {"agreement": [], "speed": [], "memory": []}
    for contact in ("preloaded", "loaded"):
        kept["agreement"].append(agreement(contact, options.seconds, options.device))
    rows = [
        [
            item["contact"],
            f"{1e6 * item['bend_rad']:.0f}",
            f"{1e6 * item['place_m']:.1f}",
            f"{100 * item['speed']:.3f}",
            " / ".join(f"{wall:.1f}" for wall in item["wall_s"]),
        ]
        for item in kept["agreement"]
    ]
    print(
        table(
            [
                "contact",
                "bends, µrad",
                "positions, µm, after 1 s",
                "speeds, %",
                "processor / device, s",
            ],
            rows,
        )
    )
    for contact, worlds, look in product(
        ("preloaded", "loaded"), options.worlds, (False, True)
    ):
        kept["speed"].append(
            speed(contact, worlds, options.stepped, options.device, look=look)
        )
    rows = [
        [
            item["contact"],
            f"{item['worlds']:,}",
            "every 10 ms" if item["look"] else "no",
            f"{item['steps_per_s']:,.0f}",
        ]
        for item in kept["speed"]
    ]
    print(table(["contact", "worlds", "recorded", "steps per second"], rows))
    if device.is_cuda:
        for contact in ("preloaded", "loaded"):
            worlds = max(options.worlds)
            with ProcessPoolExecutor(1, get_context("spawn")) as own:
                taken = own.submit(memory, contact, worlds, options.device).result()
            kept["memory"].append(
                {"contact": contact, "worlds": worlds, "bytes_per_world": taken}
            )
            print(
                f"{contact}: {taken / 1e3:.0f} kB per world, of {worlds:,}", flush=True
            )
    if options.json:
        options.json.write_text(json.dumps(kept, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
