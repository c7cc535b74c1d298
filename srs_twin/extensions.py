"""Registry of extensions and plug-ins.

The core of the package refers to extensions only in this module. Each table entry has
the form ``name: "module:object"``, and the module is imported when the object is first
used. Entries of extensions that are not installed are ignored.

Scenarios and other files may also name plug-in classes as ``module:Name``. To prevent a
file from executing arbitrary code, the user must allow the module with `allow_plugin`.
Modules of installed distributions with entry points ``srs_twin.*`` are allowed as well.
Such a distribution may register short class names in the entry point groups
``srs_twin.controllers``, ``srs_twin.pneumatics``, ``srs_twin.sensors``,
``srs_twin.metrics`` and ``srs_twin.formats``.
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
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, spec_from_file_location
from inspect import isabstract
from pkgutil import resolve_name
from types import ModuleType
from typing import TYPE_CHECKING, Any

from srs_twin.errors import OUTSIDE, InputError, UnknownNameError, describe_error

if TYPE_CHECKING:
    from importlib.metadata import Distribution

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
"""Functions or Typer applications that implement the commands."""

CONTROLLERS = {
    "replay": "srs_twin.recordings.takes:ReplayFile",
    "follow": "srs_twin.planning.follow_file:FollowFile",
}
"""Additional controller kinds (subclasses of `controllers.ControllerSection`)."""

SECTIONS = {
    "recording": "srs_twin.recordings.takes:RECORDING",
    "planner": "srs_twin.planning.scenario:PLANNER",
}
"""Additional scenario sections, defined by `scenario.fields.SectionEntry`."""

METRICS = {
    "following": "srs_twin.planning.metrics:METRICS",
}
"""Additional run metrics, defined by `comparison.sampling.MetricGroup`."""

PICTURES = {"following": "srs_twin.planning.pictures:PICTURES"}
"""Additional run pictures, defined by `viewing.additions.RunPictures`."""

PAGES = {
    "run": "srs_twin.viewing.html.report:page_of_run",
    "comparison": "srs_twin.viewing.html.report:page_of_comparison",
    "plan": "srs_twin.planning.pictures:plan_page",
    "fit": "srs_twin.identification.fit_report:fit_page",
}
"""Functions that convert a result to an HTML page for notebooks."""

ENGINES = {"warp": "srs_twin.warp.batch:WarpBatch"}
"""Engines that simulate batches of twins."""

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
"""File formats of motion recordings (subclasses of `recordings.formats.base.Format`).

Each file is read by the first format that recognizes it. The format `plain` is last,
because it accepts most tables.
"""

LOADERS = {"study": "srs_twin.studies.optimization.loading:load_study"}
"""Functions that load and validate files, keyed by the kind of file."""

SCHEMAS = {
    "sweep": "srs_twin.studies.sweep.points:sweep_json_schema",
    "study": "srs_twin.studies.optimization.loading:study_json_schema",
    "setup": "srs_twin.live.setup_file:setup_json_schema",
    "inspect": "srs_twin.recordings.facts:facts_json_schema",
}
"""Functions that return the JSON Schema of a file or of JSON output."""


def load(entry: str) -> Any:
    """Import the object to which an entry ``module:object`` refers."""
    return resolve_name(entry)


def installed(table: Mapping[str, str]) -> dict[str, str]:
    """Return the table entries that belong to installed extensions."""
    return {name: entry for name, entry in table.items() if _is_installed(entry)}


def objects(table: Mapping[str, str]) -> Iterator[tuple[str, Any]]:
    """Yield the name and the object of each table entry that is installed."""
    return ((name, load(entry)) for name, entry in installed(table).items())


def module_of(entry: str) -> str:
    """Return the dotted module name of an entry."""
    return entry.partition(":")[0]


def _is_installed(entry: str) -> bool:
    return _has_package(".".join(entry.split(".")[:2]))


@cache
def _has_package(name: str) -> bool:
    return find_spec(name) is not None


class _LazyPackage(ModuleType):
    """Package whose public names are imported on first use."""

    _homes: dict[str, str | None]
    """Module that defines each public name."""

    def __getattr__(self, name: str) -> Any:
        if name not in self._homes:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        return load(f"{self._homes[name]}:{name}")

    def __dir__(self) -> list[str]:
        return sorted(self.__all__)

    def __setattr__(self, name: str, value: object) -> None:
        # The import of a submodule sets an attribute of the package, which would hide
        # a public object of the same name.
        if isinstance(value, ModuleType) and name in self._homes:
            value = getattr(value, name)
        super().__setattr__(name, value)

    def __reduce__(self) -> tuple[Callable[[str], ModuleType], tuple[str]]:
        return import_module, (self.__name__,)


def lazy(package: str) -> None:
    """Make a package import its public names on first use.

    The names are read from the ``if TYPE_CHECKING:`` block in the package's source.
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
"""Environment variable that lists the allowed plug-ins (Python files or module names).
"""

PART_PATTERN = r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z]\w*"
"""Regular expression for the name of a plug-in class, ``module:Name``."""

READING = ContextVar("READING", default=False)
"""Whether a finished run is being read, in which case no plug-ins are imported."""


