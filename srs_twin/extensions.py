"""Registry of the extensions, the only place in the core that names them, and of parts from outside.

An entry is ``name: "module:object"``. The module is imported when the object is needed.
Entries of extensions that are not installed are ignored.

Files may also name parts from outside the package as ``module:Name``. A file alone
never runs code: the module must be a plug-in, which the user allows (`allow_plugin`),
or belong to an installed distribution that declares entry points ``srs_twin.*``. Such a
distribution may register short names for its parts in the groups
``srs_twin.controllers``, ``pneumatics``, ``sensors``, ``metrics`` and ``formats``,
which are read only if a name is unknown.
"""

from __future__ import annotations

import ast
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib import import_module
from importlib.util import find_spec, spec_from_file_location
from inspect import isabstract
from types import ModuleType
from typing import Any

from srs_twin.errors import OUTSIDE, InputError, UnknownNameError, describe_error

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
    "c3d": "srs_twin.recordings.formats.c3d_file:C3d",
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
"""File formats of motion recordings (`recordings.formats.base.Format`).

A file is read by the first format that recognizes it; `plain` accepts most tables and
is last."""

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

    Its source imports them below ``TYPE_CHECKING`` as themselves (``from module import
    name as name``), where type checkers and editors find them. This function reads them
    from the source, so that each name is written once.
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


PLUGINS = "SRS_TWIN_PLUGINS"
"""Environment variable with the plug-ins that the user allows: Python files and names
of modules. Processes started later inherit it."""

PART_PATTERN = r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z]\w*"
"""Pattern of the name of a part from outside, ``module:Name``."""

READING = ContextVar("READING", default=False)
"""Whether the files of a finished run are read, which imports none of the parts that
they name."""


def allow_plugin(source: str | os.PathLike[str] | ModuleType | type) -> None:
    """Allow scenarios and other files to name the parts of a plug-in, in this process and in its workers.

    Args:
        source: path of a Python file, which is imported under the name of the file; or
            a module, its name, or a class in it.

    Raises:
        InputError: there is no such file or module, or another module has the name of
            the file.
    """
    if isinstance(source, type | ModuleType):
        source = getattr(source, "__module__", source.__name__)
    entry = os.fspath(source)
    if entry in plugins():
        return
    if entry.endswith(".py"):
        entry = os.path.abspath(entry)
    if problem := _why_unusable(entry):
        raise InputError(f"plug-in {entry}: {problem}")
    os.environ[PLUGINS] = os.pathsep.join(dict.fromkeys([*plugins().values(), entry]))


def _why_unusable(entry: str) -> str:
    """Return the reason why a plug-in cannot be imported; empty if it can be."""
    name = os.path.basename(entry).partition(".")[0]
    module = name.isidentifier() and (sys.modules.get(name) or find_spec(name))
    if not entry.endswith(".py"):
        if module:
            return ""
        return "no such module; give a file that ends in .py, or an installed module"
    if not os.path.isfile(entry):
        return "no such file"
    if not name.isidentifier() or os.pathsep in entry:
        return (
            "cannot be imported; use only letters, digits and _ in its name, and no"
            f" '{os.pathsep}'"
        )
    if module:
        places = (getattr(module, key, None) for key in ("__file__", "origin"))
        origin = next(filter(None, places), "built in")
        if os.path.realpath(origin) != os.path.realpath(entry):
            return f"a module {name} exists already ({origin}); rename the file"
    return ""


def plugins() -> dict[str, str]:
    """Return the plug-ins that the user allows: name of the module → path of its file, or its name."""
    entries = os.environ.get(PLUGINS, "").split(os.pathsep)
    return {
        os.path.basename(entry).removesuffix(".py"): entry for entry in entries if entry
    }


