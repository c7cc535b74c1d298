"""The machine as a run sees it: processors, memory, room for results. Limits of a container count."""

from __future__ import annotations

import math
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from srs_twin.doctor.check import Check
from srs_twin.errors import InputError
from srs_twin.io.files import open_folder, shown

TOPIC = "machine"
LEAST_MEMORY_BYTES = 1 << 30
LEAST_DISK_BYTES = 512 << 20
_GROUP = Path("/sys/fs/cgroup")
_MEMINFO = Path("/proc/meminfo")


@dataclass(frozen=True)
class Machine:
    """What there is.

    Attributes:
        processors: how many this process may use.
        share: how many it is given the time of, where a container limits that.
        memory: free, bytes; None where the system does not say.
    """

    processors: int
    share: float | None
    memory: int | None

    @staticmethod
    def here(group: Path = _GROUP, meminfo: Path = _MEMINFO) -> Machine:
        """Ask the system.

        Args:
            group: folder of the control group (version 2) that this process sees as its own.
            meminfo: the kernel's table of memory.
        """
        usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        quota, _, period = _words(group / "cpu.max").partition(" ")
        share = int(quota) / int(period) if quota.isdigit() and period.isdigit() else None
        limit, used = (_words(group / name) for name in ("memory.max", "memory.current"))
        within = int(limit) - int(used) if limit.isdigit() and used.isdigit() else None
        free = [each for each in (_available(meminfo), within) if each is not None]
        return Machine(usable, share, min(free, default=None))


def _words(path: Path) -> str:
    try:
        return path.read_text("ascii").strip()
    except OSError:
        return ""


def _available(meminfo: Path) -> int | None:
    """Return the memory that new programs can have without swapping, bytes."""
    for line in _words(meminfo).splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


def processors_check(machine: Machine) -> Check:
    """Judge the processors; one is enough."""
    detail = f"{machine.processors} usable"
    if machine.share is not None and machine.share < machine.processors:
        detail += f", with the time of {machine.share:.3g}"
        if math.ceil(machine.share) < machine.processors:
            remedy = f"more workers than that only wait: give --jobs {math.ceil(machine.share)}"
            return Check(TOPIC, "processors", "missing", detail, remedy)
    return Check(TOPIC, "processors", "ok", detail)


def memory_check(machine: Machine) -> Check:
    """Judge the free memory."""
    if machine.memory is None:
        return Check(TOPIC, "memory", "ok", "this system does not say how much is free")
    detail = f"{_size(machine.memory)} free"
    if machine.memory >= LEAST_MEMORY_BYTES:
        return Check(TOPIC, "memory", "ok", detail)
    remedy = (
        f"below {_size(LEAST_MEMORY_BYTES)} runs may be ended by the system: close programs, or give --jobs 1"
    )
    return Check(TOPIC, "memory", "missing", detail, remedy)


def output_check(folder: Path) -> Check:
    """Judge whether results can be written to a folder, by writing there; leave nothing behind."""
    try:
        open_folder(folder)
    except InputError as error:
        reason, _, remedy = str(error).partition("; ")
        return Check(TOPIC, "results", "broken", reason, remedy, necessary=True)
    return Check(TOPIC, "results", "ok", f"{shown(folder)} can be written", necessary=True)


def disk_check(folder: Path, free: int | None = None) -> Check:
    """Judge the free disk where results go.

    Args:
        folder: where they go, or would.
        free: bytes; None: ask the system.
    """
    present = next(each for each in (folder.absolute(), *folder.absolute().parents) if os.path.isdir(each))
    free = shutil.disk_usage(present).free if free is None else free
    if free >= LEAST_DISK_BYTES:
        return Check(TOPIC, "disk", "ok", f"{_size(free)} free")
    remedy = (
        f"below {_size(LEAST_DISK_BYTES)} a sweep may not fit: make room, or give another disk with --out"
    )
    return Check(TOPIC, "disk", "missing", f"{_size(free)} free", remedy)


def _size(count: int) -> str:
    return f"{count / (1 << 30):.3g} GB" if count >= 1 << 30 else f"{count / (1 << 20):.3g} MB"
