"""Options that several commands share, and classes of options that commands take as one parameter."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, is_dataclass
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from srs_twin.errors import one_of

if TYPE_CHECKING:
    from srs_twin.io.documents import Change


def option(words: str, help: str | None = None, **more: Any) -> Any:
    """Return an option of a command.

    Args:
        words: as help shows it: "--robot -r ROBOT"; a flag: "--check".
        help: what it is; None: said in the docstring, see `with_options`.
        more: as `typer.Option` takes it.
    """
    flags = [word for word in words.split() if word.startswith("-")]
    value = [word for word in words.split() if not word.startswith("-")]
    return typer.Option(*flags, metavar=" ".join(value) or None, help=help, **more)


def argument(name: str, help: str | None = None, *, of: Sequence[str] = ()) -> Any:
    """Return an argument of a command.

    Args:
        name: as help shows it.
        help: as in `option`.
        of: kinds of shipped files whose names a shell may complete: "scenario", "robot", "sweep".
    """

    def names(incomplete: str) -> list[str]:
        from srs_twin.io.files import shipped_names

        return [each for kind in of for each in shipped_names(kind) if each.startswith(incomplete)]

    return typer.Argument(metavar=name, help=help, autocompletion=names if of else None)


def at_once(words: str) -> Any:
    """Return the option that says how many of a command's runs go on at once."""
    return option(words, "Runs at once; 1: one after the other. [default: one a processor]", min=1, max=4096)


ScenarioArgument = Annotated[str, argument("SCENARIO", "A shipped scenario or a file.", of=["scenario"])]
RobotArgument = Annotated[str, argument("ROBOT", "A shipped robot or a file.", of=["robot"])]
OneOutOption = Annotated[str | None, option("--out DIR", "Folder for the files. [default: runs/SCENARIO]")]
CheckOption = Annotated[bool, option("--check", "Exit with 1 when an expectation fails.")]
_STRICT = "Like --check, and also fail on expectations marked `known` or not judged."
StrictOption = Annotated[bool, option("--strict", _STRICT)]
QuietOption = Annotated[bool, option("--quiet -q", "No table and no progress; errors only.")]
JobsOption = Annotated[int | None, at_once("--jobs -j N")]
JsonOption = Annotated[bool, option("--json", "Print one JSON document instead of tables.")]
OverwriteOption = Annotated[bool, option("--overwrite", "Replace another file.")]

PressureOption = Annotated[float | None, option("--pressure KPA", "Of the supply. [default: the robot's]")]
_FLOOR = "Of the analytical plant's floor. [default: wheel]"
FloorOption = Annotated[str | None, option("--law NAME", _FLOOR)]


def print_json(document: Any) -> None:
    """Print one JSON document on stdout; NumPy's numbers and arrays become Python's."""
    import json

    # ASCII alone: a terminal obeys what control characters foreign names hold.
    typer.echo(json.dumps(document, indent=2, allow_nan=False, default=lambda value: value.tolist()))


def plants_of(given: str | None) -> list[str] | None:
    """Return the plants that `--plants` names, None where it was not given."""
    known = ("analytical", "twin")
    wanted = given and [each.strip() for each in given.split(",")]
    for each in wanted or ():
        one_of("--plants:", each, known)
    return [each for each in known if each in wanted] if wanted else None


@dataclass(frozen=True)
class ChangeOptions:
    """What is to be other than in the file.

    Options:
        change: Another value of a field, as controller.frequency_hz=1.5; repeatable.
        duration: Simulated time.
        seed: Of all that is random.
    """

    change: Annotated[list[str] | None, option("--set FIELD=VALUE")] = None
    duration: Annotated[str | None, option("--duration S")] = None
    seed: Annotated[str | None, option("--seed N")] = None

    def changes(self) -> list[Change]:
        """Return what was given, as fields of a scenario.

        Raises:
            InputError: what was given is no field with a value.
        """
        from srs_twin.io.documents import Change

        found = []
        for text in self.change or ():
            field, sign, value = text.partition("=")
            found.append(Change.of(f"--set {text}", field.strip() if sign else "", value))
        for field, given in (("duration_s", self.duration), ("seed", self.seed)):
            if given is not None:
                found.append(Change.of(f"--{field.removesuffix('_s')} {given}", field, given))
        return found


NO_CHANGES = ChangeOptions()


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command whose options are complete.

    A parameter that is a class of options becomes these options. What the section "Options:" of the
    command's or the class's docstring says of an option becomes its help.
    """
    about, texts = _documented(command)
    hints = get_type_hints(command, include_extras=True)
    groups = {name: kind for name, kind in hints.items() if isinstance(kind, type) and is_dataclass(kind)}
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        of, annotations = [parameter], hints
        if name in groups:
            of = list(inspect.signature(groups[name]).parameters.values())
            annotations = get_type_hints(groups[name], include_extras=True)
            texts |= _documented(groups[name])[1]
        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters += [each.replace(kind=keyword, annotation=annotations[each.name]) for each in of]
    for each in parameters:
        for info in getattr(each.annotation, "__metadata__", ()):
            info.help = info.help or texts.get(each.name)

    @wraps(command)
    def run(**given: Any) -> None:
        for name, kind in groups.items():
            given[name] = kind(**{field: given.pop(field) for field in inspect.signature(kind).parameters})
        command(**given)

    run.__doc__, run.__annotations__ = about, {}
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run


def _documented(described: object) -> tuple[str, dict[str, str]]:
    """Return a docstring without its section "Options:", and the text of each of these."""
    about, _, listed = (inspect.getdoc(described) or "").partition("\n\nOptions:\n")
    texts = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", listed, re.MULTILINE)
    return about, {name: " ".join(text.split()) for name, text in texts}
