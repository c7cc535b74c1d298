"""Ten thousand generated files a parser, and every malformed file as a person would meet it.

    uv run python benchmarks/fuzz.py [--only NAME …] [--examples 10000] [--no-commands]

The parsers, their good and malformed files and how files are generated stand in ``tests/hostile``. Generated
files go through the parser in this process (MJCF: each in a process of its own, forked from a warm one), and
anything but an `InputError` counts as untyped. Malformed files go through ``srs-twin`` in a process of their
own, with its wall time; where no command reads such files, through the parser in a fresh Python. Exits with
1 where anything is untyped, is not refused with exit code 2, or takes longer than 2 s.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, settings

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "hostile"))

from grid import table  # noqa: E402
from harness import Malformed, Parser  # noqa: E402
from parsers import PARSERS  # noqa: E402

SHARES = {"damaged": 0.4, "values": 0.4, "bytes": 0.2}
LIMIT_S = 2.0
HANGS_S = 60.0
IN_PYTHON = """
import sys
from operator import attrgetter
from importlib import import_module
from pathlib import Path
from srs_twin.errors import InputError
module, _, name = sys.argv[1].partition(":")
try:
    attrgetter(name)(import_module(module))(Path(sys.argv[2]))
except InputError as error:
    print(error, file=sys.stderr)
    sys.exit(error.exit_code)
"""


@dataclass
class Generated:
    """What generated files did to a parser."""

    tried: int = 0
    read: int = 0
    seconds: float = 0.0
    slowest_s: float = 0.0
    untyped: Counter[str] = field(default_factory=Counter)


def main() -> None:
    """Print two tables; exit with 1 where anything is not as it should be."""
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = [parser.name for parser in PARSERS]
    words.add_argument("--only", nargs="+", choices=names, default=names)
    words.add_argument("--examples", type=int, default=10_000)
    words.add_argument("--no-commands", action="store_true", help="generated files only")
    given_words = words.parse_args()
    chosen = [parser for parser in PARSERS if parser.name in given_words.only]
    rows, faults = [], 0
    for parser in chosen:
        found = generate(parser, given_words.examples)
        faults += sum(found.untyped.values())
        rows.append([
            parser.name, str(found.tried), str(found.read), str(sum(found.untyped.values())),
            f"{1e3 * found.seconds / found.tried:.1f}", f"{found.slowest_s:.2f}",
        ])  # fmt: skip
        for error, times in found.untyped.items():
            print(f"{parser.name}: untyped, {times} times: {error}", flush=True)
    head = ["parser", "generated", "read", "untyped", "mean, ms", "slowest, s"]
    print(f"\nGenerated files\n\n{table(head, rows)}\n", flush=True)
    if not given_words.no_commands:
        faults += commands(chosen)
    sys.exit(1 if faults else 0)


def generate(parser: Parser, examples: int) -> Generated:
    """Let a parser read generated files."""
    found = Generated()
    with tempfile.TemporaryDirectory() as room:
        path = parser.path_in(Path(room))
        for way, share in SHARES.items():

            @settings(
                max_examples=max(1, round(share * examples)), deadline=None, database=None,
                phases=[Phase.generate], suppress_health_check=list(HealthCheck),
            )  # fmt: skip
            @given(parser.generated[way])
            def look(content: bytes) -> None:
                begun = time.perf_counter()
                try:
                    found.read += parser.read_or_reject(content, path) is None
                except Exception as error:  # whatever nobody foresaw is what is looked for
                    last = traceback.extract_tb(error.__traceback__)[-1]
                    said = " ".join(str(error).split())[:200]
                    found.untyped[f"{type(error).__name__}: {said} ({last.filename}:{last.lineno})"] += 1
                spent = time.perf_counter() - begun
                found.tried += 1
                found.seconds += spent
                found.slowest_s = max(found.slowest_s, spent)
                if found.tried % 1000 == 0:
                    print(f"{parser.name}: {found.tried} of {examples}", file=sys.stderr, flush=True)

            look()
    return found


def commands(chosen: list[Parser]) -> int:
    """Start the command line on every malformed file; return how many were not refused as they should be."""
    rows, faults = [], 0
    for parser in chosen:
        times: list[tuple[float, str]] = []
        bad = 0
        for malformed in parser.all_malformed:
            taken, wrong = start(parser, malformed)
            times.append((taken, malformed.name))
            if wrong:
                bad += 1
                print(f"{parser.name}: {malformed.name}: {wrong}", flush=True)
        times.sort(reverse=True)
        middle = times[len(times) // 2][0]
        slowest = f"{times[0][0]:.2f} ({times[0][1]})"
        rows.append([parser.name, str(len(times)), str(bad), f"{middle:.2f}", slowest])
        faults += bad
        print(f"{parser.name}: {len(times)} malformed files", file=sys.stderr, flush=True)
    head = ["parser", "malformed", "not as they should be", "median, s", "slowest, s"]
    print(f"Malformed files, each in a process of its own\n\n{table(head, rows)}")
    return faults


def start(parser: Parser, malformed: Malformed) -> tuple[float, str]:
    """Return how long a process needs to refuse a file (s), and what is wrong with how it does."""
    with tempfile.TemporaryDirectory() as room:
        path = parser.path_in(Path(room))
        malformed.write(path)
        words = [str(Path(sys.executable).with_name("srs-twin")), *parser.arguments(Path(path.name))]
        if not parser.command:
            words = [sys.executable, "-c", IN_PYTHON, parser.function, path.name]
        before = {each.name for each in Path(room).iterdir()}
        begun = time.perf_counter()
        try:
            done = subprocess.run(words, cwd=room, capture_output=True, text=True, timeout=HANGS_S)
        except subprocess.TimeoutExpired:
            return HANGS_S, f"did not end within {HANGS_S:g} s"
        taken = time.perf_counter() - begun
        left = {each.name for each in Path(room).iterdir()} - before
    checks = {
        f"exit code {done.returncode}": done.returncode == 2,
        f"message {done.stderr[:200]!r}": malformed.message in done.stderr and path.name in done.stderr,
        "a traceback": "Traceback" not in done.stderr,
        f"wrote {sorted(left)}": not left,
        f"took {taken:.2f} s": taken < LIMIT_S,
    }
    return taken, "; ".join(what for what, fine in checks.items() if not fine)


if __name__ == "__main__":
    main()
