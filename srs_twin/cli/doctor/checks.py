"""Checks: one thing looked at each, whether it works, and the remedy where it does not.

What this process finds out by itself: Python, the packages that srs_twin asks for and its extras, as
installed; the machine as a run sees it, where limits of a container count: processors, memory, room for
results.
"""

from __future__ import annotations

import math
import os
import platform
import re
import shlex
import shutil
import signal
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from email.message import Message
from importlib import metadata
from pathlib import Path
from typing import Literal

from srs_twin.errors import InputError, ending
from srs_twin.io.files import open_folder, shown

INSTALLATION, MACHINE, EXTRAS = "installation", "machine", "extras"
Status = Literal["ok", "missing", "broken", "undecided"]


@dataclass(frozen=True)
class Check:
    """One line of what `srs-twin doctor` says.

    Attributes:
        topic: what it belongs to.
        name: what was looked at, unique.
        status: "ok"; "missing": not there, or too little of it; "broken": there, but it does not work;
            "undecided": no answer in time, or not tried, which says nothing about whether it works.
        detail: what was found.
        remedy: a command or a sentence; empty where, and only where, all is well.
        necessary: whether runs fail without it.
    """

    topic: str
    name: str
    status: Status
    detail: str
    remedy: str = ""
    necessary: bool = False

    def __post_init__(self) -> None:
        if bool(self.remedy) == (self.status == "ok"):
            raise ValueError(f"{self.name}: {self.status}, but its remedy is {self.remedy!r}")


@dataclass(frozen=True)
class Answer:
    """What came of a probe; fields as in `Check`, the remedy empty where the probe knows none itself."""

    status: Status
    detail: str
    remedy: str = ""


def ended(code: int) -> Answer:
    """Return what the end of a process says that gave no answer; below 0 the signal that ended it."""
    if code in (-signal.SIGALRM, -signal.SIGKILL):  # SIGKILL: by a system short of memory
        remedy = "this machine is busy, or very slow: run `srs-twin doctor` again when it is not"
        return Answer("undecided", "slow: no answer in time", remedy)
    return Answer("broken", ending(code))


def failing(checks: Iterable[Check]) -> list[Check]:
    """Return those that are necessary and do not work; a slow machine is no reason to refuse it."""
    return [check for check in checks if check.necessary and check.status in ("missing", "broken")]


DISTRIBUTION = "srs-twin"

PURPOSES = {
    "envs": "environments for agents (docs/environments.md)",
    "gpu": "twins on an accelerator (`srs-twin sweep --engine warp`)",
    "ompl": "a baseline beside the project's own planner (`planner: {kind: ompl}`)",
    "ray": "sweeps on several machines (`srs-twin sweep --engine ray`)",
    "live": "a robot on the air (MQTT), journals",
    "recordings": "recordings in the formats C3D and MCAP, bags of ROS",
    "optimize": "studies (`srs-twin optimize`)",
    "video": "videos (`srs-twin render RUN --video out.mp4`)",
}
"""What each extra of pyproject.toml is for."""

_DECIDING = ("mujoco", "dm-control", "numpy", "scipy", "numba", "pyarrow", "matplotlib", "rerun-sdk")

# Others are called like their package. Rerun's half in Python takes as long to import as all others together.
_MODULES = {
    "rerun-sdk": "rerun_bindings",
    "ruamel-yaml": "ruamel.yaml",
    "backports-zstd": "backports.zstd",
    "pillow": "PIL",
}


@dataclass(frozen=True)
class Wanted:
    """A package that srs_twin asks for.

    Attributes:
        name: of the distribution.
        requirement: as a package manager takes it, e.g. "mujoco<4,>=3.17".
        installed: version, None where there is none.
        fits: whether that version is one of those asked for.
        extra: name of the extra that it belongs to; empty: always asked for.
    """

    name: str
    requirement: str
    installed: str | None
    fits: bool
    extra: str = ""

    @property
    def fault(self) -> str:
        """What is wrong with it, empty where nothing is."""
        if self.installed is None:
            return f"{self.name} is missing"
        return "" if self.fits else f"{self.name} is {self.installed}, but {self.requirement} is asked for"


def wanted(requirements: Sequence[str]) -> list[Wanted]:
    """Return the packages of requirements that hold on this machine, with what of them is installed."""
    from packaging.requirements import Requirement

    found = []
    for requirement in map(Requirement, requirements):
        extra = _extra_of(str(requirement.marker or ""))
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            installed = _installed(requirement.name)
            fits = installed is not None and requirement.specifier.contains(installed, prereleases=True)
            text = f"{requirement.name}{requirement.specifier}"
            found.append(Wanted(requirement.name, text, installed, fits, extra))
    return found


def modules(packages: Sequence[Wanted]) -> list[str]:
    """Return the top modules of the packages that are always asked for, those that are not there left out."""
    there = (each.name for each in packages if not each.extra and each.installed is not None)
    return [_MODULES.get(name, name.replace("-", "_")) for name in there]


def python_check(version: str, allowed: str) -> Check:
    """Judge Python's version.

    Args:
        version: e.g. "3.11.7".
        allowed: what pyproject.toml asks for, e.g. ">=3.11,<3.13".
    """
    from packaging.specifiers import SpecifierSet

    about = f"{version} ({platform.python_implementation()}, {platform.system()} {platform.machine()})"
    if SpecifierSet(allowed).contains(version, prereleases=True):
        return Check(INSTALLATION, "Python", "ok", about, necessary=True)
    remedy = (
        f"make the environment anew with Python {allowed}, e.g. `uv venv --python 3.12`, and install again"
    )
    return Check(INSTALLATION, "Python", "broken", f"{about}; {allowed} is needed", remedy, necessary=True)


