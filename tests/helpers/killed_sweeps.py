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
    """Kills of a sweep.

    Attributes:
        victims: number of kills of "sweep", "worker" and "server".
        starts: number of starts of the sweep.
        rows: number of stored rows after each kill.
    """

    victims: Counter[str] = field(default_factory=Counter)
    starts: int = 0
    rows: list[int] = field(default_factory=list)


def disturbed(
    sweep: Path, out: Path, kills: int, rng: random.Random, longest: float
) -> Kills:
    """Run a sweep to its end while its processes are killed a number of times.

    Args:
        sweep: sweep file.
        out: folder of the results.
        kills: number of kills.
        rng: random generator for times and victims.
        longest: longest time to the next kill, s, from a start or the death of a
            worker, or (with probability 0.7) from the first row after it.

    Raises:
        RuntimeError: the sweep failed by itself, or ended before all kills.
    """
    result = Kills()
    while True:
        process = start(sweep, out)
        result.starts += 1
        while sum(result.victims.values()) < kills:
            if rng.random() < 0.7:
                _wait_for_a_row(process, out)
            if _ended(process, rng.uniform(0, longest)):
                if process.returncode == WORKERS_DIED:
                    break
                raise RuntimeError(
                    f"complete after only {sum(result.victims.values())} kills: use"
                    " more runs"
                )
            who, pid = _victim(process.pid, rng)
            with contextlib.suppress(
                ProcessLookupError
            ):  # ended by itself, or with its server, just now
                os.kill(pid, signal.SIGKILL)
                result.victims[who] += 1
            if who == "sweep":
                break
        code = process.wait()
        result.rows.append(rows(out))
        if code == 0:
            return result
        # A point whose workers were killed three times in a row becomes a failed row,
        # which is repeated. The sweep itself ends if three workers in a row are killed
        # before they begin.
        if code not in (-signal.SIGKILL, WORKERS_DIED):
            raise RuntimeError(
                f"the sweep ended with {code}:"
                f" {process.stderr.read() if process.stderr else ''}"
            )


def start(sweep: Path, out: Path) -> subprocess.Popen[str]:
    """Start a sweep with two workers."""
    words = [
        str(COMMAND),
        "sweep",
        str(sweep),
        "--out",
        str(out),
        "--workers",
        "2",
        "-q",
        "--retry-failed",
    ]
    return subprocess.Popen(words, stderr=subprocess.PIPE, text=True)


def _victim(sweep: int, rng: random.Random) -> tuple[str, int]:
    """Choose the process to kill: the sweep with probability 0.5, otherwise a worker or the fork server."""
    if rng.random() < 0.5:
        return "sweep", sweep
    servers = [pid for pid in children(sweep) if b"forkserver" in _command_line(pid)]
    workers = [pid for server in servers for pid in children(server)]
    if workers and rng.random() < 0.8:
        return "worker", rng.choice(workers)
    return ("server", servers[0]) if servers else ("sweep", sweep)


def children(pid: int) -> list[int]:
    """Return the child processes of a process."""
    try:
        return [
            int(item)
            for item in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        ]
    except (FileNotFoundError, ProcessLookupError):
        return []


def _command_line(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""


def rows(out: Path) -> int:
    """Return the number of stored rows, as seen by another process."""
    from srs_twin.studies.sweep.store import FILE, RowStore

    if not (out / FILE).exists():
        return 0
    for _ in range(100):
        try:
            with RowStore(out) as store:
                return len(store.keys(failed=True))
        except Exception:
            time.sleep(0.05)  # a killed process keeps the lock briefly
    raise RuntimeError("the folder remains locked")


def digest(out: Path) -> tuple[int, str]:
    """Return the number of runs of a complete sweep, and the digest of its results."""
    about = json.loads((out / "sweep.json").read_text())
    return about["done"], about["results_sha256"]


def pages(log: Path) -> int:
    """Return the number of pages in the write-ahead log of a running sweep."""
    try:
        return log.stat().st_size // 4096
    except FileNotFoundError:
        return 0


def _wait_for_a_row(process: subprocess.Popen[str], out: Path) -> None:
    """Wait until a sweep stores another row or ends."""
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