def allow_plugin(source: str | os.PathLike[str] | ModuleType | type) -> None:
    """Allow scenarios and other files to name the classes of a plug-in.

    Args:
        source: plug-in, given as a module, a module name, a class or the path of a
            Python file.

    Raises:
        InputError: the file or module does not exist, or the file name is not a valid
            and unused module name.
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
    """Return why a plug-in cannot be imported, or an empty string if it is usable."""
    name = os.path.basename(entry).partition(".")[0]
    module = name.isidentifier() and (sys.modules.get(name) or find_spec(name))
    if not entry.endswith(".py"):
        if module:
            return ""
        return (
            "this module does not exist; give a file whose name ends in .py, or"
            " an installed module"
        )
    if not os.path.isfile(entry):
        return "this file does not exist"
    if not name.isidentifier() or os.pathsep in entry:
        return (
            "the file cannot be imported because of its name; use only letters,"
            f" digits and _ in the name of the file, and no '{os.pathsep}' in its path"
        )
    if module:
        places = (getattr(module, key, None) for key in ("__file__", "origin"))
        origin = next(filter(None, places), "built in")
        if os.path.realpath(origin) != os.path.realpath(entry):
            return f"another module is already named {name} ({origin}); rename the file"
    return ""


def plugins() -> dict[str, str]:
    """Return the path or module name of each allowed plug-in, keyed by module name."""
    entries = os.environ.get(PLUGINS, "").split(os.pathsep)
    return {
        os.path.basename(entry).removesuffix(".py"): entry for entry in entries if entry
    }


class _PluginFinder:
    """Import hook for plug-in files, which runs after all other import hooks."""

    @staticmethod
    def find_spec(
        name: str, path: object = None, target: object = None
    ) -> ModuleSpec | None:
        file = plugins().get(name, "")
        if file.endswith(".py"):
            return spec_from_file_location(name, file)
        return None


sys.meta_path.append(_PluginFinder)


def owners() -> dict[str, Distribution]:
    """Return distributions with ``srs_twin.*`` entry points, keyed by package name."""
    # An empty entry in sys.path stands for the current folder, which is not trusted.
    return _owners(tuple(filter(None, sys.path)))


@cache
def _owners(path: tuple[str, ...]) -> dict[str, Distribution]:
    from importlib.metadata import distributions

    found: dict[str, Distribution] = {}
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
    """Return registered classes of a kind as ``module:Name``, keyed by short name."""
    group = f"srs_twin.{kind.removesuffix('s')}s"
    entries = (
        each.entry_points.select(group=group)
        for each in reversed(dict.fromkeys(owners().values()))
    )
    return {entry.name: entry.value for each in entries for entry in each}


def import_plugin(module: str) -> ModuleType:
    """Import a plug-in module.

    Raises:
        InputError: neither the user nor an installed distribution allows the module, or
            the import fails.
    """
    package = module.partition(".")[0]
    if (
        package not in {name.partition(".")[0] for name in plugins()}
        and package not in owners()
    ):
        raise InputError(
            f"module {module} is not imported, because a scenario file must not run"
            " code. If you trust the module, name it with --plugin FILE.py or in the"
            f" environment variable {PLUGINS}"
        )
    OUTSIDE.update(plugins().values())
    try:
        imported = import_module(module)
    except (Exception, SystemExit) as error:  # a plug-in may raise any error
        raise InputError(
            f"module {module} cannot be imported: {describe_error(error)}"
        ) from error
    OUTSIDE.add(imported.__file__ or "")
    return imported


def part(
    kind: str, name: str, bases: tuple[type, ...], known: Iterable[str] = ()
) -> Any:
    """Import a plug-in class.

    Args:
        kind: kind of the class, such as "controller" or "sensor".
        name: class name in the form ``module:Name``, or a registered short name.
        bases: allowed base classes.
        known: further valid names of this kind, for suggestions in error messages.

    Raises:
        UnknownNameError: no distribution has registered the short name.
        InputError: the module is not allowed, or the class is abstract or does not
            derive from an allowed base class.
    """
    names = {name: name} if ":" in name else registered(kind)
    if name not in names:
        raise UnknownNameError(kind, name, (*known, *names))
    if not re.fullmatch(PART_PATTERN, names[name], re.ASCII):
        raise InputError(
            f"'{names[name]}' is not the name of a class; write module:Name, such as"
            " my_module:MyController"
        )
    module, _, attribute = names[name].partition(":")
    found = getattr(import_plugin(module), attribute, None)
    is_derived = (
        isinstance(found, type) and issubclass(found, bases) and found not in bases
    )
    if not is_derived or isabstract(found):
        expected = " or ".join(base.__name__ for base in bases)
        raise InputError(
            f"{names[name]} is not allowed; it must be a class that derives from"
            f" {expected} and implements all abstract methods of its base class"
        )
    return found


def plugin_parts(base: type) -> Iterator[tuple[str, Any]]:
    """Yield all instances and subclasses of `base` in plug-ins, with module names."""
    for module in plugins():
        for found in vars(import_plugin(module)).values():
            is_class = isinstance(found, type) and found.__module__ == module
            if isinstance(found, base) or (
                is_class and issubclass(found, base) and not isabstract(found)
            ):
                yield module, found


@contextmanager
def reading() -> Iterator[None]:
    """Disable the import of plug-ins while the files of a finished run are read."""
    token = READING.set(True)
    try:
        yield
    finally:
        READING.reset(token)
