"""Sweeps whose processes are killed at random until the sweep is complete."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

SWEEP = """\
scenario: gen2_straight
plants: [analytical]
fixed: {{duration_s: {duration}}}
vary:
  controller.frequency_hz: {{from: 1, to: 2, count: {runs}}}
"""
COMMAND = Path(sys.executable).with_name("srs-twin")
WORKERS_DIED = 4


@dataclass
class Kills:
    """What was killed.

    Attributes:
        victims: "sweep", "worker" or "server" → how often.
        starts: how often the sweep was started.
        rows: rows that were there after each kill.
    """

    victims: Counter[str] = field(default_factory=Counter)
    starts: int = 0
    rows: list[int] = field(default_factory=list)


def disturbed(sweep: Path, out: Path, kills: int, rng: random.Random, longest: float) -> Kills:
    """Run a sweep to its end; kill it or a worker that many times on the way.

    Args:
        sweep: the file.
        out: the folder of its results.
        kills: how many.
        rng: decides when and whom.
        longest: the longest time to the next kill, s: from a start or the death of a worker, or (seven times
            of ten) from the first row after that.

    Raises:
        RuntimeError: the sweep failed by itself, or was done before all the kills.
    """
    found = Kills()
    while True:
        process = start(sweep, out)
        found.starts += 1
        while sum(found.victims.values()) < kills:
            if rng.random() < 0.7:
                _wait_for_a_row(process, out)
            if _ended(process, rng.uniform(0, longest)):
                if process.returncode == WORKERS_DIED:
                    break
                raise RuntimeError(f"done after {sum(found.victims.values())} kills only: take more runs")
            who, pid = _victim(process.pid, rng)
            with contextlib.suppress(ProcessLookupError):  # ended by itself, or with its server, just now
                os.kill(pid, signal.SIGKILL)
                found.victims[who] += 1
            if who == "sweep":
                break
        code = process.wait()
        found.rows.append(rows(out))
        if code == 0:
            return found
        # A point whose workers were killed three times in a row is a failed row, and tried again; so is the
        # sweep where three workers in a row were killed before they could begin.
        if code not in (-signal.SIGKILL, WORKERS_DIED):
            raise RuntimeError(
                f"the sweep ended with {code}: {process.stderr.read() if process.stderr else ''}"
            )


def start(sweep: Path, out: Path) -> subprocess.Popen[str]:
    """Start a sweep of two workers."""
    words = [str(COMMAND), "sweep", str(sweep), "--out", str(out), "--workers", "2", "-q", "--retry-failed"]
    return subprocess.Popen(words, stderr=subprocess.PIPE, text=True)


def _victim(sweep: int, rng: random.Random) -> tuple[str, int]:
    """Choose who is killed: the sweep every other time, else a worker, now and then the server."""
    if rng.random() < 0.5:
        return "sweep", sweep
    servers = [pid for pid in children(sweep) if b"forkserver" in _command_line(pid)]
    workers = [pid for server in servers for pid in children(server)]
    if workers and rng.random() < 0.8:
        return "worker", rng.choice(workers)
    return ("server", servers[0]) if servers else ("sweep", sweep)


def children(pid: int) -> list[int]:
    """Return the processes that a process has started."""
    try:
        return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except (FileNotFoundError, ProcessLookupError):
        return []


def _command_line(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""


def rows(out: Path) -> int:
    """Return how many rows a folder has, seen from outside."""
    from srs_twin.studies.sweep.store import FILE, RowStore

    if not (out / FILE).exists():
        return 0
    for _ in range(100):
        try:
            with RowStore(out) as store:
                return len(store.keys(failed=True))
        except Exception:
            time.sleep(0.05)  # a killed process takes a moment to let go
    raise RuntimeError("the folder stays locked")


def digest(out: Path) -> tuple[int, str]:
    """Return how many runs a finished sweep has done, and the digest of its results."""
    about = json.loads((out / "sweep.json").read_text())
    return about["done"], about["results_sha256"]


def pages(log: Path) -> int:
    """Return how many pages a running sweep has written to the log of its rows."""
    try:
        return log.stat().st_size // 4096
    except FileNotFoundError:
        return 0


def _wait_for_a_row(process: subprocess.Popen[str], out: Path) -> None:
    """Wait until a sweep writes a row or ends."""
    log = out / "rows.sqlite-wal"
    before = pages(log)
    while process.poll() is None and pages(log) == before:
        time.sleep(0.01)


def _ended(process: subprocess.Popen[str], within: float) -> bool:
    try:
        process.wait(within)
    except subprocess.TimeoutExpired:
        return False
    return True
