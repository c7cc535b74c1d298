"""Checks of `srs-twin doctor` that run in the current process."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from email.message import Message
from importlib import metadata
from pathlib import Path
from typing import Literal

from srs_twin import __version__
from srs_twin.errors import InputError
from srs_twin.io.files import check_output_folder, data_root, display_path

INSTALLATION = "installation"
SIMULATION = "simulation"
MACHINE = "machine"
VIEWING = "viewing (optional)"
EXTRAS = "extras"
TOPICS = (INSTALLATION, SIMULATION, MACHINE, VIEWING, EXTRAS)
"""Topics of the checks, in the order in which they are printed."""

Status = Literal["ok", "missing", "broken", "undecided"]


@dataclass(frozen=True)
class Check:
    """Result of one check of `srs-twin doctor`.

    Attributes:
        topic: topic of the check, one of `TOPICS`.
        name: unique name of the check.
        status: "ok", "missing" (absent or insufficient), "broken" (present but not
            working) or "undecided" (not tested, or no result in time).
        detail: text that describes the result.
        remedy: instruction for solving the problem, empty if the status is "ok".
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
    """Return the necessary checks with the status "missing" or "broken"."""
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
    "recordings": "recordings in MCAP files and ROS bags",
    "optimize": "studies (`srs-twin optimize`)",
    "video": "videos (`srs-twin render RUN --video out.mp4`)",
    "rl": "training of policies (tools/train_ppo.py)",
}
"""Purpose of each optional extra in pyproject.toml."""

_LISTED_PACKAGES = (
    "mujoco",
    "numpy",
    "scipy",
    "numba",
    "pyarrow",
    "matplotlib",
    "rerun-sdk",
)

_OMITTABLE_PACKAGES = ("dm-control", "rerun-sdk")
"""Packages that are installed by default but not needed by `run` and `compare`."""

# Module names that differ from the package names. Only the bindings of rerun-sdk are
# imported, because importing its Python part takes as long as importing all other
# packages.
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
        name: name of the package on the package index.
        requirement: requirement in pip syntax, such as "mujoco<4,>=3.17".
        installed: installed version, or None.
        fits: whether the installed version satisfies the requirement.
        extra: extra that requires the package, or an empty string if it is always
            required.
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
    """Return the packages required on this machine, with their installed versions.

    Args:
        requirements: requirements in pip syntax, by default those of srs_twin.
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
    """Return the module names of all installed packages that are always required."""
    names = (
        package.name
        for package in packages
        if not package.extra and package.installed is not None
    )
    return [_MODULES.get(name, name.replace("-", "_")) for name in names]


def python_check(version: str, allowed: str) -> Check:
    """Check a Python version against `requires-python` in pyproject.toml."""
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
    """Yield a check of the required packages for each extra."""
    for extra in extras:
        members = [package for package in packages if package.extra == extra]
        command = f"uv sync --extra {extra}" if checkout else ""
        prefix = f"{PURPOSES.get(extra, 'optional')}: "
        yield _installed_check(
            EXTRAS, extra, members, _versions(members), command, prefix
        )


def checks_of_installation() -> Iterator[Check]:
    """Yield checks of the srs_twin installation, its required packages and extras."""
    metadata = installed_metadata()
    checkout = (data_root() / "pyproject.toml").is_file()
    packages = required_packages()
    kind = "checkout" if checkout else "wheel"
    detail = f"{__version__}, {kind} in {data_root()}"
    if metadata:
        yield Check(INSTALLATION, "srs_twin", "ok", detail, necessary=True)
        yield python_check(platform.python_version(), metadata["Requires-Python"])
    else:
        detail += "; the package is not installed, so its requirements are unknown"
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
    """Return the package metadata of srs_twin, empty if it is not installed."""
    try:
        return metadata.metadata(DISTRIBUTION)  # type: ignore[return-value]
    except metadata.PackageNotFoundError:
        return Message()


def _extra_of(marker: str) -> str:
    """Return the extra named in a marker, such as 'ray' in `extra == "ray"`."""
    _, _, rest = marker.partition('extra == "')
    return rest.partition('"')[0]


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def output_check(folder: Path) -> Check:
    """Check that files can be written to a folder."""
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