def packages_check(packages: Sequence[Wanted], *, checkout: bool) -> Check:
    """Judge whether every package that is always asked for is there in a version that will do."""
    always = [each for each in packages if not each.extra]
    listed = ", ".join(f"{each.name} {each.installed}" for each in always if each.name in _DECIDING)
    fine = f"all {len(always)} that are asked for; {listed}"
    command = "uv sync" if checkout else ""
    return _installed_check(INSTALLATION, "packages", always, fine, command)


def extra_checks(extras: Sequence[str], packages: Sequence[Wanted], *, checkout: bool) -> Iterator[Check]:
    """Judge which extras are installed."""
    for extra in extras:
        parts = [each for each in packages if each.extra == extra]
        fine = ", ".join(f"{each.name} {each.installed}" for each in parts)
        command = f"uv sync --extra {extra}" if checkout else ""
        yield _installed_check(EXTRAS, extra, parts, fine, command, f"{PURPOSES.get(extra, 'optional')}: ")


def _installed_check(
    topic: str, name: str, packages: Sequence[Wanted], fine: str, command: str, before: str = ""
) -> Check:
    """Judge packages; `command` installs what is missing, or else pip."""
    faults = [each for each in packages if each.fault]
    if not faults:
        return Check(topic, name, "ok", before + fine, necessary=topic == INSTALLATION)
    status: Status = "missing" if any(each.installed is None for each in faults) else "broken"
    remedy = command or shlex.join(["pip", "install", *(each.requirement for each in faults)])
    detail = before + "; ".join(each.fault for each in faults)
    return Check(topic, name, status, detail, remedy, topic == INSTALLATION)


def about_srs_twin() -> Message:
    """Return what the installation says of srs_twin; empty where it runs from files that nobody installed."""
    try:
        return metadata.metadata(DISTRIBUTION)  # type: ignore[return-value]
    except metadata.PackageNotFoundError:
        return Message()


def _extra_of(marker: str) -> str:
    """Return 'ray' for a marker like `python_version < "3.13" and extra == "ray"`."""
    _, found, rest = marker.partition('extra == "')
    return rest.partition('"')[0] if found else ""


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


LEAST_MEMORY_BYTES = 1 << 30
LEAST_DISK_BYTES = 512 << 20
_GROUP = Path("/sys/fs/cgroup")
_MEMINFO = Path("/proc/meminfo")


def processor_share(group: Path = _GROUP) -> float | None:
    """Return how many processors this process is given the time of; None where no container limits it.

    Args:
        group: folder of the control group (version 2) that this process sees as its own.
    """
    quota, _, period = _words(group / "cpu.max").partition(" ")
    return int(quota) / int(period) if quota.isdigit() and period.isdigit() else None


def free_memory(group: Path = _GROUP, meminfo: Path = _MEMINFO) -> int | None:
    """Return the memory that new programs can have without swapping, bytes; None where nobody says.

    Args:
        group: as in `processor_share`.
        meminfo: the kernel's table of memory.
    """
    limit, used = (_words(group / name) for name in ("memory.max", "memory.current"))
    free = [
        1024 * int(kilobytes) for kilobytes in re.findall(r"^MemAvailable:\s*(\d+)", _words(meminfo), re.M)
    ]
    if limit.isdigit() and used.isdigit():
        free.append(int(limit) - int(used))
    return min(free, default=None)


def _words(path: Path) -> str:
    try:
        return path.read_text("ascii").strip()
    except OSError:
        return ""


def processors_check(usable: int, share: float | None) -> Check:
    """Judge the processors; one is enough."""
    detail = f"{usable} usable"
    if share is not None and share < usable:
        detail += f", with the time of {share:.3g}"
        if math.ceil(share) < usable:
            remedy = f"more workers than that only wait: give --jobs {math.ceil(share)}"
            return Check(MACHINE, "processors", "missing", detail, remedy)
    return Check(MACHINE, "processors", "ok", detail)


def memory_check(free: int | None) -> Check:
    """Judge the free memory, bytes."""
    if free is None:
        return Check(MACHINE, "memory", "ok", "this system does not say how much is free")
    least = _size(LEAST_MEMORY_BYTES)
    remedy = f"below {least} runs may be ended by the system: close programs, or give --jobs 1"
    return _room_check("memory", free, LEAST_MEMORY_BYTES, remedy)


def _room_check(name: str, free: int, least: int, remedy: str) -> Check:
    if free >= least:
        return Check(MACHINE, name, "ok", f"{_size(free)} free")
    return Check(MACHINE, name, "missing", f"{_size(free)} free", remedy)


def output_check(folder: Path) -> Check:
    """Judge whether results can be written to a folder, by writing there; leave nothing behind."""
    try:
        open_folder(folder)
    except InputError as error:
        reason, _, remedy = str(error).partition("; ")
        return Check(MACHINE, "results", "broken", reason, remedy, necessary=True)
    return Check(MACHINE, "results", "ok", f"{shown(folder)} can be written", necessary=True)


def disk_check(folder: Path, free: int | None = None) -> Check:
    """Judge the free disk where results go.

    Args:
        folder: where they go, or would.
        free: bytes; None: ask the system.
    """
    present = next(each for each in (folder.absolute(), *folder.absolute().parents) if os.path.isdir(each))
    free = shutil.disk_usage(present).free if free is None else free
    least = _size(LEAST_DISK_BYTES)
    remedy = f"below {least} a sweep may not fit: make room, or give another disk with --out"
    return _room_check("disk", free, LEAST_DISK_BYTES, remedy)


def _size(count: int) -> str:
    return f"{count / (1 << 30):.3g} GB" if count >= 1 << 30 else f"{count / (1 << 20):.3g} MB"
