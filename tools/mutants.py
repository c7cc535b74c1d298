"""Mutation testing: random mutants of the sources, each of which the tests should detect.

A file of srs_twin is drawn with a probability proportional to its lines of code, then a
line, a kind of mutation and a mutation. Each mutant is put into a copy of the sources.
The nearest tests run first, then the rest of the default run. A mutant survives if all
of them pass. Mutants in equivalent_mutants.yaml change no result, for the reason given
there, and are skipped.

With a file of coverage contexts, the tests that execute the mutated line run instead of
the nearest ones, and the survivors run together in one default run at the end:

    uv run --with pytest-cov pytest --cov=srs_twin --cov-context=test --cov-report=
    uv run --with coverage python tools/mutants.py --seed 7 --contexts .coverage

Compiled kernels are not traced, so their lines have no contexts. Mutants there run the
nearest tests.
"""

from __future__ import annotations

import argparse
import ast
import functools
import json
import queue
import random
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml
from faults import ROOT, copied_to, failures, first_failure
from mutations import Mutation, changes_program, code_lines, mutations

_NEAREST = 6
"""Number of nearest test files that run before the whole default run."""

_MOST = 150
"""Maximum number of tests by contexts; a line of a common path is executed by thousands."""


@dataclass(frozen=True)
class Mutant:
    """Mutation of a file."""

    file: str
    mutation: Mutation

    def __str__(self) -> str:
        change = self.mutation
        return f"{self.file}:{change.line} {change.kind}: {change.old} → {change.new}"


