"""Python, the packages that srs_twin asks for, and its extras: as installed, and whether they import."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata

from srs_twin.doctor.check import Check, Status

DISTRIBUTION = "srs-twin"
TOPIC, EXTRAS = "installation", "extras"

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
        return Check(TOPIC, "Python", "ok", about, necessary=True)
    remedy = (
        f"make the environment anew with Python {allowed}, e.g. `uv venv --python 3.12`, and install again"
    )
    return Check(TOPIC, "Python", "broken", f"{about}; {allowed} is needed", remedy, necessary=True)


def packages_check(packages: Sequence[Wanted], *, checkout: bool) -> Check:
    """Judge whether every package that is always asked for is there in a version that will do."""
    always = [each for each in packages if not each.extra]
    faults = [each for each in always if each.fault]
    if not faults:
        listed = [f"{each.name} {each.installed}" for each in always if each.name in _DECIDING]
        detail = f"all {len(always)} that are asked for; {', '.join(listed)}"
        return Check(TOPIC, "packages", "ok", detail, necessary=True)
    remedy = "uv sync" if checkout else _install([each.requirement for each in faults])
    detail = "; ".join(each.fault for each in faults)
    return Check(TOPIC, "packages", _mark(faults), detail, remedy, necessary=True)


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
