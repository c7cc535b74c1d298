"""Options that several commands share, and classes of options that commands take as one parameter."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, is_dataclass
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from srs_twin.errors import check_choice

if TYPE_CHECKING:
    from srs_twin.io.documents import Override
    from srs_twin.recordings.takes import RecordingReader

FITS = "calibration/fits"


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

FilesArgument = Annotated[list[str], argument("FILE", "Recordings or tables that the fit is made from.")]
RobotOption = Annotated[str, option("--robot -r ROBOT", "Where the search starts: shipped, or a file.")]
_VALIDATE = "Held against the fit, which does not see it; repeatable."
ValidateOption = Annotated[list[str] | None, option("--validate FILE", _VALIDATE)]
_LOGS = "Log of each recording, FILE... first, then --validate. [default: NAME.valves.csv beside it]"
ValvesOption = Annotated[list[str] | None, option("--valves LOG", _LOGS)]
_OFFSET = "What to add to the logs' times. [default: estimated]"
OffsetOption = Annotated[float | None, option("--offset S", _OFFSET)]
PressureOption = Annotated[float | None, option("--pressure KPA", "Of the supply. [default: the robot's]")]
_FIND = "What to look for, as friction.mu_t,friction.mu_n."
FindOption = Annotated[str | None, option("--find NAMES", _FIND)]
FrequencyOption = Annotated[float | None, option("--frequency HZ", "Of the gait. [default: the valves']")]
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
        check_choice("--plants:", each, known)
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

    def changes(self) -> list[Override]:
        """Return what was given, as fields of a scenario.

        Raises:
            InputError: what was given is no field with a value.
        """
        from srs_twin.io.documents import Override

        found = []
        for text in self.change or ():
            field, sign, value = text.partition("=")
            found.append(Override.parse(f"--set {text}", field.strip() if sign else "", value))
        for field, given in (("duration_s", self.duration), ("seed", self.seed)):
            if given is not None:
                found.append(Override.parse(f"--{field.removesuffix('_s')} {given}", field, given))
        return found


NO_CHANGES = ChangeOptions()


@dataclass(frozen=True)
class ReadingOptions:
    """How markers are read; see `RecordingReader`.

    Options:
        up: Axis of the files that points up.
        layout: Markers: auto, single, head, pair, middles or head_middles.
        head: At the head. [default: where it crawls to]
        longest_gap: Longest gap that is filled. [default: 0.2]
        map: What is what in the files (docs/logs.md).
        units: Of lengths, where the file does not say: m, cm, mm, in, ft.
        rate: Frames a second, where the file has no time.
        columns: Names of the columns of a plain file that has none, as time,x_1,y_1.
        separator: Separator of the cells of a plain file: , ; | tab or space, where it is not found.
        decimal: Decimal mark of a plain file, where it is not found.
        marker: Its place, as tip=connector 3, m1=middle 1 or h2=connector 1 ahead; repeatable.
    """

    up: Annotated[str, option("--up AXIS")] = "auto"
    layout: Annotated[str, option("--layout NAME")] = "auto"
    head: Annotated[str | None, option("--head MARKER")] = None
    longest_gap: Annotated[float | None, option("--longest-gap S")] = None
    map: Annotated[str | None, option("--map FILE.yaml")] = None
    units: Annotated[str | None, option("--units UNIT")] = None
    rate: Annotated[float | None, option("--rate HZ")] = None
    columns: Annotated[str | None, option("--columns NAMES")] = None
    separator: Annotated[str | None, option("--separator CHARACTER")] = None
    decimal: Annotated[str | None, option("--decimal CHARACTER")] = None
    marker: Annotated[list[str] | None, option("--marker NAME=PLACE")] = None

    def given(self) -> dict[str, Any]:
        """Return what was given, by the names of `RecordingReader`; a map as plain data."""
        from srs_twin.recordings.recording_map import given_map

        options = {
            "units": self.units, "rate_hz": self.rate, "columns": self.columns, "separator": self.separator,
            "decimal": self.decimal,
        }  # fmt: skip
        values = {
            "up": self.up, "layout": self.layout, "head": self.head, "longest_gap_s": self.longest_gap,
            "map": given_map(self.map, options, self.marker or ()),
        }  # fmt: skip
        return {name: value for name, value in values.items() if value is not None}

    def reader(self, **more: Any) -> RecordingReader:
        """Return a reader with what was given.

        Raises:
            InputFileError: what is wrong with a map.
        """
        from srs_twin.recordings.recording_map import read_map
        from srs_twin.recordings.takes import RecordingReader

        given = self.given()
        return RecordingReader(**given | {"map": read_map(given.get("map", {}))}, **more)


@dataclass(frozen=True)
class FitOptions:
    """Where a fit goes, and whether to be quiet.

    Options:
        name: Of the fit and its file. [default: ROBOT_WHAT]
        out: Its file. [default: calibration/fits/NAME.yaml]
        overwrite: Replace the fit of another command.
    """

    name: Annotated[str | None, option("--name NAME")] = None
    out: Annotated[str | None, option("--out FILE.yaml")] = None
    overwrite: Annotated[bool, option("--overwrite")] = False
    quiet: QuietOption = False
    as_json: JsonOption = False


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
