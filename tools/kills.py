"""Sweeps killed at random: whether the final results equal those of an undisturbed sweep.

    uv run python tools/kills.py [--kills 200] [--runs 400] [--seed 0]
    uv run python tools/kills.py --commands 300 --finishes 2000

Kills the sweep, one of its workers or their fork server by SIGKILL, at random times
after the start or the latest row, and starts the sweep again until it is complete. Its
rows must equal those of an undisturbed sweep. With --commands, run, sweep, optimize,
uncertainty and reproduce are killed and resumed (`kills_of_commands.py`). With
--finishes, several processes complete their files in one folder at once.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path

import kills_of_commands

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from killed_sweeps import SWEEP, digest, disturbed, start


def _of_commands(arguments: argparse.Namespace) -> int:
    """Print the results of killed commands and of sets completed at once; return the exit code."""
    faults: list[str] = []
    if arguments.finishes:
        with tempfile.TemporaryDirectory() as name:
            counts = kills_of_commands.finishes(Path(name), arguments.finishes)
        print(f"sets completed at once: {dict(counts)}", flush=True)
        faults += [
            f"{count} {kind} sets" for kind, count in counts.items() if kind != "whole"
        ]
    if arguments.only:
        names = [arguments.only]
    else:
        names = list(kills_of_commands.CASES)
    rng = random.Random(arguments.seed)
    for command in names if arguments.commands else ():
        begun = time.perf_counter()
        with tempfile.TemporaryDirectory() as name:
            for file, text in kills_of_commands.FILES.items():
                (Path(name) / file).write_text(text)
            result = kills_of_commands.killed(
                command, Path(name), -(-arguments.commands // len(names)), rng
            )
        took = time.perf_counter() - begun
        print(
            f"{command}: {result.kills} kills in {result.trials} trials, {took:.0f} s;"
            f" after a kill: {dict(result.left)}; faults: {len(result.faults)}",
            flush=True,
        )
        faults += result.faults
    print(*faults[:20], sep="\n")
    print(f"{len(faults)} faults")
    if faults:
        return 1
    return 0


def main() -> None:
    """Print the kills and whether the results are the same."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200, help="number of kills")
    parser.add_argument(
        "--runs", type=int, default=400, help="number of runs of the sweep"
    )
    parser.add_argument(
        "--duration", type=float, default=100.0, help="simulated time of a run, s"
    )
    parser.add_argument(
        "--longest", type=float, default=0.5, help="longest time to the next kill, s"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument(
        "--commands", type=int, help="total number of kills of all commands"
    )
    parser.add_argument(
        "--only", choices=kills_of_commands.CASES, help="kill this command only"
    )
    parser.add_argument(
        "--finishes", type=int, help="number of sets completed in one folder at once"
    )
    arguments = parser.parse_args()
    if arguments.commands or arguments.finishes:
        sys.exit(_of_commands(arguments))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sweep = folder / "sweep.yaml"
        sweep.write_text(SWEEP.format(duration=arguments.duration, runs=arguments.runs))
        quiet = start(sweep, folder / "quiet")
        begun = time.perf_counter()
        if quiet.wait():
            sys.exit(
                "the undisturbed sweep failed:"
                f" {quiet.stderr.read() if quiet.stderr else ''}"
            )
        alone = time.perf_counter() - begun
        begun = time.perf_counter()
        killed = disturbed(
            sweep,
            folder / "killed",
            arguments.kills,
            random.Random(arguments.seed),
            arguments.longest,
        )
        took = time.perf_counter() - begun
        same = digest(folder / "killed") == digest(folder / "quiet")
        victims = ", ".join(
            f"{count} of the {who}" for who, count in sorted(killed.victims.items())
        )
        print(f"{arguments.runs} runs, {alone:.0f} s undisturbed")
        print(f"killed: {victims}; {killed.starts} starts, {took:.0f} s")
        print(f"rows after each kill of the sweep: {killed.rows}")
        print(
            f"the results are {'the same' if same else 'NOT the same'}:"
            f" {digest(folder / 'killed')}"
        )
        sys.exit(0 if same else 1)


if __name__ == "__main__":
    main()
