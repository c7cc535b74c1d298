"""Options shared by several commands, and option groups as dataclasses."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, is_dataclass
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_type_hints

import typer

from srs_twin.errors import check_choice
from srs_twin.extensions import PLUGINS, allow_plugin

if TYPE_CHECKING:
    from typer.models import ArgumentInfo, OptionInfo

    from srs_twin.io.documents import Override


def option(declaration: str, text: str | None = None, **settings: Any) -> OptionInfo:
    """Define a command option.

    Args:
        declaration: flags and name of the value, such as "--robot -r ROBOT".
        text: help text, which by default is taken from a docstring.
        settings: additional arguments of `typer.Option`.
    """
    words = declaration.split()
    flags = [word for word in words if word.startswith("-")]
    metavar = " ".join(word for word in words if not word.startswith("-"))
    info: OptionInfo = typer.Option(
        *flags, metavar=metavar or None, help=text, **settings
    )
    return info


class OptionRange(NamedTuple):
    """Minimum and maximum of an option that is declared in a docstring."""

    min: float | None = None
    max: float | None = None


def argument(
    metavar: str, text: str | None = None, *, shipped: Sequence[str] = ()
) -> ArgumentInfo:
    """Define a command argument.

    Args:
        metavar: argument name shown in the help.
        text: help text, which by default is taken from a docstring.
        shipped: kinds of shipped files whose names are offered as shell completions.
    """

    def complete(incomplete: str) -> list[str]:
        from srs_twin.io.files import shipped_names

        return [
            name
            for kind in shipped
            for name in shipped_names(kind)
            if name.startswith(incomplete)
        ]

    completion = complete if shipped else None
    info: ArgumentInfo = typer.Argument(
        metavar=metavar, help=text, autocompletion=completion
    )
    return info


def workers_option(declaration: str) -> OptionInfo:
    """Define the option that sets the number of parallel runs."""
    return option(
        declaration,
        "Number of parallel runs. With 1, runs are executed one after another."
        " [default: one per processor]",
        min=1,
        max=4096,
    )


ScenarioArgument = Annotated[
    str,
    argument(
        "SCENARIO",
        "Name of a shipped scenario, or path of a scenario file.",
        shipped=["scenario"],
    ),
]
RobotArgument = Annotated[
    str,
    argument(
        "ROBOT", "Name of a shipped robot, or path of a robot file.", shipped=["robot"]
    ),
]
OneOutOption = Annotated[
    str | None,
    option("--out DIR", "Folder for the output files. [default: runs/SCENARIO]"),
]
CheckOption = Annotated[
    bool,
    option("--check", "Exit with code 1 if a result lies outside its expected range."),
]
StrictOption = Annotated[
    bool,
    option(
        "--strict",
        "Like --check, but expectations that cannot be judged or are marked with"
        " `expected_failure` also cause exit code 1.",
    ),
]
QuietOption = Annotated[
    bool, option("--quiet -q", "Print only errors, without tables and progress.")
]
WorkersOption = Annotated[int | None, workers_option("--workers -j N")]
JsonOption = Annotated[
    bool, option("--json", "Print the result as a JSON document instead of tables.")
]
PluginOption = Annotated[
    list[str] | None,
    option(
        "--plugin FILE.py",
        "Python file with classes used by the input files, such as a controller. Can be"
        f" repeated. Alternatively, list files in the environment variable {PLUGINS}.",
    ),
]
OverwriteOption = Annotated[
    bool, option("--overwrite", "Replace the output file if it already exists.")
]

PressureOption = Annotated[
    float | None,
    option(
        "--pressure KPA",
        "Supply pressure (gauge) in kPa. [default: from the robot file]",
        min=0.1,
        max=2000.0,
    ),
]
FloorOption = Annotated[
    str | None,
    option(
        "--friction-law NAME",
        "Friction law of the analytical model: axis, wheel, ellipse, cosine or viscous."
        " [default: wheel]",
    ),
]


def print_json(document: object) -> None:
    """Print a JSON document on stdout, with NumPy arrays as lists."""
    import json

    # The output is ASCII, because file names may contain control characters, which a
    # terminal would interpret.
    typer.echo(
        json.dumps(
            document, indent=2, allow_nan=False, default=lambda value: value.tolist()
        )
    )


def parse_plants(text: str | None) -> list[str] | None:
    """Return the plants listed in `--plants`, or None without this option."""
    plants = ("analytical", "twin")
    if text is None:
        return None
    names = [name.strip() for name in text.split(",")]
    for name in names:
        check_choice("--plants:", name, plants)
    return [plant for plant in plants if plant in names]


@dataclass(frozen=True)
class ChangeOptions:
    """Options that override fields of a scenario.

    Options:
        --set FIELD=VALUE: Override a field of the scenario, for example
            controller.frequency_hz=1.5. Can be repeated.
        --duration S: Override the simulated duration, in seconds.
        --seed N: Override the random seed.
    """

    set: list[str] | None = None
    duration: str | None = None
    seed: str | None = None

    def changes(self) -> list[Override]:
        """Return the overridden fields.

        Raises:
            InputError: an override does not have the form FIELD=VALUE.
        """
        from srs_twin.io.documents import Override

        changes = []
        for text in self.set or ():
            field, sign, value = text.partition("=")
            if not sign:
                field = ""  # Override.parse rejects an empty field
            changes.append(Override.parse(f"--set {text}", field.strip(), value))
        for name, field in (("duration", "duration_s"), ("seed", "seed")):
            value = getattr(self, name)
            if value is not None:
                changes.append(Override.parse(f"--{name} {value}", field, value))
        return changes


NO_CHANGES = ChangeOptions()


def expand_option_groups(
    command: Callable[..., None], *, plugins: bool = False
) -> Callable[..., None]:
    """Convert option groups and documented options of a command for Typer.

    A parameter whose type is a dataclass is replaced with the fields of the dataclass.
    Options are declared in the docstring of the command or dataclass, in a section
    "Options:". For example, the entry "--out DIR: Output folder." declares the option
    for the parameter `out`. If a parameter is annotated with `option` or `argument`,
    its entry begins with the parameter name instead of flags.
    """
    description, options = _parse_docstring(command)
    hints = get_type_hints(command, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    groups = {
        name: kind
        for name, kind in hints.items()
        if isinstance(kind, type) and is_dataclass(kind)
    }
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        members = [parameter]
        annotations = hints
        if name in groups:
            members = list(inspect.signature(groups[name]).parameters.values())
            annotations = get_type_hints(groups[name], include_extras=True)
            for kind in groups[name].__mro__[:-1]:
                options |= _parse_docstring(kind)[1]
        for member in members:
            declared = options.get(member.name.rstrip("_"), ("", ""))
            annotation = _with_option(annotations[member.name], *declared)
            parameters.append(member.replace(kind=keyword, annotation=annotation))
    if plugins:
        parameters.append(
            inspect.Parameter("plugin", keyword, default=None, annotation=PluginOption)
        )

    @wraps(command)
    def run(**values: Any) -> None:
        for source in values.pop("plugin", None) or ():
            allow_plugin(source)
        for name, kind in groups.items():
            members = inspect.signature(kind).parameters
            values[name] = kind(**{member: values.pop(member) for member in members})
        command(**values)

    run.__doc__ = description
    run.__annotations__ = {}
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run


def _with_option(annotation: object, declaration: str, text: str) -> object:
    (info,) = getattr(annotation, "__metadata__", (None,))
    if declaration.startswith("-"):
        settings = info._asdict() if info else {}
        return Annotated[annotation, option(declaration, text, **settings)]
    if info is not None:
        info.help = info.help or text
    return annotation


def _parse_docstring(documented: object) -> tuple[str, dict[str, tuple[str, str]]]:
    """Return the description and the options in a docstring.

    The options map parameter names to declarations and help texts.
    """
    description, _, section = (inspect.getdoc(documented) or "").partition(
        "\n\nOptions:\n"
    )
    entries = re.findall(
        r"^ {4}((?:--)?([\w-]+).*?): (.*(?:\n {8}.*)*)", section, re.MULTILINE
    )
    return description, {
        name.replace("-", "_"): (declaration, " ".join(text.split()))
        for declaration, name, text in entries
    }
