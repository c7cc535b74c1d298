"""Checks: one thing looked at each, whether it works, and the remedy where it does not.

What this process finds out by itself: Python, the packages that srs_twin asks for and its extras, as
installed; the machine as a run sees it, where limits of a container count: processors, memory, room for
results.
"""

from __future__ import annotations

import math
import os
import platform
import shlex
import shutil
import signal
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from srs_twin.errors import InputError
from srs_twin.io.files import open_folder, shown
from srs_twin.parallel import processors

INSTALLATION, MACHINE, EXTRAS = "installation", "machine", "extras"
Status = Literal["ok", "missing", "broken", "undecided"]


class Fault(Exception):
    """What a probe finds wrong.

    Attributes:
        status: "missing" or "broken".
        remedy: what to do; empty: the probe's usual one.
    """

    def __init__(self, status: Status, detail: str, remedy: str = "") -> None:
        super().__init__(detail)
        self.status, self.remedy = status, remedy


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
    """What came of a probe; fields as in `Check`, the remedy empty where the probe names none."""

    status: Status
    detail: str
    remedy: str = ""


def ended(code: int) -> Answer:
    """Return what the end of a process says that gave no answer; below 0 the signal that ended it."""
    if code in (-signal.SIGALRM, -signal.SIGKILL):  # SIGKILL: by a system short of memory
        remedy = "this machine is busy, or very slow: run `srs-twin doctor` again when it is not"
        return Answer("undecided", "slow: no answer in time", remedy)
    if code >= 0:
        return Answer("broken", f"ended with exit code {code}")
    known = -code in set(signal.Signals)
    return Answer("broken", f"ended by {signal.Signals(-code).name if known else f'signal {-code}'}")


def failing(checks: Iterable[Check]) -> list[Check]:
    """Return those that are necessary and do not work; a slow machine is no reason to refuse it."""
    return [check for check in checks if check.necessary and check.status in ("missing", "broken")]


DISTRIBUTION = "srs-twin"

PURPOSES = {
    "envs": 'environments for agents (`gymnasium.make("srs_twin.envs:SRSTwin/GoTo-v0")`)',
    "ompl": "a baseline beside the project's own planner (`planner: {kind: ompl}`)",
    "ray": "sweeps on several machines (`srs-twin sweep --engine ray`)",
    "video": "videos (`srs-twin render RUN --video out.mp4`)",
}
"""What each extra of pyproject.toml is for."""

_DECIDING = ("mujoco", "dm-control", "numpy", "scipy", "numba", "pyarrow", "matplotlib", "rerun-sdk")

# Others are called like their package. Rerun's half in Python takes as long to import as all others together.
_MODULES = {"rerun-sdk": "rerun_bindings", "ruamel-yaml": "ruamel.yaml"}


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
    faults = [each for each in always if each.fault]
    if not faults:
        listed = [f"{each.name} {each.installed}" for each in always if each.name in _DECIDING]
        detail = f"all {len(always)} that are asked for; {', '.join(listed)}"
        return Check(INSTALLATION, "packages", "ok", detail, necessary=True)
    remedy = "uv sync" if checkout else _install([each.requirement for each in faults])
    detail = "; ".join(each.fault for each in faults)
    return Check(INSTALLATION, "packages", _mark(faults), detail, remedy, necessary=True)


def extra_checks(extras: Sequence[str], packages: Sequence[Wanted], *, checkout: bool) -> Iterator[Check]:
    """Judge which extras are installed."""
    for extra in extras:
        parts = [each for each in packages if each.extra == extra]
        faults = [each for each in parts if each.fault]
        purpose = PURPOSES.get(extra, "optional")
        if not faults:
            listed = ", ".join(f"{each.name} {each.installed}" for each in parts)
            yield Check(EXTRAS, extra, "ok", f"{purpose}: {listed}")
            continue
        needed = [each.requirement for each in faults]
        remedy = f"uv sync --extra {extra}" if checkout else _install(needed)
        yield Check(
            EXTRAS, extra, _mark(faults), f"{purpose}: {'; '.join(each.fault for each in faults)}", remedy
        )


def about_srs_twin() -> tuple[Mapping[str, str], list[str], list[str]]:
    """Return what the installation says of srs_twin: fields, requirements, names of extras.

    Raises:
        PackageNotFoundError: it runs from files that nobody installed.
    """
    about = metadata.metadata(DISTRIBUTION)
    fields = {"Version": about["Version"], "Requires-Python": about["Requires-Python"]}
    return fields, metadata.requires(DISTRIBUTION) or [], about.get_all("Provides-Extra") or []


def _mark(faults: Sequence[Wanted]) -> Status:
    return "missing" if any(each.installed is None for each in faults) else "broken"


def _install(requirements: Sequence[str]) -> str:
    return shlex.join(["pip", "install", *requirements])


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
        quota, _, period = _words(group / "cpu.max").partition(" ")
        share = int(quota) / int(period) if quota.isdigit() and period.isdigit() else None
        limit, used = (_words(group / name) for name in ("memory.max", "memory.current"))
        within = int(limit) - int(used) if limit.isdigit() and used.isdigit() else None
        free = [each for each in (_available(meminfo), within) if each is not None]
        return Machine(processors(), share, min(free, default=None))


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
            return Check(MACHINE, "processors", "missing", detail, remedy)
    return Check(MACHINE, "processors", "ok", detail)


def memory_check(machine: Machine) -> Check:
    """Judge the free memory."""
    if machine.memory is None:
        return Check(MACHINE, "memory", "ok", "this system does not say how much is free")
    detail = f"{_size(machine.memory)} free"
    if machine.memory >= LEAST_MEMORY_BYTES:
        return Check(MACHINE, "memory", "ok", detail)
    remedy = (
        f"below {_size(LEAST_MEMORY_BYTES)} runs may be ended by the system: close programs, or give --jobs 1"
    )
    return Check(MACHINE, "memory", "missing", detail, remedy)


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
    if free >= LEAST_DISK_BYTES:
        return Check(MACHINE, "disk", "ok", f"{_size(free)} free")
    remedy = (
        f"below {_size(LEAST_DISK_BYTES)} a sweep may not fit: make room, or give another disk with --out"
    )
    return Check(MACHINE, "disk", "missing", f"{_size(free)} free", remedy)


def _size(count: int) -> str:
    return f"{count / (1 << 30):.3g} GB" if count >= 1 << 30 else f"{count / (1 << 20):.3g} MB"
