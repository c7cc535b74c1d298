"""What learning leaves of the curvature of snakes with unequal gains and unequal time constants.

    uv run python benchmarks/learning_phases.py [--snakes 20] [--first 100] [--runs
    FILE] [--table]

Each snake crawls on the twin for 16 periods with the shipped law, which corrects one
duty per chamber from the largest bend. Two further controllers show what remains if
other properties of the bends are ideal. Once per period, they correct the timing of the
valve edges of each segment with the sensor of the segment. The controller "ideal
phases" shifts both edges of a segment together, until the fundamental of the bend has
the phase of the wave in all segments. The controller "ideal phases and means" also
shifts the edges in opposite directions, until the mean bend is zero. Curvature, phases
and means are those of the last five periods. Finished runs are kept in the file of
runs, so that an interrupted study continues; with `--table` only the table is printed.
A run takes 5 s.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from grid import table

from srs_twin import load_scenario, rollout
from srs_twin.comparison.learning import learning_metrics
from srs_twin.control.gait import Gait
from srs_twin.control.learning import ILC
from srs_twin.plants.base import SnakeState
from srs_twin.robot.spec import RobotSpec

SPREAD = 0.15
SPREADS = {
    "gain": (SPREAD, 0.0),
    "time constants": (0.0, SPREAD),
    "both": (SPREAD, SPREAD),
}
SETTINGS = {
    "smallest, 60 Hz": {"target": "smallest", "carrier_hz": 60.0},
    "0.7 rad, 120 Hz": {"target": 0.7, "carrier_hz": 120.0},
    "smallest, 120 Hz": {"target": "smallest", "carrier_hz": 120.0},
    "0.7 rad, 60 Hz": {"target": 0.7, "carrier_hz": 60.0},
}
"""Target and carrier: first those of ilc_straight, then those with the least curvature (docs/module.md)."""
PERIODS = 16
LAST = 5
FIRST_TIMED = 3
"""First period whose phases are measured."""
LAW = "the law"
PHASES = "ideal phases"
MEANS = "ideal phases and means"
TIMING_GAINS = {PHASES: (0.5, 0.0), MEANS: (0.5, 0.5)}
"""Fractions of an error of the phase, and of the mean bend over the amplitude, corrected per period."""
MAX_EDGE_OFFSET = 0.5


class SegmentGait(Gait):
    """Gait with one offset per segment, shape (segments,)."""

    def valves_at(self, time: float) -> np.ndarray:
        """Return the valve states of the tick that begins at `time` (s)."""
        wave = self._wave(time + self._tick * self._slot_centres)
        return np.stack([2 * (wave > 0) - 1, 2 * (wave < 0) - 1], axis=-1).astype(
            np.int8
        )


class TimedILC(ILC):
    """Learning law that also corrects the valve edges of each segment."""

    def __init__(
        self, frequency: float, gains: tuple[float, float], **settings: Any
    ) -> None:
        """Create the controller with the gains of phase and mean."""
        super().__init__(frequency, **settings)
        self._gains = gains
        self._gait = SegmentGait(frequency)

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""
        super().reset(spec, tick, seed=seed)
        self._wave_lag = self._gait.phase_lag
        self._first_fills = self._periods.fill_starts
        self._lead = np.zeros(spec.segments)
        self._edge_offset = np.zeros(spec.segments)
        self._sum = np.zeros((2, spec.segments), dtype=complex)
        self._ticks = 0
        self._number = 0

    def step(self, state: SnakeState) -> np.ndarray:
        """Correct the edges at the start of a period and return the valve states."""
        time = float(state.time)
        number = math.floor(time * self.frequency + 1e-9)
        if number > self._number:
            if self._number >= FIRST_TIMED:
                self._correct_edges()
            self._number = number
            self._sum = np.zeros_like(self._sum)
            self._ticks = 0
        turn = np.exp([0, -2j * math.pi * self.frequency * time])
        self._sum = self._sum + turn[:, None] * np.nan_to_num(state.measured_bend)
        self._ticks += 1
        return super().step(state)

    def _steer_wave(self) -> None:
        """Keep the edges, which `_correct_edges` sets."""

    def _correct_edges(self) -> None:
        mean, fundamental = self._sum / self._ticks
        lag = np.angle(np.exp(-1j * self._wave_lag) / (1j * fundamental))
        for_phase, for_mean = self._gains
        self._lead = self._lead + for_phase * (lag - lag.mean())
        change = for_mean * mean.real / np.abs(2 * fundamental)
        self._edge_offset = np.clip(
            self._edge_offset - change, -MAX_EDGE_OFFSET, MAX_EDGE_OFFSET
        )
        self._gait.phase_lag, self._gait._offset = (
            self._wave_lag - self._lead,
            self._edge_offset,
        )  # type: ignore[assignment]
        opening = np.arcsin(self._edge_offset)[:, None] * np.array([1, -1])
        shift = (self._lead[:, None] + opening) / (2 * math.pi) * self._periods.period
        self._periods.fill_starts = self._first_fills - shift
        self._periods._set_next()


def run(setting: str, spread: str, controller: str, seed: int) -> dict[str, Any]:
    """Run one snake; return its curvature before and after, and errors of amplitude, phase and mean."""
    gain, tau = SPREADS[spread]
    changes = {
        "robot.modules.gain_spread": gain,
        "robot.modules.tau_spread": tau,
        "seed": seed,
    }
    scenario = load_scenario("ilc_straight", set=changes)
    options = SETTINGS[setting]
    frequency = 1.0
    if controller == LAW:
        ilc = ILC(frequency, **options)
    else:
        ilc = TimedILC(frequency, TIMING_GAINS[controller], **options)
    trajectory = rollout(
        scenario.build_plant("twin"), ilc, PERIODS / frequency, seed=seed
    )
    metrics = learning_metrics(trajectory)
    chosen = trajectory.time > trajectory.time[-1] - LAST / frequency + 1e-9
    bend = trajectory.stack("bend")[chosen]
    time = trajectory.time[chosen]
    fundamental = (bend * np.exp(-2j * math.pi * frequency * time)[:, None]).mean(
        axis=0
    )
    step = scenario.robot.phase_step
    lag = np.angle(np.exp(-1j * step * np.arange(bend.shape[1])) / (1j * fundamental))
    return {
        "key": [setting, spread, controller, seed],
        "before": metrics["path_curvature_before_per_m"],
        "after": metrics["path_curvature_per_m"],
        "error": metrics["amplitude_error_end_rel"],
        "phase": float((lag - lag.mean()).std()),
        "mean": float(np.sqrt(np.mean(bend.mean(axis=0) ** 2))),
    }


def cases(snakes: int, first: int) -> Iterator[tuple[str, str, str, int]]:
    """Yield setting, spread, controller and seed."""
    seeds = range(first, first + snakes)
    shipped, best, *others = SETTINGS
    yield from product([shipped], ["both"], [LAW, PHASES, MEANS], seeds)
    yield from product([shipped], ["time constants", "gain"], [LAW], seeds)
    yield from product([best, *others], ["both"], [LAW], seeds)
    yield from product([best], ["time constants", "gain"], [LAW], seeds)


def lines(results: list[dict[str, Any]]) -> Iterator[list[str]]:
    """Yield one row of the table per setting, spread and controller."""
    for group in dict.fromkeys(tuple(result["key"][:3]) for result in results):
        rows = [result for result in results if tuple(result["key"][:3]) == group]
        value = {
            name: np.abs([row[name] for row in rows])
            for name in rows[0]
            if name != "key"
        }
        within = sum(value["error"] <= 0.05)
        curved = value["before"] > 0.2
        tenfold = sum(value["after"][curved] <= 0.1 * value["before"][curved])
        yield [
            *group,
            f"{within} of {len(rows)}",
            *(
                f"{np.median(value[name]):.3f} ({value[name].max():.3f})"
                for name in ("before", "after")
            ),
            f"{tenfold} of {sum(curved)}",
            str(sum(value["after"] > value["before"])),
            *(f"{np.median(value[name]):.3f}" for name in ("phase", "mean")),
        ]


def main() -> None:
    """Run the missing cases and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--snakes", type=int, default=20, help="number of snakes")
    parser.add_argument(
        "--first", type=int, default=100, help="seed of the first snake"
    )
    parser.add_argument(
        "--runs", type=Path, default=Path("learning_phases.jsonl"), help="file of runs"
    )
    parser.add_argument(
        "--table", action="store_true", help="print the table of the finished runs only"
    )
    options = parser.parse_args()
    if options.runs.exists():
        text = options.runs.read_text("utf-8")
    else:
        text = ""
    results = [json.loads(line) for line in text.splitlines()]
    finished = {tuple(result["key"]) for result in results}
    for case in cases(options.snakes, options.first):
        if options.table or case in finished:
            continue
        results.append(run(*case))
        with options.runs.open("a", encoding="utf-8") as file:
            file.write(json.dumps(results[-1]) + "\n")
    headings = [
        "target, carrier",
        "spread of 15 % in",
        "controller",
        "within 5 %",
        "curvature before, median (largest), 1/m",
        "after",
        "reduced tenfold",
        "increased",
        "deviation of phases, rad",
        "mean bends, rms, rad",
    ]
    print(table(headings, list(lines(results))))


if __name__ == "__main__":
    main()
