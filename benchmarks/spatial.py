"""Twin and quasistatic plant on gaits that lift the body: speed, direction and contact.

    uv run python benchmarks/spatial.py [--rows FILE] [--quick]

The robot is `spatial_slender`, with chambers as slow as the gait (time constants of
half a period), so that the wave has the same shape at every frequency. 16 points: four
frequencies, and four pairs of pitch share and lag. A run has two periods of warm-up and
three that count. The inertia number (2πf)² A/(μ g) uses the lateral amplitude A of the
middle connector. FILE collects the finished points, one line of JSON each; they are not
repeated.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common.grid import table

from srs_twin import AnalyticalSnake, Gait, Trajectory, compare, load_robot, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.control.gait import PitchWave
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import GRAVITY, RobotSpec

SUPPLY_PA = 30e3
FREQUENCIES_HZ = (0.1, 0.25, 0.5, 1.0)
WAVES = (
    (0.3, math.pi / 2),
    (0.15, math.pi / 2),
    (0.45, math.pi / 2),
    (0.3, math.pi / 4),
)
"""Pitch share and lag (rad)."""
PERIODS = 5
HINGES = 3
"""Hinges per segment of the twin."""


def slow(spec: RobotSpec, frequency: float) -> RobotSpec:
    """Return the robot with chambers whose time constants are half a period."""
    return replace(
        spec,
        actuator=replace(
            spec.actuator, tau_fill=0.5 / frequency, tau_vent=0.5 / frequency
        ),
    )


def sag_number(spec: RobotSpec) -> float:
    """Return m g λ²/(k p) for one wave along the body, 1."""
    assert spec.mass.segments is not None
    pitch = spec.geometry.pitch
    wave = 2 * math.pi / spec.phase_step * pitch
    weight = spec.mass.total / spec.geometry.body_length * GRAVITY
    return weight * wave**3 / (spec.bending.stiffness * pitch)


def inertia_number(spec: RobotSpec, run: Trajectory, frequency: float) -> float:
    """Return (2πf)² A/(μ g) with the lateral amplitude A of the middle connector, 1."""
    used = run.time >= 2 / frequency
    middle = run.position[used][:, spec.geometry.connectors // 2] - run.com[used]
    heading = run["heading"][used].mean()
    lateral = middle[:, 1] * math.cos(heading) - middle[:, 0] * math.sin(heading)
    return float(
        (2 * math.pi * frequency) ** 2
        * np.ptp(lateral)
        / 2
        / (spec.friction.mu_n * GRAVITY)
    )


def point(frequency: float, fraction: float, lag: float) -> dict[str, Any]:
    """Simulate one gait on both plants; return its row."""
    spec = slow(load_robot("spatial_slender"), frequency)
    gait = Gait(frequency, pitch=PitchWave(fraction, lag))
    snake = AnalyticalSnake(
        spec, model="quasistatic", supply_pa=SUPPLY_PA, timestep=0.0025 / frequency
    )
    twin = TwinSnake(
        spec, supply_pa=SUPPLY_PA, hinges_per_segment=HINGES, timestep=0.002
    )
    rate = min(50, 100 * frequency)
    runs = [
        rollout(plant, gait, PERIODS / frequency, record_hz=rate)
        for plant in (snake, twin)
    ]
    reference, candidate = runs
    one = plant_metrics(reference)
    other = plant_metrics(candidate)
    differences = compare(reference, candidate).metrics
    return {
        "frequency": frequency,
        "fraction": fraction,
        "lag": lag,
        "inertia": inertia_number(spec, candidate, frequency),
        "speeds": [run["travel_speed_m_s"] for run in (one, other)],
        "directions": [
            math.degrees(run["travel_direction_rad"]) for run in (one, other)
        ],
        "speed_rel": differences["travel_speed_rel"],
        "direction_abs": math.degrees(differences["travel_direction_abs"] or 0.0),
        "agreement": differences["contact_agreement"],
        "jumps": snake.jumps,
    }


def report(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    heads = [
        "f, Hz",
        "pitch fraction",
        "lag",
        "inertia number",
        "quasistatic, mm/s",
        "twin, mm/s",
        "speed",
        "direction",
    ]
    heads += ["contact agrees", "jumps"]
    lines = [
        [
            f"{row['frequency']:g}",
            f"{row['fraction']:g}",
            f"{math.degrees(row['lag']):.0f}°",
            f"{row['inertia']:.2g}",
            *(f"{1e3 * speed:.1f}" for speed in row["speeds"]),
            f"{100 * row['speed_rel']:+.1f} %",
            f"{row['direction_abs']:.1f}°",
            f"{100 * row['agreement']:.1f} %",
            str(row["jumps"]),
        ]
        for row in sorted(rows, key=lambda row: row["inertia"])
    ]
    print(table(heads, lines))
    print(f"sag number {sag_number(load_robot('spatial_slender')):.2g}")


def main() -> None:
    """Simulate and print."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument(
        "--rows", type=Path, metavar="FILE", help="file of finished points, JSON lines"
    )
    words.add_argument(
        "--quick", action="store_true", help="the first gait at 1 Hz only"
    )
    words.add_argument(
        "--every", type=int, default=1, metavar="N", help="every N-th point only"
    )
    given = words.parse_args()
    if given.rows and given.rows.exists():
        lines = given.rows.read_text("utf-8").splitlines()
    else:
        lines = []
    rows = [json.loads(line) for line in lines]
    known = {(row["frequency"], row["fraction"], row["lag"]) for row in rows}
    orders = [(f, *wave) for f in reversed(FREQUENCIES_HZ) for wave in WAVES]
    for order in orders[:1] if given.quick else orders[:: given.every]:
        if order in known:
            continue
        rows.append(point(*order))
        if given.rows:
            with given.rows.open("a", encoding="utf-8") as out:
                out.write(json.dumps(rows[-1]) + "\n")
    report(rows)


if __name__ == "__main__":
    main()
