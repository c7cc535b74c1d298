"""What longer steps of the twin cost in truth, and save in time, metric by metric.

    uv run python benchmarks/presets.py [--seconds 8] [--candidates]

Each is held against `contact: loaded` with a step of 0.25 ms and the hinges of the default, over gaits of all
four generations; times are of the processor, the least of three, over those of the default twin in the same
run. `--candidates` shows what else was tried.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from grid import table

from srs_twin import load_scenario, rollout
from srs_twin.comparison.metrics import plant_metrics

SCENARIOS = ("gen1_straight", "gen2_straight", "gen2_turn", "gen3_turn", "gen4_straight", "gen4_turn")
METRICS = (
    "com_speed_m_s", "yaw_rate_rad_s", "mean_bend_amplitude_rad", "cost_of_transport", "mechanical_power_w",
    "pneumatic_power_w",
)  # fmt: skip
_NOTHING = {"yaw_rate_rad_s": 0.05}
"""Below it a share says nothing."""
FINE = {"contact": "loaded", "timestep_s": 0.00025}
SHOWN: dict[str, dict[str, Any]] = {"default": {}, "fast": {"preset": "fast"}}
CANDIDATES: dict[str, dict[str, Any]] = {
    "default": {},
    **{
        f"{contact}, {1e3 * step:g} ms, {hinges} hinges": {
            "contact": contact, "timestep_s": step, "hinges_per_segment": hinges,
        }
        for contact in ("loaded", "preloaded") for step in (0.001, 0.002) for hinges in (1, 2)
    },
}  # fmt: skip


def ran(
    name: str, settings: dict[str, Any], seconds: float, repeats: int = 1
) -> tuple[dict[str, Any], float]:
    """Return metrics and the processor's time."""
    changes: dict[str, Any] = {"duration_s": seconds, "plants.twin": settings or {"timestep_s": 0.001}}
    scenario, least = load_scenario(name, set=changes), np.inf
    for _ in range(repeats):
        plant, controller = scenario.build_plant("twin"), scenario.build_controller()
        begun = time.process_time()
        done = rollout(plant, controller, **scenario.timing)
        least = min(least, time.process_time() - begun)
    return plant_metrics(done), least


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--seconds", type=float, default=8.0)
    words.add_argument("--candidates", action="store_true")
    given = words.parse_args()
    chosen = CANDIDATES if given.candidates else SHOWN
    off: dict[str, dict[str, list[float]]] = {each: {m: [] for m in METRICS} for each in chosen}
    times: dict[str, list[float]] = {each: [] for each in chosen}
    for name in SCENARIOS:
        truth, _ = ran(name, FINE, given.seconds)
        for each, settings in chosen.items():
            found, least = ran(name, settings, given.seconds, repeats=3)
            times[each].append(least)
            for metric in METRICS:
                if truth[metric] is not None and abs(truth[metric]) > _NOTHING.get(metric, 0.0):
                    off[each][metric].append(found[metric] / truth[metric] - 1)
    rows = [
        [
            each, *(f"{100 * max(values, key=abs):+.1f}" for values in off[each].values()),
            f"{np.mean(np.array(times['default']) / np.array(times[each])):.1f}",
        ]
        for each in chosen
    ]  # fmt: skip
    head = ["twin", "speed", "yaw rate", "bends", "cost of transport", "mechanical", "pneumatic"]
    print(table([*head, "times as fast"], rows))


if __name__ == "__main__":
    main()
