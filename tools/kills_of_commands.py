"""Commands killed at random: whether every set of files is complete and the resumed result unchanged.

Part of `kills.py`. Each trial begins in an empty folder or in one with an earlier
result. The command and its workers are killed by SIGKILL, at a random time after the
start or just after the first file is written. It is started again until it ends. After
each kill, a folder with a completion mark must hold the files of a single result, the
earlier or the new one. At the end the folder must equal that of an undisturbed command.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from srs_twin.comparison.diff import Results, Tolerances, diff
from srs_twin.io.file_sets import replace_files

COMMAND = Path(sys.executable).with_name("srs-twin")
SCENARIO = """\
robot: gen2
duration_s: 0.5
controller: {kind: gait, frequency_hz: 2.0}
plants: {analytical: {model: compliant, friction: wheel}, twin: {}}
"""
SWEEP = """\
scenario: gen2_straight
plants: [analytical]
fixed: {duration_s: 2}
vary: {controller.frequency_hz: {from: 1.5, to: 2.5, count: COUNT}}
plots: [{kind: line, x: controller.frequency_hz, metric: com_speed_m_s}]
"""
STUDY = """\
scenario: gen2_straight
fixed: {duration_s: DURATION}
variables: {controller.frequency_hz: {low: 1.5, high: 2.5}}
objectives: [{metric: com_speed_m_s, goal: maximize}]
budget: {compliant: 12, twin: 5}
"""
FILES = {
    "scenario.yaml": SCENARIO,
    "earlier_sweep.yaml": SWEEP.replace("COUNT", "5"),
    "sweep.yaml": SWEEP.replace("COUNT", "9"),
    "earlier_study.yaml": STUDY.replace("DURATION", "2.5"),
    "study.yaml": STUDY.replace("DURATION", "2"),
}
_UNCERTAIN = "uncertainty gen2_straight --plants analytical --workers 1 --samples"
_TIMES = ("wall_s", "realtime_factor", "plan_s")


@dataclass(frozen=True)
class Case:
    """Command that is killed.

    Attributes:
        earlier: arguments of the command that makes the earlier result.
        words: arguments of the command that is killed.
        again: options that continue in a folder with the earlier result.
        mark: file that marks a set as complete.
        products: patterns of the files of a set.
    """

    earlier: str
    words: str
    again: str
    mark: str
    products: tuple[str, ...]


CASES = {
    "run": Case(
        "run ./scenario.yaml --set seed=7 --set controller.frequency_hz=1.9",
        "run ./scenario.yaml",
        "",
        "metrics.json",
        ("metrics.json", "scenario.resolved.yaml", "*.parquet"),
    ),
    "sweep": Case(
        "sweep earlier_sweep.yaml --workers 1",
        "sweep sweep.yaml --workers 1",
        "--changed",
        "sweep.json",
        ("sweep.json", "sweep.yaml", "scenario.resolved.yaml", "results.parquet"),
    ),
    "optimize": Case(
        "optimize ./earlier_study.yaml --workers 1",
        "optimize ./study.yaml --workers 1",
        "--changed",
        "study.json",
        ("study.json", "evaluations.parquet", "best/*.yaml"),
    ),
    "uncertainty": Case(
        f"{_UNCERTAIN} 16 --set duration_s=2",
        f"{_UNCERTAIN} 17 --set duration_s=2.2",
        "--changed",
        "intervals.json",
        (
            "intervals.json",
            "*.parquet",
            "analytical/sweep.json",
            "analytical/*.parquet",
        ),
    ),
    "reproduce": Case(
        "reproduce --only ilc-law --no-figures -j 1",
        "reproduce --only gen1-no-turn --only ilc-law --no-figures -j 1",
        "",
        "reproduce.json",
        ("reproduce.json",),
    ),
}


@dataclass
class Tally:
    """Counts of one command."""

    kills: int = 0
    trials: int = 0
    left: Counter[str] = field(
        default_factory=Counter
    )  # state of a folder after a kill → count
    faults: list[str] = field(default_factory=list)


def contents(folder: Path, case: Case) -> dict[tuple[str, str], Any]:
    """Return the values of a set by (file, position in it), without wall times."""
    result: dict[tuple[str, str], Any] = {}
    for path in sorted(
        {item for pattern in case.products for item in folder.glob(pattern)}
    ):
        name = str(path.relative_to(folder))
        if path.suffix == ".json":
            leaves = dict(_leaves(json.loads(path.read_text("utf-8")), ""))
        elif path.suffix == ".parquet":
            table = pq.read_table(path)
            leaves = {
                f"{name}[{k}]": v
                for name in table.column_names
                for k, v in enumerate(table[name].to_pylist())
            }
        else:
            leaves = {"": path.read_text("utf-8")}
        result |= {
            (name, place): "NaN"
            if isinstance(value, float) and math.isnan(value)
            else value
            for place, value in leaves.items()
            if place.rpartition(".")[2].partition("[")[0] not in _TIMES
        }
    return result


def _leaves(value: Any, place: str) -> Any:
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, f"{place}.{key}")
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _leaves(item, f"{place}[{k}]")
    else:
        yield place, value


def killed(name: str, room: Path, kills: int, rng: random.Random) -> Tally:
    """Kill a command at least the given number of times, until its last trial has ended."""
    case = CASES[name]
    tally = Tally()
    for kind, words in (("earlier", case.earlier), ("new", case.words)):
        began = time.perf_counter()
        _finish(room, f"{words} --out {name}-{kind}")
        took = time.perf_counter() - began
    sets = {
        kind: contents(room / f"{name}-{kind}", case) for kind in ("earlier", "new")
    }
    if not all(sets.values()) or sets["earlier"] == sets["new"]:
        raise RuntimeError(f"{name}: needs two different results")
    while tally.kills < kills:
        out = room / f"{name}-{tally.trials}"
        again = bool(case.again or name in ("run", "reproduce")) and rng.random() < 0.5
        if again:
            shutil.copytree(room / f"{name}-earlier", out)
        words = f"{case.words} {case.again if again else ''} --out {out.name}"
        tally.trials += 1
        while rng.random() < 0.75 and _kill(room, words, out, took, rng):
            tally.kills += 1
            marked = (out / case.mark).exists()
            left = contents(out, case) if marked else {}
            state = next(
                (kind for kind, whole in sets.items() if left == whole), "mixed"
            )
            tally.left[state if marked else "unmarked"] += 1
            if marked and state == "mixed":
                tally.faults.append(f"{name} {words}: mixed after kill {tally.kills}")
        _finish(room, words)
        moved = diff(
            *(Results(item, {}) for item in (sets["new"], contents(out, case))),
            Tolerances(rel=0, abs=0),
        )
        tally.faults += [f"{name} {words}: {item}" for item in moved.moved]
        if any(out.rglob(".part-*")):
            tally.faults.append(f"{name} {words}: a hidden folder remains")
        shutil.rmtree(out)
    return tally


def _start(room: Path, words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [str(COMMAND), *words.split(), "--quiet"],
        cwd=room,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def _finish(room: Path, words: str) -> None:
    for _ in range(50):
        process = _start(room, words)
        error_output = process.communicate()[1]
        if process.returncode in (0, 1):  # 1: a claim differs from the baseline
            return
        if "another sweep works" not in error_output:
            raise RuntimeError(
                f"{words}: exit code {process.returncode}: {error_output}"
            )
        time.sleep(0.1)  # a killed process keeps the lock briefly


def _kill(room: Path, words: str, out: Path, took: float, rng: random.Random) -> bool:
    """Start a command and kill it with its workers; return False if it ended before."""
    process = _start(room, words)
    with contextlib.suppress(subprocess.TimeoutExpired):
        if rng.random() < 0.5:
            process.wait(rng.uniform(0, took))
        else:
            while process.poll() is None and not any(_hidden(out)):
                time.sleep(0.001)
            process.wait(rng.choice((0.003, 0.03, 0.3)) * rng.random())
    ended = process.poll() is not None
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    return not ended


def _hidden(out: Path) -> list[Path]:
    return [*out.glob(".part-*"), *out.glob("*/.part-*")]


def finishes(folder: Path, count: int, workers: int = 4) -> Counter[str]:
    """Complete sets in one folder from several processes at once; count "whole" and "mixed" sets."""
    fork = get_context("fork")
    result = Counter[str]()
    rounds = -(-count // workers)
    gate = fork.Barrier(workers + 1)
    processes = [
        fork.Process(target=_finishes, args=(folder, k, rounds, gate))
        for k in range(workers)
    ]
    for item in processes:
        item.start()
    for _ in range(rounds):
        gate.wait()
        gate.wait()  # all processes have finished
        texts = {item.name: item.read_text() for item in folder.iterdir()}
        whole = texts.keys() == {*_SET} and len(set(texts.values())) == 1
        result["whole" if whole else "mixed"] += workers
    for item in processes:
        item.join()
        if item.exitcode:
            result["failed"] += 1
    return result


_SET = (
    "metrics.json",
    "scenario.resolved.yaml",
    "report.html",
    "recording.rrd",
    "analytical.parquet",
)


def _finishes(folder: Path, who: int, rounds: int, gate: Any) -> None:
    for number in range(rounds):
        gate.wait()
        with replace_files(folder, _SET) as fresh:
            for name in _SET:
                (fresh / name).write_text(f"{who} {number}")
        gate.wait()