class _PluginFinder:
    """Finder that imports the files of plug-ins, if no other finder knows the module."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> Any:
        file = plugins().get(name, "")
        if file.endswith(".py"):
            return spec_from_file_location(name, file)
        return None


sys.meta_path.append(_PluginFinder)


def owners() -> dict[str, Any]:
    """Return package → installed distribution, for those that declare entry points ``srs_twin.*``."""
    # An empty entry is the current folder, whose files are not trusted.
    return _owners(tuple(filter(None, sys.path)))


@cache
def _owners(path: tuple[str, ...]) -> dict[str, Any]:
    from importlib.metadata import distributions

    found: dict[str, Any] = {}
    for distribution in distributions(path=list(path)):
        entries = [
            each
            for each in distribution.entry_points
            if each.group.startswith("srs_twin.")
        ]
        if entries:
            names = [module_of(each.value) for each in entries]
            names += [file.parts[0] for file in distribution.files or ()]
            found |= {name.partition(".")[0]: distribution for name in names}
    return found


def registered(kind: str) -> dict[str, str]:
    """Return the parts that installed distributions register: short name → ``module:Name``.

    Args:
        kind: controller, pneumatics, sensor, metric or format.
    """
    group = f"srs_twin.{kind.removesuffix('s')}s"
    entries = (
        each.entry_points.select(group=group)
        for each in reversed(dict.fromkeys(owners().values()))
    )
    return {entry.name: entry.value for each in entries for entry in each}


def import_plugin(module: str) -> ModuleType:
    """Import a module from outside the package, if the user or its distribution allows it.

    Raises:
        InputError: the module is not allowed, or its import fails.
    """
    package = module.partition(".")[0]
    if (
        package not in {name.partition(".")[0] for name in plugins()}
        and package not in owners()
    ):
        raise InputError(
            f"module {module} is not allowed, because a file alone never runs code. "
            f"If you trust it, name it with --plugin FILE.py or in {PLUGINS}"
        )
    OUTSIDE.update(plugins().values())
    try:
        imported = import_module(module)
    except (Exception, SystemExit) as error:  # foreign code may raise any error
        raise InputError(
            f"module {module} cannot be imported: {describe_error(error)}"
        ) from error
    OUTSIDE.add(imported.__file__ or "")
    return imported


def part(
    kind: str, name: str, bases: tuple[type, ...], known: Iterable[str] = ()
) -> Any:
    """Import a class from outside the package.

    Args:
        kind: controller, pneumatics, sensor or format.
        name: ``module:Name``, or a short name that an installed distribution registers.
        bases: base classes, one of which the class must have.
        known: other names of this kind, for messages.

    Raises:
        UnknownNameError: no distribution registers the short name.
        InputError: the part is not allowed, or has another base class.
    """
    names = {name: name} if ":" in name else registered(kind)
    if name not in names:
        raise UnknownNameError(kind, name, (*known, *names))
    if not re.fullmatch(PART_PATTERN, names[name], re.ASCII):
        raise InputError(f"'{names[name]}' does not name a class; write module:Name")
    module, _, attribute = names[name].partition(":")
    found = getattr(import_plugin(module), attribute, None)
    is_derived = (
        isinstance(found, type) and issubclass(found, bases) and found not in bases
    )
    if not is_derived or isabstract(found):
        expected = " or ".join(base.__name__ for base in bases)
        raise InputError(
            f"{names[name]} must be a class that derives from {expected}, with all its"
            " methods"
        )
    return found


def plugin_parts(base: type) -> Iterator[tuple[str, Any]]:
    """Yield module and object of the instances and subclasses of a class that the plug-ins define."""
    for module in plugins():
        for found in vars(import_plugin(module)).values():
            is_class = isinstance(found, type) and found.__module__ == module
            if isinstance(found, base) or (
                is_class and issubclass(found, base) and not isabstract(found)
            ):
                yield module, found


@contextmanager
def reading() -> Iterator[None]:
    """Import none of the parts that files name in a block, which reads the files of a finished run."""
    token = READING.set(True)
    try:
        yield
    finally:
        READING.reset(token)
