"""Checks that need no child process.

If a container limits a resource, the lower of the limits of container and machine is
used.
"""

from __future__ import annotations

import math
import os
import platform
import re
import shlex
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from email.message import Message
from importlib import metadata
from pathlib import Path
from typing import Literal

from srs_twin import __version__
from srs_twin.compute.workers import processor_count
from srs_twin.errors import InputError
from srs_twin.io.files import check_output_folder, data_root, display_path

INSTALLATION = "installation"
SIMULATION = "simulation"
MACHINE = "machine"
VIEWING = "viewing (optional)"
EXTRAS = "extras"
TOPICS = (INSTALLATION, SIMULATION, MACHINE, VIEWING, EXTRAS)
"""Topics of the checks, in the order of the output."""

Status = Literal["ok", "missing", "broken", "undecided"]


@dataclass(frozen=True)
class Check:
    """Result of one check of `srs-twin doctor`.

    Attributes:
        topic: one of `TOPICS`.
        name: unique name.
        status: "ok", "missing" (absent or insufficient), "broken" (present but not
            working) or "undecided" (not tested, or no result in time).
        detail: result in words.
        remedy: command or sentence, or an empty string if the status is "ok".
        necessary: whether runs fail if the check fails.
    """

    topic: str
    name: str
    status: Status
    detail: str
    remedy: str = ""
    necessary: bool = False

    def __post_init__(self) -> None:
        if bool(self.remedy) == (self.status == "ok"):
            raise ValueError(
                f"{self.name}: remedy {self.remedy!r} does not match status"
                f" {self.status}"
            )


def failed_checks(checks: Iterable[Check]) -> list[Check]:
    """Return the necessary checks that failed, without undecided checks."""
    return [
        check
        for check in checks
        if check.necessary and check.status in ("missing", "broken")
    ]


DISTRIBUTION = "srs-twin"

PURPOSES = {
    "envs": "reinforcement-learning environments (docs/environments.md)",
    "gpu": "twins on a GPU (`srs-twin sweep --engine warp`)",
    "ray": "sweeps on several machines (`srs-twin sweep --engine ray`)",
    "live": "live twin over MQTT, journals",
    "recordings": "recordings in C3D and MCAP files and ROS bags",
    "optimize": "studies (`srs-twin optimize`)",
    "video": "videos (`srs-twin render RUN --video out.mp4`)",
    "rl": "training of policies (tools/train_ppo.py)",
}
"""Purpose of each extra in pyproject.toml."""

_LISTED_PACKAGES = (
    "mujoco",
    "numpy",
    "scipy",
    "numba",
    "pyarrow",
    "matplotlib",
    "rerun-sdk",
)
"""Packages whose versions are printed, because they affect results most."""

_OMITTABLE_PACKAGES = ("dm-control", "rerun-sdk")
"""Packages that are installed by default, but that `run` and `compare` do without."""

# Modules whose names differ from the name of the package. For rerun-sdk, only the
# bindings are imported, because the Python part takes as long as all other packages.
_MODULES = {
    "rerun-sdk": "rerun_bindings",
    "pyyaml": "yaml",
    "backports-zstd": "backports.zstd",
    "pillow": "PIL",
}


@dataclass(frozen=True)
class RequiredPackage:
    """Package that srs_twin requires.

    Attributes:
        name: name of the distribution.
        requirement: requirement in the syntax of pip, such as "mujoco<4,>=3.17".
        installed: installed version, or None.
        fits: whether the installed version satisfies the requirement.
        extra: extra that requires the package, or an empty string.
    """

    name: str
    requirement: str
    installed: str | None
    fits: bool
    extra: str = ""

    @property
    def fault(self) -> str:
        """Problem with the installed version, or an empty string."""
        if self.installed is None:
            return f"{self.name} is missing"
        if self.fits:
            return ""
        return f"{self.name} is {self.installed}, but {self.requirement} is required"


def required_packages(
    requirements: Sequence[str] | None = None,
) -> list[RequiredPackage]:
    """Return the packages that this machine needs, with their installed versions.

    Args:
        requirements: requirements in the syntax of pip, by default those of srs_twin.
    """
    from packaging.requirements import Requirement

    if requirements is None:
        requirements = installed_metadata().get_all("Requires-Dist") or []
    packages = []
    for requirement in map(Requirement, requirements):
        extra = _extra_of(str(requirement.marker or ""))
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            installed = _installed(requirement.name)
            fits = installed is not None and requirement.specifier.contains(
                installed, prereleases=True
            )
            text = f"{requirement.name}{requirement.specifier}"
            packages.append(
                RequiredPackage(requirement.name, text, installed, fits, extra)
            )
    return packages


