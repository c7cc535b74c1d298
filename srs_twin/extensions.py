"""Registry of the extensions, the only place in the core that names them.

An entry is ``name: "module:object"``. The module is imported when the object is needed. Entries of extensions
that are not installed are ignored.
"""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

COMMANDS = {
    "export": "srs_twin.recordings.commands:export",
    "inspect": "srs_twin.recordings.commands:inspect",
    "plan": "srs_twin.planning.command:plan",
    "replay": "srs_twin.identification.replay_command:replay",
    "sweep": "srs_twin.studies.sweep.command:sweep",
    "optimize": "srs_twin.studies.optimization.command:optimize",
    "uncertainty": "srs_twin.studies.uncertainty.command:uncertainty",
    "reproduce": "srs_twin.reproduction.command:reproduce",
    "emulate": "srs_twin.live.emulate_command:emulate",
    "shadow": "srs_twin.live.shadow_command:shadow",
    "calibrate": "srs_twin.identification.command:app",
}
"""Commands: functions, or typer applications with subcommands."""

CONTROLLERS = {
    "replay": "srs_twin.recordings.takes:ReplayFile",
    "follow": "srs_twin.planning.follow_file:FollowFile",
}
"""Kinds of `controller` in a scenario, as sections that build the controller."""

SECTIONS = {
    "recording": "srs_twin.recordings.takes:RECORDING",
    "planner": "srs_twin.planning.scenario:PLANNER",
}
"""Additional sections of a scenario (`scenario.fields.SectionEntry`)."""

METRICS = {
    "following": "srs_twin.planning.metrics:METRICS",
}
"""Metrics of runs (`comparison.sampling.MetricGroup`)."""

PICTURES = {"following": "srs_twin.planning.pictures:PICTURES"}
"""Additions to the pictures of runs (`viewing.additions.RunPictures`)."""

PAGES = {
    "run": "srs_twin.viewing.html.report:page_of_run",
    "comparison": "srs_twin.viewing.html.report:page_of_comparison",
    "plan": "srs_twin.planning.pictures:plan_page",
    "fit": "srs_twin.identification.fit_report:fit_page",
}
"""HTML pages of results in notebooks."""

ENGINES = {"warp": "srs_twin.warp.batch:WarpBatch"}
"""Engines of batches of twins."""

FORMATS = {
    "c3d": "srs_twin.recordings.formats.motion_capture:C3d",
    "mcap": "srs_twin.recordings.formats.bags:Mcap",
    "ros1": "srs_twin.recordings.formats.bags:Ros1Bag",
    "ros2": "srs_twin.recordings.formats.bags:Ros2Bag",
    "motive": "srs_twin.recordings.formats.motion_capture:Motive",
    "vicon": "srs_twin.recordings.formats.motion_capture:Vicon",
    "qualisys": "srs_twin.recordings.formats.motion_capture:Qualisys",
    "trc": "srs_twin.recordings.formats.tables:Trc",
    "tum": "srs_twin.recordings.formats.tables:Tum",
    "deeplabcut": "srs_twin.recordings.formats.tables:DeepLabCut",
    "plain": "srs_twin.recordings.formats.tables:PlainCsv",
}
"""File formats of motion recordings (`recordings.formats.base.Format`). The first one that recognizes a file
reads it; `plain` accepts most tables and is last."""

LOADERS = {"study": "srs_twin.studies.optimization.loading:load_study"}
"""Functions that read and check a kind of file."""

SCHEMAS = {
    "sweep": "srs_twin.studies.sweep.points:sweep_json_schema",
    "study": "srs_twin.studies.optimization.loading:study_json_schema",
    "setup": "srs_twin.live.setup_file:setup_json_schema",
    "inspect": "srs_twin.recordings.facts:facts_json_schema",
}
"""JSON Schemas of files and of output."""


def load(entry: str) -> Any:
    """Import the object of an entry, ``module:object``."""
    module, _, name = entry.partition(":")
    return getattr(import_module(module), name)


def installed(table: Mapping[str, str]) -> dict[str, str]:
    """Return the entries of a table whose extension is installed."""
    return {name: entry for name, entry in table.items() if _is_installed(entry)}


def objects(table: Mapping[str, str]) -> Iterator[tuple[str, Any]]:
    """Yield the names and objects of the installed entries of a table."""
    return ((name, load(entry)) for name, entry in installed(table).items())


def module_of(entry: str) -> str:
    """Return the dotted name of an entry's module."""
    return entry.partition(":")[0]


def _is_installed(entry: str) -> bool:
    return _has_package(".".join(entry.split(".")[:2]))


@cache
def _has_package(name: str) -> bool:
    return find_spec(name) is not None


class _LazyPackage(ModuleType):
    """Package that imports its public names when they are used; they hide submodules of the same name."""

    _homes: dict[str, str | None]
    """Public name → module that defines it."""

    def __getattr__(self, name: str) -> Any:
        if name not in self._homes:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        return load(f"{self._homes[name]}:{name}")

    def __dir__(self) -> list[str]:
        return sorted(self.__all__)

    def __setattr__(self, name: str, value: object) -> None:
        # Python sets a submodule as an attribute of its package after the import.
        if isinstance(value, ModuleType) and name in self._homes:
            value = getattr(value, name)
        super().__setattr__(name, value)

    def __reduce__(self) -> tuple[Callable[[str], ModuleType], tuple[str]]:
        return import_module, (self.__name__,)


def lazy(package: str) -> None:
    """Make a package import its public names when they are used.

    Its source imports them below ``TYPE_CHECKING`` as themselves (``from module import name as name``), where
    type checkers and editors find them. This function reads the source, so that each name stands there once.
    """
    module = sys.modules[package]
    homes = {
        alias.name: node.module
        for node in ast.walk(ast.parse(inspect.getsource(module)))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    }
    vars(module).update(__all__=list(homes), _homes=homes)
    module.__class__ = _LazyPackage
