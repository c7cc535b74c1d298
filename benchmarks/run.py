"""List, run and check the studies of this folder.

    uv run python benchmarks/run.py --list           # titles, times, ages of the results
    uv run python benchmarks/run.py NAME …           # run studies and store their results
    uv run python benchmarks/run.py --stale          # studies whose code changed; exit 1 if any
    uv run python benchmarks/run.py --confirm NAME   # repeat the reduced size of a study
    uv run python benchmarks/run.py --pages          # write stored tables into docs/

A stored result contains the tables of the default size, and of the reduced size if the
study has one, from the same code. `--confirm` repeats the reduced size. If its numbers
agree, the result counts as current again, and the confirmation is recorded in the file.
After each run, the pages that have markers of the study get its tables, with the date
and the commit (`common/study_pages.py`).
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, date, datetime
from pathlib import Path

from common.freshness import digests
from common.grid import table
from common.results import (
    TOLERANCE,
    Confirmation,
    Result,
    Table,
    difference,
    load_result,
    parse_output,
    save_result,
    stamp,
)
from common.studies import BENCHMARKS, OUT, STUDIES, script_of, title_of
from common.study_pages import update_pages

from srs_twin.io.provenance import Provenance


def output_of(name: str, arguments: Sequence[str]) -> str:
    """Run the script of a study, print its output, and return it.

    Raises:
        RuntimeError: the script failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        words = [word.replace(OUT, folder) for word in arguments]
        command = [sys.executable, str(script_of(name)), *words]
        lines = []
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                print(line, end="", flush=True)
                lines.append(line)
    if process.returncode:
        raise RuntimeError(f"exit code {process.returncode}")
    return "".join(lines)


def digests_of(name: str) -> dict[str, str]:
    """Return the digests of what decides the result of a study."""
    return digests(script_of(name), STUDIES[name].inputs)


def run(name: str) -> None:
    """Run a study at its default and its reduced size, and store the result."""
    study = STUDIES[name]
    code = digests_of(name)
    start = time.monotonic()
    # Texts of the result must not depend on the folder of the checkout or of the user.
    output = output_of(name, study.arguments).replace(f"{BENCHMARKS.parent}/", "")
    output = output.replace(f"{Path.home()}/", "~/")
    tables, text = parse_output(output)
    minutes = (time.monotonic() - start) / 60
    if not tables:
        raise RuntimeError("the script printed no table")
    reduced: list[Table] = []
    if study.reduced is not None:
        reduced = _reduced(name)
    if code != digests_of(name):
        raise RuntimeError("the code changed during the run")
    save_result(
        Result(
            study=name,
            title=title_of(name),
            stamp=stamp(),
            seeds=study.seeds,
            arguments=list(study.arguments),
            minutes=round(minutes, 2),
            tables=tables,
            text=text,
            reduced_arguments=_reduced_arguments(name),
            reduced=reduced,
            digests=code,
        )
    )


def _reduced_arguments(name: str) -> list[str]:
    study = STUDIES[name]
    return list(study.arguments if study.reduced is None else study.reduced)


def _reduced(name: str) -> list[Table]:
    return parse_output(output_of(name, _reduced_arguments(name)))[0]


def confirm(name: str) -> None:
    """Repeat the reduced size of a study, and record that it reproduces the result.

    Raises:
        RuntimeError: there is no result, or the numbers differ.
    """
    result = load_result(name)
    if result is None:
        raise RuntimeError("there is no stored result; run the study")
    if result.reduced_arguments != _reduced_arguments(name):
        raise RuntimeError("the reduced size changed; run the study")
    code = digests_of(name)
    stored = result.reduced or result.tables
    found = difference(stored, _reduced(name))
    if found > TOLERANCE:
        raise RuntimeError(
            f"a number of the reduced size differs by {found:.1%} of the largest in its"
            f" column, more than {TOLERANCE:.1%}; run the study"
        )
    result.digests = code
    result.confirmed.append(Confirmation(stamp(), found))
    save_result(result)


def stale() -> dict[str, str]:
    """Return the reason for each study whose stored result is not current."""
    reasons = {}
    for name in STUDIES:
        result = load_result(name)
        if result is None:
            reasons[name] = "never run"
        elif tuple(result.arguments) != STUDIES[name].arguments:
            reasons[name] = "another default size"
        else:
            before = Provenance({}, sources=result.digests)
            now = Provenance({}, sources=digests_of(name))
            reasons[name] = now.difference(before)
    return {name: reason for name, reason in reasons.items() if reason}


def listing(today: date) -> str:
    """Return the table of all studies."""
    rows = []
    for name, study in STUDIES.items():
        result = load_result(name)
        age = commit = "–"
        minutes = f"about {study.minutes:g}"
        if result:
            last = result.confirmed[-1].stamp if result.confirmed else result.stamp
            age = f"{(today - date.fromisoformat(last.date)).days} d"
            commit = last.commit
            minutes = f"{result.minutes:g}"
        rows.append([name, title_of(name), minutes, age, commit, f"docs/{study.page}"])
    return table(["study", "title", "minutes", "age", "commit", "page"], rows)


def main() -> int:
    """Do what the options ask for; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="studies to run")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--list", action="store_true", help="list all studies")
    what.add_argument(
        "--stale", action="store_true", help="list studies without a current result"
    )
    what.add_argument(
        "--confirm", action="store_true", help="repeat the reduced size of the studies"
    )
    what.add_argument(
        "--pages", action="store_true", help="write the stored tables into docs/"
    )
    options = parser.parse_args()
    if options.list:
        print(listing(datetime.now(UTC).date()))
        return 0
    if options.stale:
        reasons = stale()
        for name, reason in reasons.items():
            print(f"{name}: {reason}")
        return int(bool(reasons))
    if options.pages:
        _update_pages()
        return 0
    if not options.names:
        parser.error("give the names of studies, --list, --stale or --pages")
    if unknown := [name for name in options.names if name not in STUDIES]:
        parser.error(f"no such study: {', '.join(unknown)}; --list shows all")
    code = 0
    for name in options.names:
        try:
            (confirm if options.confirm else run)(name)
        except RuntimeError as error:
            print(f"{name}: {error}", file=sys.stderr)
            code = 1
        else:
            _update_pages()
    return code


def _update_pages() -> None:
    for path in update_pages():
        print(f"updated: docs/{path.name}")


if __name__ == "__main__":
    sys.exit(main())
