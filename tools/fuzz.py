"""Robustness of the parsers: 10,000 generated files per parser, and all malformed files as a user meets them.

    uv run python tools/fuzz.py [--only NAME …] [--examples 10000] [--no-commands]

`tests/hostile` defines the parsers, their valid and malformed files, and the generator.
Each generated file is read by the parser in this process. Any exception other than
`InputError` counts as untyped. Malformed files are given to `srs-twin` in a separate
process with a wall time limit, or to the parser in a fresh Python where no command reads
such files. The script exits with 1 if an exception is untyped, or if a file is not
refused with exit code 2 within 2 s.
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

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "hostile"))
sys.path += [str(ROOT / "tests" / "helpers"), str(ROOT / "benchmarks")]

from common.grid import table  # noqa: E402
from harness import Malformed, Parser  # noqa: E402
from parsers import PARSERS  # noqa: E402

FRACTIONS = {"damaged": 0.4, "values": 0.4, "bytes": 0.2}
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
    """Outcome of the generated files of one parser."""

    tried: int = 0
    read: int = 0
    seconds: float = 0.0
    slowest_s: float = 0.0
    untyped: Counter[str] = field(default_factory=Counter)


def main() -> None:
    """Print two tables; exit with 1 if any file has a wrong outcome."""
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = [parser.name for parser in PARSERS]
    words.add_argument("--only", nargs="+", choices=names, default=names)
    words.add_argument("--examples", type=int, default=10_000)
    words.add_argument(
        "--no-commands", action="store_true", help="read the generated files only"
    )
    given_words = words.parse_args()
    chosen = [parser for parser in PARSERS if parser.name in given_words.only]
    rows = []
    faults = 0
    for parser in chosen:
        result = generate(parser, given_words.examples)
        faults += sum(result.untyped.values())
        rows.append(
            [
                parser.name,
                str(result.tried),
                str(result.read),
                str(sum(result.untyped.values())),
                f"{1e3 * result.seconds / result.tried:.1f}",
                f"{result.slowest_s:.2f}",
            ]
        )
        for error, times in result.untyped.items():
            print(f"{parser.name}: untyped, {times} times: {error}", flush=True)
    head = ["parser", "generated", "read", "untyped", "mean, ms", "slowest, s"]
    print(f"\nGenerated files\n\n{table(head, rows)}\n", flush=True)
    if not given_words.no_commands:
        faults += commands(chosen)
    sys.exit(1 if faults else 0)


def generate(parser: Parser, examples: int) -> Generated:
    """Read generated files with a parser."""
    result = Generated()
    with tempfile.TemporaryDirectory() as room:
        path = parser.path_in(Path(room))
        for generator, fraction in FRACTIONS.items():

            @settings(
                max_examples=max(1, round(fraction * examples)),
                deadline=None,
                database=None,
                phases=[Phase.generate],
                suppress_health_check=list(HealthCheck),
            )
            @given(parser.generated[generator])
            def look(content: bytes) -> None:
                begun = time.perf_counter()
                try:
                    result.read += parser.read_or_reject(content, path) is None
                except (
                    Exception
                ) as error:  # unforeseen exceptions are what the test looks for
                    last = traceback.extract_tb(error.__traceback__)[-1]
                    message = " ".join(str(error).split())[:200]
                    result.untyped[
                        f"{type(error).__name__}: {message}"
                        f" ({last.filename}:{last.lineno})"
                    ] += 1
                spent = time.perf_counter() - begun
                result.tried += 1
                result.seconds += spent
                result.slowest_s = max(result.slowest_s, spent)
                if result.tried % 1000 == 0:
                    print(
                        f"{parser.name}: {result.tried} of {examples}",
                        file=sys.stderr,
                        flush=True,
                    )

            look()
    return result


def commands(chosen: list[Parser]) -> int:
    """Run the command line on every malformed file; return the number of wrong refusals."""
    rows = []
    faults = 0
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
        print(
            f"{parser.name}: {len(times)} malformed files", file=sys.stderr, flush=True
        )
    head = ["parser", "malformed", "wrong refusals", "median, s", "slowest, s"]
    print(f"Malformed files, each in a separate process\n\n{table(head, rows)}")
    return faults


def start(parser: Parser, malformed: Malformed) -> tuple[float, str]:
    """Return the time to refuse a file (s) and the errors in the refusal."""
    with tempfile.TemporaryDirectory() as room:
        path = parser.path_in(Path(room))
        malformed.write(path)
        words = [
            str(Path(sys.executable).with_name("srs-twin")),
            *parser.arguments(Path(path.name)),
        ]
        if not parser.command:
            words = [sys.executable, "-c", IN_PYTHON, parser.function, path.name]
        before = {item.name for item in Path(room).iterdir()}
        begun = time.perf_counter()
        try:
            done = subprocess.run(
                words,
                cwd=room,
                capture_output=True,
                text=True,
                timeout=HANGS_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return HANGS_S, f"did not end within {HANGS_S:g} s"
        taken = time.perf_counter() - begun
        left = {item.name for item in Path(room).iterdir()} - before
    checks = {
        f"exit code {done.returncode}": done.returncode == 2,
        f"message {done.stderr[:200]!r}": (
            malformed.says in done.stderr and path.name in done.stderr
        ),
        "a traceback": "Traceback" not in done.stderr,
        f"wrote {sorted(left)}": not left,
        f"took {taken:.2f} s": taken < LIMIT_S,
    }
    return taken, "; ".join(what for what, fine in checks.items() if not fine)


if __name__ == "__main__":
    main()