def modules(packages: Sequence[RequiredPackage]) -> list[str]:
    """Return the modules of the installed packages that are always required."""
    names = (
        package.name
        for package in packages
        if not package.extra and package.installed is not None
    )
    return [_MODULES.get(name, name.replace("-", "_")) for name in names]


def python_check(version: str, allowed: str) -> Check:
    """Check a version of Python against `requires-python` of pyproject.toml."""
    from packaging.specifiers import SpecifierSet

    detail = (
        f"{version} ({platform.python_implementation()}, {platform.system()}"
        f" {platform.machine()})"
    )
    if SpecifierSet(allowed).contains(version, prereleases=True):
        return Check(INSTALLATION, "Python", "ok", detail, necessary=True)
    remedy = (
        f"create the environment again with Python {allowed}, e.g. `uv venv --python"
        " 3.12`, and reinstall"
    )
    return Check(
        INSTALLATION,
        "Python",
        "broken",
        f"{detail}; {allowed} is required",
        remedy,
        necessary=True,
    )


def packages_check(packages: Sequence[RequiredPackage], *, checkout: bool) -> Check:
    """Check that suitable versions of all required packages are installed."""
    always = [
        package
        for package in packages
        if not package.extra
        and not (package.installed is None and package.name in _OMITTABLE_PACKAGES)
    ]
    versions = _versions(
        package for package in always if package.name in _LISTED_PACKAGES
    )
    detail = f"all {len(always)} required packages; {versions}"
    command = "uv sync" if checkout else ""
    return _installed_check(INSTALLATION, "packages", always, detail, command)


def extra_checks(
    extras: Sequence[str], packages: Sequence[RequiredPackage], *, checkout: bool
) -> Iterator[Check]:
    """Yield one check per extra."""
    for extra in extras:
        members = [package for package in packages if package.extra == extra]
        command = f"uv sync --extra {extra}" if checkout else ""
        prefix = f"{PURPOSES.get(extra, 'optional')}: "
        yield _installed_check(
            EXTRAS, extra, members, _versions(members), command, prefix
        )


def checks_of_installation() -> Iterator[Check]:
    """Yield the checks of the installation of srs_twin, its packages and its extras."""
    metadata = installed_metadata()
    checkout = (data_root() / "pyproject.toml").is_file()
    packages = required_packages()
    kind = "checkout" if checkout else "wheel"
    detail = f"{__version__}, {kind} in {data_root()}"
    if metadata:
        yield Check(INSTALLATION, "srs_twin", "ok", detail, necessary=True)
        yield python_check(platform.python_version(), metadata["Requires-Python"])
    else:
        detail += "; it is not installed, so its required packages are unknown"
        remedy = "uv sync" if checkout else "pip install the wheel again"
        yield Check(INSTALLATION, "srs_twin", "missing", detail, remedy, True)
    yield packages_check(packages, checkout=checkout)
    extras = metadata.get_all("Provides-Extra") or []
    yield from extra_checks(extras, packages, checkout=checkout)


def _versions(packages: Iterable[RequiredPackage]) -> str:
    return ", ".join(f"{package.name} {package.installed}" for package in packages)


def _installed_check(
    topic: str,
    name: str,
    packages: Sequence[RequiredPackage],
    detail: str,
    command: str,
    prefix: str = "",
) -> Check:
    faulty = [package for package in packages if package.fault]
    if not faulty:
        return Check(
            topic, name, "ok", prefix + detail, necessary=topic == INSTALLATION
        )
    status: Status = (
        "missing" if any(package.installed is None for package in faulty) else "broken"
    )
    remedy = command or shlex.join(
        ["pip", "install", *(package.requirement for package in faulty)]
    )
    detail = prefix + "; ".join(package.fault for package in faulty)
    return Check(topic, name, status, detail, remedy, topic == INSTALLATION)


def installed_metadata() -> Message:
    """Return the metadata of the installed srs_twin, empty without an installation."""
    try:
        return metadata.metadata(DISTRIBUTION)  # type: ignore[return-value]
    except metadata.PackageNotFoundError:
        return Message()


