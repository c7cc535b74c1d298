"""Cost of sweeps, and equality of their results for all engines.

    uv run python benchmarks/sweeps.py [--only fig31 workers engines twins ray]
    [--repetitions 3]

- fig31: the 1,736 points of Fig. 31 with two workers.
- workers: the same points with one worker and with two.
- engines: the digests of one grid with one worker, two workers, and Ray.
- twins: twins of one robot in processes, in threads of one process, and stepped
  together in `mujoco.batch`.
- ray: additional time of a local Ray cluster.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from common.grid import table

from srs_twin import DivergedError, Job, Trajectory, run_many
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.execution import Engine, local
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.points import Sweep
from srs_twin.studies.sweep.task import flat_metrics

Found = Mapping[str, Mapping[str, float | None]]

COMMAND = Path(sys.executable).with_name("srs-twin")
GRID = """\
scenario: gen2_straight
plants: [{plants}]
fixed: {{{fixed}}}
vary:
  controller.frequency_hz: {{from: 1, to: 2, count: {frequencies}}}
  supply.pressure_kpa: {{from: 41, to: 55, count: {pressures}}}
"""


def command(sweep: str, *words: str) -> tuple[float, str]:
    """Run `srs-twin sweep` in an empty folder; return its wall time (s) and the digest of its results."""
    with tempfile.TemporaryDirectory() as out:
        begun = time.perf_counter()
        subprocess.run(
            [str(COMMAND), "sweep", sweep, "--out", out, "-q", *words], check=True
        )
        wall = time.perf_counter() - begun
        return (
            wall,
            json.loads((Path(out) / "sweep.json").read_text())["results_sha256"],
        )


def written(
    folder: Path,
    plants: str,
    duration: float,
    frequencies: int,
    pressures: int,
    *,
    contact: str = "",
) -> str:
    """Write the sweep file of a grid and return its path."""
    fixed = f"duration_s: {duration:g}"
    if contact:
        fixed += f", plants.twin.contact: {contact}"
    path = (
        folder
        / f"{plants.replace(', ', '_')}_{duration:g}_{frequencies}_{pressures}.yaml"
    )
    path.write_text(
        GRID.format(
            plants=plants,
            fixed=fixed,
            frequencies=frequencies,
            pressures=pressures,
        )
    )
    return str(path)


def fig31(folder: Path, repetitions: int) -> None:
    """Time the whole command on the grid of Fig. 31."""
    walls = [command("fig31", "--workers", "2")[0] for _ in range(repetitions)]
    print(f"fig31, 1736 points, two workers: {_spread(walls)} s")


def workers(folder: Path, repetitions: int) -> None:
    """Compare one worker with two: the whole command, and the time without its start."""
    rows = []
    for plants, size in (("analytical", (40, 30)), ("twin", (10, 6))):
        sweep = written(folder, plants, 10, *size)
        few = written(folder, plants, 10, 2, 2)
        methods = [(n, which) for n in (1, 2) for which in (sweep, few)]
        # In turns, so that other load of the machine affects all of them.
        outcomes = [
            {
                method: command(method[1], "--workers", str(method[0]))[0]
                for method in methods
            }
            for _ in range(repetitions)
        ]
        walls = {method: [item[method] for item in outcomes] for method in methods}
        least = {method: min(item) for method, item in walls.items()}
        alone = (
            (least[1, sweep] - least[1, few]) / (least[2, sweep] - least[2, few]) / 2
        )
        whole = least[1, sweep] / least[2, sweep] / 2
        rows.append(
            [
                plants,
                str(size[0] * size[1]),
                _spread(walls[1, sweep]),
                _spread(walls[2, sweep]),
                f"{whole:.2f}",
                f"{alone:.2f}",
            ]
        )
    head = ["plant", "points", "one, s", "two, s", "efficiency", "without the start"]
    print(table(head, rows))


def engines(folder: Path, repetitions: int) -> None:
    """Compare the digests of one grid by every engine over several repetitions."""
    sweep = written(folder, "analytical, twin", 3, 4, 3)
    methods = [
        ("--workers", "1"),
        ("--workers", "2"),
        ("--engine", "ray", "--workers", "2"),
    ]
    outcomes = {
        method: {command(sweep, *method)[1] for _ in range(repetitions)}
        for method in methods
    }
    for method, digests in outcomes.items():
        print(" ".join(method), *digests)
    same = len(set.union(*outcomes.values())) == 1
    print(
        f"{len(methods)} engines, {repetitions} times each:"
        f" {'all the same' if same else 'NOT the same'}"
    )
    if not same:
        sys.exit(1)


def twins(folder: Path, repetitions: int) -> None:
    """Compare methods to run the twins of a grid in pressure and gait, all after a warm-up."""
    # `mujoco.batch` cannot compute the loaded contact.
    sweep = load_sweep(written(folder, "twin", 10, 4, 4, contact="preloaded"))
    methods: dict[str, Callable[[Sweep], Found]] = {
        "two processes": lambda sweep: _rows(local(2), sweep),
        "two threads": _threads,
        "mujoco.batch, two threads": lambda sweep: _together(sweep, 2),
        "one process": lambda sweep: _rows(local(1), sweep),
        "mujoco.batch, one thread": lambda sweep: _together(sweep, 1),
    }
    outcomes = {name: method(sweep) for name, method in methods.items()}
    walls = [
        [_timed(method, sweep) for method in methods.values()]
        for _ in range(repetitions)
    ]
    rows = []
    for k, name in enumerate(methods):
        ratio = statistics.median(row[k] / row[0] for row in walls)
        rows.append([name, _spread([row[k] for row in walls]), f"{ratio:.2f}"])
    print(table(["16 twins, 10 s", "wall, s", "relative to two processes"], rows))
    same = all(item == outcomes["two processes"] for item in outcomes.values())
    print(f"results: {'all the same' if same else 'NOT the same'}")
    if not same:
        sys.exit(1)


def _rows(engine: Engine, sweep: Sweep) -> Found:
    rows = [done.result for done in engine(sweep.experiment, sweep.points)]
    return {row.key: row.values for row in rows if row is not None}


def _threads(sweep: Sweep) -> Found:
    scenarios = _scenarios(sweep)
    jobs = [
        Job(partial(s.build_plant, "twin"), s.build_controller, s.duration)
        for s in scenarios
    ]
    return _measured(sweep, run_many(jobs, threads=2))


def _together(sweep: Sweep, threads: int) -> Found:
    from common.twin_batch import run_together

    return _measured(sweep, run_together(_scenarios(sweep), threads))


def _scenarios(sweep: Sweep) -> list[Scenario]:
    return [
        parse_scenario(sweep.experiment.document(point.changes))
        for point in sweep.points
    ]


def _measured(sweep: Sweep, runs: Sequence[Trajectory | DivergedError]) -> Found:
    return {
        point.key: flat_metrics("twin", plant_metrics(run))
        for point, run in zip(sweep.points, runs, strict=True)
    }


def _timed(method: Callable[[Sweep], Found], sweep: Sweep) -> float:
    begun = time.perf_counter()
    method(sweep)
    return time.perf_counter() - begun


def ray(folder: Path, repetitions: int) -> None:
    """Compare a sweep of four short runs with local workers and with a local Ray cluster."""
    sweep = written(folder, "analytical", 1.6, 2, 2)
    here = [command(sweep, "--workers", "2")[0] for _ in range(repetitions)]
    there = [
        command(sweep, "--engine", "ray", "--workers", "2")[0]
        for _ in range(repetitions)
    ]
    added = statistics.median(there) - statistics.median(here)
    print(f"local {_spread(here)} s, Ray {_spread(there)} s: Ray adds {added:.1f} s")


def _spread(values: list[float]) -> str:
    return f"{statistics.median(values):.1f} ({min(values):.1f} to {max(values):.1f})"


STUDIES = {
    "fig31": fig31,
    "workers": workers,
    "engines": engines,
    "twins": twins,
    "ray": ray,
}


def main() -> None:
    """Run the chosen parts and print their results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument(
        "--repetitions", type=int, default=3, help="number of repetitions"
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        for part in arguments.only:
            print(f"\n{part}")
            STUDIES[part](Path(name), arguments.repetitions)


if __name__ == "__main__":
    main()
