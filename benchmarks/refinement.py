"""Change of mean speed and yaw rate when each numerical setting is refined.

    uv run python benchmarks/refinement.py [--matched]

Time step, friction regularisation and number of hinges are refined one at a time and
all together, for gaits of generation 2 between 1 and 2 Hz, straight and turning. With
`--matched`, the bends are stiff.
"""

from __future__ import annotations

import argparse
from typing import Any

from agreement import MATCHED_STIFFNESS
from grid import Run, run_all, table

from srs_twin import LoadedContact, PreloadedContact
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.plants.twin.mjcf.numerics import SLIP_SPEED_M_S, ModelSettings

GAITS = ((1.0, 0.0), (2.0, 0.0), (2.0, 0.2))  # Hz, offset
BASE = ModelSettings()
HALF_SLIP = {"contact": LoadedContact(slip_speed=SLIP_SPEED_M_S / 2)}

CASES: dict[str, list[tuple[str, dict[str, Any]]]] = {
    "analytical": [
        ("default: 2 ms, tolerance 0.2 mm/s, ε 0.25 mm/s", {}),
        ("time step halved", {"timestep": 0.001}),
        ("time step quartered", {"timestep": 0.0005}),
        ("tolerance halved", {"tolerance": 0.0001}),
        ("ε halved", {"slip_speed": 0.000125}),
        (
            "time step 1/8, tolerance 1/10, ε 1/4",
            {"timestep": 0.00025, "slip_speed": 0.0000625, "tolerance": 0.00002},
        ),
    ],
    "twin": [
        (f"default: {1e3 * BASE.timestep:g} ms, {BASE.hinges_per_segment} hinges", {}),
        ("time step 2 ms", {"timestep": 0.002}),
        ("time step halved", {"timestep": 0.0005}),
        ("time step quartered", {"timestep": 0.00025}),
        ("hinges doubled", {"hinges_per_segment": 2 * BASE.hinges_per_segment}),
        ("slip speed halved", HALF_SLIP),
        (
            "all refined",
            {
                "timestep": 0.00025,
                "hinges_per_segment": 2 * BASE.hinges_per_segment,
                **HALF_SLIP,
            },
        ),
        ("preloaded", {"contact": PreloadedContact()}),
    ],
}


def main() -> None:
    """Print one table per plant."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument(
        "--matched",
        action="store_true",
        help="use stiff bends instead of the shipped robot",
    )
    arguments.add_argument(
        "--only", nargs="+", choices=CASES, default=list(CASES), help="plants to refine"
    )
    selected = arguments.parse_args()
    stiffness = MATCHED_STIFFNESS if selected.matched else None
    head = ["change", *(f"{f:g} Hz, offset {o:g}: mm/s (%), rad/s" for f, o in GAITS)]
    for plant in selected.only:
        cases = CASES[plant]
        if plant == "analytical":
            friction = {"friction": "wheel"}
        else:
            friction = {}
        runs = [
            Run(
                plant,
                frequency=f,
                offset=o,
                supply_pa=48.3e3,
                stiffness=stiffness,
                options=friction | options,
            )
            for _, options in cases
            for f, o in GAITS
        ]
        metrics = [plant_metrics(trajectory) for trajectory in run_all(runs)]
        base = metrics[: len(GAITS)]
        rows = []
        for i, (name, _) in enumerate(cases):
            row = metrics[i * len(GAITS) : (i + 1) * len(GAITS)]
            rows.append([name, *(_cell(m, b) for m, b in zip(row, base, strict=True))])
        print(f"\n{plant}\n\n{table(head, rows)}", flush=True)


def _cell(metrics: dict[str, Any], base: dict[str, Any]) -> str:
    speed = metrics["com_speed_m_s"]
    before = base["com_speed_m_s"]
    return (
        f"{1e3 * speed:.2f} ({100 * (speed / before - 1):+.2f}),"
        f" {metrics['yaw_rate_rad_s']:+.4f}"
    )


if __name__ == "__main__":
    main()