def _extra_of(marker: str) -> str:
    """Return the extra of a marker, such as 'ray' for `extra == "ray"`."""
    _, _, rest = marker.partition('extra == "')
    return rest.partition('"')[0]


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


MIN_MEMORY_BYTES = 1 << 30
"""Free memory below which the operating system may kill runs, bytes."""

MIN_DISK_BYTES = 512 << 20
"""Free disk space below which the results of a sweep may not fit, bytes."""

_CGROUP = Path("/sys/fs/cgroup")
_MEMINFO = Path("/proc/meminfo")


def cpu_quota(cgroup: Path = _CGROUP) -> float | None:
    """Return the processor time per wall time that a container may use.

    The value is None without a limit. `cgroup` is the folder of the control group
    (version 2) of this process.
    """
    quota, _, period = _read(cgroup / "cpu.max").partition(" ")
    if quota.isdigit() and period.isdigit():
        return int(quota) / int(period)
    return None


def free_memory(cgroup: Path = _CGROUP, meminfo: Path = _MEMINFO) -> int | None:
    """Return the memory available without swapping in bytes, or None if unknown."""
    limit, used = (_read(cgroup / name) for name in ("memory.max", "memory.current"))
    free = [
        1024 * int(kib)
        for kib in re.findall(r"^MemAvailable:\s*(\d+)", _read(meminfo), re.M)
    ]
    if limit.isdigit() and used.isdigit():
        free.append(int(limit) - int(used))
    return min(free, default=None)


def _read(path: Path) -> str:
    try:
        return path.read_text("ascii").strip()
    except OSError:
        return ""


def checks_of_machine(folder: Path) -> Iterator[Check]:
    """Yield the checks of disk, processors and memory."""
    yield output_check(folder)
    yield disk_check(folder)
    yield processors_check(processor_count(), cpu_quota())
    yield memory_check(free_memory())


def processors_check(usable: int, quota: float | None) -> Check:
    """Check the number of processors against the quota of the container."""
    detail = f"{usable} usable"
    if quota is not None and quota < usable:
        detail += f", but the container limits the time to that of {quota:.3g}"
        if math.ceil(quota) < usable:
            remedy = f"more workers would only wait; use --workers {math.ceil(quota)}"
            return Check(MACHINE, "processors", "missing", detail, remedy)
    return Check(MACHINE, "processors", "ok", detail)


def memory_check(free: int | None) -> Check:
    """Check the free memory in bytes."""
    if free is None:
        return Check(
            MACHINE, "memory", "ok", "this system does not report the free memory"
        )
    remedy = (
        f"below {_size(MIN_MEMORY_BYTES)}, the system may kill runs; close programs,"
        " or use --workers 1"
    )
    return _space_check("memory", free, MIN_MEMORY_BYTES, remedy)


def _space_check(name: str, free: int, minimum: int, remedy: str) -> Check:
    if free >= minimum:
        return Check(MACHINE, name, "ok", f"{_size(free)} free")
    return Check(MACHINE, name, "missing", f"{_size(free)} free", remedy)


def output_check(folder: Path) -> Check:
    """Check that a temporary file can be written to a folder."""
    try:
        check_output_folder(folder)
    except InputError as error:
        reason, _, remedy = str(error).partition("; ")
        return Check(MACHINE, "results", "broken", reason, remedy, necessary=True)
    return Check(
        MACHINE,
        "results",
        "ok",
        f"{display_path(folder)} can be written",
        necessary=True,
    )


def disk_check(folder: Path, free: int | None = None) -> Check:
    """Check the free disk space for results.

    Args:
        folder: output folder, which need not exist.
        free: free space, bytes. By default it is measured.
    """
    existing = next(
        path
        for path in (folder.absolute(), *folder.absolute().parents)
        if os.path.isdir(path)
    )
    if free is None:
        free = shutil.disk_usage(existing).free
    remedy = (
        f"below {_size(MIN_DISK_BYTES)}, a sweep may not fit; free some space, or use"
        " another disk with --out"
    )
    return _space_check("disk", free, MIN_DISK_BYTES, remedy)


def _size(bytes_: int) -> str:
    if bytes_ >= 1 << 30:
        return f"{bytes_ / (1 << 30):.3g} GB"
    return f"{bytes_ / (1 << 20):.3g} MB"