def main() -> None:
    """Draw mutants and run the tests on them; exit with 1 if one survives."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--count", type=int, default=40, help="number of mutants")
    parser.add_argument(
        "--only",
        type=int,
        nargs="*",
        help="numbers of the mutants to try (default: all)",
    )
    parser.add_argument(
        "--list", action="store_true", help="print the mutants and stop"
    )
    parser.add_argument(
        "--nearest", action="store_true", help="try the nearest test files only"
    )
    parser.add_argument(
        "--contexts",
        type=Path,
        help="coverage file with the tests that execute each line",
    )
    parser.add_argument(
        "--jobs", type=int, default=1, help="number of parallel mutants"
    )
    parser.add_argument(
        "--json", type=Path, help="file for the mutants and their first failing tests"
    )
    parser.add_argument(
        "--folder", type=Path, help="keep the copies and their machine code here"
    )
    chosen = parser.parse_args()
    mutants = list(enumerate(draw(chosen.seed, chosen.count), 1))
    mutants = [item for item in mutants if not chosen.only or item[0] in chosen.only]
    if chosen.list:
        for number, mutant in mutants:
            print(f"{number:3} {mutant}\n      {line_of(mutant)}")
        return
    tried = [item for item in mutants if not why_equivalent(item[1])]
    with tempfile.TemporaryDirectory() as temporary:
        folder = chosen.folder or Path(temporary)
        if chosen.contexts:
            executed = tests_by_mutant(dict(tried), chosen.contexts)
        else:
            executed = None
        result = try_all(tried, folder, chosen.jobs, chosen.nearest, executed)
        if executed is not None and not chosen.nearest:
            survivors = [item for item in tried if result[item[0]] is None]
            result |= try_together(survivors, folder) if survivors else {}
    if chosen.json:
        rows = [
            {"number": number, "file": mutant.file, **asdict(mutant.mutation)}
            | {"found_by": result.get(number), "equivalent": why_equivalent(mutant)}
            for number, mutant in mutants
        ]
        chosen.json.write_text(json.dumps(rows, indent=1, ensure_ascii=False), "utf-8")
    left = [str(mutant) for number, mutant in tried if result[number] is None]
    print(
        f"{len(tried) - len(left)} of {len(tried)} mutants found,"
        f" {len(mutants) - len(tried)} equivalent"
    )
    print("Survivors:", *(left or ["none"]), sep="\n  ")
    sys.exit(bool(left))


def draw(seed: int, count: int) -> Iterator[Mutant]:
    """Yield mutants of different lines; the same seed gives the same ones."""
    random_numbers = random.Random(seed)
    files = sorted(
        path.relative_to(ROOT).as_posix() for path in (ROOT / "srs_twin").rglob("*.py")
    )
    weights = [code_lines(text_of(file)) for file in files]
    drawn: set[tuple[str, int]] = set()
    while len(drawn) < count:
        file = random_numbers.choices(files, weights)[0]
        possible = mutations_of(file)
        if not possible:
            continue
        line = random_numbers.choice(sorted({item.line for item in possible}))
        here = [item for item in possible if item.line == line]
        kind = random_numbers.choice(sorted({item.kind for item in here}))
        mutation = random_numbers.choice([item for item in here if item.kind == kind])
        if (file, line) not in drawn and changes_program(mutation, text_of(file)):
            drawn.add((file, line))
            yield Mutant(file, mutation)


@functools.cache
def text_of(file: str) -> str:
    """Return the text of a file of the checkout."""
    return (ROOT / file).read_text("utf-8")


@functools.cache
def mutations_of(file: str) -> list[Mutation]:
    """Return the mutations of a file of the checkout."""
    return mutations(text_of(file))


def line_of(mutant: Mutant) -> str:
    """Return the line that is mutated."""
    return text_of(mutant.file).splitlines()[mutant.mutation.line - 1].strip()


def why_equivalent(mutant: Mutant) -> str | None:
    """Return the listed reason why a mutant changes no result; None if it is not listed."""
    change = f"{mutant.mutation.old} → {mutant.mutation.new}"
    for item in yaml.safe_load(
        (ROOT / "tools/equivalent_mutants.yaml").read_text("utf-8")
    ):
        if (item["file"], item["line"], item["change"]) == (
            mutant.file,
            line_of(mutant),
            change,
        ):
            return str(item["why"])
    return None


def tests_by_mutant(mutants: dict[int, Mutant], contexts: Path) -> dict[int, list[str]]:
    """Return the tests that execute the line of each mutant, fewest lines of the file first.

    Args:
        mutants: mutants by their number.
        contexts: coverage file that was recorded with one context per test.
    """
    from coverage import CoverageData

    data = CoverageData(str(contexts))
    data.read()
    tests = {}
    for number, mutant in mutants.items():
        name = next(
            (name for name in data.measured_files() if name.endswith(mutant.file)), ""
        )
        by_line = data.contexts_by_lineno(name) if name else {}
        lines = Counter(
            context.rpartition("|")[0]
            for line_contexts in by_line.values()
            for context in line_contexts
        )
        here = {
            context.rpartition("|")[0]
            for context in by_line.get(mutant.mutation.line, ())
            if context
        }
        tests[number] = sorted(here, key=lambda test: (lines[test], test))
    return tests


def try_together(
    survivors: list[tuple[int, Mutant]], folder: Path
) -> dict[int, str | None]:
    """Run the default suite once on all survivors together.

    The tests that fail then run on each survivor alone.

    Returns:
        The first failing test of each survivor, by its number.
    """
    copy = copied_to(folder / "together")
    changes: dict[str, list[Mutation]] = {}
    for _, mutant in survivors:
        changes.setdefault(mutant.file, []).append(mutant.mutation)
    for file, of_file in changes.items():
        text = text_of(file)
        # From the end, so that positions of the earlier mutations stay valid.
        for mutation in sorted(of_file, key=lambda item: item.line, reverse=True):
            text = mutation.applied(text)
        (copy / file).write_text(text, "utf-8")
    failed = failures(copy, [])
    print(f"default run with {len(survivors)} survivors together:", *failed, sep="\n  ")
    if not failed:
        return {}
    alone = copied_to(folder / "copy0")
    return {
        number: first_failing(mutant, alone, True, failed)
        for number, mutant in survivors
    }


def try_all(
    mutants: list[tuple[int, Mutant]],
    folder: Path,
    jobs: int,
    nearest: bool,
    executed: dict[int, list[str]] | None,
) -> dict[int, str | None]:
    """Return the first failing test of each mutant, by its number; None for survivors."""
    copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
    for job in range(jobs):
        copies.put(copied_to(folder / f"copy{job}"))

    def tried(numbered: tuple[int, Mutant]) -> tuple[int, str | None]:
        copy = copies.get()
        try:
            tests = executed[numbered[0]] if executed is not None else []
            failed = first_failing(
                numbered[1], copy, nearest or executed is not None, tests
            )
        finally:
            copies.put(copy)
        print(f"{numbered[0]:3} {numbered[1]}: {failed or 'SURVIVED'}", flush=True)
        return numbered[0], failed

    with ThreadPoolExecutor(jobs) as pool:
        return dict(pool.map(tried, mutants))


def first_failing(
    mutant: Mutant, copy: Path, nearest: bool, executed: list[str]
) -> str | None:
    """Return the first test that fails with a mutant; None if it survives.

    Args:
        mutant: mutant to try.
        copy: folder of the copy.
        nearest: whether only the nearest test files run.
        executed: tests that execute the line and replace the nearest ones; empty if
            they are unknown.
    """
    source = copy / mutant.file
    text = text_of(mutant.file)
    files = test_files(mutant)
    source.write_text(mutant.mutation.applied(text), "utf-8")
    try:
        if executed:
            return first_failure(copy, ["-n", "0", *executed[:_MOST]])
        failed = first_failure(copy, ["-n", "0", *files[:_NEAREST]])
        if failed is None and not nearest:
            failed = first_failure(copy, ["-n", "1", *files[_NEAREST:]])
        return failed
    finally:
        source.write_text(text, "utf-8")


def test_files(mutant: Mutant) -> list[str]:
    """Return all test files, ordered by how many names of the mutant's module and scopes they contain."""
    module = Path(mutant.file).with_suffix("")
    names = {*module.parts[1:], *scopes(mutant)} - {"__init__"}
    dotted = ".".join(module.parts).removesuffix(".__init__")

    def distance(file: Path) -> tuple[float, str]:
        text = file.read_text("utf-8")
        words = set(re.findall(r"\w+", text))
        alike = len(names & set(re.findall(r"[a-z]+", file.stem)))
        return -len(names & words) - 2 * (dotted in text) - alike, file.as_posix()

    files = sorted((ROOT / "tests").rglob("test_*.py"), key=distance)
    return [file.relative_to(ROOT).as_posix() for file in files]


def scopes(mutant: Mutant) -> Iterator[str]:
    """Yield the names of the classes and functions around a mutation."""
    for node in ast.walk(ast.parse(text_of(mutant.file))):
        if not isinstance(node, ast.ClassDef | ast.FunctionDef):
            continue
        if node.lineno <= mutant.mutation.line <= (node.end_lineno or node.lineno):
            yield node.name


if __name__ == "__main__":
    main()
